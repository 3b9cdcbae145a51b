"""Cost of each step by the number of photos and of components, in CPU time and memory, in a process of its own each."""

from __future__ import annotations

import json
import multiprocessing
import resource
import tempfile
import time
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from threadpoolctl import threadpool_limits

from arview.cad import load_part
from arview.cad.model import Component, make_model
from arview.cad.part import ComponentSettings, Part
from arview.camera.read import load_camera
from arview.geometry import Array, apply, exp_so3
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.folder import read_cloud, read_folder
from arview.measurement.options import MeasureOptions
from arview.measurement.run import measure
from arview.reconstruction.run import ReconstructOptions, reconstruct
from recordings import ROOT

PLATE = ROOT / "samples" / "plate"
SCALE = 0.5
"""Size of the photos relative to the sample's."""
TURN_RAD = 0.03
"""Rotation of the camera about its centre that makes another photo of one of the sample's."""
PITCH_MM = 40.0
POINTS_EACH = 4000
"""Points of the cloud on and around each component."""


@dataclass
class StepClock:
    """CPU time by step, of all threads: a step lasts from the call that names it to the call that names another."""

    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    step: str = ""
    last: float = field(default_factory=time.process_time)

    def __call__(self, step: str, done: int = 0, total: int = 0) -> None:
        """Begin a step, which ends the one before."""
        now = time.process_time()
        self.seconds[self.step or step] += now - self.last
        self.step, self.last = step, now


@dataclass(frozen=True)
class Cost:
    """CPU seconds of each step, peak memory, and how much came out of it: photos placed or components within U."""

    seconds: dict[str, float]
    peak_mb: float
    good: int
    of: int


def photo_cost(count: int) -> Cost:
    """The way from ``count`` photos of the sample plate to the measurement without a dense cloud."""
    return _alone(_from_photos, count)


def component_cost(count: int) -> Cost:
    """The measurement of ``count`` components on a plate in a cloud whose place is known."""
    return _alone(_in_cloud, count)


