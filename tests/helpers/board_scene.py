"""Pictures of a board by a known camera: exact perspective and distortion, area-averaged, blurred, noisy."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.calibration.plain_boards import points_of
from arview.camera import Camera
from arview.camera.lens import LensDistortion
from arview.fiducials.board import Board, parse_board
from arview.fiducials.board_sheet import rectangles_mm
from arview.geometry import Array, exp_so3, rigid

BOARD = parse_board("charuco:11x8:21:16:DICT_5X5_100")
LENS = Camera(640, 480, 563.0, 561.2, 326.4, 233.7, np.array([-0.16, 0.07, 6e-4, -4e-4, -0.015]))
"""A webcam: 59° across, barrel distortion of 7 px at the corners, principal point off the centre."""
_PX_PER_MM = 10
_SUPER = 2


@cache
def _texture(board: Board) -> tuple[NDArray[np.uint8], float]:
    """The board's plane at _PX_PER_MM, and how many mm of it are left of and above the board's origin."""
    margin = 12.0
    if not board.is_coded:
        return _plain_texture(board, margin)
    size = (round((board.rows * board.cell_mm + 2 * margin) * _PX_PER_MM),
            round((board.columns * board.cell_mm + 2 * margin) * _PX_PER_MM))  # fmt: skip
    picture = np.full(size, 235, np.uint8)
    for gray, rectangles in zip((20, 235), rectangles_mm(board), strict=True):
        for left, top, width, height in rectangles:
            a, b = round((left + margin) * _PX_PER_MM), round((left + width + margin) * _PX_PER_MM)
            c, d = round((top + margin) * _PX_PER_MM), round((top + height + margin) * _PX_PER_MM)
            picture[c:d, a:b] = gray
    return picture, margin


def _plain_texture(board: Board, margin: float) -> tuple[NDArray[np.uint8], float]:
    """A checkerboard, or circles of half their distance, whose first corner or circle is at the origin."""
    points, cell = points_of(board)[:, :2], board.cell_mm
    border = margin + cell
    width, height = (round((side + 2 * border) * _PX_PER_MM) for side in points.max(axis=0))
    y, x = np.mgrid[:height, :width]
    x, y = (x + 0.5) / _PX_PER_MM - border, (y + 0.5) / _PX_PER_MM - border
    if board.kind == "checkerboard":
        inside = (x >= -cell) & (y >= -cell) & (x < board.columns * cell) & (y < board.rows * cell)
        is_dark = inside & ((np.floor(x / cell) + np.floor(y / cell)) % 2 == 0)
    else:
        is_dark = np.zeros((height, width), dtype=bool)
        for a, b in points:
            is_dark |= np.hypot(x - a, y - b) <= circle_radius_mm(board)
    return np.where(is_dark, 20, 235).astype(np.uint8), border


def circle_radius_mm(board: Board) -> float:
    """Radius of the circles that are drawn: a quarter of the distance of two in a row."""
    return (0.5 if board.kind == "acircles" else 0.25) * board.cell_mm


@cache
def _rays(width: int, height: int, numbers: tuple[float, ...], lens: LensDistortion | None) -> NDArray[np.float32]:
    """(H·s, W·s, 2) ideal normalised coordinates of sub-pixels; 1e6 where the lens sees nothing."""
    fx, fy, cx, cy, *terms = numbers
    camera = Camera(width, height, fx, fy, cx, cy, np.array(terms), lens)
    step = (np.arange(_SUPER) + 0.5) / _SUPER - 0.5
    u = (np.arange(width)[:, None] + step).ravel()
    v = (np.arange(height)[:, None] + step).ravel()
    grid = np.stack(np.meshgrid(u, v), axis=-1)
    return np.nan_to_num(camera.unproject(grid)[..., :2], nan=1e6).astype(np.float32)


def photograph(
    board: Board,
    camera: Camera,
    cam_from_board: Array,
    rng: np.random.Generator,
    blur_px: float = 0.6,
    noise: float = 3.0,
    ground: float = 110.0,
) -> NDArray[np.uint8]:
    """(H,W) uint8 gray picture; blur is a Gaussian's sigma in px, noise a normal's in grey levels."""
    picture, margin = _texture(board)
    rays = _rays(camera.width, camera.height, (camera.fx, camera.fy, camera.cx, camera.cy, *camera.dist), camera.lens)
    # Plane to normalised coordinates, and back.
    h = np.linalg.inv(cam_from_board[:3, [0, 1, 3]])
    w = h[2, 0] * rays[..., 0] + h[2, 1] * rays[..., 1] + h[2, 2]
    x = (h[0, 0] * rays[..., 0] + h[0, 1] * rays[..., 1] + h[0, 2]) / w
    y = (h[1, 0] * rays[..., 0] + h[1, 1] * rays[..., 1] + h[1, 2]) / w
    column = np.floor(np.nan_to_num(x + margin, nan=-1.0).clip(-1e3, 1e4) * _PX_PER_MM).astype(np.int32)
    row = np.floor(np.nan_to_num(y + margin, nan=-1.0).clip(-1e3, 1e4) * _PX_PER_MM).astype(np.int32)
    inside = (row >= 0) & (column >= 0) & (row < picture.shape[0]) & (column < picture.shape[1]) & (w > 0)
    fine = np.full(rays.shape[:2], ground, np.float32)
    fine[inside] = picture[row[inside], column[inside]]
    gray = fine.reshape(camera.height, _SUPER, camera.width, _SUPER).mean(axis=(1, 3))
    if blur_px > 0:
        gray = cv2.GaussianBlur(gray, (0, 0), blur_px)
    return np.clip(gray + rng.normal(0.0, noise, gray.shape) + 0.5, 0, 255).astype(np.uint8)


def wide_pose(board: Board, rng: np.random.Generator, off_axis_deg: float = 60.0) -> Array:
    """``cam_from_board`` of a random view for a wide lens: up to an angle off the axis, and tilted against the ray."""
    middle = 0.5 * np.array([board.columns * board.cell_mm, board.rows * board.cell_mm, 0.0])
    angle, azimuth = np.deg2rad(rng.uniform(0, off_axis_deg)), rng.uniform(0, 2 * np.pi)
    around = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    tilt = np.deg2rad(rng.uniform(10.0, 40.0)) * exp_so3([0, 0, rng.uniform(0, 2 * np.pi)])[:, 0]
    from_board = exp_so3(angle * around) @ exp_so3(tilt) @ exp_so3([0, 0, rng.uniform(-0.4, 0.4)])
    place = rng.uniform(130.0, 300.0) * exp_so3(angle * around)[:, 2]
    return rigid(from_board, place - from_board @ middle)


def pose(
    board: Board,
    camera: Camera,
    rng: np.random.Generator,
    tilt_deg: tuple[float, float] = (10.0, 45.0),
    fill: tuple[float, float] = (0.45, 0.95),
    aside: float = 0.3,
) -> Array:
    """``cam_from_board`` of a random view: its middle up to ``aside`` of the picture off the centre."""
    middle = 0.5 * np.array([board.columns * board.cell_mm, board.rows * board.cell_mm, 0.0])
    if not board.is_coded:
        middle = 0.5 * points_of(board).max(axis=0)
    tilt, azimuth, roll = np.deg2rad([rng.uniform(*tilt_deg), rng.uniform(0, 360), rng.uniform(-20, 20)])
    from_board = exp_so3([0, 0, roll]) @ exp_so3(tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0]))
    depth = camera.fx * 2.0 * middle[0] / (rng.uniform(*fill) * camera.width)
    u, v = (rng.uniform(-aside, aside) * side for side in (camera.width, camera.height))
    place = depth * np.array([u / camera.fx, v / camera.fy, 1.0])
    return rigid(from_board, place - from_board @ middle)
