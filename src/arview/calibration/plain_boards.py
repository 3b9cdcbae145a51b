"""Finding boards without markers in a picture: checkerboards, and symmetric and asymmetric grids of circles.

Corners of checkerboards are found by OpenCV's sector-based detector (Duda and Frese 2018) in a smaller picture, and
refined in the full one. Of circles the centroids are found, which perspective and distortion shift against the images
of their centres; `with_centres` removes that shift once a camera is known (Heikkilä 2000).

Nothing tells the corners of such a board apart. Its numbering is known up to a half turn, for square boards up to a
quarter turn; each of them is a rigid motion of the plane, which changes the poses but not the camera.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.calibration.board_view import BoardView, blur_of
from arview.calibration.projection import pose_of_board, project
from arview.camera import Camera
from arview.fiducials import Board
from arview.geometry import Array

SEARCH_PX = 1600
"""Longer side of the picture that is searched; larger pictures are made smaller, because the search takes long."""
WINDOW = 0.3
"""Half the window in which a corner is refined, in distances to the nearest other corner."""
WINDOW_RANGE_PX = (2, 25)
"""Smallest and largest half of that window."""
SAME_FIT = 1.5
"""Numberings whose residuals from a homography are within this factor, and 0.1 px, fit equally well."""
MIN_SPOT_PX = 20.0
"""Smallest area of a circle in the picture that is searched."""
PATCH_PX = 24
"""Pixels per pitch of the picture in which the circles' share of the area is measured."""
OUTLINE = 32
"""Points on the outline of a circle."""
FIRST_SIZE = (3, 3)
"""Checkerboard from which the search for one of unknown size starts."""
MIN_UNKNOWN = 12
"""Inner corners of a checkerboard that nobody has declared: chance makes smaller ones."""


