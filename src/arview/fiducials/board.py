"""Boards and tags: their description, the command-line form of it, and OpenCV's object for those of coded markers."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, Literal, NoReturn, cast

from arview.errors import InputError

BoardKind = Literal["charuco", "grid", "checkerboard", "circles", "acircles"]
"""ChArUco board, grid of markers, checkerboard without markers, symmetric and asymmetric grid of circles."""
BOARD_FORMS = (
    "charuco:COLUMNSxROWS:SQUARE_MM:MARKER_MM:DICTIONARY, grid:COLUMNSxROWS:MARKER_MM:GAP_MM:DICTIONARY, "
    "checkerboard:COLUMNSxROWS:SQUARE_MM (inner corners), circles:COLUMNSxROWS:PITCH_MM or "
    "acircles:COLUMNSxROWS:PITCH_MM, e.g. charuco:8x6:30:22:DICT_5X5_100"
)
TAG_FORM = "DICTIONARY:SIDE_MM, e.g. apriltag36h11:20"
DEFAULT_DICTIONARY = "DICT_APRILTAG_36h11"
MAX_CELLS = 2000
"""Boards of more cells are taken for a typing error."""


@dataclass(frozen=True)
class Board:
    """A printed board. ChArUco boards and grids of markers are as OpenCV defines them.

    Attributes:
        kind: of board.
        columns, rows: number of squares (ChArUco), of markers (grid), of inner corners (checkerboard: one fewer than
            squares), or of circles; an asymmetric grid has ``columns`` circles in each of its ``rows``, of which every
            second is shifted.
        cell_mm: side of a square; in a grid, the pitch from marker to marker or from circle to circle; in an
            asymmetric grid of circles, the distance of successive rows, half that of two circles of a row.
        marker_mm: side of a marker; 0 without markers.
        dictionary: OpenCV's name of the marker dictionary; empty without markers.
    """

    kind: BoardKind
    columns: int
    rows: int
    cell_mm: float
    marker_mm: float = 0.0
    dictionary: str = ""

    @property
    def is_charuco(self) -> bool:
        """Whether it is a chessboard with markers in its white squares."""
        return self.kind == "charuco"

    @property
    def is_coded(self) -> bool:
        """Whether markers tell its corners apart, so that it may be seen in part."""
        return bool(self.dictionary)

    def __str__(self) -> str:
        return f"{_TITLES[self.kind]} {self.columns}×{self.rows}, {self.cell_mm:g} mm"


_TITLES: dict[BoardKind, str] = {
    "charuco": "ChArUco board",
    "grid": "marker board",
    "checkerboard": "checkerboard",
    "circles": "circle grid",
    "acircles": "asymmetric circle grid",
}


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
    plain = re.fullmatch(r"(checkerboard|circles|acircles):(\d{1,9})x(\d{1,9}):([\d.]+)", text.strip(), re.IGNORECASE)
    if plain:
        kind, columns, rows, cell = plain.groups()
        pitch_mm = parse_length_mm(text, cell)
        return _checked_board(text, Board(cast(BoardKind, kind.lower()), int(columns), int(rows), pitch_mm))
    match = re.fullmatch(r"(charuco|grid):(\d{1,9})x(\d{1,9}):([\d.]+):([\d.]+):([\w-]+)", text.strip(), re.IGNORECASE)
    if not match:
        raise InputError(f"board {text!r}: expected {BOARD_FORMS}")
    kind, columns, rows, first, second, dictionary = match.groups()
    kind = cast(BoardKind, kind.lower())
    marker, cell_mm = parse_length_mm(text, first), parse_length_mm(text, second)
    marker, cell_mm = (cell_mm, marker) if kind == "charuco" else (marker, marker + cell_mm)
    return _checked_board(text, Board(kind, int(columns), int(rows), cell_mm, marker, dictionary_name(dictionary)))


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
    """A board in the form that the command line takes."""
    start = f"{board.kind}:{board.columns}x{board.rows}"
    if not board.is_coded:
        return f"{start}:{board.cell_mm:g}"
    if board.is_charuco:
        return f"{start}:{board.cell_mm:g}:{board.marker_mm:g}:{board.dictionary}"
    return f"{start}:{board.marker_mm:g}:{board.cell_mm - board.marker_mm:g}:{board.dictionary}"


def cv_board(board: Board) -> Any:
    """OpenCV's ``CharucoBoard`` or ``GridBoard`` of a coded board, in mm."""
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
    """The same board. Raises InputError when no such board can exist."""
    columns, rows, minimum = board.columns, board.rows, 1 if board.kind == "grid" else 3
    if columns < minimum or rows < minimum or columns * rows > MAX_CELLS:
        raise InputError(
            f"board {text!r}: {columns}×{rows} cells, expected at least {minimum}×{minimum}, {MAX_CELLS} in all at most"
        )
    if board.is_coded and board.marker_mm >= board.cell_mm:
        raise InputError(
            f"board {text!r}: markers of {board.marker_mm:g} mm do not fit in cells of {board.cell_mm:g} mm"
        )
    return board
