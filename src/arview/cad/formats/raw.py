"""Results of the readers of CAD files: triangles with name paths in the unit of the file, and names of units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from unicodedata import category

import numpy as np
from numpy.typing import NDArray

from arview.cad.view_range import Up
from arview.errors import InputError
from arview.geometry import Array

MAX_TRIANGLES = 5_000_000
"""Largest number of triangles of a file."""

MAX_INSTANCES = 10_000
"""Largest number of components and assemblies of a file, each counted as often as it is placed."""

SAME_PLACE = 1e-3
"""Difference of coordinates, as a share of what equal components span, below which these are taken for the same."""

UNIT_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}
"""Units that a user may name, in mm."""

LEFT_OUT_HIDDEN = "left out, because the %s file hides them (show and export them to have them)"

_ALIASES_MM = {
    "micron": 0.001,
    "millimeter": 1.0,
    "millimetre": 1.0,
    "centimeter": 10.0,
    "centimetre": 10.0,
    "decimeter": 100.0,
    "meter": 1000.0,
    "metre": 1000.0,
    "in": 25.4,
    "inche": 25.4,
    "ft": 304.8,
    "foot": 304.8,
    "feet": 304.8,
}


@dataclass(frozen=True)
class RawComponent:
    """One mesh of a file at its place.

    Attributes:
        path: names from the root to the mesh, without empty ones.
        vertices: (V,3) float64 in the unit of the file, nested transforms applied.
        faces: (F,3) int64, counter-clockwise seen from outside, if the file is right.
        color: sRGB in 0–1; None when the file has none.
    """

    path: tuple[str, ...]
    vertices: Array
    faces: NDArray[np.int64]
    color: tuple[float, float, float] | None = None


@dataclass
class RawModel:
    """The content of a file: its meshes, unit in mm (None when it has none), remarks for the user, and up axis."""

    components: list[RawComponent] = field(default_factory=list)
    unit_mm: float | None = None
    notes: list[str] = field(default_factory=list)
    triangle_count: int = 0
    up: Up = "z"

    def add(self, component: RawComponent, path: Path, root_from_mesh: Array | None = None) -> None:
        """Append a component, placed by an affine transform (4,4); a reflection reverses the winding of its faces.

        Raises:
            InputError: a triangle refers to a vertex that does not exist, or beyond MAX_TRIANGLES.
        """
        vertices, faces = component.vertices, component.faces
        self.triangle_count += len(faces)
        check_triangle_count(self.triangle_count, path)
        if len(faces) and not 0 <= faces.min() <= faces.max() < len(vertices):
            name = "/".join(component.path) or path.stem
            raise InputError(
                f"{path}: broken: a triangle of {name!r} refers to a vertex that does not exist; export it again"
            )
        if root_from_mesh is not None:
            if np.linalg.det(root_from_mesh[:3, :3]) < 0:
                faces = faces[:, ::-1]
            vertices = vertices @ root_from_mesh[:3, :3].T + root_from_mesh[:3, 3]
        self.components.append(replace(component, vertices=vertices, faces=faces))
        check_instance_count(len(self.components), path)


def check_triangle_count(count: int, path: Path) -> None:
    """Raise InputError when a file holds more than MAX_TRIANGLES."""
    if count > MAX_TRIANGLES:
        raise InputError(
            f"{path}: more than {MAX_TRIANGLES:,} triangles; decimate the mesh or export it with a coarser "
            "tolerance (for STEP: a larger tol_linear_mm); about 100,000 are plenty for tracking"
        )


def check_instance_count(count: int, path: Path) -> None:
    """Raise InputError when a file places more than MAX_INSTANCES components and assemblies."""
    if count > MAX_INSTANCES:
        raise InputError(
            f"{path}: more than {MAX_INSTANCES:,} components, counted as often as they are placed; "
            "export the part without what need not be inspected"
        )


def unit_in_mm(name: str) -> float | None:
    """Length in mm of a unit by its name in a file; None when the name is unknown."""
    key = name.strip().lower()
    singular = key[:-1] if key.endswith("s") else key
    known = UNIT_MM | _ALIASES_MM
    return known.get(key, known.get(singular))


def _printable(name: str) -> str:
    """A name without control characters and line breaks, which neither labels nor tables can show."""
    if name.isprintable():
        return name
    return "".join(" " if category(letter) in ("Cc", "Zl", "Zp") else letter for letter in name).strip()


def short_list(names: Sequence[str]) -> str:
    """The first four names, and how many there are besides."""
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")


def unique_names(
    paths: list[tuple[str, ...]], fallback: str, places: Array | None = None
) -> tuple[list[str], list[str]]:
    """A unique name for every name path, and a note for each name that had to be changed.

    The last name of a path is used when no other component has it. Otherwise as many parents are prepended
    (``sub_1/post``) as distinguish all components of that name, or they are numbered by their places, which stay when
    the CAD is exported again, as the order of the file need not.

    Args:
        paths: names of each component from the root on.
        fallback: name of components without any.
        places: (C,3) of the components, in any unit; None for the order of the file.
    """
    printable = [tuple(_printable(name) for name in path) for path in paths]
    notes: list[str] = []
    if changed := sum(path != shown for path, shown in zip(paths, printable, strict=True)):
        notes.append(f"control characters in the names of {changed} components were replaced by spaces")
    paths = [tuple(name for name in path if name) or (fallback,) for path in printable]
    names = [path[-1] for path in paths]
    indices: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        indices.setdefault(name, []).append(i)
    for name, same in indices.items():
        deepest = max(len(paths[i]) for i in same) if len(same) > 1 else 0
        by_depth = (["/".join(paths[i][-depth:]) for i in same] for depth in range(2, deepest + 1))
        candidates = next((longer for longer in by_depth if len(set(longer)) == len(longer)), None)
        if candidates is not None:
            notes.append(f"{len(same)} components are named {name!r}: called {', '.join(candidates[:4])}")
            for i, candidate in zip(same, candidates, strict=True):
                names[i] = candidate
    taken: set[str] = set()
    given = set(names)
    last_number: dict[str, int] = {}
    renamed: dict[str, list[str]] = {}
    for i in (i for same in indices.values() for i in (same if places is None else _by_place(same, places))):
        name = names[i]
        number, unique = last_number.get(name, 1), name
        while unique in taken or (number > 1 and unique in given):
            number += 1
            unique = f"{name}_{number}"
        last_number[name] = number
        if unique != name:
            renamed.setdefault(name, []).append(unique)
        taken.add(unique)
        names[i] = unique
    for name, others in renamed.items():
        which = f"{len(others)} more components are" if len(others) > 1 else "another component is"
        notes.append(f"{which} named {name!r}: called {short_list(others)}")
    return names, notes


def _by_place(indices: list[int], places: Array) -> list[int]:
    """Indices of components in the order of their places along x, y and z, whatever the noise of an export is."""
    points = places[indices]
    order = np.argsort(points, axis=0, kind="stable")
    ranked = np.take_along_axis(points, order, axis=0)
    steps = np.diff(ranked, axis=0, prepend=ranked[:1]) > SAME_PLACE * np.ptp(points, axis=0).max()
    levels = np.take_along_axis(np.cumsum(steps, axis=0), np.argsort(order, axis=0), axis=0)
    return [indices[k] for k in np.lexsort(levels.T[::-1])]
