"""How well photos determine the place of each component: information of bearings, and the U to be expected.

A photo measures the direction to a component with an error of a share of a pixel. Its information on the component's
place is the projector across the ray, divided by the squared error at the component's distance. The information of
independent photos adds up (the normal equations of a triangulated point), and its inverse is the covariance of the
place. A photo counts in full only where two others show the component from nearby: patches are compared in at least
three photos, and look different from far apart.

Views are chosen one after another, each so that the sum over the components of the expected error of the place,
relative to the tolerance, falls most. That is A-optimality of the experiment's design (Pukelsheim 2006), used for the
next best view by Wenhardt et al. (2007); the greedy choice is that of Roberts et al. (2017). The U that is stated is
along the worst axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.geometry import Array

_NO_COSINE = -2.0
"""Stands for the cosine to a photo that is not there."""


BEARING_PX = 0.12
"""Standard deviation of a component's direction in one photo: edges, patches and pose."""
COMMON_MM = 0.02
"""Standard deviation that more photos do not lower: datums, methods that differ, form."""
PRIOR_MM = 5.0
"""Standard deviation of a place before any photo."""
COVERAGE_FACTOR = 2.0
"""K of the expanded uncertainty."""
MATCHED_DEG = 30.0
"""Angle to the second nearest photo up to which a photo counts in full …."""
MATCH_FALL_DEG = 25.0
"""… and by how much more its weight falls to a third."""
ALONE_WEIGHT = 0.1
"""Of a photo that no two others can be matched with: its edges still count."""


@dataclass(frozen=True)
class Views:
    """Photos, taken or possible, and what each tells of each component.

    Attributes:
        information: (V,C,3,3) on the places of the components, 1/mm²; zero for those that it does not show.
        rays: (V,C,3) unit vectors from the components to the camera.
        is_seen: (V,C) which components it shows.
    """

    information: Array
    rays: Array
    is_seen: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.information)

    def __getitem__(self, index: Sequence[int] | NDArray[np.int64] | slice) -> Views:
        """Some of the views."""
        return Views(self.information[index], self.rays[index], self.is_seen[index])

    @staticmethod
    def of(
        points: Array,
        is_seen: NDArray[np.bool_],
        centers: Array,
        focal_px: float,
    ) -> Views:
        """The views of cameras at some places.

        Args:
            points: (C,3) of the components, mm.
            is_seen: (V,C) which of them each photo shows.
            centers: (V,3) of the cameras, mm.
            focal_px: their focal length.
        """
        away = np.reshape(centers, (-1, 1, 3)) - points
        square = np.maximum(np.sum(away**2, axis=2), 1e-9)
        rays = away / np.sqrt(square)[..., None]
        across = np.eye(3) - rays[..., :, None] * rays[..., None, :]
        weight = is_seen * (focal_px / BEARING_PX) ** 2 / square
        return Views(across * weight[..., None, None], rays, np.asarray(is_seen, dtype=bool))


class KnownViews:
    """The photos taken, as information on the places of the components.

    Attributes:
        views: the photos.
    """

    def __init__(self, views: Views) -> None:
        """Begin with some photos; there may be none of them."""
        self.views = views[:0]
        count = views.is_seen.shape[1]
        # Cosines to the nearest and second nearest other photo that shows the component.
        self._nearest: Array = np.full((0, count, 2), _NO_COSINE)
        for index in range(len(views)):
            self.add(views[index : index + 1])

    def add(self, view: Views) -> None:
        """Count one more photo."""
        cosines = self._cosines(view)[0]
        own = np.sort(np.concatenate([np.full((2, cosines.shape[1]), _NO_COSINE), cosines]), axis=0)[-2:][::-1]
        self._nearest = np.concatenate([self._nearer(cosines[None])[0], own.T[None]])
        old = self.views
        self.views = Views(
            np.concatenate([old.information, view.information]),
            np.concatenate([old.rays, view.rays]),
            np.concatenate([old.is_seen, view.is_seen]),
        )

    def information(self) -> Array:
        """(C,3,3) of all photos together and of what is known before."""
        weights = self._weights(self._nearest[..., 1])
        return np.asarray(self._prior() + np.einsum("nc,ncij->cij", weights, self.views.information))

    def with_each(self, views: Views) -> Array:
        """(V,C,3,3) information with each one of some views added."""
        cosines = self._cosines(views)
        nearer = self._nearer(cosines)[..., 1]
        own = np.full((len(views), views.is_seen.shape[1]), _NO_COSINE)
        if len(self.views) >= 2:
            own = np.partition(cosines, -2, axis=1)[:, -2]
        known = np.einsum("vnc,ncij->vcij", self._weights(nearer), self.views.information, optimize=True)
        return np.asarray(self._prior() + known + self._weights(own)[..., None, None] * views.information)

    def _cosines(self, views: Views) -> Array:
        """(V,N,C) cosines between views and photos at each component that both show."""
        both = views.is_seen[:, None] & self.views.is_seen[None]
        return np.where(both, np.einsum("vci,nci->vnc", views.rays, self.views.rays), _NO_COSINE)

    def _nearer(self, cosines: Array) -> Array:
        """(V,N,C,2) nearest and second nearest with each one of some views (V,N,C) added."""
        first, second = self._nearest[..., 0], self._nearest[..., 1]
        return np.stack([np.maximum(first, cosines), np.maximum(np.minimum(first, cosines), second)], axis=-1)

    def _weights(self, cosines: Array) -> Array:
        """Weights of photos by the cosines to their second nearest one."""
        angle_deg = np.rad2deg(np.arccos(np.clip(cosines, -1.0, 1.0)))
        beyond = np.maximum(angle_deg - MATCHED_DEG, 0.0) / MATCH_FALL_DEG
        near = np.where(cosines > _NO_COSINE, np.exp(-(beyond**2)), 0.0)
        return ALONE_WEIGHT + (1.0 - ALONE_WEIGHT) * near

    def _prior(self) -> Array:
        return prior_information(self.views.is_seen.shape[1])


