"""samples/manifold and samples/panel: their files agree with each other, and their truth with their photos."""

import importlib.util
import json
import sys

import cv2
import numpy as np
import pytest
from PIL import Image

from arview.cad.part_file import load_part
from helpers.paths import SAMPLES, TOOLS

BASES = {"manifold": "body", "panel": "sheet"}

pytestmark = pytest.mark.integration


def loaded(path):
    spec = importlib.util.spec_from_file_location(f"of_the_samples_{path.stem}", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module", params=sorted(BASES))
def kind(request):
    return request.param


@pytest.fixture(scope="module")
def truth(kind):
    return json.loads((SAMPLES / kind / "truth.json").read_text())


@pytest.fixture(scope="module")
def part(kind):
    return load_part(SAMPLES / kind)


@pytest.mark.slow
def test_cad_part_file_and_truth_name_the_same_components(kind, part, truth):
    names = [component.name for component in part.model.components]
    assert sorted(names) == sorted(truth["truth"])
    assert sorted(part.inspected) == sorted(set(names) - {BASES[kind]})
    assert len(names) >= 15
    assert [datum.label for datum in part.datums] == ["A", "B", "C"]


@pytest.mark.slow
def test_the_holes_of_the_datums_are_in_the_cad(kind, part):
    points = part.model.component(BASES[kind]).vertices_in_model
    for datum in part.datums[1:]:
        away = np.linalg.norm(points[:, :2] - datum.point_in_model[:2], axis=1)
        assert np.count_nonzero(np.abs(away - datum.diameter_mm / 2) < 1e-3) > 30
        assert away.min() > datum.diameter_mm / 2 - 1e-3


def test_displacements(truth):
    """Displaced, tilted, missing, fallen and foreign ones, and some that stand where the CAD has them."""
    present = {name: moved for name, moved in truth["truth"].items() if moved["present"]}
    assert len(truth["truth"]) - len(present) == 2
    fallen = [name.removeprefix("fallen_") for name in truth["foreign"] if name.startswith("fallen_")]
    assert len(fallen) == 1 and not truth["truth"][fallen[0]]["present"]
    assert len(truth["foreign"]) == 2
    lengths = []
    for name, moved in present.items():
        pose = np.array(moved["measured_from_nominal"])
        centroid, displacement = np.array(moved["centroid_mm"]), np.array(moved["displacement_mm"])
        assert np.allclose(pose[:3, :3] @ centroid + pose[:3, 3] - centroid, displacement, atol=1e-5), name
        rotation, _ = cv2.Rodrigues(np.deg2rad(moved["tilt_deg"]))
        assert np.allclose(pose[:3, :3], rotation, atol=1e-9), name
        lengths.append(np.linalg.norm(displacement))
    tilts = np.linalg.norm([moved["tilt_deg"] for moved in present.values()], axis=1)
    assert np.count_nonzero(tilts) >= 4 and 2.0 < tilts.max() < 4.0
    assert np.count_nonzero(np.array(lengths) > 0.5) >= 3 and np.count_nonzero(np.array(lengths) == 0) >= 4


def test_a_tilted_component_rests_on_its_seat():
    """One on a slope of 45° is lifted along the slope's normal until it touches."""
    shots = loaded_shots()
    kinds = sys.modules["kinds"]
    slope = np.eye(4)
    slope[:3, :3] = cv2.Rodrigues(np.array([0.0, -np.pi / 4, 0.0]))[0]
    slope[:3, 3] = 10.0, 0.0, 30.0
    block = sys.modules["textures"].box((10, 10, 10), (0, 0, 5))
    placed = block[0] @ slope[:3, :3].T + slope[:3, 3], block[1]
    options = {"rings": ((40.0, 500.0),), "radius": 100.0, "floor": 0.0, "aim": (0.0, 0.0, 0.0), "aim_spread": 1.0}
    kind = kinds.Kind("test", list, ((0.4, 0.0, 3.0, 0.0),), seats=lambda: {"block": slope}, **options)
    moved = shots.as_built(kind, 3, {"base": block, "block": placed})["block"]
    pose = np.array(moved["measured_from_nominal"])
    height = ((placed[0] @ pose[:3, :3].T + pose[:3, 3]) - slope[:3, 3]) @ slope[:3, 2]
    assert height.min() == pytest.approx(0.0, abs=1e-5)
    assert np.linalg.norm(moved["tilt_deg"]) == pytest.approx(3.0, abs=1e-5)
    in_seat = slope[:3, :3].T @ moved["displacement_mm"]
    assert np.linalg.norm(in_seat[:2]) == pytest.approx(0.4, abs=1e-5)
    assert 0.05 < in_seat[2] < 0.6


def loaded_shots():
    sys.path.insert(0, str(SAMPLES / "common"))
    try:
        import shots
    finally:
        sys.path.remove(str(SAMPLES / "common"))
    return shots


def test_layouts_and_lens():
    shots = loaded_shots()
    kinds = sys.modules["kinds"]
    options = {"rings": ((40.0, 500.0), (60.0, 480.0)), "radius": 100.0, "floor": 0.0, "aim": (0.0, 0.0, 20.0)}
    kind = kinds.Kind("test", list, (), aim_spread=5.0, **options)
    spread_deg = {}
    for layout in kinds.LAYOUTS:
        poses = shots.places(kind, kinds.SetOptions(seed=5, photos=30, layout=layout))
        assert len(poses) == 30
        centers = np.array([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])
        azimuth = np.unwrap(np.arctan2(centers[:, 1], centers[:, 0]))
        spread_deg[layout] = np.rad2deg(np.ptp(azimuth))
        assert np.all((np.linalg.norm(centers, axis=1) > 400) & (np.linalg.norm(centers, axis=1) < 600))
    assert spread_deg["ring"] > 330 and 95 < spread_deg["one-sided"] < 130 and 70 < spread_deg["film"] < 90
    camera = shots.camera(kinds.SetOptions(seed=5, focal_px=1500.0, distortion=(-0.2, 0.05), width=800))
    assert (camera["fx"], camera["dist"][:2], camera["height"]) == (750.0, [-0.2, 0.05], 600)


def test_photos_with_exif(kind, truth):
    paths = sorted((SAMPLES / kind / "photos").iterdir())
    assert [path.name for path in paths] == sorted(truth["cam_from_model_mm"])
    assert len(paths) == 24
    for path in paths:
        with Image.open(path) as photo:
            assert photo.size == (1600, 1200)
            exif = photo.getexif()
            details = exif.get_ifd(0x8769)
        assert (exif[0x010F], exif[0x0110], exif[0x0112]) == ("arview", "sample", 1)
        focal_px = details[0xA405] / 43.27 * np.hypot(1600, 1200)
        assert focal_px == pytest.approx(truth["K"][0][0], rel=0.015)


def test_size(kind):
    files = [p for p in (SAMPLES / kind).rglob("*") if p.is_file() and "__pycache__" not in p.parts]
    assert 0 < sum(path.stat().st_size for path in files) <= 12e6


@pytest.mark.slow
def test_truth_lies_on_the_photos_edges(kind, part, truth):
    """CAD edges at their true place, projected; the picture's edges must not be shifted against them."""
    edges = loaded(SAMPLES / "common" / "edges.py")
    meshes = {}
    for component in part.model.components:
        if truth["truth"][component.name]["present"]:
            pose = np.array(truth["truth"][component.name]["measured_from_nominal"])
            vertices = component.vertices_in_model @ pose[:3, :3].T + pose[:3, 3]
            meshes[component.name] = vertices, component.faces
    points = edges.crease_points(meshes, BASES[kind], -np.inf)
    matrix, distortion = np.array(truth["K"]), np.array([*truth["dist_k1_k2"], 0.0, 0.0])
    for name in ("img_002.jpg", "img_011.jpg", "img_020.jpg"):
        picture = cv2.imread(str(SAMPLES / kind / "photos" / name))
        for wrong_px in (0.0, 1.0):
            moved = matrix.copy()
            moved[0, 2] += wrong_px
            pixel, normal = edges.projected(points, np.array(truth["cam_from_model_mm"][name]), moved, distortion)
            inside = np.all((pixel > 12) & (pixel < (1588, 1188)), axis=1)
            offset, strength = edges.gradient_offsets(picture, pixel[inside], normal[inside])
            shift = edges.common_shift(offset[strength > 12], normal[inside][strength > 12])
            # Edges hidden by the part itself find other edges, which follow a shift less.
            limit_px = 0.2 + 0.1 * wrong_px
            assert max(abs(shift[0] + wrong_px), abs(shift[1])) < limit_px, f"{name}: {shift} px"


def entry(name, displacement, uncertainty=0.05, verdict="pass", finding=None, angle_tolerance=None, center=None):
    details = {"center_mm": center, "angle_tolerance_deg": angle_tolerance, "covariance": (np.eye(6) * 1e-4).tolist()}
    known = [value for value in displacement if value is not None]
    return {
        "name": name, "displacement_mm": displacement, "distance_mm": float(np.linalg.norm(known)) if known else None,
        "observable": [True] * 6, "uncertainty_mm": uncertainty, "tolerance_mm": 0.5, "verdict": verdict,
        "finding": finding, "details": details,
    }  # fmt: skip


def true(displacement, tilt_deg=(0.0, 0.0, 0.0), present=True, centroid=(10.0, 0.0, 0.0)):
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.deg2rad(np.array(tilt_deg, dtype=float)))[0]
    pose[:3, 3] = np.array(centroid) - pose[:3, :3] @ centroid + displacement
    return {
        "displacement_mm": list(displacement), "tilt_deg": list(tilt_deg), "centroid_mm": list(centroid),
        "measured_from_nominal": pose.tolist(), "present": present,
    }  # fmt: skip


