"""The range of viewpoints that covers given poses: what a scene without a declared range is searched in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from arview.cad.view_range import ViewRange
from arview.errors import InputError
from arview.geometry import Array, exp_so3, look_at

DISTANCE_MARGIN = 0.2
ANGLE_MARGIN = 0.2
ANGLE_MARGIN_MIN_DEG = 15.0
POLE_DEG = 85.0
"""From this elevation on azimuth and roll say the same, so both are left free."""


@dataclass(frozen=True)
class Viewpoint:
    """Where a camera stands around a part, as `ViewRange` counts it."""

    distance_mm: float
    elevation_deg: float
    azimuth_deg: float
    roll_deg: float


def viewpoint(cam_from_model: Array, center_in_model: ArrayLike) -> Viewpoint:
    """Viewpoint of a pose.

    The part need not be in the middle of the picture: the camera is first turned, the shortest way, to look
    at the centre. What then differs from `geometry.look_at` with +Z up is a turn about the optical axis: the
    roll, positive when the part appears turned clockwise in the picture.

    Args:
        cam_from_model: (4,4), mm.
        center_in_model: (3,) middle of the model's bounding box, mm.

    Raises:
        InputError: the camera is at the centre.
    """
    center = np.asarray(center_in_model, dtype=np.float64)
    rotation = cam_from_model[:3, :3]
    eye = -rotation.T @ cam_from_model[:3, 3]
    away = eye - center
    distance_mm = float(np.linalg.norm(away))
    if distance_mm < 1e-9:
        raise InputError("view range: a camera stands at the centre of the part")
    x, y, z = away / distance_mm
    center_in_cam = -rotation @ away / distance_mm
    centred = _shortest_turn(center_in_cam, np.array([0.0, 0.0, 1.0])) @ rotation
    upright = look_at(eye, center, [0.0, 0.0, 1.0])[:3, :3]
    turn = centred @ upright.T
    return Viewpoint(
        distance_mm=distance_mm,
        elevation_deg=float(np.rad2deg(np.arcsin(np.clip(z, -1.0, 1.0)))),
        azimuth_deg=float(np.rad2deg(np.arctan2(y, x))),
        roll_deg=float(np.rad2deg(np.arctan2(turn[1, 0], turn[0, 0]))),
    )


def _shortest_turn(start: Array, end: Array) -> Array:
    """(3,3) rotation by the smallest angle that takes one unit vector to another."""
    axis = np.cross(start, end)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return np.eye(3) if start @ end > 0 else np.diag([1.0, -1.0, -1.0])
    return exp_so3(axis / sine * np.arctan2(sine, float(start @ end)))


def covering_range(poses: list[Array], center_in_model: ArrayLike) -> ViewRange:
    """Range that holds all poses (4,4) with a margin.

    The margin is 20 % of the distance, and 20 % of the span of each angle but at least 15°. Azimuth and roll
    are taken the short way round the circle.

    Raises:
        InputError: no pose is given.
    """
    if not poses:
        raise InputError("view range: no pose to cover; give a part file with a view_range")
    points = [viewpoint(pose, center_in_model) for pose in poses]
    distances = [point.distance_mm for point in points]
    elevations = np.array([point.elevation_deg for point in points])
    low, high = _widened(float(elevations.min()), float(elevations.max()))
    if max(abs(low), abs(high)) >= POLE_DEG:
        azimuth_deg = roll_deg = (-180.0, 180.0)
    else:
        azimuth_deg = _circular([point.azimuth_deg for point in points])
        roll_deg = _circular([point.roll_deg for point in points])
    return ViewRange(
        distance_mm=((1.0 - DISTANCE_MARGIN) * min(distances), (1.0 + DISTANCE_MARGIN) * max(distances)),
        elevation_deg=(max(low, -90.0), min(high, 90.0)),
        azimuth_deg=azimuth_deg,
        roll_deg=roll_deg,
    )


def _widened(low: float, high: float) -> tuple[float, float]:
    margin = max(ANGLE_MARGIN * (high - low), ANGLE_MARGIN_MIN_DEG)
    return low - margin, high + margin


def shortest_arc(angles_deg: ArrayLike) -> tuple[float, float]:
    """Smallest interval in deg that holds all angles modulo 360; it starts in [-180, 180)."""
    angles = np.sort((np.asarray(angles_deg, dtype=np.float64) + 180.0) % 360.0 - 180.0)
    gaps = np.diff(np.append(angles, angles[0] + 360.0))
    widest = int(np.argmax(gaps))
    low = float(angles[(widest + 1) % len(angles)])
    return low, low + 360.0 - float(gaps[widest])


def _circular(angles_deg: list[float]) -> tuple[float, float]:
    low, high = _widened(*shortest_arc(angles_deg))
    return (low, high) if high - low < 360.0 else (-180.0, 180.0)
