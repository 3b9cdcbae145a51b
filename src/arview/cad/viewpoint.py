"""Viewpoint: position and roll of a camera around a part, and the pose of the part for it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from arview.cad.view_range import upright_from_model
from arview.errors import InputError
from arview.geometry import Array, exp_so3, rigid


@dataclass(frozen=True)
class Viewpoint:
    """Position and roll of a camera around a part, in the convention of `ViewRange`."""

    distance_mm: float
    elevation_deg: float
    azimuth_deg: float
    roll_deg: float


def viewpoint(cam_from_model: Array, center_in_model: ArrayLike, up: str = "z") -> Viewpoint:
    """The viewpoint of a pose.

    The part need not be in the middle of the picture: the camera is first rotated, by the smallest angle, to look at
    the centre. The remaining rotation, to a camera with +Z up, is the roll about the optical axis, positive when the
    part appears rotated clockwise in the picture.

    Args:
        cam_from_model: (4,4), mm.
        center_in_model: (3,) centre of the model's bounding box, mm.
        up: axis of the model that is up, see `ViewRange`.

    Raises:
        InputError: the camera is at the centre.
    """
    turn = upright_from_model(up)
    center = turn @ np.asarray(center_in_model, dtype=np.float64)
    rotation = cam_from_model[:3, :3] @ turn.T
    eye = -rotation.T @ cam_from_model[:3, 3]
    away = eye - center
    distance_mm = float(np.linalg.norm(away))
    if distance_mm < 1e-9:
        raise InputError("view range: a camera stands at the centre of the part")
    x, y, z = away / distance_mm
    elevation_rad = float(np.arcsin(np.clip(z, -1.0, 1.0)))
    azimuth_rad = float(np.arctan2(y, x))
    center_in_cam = -rotation @ away / distance_mm
    centred = _shortest_turn(center_in_cam, np.array([0.0, 0.0, 1.0])) @ rotation
    rolled = centred @ _upright(azimuth_rad, elevation_rad).T
    return Viewpoint(
        distance_mm=distance_mm,
        elevation_deg=float(np.rad2deg(elevation_rad)),
        azimuth_deg=float(np.rad2deg(azimuth_rad)),
        roll_deg=float(np.rad2deg(np.arctan2(rolled[1, 0], rolled[0, 0]))),
    )


def pose_at(
    place: Viewpoint, center_in_model: ArrayLike, ray_in_cam: ArrayLike = (0.0, 0.0, 1.0), up: str = "z"
) -> Array:
    """``cam_from_model`` (4,4) of a camera at a viewpoint, the inverse of `viewpoint`.

    Straight above and below the part the azimuth still matters: it determines which side of the part is down.

    Args:
        place: viewpoint of the camera.
        center_in_model: (3,) centre of the model's bounding box, mm.
        ray_in_cam: (3,) direction from the camera to that centre.
        up: axis of the model that is up, see `ViewRange`.
    """
    ray = np.asarray(ray_in_cam, dtype=np.float64)
    ray = ray / np.linalg.norm(ray)
    roll = exp_so3([0.0, 0.0, np.deg2rad(place.roll_deg)])
    aside = _shortest_turn(np.array([0.0, 0.0, 1.0]), ray)
    rotation = aside @ roll @ _upright(np.deg2rad(place.azimuth_deg), np.deg2rad(place.elevation_deg))
    rotation = rotation @ upright_from_model(up)
    return rigid(rotation, place.distance_mm * ray - rotation @ np.asarray(center_in_model, dtype=np.float64))


def _upright(azimuth_rad: float, elevation_rad: float) -> Array:
    """(3,3) rotation from the upright frame to a camera in a direction that looks at the centre with +Z up."""
    c, s = np.cos(azimuth_rad), np.sin(azimuth_rad)
    forward = -np.array([np.cos(elevation_rad) * c, np.cos(elevation_rad) * s, np.sin(elevation_rad)])
    right = np.array([-s, c, 0.0])
    return np.stack([right, np.cross(forward, right), forward])


def _shortest_turn(start: Array, end: Array) -> Array:
    """(3,3) rotation by the smallest angle from one unit vector to another."""
    axis = np.cross(start, end)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return np.eye(3) if start @ end > 0 else np.diag([1.0, -1.0, -1.0])
    return exp_so3(axis / sine * np.arctan2(sine, float(start @ end)))
