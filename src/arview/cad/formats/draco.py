"""Reader of KHR_draco_mesh_compression: all meshes of a file are decoded in one process with limits."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.cad.formats.limited_process import HUNG, TIMED_OUT, ProcessLimits, run_limited
from arview.cad.formats.raw import MAX_TRIANGLES
from arview.core.extras import require
from arview.errors import InputError

EXTENSION = "KHR_draco_mesh_compression"
LIMITS = ProcessLimits(cpu_s=10.0, cpu_s_per_mb=5.0, max_cpu_s=120.0, memory_mb=1500.0, memory_mb_per_mb=60.0)

# Exit codes 3 and 4: a mesh that is broken, and too many triangles.
_DECODE = """
import sys
source, target, lengths, wanted, most = sys.argv[1:]
import numpy as np
import DracoPy
with open(source, "rb") as file:
    data = file.read()
arrays, start, left = {}, 0, int(most)
for index, (length, names) in enumerate(zip(lengths.split(","), wanted.split(";"))):
    try:
        mesh = DracoPy.decode(data[start : start + int(length)])
        faces = np.asarray(mesh.faces, dtype=np.uint32).reshape(-1, 3)
        found = {one["unique_id"]: np.asarray(one["data"]) for one in mesh.attributes}
    except Exception as error:
        print(index, type(error).__name__, error)
        sys.exit(3)
    left -= len(faces)
    if left < 0:
        sys.exit(4)
    arrays[f"{index}:faces"] = faces
    for item in names.split(","):
        name, _, number = item.rpartition("=")
        if int(number) in found:
            arrays[f"{index}:{name}"] = found[int(number)]
    start += int(length)
np.savez(target, **arrays)
"""


@dataclass(frozen=True)
class DracoMesh:
    """A decoded mesh: faces (F,3) and the wanted attributes (V,width) by their names in glTF."""

    faces: NDArray[np.int64]
    attributes: Mapping[str, NDArray[Any]]


def decode_draco(
    meshes: Sequence[tuple[bytes, Mapping[str, int]]], path: Path, limits: ProcessLimits = LIMITS
) -> list[DracoMesh]:
    """Decode meshes.

    Args:
        meshes: the data of each, and the numbers of its wanted attributes by their names in glTF.
        path: of the file, for messages.
        limits: of the process that decodes them.

    Raises:
        InputError: broken data, too many triangles, or too much time or memory.
        MissingDependencyError: without DracoPy.
    """
    require(f"{path}: Draco compression", "DracoPy")
    size_mb = sum(len(data) for data, _ in meshes) / 1e6
    with tempfile.TemporaryDirectory(prefix="arview-draco-") as name:
        folder = Path(name)
        source, target = folder / "meshes.drc", folder / "meshes.npz"
        source.write_bytes(b"".join(data for data, _ in meshes))
        lengths = ",".join(str(len(data)) for data, _ in meshes)
        wanted = ";".join(",".join(f"{key}={number}" for key, number in names.items()) for _, names in meshes)
        arguments = [str(source), str(target), lengths, wanted, str(MAX_TRIANGLES)]
        code, printed = run_limited(_DECODE, arguments, folder, size_mb, limits)
        if code == 4:
            raise InputError(f"{path}: more than {MAX_TRIANGLES:,} triangles; decimate the mesh")
        if code in (TIMED_OUT, HUNG, -9):
            raise InputError(
                f"{path}: its Draco data take more than {limits.cpu_of(size_mb):.0f} s of computing; export it without"
            )
        if code:
            reason = next(iter(printed.splitlines()[-1:]), "")[:120] if code == 3 else f"the decoder ended with {code}"
            raise InputError(f"{path}: broken or truncated Draco data ({reason}); export it again")
        with np.load(target) as arrays:
            found: list[dict[str, NDArray[Any]]] = [{} for _ in meshes]
            for key in arrays.files:
                index, _, what = key.partition(":")
                found[int(index)][what] = arrays[key]
    return [DracoMesh(one.pop("faces").astype(np.int64), one) for one in found]
