"""Errors of an estimated pose against the true one, in the measures that papers and users ask for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from arview.cad.model import Model
from arview.cad.shape.symmetry import Symmetry
from arview.camera import Camera
from arview.geometry import Array, apply, exp_so3, rigid, rotation_angle_rad, skew

ADD_VERTICES = 2000
"""Vertices over which ADD is averaged."""
_MAX_EQUIVALENTS = 128
"""Largest rotation group; a larger one (an icosahedron has 60) is a mistake in the declaration."""


class ViewFeaturesSource(Protocol):
    """What `PoseMeter` needs of a GuideViewSet."""

    def nearest(self, cam_from_model: Array) -> object:
        """The guide view nearest to a pose, with ``features.edge_points`` and ``features.contour_points``."""


@dataclass(frozen=True)
class PoseError:
    """Errors of an estimated pose against a true one.

    Attributes:
        translation_mm: distance between the two positions of the centre of the model's bounding box. (The centre and
            not the origin, because with an origin far from the part a rotation would count as translation.)
        across_mm: its component across the line of sight to the true centre.
        depth_mm: its component along the line of sight, positive when the estimate is too far away.
        rotation_deg: angle between the two orientations, 0–180.
        add_mm: mean distance between the vertices at the two poses (ADD; Hinterstoisser et al. 2012).
        contour_px: mean distance in the picture between the model's edges at the two poses; None when
            no edge can be projected.
        contour_median_px: median of the same.
    """

    translation_mm: float
    across_mm: float
    depth_mm: float
    rotation_deg: float
    add_mm: float
    contour_px: float | None
    contour_median_px: float | None

    def within(self, translation_mm: float, rotation_deg: float) -> bool:
        """True when both errors are at most the given ones."""
        return self.translation_mm <= translation_mm and self.rotation_deg <= rotation_deg


class PoseMeter:
    """Measures the errors of poses of one model in pictures of one camera.

    Args:
        model: the part.
        camera: of the pictures.
        views: guide views of the model, whose edge points are projected; None leaves contour_px out.
        symmetries: rotations of the part that change nothing; of the equivalent true poses the nearest counts.
        symmetric_poses: (S,4,4) further ``model_from_model`` that change nothing (BOP's discrete ones).
    """

    def __init__(
        self,
        model: Model,
        camera: Camera,
        views: ViewFeaturesSource | None = None,
        symmetries: tuple[Symmetry, ...] = (),
        symmetric_poses: tuple[Array, ...] = (),
    ) -> None:
        self._camera, self._views = camera, views
        self._center = model.center_in_model
        vertices = model.mesh[0]
        step = max(1, -(-len(vertices) // ADD_VERTICES))
        self._vertices = vertices[::step]
        self._turns = symmetry_group(symmetries, symmetric_poses)
        self._free = [symmetry for symmetry in symmetries if symmetry.order is None]

    def measure(self, estimate: Array, truth: Array) -> PoseError:
        """Errors of an estimated against the true ``cam_from_model``, both (4,4)."""
        truth = self.nearest_equivalent(estimate, truth)
        center = apply(truth, self._center)
        shift = apply(estimate, self._center) - center
        depth = float(shift @ center / np.linalg.norm(center))
        distance = float(np.linalg.norm(shift))
        add = np.linalg.norm(apply(estimate, self._vertices) - apply(truth, self._vertices), axis=1).mean()
        contour = self._contour_px(estimate, truth)
        return PoseError(
            translation_mm=distance,
            across_mm=float(np.sqrt(max(0.0, distance**2 - depth**2))),
            depth_mm=depth,
            rotation_deg=float(np.rad2deg(rotation_angle_rad(truth, estimate))),
            add_mm=float(add),
            contour_px=float(contour.mean()) if contour.size else None,
            contour_median_px=float(np.median(contour)) if contour.size else None,
        )

    def nearest_equivalent(self, estimate: Array, truth: Array) -> Array:
        """Of the poses (4,4) equivalent to the true one, the one least rotated against the estimate."""
        candidates = [truth @ turn for turn in self._turns]
        candidates += [pose @ free_turn(symmetry, pose, estimate) for pose in candidates for symmetry in self._free]
        return min(candidates, key=lambda pose: rotation_angle_rad(pose, estimate))

    def _contour_px(self, estimate: Array, truth: Array) -> Array:
        """Distances in px of the edge points at the two poses."""
        if self._views is None:
            return np.zeros(0)
        features = self._views.nearest(truth).features  # type: ignore[attr-defined]
        points = features.edge_points if len(features.edge_points) else features.contour_points
        there = self._camera.project(apply(truth, points))
        here = self._camera.project(apply(estimate, points))
        distances = np.linalg.norm(here - there, axis=-1)
        return np.asarray(distances[np.isfinite(distances)])


def about(symmetry: Symmetry, angle_rad: float) -> Array:
    """(4,4) ``model_from_model``: the rotation about a symmetry's axis by an angle."""
    rotation = exp_so3(np.array(symmetry.axis_in_model) * angle_rad)
    through = np.array(symmetry.through_in_model)
    return rigid(rotation, through - rotation @ through)


def free_turn(symmetry: Symmetry, truth: Array, estimate: Array) -> Array:
    """The rotation (4,4) about a continuous symmetry's axis that brings the true orientation nearest to the estimate.

    The trace of ``truthᵀ · estimate · turn(-angle)`` is a + b cos(angle) + c sin(angle), whose maximum has a closed
    form.
    """
    axis = np.array(symmetry.axis_in_model)
    relative = truth[:3, :3].T @ estimate[:3, :3]
    along = float(axis @ relative @ axis)
    cosine = float(np.trace(relative)) - along
    sine = float(np.trace(relative.T @ skew(axis)))
    return about(symmetry, float(np.arctan2(sine, cosine)))


def symmetry_group(symmetries: tuple[Symmetry, ...], symmetric_poses: tuple[Array, ...] = ()) -> list[Array]:
    """The rotation group (4,4) ``model_from_model`` that the declared symmetries generate, identity first."""
    generators = [about(s, 2.0 * np.pi / s.order) for s in symmetries if s.order is not None]
    generators += [np.asarray(pose, dtype=np.float64) for pose in symmetric_poses]
    group = [np.eye(4)]
    for known in group:  # grows during the iteration
        for generator in generators:
            turn = known @ generator
            is_new = all(rotation_angle_rad(turn, other) > 1e-3 for other in group)
            if is_new and len(group) < _MAX_EQUIVALENTS:
                group.append(turn)
    return group
