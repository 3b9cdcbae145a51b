"""Cost of each step by what grows, in CPU time and memory, in a process of its own each; see `COST_RUNS`."""

from __future__ import annotations

import json
import math
import multiprocessing
import resource
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from arview.cad import ViewRange, load_part
from arview.cad.model import Component, Model, make_model
from arview.cad.part import ComponentSettings, Part
from arview.camera import Camera
from arview.detection import Detector
from arview.geometry import Array, apply, exp_so3, look_at, rigid
from arview.guideviews import GuideViewOptions, GuideViewSet, make_guide_views
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.folder import read_cloud, read_folder
from arview.measurement.options import MeasureOptions
from arview.measurement.run import measure
from arview.reconstruction.run import ReconstructOptions, reconstruct
from arview.rendering import ZBufferRenderer
from arview.tracking import TrackedPart, TrackingSession
from helpers.photo_scene import photograph
from helpers.photo_scene import write_photos as write_pictures
from helpers.plate_scene import as_built, part
from recordings import ROOT

PLATE = ROOT / "samples" / "plate"
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
    """The way from ``count`` photos of a plate to the measurement without a dense cloud."""
    return _alone(_from_photos, count)


def component_cost(count: int) -> Cost:
    """The measurement of ``count`` components on a plate in a cloud whose place is known."""
    return _alone(_in_cloud, count)


def triangle_cost(count: int) -> Cost:
    """Guide views, session and tracked frames of one lump of about ``count`` triangles."""
    return _alone(_of_triangles, count)


def picture_cost(kilopixels: int) -> Cost:
    """Search and tracked frames of one part in pictures of a size, which it fills always by the same share."""
    return _alone(_of_pictures, kilopixels)


def part_cost(count: int) -> Cost:
    """Tracked frames of ``count`` specimens of one part in one film."""
    return _alone(_of_specimens, count)


COST_RUNS: dict[str, tuple[Callable[[int], Cost], tuple[int, ...], str]] = {
    "photos": (photo_cost, (12, 24, 48, 96, 192), "placed"),
    "components in a cloud": (component_cost, (10, 30, 100, 300), "within U"),
    "triangles": (triangle_cost, (20_480, 81_920, 327_680, 1_310_720), "frames tracked"),
    "kilopixels": (picture_cost, (300, 900, 2_000, 8_000), "frames tracked"),
    "specimens": (part_cost, (1, 2, 4, 8), "frames tracked"),
}
"""What grows: the cost of a size, the sizes, and what comes out."""


def slope(sizes: Sequence[int], seconds: Sequence[float]) -> float:
    """Slope of a line through the costs (N,) of sizes (N,), both as logarithms; NaN where a cost is not measurable."""
    if min(seconds) <= 0.0:
        return float("nan")
    return float(np.polyfit(np.log(np.array(sizes, dtype=np.float64)), np.log(seconds), 1)[0])


def plot(grown: Mapping[str, Mapping[int, Cost]], path: Path) -> None:
    """A log-log plot of all that grew, each over its sizes, relative to its smallest one; SVG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 4.5), layout="constrained")
    axes = figure.subplots()
    for what, costs in grown.items():
        sizes = sorted(costs)
        totals = [sum(costs[size].seconds.values()) for size in sizes]
        label = f"{what}: slope {slope(sizes, totals):.2f}"
        axes.loglog(np.array(sizes) / sizes[0], np.array(totals) / totals[0], "o-", label=label)
    axes.set(xlabel="size, relative to the smallest", ylabel="CPU time, relative to it")
    axes.grid(True, which="both", alpha=0.3)
    axes.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def _alone(work: object, count: int) -> Cost:
    """The result of a function in a fresh process, so that peak memory is its own."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as process:
        return process.submit(work, count).result()  # type: ignore[arg-type]


def _from_photos(count: int) -> Cost:
    with tempfile.TemporaryDirectory() as folder:
        camera = write_photos(Path(folder) / "photos", count)
        out, clock = Path(folder) / "out", StepClock()
        options = ReconstructOptions(last_stage="scale")
        found = reconstruct(Path(folder) / "photos", out, part(), str(camera), options, progress=clock)
        placed = len(found.sparse.photos) if found.sparse is not None else 0
        clock("measure in the photos")
        measure(read_folder(out, with_cloud=False), part(), MeasureOptions(methods=("sweep", "edges")))
        clock("end")
    return _cost(clock, placed, count)


def write_photos(folder: Path, count: int) -> Path:
    """Write photos of a textured plate from places all around it, no two alike; the path of their camera file."""
    camera = Camera(1280, 960, 1440.0, 1440.0, 639.5, 479.5, np.array([-0.06, 0.01, 0.0, 0.0, 0.0]))
    pictures = [photograph(as_built(), pose, camera, seed=4) for pose in _spiral(count)]
    write_pictures(folder, pictures)
    path = folder.parent / "camera.json"
    path.write_text(json.dumps({"width": camera.width, "height": camera.height, "fx": camera.fx, "fy": camera.fy,
                                "cx": camera.cx, "cy": camera.cy, "dist": camera.dist.tolist()}))  # fmt: skip
    return path


def _spiral(count: int) -> list[Array]:
    """``cam_from_model`` (4,4) of cameras around the plate, on three turns from low to high."""
    poses = []
    for share in np.linspace(0.0, 1.0, count):
        azimuth, elevation = 6.0 * np.pi * share, np.radians(30.0 + 35.0 * share)
        flat = np.cos(elevation)
        place = 420.0 * np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
        poses.append(look_at(place, [0.0, 0.0, 5.0], [0.0, 0.0, 1.0]))
    return poses


