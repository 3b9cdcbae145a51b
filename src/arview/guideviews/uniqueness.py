"""Is a part distinctive? Measures of its guide views.

*Distinct lines* of a view: the points of outline and design edges vote for the straight line that they lie on; the
perplexity (exponential of the entropy) of the votes is the number of lines that matter. A plain block has about nine,
as has any other box in a workshop. *Confusability* of a view: its likeness to the most similar view from another side,
at the roll that maximises it; a part that looks the same from two sides has an ambiguous pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.geometry import Array
from arview.guideviews.sphere import assessed_directions
from arview.guideviews.views import GuideView, GuideViewSet
from arview.rendering import EDGE_CONTOUR, EDGE_SHARP

PLAIN_LINES = 12.0
"""Number of distinct lines below which a view is plain, as those of boxes, plates and cylinders are."""
MAX_WEAK_SHARE = 0.6
"""Largest share of plain or of confusable views of a sufficient set; many parts are plain from below."""
CONFUSABLE_LIKENESS = 0.94
"""Likeness from which two views cannot be distinguished in a picture with noise."""
SAME_DIRECTION_COSINE = 1.0 - 1e-9
"""Cosine of the angle between two directions from which they are the same."""
APART_DEG = 30.0
"""Angle between two views below which their likeness does not count."""
_RADII, _ANGLES, _ORIENTATIONS = 6, 36, 6


@dataclass(frozen=True)
class Uniqueness:
    """Assessment of a set.

    Attributes:
        distinct_lines: (N,) of each view.
        likeness: (N,) 0–1, to the most similar view from another side; NaN where no view is far enough away.
        confused_with: (N,) index of that view; -1 where there is none.
        assessed: indices of the views by which the set was assessed; all others have the values of the nearest of them.
        is_sufficient: the part can be detected without being confused with something else.
        reason: one sentence.
    """

    distinct_lines: Array
    likeness: Array
    confused_with: NDArray[np.int64]
    assessed: NDArray[np.int64]
    is_sufficient: bool
    reason: str

    @property
    def score(self) -> float:
        """Share of views that are neither plain nor confusable, 0–1."""
        fine = (self.distinct_lines >= PLAIN_LINES) & ~(self.likeness >= CONFUSABLE_LIKENESS)
        return float(np.mean(fine[self.assessed]))


def view_lines(view: GuideView, diameter_mm: float) -> float:
    """Number of distinct lines of a view."""
    pixels, normals = _edge_picture(view, diameter_mm)
    if len(pixels) == 0:
        return 0.0
    angle = np.arctan2(normals[:, 1], normals[:, 0]) % np.pi
    offset = pixels[:, 0] * np.cos(angle) + pixels[:, 1] * np.sin(angle)
    cell = np.stack([np.floor(angle / np.pi * 18), np.floor((offset + 1.0) * 12)], axis=1).astype(np.int64)
    _, votes = np.unique(cell[:, 0] * 64 + cell[:, 1], return_counts=True)
    share = votes / votes.sum()
    return float(np.exp(-np.sum(share * np.log(share))))


def assess(views: GuideViewSet) -> Uniqueness:
    """Assess a set by its views in the `assessed_directions` of the range; others get the values of the nearest.

    A set without these directions is assessed by all of its views.
    """
    index = _assessed_views(views)
    some_views = [views.view(int(i)) for i in index]
    lines = np.array([view_lines(view, views.diameter_mm) for view in some_views])
    likeness, partner = _likeness(
        np.stack([_descriptor(v, views.diameter_mm) for v in some_views]), views.directions[index]
    )
    nearest = np.argmax(views.directions @ views.directions[index].T, axis=1)
    confused = np.where(partner[nearest] >= 0, index[np.maximum(partner[nearest], 0)], -1)
    plain_share = float(np.mean(lines < PLAIN_LINES))
    confusable = float(np.mean(likeness >= CONFUSABLE_LIKENESS))
    if plain_share > MAX_WEAK_SHARE:
        reason = (
            f"insufficient: {plain_share:.0%} of the views show fewer than {PLAIN_LINES:.0f} distinct lines "
            f"(median {np.median(lines):.0f}), as any plain block or plate does; add components around it to the part"
        )
    elif confusable > MAX_WEAK_SHARE:
        reason = (
            f"insufficient: {confusable:.0%} of the views look like a view from another side; "
            "declare the symmetry or narrow the range of viewpoints"
        )
    else:
        reason = (
            f"sufficient: median of {np.median(lines):.0f} distinct lines a view; "
            f"{plain_share:.0%} of the views plain, {confusable:.0%} confusable"
        )
    return Uniqueness(
        distinct_lines=lines[nearest],
        likeness=likeness[nearest],
        confused_with=confused,
        assessed=index,
        is_sufficient=plain_share <= MAX_WEAK_SHARE and confusable <= MAX_WEAK_SHARE,
        reason=reason,
    )


def likeness_between(views: GuideViewSet, others: GuideViewSet) -> tuple[Array, NDArray[np.int64]]:
    """Largest likeness (N,) of each view to a view of another part, at any roll and size, and the index of that one."""
    spectra, other_spectra = (
        np.moveaxis(np.fft.rfft(np.stack([_descriptor(view, one.diameter_mm) for view in one]), axis=1), 1, 0)
        for one in (views, others)
    )
    conjugates = other_spectra.conj().transpose(0, 2, 1)
    likeness = np.fft.irfft(spectra @ conjugates, n=_ANGLES, axis=0).max(axis=0)
    return likeness.max(axis=1), likeness.argmax(axis=1).astype(np.int64)


def _assessed_views(views: GuideViewSet) -> NDArray[np.int64]:
    """Indices of the views by which a set is assessed."""
    cosine = assessed_directions(views.view_range) @ views.directions.T
    index = np.argmax(cosine, axis=1)
    if np.all(cosine[np.arange(len(index)), index] > SAME_DIRECTION_COSINE):
        return index.astype(np.int64)
    return np.arange(len(views), dtype=np.int64)


def _edge_picture(view: GuideView, diameter_mm: float) -> tuple[Array, Array]:
    """Positions (N,2) of outline and design edge points, in half diameters, and their normals (N,2) in the picture."""
    f = view.features
    pose = view.cam_from_model
    kept = (f.edge_kinds & (EDGE_CONTOUR | EDGE_SHARP)) > 0
    points = f.edge_points[kept] @ pose[:3, :3].T + pose[:3, 3]
    tangents = f.edge_tangents[kept] @ pose[:3, :3].T
    distance = float(np.linalg.norm(pose[:3, 3])) if len(points) == 0 else float(np.median(points[:, 2]))
    pixels = points[:, :2] / points[:, 2:] * distance / (0.5 * diameter_mm)
    across = tangents[:, :2] - points[:, :2] / points[:, 2:] * tangents[:, 2:]
    length = np.linalg.norm(across, axis=1)
    usable = length > 0.05
    across = across[usable] / length[usable, None]
    return pixels[usable], np.stack([-across[:, 1], across[:, 0]], axis=1)


def _descriptor(view: GuideView, diameter_mm: float) -> Array:
    """(angles, radii · orientations) normalised histogram of edges on a polar grid, oriented by the radius."""
    pixels, normals = _edge_picture(view, diameter_mm)
    histogram = np.zeros((_ANGLES, _RADII, _ORIENTATIONS))
    if len(pixels):
        pixels = pixels - pixels.mean(axis=0)
        angle = np.arctan2(pixels[:, 1], pixels[:, 0])
        radius = np.clip(np.linalg.norm(pixels, axis=1) * _RADII, 0, _RADII - 1e-6).astype(np.intp)
        turn = (np.arctan2(normals[:, 1], normals[:, 0]) - angle) % np.pi
        orientation = np.floor(turn / np.pi * _ORIENTATIONS + 0.5).astype(np.intp) % _ORIENTATIONS
        place = (angle / (2 * np.pi) * _ANGLES) % _ANGLES
        low = np.floor(place).astype(np.intp)
        share = place - low
        np.add.at(histogram, (low % _ANGLES, radius, orientation), 1.0 - share)
        np.add.at(histogram, ((low + 1) % _ANGLES, radius, orientation), share)
        histogram = histogram + 0.5 * (np.roll(histogram, 1, 0) + np.roll(histogram, -1, 0))
    flat = histogram.reshape(_ANGLES, -1)
    flat = flat - flat.mean()
    return flat / max(float(np.linalg.norm(flat)), 1e-12)


def _likeness(descriptors: Array, directions: Array) -> tuple[Array, NDArray[np.int64]]:
    """Largest correlation (N,), over all rolls, with a view more than APART_DEG away, and its index, -1 without any."""
    spectra = np.moveaxis(np.fft.rfft(descriptors, axis=1), 1, 0)
    conjugates = spectra.conj().transpose(0, 2, 1)
    count = len(descriptors)
    best = np.full(count, np.nan)
    partner = np.full(count, -1, dtype=np.int64)
    far = directions @ directions.T < np.cos(np.deg2rad(APART_DEG))
    for first in range(0, count, 64):
        rows = np.arange(first, min(first + 64, count))
        correlation = np.fft.irfft(spectra[:, rows] @ conjugates, n=_ANGLES, axis=0).max(axis=0)
        correlation[~far[rows]] = -np.inf
        nearest = np.argmax(correlation, axis=1)
        has_any = far[rows].any(axis=1)
        partner[rows[has_any]] = nearest[has_any]
        best[rows[has_any]] = correlation[np.arange(len(rows)), nearest][has_any]
    return best, partner
