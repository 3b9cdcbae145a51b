"""Loading of CAD files: a `Model` of named components in millimetres."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from arview.cad.fitness import clean_mesh, wrong_winding
from arview.cad.formats.gltf import read_gltf
from arview.cad.formats.obj import read_obj
from arview.cad.formats.ply import read_ply
from arview.cad.formats.raw import UNIT_MM, RawComponent, RawModel, short_list, unique_names
from arview.cad.formats.step import read_step
from arview.cad.formats.stl import read_stl
from arview.cad.formats.threemf import read_3mf
from arview.cad.model import Component, Model, make_model
from arview.cad.view_range import Up
from arview.core.checks import PATH, check_type
from arview.core.plug_ins import find_plug_ins, load_plug_in, package_of
from arview.errors import InputError
from arview.geometry import Array

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

PLUG_INS = "arview.readers"
"""Entry points of other packages, named by the suffix that each reads, without its dot."""
READERS: dict[str, Callable[[Path], RawModel]] = {
    ".glb": read_gltf,
    ".gltf": read_gltf,
    ".obj": read_obj,
    ".stl": read_stl,
    ".ply": read_ply,
    ".3mf": read_3mf,
}
"""Readers by suffix; that of STEP takes tolerances, too."""
_STEP_SUFFIXES = (".step", ".stp", ".stpz")
_PACKED = (".zip", ".gz")
"""Suffixes of archives, in which only STEP is read."""
SUFFIXES = (*_STEP_SUFFIXES, *READERS)
MIN_SIZE_MM, MAX_SIZE_MM = 1.0, 100_000.0
"""Range of the diameter of a part, for files whose unit may be wrong."""
MIN_GIVEN_MM, MAX_GIVEN_MM = 0.1, 1_000_000.0
"""Range of the diameter of a part whose unit was given by the user."""
MIN_TOL_LINEAR_MM, MIN_TOL_ANGULAR_DEG = 1e-4, 0.1
"""Finest tolerances of the triangles of a STEP file."""
MAX_COORDINATE = 1e15
"""Coordinates beyond it are no geometry, and their squares overflow."""
MAX_FLAT_SHARE = 0.02
"""Share of triangles without area, or double ones, that is not told: the poles of spheres have a few."""
DEFAULT_COLOR = (0.6, 0.6, 0.62)
"""sRGB of components without a colour."""


@dataclass(frozen=True)
class LoadedCad:
    """A model and what its file says besides.

    Attributes:
        model: its components.
        unit_mm: unit of the file, mm.
        notes: remarks on renamed or empty nodes.
        up: axis that is up by the format.
        paths: of each component, its names in the assembly from the root on.
    """

    model: Model
    unit_mm: float
    notes: tuple[str, ...]
    up: Up = "z"
    paths: tuple[tuple[str, ...], ...] = ()


def load_model(
    path: str | Path, unit: str | None = None, *, tol_linear_mm: float = 0.1, tol_angular_deg: float = 10.0
) -> Model:
    """The model of a STEP, glTF, OBJ, STL, PLY or 3MF file, see `load_cad`, which also returns remarks."""
    check_type(path, PATH, "load_model: path")
    return load_cad(path, unit, tol_linear_mm, tol_angular_deg).model


@np.errstate(all="ignore")  # Numbers that overflow are refused with the vertices that are not finite.
def load_cad(
    path: str | Path, unit: str | None = None, tol_linear_mm: float = 0.1, tol_angular_deg: float = 10.0
) -> LoadedCad:
    """Read a CAD file: every mesh at its place in the file's root frame, in mm, under its own name.

    Args:
        path: .step .stp .stpz .glb .gltf .obj .stl .ply .3mf; STEP also as .gz or .zip.
        unit: "mm", "cm", "m" or "inch". Needed for OBJ, STL and PLY, which carry none. For the others it
            overrides the file's unit: the numbers in the file are then taken to be in ``unit``.
        tol_linear_mm: STEP only: largest distance of the triangles from the true surface, mm.
        tol_angular_deg: STEP only: largest angle between neighbouring triangles on a curved surface, deg.

    Returns:
        Components in the order of the file. Vertices closer than 1e-5 of a component's size are merged,
        degenerate and double triangles removed, closed surfaces wound outwards. Colours are sRGB.

    Raises:
        InputError: missing, empty, broken, truncated or unsupported file; a tolerance that is not positive or too
            fine; NaN vertices; no triangles; more than 5 million; no unit known; a size below 1 mm or above 100 m
            with no ``unit`` given, below 0.1 mm or above 1 km with one.
        MissingDependencyError: glTF with Draco compression without DracoPy.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if not path.exists():
        raise InputError(f"{path}: no such file")
    if not path.is_file():
        raise InputError(f"{path}: is not a file")
    if suffix not in (*SUFFIXES, *_PACKED) and suffix[1:] not in find_plug_ins(PLUG_INS):
        raise InputError(f"{path}: CAD of type {suffix or '(none)'!s} is not read; give one of {' '.join(SUFFIXES)}")
    if unit is not None and unit not in UNIT_MM:
        raise InputError(f"unit {unit!r} is not known; give one of {', '.join(UNIT_MM)}")
    check_step_tolerances(tol_linear_mm, tol_angular_deg)
    stem = Path(path.stem).stem if suffix in _PACKED else path.stem
    try:
        if path.stat().st_size == 0:
            raise InputError(f"{path}: the file is empty (0 bytes)")
        raw = _read(path, suffix, tol_linear_mm, tol_angular_deg, unit is not None)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    for component in raw.components:
        _check_finite(component, path)
    if raw.triangle_count == 0:
        raise InputError(f"{path}: {'; '.join(raw.notes) or 'holds no triangles (empty, or points and lines only)'}")
    factor_mm = _unit_factor(raw, path, unit)
    names, notes = unique_names([component.path for component in raw.components], stem, _places(raw))
    components, paths = [], []
    empty: list[str] = []
    turned: list[str] = []
    flat: list[str] = []
    for name, component in zip(names, raw.components, strict=True):
        vertices, faces = clean_mesh(component.vertices * factor_mm, component.faces)
        if len(faces) == 0:
            empty.append(name)
            continue
        color = component.color or DEFAULT_COLOR
        if wrong_winding(component.vertices * factor_mm, component.faces, vertices, faces):
            turned.append(name)
        if len(faces) < (1.0 - MAX_FLAT_SHARE) * len(component.faces):
            flat.append(name)
        paths.append(component.path)
        components.append(Component(name, vertices, faces.astype(np.int32), color))
    for names_told, text in (
        (empty, "left out, because they have no triangles of any area"),
        (turned, "triangles that faced inwards were turned"),
        (flat, "triangles without area, or that were there twice, were left out"),
    ):
        if names_told:
            notes.append(f"{text}: {short_list(names_told)}")
    if not components:
        raise InputError(f"{path}: all triangles are degenerate (they have no area)")
    model = make_model(stem, tuple(components))
    _check_size(model, path, unit is not None)
    return LoadedCad(model, factor_mm, tuple(raw.notes + notes), raw.up, tuple(paths))


