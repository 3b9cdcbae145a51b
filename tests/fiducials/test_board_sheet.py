"""Printed boards: their lengths in the PDF, the page as OpenCV sees it, and boards that cannot be printed."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

from arview.errors import InputError
from arview.fiducials.board import cv_board, parse_board
from arview.fiducials.board_sheet import board_pdf, fit_board, parse_paper, place_board
from arview.geometry import Array

SPEC = "charuco:11x8:21:16:DICT_5X5_100"
MM_PER_PT = 25.4 / 72.0


def rectangles_in_pdf(content: bytes) -> tuple[Array, Array]:
    """Black and white rectangles (N,4) in mm on the page, y up, from the numbers of its content stream."""
    pypdf = pytest.importorskip("pypdf")
    import io

    page = pypdf.PdfReader(io.BytesIO(content)).pages[0]
    stack, matrix, color = [], np.eye(3), 0.0
    found: dict[float, list[list[float]]] = {0.0: [], 1.0: []}
    for operands, operator in pypdf.generic.ContentStream(page.get_contents(), None).operations:
        values = [float(v) for v in operands if isinstance(v, int | float | pypdf.generic.NumberObject)]
        if operator == b"q":
            stack.append(matrix)
        elif operator == b"Q":
            matrix = stack.pop()
        elif operator == b"cm":
            a, b, c, d, e, f = values
            matrix = np.array([[a, b, 0], [c, d, 0], [e, f, 1]]) @ matrix
        elif operator == b"rg":
            color = values[0]
        elif operator == b"re":
            x, y, width, height = values
            ends = np.array([[x, y, 1], [x + width, y + height, 1]]) @ matrix
            found[color].append([*(ends[0, :2] * MM_PER_PT), *(ends[1, :2] * MM_PER_PT)])
    return np.array(found[0.0]), np.array(found[1.0])


@pytest.mark.parametrize("spec", [SPEC, "charuco:6x9:25.4:19.05:DICT_4X4_50", "charuco:8x6:30:22:apriltag36h11"])
def test_the_numbers_of_the_pdf_are_exact(spec: str) -> None:
    board = parse_board(spec)
    sheet = place_board(board, (420.0, 297.0) if board.rows < 9 else (297.0, 420.0))
    black, _ = rectangles_in_pdf(board_pdf(sheet))
    size = np.abs(black[:, 2:] - black[:, :2])
    squares = size[:, 0] > 0.5 * (board.cell_mm + board.marker_mm)
    assert np.count_nonzero(~squares) == board.columns * board.rows // 2  # markers
    assert np.abs(size[squares] - board.cell_mm).max() < 1e-5
    assert np.abs(size[~squares] - board.marker_mm).max() < 1e-5
    # From the first to the last square: what a ruler on the print measures.
    ends = np.array([black[squares][:, [0, 2]].min(), black[squares][:, [0, 2]].max()])
    assert np.ptp(ends) == pytest.approx(board.columns * board.cell_mm, abs=1e-4)


@pytest.mark.skipif(shutil.which("pdftoppm") is None, reason="pdftoppm (poppler-utils) is not installed")
@pytest.mark.parametrize("paper", ["A4", "210x297"])
def test_the_printed_board_is_opencvs_board_in_true_scale(paper: str, tmp_path: Path) -> None:
    size = parse_paper(paper)
    board = fit_board(size)
    sheet = place_board(board, size)
    (tmp_path / "board.pdf").write_bytes(board_pdf(sheet))
    dpi = 200
    command = ["pdftoppm", "-r", str(dpi), "-gray", "-png", str(tmp_path / "board.pdf"), str(tmp_path / "board")]
    subprocess.run(command, check=True)
    gray = cv2.imread(str(next(tmp_path.glob("board*.png"))), cv2.IMREAD_GRAYSCALE)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(cv_board(board)).detectBoard(gray)
    assert len(ids) == (board.columns - 1) * (board.rows - 1)
    found_mm = (corners.reshape(-1, 2) + 0.5) * 25.4 / dpi
    places_mm = np.asarray(cv_board(board).getChessboardCorners())[ids.ravel(), :2]
    there_mm = places_mm + np.array([sheet.left_mm, sheet.top_mm])
    assert np.abs(found_mm - there_mm).max() < 0.05
    # Bit for bit what OpenCV would print.
    left, top = (round(v * dpi / 25.4) for v in (sheet.left_mm, sheet.top_mm))
    width, height = (round(n * board.cell_mm * dpi / 25.4) for n in (board.columns, board.rows))
    drawn = cv_board(board).generateImage((width, height))
    part = gray[top : top + height, left : left + width]
    assert np.mean(np.abs(part.astype(int) - drawn) > 127) < 0.01


def test_boards_that_cannot_be_printed_are_refused() -> None:
    with pytest.raises(InputError, match="there is room for"):
        place_board(parse_board("charuco:11x8:40:30:DICT_5X5_100"), parse_paper("A4"))
    with pytest.raises(InputError, match=r"needs 60 markers, DICT_4X4_50 has 50"):
        place_board(parse_board("charuco:12x10:15:11:DICT_4X4_50"), parse_paper("A4"))
    with pytest.raises(InputError, match="only ChArUco"):
        place_board(parse_board("grid:4x4:20:5:DICT_4X4_50"), parse_paper("A4"))
    with pytest.raises(InputError, match="smaller than 3 mm"):
        fit_board((100.0, 100.0), 40, 40)
    for text in ("A7", "10x10", "axb", "1e9x5"):
        with pytest.raises(InputError, match="paper"):
            parse_paper(text)
