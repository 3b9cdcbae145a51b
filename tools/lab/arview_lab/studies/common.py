"""Simulated posts, parallel runs and output files that the studies share."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from arview.core.atomic import replacing
from arview.errors import OutputError
from arview.geometry import Array
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.cloud.registration import RegistrationOptions
from arview_lab.chart import Picture, save_picture

T = TypeVar("T")
R = TypeVar("R")
POST_MM = (16.0, 40.0)
"""Diameter and height of the first post."""
SECOND_POST_MM = (20.0, 25.0)
"""Diameter and height of the second post."""
SECTIONS = 96
"""Sides of the prism that represents a post. Points are sampled from the prism itself, so this is not an error."""
EXACT = RegistrationOptions(noise_points=0)
"""Options without a noise estimate: only the position is needed, not its covariance."""


@dataclass(frozen=True)
class Study:
    """Result of a study.

    Attributes:
        name: of the study and its picture.
        tables: columns and rows by file name.
        picture: (H,W,3) uint8 RGB.
        summary: its findings in a few lines.
    """

    name: str
    tables: dict[str, tuple[tuple[str, ...], list[tuple[object, ...]]]]
    picture: Picture
    summary: tuple[str, ...]


def post(size_mm: tuple[float, float] = POST_MM) -> tuple[MeshSurface, Array]:
    """An upright closed post on z = 0, and its centre (3,)."""
    radius, height = 0.5 * size_mm[0], size_mm[1]
    angles = np.arange(SECTIONS) * 2.0 * np.pi / SECTIONS
    ring = np.stack([radius * np.cos(angles), radius * np.sin(angles), np.zeros(SECTIONS)], axis=1)
    vertices = np.concatenate([ring, ring + np.array([0.0, 0.0, height]), [[0.0, 0.0, 0.0], [0.0, 0.0, height]]])
    i = np.arange(SECTIONS)
    j, n = (i + 1) % SECTIONS, SECTIONS
    faces = np.concatenate([
        np.stack([i, j, j + n], axis=1), np.stack([i, j + n, i + n], axis=1),
        np.stack([j, i, np.full(n, 2 * n)], axis=1), np.stack([i + n, j + n, np.full(n, 2 * n + 1)], axis=1),
    ])  # fmt: skip
    return MeshSurface(vertices, faces), np.array([0.0, 0.0, 0.5 * height])


def sideways(angle_rad: float, length_mm: float) -> Array:
    """(3,) translation in the plane of the plate."""
    return length_mm * np.array([np.cos(angle_rad), np.sin(angle_rad), 0.0])


def over_cores(work: Callable[[T], R], items: Sequence[T]) -> list[R]:
    """Results of a function for each item, computed on all cores."""
    with ThreadPoolExecutor(max(1, os.cpu_count() or 1)) as threads:
        return list(threads.map(work, items))


def write_study(study: Study, folder: Path) -> list[Path]:
    """Write the tables as CSV and the picture as PNG; return their paths. Raises OutputError."""
    paths = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, (columns, rows) in study.tables.items():
            text = io.StringIO()
            writer = csv.writer(text, lineterminator="\n")
            writer.writerow(columns)
            writer.writerows([[f"{v:.6g}" if isinstance(v, float) else v for v in row] for row in rows])
            paths.append(folder / f"{name}.csv")
            with replacing(paths[-1]) as file:
                file.write(text.getvalue().encode())
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written ({error.strerror or error})") from error
    paths.append(folder / f"{study.name}.png")
    save_picture(study.picture, paths[-1])
    return paths
