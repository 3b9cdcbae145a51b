"""Finding the corners of boards and tags in a picture.

Markers and boards are found with OpenCV (Garrido-Jurado et al., "Automatic generation and detection of highly
reliable fiducial markers under occlusion", Pattern Recognition 2014); the corners of tags are then refined as the
intersections of lines fitted to their sides.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.core.subpixel_edges import choose_steps, find_steps, linear_light
from arview.fiducials.board import Board, cv_board, cv_dictionary
from arview.geometry import Array

CornerKey = tuple[str, int, int]
"""Identifies a corner: what it belongs to (``board 0``, or a dictionary), the id there, and the corner of a tag."""


@dataclass(frozen=True)
class QuadOptions:
    """Refinement of the four corners of a tag.

    Attributes:
        reach_px: how far from OpenCV's estimate a side is searched for, and the largest change of a corner accepted.
        side_range: part of a side that is sampled; near the corners the neighbouring side disturbs the profile.
        spacing_px: distance between samples along a side.
        sample_range: smallest and largest number of samples per side.
        half_width_px, threshold, half_slope: of the profiles, see `find_steps` and `choose_steps`.
        max_deviation_px: samples farther than this from the median offset of their side are dropped.
        min_samples: samples that a side needs for a line.
    """

    reach_px: float = 3.0
    side_range: tuple[float, float] = (0.12, 0.88)
    spacing_px: float = 2.0
    sample_range: tuple[int, int] = (8, 60)
    half_width_px: float = 1.0
    threshold: float = 1.0
    half_slope: float = 6.0
    max_deviation_px: float = 0.6
    min_samples: int = 6


def find_corners(
    gray: NDArray[np.uint8], camera: Camera, boards: Sequence[Board], dictionaries: Collection[str]
) -> dict[CornerKey, Array]:
    """Corners of all boards and tags visible in one picture.

    Args:
        gray: (H,W) uint8 picture of ``camera``.
        camera: with its distortion.
        boards: boards that may be in view. Chessboard corners of the n-th, if ChArUco, have the key ``board n``.
        dictionaries: marker dictionaries whose tags are wanted, those of grid boards aside.

    Returns:
        Corner (2,) px of each key, with integers at pixel centres.
    """
    import cv2

    found: dict[CornerKey, Array] = {}
    light = linear_light(gray)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    for number, board in enumerate(boards):
        if board.is_charuco:
            charuco = cv2.aruco.CharucoDetector(cv_board(board), detectorParams=parameters)
            corners, ids, _, _ = charuco.detectBoard(gray)
            for corner, index in zip(_rows(corners, 2), _rows(ids, 1), strict=True):
                found[f"board {number}", int(index[0]), 0] = corner
    grids = {board.dictionary for board in boards if not board.is_charuco}
    for name in sorted(set(dictionaries) | grids):
        detector = cv2.aruco.ArucoDetector(cv_dictionary(name), parameters)
        quads, ids, _ = detector.detectMarkers(gray)
        for quad, index in zip(quads, _rows(ids, 1), strict=True):
            for corner, place in enumerate(refined_quad(light, camera, _rows(quad, 2))):
                found[name, int(index[0]), corner] = place
    return found


def refined_quad(light: NDArray[np.float32], camera: Camera, quad: Array, options: QuadOptions | None = None) -> Array:
    """Corners (4,2) px of a tag as intersections of its four sides, which are straight once distortion is removed.

    OpenCV's corner refinement is made for chessboards: at the isolated corner of a tag its result lies 0.1 to 0.3 px
    inside. Where a side cannot be fitted, or a corner would move by more than ``reach_px``, ``quad`` is returned.

    Args:
        light: (H,W) linear light, see `linear_light`.
        camera: of the picture, with its distortion.
        quad: (4,2) px corners found by OpenCV.
        options: see `QuadOptions`.
    """
    o = options or QuadOptions()
    lines = []
    for a, b in zip(quad, np.roll(quad, -1, axis=0), strict=True):
        along = (b - a) / np.linalg.norm(b - a)
        normal = np.array([-along[1], along[0]])
        count = int(np.clip(np.linalg.norm(b - a) / o.spacing_px, *o.sample_range))
        points = a + np.linspace(*o.side_range, count)[:, None] * (b - a)
        normals = np.tile(normal, (count, 1))
        offsets, slopes, _ = find_steps(light, points, normals, o.reach_px, o.half_width_px, o.threshold)
        offset, slope = choose_steps(offsets, slopes, 0.5 * o.reach_px, o.half_slope)
        is_found = slope != 0.0
        is_found &= np.abs(offset - np.median(offset[is_found])) < o.max_deviation_px if is_found.any() else False
        if np.count_nonzero(is_found) < o.min_samples:
            return quad
        rays = camera.unproject(points[is_found] + offset[is_found, None] * normal)
        # Normal of the plane through the camera's centre that contains the rays of this side.
        lines.append(np.linalg.svd(rays)[2][2])
    corners = np.array([np.cross(lines[k - 1], lines[k]) for k in range(4)])
    with np.errstate(divide="ignore", invalid="ignore"):
        refined = camera.project(corners / corners[:, 2:])
    moved = np.linalg.norm(refined - quad, axis=1)
    return refined if np.all(moved < o.reach_px) else quad


def _rows(values: Any, columns: int) -> Array:
    """OpenCV's result as (N,columns); (0,columns) where it is None."""
    return np.asarray([] if values is None else values, dtype=np.float64).reshape(-1, columns)
