"""Evidence of the picture for a pose: how well edges and colours support it.

For every edge point of the CAD a step of the grey level is expected where the edge should be. The share of points with
such a step is compared with the share expected by chance, from the density of steps along the same profiles. For every
line across the outline the colours are expected to change at the outline.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.geometry import Array
from arview.refinement.modalities.edge import EdgeProfiles
from arview.refinement.modalities.region import RegionLines
from arview.rendering import EDGE_CONTOUR, EDGE_SHARP

DECISION_SCORE = 0.58
"""Score that separates right from wrong poses best on the recorded sequences; their quality is 0.5 there."""
SCORE_SLOPE = 16.0
"""Slope of the logistic function from score to quality."""
MIN_IN_PICTURE = 0.05
"""Share of the outline inside the picture below which the quality is 0."""
MIN_REGION_LINES = 8
"""Lines across the outline needed for an evidence of colours."""


@dataclass(frozen=True)
class PoseEvidence:
    """Evidence of the picture for a pose.

    Attributes:
        contour_support: 0–1, share of outline points with a step at the outline, beyond chance.
        inner_support: 0–1, the same for the design edges inside the outline.
        inner_share: 0–1, share of the design edges among the points measured; 0 for a part without any.
        sharpness: 0–1, mean strength of the step on the outline over the strongest step nearby.
        region_support: 0–1, how closely the colours change at the outline, weighted by information; -1 if no line
            across the outline was measured.
        region_information: mean information of a line across the outline, 1/px².
        points_in_picture: 0–1, share of the outline inside the picture.
        scatter_px: mean distance between the outline and the steps that support it; steps that fit by chance scatter.
    """

    contour_support: float
    inner_support: float
    inner_share: float
    sharpness: float
    region_support: float
    region_information: float
    points_in_picture: float
    scatter_px: float = 0.5

    @property
    def score(self) -> float:
        """Weighted sum of the support, 0 to about 1.5; right poses mostly exceed `DECISION_SCORE`.

        Outline and design edges are weighted by the share of design edges, at most half. Colours add to it by their
        information, the more the fewer design edges there are, because they are reliable on soft or blurred outlines.
        """
        outline = 0.6 * self.contour_support + 0.4 * self.sharpness
        share = min(0.5, self.inner_share)
        colours = max(self.region_support, 0.0) * min(self.region_information / 0.2, 1.0)
        return (1.0 - share) * outline + share * self.inner_support + 0.5 * (1.0 - share) * colours

    @property
    def quality(self) -> float:
        """0–1, 0.5 at `DECISION_SCORE`; 0 for a part outside the picture."""
        return self.quality_with(0.0)

    def quality_with(self, more_score: float) -> float:
        """The quality where other evidence adds to the score."""
        if self.points_in_picture <= MIN_IN_PICTURE:
            return 0.0
        return float(1.0 / (1.0 + np.exp(-(self.score + more_score - DECISION_SCORE) * SCORE_SLOPE)))


class EdgeTerms(NamedTuple):
    """The part of a `PoseEvidence` that comes from edges."""

    contour_support: float
    inner_support: float
    inner_share: float
    sharpness: float
    points_in_picture: float
    scatter_px: float


class RegionTerms(NamedTuple):
    """The part of a `PoseEvidence` that comes from colours."""

    region_support: float
    region_information: float


@dataclass(frozen=True)
class EdgeSteps:
    """Edge points of the part at a pose.

    Attributes:
        pixels: (N,2) projections of the points.
        normals: (N,2) unit normals of the edges in the picture.
        support: (N,) support of each point by the picture beyond chance, -1 to 1.
    """

    pixels: Array
    normals: Array
    support: Array


@kernel
def edge_evidence(profiles: EdgeProfiles, kinds: NDArray[np.uint8], reach_px: float, tolerance_px: float) -> EdgeTerms:
    """Evidence of edges, `EdgeTerms`.

    Args:
        profiles: `EdgeProfiles` of the points.
        kinds: (N,) EDGE_* bits of the points.
        reach_px: steps farther from the edge do not count.
        tolerance_px: steps at most this far from the edge support it.
    """
    positions, strengths = profiles.positions, profiles.strengths
    hits = np.zeros(2)
    chances = np.zeros(2)
    counts = np.zeros(2)
    sharp = 0.0
    outline = 0.0
    scatter = 0.0
    for i in range(positions.shape[0]):
        is_contour = (kinds[i] & EDGE_CONTOUR) > 0
        if is_contour:
            outline += 1.0
        elif (kinds[i] & EDGE_SHARP) == 0:
            continue
        if not profiles.visible[i]:
            continue
        steps = 0
        best_near = 0.0
        best_all = 0.0
        distance = 0.0
        for j in range(positions.shape[1]):
            s = abs(strengths[i, j])
            if s == 0.0:
                break
            if abs(positions[i, j]) > reach_px:
                continue
            steps += 1
            best_all = max(best_all, s)
            if abs(positions[i, j]) <= tolerance_px and s > best_near:
                best_near = s
                distance = abs(positions[i, j])
        group = 0 if is_contour else 1
        counts[group] += 1.0
        chances[group] += 1.0 - (1.0 - tolerance_px / reach_px) ** steps
        if best_near > 0.0:
            hits[group] += 1.0
        if is_contour and best_all > 0.0:
            sharp += best_near / best_all
            scatter += distance
    support = np.zeros(2)
    for group in range(2):
        if counts[group] > 0:
            hit = hits[group] / counts[group]
            chance = chances[group] / counts[group]
            support[group] = max(0.0, (hit - chance) / (1.0 - chance + 1e-3))
    inside = counts[0] / outline if outline > 0 else 0.0
    share = counts[1] / max(counts[0] + counts[1], 1.0)
    scatter = scatter / hits[0] if hits[0] > 0 else tolerance_px
    return EdgeTerms(support[0], support[1], share, sharp / max(counts[0], 1.0), inside, scatter)


@kernel
def region_evidence(lines: RegionLines, tolerance_px: float) -> RegionTerms:
    """Evidence of colours, `RegionTerms`, of the lines across the outline, a `RegionLines`."""
    information = lines.information
    total = 0.0
    near = 0.0
    count = 0
    for i in range(information.shape[0]):
        if lines.crossing[i] < 0.0:
            continue
        count += 1
        total += information[i]
        near += information[i] * np.exp(-0.5 * (lines.mean[i] / tolerance_px) ** 2)
    if count < MIN_REGION_LINES:
        return RegionTerms(-1.0, 0.0)
    return RegionTerms(near / total if total > 0 else 0.0, total / count)
