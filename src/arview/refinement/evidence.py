"""How well a pose is borne out by the picture: the evidence that separates right poses from wrong ones.

Every CAD edge point is asked whether a step lies where the edge should be, against how often a step would lie there
by chance (the density of steps along the same profile); every contour line whether the colours change there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from arview.core.kernel import kernel
from arview.geometry import Array
from arview.guideviews.mesh_edges import EDGE_CONTOUR, EDGE_SHARP


@dataclass(frozen=True)
class PoseEvidence:
    """Evidence for a pose.

    Attributes:
        contour_support: 0–1, outline points borne out beyond chance.
        inner_support: the same for the design edges inside the outline.
        inner_share: share of the design edges among the points looked at, 0 for organic shapes.
        sharpness: 0–1, how much stronger the steps are on the outline than beside it.
        region_support: 0–1, contour lines whose colours change at the contour, by information; -1 if none says.
        region_information: mean information of a line, 1/px².
        points_in_picture: share of the outline inside the picture.
        scatter_px: mean distance of the steps that bear the outline out from it; chance puts them anywhere.
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
        """Sum of what speaks for the pose, 0 to about 1.5; right and wrong poses part at about DECISION_SCORE.

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
        return quality_of(self.score) if self.points_in_picture > 0.05 else 0.0


DECISION_SCORE = 0.58
"""Between the scores of right and wrong poses on the recorded sequences."""


def quality_of(score: float) -> float:
    """Logistic of a score, 0–1."""
    return float(1.0 / (1.0 + np.exp(-(score - DECISION_SCORE) * 16.0)))


@dataclass(frozen=True)
class EdgeSteps:
    """Edges of the part at a pose: ``pixels`` (N,2), ``normals`` (N,2), and their ``support`` (N,) beyond chance."""

    pixels: Array
    normals: Array
    support: Array


@kernel
def edge_evidence(positions, strengths, seen, kinds, reach_px, tolerance_px):  # type: ignore[no-untyped-def]
    """contour_support, inner_support, inner_share, sharpness, points_in_picture and scatter_px, see PoseEvidence."""
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
        if not seen[i]:
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
    return support[0], support[1], share, sharp / max(counts[0], 1.0), inside, scatter


@kernel
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
