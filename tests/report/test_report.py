"""The report of an inspection: numbers, pictures, 3D view, PDF, and explanations of absent data."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from arview.cad.model import Model
from arview.cad.part import ComponentSettings, Part
from arview.cli import main
from arview.errors import MismatchError, MissingDependencyError
from arview.geometry import Array, apply, exp_so3, invert, rigid
from arview.inspection import CharacteristicResult, Inspection, Verdict, save_inspection
from arview.measurement.cloud.distance_map import (
    distance_map,
    read_distance_ply,
    write_distance_ply,
)
from arview.measurement.folder import MetricReconstruction
from arview.overlay.options import VERDICT_RGB
from arview.reconstruction.scale.types import Consistency, ScaleResult
from arview.reconstruction.types import DenseCloud, PosedPhoto, SparseModel
from arview.rendering.rasterizer import rasterise
from arview.report import gather, make_report, pictures
from arview.report import make as make_module
from arview.report import scene as scene_module
from arview.report.formatting import finding_text, number, zone_text
from arview.report.pictures import make_gallery, overview
from arview.report.scene import make_scene, scene_json
from helpers.inspections import bench_inspection, deviation, inspection
from helpers.photo_scene import CAMERA, bench, photograph, ring, write_photos

ROUGH_FROM_DATUM = rigid(exp_so3(np.array([0.1, -0.2, 0.3])), [30.0, -40.0, 25.0])
"""The frame of the reconstruction is not that of the datums."""
SHIFT = np.array([2.4, -1.8, 0.0])


@pytest.fixture(scope="module")
def model() -> Model:
    return bench()


@pytest.fixture(scope="module")
def part(model: Model) -> Part:
    roles = {"bench": "base", "plate": "base"}
    settings = tuple(ComponentSettings(c.name, roles.get(c.name, "inspect"), 0.5) for c in model.components)  # type: ignore[arg-type]
    return Part("bench", Path("bench.toml"), Path("bench.step"), model, settings)


@pytest.fixture(scope="module")
def found(model: Model) -> Inspection:
    made = bench_inspection(model)
    assert made.datum_system is not None
    frame = tuple(tuple(float(v) for v in row) for row in ROUGH_FROM_DATUM)
    return replace(made, datum_system=replace(made.datum_system, rough_from_datum=frame))


@pytest.fixture(scope="module")
def reconstruction(model: Model, tmp_path_factory: pytest.TempPathFactory) -> MetricReconstruction:
    """Eight photos of the nominal bench, 300 points with half a pixel of noise, a cloud 0.1 mm above the surface."""
    folder = tmp_path_factory.mktemp("photos")
    poses = ring(8, 420.0)
    paths = write_photos(folder, [photograph(model, pose) for pose in poses])
    rng = np.random.default_rng(0)
    rough_points = apply(ROUGH_FROM_DATUM, np.column_stack([rng.uniform(-90, 90, (300, 2)), np.zeros(300)]))
    photos = tuple(
        PosedPhoto(path.name, path, CAMERA, pose @ invert(ROUGH_FROM_DATUM))
        for path, pose in zip(paths, poses, strict=True)
    )
    observed = [photo.camera.project(apply(photo.cam_from_scan, rough_points)) for photo in photos]
    pixels = np.concatenate(observed) + rng.normal(0.0, 0.5, (8 * 300, 2))
    sparse = SparseModel(
        photos, rough_points, np.zeros((300, 3), np.uint8), np.zeros(300), np.tile(np.arange(300, dtype=np.int32), 8),
        np.repeat(np.arange(8, dtype=np.int32), 300), pixels,
    )  # fmt: skip
    flat = np.column_stack([rng.uniform(-95, 95, (20_000, 2)), np.full(20_000, 0.1)])
    cloud = DenseCloud(
        apply(ROUGH_FROM_DATUM, flat), np.tile(ROUGH_FROM_DATUM[:3, 2].astype(np.float32), (20_000, 1)),
        np.full((20_000, 3), 90, np.uint8), np.full(20_000, 0.05, np.float32), np.full(20_000, 3, np.uint8),
    )  # fmt: skip
    scale = ScaleResult(1.0, 1e-4, np.eye(4), None, (), (), "", Consistency(True, ""))
    return MetricReconstruction(sparse, scale, cloud)


@pytest.fixture
def source(found: Inspection, tmp_path: Path) -> Path:
    save_inspection(found, tmp_path / "inspection.json")
    return tmp_path / "inspection.json"


@pytest.fixture
def patched(monkeypatch: pytest.MonkeyPatch, reconstruction: MetricReconstruction) -> None:
    monkeypatch.setattr("arview.measurement.read_folder", lambda *_: reconstruction)


def in_datum_frame(reconstruction: MetricReconstruction) -> SparseModel:
    return reconstruction.sparse.transformed(1.0, invert(ROUGH_FROM_DATUM))


# ---- numbers in words


def test_undetermined_is_a_word_and_minus_a_minus() -> None:
    assert number(-1.2345) == "−1.234"
    assert number(-0.0001, signed=True) == "0.000"
    open_z = deviation("x", (0.1, -0.05, None), np.zeros(3))
    assert "dz\u00a0undetermined" in finding_text(open_z)
    assert "dy\u00a0−0.050" in finding_text(open_z)
    rough = deviation("x", (0.1234, 0.0, 0.0), np.zeros(3), 0.3, uncertainty_mm=0.4)
    assert finding_text(rough).startswith(
        "0.12 mm from its design position, U = 0.40 mm; 0.3 mm is allowed: dx\u00a0+0.12"
    )
    assert zone_text(open_z).startswith("≥ 0.224")  # an undetermined axis can only enlarge it
    assert zone_text(deviation("x", (0.3, 0.4, 0.0), np.zeros(3))) == "1.000 (1)"


# ---- pictures


@pytest.mark.slow
def test_crops_show_the_ghost_at_the_design_place_and_the_arrow_where_it_points(
    model: Model, found: Inspection, reconstruction: MetricReconstruction, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pictures, "WIDTH_PX", 480)
    monkeypatch.setattr(pictures, "HEIGHT_PX", 360)
    sparse = in_datum_frame(reconstruction)
    gallery = make_gallery(found, model, sparse)
    assert not gallery.unread
    assert {name: len(crops) for name, crops in gallery.components.items()} == {
        "block_1": 1, "block_2": 2, "block_3": 2, "block_4": 2, "plate": 2,
    }  # fmt: skip
    crop = gallery.components["block_2"][0]
    photo = next(one for one in sparse.photos if one.name == crop.photo)
    assert crop.image.shape == (360, 480, 3)
    # The arrow alone is white; its ends are the middle of the block, and that plus the scaled displacement.
    white = np.argwhere((crop.image > 250).all(axis=2))[:, ::-1]
    assert crop.arrow_scale is not None
    center = model.component("block_2").bounds_in_model.mean(axis=0)
    ends = photo.camera.project(apply(photo.cam_from_scan, np.stack([center, center + crop.arrow_scale * SHIFT])))
    drawn = np.ptp(white, axis=0)
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    spread = (white - white.mean(axis=0)) @ np.stack([along, [-along[1], along[0]]]).T
    zoom = np.ptp(spread[:, 0]) / np.linalg.norm(ends[1] - ends[0])
    assert 1.0 < zoom < 6.0  # the photo is enlarged, the arrow with it
    assert np.ptp(spread[:, 0]) > 4.0 * np.ptp(spread[:, 1]) > 0.0  # it points along the displacement
    assert drawn.max() < 0.5 * 480
    # The line of sight is more perpendicular than parallel to the displacement.
    ray = photo.centre_in_scan - center
    assert abs(ray @ SHIFT) / (np.linalg.norm(ray) * np.linalg.norm(SHIFT)) < 0.71


@pytest.mark.slow
def test_the_ghost_lies_on_the_block_in_the_photo(
    model: Model, found: Inspection, reconstruction: MetricReconstruction, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Against the silhouette of the nominal block as the camera of the photo projects it."""
    sparse = in_datum_frame(reconstruction)
    plain = replace(found, components=(replace(found.components[0]),), foreign_objects=())
    for name, value in {"WIDTH_PX": 640, "HEIGHT_PX": 480, "SHARE": 0.01, "MIN_PX": 640}.items():  # the whole photo
        monkeypatch.setattr(pictures, name, value)
    crop = make_gallery(plain, model, sparse).components["block_1"][0]
    photo = next(one for one in sparse.photos if one.name == crop.photo)
    from arview.reconstruction.intake.reading import read_photo

    changed = np.abs(crop.image.astype(int) - read_photo(photo.path).astype(int)).max(axis=2) > 12
    block, ideal = model.component("block_1"), photo.camera.without_distortion()
    _, faces = rasterise(
        apply(photo.cam_from_scan, block.vertices_in_model), block.faces, ideal.fx, ideal.fy, ideal.cx, ideal.cy,
        ideal.width, ideal.height,
    )  # fmt: skip
    rows, columns = np.nonzero(faces >= 0)
    rays = np.stack([(columns - ideal.cx) / ideal.fx, (rows - ideal.cy) / ideal.fy, np.ones(len(rows))], axis=1)
    bent = np.round(photo.camera.project(rays)).astype(int)
    mask = np.zeros(changed.shape, bool)
    mask[bent[:, 1].clip(0, 479), bent[:, 0].clip(0, 639)] = True
    near = mask[
        max(0, bent[:, 1].min() - 6) : bent[:, 1].max() + 6, max(0, bent[:, 0].min() - 6) : bent[:, 0].max() + 6
    ]
    cut = changed[
        max(0, bent[:, 1].min() - 6) : bent[:, 1].max() + 6, max(0, bent[:, 0].min() - 6) : bent[:, 0].max() + 6
    ]
    assert (near & cut).sum() / (near | cut).sum() > 0.8  # the rest is due to rounding at the rim and the holes


