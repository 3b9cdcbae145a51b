"""A ChArUco board as a page to print: PDF in true scale, with two rulers that show whether the printer kept it.

The page is drawn in millimetres: its content stream sets 72/25.4 pt as the unit once, so that every number after it is
a length on paper. Viewers are asked to print without scaling (PDF 1.7, 12.2 ViewerPreferences).
"""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from arview.core.extras import load
from arview.errors import InputError
from arview.fiducials.board import Board, cv_board, spec_of
from arview.geometry import Array

PAPERS_MM = {
    "A4": (297.0, 210.0),
    "A3": (420.0, 297.0),
    "A2": (594.0, 420.0),
    "A1": (841.0, 594.0),
    "A0": (1189.0, 841.0),
    "letter": (279.4, 215.9),
    "tabloid": (431.8, 279.4),
}
"""Width and height of sheets in landscape format."""
DICTIONARY = "DICT_5X5_100"
"""Default marker dictionary of printed boards."""
COLUMNS, ROWS = 11, 8
"""Default number of squares: many corners, with markers that are legible when the board fills half of a picture."""
_MARGIN_MM, _RULER_ROOM_MM = 10.0, 15.0
"""Margin that printers leave white, and room for rulers and text below and left of the board."""
_PT_PER_MM = 72.0 / 25.4
_TEXT_MM, _TICK_MM = 2.8, 3.0


@dataclass(frozen=True)
class Sheet:
    """A board on its page.

    Attributes:
        board: the board.
        width_mm, height_mm: of the page.
        left_mm, top_mm: upper left corner of the board, from that of the page.
        ruler_mm: length of the two rulers.
    """

    board: Board
    width_mm: float
    height_mm: float
    left_mm: float
    top_mm: float
    ruler_mm: float


def parse_paper(text: str) -> tuple[float, float]:
    """Width and height in mm of a paper in PAPERS_MM (landscape), or of ``WIDTHxHEIGHT``. Raises InputError."""
    known = {name.lower(): size for name, size in PAPERS_MM.items()}
    if text.strip().lower() in known:
        return known[text.strip().lower()]
    match = re.fullmatch(r"([\d.]+)x([\d.]+)", text.strip())
    try:
        width, height = (float(value) for value in match.groups()) if match else (0.0, 0.0)
    except ValueError:
        width = height = 0.0
    if not (60.0 <= width <= 5000.0 and 60.0 <= height <= 5000.0):
        raise InputError(f"paper {text!r}: expected {', '.join(PAPERS_MM)} or WIDTHxHEIGHT in mm, 60 to 5000")
    return width, height


def fit_board(
    paper_mm: tuple[float, float], columns: int | None = None, rows: int | None = None, dictionary: str = DICTIONARY
) -> Board:
    """The largest board with the given number of squares on a sheet; squares are whole mm, markers ¾ of that.

    Args:
        paper_mm: width and height of the sheet.
        columns, rows: number of squares; default COLUMNS and ROWS, exchanged on an upright sheet.
        dictionary: OpenCV's name of the marker dictionary.

    Raises:
        InputError: the squares would be smaller than 3 mm.
    """
    if columns is None or rows is None:
        upright = paper_mm[1] > paper_mm[0]
        columns, rows = columns or (ROWS if upright else COLUMNS), rows or (COLUMNS if upright else ROWS)
    width, height = _room(paper_mm)
    square = float(np.floor(min(width / columns, height / rows)))
    if square < 3.0:
        raise InputError(
            f"{columns}×{rows} squares on {paper_mm[0]:g}×{paper_mm[1]:g} mm would be smaller than 3 mm; take fewer"
            " squares or a larger sheet"
        )
    return Board("charuco", columns, rows, square, 0.5 * round(1.5 * square), dictionary)


def place_board(board: Board, paper_mm: tuple[float, float]) -> Sheet:
    """The board in the middle of the printable area, with rulers as long as fit.

    Raises:
        InputError: it is not a ChArUco board, does not fit, or its dictionary has too few markers.
    """
    if not board.is_charuco:
        raise InputError(
            f"{board}: only ChArUco boards are printed; their corners are exact, and they may be seen in part"
        )
    needed, known = board.columns * board.rows // 2, _markers_in(board.dictionary)
    if needed > known:
        raise InputError(f"{board}: needs {needed} markers, {board.dictionary} has {known}; take a larger dictionary")
    width, height = _room(paper_mm)
    across, down = board.columns * board.cell_mm, board.rows * board.cell_mm
    if across > width + 1e-9 or down > height + 1e-9:
        raise InputError(
            f"{board}: is {across:g}×{down:g} mm; on {paper_mm[0]:g}×{paper_mm[1]:g} mm there is room for"
            f" {width:g}×{height:g} mm; take a larger sheet or smaller squares"
        )
    left = _MARGIN_MM + _RULER_ROOM_MM + 0.5 * (width - across)
    top = _MARGIN_MM + 0.5 * (height - down)
    ruler = next(mm for mm in (500.0, 200.0, 100.0, 50.0, 20.0) if mm <= min(across, down) or mm == 20.0)
    return Sheet(board, *paper_mm, left, top, ruler)


