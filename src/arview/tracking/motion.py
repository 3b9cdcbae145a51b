"""Distance of a pose from the pose predicted from the motion so far."""

from __future__ import annotations

from arview.geometry import Array, rotation_angle_rad

ROTATION_UNIT_RAD = 0.785
"""Rotation that has a distance of 1."""
LATERAL_UNIT, AXIAL_UNIT = 0.35, 0.7
"""Shifts across and along the line of sight, in diameters of the part, that have a distance of 1."""


def squared_motion_distance(cam_from_body: Array, predicted: Array, diameter_mm: float) -> float:
    """Squared normalised distance of a pose from the predicted pose.

    It is 1 for a rotation of 45°, a lateral shift of 0.35 diameters or an axial shift of 0.7 diameters.

    Args:
        cam_from_body: (4,4) pose about the part's centre.
        predicted: (4,4) predicted pose about the part's centre.
        diameter_mm: diameter of the part.
    """
    rotation = float(rotation_angle_rad(cam_from_body, predicted)) / ROTATION_UNIT_RAD
    shift = (cam_from_body[:3, 3] - predicted[:3, 3]) / (LATERAL_UNIT * diameter_mm)
    return float(rotation**2 + shift[0] ** 2 + shift[1] ** 2 + (LATERAL_UNIT / AXIAL_UNIT) ** 2 * shift[2] ** 2)
