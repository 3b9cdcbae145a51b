"""How well photos determine the place of each component: information of bearings, and the U to be expected.

A photo measures the direction to a component with an error of a share of a pixel. Its information on the component's
place is the projector across the ray, divided by the squared error at the component's distance. The information of
independent photos adds up (the normal equations of a triangulated point), and its inverse is the covariance of the
place. Views are chosen one after another, each so that the sum over the components of the place's expected error,
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


@dataclass(frozen=True)
class InformationOptions:
    """Errors of one photo and of all photos together."""

    bearing_px: float = 0.24  # standard deviation of a component's direction in one photo: edges, patches and pose
    common_mm: float = 0.006  # standard deviation that more photos do not lower: form, lens, datums
    prior_mm: float = 5.0  # standard deviation of a place before any photo
    coverage_factor: float = 2.0  # k of the expanded uncertainty


def view_information(
    points: Array, is_seen: NDArray[np.bool_], center: Array, focal_px: float, options: InformationOptions | None = None
) -> Array:
    """(C,3,3) information of one photo on the places (C,3) of components, 1/mm²; zero for those that it does not show.

    Args:
        points: of the components, mm.
        is_seen: (C,) which of them the photo shows.
        center: (3,) of the camera, mm.
        focal_px: its focal length.
        options: see `InformationOptions`.
    """
    options = options or InformationOptions()
    rays = points - center
    square = np.maximum(np.sum(rays**2, axis=1), 1e-9)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :] / square[:, None, None]
    weight = is_seen * (focal_px / options.bearing_px) ** 2 / square
    return np.asarray(across * weight[:, None, None])


def prior_information(count: int, options: InformationOptions | None = None) -> Array:
    """(C,3,3) information on the places of components before any photo."""
    options = options or InformationOptions()
    return np.tile(np.eye(3) / options.prior_mm**2, (count, 1, 1))


def expanded_uncertainty(information: Array, options: InformationOptions | None = None) -> Array:
    """(...,) expanded uncertainty along the worst axis, mm, of information (...,3,3)."""
    options = options or InformationOptions()
    worst = np.maximum(np.linalg.eigvalsh(information)[..., 0], 1e-12)
    return np.asarray(options.coverage_factor * np.sqrt(1.0 / worst + options.common_mm**2))


def expected_error(information: Array, options: InformationOptions | None = None) -> Array:
    """(...,) root mean square length of the error of a place times the coverage factor, mm."""
    options = options or InformationOptions()
    values = np.maximum(np.linalg.eigvalsh(information), 1e-12)
    return np.asarray(options.coverage_factor * np.sqrt(np.sum(1.0 / values + options.common_mm**2, axis=-1)))


def gains(known: Array, views: Array, weights: Array, options: InformationOptions | None = None) -> Array:
    """(V,) by how much each of some views (V,C,3,3) lowers the weighted sum of expected errors of components.

    Args:
        known: (C,3,3) information of the photos taken.
        views: information of each view.
        weights: (C,) of the components, 1/mm: one over the tolerance.
        options: see `InformationOptions`.
    """
    before = expected_error(known, options) @ weights
    return np.asarray(before - expected_error(known + views, options) @ weights)


def choose_views(
    known: Array,
    views: Array,
    weights: Array,
    directions: Array,
    taken: Sequence[Array],
    count: int,
    max_step_deg: float,
    options: InformationOptions | None = None,
) -> list[int]:
    """Indices of views to take, the next one first: each lowers the weighted sum of errors most after those before it.

    A view farther than ``max_step_deg`` from every photo cannot be matched to one. Where none is nearer, the nearest
    view is taken.

    Args:
        known: (C,3,3) information of the photos taken.
        views: (V,C,3,3) information of the views.
        weights: (C,) of the components.
        directions: (V,3) unit vectors from the part to the views.
        taken: unit vectors (3,) to the photos taken.
        count: largest number of views.
        max_step_deg: see above.
        options: see `InformationOptions`.
    """
    left = np.ones(len(views), dtype=bool)
    nearest = np.full(len(views), -1.0) if len(taken) == 0 else (directions @ np.array(taken).T).max(axis=1)
    is_first = len(taken) == 0
    chosen: list[int] = []
    while left.any() and len(chosen) < count:
        value = gains(known, views, weights, options)
        in_reach = left & (nearest >= np.cos(np.deg2rad(max_step_deg)))
        if is_first:
            best = int(np.argmax(np.where(left, value, -np.inf)))
        elif in_reach.any():
            best = int(np.argmax(np.where(in_reach, value, -np.inf)))
        else:
            best = int(np.argmax(np.where(left, nearest, -np.inf)))
        is_first = False
        chosen.append(best)
        left[best] = False
        known = known + views[best]
        nearest = np.maximum(nearest, directions @ directions[best])
    return chosen


def focal_px(camera: Camera) -> float:
    """Mean focal length of a camera."""
    return 0.5 * (camera.fx + camera.fy)