def _in_cloud(count: int) -> Cost:
    boxes, moves = plate_with_posts(count)
    clock = StepClock()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cloud.xyz"
        _write_cloud(path, boxes, moves)
        clock("read")
        found = read_cloud(path)
        placed = replace(found, scale=replace(found.scale, model_from_scan=np.eye(4)))
        with threadpool_limits(1, "blas"):
            inspection = measure(placed, boxes, MeasureOptions(methods=("cloud",)), progress=clock)
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


FRAMES = 40
"""Frames that are tracked, after the first, in which the part is found or its start is refined."""


def _lump(triangles: int) -> Model:
    """A closed lump without symmetries."""
    steps = max(0, round(math.log(triangles / 20.0, 4.0)))
    ball = trimesh.creation.icosphere(steps)
    x, y, z = ball.vertices.T
    bumps = 1.0 + 0.15 * np.sin(3.0 * x + 1.0) * np.cos(4.0 * y) + 0.1 * np.sin(5.0 * z + 2.0 * x)
    vertices = ball.vertices * (60.0 * bumps)[:, None] * [1.0, 0.7, 0.5]
    return make_model("lump", (Component("lump", vertices, ball.faces.astype(np.int32)),))


def _views_of(model: Model) -> GuideViewSet:
    views_range = ViewRange((2.0 * model.diameter_mm, 6.0 * model.diameter_mm))
    return make_guide_views(model, views_range, GuideViewOptions(subdivisions=2, renderer="zbuffer"))


def _drawn(model: Model, camera: Camera, poses: Sequence[Array], seed: int) -> NDArray[np.uint8]:
    """A picture (H,W,3) of a model at some poses (4,4), grey on grey with noise."""
    renderer = ZBufferRenderer(model, camera)
    gray = np.full((camera.height, camera.width), 70, dtype=np.uint8)
    for pose in poses:
        rendering = renderer.render(pose)
        shown = rendering.component_ids >= 0
        gray[shown] = rendering.shaded(camera)[shown]
    noise = np.random.default_rng(seed).normal(0.0, 2.0, gray.shape)
    noisy = np.clip(gray + noise, 0.0, 255.0).astype(np.uint8)
    return np.ascontiguousarray(np.repeat(noisy[..., None], 3, axis=2))


def _path(model: Model, frame: int, aside_mm: float = 0.0) -> Array:
    """Pose (4,4) of the part in a frame: it turns and sways."""
    turn = exp_so3(np.array([0.6 + 0.004 * frame, 0.3 + 0.006 * frame, 0.1]))
    place = np.array([aside_mm + 4.0 * np.sin(0.1 * frame), 2.0 * np.cos(0.1 * frame), 3.0 * model.diameter_mm])
    return rigid(turn, place - turn @ model.center_in_model)


def _camera(kilopixels: int) -> Camera:
    width = round(math.sqrt(1000.0 * kilopixels * 4.0 / 3.0) / 8.0) * 8
    height = width * 3 // 4
    return Camera(width, height, 1.1 * width, 1.1 * width, 0.5 * width - 0.5, 0.5 * height - 0.5)


def _tracked(views: GuideViewSet, model: Model, camera: Camera, asides_mm: Sequence[float], clock: StepClock) -> int:
    """Track specimens through drawn frames; the number of frames in which all are followed."""
    clock("session")
    parts = [
        TrackedPart(views, model, f"#{k}", initial_cam_from_model=_path(model, 0, aside))
        for k, aside in enumerate(asides_mm)
    ]
    session = TrackingSession(parts, camera)
    good = 0
    for frame in range(FRAMES + 1):
        clock("drawing")
        image = _drawn(model, camera, [_path(model, frame, aside) for aside in asides_mm], frame)
        clock("tracked frames" if frame else "first frame")
        poses = session.process(image, frame, frame / 30.0)
        good += frame > 0 and all(pose.cam_from_model is not None for pose in poses)
    clock("end")
    del clock.seconds["drawing"]
    return good


def _of_triangles(count: int) -> Cost:
    model, camera, clock = _lump(count), _camera(300), StepClock()
    clock("guide views")
    views = _views_of(model)
    return _cost(clock, _tracked(views, model, camera, [0.0], clock), FRAMES)


def _of_pictures(kilopixels: int) -> Cost:
    model, camera, clock = load_part(PLATE / "part.toml").model, _camera(kilopixels), StepClock()
    views = _views_of(model)
    detector, image = Detector(views, camera), _drawn(model, camera, [_path(model, 0)], 0)
    detector.detect(image)  # compiled code is loaded
    clock.last = time.process_time()
    clock("search")
    detector.detect(image)
    return _cost(clock, _tracked(views, model, camera, [0.0], clock), FRAMES)


def _of_specimens(count: int) -> Cost:
    model, camera, clock = _lump(20_480), _camera(900), StepClock()
    views = _views_of(model)
    pitch_mm = 0.55 * model.diameter_mm
    asides = [pitch_mm * (k - 0.5 * (count - 1)) for k in range(count)]
    clock.last = time.process_time()
    return _cost(clock, _tracked(views, model, camera, asides, clock), FRAMES)


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
