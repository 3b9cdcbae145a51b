"""ViewRange: the viewpoints from which a camera may see the part."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array

Up = Literal["x", "y", "z", "-x", "-y", "-z"]
UP_AXES: tuple[Up, ...] = ("x", "y", "z", "-x", "-y", "-z")

# The images of +X, +Y and +Z in the frame whose +Z is up: proper rotations, as rows.
_IN_UPRIGHT: dict[str, tuple[tuple[int, int, int], ...]] = {
    "z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-z": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "y": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "-y": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "x": ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
    "-x": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
}


def upright_from_model(up: str) -> Array:
    """(3,3) rotation from the model to the upright frame, whose +Z is the up axis of the part."""
    return np.array(_IN_UPRIGHT[up], dtype=np.float64).T


@dataclass(frozen=True)
class ViewRange:
    """Range of viewpoints around the centre of a model's bounding box.

    A range of 360° or more in azimuth or roll means any angle. Angles are those of the upright frame: the model's own
    where ``up`` is "z"; where it is "y", +X stays, +Y is up and the front is seen along -Z, as in glTF.

    Attributes:
        distance_mm: from the camera to the centre.
        elevation_deg: from the XY plane of the model towards ``+Z``.
        azimuth_deg: from ``+X`` towards ``+Y``.
        roll_deg: about the viewing axis; at 0, ``+Z`` points up in the image.
        min_span_px: the part's diameter in the picture at which the range ends for a camera, in pictures of up to
            ``full_side_px``, see `for_camera`; None: the distances hold for every camera, because they were declared.
        full_side_px: longer side of the picture above which ``min_span_px`` grows in proportion to it.
        max_fill: the part's diameter, as a share of the picture's longer side, at which the range begins for a camera.
        up: axis of the model that is up.
    """

    distance_mm: tuple[float, float]
    elevation_deg: tuple[float, float] = (-90.0, 90.0)
    azimuth_deg: tuple[float, float] = (-180.0, 180.0)
    roll_deg: tuple[float, float] = (-180.0, 180.0)
    min_span_px: float | None = None
    full_side_px: float = 1280.0
    max_fill: float = 1.3
    up: str = "z"

    def __post_init__(self) -> None:
        for name in ("distance_mm", "elevation_deg", "azimuth_deg", "roll_deg"):
            low, high = getattr(self, name)
            if not (np.isfinite(low) and np.isfinite(high) and low <= high):
                raise InputError(f"view range: {name} = [{low}, {high}] is not an interval")
        if self.distance_mm[0] <= 0:
            raise InputError(f"view range: distance_mm = {list(self.distance_mm)} must be positive")
        if self.elevation_deg[0] < -90 or self.elevation_deg[1] > 90:
            raise InputError(f"view range: elevation_deg = {list(self.elevation_deg)} leaves [-90, 90]")
        if self.up not in UP_AXES:
            raise InputError(f"view range: up = {self.up!r}: expected one of {', '.join(UP_AXES)}")

    def for_camera(self, camera: Camera, diameter_mm: float) -> ViewRange:
        """The range at whose distances a camera shows a part of a diameter neither too small nor too large.

        A declared range, without `min_span_px`, is returned as it is.
        """
        if self.min_span_px is None:
            return self
        low, high = self.distance_mm
        longer_px = max(camera.width, camera.height)
        scale_mm = 0.5 * (camera.fx + camera.fy) * diameter_mm
        near = min(max(low, scale_mm / (self.max_fill * longer_px)), high)
        span_px = self.min_span_px * max(1.0, longer_px / self.full_side_px)
        return replace(self, distance_mm=(near, max(near, min(high, scale_mm / span_px))))

    @property
    def upright_from_model(self) -> Array:
        """(3,3) rotation from the model to the frame in which the angles are stated."""
        return upright_from_model(self.up)

    @property
    def up_in_model(self) -> Array:
        """(3,) unit vector of the model that is up."""
        return self.upright_from_model[2]

    def direction(self, azimuth_deg: float, elevation_deg: float) -> Array:
        """(3,) unit vector of the model from the centre towards a camera at two angles."""
        azimuth, elevation = np.deg2rad([azimuth_deg, elevation_deg])
        flat = np.cos(elevation)
        upright = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
        return upright @ self.upright_from_model

    @property
    def is_full_sphere(self) -> bool:
        """True when every viewing direction is in the range."""
        return (
            self.elevation_deg[0] <= -90
            and self.elevation_deg[1] >= 90
            and self.azimuth_deg[1] - self.azimuth_deg[0] >= 360
        )

    def contains_direction(self, directions: ArrayLike, margin_deg: float = 0.0) -> NDArray[np.bool_]:
        """Which unit vectors (N,3) from the centre to the camera are in the range, widened by a margin in deg."""
        d = np.asarray(directions, dtype=np.float64)
        if self.up != "z":
            d = d @ self.upright_from_model.T
        elevation = np.rad2deg(np.arcsin(np.clip(d[..., 2], -1.0, 1.0)))
        inside = (elevation >= self.elevation_deg[0] - margin_deg) & (elevation <= self.elevation_deg[1] + margin_deg)
        low, high = self.azimuth_deg
        if high - low < 360:
            azimuth = np.rad2deg(np.arctan2(d[..., 1], d[..., 0]))
            away = np.abs((azimuth - 0.5 * (low + high) + 180.0) % 360.0 - 180.0)
            # Azimuths converge at the poles: the margin grows with 1 / cos(elevation).
            widened = margin_deg / np.maximum(np.cos(np.deg2rad(elevation)), 1e-3)
            inside &= away <= 0.5 * (high - low) + widened
        return np.asarray(inside)

    def rolls_deg(self, step_deg: float) -> Array:
        """Evenly spaced rolls (R,), deg, that cover the range with at most a given step."""
        low, high = self.roll_deg
        if high - low >= 360:
            return np.arange(0.0, 360.0, 360.0 / np.ceil(360.0 / step_deg))
        count = max(1, int(np.ceil((high - low) / step_deg)))
        return np.asarray(low + (high - low) * (np.arange(count) + 0.5) / count)

    def distances_mm(self, ratio: float) -> Array:
        """Distances (D,), mm, in a geometric series whose steps do not exceed ``ratio``."""
        low, high = self.distance_mm
        count = max(1, int(np.ceil(np.log(high / low) / np.log(ratio) - 1e-9)))
        return np.asarray(low * (high / low) ** ((np.arange(count) + 0.5) / count))
