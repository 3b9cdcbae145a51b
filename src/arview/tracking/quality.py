"""How well a pose is borne out by the picture: the evidence that separates right poses from wrong ones.

Every CAD edge point is asked whether a step lies where the edge should be, against how often a step would lie there
by chance (the density of steps along the same profile); every contour line whether the colours change there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from arview.guideviews.mesh_edges import EDGE_CONTOUR, EDGE_SHARP


@dataclass(frozen=True)
class Evidence:
    """Evidence for a pose.

    Attributes:
        contour_support: 0–1, outline points borne out beyond chance.
        inner_support: the same for the design edges inside the outline.
        inner_share: share of the design edges among the points looked at, 0 for organic shapes.
        sharpness: 0–1, how much stronger the steps are on the outline than beside it.
        region_support: 0–1, contour lines whose colours change at the contour, by information; -1 if none says.
        region_information: mean information of a line, 1/px².
        points_in_picture: share of the outline inside the picture.
    """

    contour_support: float
    inner_support: float
    inner_share: float
    sharpness: float
    region_support: float
    region_information: float
    points_in_picture: float

    @property
    def worth(self) -> float:
        """Sum of what speaks for the pose, 0 to about 1.5; right and wrong poses part at about RIGHT_WORTH.

        Outline and, as far as the part has them, design edges count; colours that change along the outline add
        to it, by how sure they are, where design edges are few: on soft or blurred
        outlines they are the better witness.
        """
        outline = 0.6 * self.contour_support + 0.4 * self.sharpness
        share = min(0.5, self.inner_share)
        colours = max(self.region_support, 0.0) * min(self.region_information / 0.2, 1.0)
        return (1.0 - share) * outline + share * self.inner_support + 0.5 * (1.0 - share) * colours

    @property
    def quality(self) -> float:
        """0–1, 0.5 where right and wrong poses part on the recorded sequences."""
        return quality_of(self.worth) if self.points_in_picture > 0.05 else 0.0


RIGHT_WORTH = 0.58
"""Between the worths of right and wrong poses on the recorded sequences."""


def quality_of(worth: float) -> float:
    """Logistic of a worth, 0–1."""
    return float(1.0 / (1.0 + np.exp(-(worth - RIGHT_WORTH) * 16.0)))


def found_features(evidence: Evidence, lines: float) -> tuple[float, ...]:
    """What speaks for a pose that was found without history, for `found_logit`."""
    share = min(0.5, evidence.inner_share)
    colours = max(evidence.region_support, 0.0) * min(evidence.region_information / 0.2, 1.0)
    return (
        (1.0 - share) * evidence.contour_support,
        (1.0 - share) * evidence.sharpness,
        share * evidence.inner_support,
        share,
        (1.0 - share) * colours,
        math.log(lines),
        (1.0 - share) * evidence.contour_support * evidence.sharpness,
        share * evidence.inner_support * evidence.contour_support,
        (1.0 - share) ** 2 * colours * evidence.contour_support,
    )


LOGIT_WEIGHTS = (1.22, 3.23, 3.12, 3.78, 3.08, 0.60, 3.44, 17.17, 0.0)
LOGIT_BIAS = -10.55
"""For comparing hypotheses of one picture: logistic regression with weights that may not be negative, on 1,400
hypotheses of the detector, right and wrong, in semi-synthetic and recorded frames with and without the part."""
FOUND_WEIGHTS = (0.64, 5.72, 5.14, 2.78, 2.63, 1.43, 0.27, 5.68, 0.0)
MARGIN_WEIGHT, LONE_WEIGHT, FOUND_BIAS = 1.82, 7.01, -16.5
"""For the probability: the same on the best hypotheses, with their lead as a further feature, after the quick and
after the wide search of 560 frames and photos, 357 of them without the part (24 semi-synthetic scenes of six shapes,
five recordings whose right poses count eightfold, being fewer). 1.4 is taken from the bias, for false alarms cost more
than a frame without a pose: of those 357 one keeps a wrong pose above 0.5, of 198 others three; of the right poses
84 % on semi-synthetic frames, all but one in seven on one recording."""
LARGEST_MARGIN = 4.0
"""A larger lead says no more."""


def found_logit(evidence: Evidence, lines: float) -> float:
    """By how much one of many hypotheses of a picture is likelier than another; ``lines`` as of `view_lines`."""
    return LOGIT_BIAS + _weighted(LOGIT_WEIGHTS, found_features(evidence, lines))


def found_probability(evidence: Evidence, lines: float, margin: float) -> float:
    """Probability 0–1 that the best hypothesis of a picture is right.

    Args:
        evidence, lines: of the hypothesis, see `found_logit`.
        margin: lead of its logit over the best hypothesis for another pose, infinite without one. The right pose
            stands out; of many that fit by chance one is hardly better than the next.
    """
    lead = LONE_WEIGHT if math.isinf(margin) else MARGIN_WEIGHT * min(margin, LARGEST_MARGIN)
    total = FOUND_BIAS + _weighted(FOUND_WEIGHTS, found_features(evidence, lines)) + lead
    return 1.0 / (1.0 + math.exp(-min(max(total, -50.0), 50.0)))


def _weighted(weights: tuple[float, ...], features: tuple[float, ...]) -> float:
    return sum(weight * feature for weight, feature in zip(weights, features, strict=True))


@njit(cache=True, nogil=True)
def edge_evidence(positions, strengths, seen, kinds, reach_px, tolerance_px):  # type: ignore[no-untyped-def]
    """contour_support, inner_support, inner_share, sharpness and points_in_picture, see Evidence."""
    hits = np.zeros(2)
    chances = np.zeros(2)
    counts = np.zeros(2)
    sharp = 0.0
    outline = 0.0
    for i in range(positions.shape[0]):
        is_contour = (kinds[i] & EDGE_CONTOUR) > 0
        if is_contour:
            outline += 1.0
        elif (kinds[i] & EDGE_SHARP) == 0:
            continue
        if not seen[i]:
            continue
        steps = 0
        best_near = 0.0
        best_all = 0.0
        for j in range(positions.shape[1]):
            s = abs(strengths[i, j])
            if s == 0.0:
                break
            if abs(positions[i, j]) > reach_px:
                continue
            steps += 1
            best_all = max(best_all, s)
            if abs(positions[i, j]) <= tolerance_px:
                best_near = max(best_near, s)
        group = 0 if is_contour else 1
        counts[group] += 1.0
        chances[group] += 1.0 - (1.0 - tolerance_px / reach_px) ** steps
        if best_near > 0.0:
            hits[group] += 1.0
        if is_contour and best_all > 0.0:
            sharp += best_near / best_all
    support = np.zeros(2)
    for group in range(2):
        if counts[group] > 0:
            hit = hits[group] / counts[group]
            chance = chances[group] / counts[group]
            support[group] = max(0.0, (hit - chance) / (1.0 - chance + 1e-3))
    inside = counts[0] / outline if outline > 0 else 0.0
    share = counts[1] / max(counts[0] + counts[1], 1.0)
    return support[0], support[1], share, sharp / max(counts[0], 1.0), inside


@njit(cache=True, nogil=True)
def region_evidence(mean, information, agreement, tolerance_px):  # type: ignore[no-untyped-def]
    """Support by information and mean information of the lines looked at; support -1 when there are none."""
    total = 0.0
    near = 0.0
    lines = 0
    for i in range(mean.shape[0]):
        if agreement[i] < 0.0:
            continue
        lines += 1
        total += information[i]
        near += information[i] * np.exp(-0.5 * (mean[i] / tolerance_px) ** 2)
    if lines < 8:
        return -1.0, 0.0
    return (near / total if total > 0 else 0.0), total / lines
