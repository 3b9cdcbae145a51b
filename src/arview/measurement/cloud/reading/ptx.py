"""Clouds as PTX: scans of several stations, each a grid of points with the matrix that brings them into one frame."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import TextIO

import numpy as np

from arview.errors import InputError
from arview.geometry import Array
from arview.measurement.cloud.reading.raw_points import PointCollector, RawPoints, check_count

CHUNK_LINES = 1_000_000
"""Lines that are parsed at a time."""
_HEADER = (3, 3, 3, 3, 4, 4, 4, 4)
"""Numbers in the lines after the size of the grid: place and axes of the scanner, then the matrix."""
MAX_SKEW = 1e-3
"""Largest deviation of a matrix from a rigid motion: it is written with six digits or more."""


def read_ptx(path: Path) -> RawPoints:
    """All scans of a PTX file in their common frame; a point at 0 0 0 is a ray without a return.

    Raises:
        InputError: a header or a line of points is damaged, or lines are missing.
    """
    collector = PointCollector(path)
    stations = total = 0
    with path.open(encoding="latin-1") as file:
        while (first := next((line for line in file if line.strip()), None)) is not None:
            stations += 1
            where = f"{path}: scan {stations}"
            count = _whole(where, first) * _whole(where, file.readline())
            total += count
            check_count(path, total)
            if 6 * count > path.stat().st_size:
                raise InputError(f"{where} is truncated: its header names {count} points")
            matrix = _matrix(where, file)
            for start in range(0, count, CHUNK_LINES):
                lines = list(islice(file, min(CHUNK_LINES, count - start)))
                points = _points(where, lines)
                if len(points) < min(CHUNK_LINES, count - start):
                    raise InputError(f"{where} is truncated: its header names {count} points")
                points = points[points.any(axis=1)]
                collector.add(points @ matrix[:3, :3] + matrix[3, :3])
    return collector.result()


def _whole(where: str, line: str) -> int:
    """Number of columns or rows of a scan. Raises InputError."""
    word = line.strip()
    if not word.isdecimal() or len(word) > 9:
        raise InputError(f"{where}: {word[:30]!r} is no number of columns or rows of a PTX file")
    return int(word)


def _matrix(where: str, file: TextIO) -> Array:
    """(4,4) matrix of a scan, for points as rows. Raises InputError unless it is a rigid motion."""
    try:
        rows = [[float(word) for word in file.readline().split()] for _ in _HEADER]
    except ValueError as error:
        raise InputError(f"{where}: its header is damaged ({error})") from error
    if tuple(len(row) for row in rows) != _HEADER or not np.isfinite(rows[4:]).all():
        raise InputError(f"{where}: its header is damaged; expected place, three axes and a matrix of 4 × 4 numbers")
    matrix = np.array(rows[4:])
    rotation = matrix[:3, :3]
    is_rigid = np.abs(rotation @ rotation.T - np.eye(3)).max() < MAX_SKEW and np.linalg.det(rotation) > 0.0
    if not is_rigid or np.abs(matrix[:, 3] - [0.0, 0.0, 0.0, 1.0]).max() > MAX_SKEW:
        raise InputError(f"{where}: its matrix is no rigid motion; export the scan again")
    return matrix


def _points(where: str, lines: list[str]) -> Array:
    """(N,3) of lines of points. Raises InputError."""
    try:
        return np.loadtxt(lines, usecols=(0, 1, 2), ndmin=2, comments=None) if lines else np.zeros((0, 3))
    except (ValueError, IndexError) as error:
        raise InputError(f"{where}: a line of points is damaged ({str(error).split(';')[0]})") from error
