"""Points as a file holds them, and the limits within which files are read."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from arview.errors import InputError
from arview.geometry import Array


@dataclass(frozen=True)
class ReadOptions:
    """Limits of reading; they keep damaged or hostile files from filling the memory."""

    max_coordinate: float = 1e12  # largest coordinate in the file's unit; others stand for points that are not there
    max_points: int = 100_000_000  # points of a file; more are refused, with advice to thin them
    max_header_bytes: int = 65_536  # length of the header of a PLY or PCD file
    max_columns: int = 64  # numbers in a line of a text file
    max_header_lines: int = 200  # lines before the first point of a text file
    max_bad_share: float = 0.01  # share of lines of a text file that may be unreadable
    min_bad_lines: int = 10  # unreadable lines that are tolerated in any text file
    block_bytes: int = 16_000_000  # part of a text file that is parsed at a time
    chunk_points: int = 2_000_000  # points of a LAS file that are decoded at a time


@dataclass(frozen=True)
class RawPoints:
    """Points of a file in its own unit.

    Attributes:
        points: (N,3) float32, all finite, relative to ``origin``: single precision suffices once large offsets, as of
            surveyed coordinates, are subtracted.
        normals: (N,3) float32 as the file has them, or None.
        origin: (3,) float64.
        unit: name of the unit that the file declares, or None.
        notes: what was left out while reading.
    """

    points: NDArray[np.float32]
    normals: NDArray[np.float32] | None
    origin: Array
    unit: str | None = None
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.points)


class PointCollector:
    """Gathers chunks of points in single precision relative to the first one."""

    def __init__(self, path: Path, options: ReadOptions) -> None:
        self._path, self._options = path, options
        self._origin: Array | None = None
        self._points: list[NDArray[np.float32]] = []
        self._normals: list[NDArray[np.float32]] = []
        self._count = self._broken = 0

    def add(self, points: NDArray[np.floating], normals: NDArray[np.floating] | None = None) -> None:
        """Add points (N,3) with their normals, if the file has any. Raises InputError above the limit."""
        finite = (np.abs(points) <= self._options.max_coordinate).all(axis=1)
        if not finite.all():
            self._broken += int(np.count_nonzero(~finite))
            points = points[finite]
            normals = None if normals is None else normals[finite]
        if len(points) == 0:
            return
        self._count += len(points)
        check_count(self._path, self._count, self._options)
        if self._origin is None:
            self._origin = np.asarray(points[0], dtype=np.float64)
        self._points.append((points - self._origin.astype(points.dtype)).astype(np.float32))
        if normals is not None:
            self._normals.append(np.nan_to_num(np.asarray(normals, dtype=np.float32)))

    def result(self, unit: str | None = None, notes: tuple[str, ...] = ()) -> RawPoints:
        """All points. Raises InputError when there is none."""
        if self._origin is None:
            raise InputError(f"{self._path}: holds no points with sensible coordinates")
        normals = np.concatenate(self._normals) if self._normals else None
        points = np.concatenate(self._points)
        self._points, self._normals = [], []
        raw = RawPoints(points, normals if normals is None or len(normals) == len(points) else None, self._origin, unit)
        if self._broken:
            notes = (*notes, f"{self._broken} points without sensible coordinates were left out")
        return replace(raw, notes=notes)


def check_count(path: Path, count: int, options: ReadOptions) -> None:
    """Raise InputError when a file holds more points than are read."""
    if count > options.max_points:
        raise InputError(f"{path}: holds {count} points; at most {options.max_points} are read: thin it first")