def prior_information(count: int) -> Array:
    """(C,3,3) information on the places of components before any photo."""
    return np.tile(np.eye(3) / PRIOR_MM**2, (count, 1, 1))


def expanded_uncertainty(information: Array) -> Array:
    """(...,) expanded uncertainty along the worst axis, mm, of information (...,3,3)."""
    worst = np.maximum(np.linalg.eigvalsh(information)[..., 0], 1e-12)
    return np.asarray(COVERAGE_FACTOR * np.sqrt(1.0 / worst + COMMON_MM**2))


def expected_error(information: Array) -> Array:
    """(...,) root mean square length of the error of a place times the coverage factor, mm."""
    values = np.maximum(np.linalg.eigvalsh(information), 1e-12)
    return np.asarray(COVERAGE_FACTOR * np.sqrt(np.sum(1.0 / values + COMMON_MM**2, axis=-1)))


def gains(known: KnownViews, views: Views, weights: Array) -> Array:
    """(V,) by how much each of some views lowers the weighted sum of expected errors of components.

    Args:
        known: the photos taken.
        views: the views.
        weights: (C,) of the components, 1/mm: one over the tolerance.
    """
    before = expected_error(known.information()) @ weights
    return np.asarray(before - expected_error(known.with_each(views)) @ weights)


def choose_views(
    taken: Views,
    views: Views,
    weights: Array,
    directions: Array,
    taken_directions: Sequence[Array],
    count: int,
    max_step_deg: float,
) -> list[int]:
    """Indices of views to take, the next one first: each lowers the weighted sum of errors most after those before it.

    A view farther than ``max_step_deg`` from every photo cannot be matched to one. Where none is nearer, the nearest
    view is taken.

    Args:
        taken: the photos taken.
        views: the views to choose from.
        weights: (C,) of the components.
        directions: (V,3) unit vectors from the part to the views.
        taken_directions: unit vectors (3,) to the photos taken.
        count: largest number of views.
        max_step_deg: see above.
    """
    known = KnownViews(taken)
    left = np.ones(len(views), dtype=bool)
    nearest = np.full(len(views), -1.0)
    if len(taken_directions):
        nearest = (directions @ np.array(taken_directions).T).max(axis=1)
    chosen: list[int] = []
    while left.any() and len(chosen) < count:
        is_first = len(known.views) == 0
        in_reach = left & (is_first | (nearest >= np.cos(np.deg2rad(max_step_deg))))
        if in_reach.any():
            some = np.flatnonzero(in_reach)
            best = int(some[np.argmax(gains(known, views[some], weights))])
        else:
            best = int(np.argmax(np.where(left, nearest, -np.inf)))
        chosen.append(best)
        left[best] = False
        known.add(views[best : best + 1])
        nearest = np.maximum(nearest, directions @ directions[best])
    return chosen


def focal_px(camera: Camera) -> float:
    """Mean focal length of a camera."""
    return 0.5 * (camera.fx + camera.fy)