def _alone(work: object, count: int) -> Cost:
    """The result of a function in a fresh process, so that peak memory is its own."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as process:
        return process.submit(work, count).result()  # type: ignore[arg-type]


def _from_photos(count: int) -> Cost:
    with tempfile.TemporaryDirectory() as folder:
        camera = write_photos(Path(folder) / "photos", count)
        part, out, clock = load_part(PLATE / "part.toml"), Path(folder) / "out", StepClock()
        options = ReconstructOptions(last_stage="scale")
        found = reconstruct(Path(folder) / "photos", out, part, str(camera), options, progress=clock)
        placed = len(found.sparse.photos) if found.sparse is not None else 0
        clock("measure in the photos")
        measure(read_folder(out, with_cloud=False), part, MeasureOptions(methods=("sweep", "edges")))
        clock("end")
    return _cost(clock, placed, count)


def write_photos(folder: Path, count: int) -> Path:
    """Write photos of the sample, and rotated ones of them, at a reduced size; the path of their camera file."""
    folder.mkdir(parents=True)
    camera = load_camera(str(PLATE / "camera.json"))
    small = camera.scaled(round(SCALE * camera.width), round(SCALE * camera.height))
    rows, columns = np.mgrid[0 : small.height, 0 : small.width]
    rays = small.unproject(np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64))
    paths = sorted((PLATE / "photos").glob("*.jpg"))
    for index in range(count):
        again, of_photo = divmod(index, len(paths))
        image = cv2.imread(str(paths[of_photo]))
        image = cv2.resize(image, (small.width, small.height), interpolation=cv2.INTER_AREA)
        if again:
            turn = exp_so3(TURN_RAD * again * np.array([np.cos(2.4 * index), np.sin(2.4 * index), 0.5]))
            at = small.project(rays @ turn.T).astype(np.float32).reshape(small.height, small.width, 2)
            image = cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
            noise = np.random.default_rng(index).normal(0.0, 2.0, image.shape)
            image = np.clip(image + noise, 0.0, 255.0).astype(np.uint8)
        cv2.imwrite(str(folder / f"img_{index:03d}.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 92])
    path = folder.parent / "camera.json"
    dist = [float(v) for v in small.dist]
    path.write_text(json.dumps({"width": small.width, "height": small.height, "fx": small.fx, "fy": small.fy,
                                "cx": small.cx, "cy": small.cy, "dist": dist}))  # fmt: skip
    return path


def _in_cloud(count: int) -> Cost:
    part, moves = plate_with_posts(count)
    clock = StepClock()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cloud.xyz"
        _write_cloud(path, part, moves)
        clock("read")
        found = read_cloud(path)
        placed = replace(found, scale=replace(found.scale, model_from_scan=np.eye(4)))
        with threadpool_limits(1, "blas"):
            inspection = measure(placed, part, MeasureOptions(methods=("cloud",)), progress=clock)
        clock("end")
    good = 0
    for one in inspection.components:
        if one.distance_mm is not None and one.uncertainty_mm is not None:
            displacement = np.array([v or 0.0 for v in one.displacement_mm])
            good += bool(np.linalg.norm(displacement - moves[one.name]) <= one.uncertainty_mm)
    return _cost(clock, good, count)


def plate_with_posts(count: int) -> tuple[Part, dict[str, Array]]:
    """A plate with ``count`` boxes on it, and by how much each is displaced, mm."""
    columns = int(np.ceil(np.sqrt(count)))
    size = 0.5 * PITCH_MM * (columns + 1)
    rng = np.random.default_rng(0)
    parts = [Component("plate", *_box((-size, -size, -8.0), (size, size, 0.0)))]
    moves: dict[str, Array] = {}
    for index in range(count):
        x, y = (PITCH_MM * (k - 0.5 * (columns - 1)) for k in divmod(index, columns))
        a, b, c = rng.uniform((6.0, 6.0, 15.0), (9.0, 9.0, 30.0))
        parts.append(Component(f"box_{index:03d}", *_box((x - a, y - b, 0.0), (x + a, y + b, c))))
        moves[parts[-1].name] = np.array([*rng.uniform(-0.8, 0.8, 2), 0.0])
    settings = tuple(ComponentSettings(c.name, "inspect" if c.name in moves else "base") for c in parts)
    return Part("boxes", Path("boxes"), Path("boxes"), make_model("boxes", tuple(parts)), settings), moves


def _box(low: tuple[float, ...], high: tuple[float, ...]) -> tuple[Array, np.ndarray]:
    corners = np.array([[(low, high)[(i >> k) & 1][k] for k in range(3)] for i in range(8)], dtype=np.float64)
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    return corners, np.array(faces, dtype=np.int32)


def _write_cloud(path: Path, part: Part, moves: dict[str, Array]) -> None:
    """Write points with 20 µm of noise of what is not below."""
    model = part.model
    vertices = [c.vertices_in_model + moves.get(c.name, np.zeros(3)) for c in model.components]
    surface = MeshSurface(np.concatenate(vertices), model.mesh[1], model.mesh[2])
    points, of_face = surface.spread(POINTS_EACH * len(moves))
    kept = surface.face_normals[of_face, 2] > -0.5
    on_plate = np.flatnonzero(kept & (surface.groups[of_face] == 0))
    others = MeshSurface(surface.vertices, model.mesh[1][model.mesh[2] != 0])
    kept[on_plate[others.closest(points[on_plate], 0.25).faces >= 0]] = False
    noise = np.random.default_rng(0).normal(0.0, 0.02, points.shape)
    np.savetxt(path, apply(np.eye(4), points + noise)[kept], fmt="%.4f")


def _cost(clock: StepClock, good: int, of: int) -> Cost:
    seconds = {name: value for name, value in clock.seconds.items() if name != "end"}
    return Cost(seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0, good, of)
