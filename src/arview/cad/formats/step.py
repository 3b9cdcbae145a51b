"""Reader of STEP: OpenCASCADE (cascadio) triangulates it in a process of its own, with limits of time and memory."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from arview.cad.formats.gltf import parse_gltf
from arview.cad.formats.raw import RawComponent, RawModel
from arview.cad.formats.step_text import prepare_step, step_unit_mm
from arview.errors import InputError, MissingDependencyError


@dataclass(frozen=True)
class StepLimits:
    """Limits of the process that reads a STEP file: fixed shares, and shares that grow with the size of the file.

    Attributes:
        cpu_s: seconds of computing.
        cpu_s_per_mb: further seconds for each megabyte.
        max_cpu_s: seconds at most.
        wall_factor: seconds of waiting for one of computing, on a machine that is shared.
        memory_mb: address space, MB, of which the libraries take 400.
        memory_mb_per_mb: further address space for each megabyte.
        output_mb: largest file of triangles, MB.
    """

    cpu_s: float = 5.0
    cpu_s_per_mb: float = 20.0
    max_cpu_s: float = 600.0
    wall_factor: float = 4.0
    memory_mb: float = 1500.0
    memory_mb_per_mb: float = 100.0
    output_mb: float = 1000.0


DEFAULT = StepLimits()
_OUT_OF_MEMORY = ("bad_alloc", "MemoryError", "failed to map", "Cannot allocate memory")

# OpenCASCADE writes to the terminal, and may abort on malformed files: it runs in a process of its own.
# trimesh, for which cascadio only registers a glTF extension, is left out, so that the process starts faster.
_STEP_TO_GLB = """
import sys
sys.modules["trimesh"] = None
source, target, linear, angular, cpu_s, memory, output = sys.argv[1:]
try:
    import resource
    for kind, limit in ((resource.RLIMIT_CPU, cpu_s), (resource.RLIMIT_AS, memory), (resource.RLIMIT_FSIZE, output)):
        hard = resource.getrlimit(kind)[1]
        limit = int(limit) if hard == resource.RLIM_INFINITY else min(int(limit), hard)
        resource.setrlimit(kind, (limit, limit))
except (ImportError, ValueError, OSError):
    pass
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
        path: of the file.
        tol_linear_mm: largest distance of the triangles from the surface, mm, whatever the unit of the file.
        tol_angular_deg: largest angle between neighbouring triangles, deg.
        is_overridden: return the numbers of the file, because their unit is given by the user.
        limits: of the process that reads it.

    Raises:
        InputError: a broken or truncated file, or one that takes too much time or memory.
        MissingDependencyError: without cascadio.
    """
    import importlib.util

    if importlib.util.find_spec("cascadio") is None:
        raise MissingDependencyError("reading STEP needs cascadio: pip install cascadio")
    data = path.read_bytes()
    prepared = prepare_step(data, path)
    raw = parse_gltf(_triangulated(prepared, path, tol_linear_mm, tol_angular_deg, limits), path)
    raw.up = "z"
    if is_overridden:
        factor = 1000.0 / step_unit_mm(data, path)
        for index, component in enumerate(raw.components):
            raw.components[index] = RawComponent(
                component.path, component.vertices * factor, component.faces, component.color
            )
    return raw


def _triangulated(data: bytes, path: Path, tol_linear_mm: float, tol_angular_deg: float, limits: StepLimits) -> bytes:
    """The GLB that OpenCASCADE makes of a STEP file."""
    size_mb = len(data) / 1e6
    cpu_s = min(limits.cpu_s + limits.cpu_s_per_mb * size_mb, limits.max_cpu_s)
    memory_mb = limits.memory_mb + limits.memory_mb_per_mb * size_mb
    with tempfile.TemporaryDirectory(prefix="arview-step-") as folder:
        source, target, log = (Path(folder) / name for name in ("source.step", "tessellated.glb", "log.txt"))
        source.write_bytes(data)
        numbers = [tol_linear_mm, float(np.deg2rad(tol_angular_deg)), np.ceil(cpu_s), 1e6 * memory_mb]
        arguments = [str(source), str(target), *(repr(float(value)) for value in numbers[:2])]
        arguments += [str(int(value)) for value in (*numbers[2:], 1e6 * limits.output_mb)]
        # Without the limit each thread reserves an arena of address space, which counts as memory.
        environment = {**os.environ, "MALLOC_ARENA_MAX": "2"}
        with log.open("wb") as output:
            try:
                code = subprocess.run(
                    [sys.executable, "-c", _STEP_TO_GLB, *arguments],
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    env=environment,
                    timeout=limits.wall_factor * cpu_s,
                ).returncode
            except subprocess.TimeoutExpired:
                code = -24
        glb = target.read_bytes() if target.is_file() and code == 0 else b""
        with log.open("rb") as output:
            printed = output.read(100_000).decode("utf-8", errors="replace")
    if code in (-24, -9):
        raise InputError(
            f"{path}: OpenCASCADE did not read it in {cpu_s:.0f} s of computing; is it broken? "
            "Else raise tol_linear_mm, or export simpler geometry"
        )
    if not glb:
        lines = re.sub(r"\x1b\[[0-9;]*m", "", printed).splitlines()
        reason = next((line.strip(" *") for line in lines if "ERR" in line), "")
        if not reason and any(word in printed for word in _OUT_OF_MEMORY):
            reason = f"it needs more than {memory_mb / 1000:.1f} GB of memory"
        reason = reason or (f"OpenCASCADE crashed, code {code}" if code else "no shape in it")
        raise InputError(f"{path}: broken or truncated STEP ({reason}); export it again")
    return glb