@dataclass
class PlainBoardFinder:
    """Finds all corners, or circles, of one board without markers in grey pictures."""

    board: Board
    sizes_seen: Counter[tuple[int, int]] = field(default_factory=Counter)
    """Columns and rows of the checkerboards in pictures that do not show the declared one."""

    def __post_init__(self) -> None:
        self._points = points_of(self.board)
        self._before: Array | None = None
        self._is_light = False
        self._seen: tuple[int, int] | None = None

    def find(self, name: str, gray: NDArray[np.uint8]) -> BoardView | str:
        """The view of a picture (H,W) uint8, or the reason why there is none."""
        small, factor = _smaller(gray)
        is_checkerboard = self.board.kind == "checkerboard"
        found = self._corners(gray, small, factor) if is_checkerboard else self._circles(small, factor)
        if found is None:
            return self._reason()
        pixels = self._numbered(found)
        self._before = pixels
        radius_mm = 0.0 if is_checkerboard else self._radius_mm(gray, pixels)
        ids = np.arange(len(pixels), dtype=np.int64)
        return BoardView(name, ids, self._points, pixels, blur_of(gray, pixels), radius_mm=radius_mm)

    def _corners(self, gray: NDArray[np.uint8], small: NDArray[np.uint8], factor: Array) -> Array | None:
        """Inner corners (N,2) px of the whole checkerboard in the full picture."""
        size = (self.board.columns, self.board.rows)
        is_found, corners = cv2.findChessboardCornersSB(small, size)
        if not is_found:
            self._seen, corners = _any_checkerboard(small)  # which may find it all the same
            if self._seen not in (size, size[::-1]):
                return None
            if self._seen != size:
                corners = np.asarray(corners).reshape(*size, 2).transpose(1, 0, 2)
        pixels = _in_full_picture(corners, factor)
        grid = pixels.reshape(self.board.rows, self.board.columns, 2)
        nearest = min(float(np.linalg.norm(np.diff(grid, axis=axis), axis=2).min()) for axis in (0, 1))
        half = int(np.clip(WINDOW * nearest, *WINDOW_RANGE_PX))
        stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-4)
        refined = cv2.cornerSubPix(gray, np.array(pixels[:, None], dtype=np.float32), (half, half), (-1, -1), stop)
        return np.asarray(refined, dtype=np.float64).reshape(-1, 2)

    def _circles(self, small: NDArray[np.uint8], factor: Array) -> Array | None:
        """Centroids (N,2) px, in the full picture, of all circles: dark ones, else light ones."""
        is_asymmetric = self.board.kind == "acircles"
        flag = cv2.CALIB_CB_ASYMMETRIC_GRID if is_asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
        size = (self.board.columns, self.board.rows)
        spots = _spot_detector(small.size / (self.board.columns * self.board.rows))
        for is_light in (self._is_light, not self._is_light):
            picture = cv2.bitwise_not(small) if is_light else small
            for more in (0, cv2.CALIB_CB_CLUSTERING):
                is_found, centres = cv2.findCirclesGrid(
                    picture, size, flag | more, spots, cv2.CirclesGridFinderParameters()
                )
                if is_found:
                    self._is_light = is_light
                    return _in_full_picture(centres, factor)
        return None

    def _numbered(self, found: Array) -> Array:
        """The corners in the order of the board's points: of the numberings that fit, the one nearest to the last.

        So the corners keep their numbers through a video. In an asymmetric grid with an even number of rows OpenCV
        swaps the two rows of each pair.
        """
        grid = found.reshape(self.board.rows, self.board.columns, 2)
        if self.board.kind == "acircles" and self.board.rows % 2 == 0:
            paired = grid[np.arange(self.board.rows) ^ 1]
            grid = min(grid, paired, key=lambda one: _misfit(self._points, one.reshape(-1, 2)))
        ways = [grid[::down, ::right] for down in (1, -1) for right in (1, -1)]
        if self.board.rows == self.board.columns:
            ways += [way.transpose(1, 0, 2) for way in ways]
        numberings = [way.reshape(-1, 2) for way in ways]
        errors = np.array([_misfit(self._points, pixels) for pixels in numberings])
        fitting = [
            pixels
            for pixels, error in zip(numberings, errors, strict=True)
            if error <= SAME_FIT * errors.min() + 0.1  # equal up to rounding
        ]
        before = self._before
        if before is None or not fitting:
            return fitting[0] if fitting else found
        return min(fitting, key=lambda pixels: float(np.sum((pixels - before) ** 2)))

    def _radius_mm(self, gray: NDArray[np.uint8], pixels: Array) -> float:
        """Radius of the circles, from the share of the board's area that they cover; the picture shows it to some %."""
        to_patch = PATCH_PX / self.board.cell_mm
        homography, _ = cv2.findHomography(pixels, to_patch * self._points[:, :2])
        across, down = (int(n) for n in np.round(to_patch * self._points[:, :2].max(axis=0)))
        if homography is None:
            return 0.0
        patch = cv2.warpPerspective(gray, homography, (across, down), flags=cv2.INTER_AREA)
        level, _ = cv2.threshold(patch, 0, 255, cv2.THRESH_OTSU)
        share = float(np.mean(patch > level if self._is_light else patch <= level))
        area_mm2 = (2.0 if self.board.kind == "acircles" else 1.0) * self.board.cell_mm**2
        return float(np.sqrt(share * area_mm2 / np.pi))

    def _reason(self) -> str:
        """Why a picture does not count."""
        columns, rows = self.board.columns, self.board.rows
        if self.board.kind != "checkerboard":
            return f"does not show all {columns}×{rows} circles of the grid"
        if self._seen is None:
            return f"shows no checkerboard of {columns}×{rows} inner corners"
        across, down = sorted(self._seen, reverse=columns >= rows)
        self.sizes_seen[across, down] += 1
        return f"shows {across}×{down} inner corners of a checkerboard; all {columns}×{rows} must be seen"


