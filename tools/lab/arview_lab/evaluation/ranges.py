"""The range of viewpoints that covers given poses; used for scenes without a declared range."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from arview.cad.view_range import ViewRange
from arview.cad.viewpoint import viewpoint
from arview.errors import InputError
from arview.geometry import Array

DISTANCE_MARGIN = 0.2
"""Share of the distance that is added at both ends."""
ANGLE_MARGIN, MIN_ANGLE_MARGIN_DEG = 0.2, 15.0
"""Share of an angle's span that is added at both ends, and its minimum."""
POLE_DEG = 85.0
"""From this elevation on azimuth and roll cannot be separated, so both are left free."""


def covering_range(poses: list[Array], center_in_model: ArrayLike) -> ViewRange:
    """Range that contains all poses (4,4) with a margin.

    The margin is 20 % of the distance, and 20 % of the span of each angle but at least 15°. Azimuth and roll take the
    shortest arc of the circle.

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
    margin = max(ANGLE_MARGIN * (high - low), MIN_ANGLE_MARGIN_DEG)
    return low - margin, high + margin


def shortest_arc(angles_deg: ArrayLike) -> tuple[float, float]:
    """Smallest interval in deg that contains all angles modulo 360; it starts in [-180, 180)."""
    angles = np.sort((np.asarray(angles_deg, dtype=np.float64) + 180.0) % 360.0 - 180.0)
    gaps = np.diff(np.append(angles, angles[0] + 360.0))
    widest = int(np.argmax(gaps))
    low = float(angles[(widest + 1) % len(angles)])
    return low, low + 360.0 - float(gaps[widest])


def _circular(angles_deg: list[float]) -> tuple[float, float]:
    low, high = _widened(*shortest_arc(angles_deg))
    return (low, high) if high - low < 360.0 else (-180.0, 180.0)
