"""Finding the corners of boards and tags in a picture.

Markers and boards are found with OpenCV (Garrido-Jurado et al., "Automatic generation and detection of highly
reliable fiducial markers under occlusion", Pattern Recognition 2014); the corners of tags are then refined as the
intersections of lines fitted to their sides.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.core import subpixel_edges
from arview.fiducials.board import Board, cv_board, cv_dictionary
from arview.geometry import Array

CornerKey = tuple[str, int, int]
"""Identifies a corner: what it belongs to (``board 0``, or a dictionary), the id there, and the corner of a tag."""


REACH_PX = 3.0
"""How far from OpenCV's estimate a side is searched for, and the largest change of a corner accepted."""
SIDE_RANGE = (0.12, 0.88)
"""Part of a side that is sampled; near the corners the neighbouring side disturbs the profile."""
SPACING_PX = 2.0
"""Distance between samples along a side."""
SAMPLE_RANGE = (8, 60)
"""Smallest and largest number of samples per side."""
HALF_WIDTH_PX = 1.0
THRESHOLD = 1.0
HALF_SLOPE = 6.0
"""Half width, weakest step and slope of half weight of the profiles, see `find_steps` and `choose_steps`."""
MAX_DEVIATION_PX = 0.6
"""Samples farther than this from the median offset of their side are dropped."""
MIN_SAMPLES = 6
"""Samples that a side needs for a line."""


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
    light = subpixel_edges.linear_light(gray)
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


def refined_quad(light: NDArray[np.float32], camera: Camera, quad: Array) -> Array:
    """Corners (4,2) px of a tag as intersections of its four sides, which are straight once distortion is removed.

    OpenCV's corner refinement is made for chessboards: at the isolated corner of a tag its result lies 0.1 to 0.3 px
    inside. Where a side cannot be fitted, or a corner would move by more than ``REACH_PX``, ``quad`` is returned.

    Args:
        light: (H,W) linear light, see `linear_light`.
        camera: of the picture, with its distortion.
        quad: (4,2) px corners found by OpenCV.
    """
    lines = []
    for a, b in zip(quad, np.roll(quad, -1, axis=0), strict=True):
        along = (b - a) / np.linalg.norm(b - a)
        normal = np.array([-along[1], along[0]])
        count = int(np.clip(np.linalg.norm(b - a) / SPACING_PX, *SAMPLE_RANGE))
        points = a + np.linspace(*SIDE_RANGE, count)[:, None] * (b - a)
        normals = np.tile(normal, (count, 1))
        offsets, slopes, _ = subpixel_edges.find_steps(light, points, normals, REACH_PX, HALF_WIDTH_PX, THRESHOLD)
        offset, slope = subpixel_edges.choose_steps(offsets, slopes, 0.5 * REACH_PX, HALF_SLOPE)
        is_found = slope != 0.0
        is_found &= np.abs(offset - np.median(offset[is_found])) < MAX_DEVIATION_PX if is_found.any() else False
        if np.count_nonzero(is_found) < MIN_SAMPLES:
            return quad
        rays = camera.unproject(points[is_found] + offset[is_found, None] * normal)
        # Normal of the plane through the camera's centre that contains the rays of this side.
        lines.append(np.linalg.svd(rays)[2][2])
    corners = np.array([np.cross(lines[k - 1], lines[k]) for k in range(4)])
    with np.errstate(divide="ignore", invalid="ignore"):
        refined = camera.project(corners / corners[:, 2:])
    moved = np.linalg.norm(refined - quad, axis=1)
    return refined if np.all(moved < REACH_PX) else quad


def _rows(values: Any, columns: int) -> Array:
    """OpenCV's result as (N,columns); (0,columns) where it is None."""
    return np.asarray([] if values is None else values, dtype=np.float64).reshape(-1, columns)
