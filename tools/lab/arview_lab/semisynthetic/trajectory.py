"""Smooth random trajectories of a part in front of a camera, about as fast as those of the RBOT dataset.

The speed, 7° and 15 mm from frame to frame, is the one given for RBOT by Tian et al. ("Large-displacement 3D Object
Tracking with Hybrid Non-local Optimization", ECCV 2022), quoted from memory.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from arview.camera import Camera
from arview.geometry import Array, apply, exp_so3, orthonormalise, rigid


@dataclass(frozen=True)
class TrajectoryOptions:
    """Motion of a part.

    Attributes:
        turn_deg, step_mm: mean rotation and translation from frame to frame.
        distance_mm: smallest and largest distance from the camera to the part's centre.
        smooth_frames: frames over which direction and speed change.
        margin: share of the part's projected radius that may leave the picture.
    """

    turn_deg: float = 7.0
    step_mm: float = 15.0
    distance_mm: tuple[float, float] = (450.0, 1000.0)
    smooth_frames: float = 12.0
    margin: float = 0.3


def random_trajectory(
    camera: Camera,
    center_in_model: Array,
    diameter_mm: float,
    count: int,
    rng: np.random.Generator,
    options: TrajectoryOptions | None = None,
) -> Array:
    """``cam_from_model`` (count,4,4) of a part that tumbles about its centre and moves through the picture.

    The mean rotation and translation from frame to frame are those of the options; a part too large to move that far
    in the picture moves less.
    """
    o = options or TrajectoryOptions()
    rotations = _rotations(count, o, rng)
    centers = _centers(camera, diameter_mm, count, o, rng)
    shifts = centers - np.einsum("nij,j->ni", rotations, center_in_model)
    return np.stack([rigid(rotation, shift) for rotation, shift in zip(rotations, shifts, strict=True)])


def followed_trajectory(poses: list[Array], center_of_poses: Array, center_in_model: Array) -> Array:
    """``cam_from_model`` (N,4,4) of a part whose centre and orientation follow those of another part's poses."""
    moved = [rigid(p[:3, :3], apply(p, center_of_poses) - p[:3, :3] @ center_in_model) for p in poses]
    return np.stack(moved)


def smooth_noise(count: int, width: int, smooth_frames: float, rng: np.random.Generator) -> Array:
    """(count, width) noise of standard deviation 1, smoothed over a number of frames."""
    margin = int(np.ceil(4 * smooth_frames))
    noise = gaussian_filter1d(rng.normal(size=(count + 2 * margin, width)), smooth_frames, axis=0)
    # A Gaussian filter leaves 1 / sqrt(2 sqrt(pi) sigma) of the deviation of white noise.
    return np.asarray(noise[margin : margin + count] * np.sqrt(2.0 * np.sqrt(np.pi) * smooth_frames))


def _speeds(count: int, mean: float, smooth_frames: float, rng: np.random.Generator) -> Array:
    """(count,) positive speeds that vary smoothly between about half and one and a half times their mean."""
    speeds = 1.0 + 0.5 * np.tanh(smooth_noise(count, 1, smooth_frames, rng)[:, 0])
    return np.asarray(speeds * mean / speeds.mean())


def _rotations(count: int, o: TrajectoryOptions, rng: np.random.Generator) -> Array:
    """(count,3,3): a random first orientation, rotated about an axis that changes smoothly."""
    quaternion = rng.normal(size=4)
    angle = 2.0 * np.arccos(np.clip(quaternion[0] / np.linalg.norm(quaternion), -1.0, 1.0))
    first = exp_so3(angle * quaternion[1:] / np.linalg.norm(quaternion[1:]))
    axes = smooth_noise(count, 3, o.smooth_frames, rng)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    turns = axes * np.deg2rad(_speeds(count, o.turn_deg, o.smooth_frames, rng))[:, None]
    rotations = [first]
    for turn in turns[1:]:
        rotations.append(orthonormalise(rigid(exp_so3(turn) @ rotations[-1], np.zeros(3)))[:3, :3])
    return np.stack(rotations)


def _centers(camera: Camera, diameter_mm: float, count: int, o: TrajectoryOptions, rng: np.random.Generator) -> Array:
    """(count,3) positions of the part's centre in the camera frame, mm, along a smooth curve."""
    # A curve far longer than needed is sampled densely and then followed at the wanted speed.
    dense = 40 * count
    noise = np.tanh(0.9 * smooth_noise(dense, 3, 20.0 * o.smooth_frames, rng))
    low, high = np.log(o.distance_mm)
    distance = np.exp(0.5 * (low + high) + 0.5 * (high - low) * noise[:, 2])
    radius_px = 0.5 * diameter_mm * camera.fx / distance
    free_u = np.maximum(0.5 * camera.width - (1.0 - o.margin) * radius_px, 0.02 * camera.width)
    free_v = np.maximum(0.5 * camera.height - (1.0 - o.margin) * radius_px, 0.02 * camera.height)
    u = 0.5 * (camera.width - 1) + free_u * noise[:, 0]
    v = 0.5 * (camera.height - 1) + free_v * noise[:, 1]
    rays = camera.unproject(np.stack([u, v], axis=1))
    centers = rays / np.linalg.norm(rays, axis=1, keepdims=True) * distance[:, None]
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(centers, axis=0), axis=1))])
    steps = _speeds(count, o.step_mm, o.smooth_frames, rng)
    # If the curve is too short, it is followed more slowly.
    walked = np.cumsum(steps) - steps[0]
    walked *= min(1.0, lengths[-1] / max(walked[-1], 1e-9))
    return np.stack([np.interp(walked, lengths, centers[:, k]) for k in range(3)], axis=1)
