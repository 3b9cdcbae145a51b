"""Points as a file holds them, and the limits within which files are read."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from arview.errors import InputError
from arview.geometry import Array

MAX_COORDINATE = 1e12
"""Largest coordinate in the file's unit; others stand for points that are not there."""
MAX_POINTS = 100_000_000
"""Points of a file; more are refused, with advice to thin them."""


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

    def __init__(self, path: Path) -> None:
        self._path = path
        self._origin: Array | None = None
        self._points: list[NDArray[np.float32]] = []
        self._normals: list[NDArray[np.float32]] = []
        self._count = self._broken = 0

    def add(self, points: NDArray[np.floating], normals: NDArray[np.floating] | None = None) -> None:
        """Add points (N,3) with their normals, if the file has any. Raises InputError above the limit."""
        finite = (np.abs(points) <= MAX_COORDINATE).all(axis=1)
        if not finite.all():
            self._broken += int(np.count_nonzero(~finite))
            points = points[finite]
            normals = None if normals is None else normals[finite]
        if len(points) == 0:
            return
        self._count += len(points)
        check_count(self._path, self._count)
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


def check_count(path: Path, count: int) -> None:
    """Raise InputError when a file holds more points than are read."""
    if count > MAX_POINTS:
        raise InputError(f"{path}: holds {count} points; at most {MAX_POINTS} are read: thin it first")
