"""What both methods of measuring a component in photos share: its geometry, its free directions and the result."""

from __future__ import annotations

import copy

import numpy as np

from arview.cad import Model, Part, sample_surface
from arview.geometry import Array, apply, exp_so3, log_so3, rigid
from arview.measurement.photo.fit import RigidFit
from arview.measurement.photo.options import JOINT_MM
from arview.measurement.photo.patches import free_directions, near_others, turning_center
from arview.measurement.photo.views import PhotoViews
from arview.measurement.types import Method, Move

HEIGHTS_MM, HEIGHT_SHARE = (8.0, 5.6, 4.0, 2.8, 2.0, 1.4, 1.0, 0.7, 0.5), 0.1
"""Heights above other components that are tried, and share of the surface that must be higher."""
NEAR_JOINT_MM = 1.0
"""As `JOINT_MM`, where the edges farther away do not determine all directions: many joints are bolted, clipped or
riveted, not welded."""
HEIGHT_SAMPLES = 600
"""Samples of a component by which its height is found."""


class MeasuredComponent:
    """A component of the model, as it is measured in the photos.

    A *place* is the (4,4) matrix ``measured_from_nominal`` in the model frame.

    Attributes:
        views, index: as given.
        shape: the component's mesh.
        center: (3,) its centre of mass, mm; on the declared axis of what is round.
        corners: (8,3) corners of its bounding box, mm.
        radius_mm: half the diagonal of the bounding box.
        px_mm: size of a pixel at the component.
        free: (K,6) motions that leave its shape unchanged, see `free_directions`.
        joint_mm: see `joint_mm`.
        uses_joints: whether edges at joints with other components are used, too.
    """

    def __init__(self, views: PhotoViews, index: int, part: Part | None) -> None:
        self.views, self.index = views, index
        self.shape = views.model.components[index]
        low, high = self.shape.bounds_in_model
        self.center = turning_center(self.shape, part)
        self.corners = low + np.array(list(np.ndindex(2, 2, 2))) * (high - low)
        self.radius_mm = 0.5 * float(np.linalg.norm(np.ptp(self.shape.bounds_in_model, axis=0)))
        self.px_mm = views.mm_per_px(self.center)
        self.free = free_directions(self.shape, part, self.center, self.radius_mm)
        self.joint_mm = joint_mm(views.model, index)
        self.uses_joints = False

    def with_joints(self) -> MeasuredComponent:
        """The same component, measured by edges at its joints as well."""
        other = copy.copy(self)
        other.joint_mm, other.uses_joints = min(self.joint_mm, NEAR_JOINT_MM), True
        return other

    def moved(self, place: Array, twist: Array) -> Array:
        """The place after a further twist (6,) about the point to which the place takes the centre."""
        rotation, center = exp_so3(twist[:3]), apply(place, self.center)
        return rigid(rotation, center - rotation @ center + twist[3:]) @ place

    def size_mm(self, twist: Array) -> float:
        """Largest element of a twist in mm; rotations count at the component's rim."""
        return float(np.abs(twist * np.repeat([self.radius_mm, 1.0], 3)).max())

    def is_same(self, place: Array, other: Array) -> bool:
        """Whether two places differ at all corners by less than a quarter of a pixel, so that the same is visible."""
        apart = apply(place, self.corners) - apply(other, self.corners)
        return float(np.linalg.norm(apart, axis=1).max()) < 0.25 * self.px_mm

    def free_at(self, place: Array) -> Array:
        """(K,6) the free directions, rotated with the component."""
        turn = place[:3, :3].T
        return np.concatenate([self.free[:, :3] @ turn, self.free[:, 3:] @ turn], axis=1)

    def shifts(self, reach_mm: float) -> Array:
        """(T,3) translations to try within ``reach_mm``, nearest first."""
        axis = np.arange(-reach_mm, reach_mm + 1e-9, max(0.5, reach_mm / 12))
        grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
        return np.asarray(grid[np.argsort(np.linalg.norm(grid, axis=1), kind="stable")])

    def move(
        self,
        method: Method,
        fit: RigidFit,
        by_poses: Array,
        place: Array,
        systematic_mm: float,
        support: float,
        common: Array | None = None,
    ) -> Move:
        """The measured move from the last fit.

        Args:
            method: method of measurement.
            fit: the last fit; its twist is already included in ``place``.
            by_poses: (6,6M) derivative of the twist with respect to the twists of the photos' poses.
            place: (4,4) where the component is.
            systematic_mm: standard deviation, in every direction, of errors that the residuals do not show.
            support: see `Move`.
            common: (6,) standard deviation of the twist by an error that moves all measurements together.
        """
        scale = np.repeat([1.0 / self.radius_mm, 1.0], 3)
        project = np.eye(6) - fit.undetermined.T @ fit.undetermined
        # A shift of a face rotates the component by more than it would at the rim, since faces do not reach that far.
        systematic = np.diag(np.repeat([4.0, 1.0], 3)) * systematic_mm**2
        covariance = fit.covariance + project @ systematic @ project * np.outer(scale, scale)
        if common is not None:
            covariance = covariance + np.outer(common, common)
        if self.views.pose_covariance is not None:
            covariance = covariance + by_poses @ self.views.pose_covariance @ by_poses.T
        extra = len(fit.undetermined) - len(self.free)
        noun = "direction" if extra == 1 else "directions"
        notes = (f"undetermined in {extra} {noun} beyond those that its symmetry leaves free",) if extra > 0 else ()
        twist = np.concatenate([log_so3(place[:3, :3]), apply(place, self.center) - self.center])
        return Move(
            component=self.shape.name,
            method=method,
            center_in_model=self.center,
            twist=scale * (project @ (twist / scale)),
            covariance=0.5 * (covariance + covariance.T),
            undetermined=fit.undetermined,
            radius_mm=self.radius_mm,
            used=int(np.count_nonzero(fit.weights > 0.1)),
            residual_mm=fit.residual_mm,
            support=support,
            notes=notes,
        )


def joint_mm(model: Model, component: int) -> float:
    """Distance from other components within which surfaces and edges of one are dropped, see `JOINT_MM`.

    Of a low component, such as the head of a screw, it is half of the height that some of its surface has above them,
    because nothing would be left of it.
    """
    points = sample_surface(model.components[component], 0.5, HEIGHT_SAMPLES).points
    for height_mm in HEIGHTS_MM:
        if np.mean(near_others(points, model, component, height_mm)) < 1.0 - HEIGHT_SHARE:
            break
    return min(JOINT_MM, 0.5 * height_mm)
