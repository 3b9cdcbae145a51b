"""samples/plate: its files agree with each other, and its truth with its photos."""

import importlib.util
import json

import cv2
import numpy as np
import pytest
from PIL import Image

from arview.cad.part_file import load_part
from helpers.paths import SAMPLES

FOLDER = SAMPLES / "plate"

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def truth():
    return json.loads((FOLDER / "truth.json").read_text())


@pytest.fixture(scope="module")
def part():
    return load_part(FOLDER)


@pytest.mark.slow
def test_cad_part_file_and_truth_name_the_same_components(part, truth):
    names = [component.name for component in part.model.components]
    assert sorted(names) == sorted(truth["truth"])
    assert sorted(part.inspected) == sorted(set(names) - {"base_plate"})
    assert 12 <= len(names) <= 18
    low, high = part.model.component("base_plate").bounds_in_model
    assert np.allclose(low, (-150, -150, -8), atol=1e-3)
    assert np.allclose(high, (150, 150, 0), atol=1e-3)
    assert [datum.label for datum in part.datums] == ["A", "B", "C"]


def test_the_holes_of_the_datums_are_in_the_cad(part):
    points = part.model.component("base_plate").vertices_in_model
    assert len(part.datums) == 3
    for datum in part.datums[1:]:
        away = np.linalg.norm(points[:, :2] - datum.point_in_model[:2], axis=1)
        assert np.count_nonzero(np.abs(away - datum.diameter_mm / 2) < 1e-3) > 30
        assert away.min() > datum.diameter_mm / 2 - 1e-3


def test_displacements(truth):
    lengths = []
    for name, moved in truth["truth"].items():
        pose = np.array(moved["measured_from_nominal"])
        centroid, displacement = np.array(moved["centroid_mm"]), np.array(moved["displacement_mm"])
        assert np.allclose(pose[:3, :3] @ centroid + pose[:3, 3] - centroid, displacement, atol=1e-5), name
        rotation, _ = cv2.Rodrigues(np.deg2rad(moved["tilt_deg"]))
        assert np.allclose(pose[:3, :3], rotation, atol=1e-9), name
        lengths.append(np.linalg.norm(displacement))
    for wanted in (0.0, 0.3, 1.0, 3.0):
        assert np.abs(np.array(lengths) - wanted).min() < 1e-5
    tilts = np.linalg.norm([moved["tilt_deg"] for moved in truth["truth"].values()], axis=1)
    assert np.count_nonzero(tilts) >= 3
    assert tilts.max() < 2.0


def test_photos_with_exif(truth):
    paths = sorted((FOLDER / "photos").iterdir())
    assert [path.name for path in paths] == sorted(truth["cam_from_model_mm"])
    assert 24 <= len(paths) <= 30
    exposures = set()
    for path in paths:
        with Image.open(path) as photo:
            assert photo.size == (1600, 1200)
            exif = photo.getexif()
            details = exif.get_ifd(0x8769)
        assert (exif[0x010F], exif[0x0110], exif[0x0112]) == ("arview", "sample", 1)
        assert details[0x920A] == pytest.approx(7.7)
        # Over the diagonal of 43.27 mm: rounded as it is, the focal length is known to about 1 %.
        focal_px = details[0xA405] / 43.27 * np.hypot(1600, 1200)
        assert focal_px == pytest.approx(truth["K"][0][0], rel=0.015)
        exposures.add(float(details[0x829A]))
    assert len(exposures) > 20


def test_size():
    """Photos alone, and all that is shipped for the demo: photos, films, CAD."""
    for folder, limit in ((FOLDER / "photos", 15e6), (FOLDER.parent, 60e6)):
        files = [p for p in folder.rglob("*") if p.is_file() and "__pycache__" not in p.parts]
        assert 0 < sum(path.stat().st_size for path in files) <= limit


@pytest.mark.slow
def test_truth_lies_on_the_photos_edges(part, truth):
    """CAD edges at their true place, projected; the picture's edges must not be shifted against them."""
    spec = importlib.util.spec_from_file_location("sample_edges", FOLDER.parent / "common" / "edges.py")
    edges = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(edges)
    meshes = {}
    for component in part.model.components:
        pose = np.array(truth["truth"][component.name]["measured_from_nominal"])
        vertices = component.vertices_in_model @ pose[:3, :3].T + pose[:3, 3]
        meshes[component.name] = vertices, component.faces
    points = edges.crease_points(meshes, "base_plate")
    matrix, distortion = np.array(truth["K"]), np.array([*truth["dist_k1_k2"], 0.0, 0.0])
    for name in ("img_002.jpg", "img_011.jpg", "img_020.jpg"):
        picture = cv2.imread(str(FOLDER / "photos" / name))
        for wrong_px in (0.0, 1.0):
            moved = matrix.copy()
            moved[0, 2] += wrong_px
            pixel, normal = edges.projected(points, np.array(truth["cam_from_model_mm"][name]), moved, distortion)
            inside = np.all((pixel > 12) & (pixel < (1588, 1188)), axis=1)
            offset, strength = edges.gradient_offsets(picture, pixel[inside], normal[inside])
            shift = edges.common_shift(offset[strength > 12], normal[inside][strength > 12])
            assert max(abs(shift[0] + wrong_px), abs(shift[1])) < 0.15, f"{name}: {shift} px"