@pytest.mark.slow
def test_a_failing_characteristic_has_a_picture_with_a_ring_at_its_place(
    model: Model, found: Inspection, reconstruction: MetricReconstruction
) -> None:
    place = model.component("block_1").bounds_in_model.mean(axis=0)
    failed = CharacteristicResult(
        "top", "position", ("top",), Verdict.FAIL, value_mm=0.5, uncertainty_mm=0.1, zone_mm=0.2,
        point_mm=tuple(place.tolist()),
    )  # fmt: skip
    passed = replace(failed, name="other", verdict=Verdict.PASS, value_mm=0.05)
    gallery = make_gallery(replace(found, characteristics=(passed, failed)), model, in_datum_frame(reconstruction))
    assert set(gallery.characteristics) == {"top"}
    image = gallery.characteristics["top"].image
    is_red = np.all(np.abs(image.astype(int) - VERDICT_RGB[Verdict.FAIL]) < 30, axis=2)
    rows, columns = np.nonzero(is_red)
    assert len(rows) > 200
    middle = np.array([columns.mean(), rows.mean()])
    assert np.hypot(columns - middle[0], rows - middle[1]) == pytest.approx(pictures.MARK_PX, abs=4.0)


@pytest.mark.slow
def test_photos_that_are_gone_are_named(
    model: Model, found: Inspection, reconstruction: MetricReconstruction, tmp_path: Path
) -> None:
    sparse = in_datum_frame(reconstruction)
    gone = replace(sparse, photos=tuple(replace(p, path=tmp_path / p.name) for p in sparse.photos))
    gallery = make_gallery(found, model, gone)
    assert gallery.unread
    assert all("img_" in reason for reason in gallery.unread)
    assert gallery.components
    assert all(crops == () for crops in gallery.components.values())
    assert overview(found, model, gone, 400).shape == (248, 400, 3)  # the CAD alone