def points_of(board: Board) -> Array:
    """(N,3) mm corners or centres of a board without markers, row by row, z = 0."""
    row, column = np.divmod(np.arange(board.columns * board.rows), board.columns)
    across = 2 * column + row % 2 if board.kind == "acircles" else column
    return board.cell_mm * np.stack([across, row, 0 * row], axis=1).astype(np.float64)


def with_centres(view: BoardView, camera: Camera) -> BoardView:
    """The view with the images of the circles' centres in place of the centroids of their images.

    Args:
        view: of a board; of corners it is returned as it is.
        camera: near the true one.
    """
    pose = pose_of_board(view.points_in_board, view.pixels, camera) if view.radius_mm > 0.0 else None
    if pose is None:
        return view
    angle = np.linspace(0.0, 2.0 * np.pi, OUTLINE, endpoint=False)
    ring = view.radius_mm * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    outlines = project((view.points_in_board[:, None] + ring).reshape(-1, 3), camera, pose)[0].reshape(-1, OUTLINE, 2)
    centres = project(view.points_in_board, camera, pose)[0]
    # Centroid of a polygon, about the centre, by the triangles between it and each side.
    a = outlines - centres[:, None]
    b = np.roll(a, -1, axis=1)
    area = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    shift = np.sum((a + b) * area[..., None], axis=1) / (3.0 * area.sum(axis=1))[:, None]
    return replace(view, pixels=view.pixels - shift) if np.isfinite(shift).all() else view


def checkerboard_in(gray: NDArray[np.uint8]) -> tuple[int, int] | None:
    """Columns and rows of the inner corners of a checkerboard of unknown size; of one hidden in part, what is seen."""
    return _any_checkerboard(_smaller(gray)[0])[0]


def _any_checkerboard(small: NDArray[np.uint8]) -> tuple[tuple[int, int] | None, Array]:
    """Columns and rows of a checkerboard of unknown size, None if there is none, and its corners (N,2) px."""
    is_found, corners, kinds = cv2.findChessboardCornersSBWithMeta(small, FIRST_SIZE, cv2.CALIB_CB_LARGER)
    rows, columns = np.asarray(kinds).shape[:2] if is_found and kinds is not None else (0, 0)
    size = (int(columns), int(rows)) if columns * rows >= MIN_UNKNOWN else None
    return size, np.asarray(corners, dtype=np.float64).reshape(-1, 2) if size else np.zeros((0, 2))


def _smaller(gray: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], Array]:
    """A picture of at most SEARCH_PX, and pixels (2,) of the given one per pixel of it."""
    height, width = gray.shape
    factor = max(width, height) / SEARCH_PX
    if factor <= 1.0:
        return gray, np.ones(2)
    size = (round(width / factor), round(height / factor))
    small = np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return small, np.array([width, height]) / size


def _in_full_picture(pixels: Any, factor: Array) -> Array:
    """(N,2) px of the full picture, integers at pixel centres."""
    return (np.asarray(pixels, dtype=np.float64).reshape(-1, 2) + 0.5) * factor - 0.5


def _spot_detector(room_px: float) -> Any:
    """OpenCV's detector of dark spots for a grid; ``room_px`` is the area of the picture per circle."""
    untyped: Any = cv2  # its types lack this detector
    details = untyped.SimpleBlobDetector_Params()
    details.minArea, details.maxArea = MIN_SPOT_PX, max(room_px, 2.0 * MIN_SPOT_PX)
    details.minDistBetweenBlobs = 0.5 * MIN_SPOT_PX**0.5
    return untyped.SimpleBlobDetector_create(details)


def _misfit(points: Array, pixels: Array) -> float:
    """Root mean square distance, px, from the points (N,3) of a plane by their best homography; infinite without."""
    homography, _ = cv2.findHomography(points[:, :2], pixels)
    if homography is None:
        return np.inf
    there = cv2.perspectiveTransform(points[None, :, :2], homography)[0]
    return float(np.sqrt(np.mean(np.sum((there - pixels) ** 2, axis=1))))