def rectangles_mm(board: Board) -> tuple[Array, Array]:
    """Black (N,4) and, on top, white (M,4) rectangles (left, top, width, height), mm from the upper left corner.

    Squares without a marker are black; a marker is a black square with white bits.
    """
    import cv2

    drawn = cv_board(board)
    cell, side = board.cell_mm, board.marker_mm
    bits = int(drawn.getDictionary().markerSize) + 2  # with its black border
    markers = [
        (int(i), np.asarray(c, dtype=np.float64)[0, :2])
        for i, c in zip(drawn.getIds().ravel(), drawn.getObjPoints(), strict=True)
    ]
    white_squares = {(int(corner[0] // cell), int(corner[1] // cell)) for _, corner in markers}
    black = [
        (column * cell, row * cell, cell, cell)
        for row in range(board.rows)
        for column in range(board.columns)
        if (column, row) not in white_squares
    ]
    white = []
    for index, corner in markers:
        # OpenCV's corners are float32, so the exact position is computed from the square.
        left, top = np.floor(corner / cell) * cell + 0.5 * (cell - side)
        black.append((float(left), float(top), side, side))
        picture = np.pad(cv2.aruco.generateImageMarker(drawn.getDictionary(), index, bits) > 127, ((0, 0), (0, 1)))
        step = side / bits
        for row, line in enumerate(picture):
            edges = np.flatnonzero(np.diff(line.astype(int), prepend=0))
            white += [
                (float(left) + a * step, float(top) + row * step, (b - a) * step, step)
                for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
            ]
    return np.array(black), np.array(white)


def board_pdf(sheet: Sheet) -> bytes:
    """One page of PDF with the board, two rulers, and the command line for ``arview calibrate``."""
    pydyf = load("the PDF of a board", "pydyf")

    stream = pydyf.Stream(compress=False)
    stream.set_matrix(_PT_PER_MM, 0, 0, _PT_PER_MM, 0, 0)
    stream.push_state()
    # Origin at the board's corner, y down.
    stream.set_matrix(1, 0, 0, -1, sheet.left_mm, sheet.height_mm - sheet.top_mm)
    for gray, rectangles in zip((0, 1), rectangles_mm(sheet.board), strict=True):
        stream.set_color_rgb(gray, gray, gray)
        for rectangle in rectangles:  # one path, so that no hairlines appear between neighbours
            stream.rectangle(*(_short(value) for value in rectangle))
        stream.fill()
    stream.pop_state()
    _draw_rulers(stream, sheet)
    pdf = pydyf.PDF()
    pdf.add_object(stream)
    font = pydyf.Dictionary(
        {
            "Type": "/Font",
            "Subtype": "/Type1",
            "BaseFont": "/Helvetica",
            "Encoding": "/WinAnsiEncoding",
        }
    )
    pdf.add_object(font)
    page = pydyf.Dictionary(
        {
            "Type": "/Page",
            "Parent": pdf.pages.reference,
            "Contents": stream.reference,
            "MediaBox": pydyf.Array([0, 0, _short(sheet.width_mm * _PT_PER_MM), _short(sheet.height_mm * _PT_PER_MM)]),
            "Resources": pydyf.Dictionary({"Font": pydyf.Dictionary({"F1": font.reference})}),
        }
    )
    pdf.add_page(page)
    pdf.catalog["ViewerPreferences"] = pydyf.Dictionary({"PrintScaling": "/None"})
    pdf.info["Title"] = pydyf.String(f"ChArUco board {spec_of(sheet.board)}")
    out = io.BytesIO()
    pdf.write(out)
    return out.getvalue()


def _draw_rulers(stream: Any, sheet: Sheet) -> None:
    """A ruler below the board and one left of it, with text."""
    board, length = sheet.board, sheet.ruler_mm
    bottom = sheet.height_mm - sheet.top_mm - board.rows * board.cell_mm
    stream.set_color_rgb(0, 0, 0)
    stream.set_color_rgb(0, 0, 0, stroke=True)
    stream.set_line_width(0.15)
    lines = (
        f"arview calibrate PHOTOS --board {spec_of(board)}   {board}",
        f"Print at 100 % (actual size), glue it on something flat. Both rulers must measure {length:g} mm;"
        " else give the measured squares with --board.",
    )
    for turn, (x, y) in enumerate(((sheet.left_mm, bottom - 3.0), (sheet.left_mm - 3.0, bottom))):
        stream.push_state()
        stream.set_matrix(*((1, 0, 0, 1) if turn == 0 else (0, 1, -1, 0)), _short(x), _short(y))
        stream.move_to(0, 0)
        stream.line_to(_short(length), 0)
        for mm in range(int(length) + 1):
            tick = _TICK_MM * (1.0 if mm % 10 == 0 else 0.7 if mm % 5 == 0 else 0.4)
            stream.move_to(mm, 0)
            stream.line_to(mm, _short(-tick if turn == 0 else tick))
        stream.stroke()
        side = -1.0 if turn == 0 else 1.0
        _write(stream, f"{length:g} mm", length + 2.0, -0.5 * _TEXT_MM if turn == 0 else 0.5)
        if turn == 0:
            for k, text in enumerate(lines):
                _write(stream, text, 0.0, side * (_TICK_MM + (k + 1) * 1.35 * _TEXT_MM))
        stream.pop_state()


def _write(stream: Any, text: str, x: float, y: float) -> None:
    """Write text at (x, y) mm."""
    escaped = re.sub(r"([\\()])", r"\\\1", text).encode("cp1252", "replace")
    stream.begin_text()
    stream.set_font_size("F1", _TEXT_MM)
    stream.move_text_to(_short(x), _short(y))
    stream.stream.append(b"(" + escaped + b") Tj")
    stream.end_text()


def _room(paper_mm: tuple[float, float]) -> tuple[float, float]:
    """Width and height of the printable area for the board, mm."""
    return paper_mm[0] - 2.0 * _MARGIN_MM - _RULER_ROOM_MM, paper_mm[1] - 2.0 * _MARGIN_MM - _RULER_ROOM_MM


def _markers_in(dictionary: str) -> int:
    """Number of markers in a dictionary."""
    import cv2

    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    return int(known.bytesList.shape[0])


def _short(value: float) -> float:
    """The value rounded to a nanometre, which PDF readers can represent."""
    return round(float(value), 6)