# ---- the page


@pytest.mark.slow
def test_the_page_holds_all_and_needs_no_network(
    source: Path, part: Part, patched: None, tmp_path: Path, found: Inspection
) -> None:
    page = tmp_path / "report.html"
    evidence = make_report(source, page, part=part, folder=tmp_path)
    assert evidence.absent == {
        "distances": "This inspection has no distance map: there was no cloud, or no part of it was near the CAD model."
    }
    text = page.read_text(encoding="utf-8")
    body = re.sub(r"<script.*?</script>|<style.*?</style>", "", text, flags=re.DOTALL)
    assert not re.search(r'(src|href)="(?!data:|#)', body)
    assert not re.search(r"url\((?!data:|#)", text)
    assert "@import" not in text
    assert "<link" not in text
    plain = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", body))
    for expected in (
        "bench", "SN-7", "Fail", "1 missing, 1 out of tolerance", "the photos are few", "+2.400", "−1.800",
        "6.000 (1)", "undetermined", "The component is missing.", "Foreign object on plate, 90 mm²",
        "ISO 14253-1", "fewer than 100 points", "8 photos, 300 points observed 2,400 times", "datum A",
    ):  # fmt: skip
        assert expected in plain, expected
    # Two crops of each finding and of the chip, one thumbnail, the overview.
    assert body.count("data:image/jpeg") == 2 * 4 + 2 + 1 + 1
    assert 'class="tag fail"' in body
    assert body.count("<svg") > 8
    kept = base64.b64decode(re.search(r"data:application/json;base64,([^\"]+)", body).group(1))  # type: ignore[union-attr]
    assert kept == source.read_bytes()