def test_comparison_with_the_truth():
    compare = loaded(SAMPLES / "common" / "compare.py")
    truth = {"truth": {
        "right": true((0.1, 0.0, 0.0)), "far": true((0.9, 0.0, 0.0)), "near": true((0.0, 0.0, 0.0)),
        "turned": true((0.0, 0.0, 0.0), (3.0, 0.0, 0.0)), "gone": true((0.0, 0.0, 0.0), present=False),
        "named": true((0.0, 0.0, 0.0), present=False), "there": true((0.0, 0.0, 0.0)),
        "unseen": true((0.0, 0.0, 0.0)), "lever": true((0.0, 0.0, 0.0), (0.0, 0.0, 2.0)),
    }}  # fmt: skip
    inspection = {"components": [
        entry("right", [0.13, 0.0, None]), entry("far", [0.4, 0.0, 0.0]),
        entry("near", [0.7, 0.0, 0.0], verdict="fail"), entry("turned", [0.0, 0.0, 0.0], angle_tolerance=1.0),
        entry("gone", [None] * 3, None, "not_measured"), entry("named", [None] * 3, None, "fail", "missing"),
        entry("there", [None] * 3, None, "fail", "missing"), entry("unseen", [None] * 3, None, "not_measured"),
        entry("lever", [0.0, 0.349, 0.0], verdict="pass", center=[20.0, 0.0, 0.0]),
    ]}  # fmt: skip
    rows = {row.name: row for row in compare.compare(inspection, truth)}
    assert {name for name, row in rows.items() if row.fault} == {"far", "near", "turned", "gone", "there"}
    assert rows["right"].is_covered and not rows["far"].is_covered and rows["unseen"].is_covered is None
    assert rows["right"].error_mm[0] == pytest.approx(0.03) and np.isnan(rows["right"].error_mm[2])
    # The displacement is that of the stated point: 10 mm from the centroid, 2° are 0.349 mm.
    assert np.abs(rows["lever"].error_mm).max() < 0.01
    assert "U holds 3 of 5" in compare.table(list(rows.values()))


