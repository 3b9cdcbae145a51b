"""Time and memory of measuring a scanner's cloud, by its number of points, and whether the result is right."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from arview.cad import Part, load_part
from arview.geometry import Array, apply, exp_so3, rigid
from arview.inspection import load_inspection
from arview.measurement.cloud.mesh_surface import MeshSurface
from recordings import ROOT

PLATE = ROOT / "samples" / "plate"
SCAN_FROM_MODEL = rigid(exp_so3(np.array([0.2, -0.1, 0.65])), [210.0, -95.0, 430.0])
NOISE_MM = 0.02
BLOCK = 1_000_000
HIDDEN_MM = 0.25
"""The base is not scanned where it is nearer than this to something that stands on it."""


@dataclass(frozen=True)
class CloudCost:
    """What `arview measure --cloud` needed for one file, and how far its results are from the truth.

    Attributes:
        kind: suffix of the file.
        points: in it.
        cpu_s: CPU time of the whole command, all threads.
        peak_mb: its largest resident memory.
        measured, within: components that were measured, and those of them whose error is at most U.
        worst_mm: largest error.
        mean_u_mm: mean U.
    """

    kind: str
    points: int
    cpu_s: float
    peak_mb: float
    measured: int
    within: int
    worst_mm: float
    mean_u_mm: float


def cloud_costs(folder: Path, counts: tuple[int, ...], kinds: tuple[str, ...] = ("ply", "las")) -> Iterator[CloudCost]:
    """Measure clouds of the sample plate as built, with 20 µm of noise and in another frame, of each size and kind."""
    part = load_part(PLATE / "part.toml")
    truth = json.loads((PLATE / "truth.json").read_text())["truth"]
    for count in counts:
        for kind in kinds:
            path = folder / f"cloud_{count}.{kind}"
            written = write_scan(path, part, truth, count)
            yield measured(path, written, truth)
            path.unlink()


def write_scan(path: Path, part: Part, truth: dict[str, dict[str, object]], count: int) -> int:
    """Write a scan of a part as built, a block at a time; the number of points, about ``count``."""
    model = part.model
    _, faces, groups = model.mesh
    moves = {name: np.array(one["measured_from_nominal"]) for name, one in truth.items()}
    parts = [apply(moves.get(c.name, np.eye(4)), c.vertices_in_model) for c in model.components]
    surface = MeshSurface(np.concatenate(parts), faces, groups)
    base = [i for i, c in enumerate(model.components) if part.component_settings(c.name).role == "base"]
    others = MeshSurface(surface.vertices, faces[~np.isin(groups, base)])
    written, seed = 0, 0
    # What looks down, and what is hidden, is left out afterwards; the share that is left follows from a first sample.
    share = len(_seen(surface, others, base, 100_000, 0)[0]) / 100_000
    with _Writer(path, count) as out:
        while written < count:
            seed += 1
            drawn = min(BLOCK, round((count - written) / share * 1.02) + 50)
            points, normals = _seen(surface, others, base, drawn, seed)
            points, normals = points[: count - written], normals[: count - written]
            out.add(apply(SCAN_FROM_MODEL, points), normals @ SCAN_FROM_MODEL[:3, :3].T)
            written += len(points)
    return written


def _seen(surface: MeshSurface, others: MeshSurface, base: list[int], count: int, seed: int) -> tuple[Array, Array]:
    """Points with noise and normals of what a scanner above the part sees, of ``count`` that are drawn."""
    points, of_face = surface.spread(count, seed)
    normals = surface.face_normals[of_face]
    kept = normals[:, 2] > -0.5
    of_base = np.flatnonzero(kept & np.isin(surface.groups[of_face], base))
    kept[of_base[others.closest(points[of_base], HIDDEN_MM).faces >= 0]] = False
    rng = np.random.default_rng(seed)
    points, normals = points[kept], normals[kept]
    order = rng.permutation(len(points))
    return (points + rng.normal(0.0, NOISE_MM, points.shape))[order], normals[order]


class _Writer:
    """A binary PLY file with normals, or a LAS file, that grows by blocks."""

    def __init__(self, path: Path, count: int) -> None:
        self._path, self._count = path, count

    def __enter__(self) -> _Writer:
        if self._path.suffix == ".las":
            import laspy

            header = laspy.LasHeader(point_format=0, version="1.2")
            header.scales, header.offsets = np.full(3, 1e-4), np.zeros(3)
            self._las = laspy.open(self._path, "w", header=header)
        else:
            names = ("x", "y", "z", "nx", "ny", "nz")
            lines = ["ply", "format binary_little_endian 1.0", f"element vertex {self._count}"]
            lines += [*(f"property float {name}" for name in names), "end_header", ""]
            self._file = self._path.open("wb")
            self._file.write("\n".join(lines).encode())
        return self

    def add(self, points: Array, normals: Array) -> None:
        """Append points (N,3) with their normals."""
        if self._path.suffix != ".las":
            self._file.write(np.hstack([points, normals]).astype("<f4").tobytes())
            return
        import laspy

        record = laspy.ScaleAwarePointRecord.zeros(len(points), header=self._las.header)
        record.x, record.y, record.z = points.T
        self._las.write_points(record)

    def __exit__(self, *problem: object) -> None:
        (self._las if self._path.suffix == ".las" else self._file).close()


def measured(path: Path, count: int, truth: dict[str, dict[str, object]]) -> CloudCost:
    """Measure one cloud by the command, in a process of its own. Raises SystemExit when it fails."""
    result = path.with_suffix(".json")
    command = [sys.executable, "-m", "arview.cli", "measure", "--cloud", str(path), "--part", str(PLATE / "part.toml"),
               "-o", str(result)]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout is not None
    text = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if not result.is_file():
        raise SystemExit(f"{' '.join(command)} ended with code {process.returncode}:\n{text}")
    errors, u = [], []
    for one in load_inspection(result).components:
        if one.distance_mm is None or one.uncertainty_mm is None:
            continue
        displacement = np.array([0.0 if v is None else v for v in one.displacement_mm])
        errors.append(float(np.linalg.norm(displacement - np.array(truth[one.name]["displacement_mm"]))))
        u.append(one.uncertainty_mm)
    within = int(np.count_nonzero(np.array(errors) <= np.array(u)))
    return CloudCost(
        path.suffix[1:], count, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024.0, len(errors), within,
        max(errors), float(np.mean(u)),
    )  # fmt: skip