def test_the_undetermined_axis_is_no_number_in_the_table(source: Path, tmp_path: Path) -> None:
    page = tmp_path / "r.html"
    make_report(source, page)
    text = page.read_text(encoding="utf-8")
    table = text[text.index('<table class="components">') :]
    block = re.search(r"<tbody[^>]*>(?:(?!</tbody>).)*block_3.*?</tbody>", table, re.DOTALL).group(0)  # type: ignore[union-attr]
    rows = [re.findall(r'<td class="value[^"]*">(.*?)</td>', row) for row in block.split("<tr>")[1:]]
    assert [row[2] for row in rows[:2]] == ["+0.100", "+0.050"]
    assert [re.sub("<.*?>", "", cell) for cell in rows[2][1:]] == ["undetermined", "undetermined"]


def test_what_is_absent_is_said(source: Path, tmp_path: Path, part: Part) -> None:
    page = tmp_path / "r.html"
    absent = make_report(source, page).absent
    assert set(absent) == {"part", "sparse", "distances", "cloud"}
    text = page.read_text(encoding="utf-8")
    for reason in absent.values():
        assert reason.split("(")[0].strip() in text
    assert 'id="scene"' not in text
    (tmp_path / "reconstruction.json").write_text("{}")  # a folder that was damaged
    assert "could not be used" in make_report(source, page, part=part).absent["sparse"]


def test_texts_are_escaped(model: Model, tmp_path: Path) -> None:
    odd = inspection(model, (deviation("block_1", (1.0, 0.0, 0.0), np.zeros(3)),), serial="<script>alert(1)</script>")
    save_inspection(odd, tmp_path / "i.json")
    make_report(tmp_path / "i.json", tmp_path / "r.html")
    assert "<script>alert" not in (tmp_path / "r.html").read_text(encoding="utf-8")


def test_another_part_is_refused(source: Path, tmp_path: Path, part: Part) -> None:
    other = replace(part, model=bench(seed=5))
    with pytest.raises(MismatchError, match="another model"):
        make_report(source, tmp_path / "r.html", part=other)
    assert not (tmp_path / "r.html").exists()


# ---- the 3D view


@pytest.mark.slow
def test_the_scene_is_the_cad_and_the_cloud(
    model: Model, found: Inspection, reconstruction: MetricReconstruction, monkeypatch: pytest.MonkeyPatch
) -> None:
    cloud = reconstruction.cloud
    assert cloud is not None
    moved = replace(cloud, points=apply(invert(ROUGH_FROM_DATUM), cloud.points))
    monkeypatch.setattr(scene_module, "MAX_POINTS", 5000)
    scene = make_scene(found, model, moved, None)
    assert scene is not None
    again = json.loads(scene_json(scene))
    vertices = _decoded(again["mesh"])
    assert np.abs(vertices - model.mesh[0]).max() < 0.01
    faces = np.frombuffer(base64.b64decode(again["mesh"]["faces"]), "<u4").reshape(-1, 3)
    assert (faces == model.mesh[1]).all()
    points = _decoded(again["cloud"])
    assert len(points) == 5000
    assert np.abs(points[:, 2] - 0.1).max() < 0.01
    distances = np.frombuffer(base64.b64decode(again["cloud"]["distances"]), "<i2")
    on_plate = distances[distances < 200]  # the others lie inside a block
    assert np.median(on_plate) == pytest.approx(100, abs=1)  # micrometres
    by_name = {one["name"]: one for one in again["components"]}
    assert by_name["block_2"]["place"][3] == pytest.approx(
        np.array(found.components[1].details.measured_from_nominal)[0, 3],
        rel=1e-6,  # type: ignore[union-attr]
    )
    assert by_name["block_3"]["displacement"] == [0.1, 0.05, None]
    assert by_name["bench"]["verdict"] is None
    assert make_scene(found, None, None, None) is None
    monkeypatch.setattr(scene_module, "MAX_FACES", 10)
    assert "mesh" not in (make_scene(found, model, moved, None) or {})


def _decoded(pack: dict[str, Any]) -> Array:
    whole = np.frombuffer(base64.b64decode(pack["points"]), "<u2").reshape(-1, 3)
    return np.asarray(whole * np.array(pack["step"]) + pack["low"])


