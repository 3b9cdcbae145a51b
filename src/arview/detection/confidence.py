"""Probability that a pose found without history is right.

Four linear models share the weights file ``pose_confidence.json``: a logit of the edge and colour evidence, a score
that ranks the hypotheses of one image, and two logistic regressions for the probability of the best of them. One of
these relies on the pose verifier, the other on the outline alone, because the verifier can reject right poses of parts
that look unlike all it was trained on; the surer one counts. They were fitted as conditional logistic regressions
(McFadden, "Conditional logit analysis of qualitative choice behavior", 1974)
and as a logistic regression with non-negative weights.
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

from arview.refinement import PoseEvidence
from arview.weights import load_weights

MIN_VERIFIER_SCORE = -4.0
"""Lower bound on the verifier score, which can reject right poses on unknown materials."""
MAX_NEARBY_MARGIN = 6.0
"""Upper bound on the margin over other poses at the same place."""
MAX_DISTANT_MARGIN = 4.0
"""Upper bound on the margin over poses at other places."""
MIN_VIEW_RICHNESS = -0.5
MAX_VIEW_RICHNESS = 0.3
"""Bounds on the log ratio of distinct lines in the view to the usual number."""
SMALL_RADIUS_PX = 60.0
"""Half diameter below which a part counts as small; small parts fit clutter more often."""
OUTLINE_CONTOUR = -1.0
OUTLINE_SLOPE = 1.5
"""Score of the contour verifier at which a well-supported outline counts half, and slope of the logistic function
around it."""
FULL_INNER_SHARE = 0.5
FULL_INNER_SUPPORT = 0.25
"""Share of design edges inside the outline from which they must be seen, too, and support with which they are."""
MIN_OUTLINE = 0.15
"""Outline score below which the outline alone confirms no pose."""
MAX_CUT_LOSS = 8.0
"""Log odds that a pose entirely outside the picture would lose. A pose cut by the picture's border loses its share of
them unless the outline score reaches ``MIN_OUTLINE`` and the contour verifier confirms what is left, because a part of
an outline fits clutter more often than a whole one."""
CUT_GAIN, CUT_GAIN_SHARE = 1.0, 0.1
"""Log odds by which the regression with the verifiers takes cut poses for less likely than they are, because these saw
few, and the share outside the picture from which it does so."""
FAR_OUTSIDE, FAR_OUTSIDE_LOSS = 0.4, 14.0
"""Share of the outline outside the picture from which what is left fits clutter, and the log odds lost for each whole
share beyond it."""
CUT_CONTOUR = -0.1
CUT_SLOPE = 3.0
"""Score of the contour verifier at which a cut pose counts as half confirmed, and slope of the logistic function around
it."""


class EvidenceFeatures(NamedTuple):
    """Features of the evidence for one pose, or the weights of these features.

    Attributes:
        contour_support: outline points supported beyond chance, by the share of the outline.
        sharpness: sharpness of the outline, by the share of the outline.
        inner_support: design edges supported beyond chance, by their share.
        colours: region support by its information, by the share of the outline.
        log_view_lines: logarithm of the distinct lines that the view shows.
        contour_and_sharpness: product of contour support and sharpness, by the share of the outline.
        inner_and_contour: product of inner and contour support, by the share of design edges.
        negative_scatter_px: negative mean distance of the supporting steps from the outline.
        log_size: logarithm of the half diameter relative to 50 px.
    """

    contour_support: float
    sharpness: float
    inner_support: float
    colours: float
    log_view_lines: float
    contour_and_sharpness: float
    inner_and_contour: float
    negative_scatter_px: float
    log_size: float


class ConfidenceTerms(NamedTuple):
    """Terms of the probability of a hypothesis, or the weights of these terms.

    Attributes:
        appearance: verifier score and edge responses, see `appearance_score`.
        evidence: logit of the evidence, see `evidence_logit`.
        profile: score of the profile rankers.
        contour: score of the contour verifier.
        nearby_margin, distant_margin: bounded margins over competing hypotheses, see `Margins`.
        is_alone: 1 where neither margin is below the bound of the nearby one.
        view_richness: bounded log ratio of distinct lines in the view to the usual number of the part.
        log_size: logarithm of the half diameter relative to `SMALL_RADIUS_PX`, at most 0.
        outline: support, sharpness and colours of the outline as one product, see `outline_score`.
    """

    appearance: float
    evidence: float
    profile: float
    contour: float
    nearby_margin: float
    distant_margin: float
    is_alone: float
    view_richness: float
    log_size: float
    outline: float


class RankingWeights(NamedTuple):
    """Weights beside the verifier score when verified hypotheses of one image are ranked."""

    evidence: float
    profile: float
    edge_response: float
    contour: float


class ConfidenceWeights(NamedTuple):
    """All fitted weights.

    Attributes:
        evidence, evidence_bias: of `evidence_logit`.
        unverified_evidence: of the evidence logit beside the profile score, before verification.
        verified: of the ranking after verification.
        probability, probability_bias: of `pose_probability` with the pose verifier.
        by_outline, by_outline_bias: of `pose_probability` without it.
        appearance_edge_response: of the edge response beside the verifier score in `appearance_score`.
    """

    evidence: EvidenceFeatures
    evidence_bias: float
    unverified_evidence: float
    verified: RankingWeights
    probability: ConfidenceTerms
    probability_bias: float
    by_outline: ConfidenceTerms
    by_outline_bias: float
    appearance_edge_response: float


@cache
def confidence_weights() -> ConfidenceWeights:
    """The fitted weights of ``pose_confidence.json``."""
    groups = load_weights("pose_confidence")
    evidence, probability, by_outline = groups["evidence"], groups["probability"], groups["by_outline"]
    evidence_bias, probability_bias, by_outline_bias = (
        group.pop("bias") for group in (evidence, probability, by_outline)
    )
    edge_response = probability.pop("edge_response")
    return ConfidenceWeights(
        evidence=EvidenceFeatures(**evidence),
        evidence_bias=evidence_bias,
        unverified_evidence=groups["unverified"]["evidence"],
        verified=RankingWeights(**groups["verified"]),
        probability=ConfidenceTerms(**probability),
        probability_bias=probability_bias,
        by_outline=ConfidenceTerms(**by_outline),
        by_outline_bias=by_outline_bias,
        appearance_edge_response=edge_response,
    )


class Margins(NamedTuple):
    """Differences of logits between a hypothesis and its best competitors; infinite where there is none.

    Attributes:
        nearby: over the best other pose at the same place.
        distant: over the best pose at another place.
    """

    nearby: float
    distant: float


def evidence_features(evidence: PoseEvidence, view_lines: float, radius_px: float) -> EvidenceFeatures:
    """Features of the evidence for one pose; see `evidence_logit` for the arguments."""
    share = min(0.5, evidence.inner_share)
    colours = max(evidence.region_support, 0.0) * min(evidence.region_information / 0.2, 1.0)
    return EvidenceFeatures(
        contour_support=(1.0 - share) * evidence.contour_support,
        sharpness=(1.0 - share) * evidence.sharpness,
        inner_support=share * evidence.inner_support,
        colours=(1.0 - share) * colours,
        log_view_lines=math.log(view_lines),
        contour_and_sharpness=(1.0 - share) * evidence.contour_support * evidence.sharpness,
        inner_and_contour=share * evidence.inner_support * evidence.contour_support,
        negative_scatter_px=-evidence.scatter_px,
        log_size=math.log(max(radius_px, 5.0) / 50.0),
    )


def evidence_logit(evidence: PoseEvidence, view_lines: float, radius_px: float) -> float:
    """Log odds of a hypothesis by its evidence alone; differences compare the hypotheses of one image.

    Args:
        evidence: edge and colour evidence at the pose.
        view_lines: distinct lines that the view shows, see `guideviews.uniqueness.view_lines`.
        radius_px: half the part's diameter in the image; small parts fit clutter more often.
    """
    weights = confidence_weights()
    return weights.evidence_bias + _weighted(weights.evidence, evidence_features(evidence, view_lines, radius_px))


def appearance_score(verifier_score: float, edge_response: float) -> float:
    """What the learned models predict from the image around a pose, as one term of the probability.

    Args:
        verifier_score: of the pose verifier.
        edge_response: mean edge response along the part's lines, 0–1.
    """
    bounded = max(verifier_score, MIN_VERIFIER_SCORE)
    return bounded + confidence_weights().appearance_edge_response * edge_response


def outline_score(
    evidence: PoseEvidence,
    outline: PoseEvidence,
    contour: float,
) -> float:
    """How clearly the image shows the outline of a pose, 0–1, as one term of the probability.

    Things with two long straight sides fit the outline of many parts; a part with design edges inside must show some of
    them, too, and a cut outline counts less.

    Args:
        evidence: edge and colour evidence at the pose.
        outline: the same at the scale at which the outline is judged.
        contour: score of the contour verifier; a low one says that the outline is not the part's.
    """
    colours = max(outline.region_support, 0.0) * max(evidence.region_support, 0.0)
    shown = outline.contour_support * outline.sharpness * colours
    share = min(1.0, evidence.inner_share / FULL_INNER_SHARE)
    inner = 1.0 - share + share * min(1.0, evidence.inner_support / FULL_INNER_SUPPORT)
    shown *= inner * evidence.points_in_picture
    return shown / (1.0 + math.exp(-OUTLINE_SLOPE * (contour - OUTLINE_CONTOUR)))


def confidence_terms(
    appearance: float,
    evidence: float,
    outline: float,
    profile: float,
    contour: float,
    margins: Margins,
    relative_lines: float,
    radius_px: float,
) -> ConfidenceTerms:
    """Terms of the probability of the best hypothesis of an image.

    Args:
        appearance: see `appearance_score`.
        evidence: see `evidence_logit`; with the profile score more reliable than ``appearance`` on parts unlike the
            training solids.
        outline: see `outline_score`.
        profile: score of the profile rankers.
        contour: score of the contour verifier.
        margins: over other hypotheses; a right pose stands out, poses that fit by chance come in groups.
        relative_lines: distinct lines in the view relative to the geometric mean over the part's views; plain views
            fit clutter by chance more often than others.
        radius_px: half the part's diameter in the image.
    """
    return ConfidenceTerms(
        appearance=appearance,
        evidence=evidence,
        profile=profile,
        contour=contour,
        nearby_margin=min(margins.nearby, MAX_NEARBY_MARGIN),
        distant_margin=min(margins.distant, MAX_DISTANT_MARGIN),
        is_alone=float(min(margins.nearby, margins.distant) >= MAX_NEARBY_MARGIN),
        view_richness=min(max(math.log(relative_lines), MIN_VIEW_RICHNESS), MAX_VIEW_RICHNESS),
        log_size=min(math.log(max(radius_px, 1.0) / SMALL_RADIUS_PX), 0.0),
        outline=outline,
    )


def pose_probability(terms: ConfidenceTerms, share_outside: float = 0.0) -> float:
    """Probability that the best hypothesis of an image is right: that of the surer of both regressions.

    Args:
        terms: of the hypothesis.
        share_outside: of the outline, cut off by the picture's border.
    """
    weights = confidence_weights()
    total = verified = weights.probability_bias + _weighted(weights.probability, terms)
    if terms.outline >= MIN_OUTLINE:
        total = max(total, weights.by_outline_bias + _weighted(weights.by_outline, terms))
    is_confirmed = 1.0 / (1.0 + math.exp(-CUT_SLOPE * (terms.contour - CUT_CONTOUR)))
    is_clear = min(max(terms.outline, 0.0) / MIN_OUTLINE, 1.0) * is_confirmed
    total -= MAX_CUT_LOSS * share_outside * (1.0 - is_clear)
    total = max(total, verified + CUT_GAIN * min(share_outside / CUT_GAIN_SHARE, 1.0) - share_outside)
    total -= FAR_OUTSIDE_LOSS * max(share_outside - FAR_OUTSIDE, 0.0)
    return 1.0 / (1.0 + math.exp(-min(max(total, -50.0), 50.0)))


def _weighted(weights: tuple[float, ...], features: tuple[float, ...]) -> float:
    return sum(weight * feature for weight, feature in zip(weights, features, strict=True))
