"""Adjustment of a fisheye camera and of the poses of a board in all views, by Levenberg's and Marquardt's method.

The start is found by trying fields of view: an equidistant lens (Kannala and Brandt 2006 with all terms zero) of each
gives the poses of the views, and the one whose corners fit best is adjusted.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from arview.calibration.board_view import BoardView
from arview.calibration.projection import fisheye_camera, intrinsics_of, pose_of_board, project
from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array, exp_so3

START_HALF_ANGLES_DEG: tuple[float, ...] = (30.0, 45.0, 60.0, 75.0, 90.0, 105.0)
"""Angles off the axis, at the border of the picture's longer side, that are tried."""
CANDIDATES = 2
"""Starts that are adjusted: those that fit best."""
MAX_STEPS = 60
"""Steps of the adjustment."""
TOLERANCE = 1e-10
"""Relative change of the sum of squares below which the adjustment has ended."""


def adjust_fisheye(views: Sequence[BoardView], width: int, height: int, start: Camera | None) -> tuple[Camera, Array]:
    """The fisheye camera of the views, and the poses of the board (V,4,4) in it.

    Args:
        views: of the board.
        width, height: of the sensor's picture, px.
        start: a camera near the solution, or None.

    Raises:
        InputError: no start explains the views.
    """
    starts = [start] if start is not None else _starts(width, height)
    found: list[tuple[float, Camera, Array]] = []
    for camera in starts:
        poses = [pose_of_board(view.points_in_board, view.pixels, camera) for view in views]
        if all(pose is not None for pose in poses):
            stacked = np.array(poses)
            found.append((_cost(views, camera, stacked), camera, stacked))
    found.sort(key=lambda one: one[0])
    adjusted = [_adjusted(views, camera, poses) for _, camera, poses in found[:CANDIDATES]]
    if not adjusted:
        raise InputError("no fisheye camera explains the views of the board")
    _, best, best_poses = min(adjusted, key=lambda one: one[0])
    return best, best_poses


def _starts(width: int, height: int) -> list[Camera]:
    half = 0.5 * max(width, height)
    focal_px = [half / np.deg2rad(angle) for angle in START_HALF_ANGLES_DEG]
    return [fisheye_camera(width, height, [f, f, 0.5 * (width - 1), 0.5 * (height - 1), 0, 0, 0, 0]) for f in focal_px]


def _cost(views: Sequence[BoardView], camera: Camera, poses: Array) -> float:
    """Sum of squared residuals, px²."""
    total = 0.0
    for view, pose in zip(views, poses, strict=True):
        total += float(np.sum((view.pixels - project(view.points_in_board, camera, pose)[0]) ** 2))
    return total


def _adjusted(views: Sequence[BoardView], camera: Camera, poses: Array) -> tuple[float, Camera, Array]:
    """Sum of squares, camera and poses after the adjustment from a start."""
    cost, damping = _cost(views, camera, poses), 1e-3
    for _ in range(MAX_STEPS):
        system = _Normal(views, camera, poses)
        while True:
            try:
                intrinsics, turns = system.step(damping)
                trial = fisheye_camera(camera.width, camera.height, (intrinsics_of(camera) + intrinsics).tolist())
                moved = np.array([_moved(pose, turn) for pose, turn in zip(poses, turns, strict=True)])
                trial_cost = _cost(views, trial, moved)
            except (np.linalg.LinAlgError, InputError):
                trial_cost = np.inf
            if trial_cost < cost:
                break
            damping *= 10.0
            if damping > 1e8:
                return cost, camera, poses
        change = (cost - trial_cost) / max(cost, 1e-30)
        camera, poses, cost, damping = trial, moved, trial_cost, max(0.1 * damping, 1e-12)
        if change < TOLERANCE:
            break
    return cost, camera, poses


def _moved(pose: Array, step: Array) -> Array:
    """A pose turned in the camera frame, around the board's origin, and shifted."""
    moved = pose.copy()
    moved[:3, :3] = exp_so3(step[:3]) @ pose[:3, :3]
    moved[:3, 3] += step[3:]
    return moved


class _Normal:
    """Normal equations of all views, with a block for the intrinsics and one for each pose."""

    def __init__(self, views: Sequence[BoardView], camera: Camera, poses: Array) -> None:
        parts = []
        for view, pose in zip(views, poses, strict=True):
            pixels, a, b = project(view.points_in_board, camera, pose)
            r = (view.pixels - pixels).ravel()
            parts.append((a.T @ a, a.T @ b, b.T @ b, a.T @ r, b.T @ r))
        self.aa, self.ab, self.bb, self.ar, self.br = (np.array(column) for column in zip(*parts, strict=True))

    def step(self, damping: float) -> tuple[Array, Array]:
        """Changes (P,) of the intrinsics and (V,6) of the poses, with the diagonal increased by a share."""
        count = self.bb.shape[1]
        bb = self.bb.copy()
        diagonal = np.arange(count)
        bb[:, diagonal, diagonal] *= 1.0 + damping
        aa = self.aa.sum(axis=0)
        aa[np.diag_indices(len(aa))] *= 1.0 + damping
        # Schur complement: the poses are eliminated view by view.
        back = np.linalg.solve(bb, np.concatenate([self.ab.transpose(0, 2, 1), self.br[:, :, None]], axis=2))
        left = aa - np.einsum("vij,vjk->ik", self.ab, back[:, :, :-1])
        right = self.ar.sum(axis=0) - np.einsum("vij,vj->i", self.ab, back[:, :, -1])
        intrinsics = np.linalg.solve(left, right)
        poses = back[:, :, -1] - back[:, :, :-1] @ intrinsics
        return intrinsics, poses
