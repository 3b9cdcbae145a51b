"""Boards and tags of coded markers: their description, the command-line form of it, and OpenCV's object for it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, NoReturn

from arview.errors import InputError

BOARD_FORMS = (
    "charuco:COLUMNSxROWS:SQUARE_MM:MARKER_MM:DICTIONARY or grid:COLUMNSxROWS:MARKER_MM:GAP_MM:DICTIONARY, "
    "e.g. charuco:8x6:30:22:DICT_5X5_100"
)
TAG_FORM = "DICTIONARY:SIDE_MM, e.g. apriltag36h11:20"
DEFAULT_DICTIONARY = "DICT_APRILTAG_36h11"
MAX_CELLS = 2000
"""Boards of more cells are taken for a typing error."""


@dataclass(frozen=True)
class Board:
    """A printed ChArUco or marker-grid board as OpenCV defines them.

    Attributes:
        is_charuco: chessboard with markers in its white squares; otherwise a grid of markers.
        columns, rows: number of squares (ChArUco) or of markers (grid).
        cell_mm: side of a square; in a grid, the pitch from marker to marker.
        marker_mm: side of a marker.
        dictionary: OpenCV's name of the marker dictionary.
    """

    is_charuco: bool
    columns: int
    rows: int
    cell_mm: float
    marker_mm: float
    dictionary: str

    def __str__(self) -> str:
        kind = "ChArUco board" if self.is_charuco else "marker board"
        return f"{kind} {self.columns}×{self.rows}, {self.cell_mm:g} mm"


@dataclass(frozen=True)
class Tags:
    """Tags of one dictionary and size that are not part of a board.

    Attributes:
        dictionary: OpenCV's name of the marker dictionary.
        side_mm: side of each tag, measured over its black border.
        ids: the tags that have this size; empty means every tag of the dictionary.
    """

    dictionary: str
    side_mm: float
    ids: tuple[int, ...] = ()


def dictionary_name(text: str) -> str:
    """OpenCV's name of a marker dictionary given as ``DICT_5X5_100``, ``5x5_100``, ``apriltag36h11`` or ``tag36h11``.

    Raises:
        InputError: OpenCV has no such dictionary.
    """
    import cv2

    known = {name.upper(): name for name in dir(cv2.aruco) if name.startswith("DICT_")}
    wanted = text.strip().upper().replace("-", "_")
    family = re.fullmatch(r"(?:APRIL_?)?TAG_?(\d\dH\d\d)", wanted)
    for name in (wanted, f"DICT_{wanted}", f"DICT_APRILTAG_{family[1]}" if family else ""):
        if name in known:
            return known[name]
    some = "DICT_4X4_50, DICT_5X5_100, DICT_6X6_250, DICT_ARUCO_ORIGINAL, apriltag36h11, apriltag25h9, apriltag16h5"
    raise InputError(f"unknown marker dictionary {text!r}; expected one of OpenCV's, e.g. {some}")


def parse_board(text: str) -> Board:
    """The board described on the command line, see BOARD_FORMS. Raises InputError."""
    match = re.fullmatch(r"(charuco|grid):(\d{1,9})x(\d{1,9}):([\d.]+):([\d.]+):([\w-]+)", text.strip(), re.IGNORECASE)
    if not match:
        raise InputError(f"board {text!r}: expected {BOARD_FORMS}")
    kind, columns, rows, first, second, dictionary = match.groups()
    is_charuco = kind.lower() == "charuco"
    if is_charuco:
        cell, marker = parse_length_mm(text, first), parse_length_mm(text, second)
    else:
        marker = parse_length_mm(text, first)
        cell = marker + parse_length_mm(text, second)
    return _checked_board(text, Board(is_charuco, int(columns), int(rows), cell, marker, dictionary))


def parse_tags(text: str) -> Tags:
    """The tags described on the command line, see TAG_FORM. Raises InputError."""
    dictionary, _, side = text.rpartition(":")
    if not dictionary:
        raise InputError(f"tag {text!r}: expected {TAG_FORM}")
    return Tags(dictionary_name(dictionary), parse_length_mm(text, side))


def parse_length_mm(where: str, value: object) -> float:
    """A positive length in mm below one kilometre; ``where`` names the input in the message. Raises InputError."""

    def fail() -> NoReturn:
        raise InputError(f"{where}: {value!r} is not a positive length in mm")

    try:
        length = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        fail()
    if not 0 < length < 1e6:
        fail()
    return length


def spec_of(board: Board) -> str:
    """A ChArUco board in the form that the command line takes."""
    sizes = f"{board.cell_mm:g}:{board.marker_mm:g}"
    return f"charuco:{board.columns}x{board.rows}:{sizes}:{board.dictionary}"


def cv_board(board: Board) -> Any:
    """OpenCV's ``CharucoBoard`` or ``GridBoard`` of the board, in mm."""
    import cv2

    size = (board.columns, board.rows)
    dictionary = cv_dictionary(board.dictionary)
    if board.is_charuco:
        return cv2.aruco.CharucoBoard(size, board.cell_mm, board.marker_mm, dictionary)
    return cv2.aruco.GridBoard(size, board.marker_mm, board.cell_mm - board.marker_mm, dictionary)


def cv_dictionary(name: str) -> Any:
    """OpenCV's predefined marker dictionary of this name."""
    import cv2

    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def _checked_board(text: str, board: Board) -> Board:
    """The board with OpenCV's name of its dictionary. Raises InputError when no such board can exist."""
    columns, rows, minimum = board.columns, board.rows, 3 if board.is_charuco else 1
    if columns < minimum or rows < minimum or columns * rows > MAX_CELLS:
        raise InputError(f"board {text!r}: {columns}×{rows} cells, expected at least {minimum}×{minimum}")
    if board.marker_mm >= board.cell_mm:
        raise InputError(
            f"board {text!r}: markers of {board.marker_mm:g} mm do not fit in cells of {board.cell_mm:g} mm"
        )
    name = dictionary_name(board.dictionary)
    return Board(board.is_charuco, columns, rows, board.cell_mm, board.marker_mm, name)
