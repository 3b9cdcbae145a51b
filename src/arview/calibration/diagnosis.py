"""Why no picture shows the board: another dictionary, another layout, another kind of board, or nothing at all."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from arview.calibration.plain_boards import checkerboard_in
from arview.fiducials import Board, cv_board
from arview.geometry import Array

_DICTIONARIES = (
    "DICT_4X4_250",
    "DICT_5X5_250",
    "DICT_6X6_250",
    "DICT_7X7_250",
    "DICT_ARUCO_ORIGINAL",
    "DICT_APRILTAG_36h11",
    "DICT_APRILTAG_16h5",
    "DICT_APRILTAG_25h9",
)
"""Of each family one dictionary that includes the smaller ones, except for boards of more than 250 markers."""
_MIN_MARKERS = 4
"""Markers of one picture that a conclusion needs."""
_FIT = 0.1
"""Distance from a homography, in sides of a marker, that corners may have because of lens distortion."""


MarkerDetections = tuple[Array, NDArray[np.int64]]
"""Markers found in one picture: corners (N,4,2) px and ids (N,)."""


def diagnose_missing_board(
    board: Board, detections: Sequence[MarkerDetections], picture_count: int, pictures: Sequence[NDArray[np.uint8]]
) -> str:
    """Explain why no picture shows the board, and say what to do.

    Args:
        board: the board that was searched for.
        detections: markers of pictures in which too few of the board's corners were found.
        picture_count: number of pictures searched.
        pictures: some of them, grey (H,W) uint8, in which markers of other dictionaries are searched for.
    """
    if any(len(ids) >= _MIN_MARKERS for _, ids in detections):
        columns = _columns_that_fit(board, detections)
        if columns is not None and columns != board.columns:
            return (
                f"markers of {board.dictionary} were found, but arranged as on a board with {columns} columns instead"
                f" of {board.columns}; correct --board"
            )
        if columns is None:
            return (
                f"markers of {board.dictionary} were found, but not arranged as on a board of {board.columns}×"
                f"{board.rows} squares of {board.cell_mm:g} mm with markers of {board.marker_mm:g} mm; check --board"
            )
        return (
            "the markers of the board were found, but hardly any corner of its squares: it is too small, blurred or"
            " covered; bring it nearer and into focus, with more light"
        )
    other = _other_dictionary(pictures)
    if other is not None:
        return f"no marker of {board.dictionary} was found, but some of {other}; give the board in the pictures"
    seen = Counter(max(size, size[::-1]) for gray in pictures if (size := checkerboard_in(gray)) is not None)
    if seen:
        (columns, rows), _ = seen.most_common(1)[0]
        return (
            f"a checkerboard without markers is seen, with {columns}×{rows} inner corners if that is all of it; give it"
            f" as --board checkerboard:{columns}x{rows}:SQUARE_MM"
        )
    return (
        f"no marker of the board was found in any of {_count(picture_count)}; it must be in focus and fill half of it"
    )


def diagnose_missing_plain_board(
    board: Board,
    sizes_seen: Counter[tuple[int, int]],
    picture_count: int,
    pictures: Iterable[NDArray[np.uint8]],
) -> str:
    """Explain why no picture shows a board without markers, and say what to do.

    Args:
        board: the board that was searched for.
        sizes_seen: columns and rows of the checkerboards that were seen instead.
        picture_count: number of pictures searched.
        pictures: some of them, grey (H,W) uint8, in which markers are searched for.
    """
    dictionary = _other_dictionary(pictures)
    if dictionary is not None:
        return f"markers of {dictionary} are seen; give the board as --board charuco:… with what is printed on it"
    if sizes_seen:
        (columns, rows), times = sizes_seen.most_common(1)[0]
        return (
            f"a checkerboard of {columns}×{rows} inner corners is seen in {times} of {_count(picture_count)}, nowhere"
            f" {board.columns}×{board.rows}; correct --board (one fewer than squares), or show the whole board"
        )
    what = "inner corners" if board.kind == "checkerboard" else "circles"
    return (
        f"no {board} with all its {what} was found in any of {_count(picture_count)}; it must be whole, with a light"
        " margin, in focus and fill half of the picture"
    )


def _count(pictures: int) -> str:
    return f"{pictures} picture{'s' if pictures > 1 else ''}"


def _columns_that_fit(board: Board, detections: Sequence[MarkerDetections]) -> int | None:
    """Number of columns with which the ids of the markers form a plane board in most pictures, or None."""
    pictures = sorted((one for one in detections if len(one[1]) >= _MIN_MARKERS), key=lambda one: -len(one[1]))[:3]
    votes: Counter[int] = Counter()
    for quads, ids in pictures:
        fits = [columns for columns in range(3, 31) if _fits(board, columns, quads, ids)]
        votes.update([board.columns] if board.columns in fits else fits[:1])
    columns, count = votes.most_common(1)[0] if votes else (0, 0)
    return columns if 2 * count > len(pictures) else None


def _fits(board: Board, columns: int, quads: Array, ids: NDArray[np.int64]) -> bool:
    """Whether markers lie as on a board with this number of columns, up to a homography."""
    import cv2

    rows = 2 * (int(ids.max()) + 1) // columns + 2
    if columns * rows // 2 > len(cv_board(board).getDictionary().bytesList):
        rows = 2 * len(cv_board(board).getDictionary().bytesList) // columns
    if rows < 3:
        return False
    for legacy in (False, True):
        drawn = cv_board(replace(board, columns=columns, rows=rows + rows % 2))
        drawn.setLegacyPattern(legacy)
        place = {
            int(i): np.asarray(c)[:, :2] for i, c in zip(drawn.getIds().ravel(), drawn.getObjPoints(), strict=True)
        }
        known = [k for k, index in enumerate(ids) if int(index) in place]
        if len(known) < max(_MIN_MARKERS, 0.8 * len(ids)):
            continue
        on_board = np.concatenate([place[int(ids[k])] for k in known]).astype(np.float64)
        pixels = np.concatenate([quads[k] for k in known])
        side = float(np.median(np.linalg.norm(quads[:, 0] - quads[:, 1], axis=1)))
        found, _ = cv2.findHomography(on_board, pixels, cv2.RANSAC, _FIT * side, maxIters=60)
        if found is None:
            continue
        there = cv2.perspectiveTransform(on_board[None], found)[0]
        if np.mean(np.linalg.norm(there - pixels, axis=1) < 2.0 * _FIT * side) > 0.9:
            return True
    return False


def _other_dictionary(pictures: Iterable[NDArray[np.uint8]]) -> str | None:
    """The dictionary family of most markers in some pictures; None without enough."""
    import cv2

    counts: Counter[str] = Counter()
    for gray in pictures:
        for name in _DICTIONARIES:
            detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)))
            _, ids, _ = detector.detectMarkers(gray)
            counts[name] += 0 if ids is None else len(ids)
    name, count = counts.most_common(1)[0] if counts else ("", 0)
    return name if count >= _MIN_MARKERS else None
