"""A cloud of unknown frame against the CAD: found, measured, judged; and refused where it tells nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from arview.cad.model import Component, Model, make_model
from arview.cad.part import ComponentSettings, Datum
from arview.cli import ExitCode, main
from arview.errors import InputError
from arview.geometry import Array, apply, exp_so3, invert, rigid
from arview.inspection import DistanceReport, Inspection, load_inspection
from arview.inspection.details import DistanceStatistics
from arview.measurement.cloud import global_registration, pair_registration
from arview.measurement.cloud.global_registration import find_model_in_cloud
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.cloud_report import scatter_doubts
from arview.measurement.datums.in_cloud import measure_datums_in_cloud
from arview.measurement.folder import in_model_frame, read_cloud
from arview.measurement.run import measure
from arview.reconstruction.dense import write_ply
from arview.reconstruction.types import DenseCloud
from helpers.cad_files import box
from helpers.plate_scene import TRUTH, as_built, nominal
from helpers.plate_scene import part as plate_part

NOISE_MM = 0.04
PLACE = rigid(exp_so3(np.array([0.9, -1.4, 0.6])), [120.0, -300.0, 800.0])
"""scan_from_model."""


def search_coarsely(patch: pytest.MonkeyPatch) -> None:
    """A coarser search than usual, for time."""
    for name, value in {"POINTS": 1500, "VOXELS": 28, "STEP_DEG": 8.0}.items():
        patch.setattr(global_registration, name, value)
    pairs = {"FIRST_PAIRS": 2000, "PAIRS": 3000, "ROUNDS": 2, "MODEL_POINTS": 1600, "KEPT": 10}
    for name, value in pairs.items():
        patch.setattr(pair_registration, name, value)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    search_coarsely(monkeypatch)


def scan(model: Model, place: Array = PLACE, count: int = 60_000, seed: int = 0, scale: float = 1.0) -> DenseCloud:
    """Points of all that does not look down, with noise."""
    vertices, faces, _ = model.mesh
    surface = MeshSurface(vertices, faces)
    points, of_face = surface.spread(count, seed)
    normals = surface.face_normals[of_face]
    seen = normals[:, 2] > -0.5
    noise = np.random.default_rng(seed).normal(0.0, NOISE_MM, (int(seen.sum()), 1))
    points = apply(place, points[seen] + noise * normals[seen]) / scale
    turned = (normals[seen] @ place[:3, :3].T).astype(np.float32)
    many = len(points)
    return DenseCloud(
        points, turned, np.zeros((many, 3), np.uint8), np.full(many, NOISE_MM / scale, np.float32),
        np.full(many, 3, np.uint8),
    )  # fmt: skip


def off_mm(found_from_scan: Array, scale: float = 1.0, true_scale: float = 1.0) -> float:
    """How far the corners of the plate are from where they are."""
    corners = np.array([[x, y, z] for x in (-100.0, 100.0) for y in (-100.0, 100.0) for z in (-8.0, 0.0)])
    return float(np.abs(apply(found_from_scan, apply(PLACE, corners) / true_scale * scale) - corners).max())


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("has_normals", [True, False])
def test_the_part_is_found_and_not_half_a_turn_round(has_normals: bool) -> None:
    """The plate is symmetric, the blocks differ by millimetres, one is missing, and two stand elsewhere."""
    cloud = scan(as_built())
    cloud = cloud if has_normals else replace(cloud, normals=np.zeros_like(cloud.normals))
    found = find_model_in_cloud(cloud, nominal())
    assert found.scale == 1.0
    assert off_mm(found.model_from_scan) < 0.3


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_the_scale_is_found_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(global_registration, "SCALE_RANGE", (0.85, 1.2))
    cloud = scan(as_built(), scale=37.0)
    found = find_model_in_cloud(cloud, nominal(), None)
    assert found.scale == pytest.approx(37.0, rel=1e-3)
    assert off_mm(found.model_from_scan, found.scale, 37.0) < 0.4


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_clouds_of_nothing_that_is_known() -> None:
    cloud = scan(as_built())
    mirror = np.array([-1.0, 1.0, 1.0])
    with pytest.raises(InputError, match="20 points are too few"):
        find_model_in_cloud(DenseCloud(*(a[:20] for a in vars(cloud).values())), nominal())
    rng = np.random.default_rng(3)
    ball = rng.normal(size=(8000, 3))
    ball = 90.0 * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    other = replace(cloud, points=ball, normals=(ball / 90.0).astype(np.float32))
    with pytest.raises(InputError, match=r"cloud: the part (was not found|fits in two ways)"):
        find_model_in_cloud(other, nominal())
    # A lug at one end of a block tells left from right.
    parts = (*nominal().components, Component("lug", *with_faces(box((-20, 70, 0), (30, 85, 35)))))
    handed = make_model("handed", parts)
    mirrored = scan(handed)
    mirrored = replace(
        mirrored, points=mirrored.points * mirror, normals=(mirrored.normals * mirror).astype(np.float32)
    )
    settings = (ComponentSettings("plate", "base"), *(ComponentSettings(c.name) for c in parts[1:]))
    part = replace(plate_part(), model=handed, settings=settings)
    unknown = replace(read_scan(mirrored), cloud=mirrored)
    with pytest.raises(InputError, match=r"mirrored|left-handed|not found|does not"):
        measure(unknown, part)


def with_faces(mesh: tuple[Array, Array]) -> tuple[Array, Array]:
    return mesh[0], mesh[1].astype(np.int32)


def read_scan(cloud: DenseCloud) -> object:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        write_ply(cloud, Path(folder) / "scan.ply")
        return read_cloud(Path(folder) / "scan.ply")


# --- measured --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def inspected(tmp_path_factory: pytest.TempPathFactory) -> tuple[Inspection, Path, str, int]:
    """What the command makes of a scan with a foreign block, NaN and repeats."""
    folder = tmp_path_factory.mktemp("scan")
    thing = Component("thing", *with_faces(box((-12, -20, 0), (8, -6, 12))))
    cloud = scan(make_model("built", (*as_built().components, thing)), count=80_000)
    points = np.concatenate([cloud.points, cloud.points[:2000], np.full((50, 3), np.nan)])
    again = [np.concatenate([a, a[:2000], a[:50]]) for a in (cloud.normals, cloud.colors, cloud.sigma, cloud.views)]
    write_ply(DenseCloud(points, *again), folder / "scan.ply")
    with pytest.MonkeyPatch.context() as patch:
        search_coarsely(patch)
        patch.setattr("arview.cad.load_part", lambda path, unit: plate_part())
        result = CliRunner().invoke(main, ["measure", "--cloud", str(folder / "scan.ply"), "--part", "part.toml"])
    assert result.exit_code == ExitCode.FAIL, result.output
    return load_inspection(folder / "inspection.json", nominal()), folder, result.output, result.exit_code


@pytest.mark.slow
def test_a_scan_alone_against_truth(inspected: tuple[Inspection, Path, str, int]) -> None:
    inspection = inspected[0]
    for name, (shift, turn_deg) in TRUTH.items():
        found = inspection.find(name)
        assert found is not None and found.distance_mm is not None and found.uncertainty_mm is not None
        assert np.abs(np.array(found.displacement_mm, dtype=float) - shift).max() < 0.05, name
        assert abs(found.distance_mm - np.linalg.norm(shift)) < found.uncertainty_mm < 0.15
        assert found.details is not None and found.details.angle_deg == pytest.approx(
            np.linalg.norm(turn_deg), abs=0.15
        )
    missing = inspection.find("block_4")
    assert missing is not None and missing.finding is not None
    system = inspection.datum_system
    assert system is not None and [datum.locked for datum in system.datums] == ["rx ry tz", "tx ty", "rz"]
    assert {datum.method for datum in system.datums} == {"cloud"}
    assert any("a cloud without photos" in warning for warning in inspection.warnings)


@pytest.mark.slow
def test_a_cloud_without_scatter_is_doubted() -> None:
    """Points taken from a CAD lie on it but for rounding; the least scatter of a scanner is far larger."""
    for sigma_mm, is_doubted in ((0.0002, True), (0.004, False)):
        rows = [("all", 0.3), ("base", sigma_mm), ("a", sigma_mm), ("b", 0.2)]
        statistics = tuple(DistanceStatistics(name, 900, 0.0, one, 0.0, one) for name, one in rows)
        doubts = scatter_doubts(DistanceReport(2.0, statistics), 150.0)
        assert ["no scatter beside the CAD" in one for one in doubts] == [True] * is_doubted


def test_foreign_object_and_distance_map(inspected: tuple[Inspection, Path, str, int]) -> None:
    inspection, folder, output, _ = inspected
    assert len(inspection.foreign_objects) == 1
    assert inspection.foreign_objects[0].center_mm == pytest.approx((-2.0, -13.0, 8.0), abs=2.5)
    assert inspection.foreign_objects[0].nearest_component == "plate"
    assert "foreign object at" in output and "1 foreign" in output
    distances = inspection.distance_map
    assert distances is not None
    rows = {row.name: row for row in distances.statistics}
    assert abs(rows["plate"].median_mm) < 0.02
    assert rows["plate"].fwhm_mm == pytest.approx(2.355 * NOISE_MM, rel=0.25)
    assert rows["block_1"].sigma_mm > 0.3 > rows["block_2"].sigma_mm  # it stands 1.17 mm off
    assert all((folder / name).is_file() for name in distances.files)
    assert "inspection_distances/map.png" in distances.files
    assert len(distances.files) == 3 + len(rows) - 1


def test_clouds_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_cloud(tmp_path / "absent.ply")
    (tmp_path / "bad.ply").write_text("ply\nformat ascii 1.0\nend_header\n", encoding="utf-8")
    with pytest.raises(InputError, match="is not a PLY file with points"):
        read_cloud(tmp_path / "bad.ply")
    lines = ["ply", "format ascii 1.0", "element vertex 2", *(f"property float {n}" for n in "xyz"), "end_header"]
    (tmp_path / "two.ply").write_text("\n".join([*lines, "1 2 3", "4 5 6", ""]), encoding="utf-8")
    read = read_cloud(tmp_path / "two.ply")
    assert read.cloud is not None and read.cloud.points == pytest.approx(np.array([[1, 2, 3], [4, 5, 6]]))
    unscaled = replace(read, scale=replace(read.scale, scale=None))
    with pytest.raises(InputError, match="no two datums whose distance gives the scale"):
        in_model_frame(unscaled, replace(plate_part(), datums=()))
    result = CliRunner().invoke(main, ["measure", "--part", "p.toml"])
    assert result.exit_code == 64 and "either OUT" in result.output


# --- datum features --------------------------------------------------------------------------------------


def posted() -> Model:
    """A plate with a post of ⌀30 on it."""
    angle = np.arange(48) * 2 * np.pi / 48
    ring = np.column_stack([15 * np.cos(angle), 15 * np.sin(angle)])
    vertices = np.concatenate(
        [np.column_stack([ring, np.full(48, z)]) for z in (0.0, 45.0)] + [[[0, 0, 0], [0, 0, 45]]]
    )
    i = np.arange(48)
    j = (i + 1) % 48
    sides = [(i, j, j + 48), (i, j + 48, i + 48), (j, i, 0 * i + 96), (i + 48, j + 48, 0 * i + 97)]
    faces = np.concatenate([np.stack(side, axis=1) for side in sides]).astype(np.int32)
    plate = Component("plate", *with_faces(box((-80, -60, -8), (80, 60, 0))))
    return make_model("posted", (plate, Component("post", vertices, faces)))


AXIS = Datum("A", "cylinder", "post", (0.0, 0.0, 20.0), (0.0, 0.0, 1.0), 30.0)
TOP = Datum("B", "plane", "plate", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
EDGE = Datum("C", "edge", "plate", (0.0, -60.0, 0.0), (1.0, 0.0, 0.0))


def solved(datums: tuple[Datum, ...], equations: list[object]) -> tuple[list[str], Array]:
    from arview.measurement.datums.alignment import align

    found = align(equations, np.zeros(3), 100.0)  # type: ignore[arg-type]
    return [one.locked for one in found.datums], found.rough_from_datum


def test_cylinder_and_edge_in_a_cloud() -> None:
    moved = rigid(exp_so3(np.array([0.0004, -0.0006, 0.001])), [0.2, -0.15, 0.1])
    cloud = scan(posted(), moved, 80_000)
    datums = (AXIS, TOP, EDGE)
    locked, found = solved(datums, list(measure_datums_in_cloud(datums, posted(), cloud, {})))
    assert locked == ["rx ry tx ty", "tz", "rz"]
    for point in ([0.0, 0.0, 0.0], [80.0, 60.0, 0.0], [0.0, 0.0, 45.0]):
        assert np.abs(apply(found, [point]) - apply(moved, [point])).max() < 0.03
    edges = (
        replace(EDGE, label="A"),
        replace(TOP),
        replace(EDGE, point_in_model=(80.0, 0.0, 0.0), direction_in_model=(0.0, 1.0, 0.0)),
    )
    locked, found = solved(edges, list(measure_datums_in_cloud(edges, posted(), cloud, {})))
    assert locked[0] == "4 oblique directions" and locked[2] == "tx"  # the edge is not at the origin
    assert np.abs(apply(found, [[80.0, 60.0, 0.0]]) - apply(moved, [[80.0, 60.0, 0.0]])).max() < 0.05


@pytest.mark.slow
def test_cylinder_and_edge_in_photos(tmp_path: Path) -> None:
    from arview.measurement.datums.in_photos import measure_datums_in_photos
    from arview.measurement.photo.views import views_of
    from helpers.photo_scene import CAMERA, photograph, ring

    moved = rigid(exp_so3(np.deg2rad([0.02, -0.03, 0.05])), [0.15, -0.2, 0.1])
    poses = ring(12, distance_mm=330.0)
    grays = [photograph(posted(), pose, seed=2)[..., 0] for pose in poses]
    placed = np.stack([pose @ invert(moved) for pose in poses])
    views = views_of(grays, (CAMERA,) * 12, placed, posted(), tuple(str(i) for i in range(12)))
    datums = (AXIS, TOP, EDGE)
    locked, found = solved(datums, list(measure_datums_in_photos(datums, views, {})))
    assert locked == ["rx ry tx ty", "tz", "rz"]
    for point in ([0.0, 0.0, 0.0], [80.0, 60.0, 0.0], [0.0, 0.0, 45.0]):  # a pixel is 0.46 mm
        assert np.abs(apply(found, [point]) - apply(moved, [point])).max() < 0.08


def test_features_that_are_not_there() -> None:
    cloud = scan(posted(), np.eye(4), 20_000)
    with pytest.raises(InputError, match="datum A: 'post' has no cylinder of ⌀20 mm"):
        measure_datums_in_cloud((replace(AXIS, diameter_mm=20.0),), posted(), cloud, {})
    with pytest.raises(InputError, match="datum C: 'plate' has no straight edge"):
        measure_datums_in_cloud((replace(EDGE, point_in_model=(0.0, 0.0, 0.0)),), posted(), cloud, {})
    bare = replace(cloud, points=np.where(cloud.points[:, 2:] > 1.0, np.nan, cloud.points))
    away = DenseCloud(*(a[cloud.points[:, 2] < 1.0] for a in vars(cloud).values()))
    assert len(bare.points) > len(away.points)
    with pytest.raises(InputError, match=r"datum A \(cylinder\): \d+ points of the cloud are on it, 12 are needed"):
        measure_datums_in_cloud((AXIS,), posted(), away, {})
