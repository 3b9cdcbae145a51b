"""Probability that a pose which was found without history is right, from all that speaks for it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from arview.refinement.evidence import PoseEvidence


def evidence_features(evidence: PoseEvidence, lines: float, radius_px: float) -> tuple[float, ...]:
    """What speaks for a pose that was found without history, for `evidence_logit`."""
    share = min(0.5, evidence.inner_share)
    colours = max(evidence.region_support, 0.0) * min(evidence.region_information / 0.2, 1.0)
    return (
        (1.0 - share) * evidence.contour_support,
        (1.0 - share) * evidence.sharpness,
        share * evidence.inner_support,
        (1.0 - share) * colours,
        math.log(lines),
        (1.0 - share) * evidence.contour_support * evidence.sharpness,
        share * evidence.inner_support * evidence.contour_support,
        -evidence.scatter_px,
        math.log(max(radius_px, 5.0) / 50.0),
    )


LOGIT_WEIGHTS = (2.61, 0.30, 5.90, 4.13, 0.73, 2.00, 11.22, 2.68, 3.11)
LOGIT_BIAS = -10.0
"""For comparing hypotheses of one picture: conditional logistic regression (McFadden 1974) with weights that may not
be negative, on the hypotheses of the detector in 194 semi-synthetic and recorded frames, halved."""
EVIDENCE_WEIGHT = 0.82
"""Of that beside what the judge says, fitted together with it."""
VERIFIED_EVIDENCE, VERIFIED_JUDGEMENT, VERIFIED_LINES = 0.67, 0.48, 4.5
"""Of evidence, judge, and what the line network sees along a pose's lines, beside what the verifier says: fitted as
above on 761 pictures of 53 random solids in which right and wrong poses compete."""
VERIFIED_STRIPS = 1.0
"""And of what strips say: the likeliest, all others as they are, in 464 pictures of 26 random solids on which they were
not fitted; it is hardly less likely from 0.8 to 1.3."""
LEAST_VERIFIED = -4.0
"""Less than this the verifier does not say: on materials that it does not know it denies right poses, too."""
FOUND_LINES = 6.2
FOUND_WEIGHTS = (0.59, 0.07, 0.02, 0.60, 0.09, 0.39, 1.38, 3.37, 2.63)
FOUND_BIAS = -4.24
"""For the probability, in which lines count so much beside the verifier: logistic regression with weights that may not
be negative, on the best hypotheses of the search in 504 pictures of 31 other solids where these were right and in 371
without the part, many in crowds of others; on 198 frames of the recordings and 299 photos of others, which count twice;
and on 1,000 photos and pictures of other parts for the semi-synthetic shapes and the recorded parts, which count half.
As fitted the bias would be 1.25 higher: of 1,001 further such pictures 12 would be taken for the part, with it and all
four searches 3 are, and of another 1,001 none. What the view shows is the strongest term beside the verifier: without
it 9 were taken for the part."""
LARGEST_HERE, LARGEST_ELSEWHERE = 6.0, 4.0
"""Larger leads say no more."""
LEAST_SHOWN, MOST_SHOWN = -0.5, 0.3
"""Nor does a view that shows fewer or more lines than the usual one by these logarithms. With -0.75 as the least,
the back of a plate is taken for another plate less often, but right ones from behind are found less often: no gain."""
SMALL_PX = 60.0
"""Parts of less than this half diameter fit by chance the more often the smaller they are."""


@dataclass(frozen=True)
class Margins:
    """Margins of a hypothesis' logit over the best ones for other poses at the same place and elsewhere.

    The right pose stands out; of many that fit by chance one is hardly better than the next. Infinite without rivals.
    """

    here: float
    elsewhere: float


def evidence_logit(evidence: PoseEvidence, lines: float, radius_px: float) -> float:
    """By how much one of many hypotheses of a picture is likelier than another.

    Args:
        evidence: of the hypothesis.
        lines: distinct lines that its view shows, see `view_lines`.
        radius_px: half the part's diameter in the picture: small ones fit by chance more often.
    """
    return LOGIT_BIAS + _weighted(LOGIT_WEIGHTS, evidence_features(evidence, lines, radius_px))


def confidence_terms(
    seen: float,
    evidence_logit: float,
    profile_score: float,
    strips: float,
    leads: Margins,
    shown: float,
    radius_px: float,
) -> tuple[float, ...]:
    """What speaks for the best hypothesis of a picture, for `pose_probability`.

    Args:
        seen: what verifier and line network see there, see `Hypothesis`; on parts unlike those that they know the next
            two are the surer ones.
        evidence_logit: see `evidence_logit`.
        profile_score: see `judge`.
        strips: see `ContourVerifier`.
        leads: over other hypotheses.
        shown: distinct lines that its view shows, against what the part's views show in the (geometric) mean. A plain
            view fits by chance where no other does: of 82 likely poses without the part half were among the plainest
            eighth of views, of 702 right ones a fourteenth.
        radius_px: half the part's diameter in the picture.
    """
    here, elsewhere = min(leads.here, LARGEST_HERE), min(leads.elsewhere, LARGEST_ELSEWHERE)
    is_alone = float(min(leads.here, leads.elsewhere) >= LARGEST_HERE)
    rich, small = min(max(math.log(shown), LEAST_SHOWN), MOST_SHOWN), min(math.log(max(radius_px, 1.0) / SMALL_PX), 0.0)
    return seen, evidence_logit, profile_score, strips, here, elsewhere, is_alone, rich, small


def pose_probability(terms: tuple[float, ...]) -> float:
    """Probability that the best hypothesis of a picture is right, by its `confidence_terms`."""
    total = FOUND_BIAS + _weighted(FOUND_WEIGHTS, terms)
    return 1.0 / (1.0 + math.exp(-min(max(total, -50.0), 50.0)))


def _weighted(weights: tuple[float, ...], features: tuple[float, ...]) -> float:
    return sum(weight * feature for weight, feature in zip(weights, features, strict=True))