@pytest.mark.slow
@pytest.mark.browser
@pytest.mark.skipif(shutil.which("chromium") is None, reason="there is no chromium")
def test_the_view_works_from_a_file(source: Path, part: Part, patched: None, tmp_path: Path) -> None:
    page = tmp_path / "report.html"
    make_report(source, page, part=part, folder=tmp_path)
    command = [
        "chromium", "--headless", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader", "--virtual-time-budget=8000", "--window-size=900,1200",
        f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom", page.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    if 'class="live"' not in done.stdout and "does not support WebGL" in done.stdout:
        pytest.skip("this chromium has no WebGL")
    assert 'data-state="ready"' in done.stdout
    assert re.search(r'class="name fail"[^>]*>block_2<', done.stdout)


# ---- paper


@pytest.mark.slow
def test_the_pdf(source: Path, part: Part, patched: None, tmp_path: Path) -> None:
    pypdf = pytest.importorskip("pypdf")
    paper = tmp_path / "report.pdf"
    make_report(source, pdf=paper, part=part, folder=tmp_path)
    document = pypdf.PdfReader(paper)
    width, height = (float(v) * 25.4 / 72.0 for v in document.pages[0].mediabox[2:])
    assert (width, height) == (pytest.approx(210, abs=0.5), pytest.approx(297, abs=0.5))
    text = " ".join(page.extract_text() for page in document.pages)
    for expected in (
        "SN-7",
        "block_2",
        "undetermined",
        "6.000 (1)",
        f"Page 1 of {len(document.pages)}",
        "Inspector",
    ):
        assert expected in text, expected
    assert document.attachments["inspection.json"][0] == source.read_bytes()


def test_without_pango_the_page_is_made_all_the_same(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse() -> None:
        raise MissingDependencyError(f"the PDF needs the Pango libraries: {make_module.PANGO_INSTALL_COMMAND}")

    monkeypatch.setattr(make_module, "_weasyprint", refuse)
    make_report(source, tmp_path / "r.html")
    done = CliRunner().invoke(main, ["report", str(source), "--pdf", str(tmp_path / "r.pdf")])
    assert done.exit_code == 64
    assert "apt-get install" in done.output
    assert not (tmp_path / "r.pdf").exists()


# ---- files


@pytest.mark.slow
def test_distances_are_read_back(model: Model, reconstruction: MetricReconstruction, tmp_path: Path) -> None:
    cloud = reconstruction.cloud
    assert cloud is not None
    made = distance_map(replace(cloud, points=apply(invert(ROUGH_FROM_DATUM), cloud.points)), model)
    write_distance_ply(made, tmp_path / "d.ply")
    again = read_distance_ply(tmp_path / "d.ply", made.reach_mm, made.statistics)
    assert np.abs(again.points_in_model - made.points_in_model).max() < 1e-4
    assert np.abs(again.distances - made.distances).max() < 1e-6
    (tmp_path / "cut.ply").write_bytes((tmp_path / "d.ply").read_bytes()[:-5])
    with pytest.raises(Exception, match="truncated"):
        read_distance_ply(tmp_path / "cut.ply", 3.0, ())


@pytest.mark.slow
def test_evidence_is_in_the_datum_frame(source: Path, part: Part, patched: None, tmp_path: Path) -> None:
    evidence = gather(source, part, tmp_path)
    assert evidence.sparse is not None
    assert evidence.cloud is not None
    assert np.abs(evidence.cloud.points[:, 2] - 0.1).max() < 1e-9
    assert np.abs(evidence.cloud.normals - [0.0, 0.0, 1.0]).max() < 1e-5
    truth = ring(8, 420.0)
    assert all(np.abs(p.cam_from_scan - t).max() < 1e-9 for p, t in zip(evidence.sparse.photos, truth, strict=True))


def test_the_command(source: Path, tmp_path: Path) -> None:
    done = CliRunner().invoke(main, ["report", str(source)])
    assert done.exit_code == 0, done.output
    assert (tmp_path / "report.html").is_file()
    assert "The CAD model was not given" in done.output
    for arguments, message in (
        ([str(tmp_path / "none.json")], "no such file"),
        ([str(source), "-o", str(source)], "would overwrite an input"),
        ([str(source), "--folder", str(tmp_path / "nowhere")], "no such folder"),
        ([str(source), "-o", str(tmp_path / "no" / "r.html")], "there is no folder"),
    ):
        refused = CliRunner().invoke(main, ["report", *arguments])
        assert refused.exit_code == 64
        assert message in refused.output
