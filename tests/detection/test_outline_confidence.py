"""The outline alone confirms a pose that the verifier does not know, and only a clear one."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from arview.detection.confidence import (
    CUT_GAIN,
    MIN_OUTLINE,
    ConfidenceTerms,
    Margins,
    confidence_terms,
    outline_score,
    pose_probability,
)
from arview.refinement.evidence import PoseEvidence

CLEAR = PoseEvidence(
    contour_support=0.9,
    inner_support=0.4,
    inner_share=0.8,
    sharpness=0.95,
    region_support=0.9,
    region_information=0.2,
    points_in_picture=1.0,
)
"""Evidence at a right pose of a part before a plain background."""


def terms(outline: float, appearance: float = -2.0, nearby: float = 9.0) -> ConfidenceTerms:
    return confidence_terms(
        appearance=appearance,
        evidence=0.0,
        outline=outline,
        profile=1.0,
        contour=1.0,
        margins=Margins(nearby, 9.0),
        relative_lines=1.3,
        radius_px=120.0,
    )


def test_a_clear_outline_confirms_a_pose_that_the_verifier_doubts() -> None:
    outline = outline_score(CLEAR, CLEAR, contour=1.0)
    assert outline == pytest.approx(0.9 * 0.95 * 0.9 * 0.9, abs=0.06)
    assert pose_probability(terms(outline)) > 0.9
    assert pose_probability(terms(0.0)) < 0.6


def test_a_strong_competitor_at_the_same_place_leaves_it_open() -> None:
    outline = outline_score(CLEAR, CLEAR, contour=1.0)
    assert pose_probability(terms(outline, nearby=1.0)) < 0.5


@pytest.mark.parametrize(
    ("evidence", "contour"),
    [
        (replace(CLEAR, region_support=0.3), 1.0),
        (replace(CLEAR, inner_support=0.02), 1.0),
        (replace(CLEAR, contour_support=0.3, sharpness=0.4), 1.0),
        (CLEAR, -4.0),
    ],
    ids=["other colours", "no design edges", "no outline", "a drifting outline"],
)
def test_the_outline_confirms_nothing_where_something_contradicts(evidence: PoseEvidence, contour: float) -> None:
    assert outline_score(evidence, evidence, contour) < MIN_OUTLINE


def test_a_part_without_design_edges_need_not_show_any() -> None:
    plain = replace(CLEAR, inner_share=0.0, inner_support=0.0)
    assert outline_score(plain, plain, 1.0) >= outline_score(CLEAR, CLEAR, 1.0)


def test_a_cut_outline_counts_less() -> None:
    cut = replace(CLEAR, points_in_picture=0.5)
    whole = outline_score(CLEAR, CLEAR, 1.0)
    assert outline_score(cut, cut, 1.0) == pytest.approx(0.5 * whole)


def odds(terms: ConfidenceTerms, share_outside: float) -> float:
    probability = pose_probability(terms, share_outside)
    return probability / (1.0 - probability)


def test_a_cut_pose_with_a_clear_outline_loses_little_up_to_two_fifths() -> None:
    clear = terms(0.3)._replace(contour=2.0, appearance=3.0)
    assert pose_probability(clear) > 0.9 and pose_probability(clear, 0.4) > pose_probability(clear) - 0.05
    assert odds(clear, 0.5) < 0.5 * odds(clear, 0.4)


def test_a_cut_pose_is_confirmed_by_the_verifiers_or_by_its_outline() -> None:
    """The verifiers alone give a cut pose what they give a whole one, less its share outside; the outline alone less
    still, unless it is clear."""
    verified = terms(0.0)._replace(contour=-3.0, appearance=3.0)
    assert odds(verified, 0.35) == pytest.approx(odds(verified, 0.0) * math.exp(CUT_GAIN - 0.35), rel=1e-6)
    by_outline = terms(0.05)._replace(contour=-0.5, appearance=-4.0)
    by_share = [pose_probability(by_outline, share) for share in (0.1, 0.25, 0.4, 0.6)]
    assert by_share == sorted(by_share, reverse=True) and by_share[0] > 1.2 * by_share[-1]
