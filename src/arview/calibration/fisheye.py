"""Adjustment of a fisheye camera and of the poses of a board in all views, by least squares.

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
from arview.geometry import Array, exp_se3, exp_so3

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
    """Sum of squares, camera and poses after the adjustment from a start, by MINPACK's Levenberg-Marquardt method."""
    from scipy.optimize import least_squares

    def placed(x: Array) -> tuple[Camera, Array]:
        moved = poses.copy()
        for pose, step in zip(moved, x[8:].reshape(-1, 6), strict=True):
            pose[:3, :3] = exp_so3(step[:3]) @ pose[:3, :3]  # about the origin of the board
            pose[:3, 3] += step[3:]
        return fisheye_camera(camera.width, camera.height, x[:8].tolist()), moved

    def residuals(x: Array) -> Array:
        try:
            trial, moved = placed(x)
        except InputError:  # a step beyond any lens; the next one is shorter
            return np.full(sum(view.pixels.size for view in views), 1e6)
        pairs = zip(views, moved, strict=True)
        return np.concatenate([(project(v.points_in_board, trial, m)[0] - v.pixels).ravel() for v, m in pairs])

    def jacobian(x: Array) -> Array:
        trial, moved = placed(x)
        rows = []
        for k, (view, pose) in enumerate(zip(views, moved, strict=True)):
            _, by_lens, by_pose = project(view.points_in_board, trial, pose)
            by_all = np.zeros((len(by_lens), len(x)))
            step = x[8 + 6 * k : 11 + 6 * k]
            turn = np.stack([exp_se3([*step, *axis])[:3, 3] for axis in np.eye(3)], axis=1)  # left Jacobian of SO(3)
            by_all[:, :8] = by_lens
            by_all[:, 8 + 6 * k : 14 + 6 * k] = np.concatenate([by_pose[:, :3] @ turn, by_pose[:, 3:]], axis=1)
            rows.append(by_all)
        return np.concatenate(rows)

    start = np.concatenate([intrinsics_of(camera), np.zeros(6 * len(poses))])
    found = least_squares(residuals, start, jacobian, method="lm", x_scale="jac", ftol=TOLERANCE, max_nfev=MAX_STEPS)
    return 2.0 * float(found.cost), *placed(found.x)
