"""What both ways of measuring a component share: its centre, what its shape leaves free, and the result in words."""

from __future__ import annotations

import numpy as np

from arview.cad.part import Part
from arview.geometry import Array, apply, exp_so3, log_so3, rigid
from arview.measurement.photo.fit import RigidFit
from arview.measurement.photo.options import PhotoOptions
from arview.measurement.photo.patches import free_directions
from arview.measurement.photo.views import PhotoViews
from arview.measurement.types import Method, Move


class MeasuredComponent:
    """One component of the model that the views show.

    A *place* is (4,4) measured_from_nominal in the model frame.

    Attributes:
        views, index, options: as given.
        shape: the component.
        center: (3,) of its bounding box.
        corners: (8,3) of its bounding box.
        radius_mm: half its diagonal.
        px_mm: size of a pixel there.
        free: (K,6) moves that its shape does not show, see `free_directions`.
    """

    def __init__(self, views: PhotoViews, index: int, part: Part | None, options: PhotoOptions) -> None:
        self.views, self.index, self.options = views, index, options
        self.shape = views.model.components[index]
        low, high = self.shape.bounds_in_model
        self.center = self.shape.bounds_in_model.mean(axis=0)
        self.corners = low + np.array(list(np.ndindex(2, 2, 2))) * (high - low)
        self.radius_mm = 0.5 * float(np.linalg.norm(np.ptp(self.shape.bounds_in_model, axis=0)))
        self.px_mm = views.mm_per_px(self.center)
        self.free = free_directions(self.shape, part, self.center, self.radius_mm)

    def moved(self, place: Array, twist: Array) -> Array:
        """A place after a further move (6,) about where it takes the centre."""
        rotation = exp_so3(twist[:3])
        center = apply(place, self.center)
        return rigid(rotation, center - rotation @ center + twist[3:]) @ place

    def size_mm(self, twist: Array) -> float:
        """The largest part of a move, turns at the component's rim."""
        return float(np.abs(twist * np.repeat([self.radius_mm, 1.0], 3)).max())

    def is_same(self, place: Array, other: Array) -> bool:
        """Whether no corner of the component's box differs by a quarter of a pixel: too little to hide or show it."""
        apart = apply(place, self.corners) - apply(other, self.corners)
        return float(np.linalg.norm(apart, axis=1).max()) < 0.25 * self.px_mm

    def free_at(self, place: Array) -> Array:
        """The free directions turned along with the component."""
        turn = place[:3, :3].T
        return np.concatenate([self.free[:, :3] @ turn, self.free[:, 3:] @ turn], axis=1)

    def shifts(self, reach_mm: float) -> Array:
        """(T,3) shifts to try, nearest first."""
        axis = np.arange(-reach_mm, reach_mm + 1e-9, max(0.5, reach_mm / 12))
        grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
        return np.asarray(grid[np.argsort(np.linalg.norm(grid, axis=1), kind="stable")])

    def move(
        self, method: Method, fit: RigidFit, by_poses: Array, place: Array, systematic_mm: float, support: float
    ) -> Move:
        """The result: a fit at its end, at a place.

        Args:
            method: which way of measuring.
            fit: the last one; its twist is already in ``place``.
            by_poses: (6,6M) how the twist changes with the twists of the photos' poses.
            place: where the component stands.
            systematic_mm: standard deviation, in every direction, of what residuals do not show.
            support: see ``Move``.
        """
        scale = np.repeat([1.0 / self.radius_mm, 1.0], 3)
        project = np.eye(6) - fit.undetermined.T @ fit.undetermined
        # What shifts a face by this turns a component by more: faces do not reach out to its rim.
        systematic = np.diag(np.repeat([4.0, 1.0], 3)) * systematic_mm**2
        covariance = fit.covariance + project @ systematic @ project * np.outer(scale, scale)
        if self.views.pose_covariance is not None:
            covariance = covariance + by_poses @ self.views.pose_covariance @ by_poses.T
        open_too = len(fit.undetermined) - len(self.free)
        notes = (f"in {open_too} more directions than its shape leaves free it is not held",) if open_too > 0 else ()
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
