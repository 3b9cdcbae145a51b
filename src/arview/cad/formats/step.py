"""Reader of STEP: OpenCASCADE (cascadio) triangulates it in a process of its own, with limits of time and memory."""

from __future__ import annotations

import re
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from arview.cad.formats.archive import unpacked
from arview.cad.formats.gltf import parse_gltf
from arview.cad.formats.limited_process import HUNG, IDLE_S, TIMED_OUT, ProcessLimits, run_limited
from arview.cad.formats.raw import RawModel
from arview.cad.formats.step_scene import HIDDEN
from arview.cad.formats.step_text import prepare_step, step_unit_mm
from arview.errors import InputError

StepLimits = ProcessLimits
DEFAULT = StepLimits()
_PLACEHOLDER_NAME = re.compile(r"Open ?CASCADE STEP translator [\d. ]+|NONE|=>\[[\d:]+\]", re.IGNORECASE)
"""Names that writers give to products that have none."""
_ANALYSIS = re.compile(rb"FILE_SCHEMA\s*\(\s*\(\s*'(?:AP209|STRUCTURAL_ANALYSIS_DESIGN)", re.IGNORECASE)
_USUAL_TOL_MM, _USUAL_TOL_DEG = 0.01, 1.0
"""Tolerances below these are named in a message when the triangulation fails."""
_OUT_OF_MEMORY = ("bad_alloc", "MemoryError", "failed to map", "Cannot allocate memory")

# trimesh, for which cascadio only registers a glTF extension, is left out, so that the process starts faster.
_STEP_TO_GLB = """
sys.modules["trimesh"] = None
source, target, linear, angular = sys.argv[1:]
import cascadio
with open(source, "rb") as f: step = f.read()
glb = cascadio.load(step, file_type="step", tol_linear=float(linear), tol_angular=float(angular))
with open(target, "wb") as f: f.write(glb)
"""


def read_step(
    path: Path, tol_linear_mm: float, tol_angular_deg: float, is_overridden: bool, limits: StepLimits = DEFAULT
) -> RawModel:
    """Components of a STEP file: its products and, where a product has several named solids, those.

    Args:
        path: of the file, which may be packed by gzip or zip.
        tol_linear_mm: largest distance of the triangles from the surface, mm, whatever the unit of the file.
        tol_angular_deg: largest angle between neighbouring triangles, deg.
        is_overridden: return the numbers of the file, because their unit is given by the user.
        limits: of the process that reads it.

    Raises:
        InputError: a broken or truncated file, or one that takes too much time or memory.
    """
    data = unpacked(path)
    prepared, notes = prepare_step(data, path)
    raw = parse_gltf(_triangulated(prepared, path, tol_linear_mm, tol_angular_deg, limits), path)
    raw.up = "z"
    raw.components = [mesh for mesh in raw.components if HIDDEN not in mesh.path]
    raw.triangle_count = sum(len(mesh.faces) for mesh in raw.components)
    factor = 1000.0 / step_unit_mm(data, path) if is_overridden else 1.0
    for index, mesh in enumerate(raw.components):
        named = tuple(name for name in mesh.path if not _PLACEHOLDER_NAME.fullmatch(name.strip()))
        raw.components[index] = replace(mesh, path=named, vertices=mesh.vertices * factor)
    raw.notes += notes
    if not raw.triangle_count and _ANALYSIS.search(data[:8192]):
        raw.notes.append("AP209, a model for finite elements, holds no shape; export AP214 or AP242")
    return raw


def _triangulated(data: bytes, path: Path, tol_linear_mm: float, tol_angular_deg: float, limits: StepLimits) -> bytes:
    """The GLB that OpenCASCADE makes of a STEP file."""
    size_mb = len(data) / 1e6
    with tempfile.TemporaryDirectory(prefix="arview-step-") as name:
        folder = Path(name)
        source, target = folder / "source.step", folder / "tessellated.glb"
        source.write_bytes(data)
        numbers = [repr(float(tol_linear_mm)), repr(float(np.deg2rad(tol_angular_deg)))]
        is_fine = tol_linear_mm < _USUAL_TOL_MM or tol_angular_deg < _USUAL_TOL_DEG
        code, printed = run_limited(_STEP_TO_GLB, [str(source), str(target), *numbers], folder, size_mb, limits)
        glb = target.read_bytes() if target.is_file() and code == 0 else b""
    if code == HUNG:
        raise InputError(f"{path}: OpenCASCADE did nothing for {IDLE_S:.0f} s and was ended; try again")
    if is_fine and (code or not glb):
        raise InputError(
            f"{path}: OpenCASCADE could not triangulate it with tol_linear_mm = {tol_linear_mm:g}, tol_angular_deg = "
            f"{tol_angular_deg:g}; raise them (0.1 and 10 are usual)"
        )
    if code in (TIMED_OUT, -9):
        raise InputError(
            f"{path}: OpenCASCADE did not read it in {limits.cpu_of(size_mb):.0f} s of computing; is it broken? "
            "Else raise tol_linear_mm, or export simpler geometry"
        )
    if not glb:
        lines = re.sub(r"\x1b\[[0-9;]*m", "", printed).splitlines()
        reason = next((line.strip(" *") for line in lines if "ERR" in line), "")
        if not reason and any(word in printed for word in _OUT_OF_MEMORY):
            reason = f"it needs more than {limits.memory_of(size_mb) / 1000:.1f} GB of memory"
        reason = reason or (f"OpenCASCADE crashed, code {code}" if code else "no shape in it")
        if _ANALYSIS.search(data[:8192]):
            raise InputError(f"{path}: AP209, a model for finite elements, holds no shape; export AP214 or AP242")
        raise InputError(f"{path}: broken or truncated STEP ({reason}); export it again")
    return glb