def check_step_tolerances(tol_linear_mm: float, tol_angular_deg: float) -> None:
    """Raise InputError for tolerances of triangles that are not positive, or that no computer could keep."""
    for name, value, low, unit in (
        ("tol_linear_mm", tol_linear_mm, MIN_TOL_LINEAR_MM, "mm"),
        ("tol_angular_deg", tol_angular_deg, MIN_TOL_ANGULAR_DEG, "deg"),
    ):
        if not value > 0:
            raise InputError(f"{name} = {value:g}: tolerances must be positive")
        if not low <= value:
            raise InputError(f"{name} = {value:g} makes too many triangles; give at least {low:g} {unit}")


def _read(path: Path, suffix: str, tol_linear_mm: float, tol_angular_deg: float, is_overridden: bool) -> RawModel:
    if suffix in (*_STEP_SUFFIXES, *_PACKED):
        return read_step(path, tol_linear_mm, tol_angular_deg, is_overridden)
    if suffix in READERS:
        return READERS[suffix](path)
    return _read_by_plug_in(path, find_plug_ins(PLUG_INS)[suffix[1:]])


def _read_by_plug_in(path: Path, entry: EntryPoint) -> RawModel:
    """A file read by another package: pairs of a name and a `trimesh.Trimesh` in mm."""
    read, raw = load_plug_in(entry), RawModel(unit_mm=1.0)
    try:
        for name, mesh in read(path):
            vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
            raw.add(RawComponent((str(name),), vertices, faces), path)
    except InputError:
        raise
    except Exception as error:  # another package's code
        raise InputError(f"{path}: {package_of(entry)} cannot read it ({type(error).__name__}: {error})") from error
    return raw


def _check_finite(component: RawComponent, path: Path) -> None:
    bad = int(np.count_nonzero(~(np.abs(component.vertices) < MAX_COORDINATE).all(axis=1)))
    if bad:
        name = "/".join(component.path) or path.stem
        total = len(component.vertices)
        raise InputError(f"{path}: {bad} of {total} vertices of {name!r} are NaN or infinite; export it again")


def _places(raw: RawModel) -> Array:
    """(C,3) middles of the bounding boxes of the components; zero for those without triangles."""
    used = [mesh.vertices[np.unique(mesh.faces)] for mesh in raw.components]
    return np.array([0.5 * (v.min(axis=0) + v.max(axis=0)) if len(v) else np.zeros(3) for v in used])


def _bounding_size(raw: RawModel) -> Array:
    used = [component.vertices[np.unique(component.faces)] for component in raw.components if len(component.faces)]
    corners = np.concatenate([np.stack([v.min(axis=0), v.max(axis=0)]) for v in used])
    return np.asarray(np.ptp(corners, axis=0), dtype=np.float64)


def _size_text(size_mm: Array) -> str:
    """A size such as ``120 × 80 × 8 mm``, in metres from 10 m on."""
    factor, name = (1000.0, "m") if size_mm.max() >= 10_000 else (1.0, "mm")
    return " × ".join(f"{value:.4g}" for value in size_mm / factor) + f" {name}"


def _unit_factor(raw: RawModel, path: Path, unit: str | None) -> float:
    if unit is not None:
        return UNIT_MM[unit]
    if raw.unit_mm is not None:
        return raw.unit_mm
    size = _bounding_size(raw)
    choices = ", ".join(f"--unit {name} ({_size_text(size * mm)})" for name, mm in UNIT_MM.items())
    is_without = path.suffix.lower() in (".stl", ".obj", ".ply") or not raw.notes
    reason = f"{path.suffix[1:].upper()} files carry no unit" if is_without else "; ".join(raw.notes)
    raise InputError(f"{path}: which unit? {reason}; give {choices}")


def _check_size(model: Model, path: Path, is_unit_given: bool) -> None:
    low_mm, high_mm = (MIN_GIVEN_MM, MAX_GIVEN_MM) if is_unit_given else (MIN_SIZE_MM, MAX_SIZE_MM)
    if low_mm <= model.diameter_mm <= high_mm:
        return
    extent = _size_text(model.bounds_in_model[1] - model.bounds_in_model[0])
    raise InputError(
        f"{path}: is it really {extent}? If so, or if the file's unit is wrong, say which its numbers are in: "
        f"--unit {'|'.join(UNIT_MM)}"
    )