def test_foreign_objects_are_compared():
    compare = loaded(SAMPLES / "common" / "compare.py")
    truth = {"foreign": {"foreign_1": {"low_mm": [0, 0, 0], "high_mm": [10, 10, 30]}}}
    there = {"center_mm": [6.0, 5.0, 20.0], "text": "a bolt"}
    nowhere = {"center_mm": [90.0, 5.0, 20.0], "text": "a ghost"}
    assert compare.foreign_faults({"foreign_objects": [there]}, truth) == []
    assert len(compare.foreign_faults({"foreign_objects": [nowhere]}, truth)) == 2
    assert compare.foreign_faults({}, truth) == ["foreign_1 is not reported"]


def test_sets_for_the_coverage():
    """Enough sets and components, every class among them, and half of each kind kept for judging."""
    make_sets = loaded(TOOLS / "benchmarks" / "make_sets.py")
    sets = make_sets.all_sets()
    assert len({one.name for one in sets}) == len({one.seed for one in sets}) == len(sets) >= 20
    components = {"plate": 16, "manifold": 14, "panel": 22, "cabinet": 19}
    assert sum(components[one.kind] for one in sets) >= 300
    assert {one.light for one in sets} == set(make_sets.LIGHTS)
    assert min(one.photos for one in sets) == 8 and max(one.photos for one in sets) == 48
    assert {one.layout for one in sets} == {"ring", "one-sided", "film"}
    for kind in make_sets.KINDS:
        uses = [one.use for one in sets if one.kind == kind]
        assert uses.count("judge") == uses.count("develop") > 2
