"""From photos with exact truth to inspection.json, and the command that does it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from arview.cad.part import ComponentSettings, Datum, Part
from arview.cad.part_file import load_part
from arview.cli import ExitCode, main
from arview.errors import InputError
from arview.geometry import Array, apply
from arview.inspection import Inspection, Verdict, load_inspection, save_inspection
from arview.inspection.summary import overall_verdict
from arview.measurement import run
from arview.measurement.datums.planes import base_plane, plane_samples
from arview.measurement.datums.rims import find_rim
from arview.measurement.folder import MetricReconstruction, read_folder
from arview.measurement.options import MeasureOptions
from arview.measurement.run import measure
from arview.measurement.uncertainty.budget import UncertaintyOptions
from arview.reconstruction.scale.types import Consistency, ScaleResult
from helpers import photo_scene
from helpers.cad_files import box, obj_text
from helpers.photo_scene import CAMERA, photograph, ring
from helpers.placed_photos import ROUGH_FROM_TRUE, placed
from helpers.plate_scene import TRUTH, as_built, nominal, part


@pytest.fixture(scope="module")
def reconstruction(tmp_path_factory: pytest.TempPathFactory) -> MetricReconstruction:
    """Twelve photos of the part as built, with poses that are exact in a frame 0.27 mm and 0.06° off."""
    return _photographed(tmp_path_factory.mktemp("photos"))


def _photographed(folder: Path) -> MetricReconstruction:
    built, poses = as_built(), ring(12, distance_mm=420.0)
    return placed(folder, [photograph(built, pose, seed=4) for pose in poses], poses, CAMERA)


@pytest.fixture(scope="module")
def inspection(reconstruction: MetricReconstruction) -> Inspection:
    return measure(reconstruction, part(), MeasureOptions(methods=("sweep", "edges")))


@pytest.mark.slow
def test_displacements_against_truth(inspection: Inspection) -> None:
    for name, (shift, turn_deg) in TRUTH.items():
        found = inspection.find(name)
        assert found is not None and found.distance_mm is not None and found.uncertainty_mm is not None
        error = np.array(found.displacement_mm, dtype=float) - shift
        assert np.linalg.norm(error[:2]) < 0.08, (name, error)  # a pixel is 0.58 mm
        assert abs(error[2]) < 0.1, (name, error)
        assert abs(found.distance_mm - np.linalg.norm(shift)) < found.uncertainty_mm < 0.3
        details = found.details
        assert details is not None and details.covariance is not None and details.angle_deg is not None
        sigma = np.sqrt(np.diag(np.array(details.covariance)))[3:]
        assert (np.abs(error) < 3.5 * sigma).all(), (name, error, sigma)
        assert details.angle_deg == pytest.approx(np.linalg.norm(turn_deg), abs=0.25)
        place = np.array(details.measured_from_nominal)
        center = np.array(details.center_mm)
        assert place[:3, :3] @ center + place[:3, 3] - center == pytest.approx(found.displacement_mm, abs=1e-9)


@pytest.mark.slow
def test_a_datum_that_fails_does_not_stop_the_rest(reconstruction: MetricReconstruction, tmp_path: Path) -> None:
    """Datum A is the underside of a block, which no photo shows: it is named, and all else is measured."""
    whole = part()
    underside = Datum("A", "plane", "block_2", (55.0, -60.0, 0.0), (0.0, 0.0, -1.0))
    found = measure(
        reconstruction,
        replace(whole, datums=(underside, *whole.datums[1:])),
        MeasureOptions(methods=("sweep", "edges")),
    )
    system = found.datum_system
    assert system is not None and system.frame == "partial" and [one.label for one in system.not_measured] == ["A"]
    failed = system.not_measured[0]
    assert "clear of other components; nor by its edges" in failed.reason and failed.feature == "plane"
    assert failed.instead[0].startswith("plane at ("), failed.instead
    assert "best fit of plate" in failed.instead[-1]
    assert any(
        text.startswith("datum A (plane): ") and "Could be measured: plane at" in text for text in found.warnings
    )
    assert {datum.label: datum.locked for datum in system.datums} == {"plate": "rx ry tz", "B": "tx ty", "C": "rz"}
    for name, (shift, _) in TRUTH.items():
        one = found.find(name)
        assert one is not None and one.distance_mm is not None and one.uncertainty_mm is not None
        error = np.array(one.displacement_mm, dtype=float) - shift
        assert np.linalg.norm(error) < 0.15 and abs(one.distance_mm - np.linalg.norm(shift)) < one.uncertainty_mm
    verdicts = {one.name: one.verdict for one in found.components}
    assert verdicts["block_2"] is Verdict.UNDECIDED and verdicts["block_1"] is verdicts["block_4"] is Verdict.FAIL
    save_inspection(found, tmp_path / "partial.json")
    assert load_inspection(tmp_path / "partial.json") == found


@pytest.mark.slow
def test_a_plane_without_texture_is_carried_by_its_edges(tmp_path: Path) -> None:
    """Everything is painted in one grey: datum A is measured by the borders and holes of its face."""

    def paint(points: Array) -> Array:
        return np.where(points[:, 2] > 0.01, 150.0, 90.0)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(photo_scene, "PAINT", paint)
        painted = _photographed(tmp_path)
    found = measure(painted, part(), MeasureOptions(methods=("sweep", "edges")))
    system = found.datum_system
    assert system is not None and system.frame == "datums" and not system.not_measured
    assert (system.datums[0].label, system.datums[0].feature, system.datums[0].method) == ("A", "plane", "edges")
    assert system.datums[0].locked == "rx ry tz" and system.datums[1].locked == "tx ty"
    for name, (shift, _) in TRUTH.items():
        one = found.find(name)
        assert one is not None and one.distance_mm is not None and one.uncertainty_mm is not None
        assert np.linalg.norm(np.array(one.displacement_mm, dtype=float) - shift) < 0.15  # a pixel is 0.58 mm
        assert abs(one.distance_mm - np.linalg.norm(shift)) < one.uncertainty_mm < 0.4


@pytest.mark.slow
def test_verdicts_and_findings(inspection: Inspection) -> None:
    verdicts = {component.name: component.verdict for component in inspection.components}
    assert verdicts["block_1"] is Verdict.FAIL  # 1.17 mm, 0.5 allowed
    assert verdicts["block_2"] is Verdict.PASS
    assert verdicts["block_3"] is Verdict.FAIL  # in its place, but turned by 2°, 1° allowed
    turned = inspection.find("block_3")
    assert turned is not None and turned.details is not None and turned.twist_deg == pytest.approx(2.0, abs=0.25)
    assert any("turned by" in note for note in turned.details.notes)
    missing = inspection.find("block_4")
    assert missing is not None and missing.finding is not None and missing.distance_mm is None


@pytest.mark.slow
def test_without_tolerances_components_are_measured_not_judged(reconstruction: MetricReconstruction) -> None:
    bare = part()
    settings = tuple(
        replace(one, position_tolerance_mm=None, angle_tolerance_deg=1.0 if one.name == "block_3" else None)
        for one in bare.settings
    )
    found = measure(reconstruction, replace(bare, settings=settings), MeasureOptions(methods=("edges",)))
    verdicts = {one.name: one.verdict for one in found.components}
    assert verdicts["block_1"] is verdicts["block_2"] is Verdict.MEASURED
    assert verdicts["block_3"] is Verdict.FAIL  # turned by 2°, 1° allowed, without a tolerance of its position
    assert verdicts["block_4"] is Verdict.FAIL  # missing
    only = replace(found, components=tuple(one for one in found.components if one.name in ("block_1", "block_2")))
    assert overall_verdict(only) is Verdict.MEASURED


@pytest.mark.slow
def test_budget_and_datums(inspection: Inspection) -> None:
    measured = [c for c in inspection.components if c.distance_mm is not None and c.details is not None]
    assert {component.name for component in measured} == set(TRUTH)
    for component in measured:
        assert component.distance_mm is not None and component.details is not None
        lines = [line.std_mm for line in component.details.budget]
        assert lines == sorted(lines, reverse=True)
        k = component.details.k
        assert k is not None and 1.9 < k < 4.0
        assert component.uncertainty_mm == pytest.approx(k * np.sqrt(np.sum(np.square(lines))), rel=0.02)
        low, high = component.details.interval_mm or (0.0, 0.0)
        assert low <= component.distance_mm <= high
        assert {method.method for method in component.details.methods} == {"sweep", "edges"}
    system = inspection.datum_system
    assert system is not None
    assert [datum.locked for datum in system.datums] == ["rx ry tz", "tx ty", "rz"]
    # The rough frame was 0.27 mm and 0.06° off: the datums find it.
    found = np.array(system.rough_from_datum)
    for point in ([0.0, 0.0, 0.0], [80.0, 80.0, 0.0]):
        off = apply(found, [point]) - apply(ROUGH_FROM_TRUE, [point])
        assert np.linalg.norm(off) < 0.1  # rims of 28 px across, in twelve photos
    assert inspection.provenance.photos == 12 and inspection.provenance.photos_hash


@pytest.mark.slow
def test_without_datums_the_base_is_the_frame(reconstruction: MetricReconstruction) -> None:
    options = MeasureOptions(methods=("edges",), uncertainty=UncertaintyOptions(monte_carlo=False))
    found = measure(reconstruction, part(datums=False), options)
    assert found.datum_system is not None
    assert "best fit of plate" in found.datum_system.notes[0]
    block = found.find("block_1")
    assert block is not None
    assert np.array(block.displacement_mm, dtype=float) == pytest.approx([1.0, -0.6, 0.0], abs=0.12)


@pytest.mark.slow
def test_a_datum_that_is_not_there(reconstruction: MetricReconstruction) -> None:
    filled = replace(part(), datums=(*part().datums[:2], replace(part().datums[2], point_in_model=(0.0, 40.0, 0.0))))
    with pytest.raises(InputError, match="datum C: 'plate' has no hole of ⌀16 mm about"):
        run.align_to_datums(reconstruction, _views(reconstruction), filled, ["plate"], {})
    covered = replace(part(), datums=(replace(part().datums[0], point_in_model=(0.0, 0.0, 3.0)),))
    with pytest.raises(InputError, match="datum A: 'plate' has no flat face"):
        run.align_to_datums(reconstruction, _views(reconstruction), covered, ["plate"], {})


def _views(reconstruction: MetricReconstruction) -> Any:
    return run.load_views(reconstruction.sparse, nominal())


@pytest.mark.slow
def test_an_inconsistent_reconstruction_is_refused(reconstruction: MetricReconstruction) -> None:
    bad = replace(reconstruction, scale=replace(reconstruction.scale, consistency=Consistency(False, "bent")))
    with pytest.raises(InputError, match="bent; take other photos"):
        measure(bad, part())
    with pytest.raises(InputError, match="expected some of sweep"):
        MeasureOptions(methods=("touch",))  # type: ignore[arg-type]
    only_base = replace(part(), settings=(ComponentSettings("plate", "base"),))
    with pytest.raises(InputError, match="no component has the role 'inspect'"):
        measure(reconstruction, only_base)


# --- features in the CAD ---------------------------------------------------------------------------------


def test_rims_and_planes_of_the_cad() -> None:
    up = np.array([0.0, 0.0, 1.0])
    rim = find_rim(nominal(), part().datums[1], up)
    assert rim.center == pytest.approx([-50, 0, 0], abs=1e-6) and rim.radius_mm == pytest.approx(8.0, abs=1e-6)
    assert rim.other_center == pytest.approx([-50, 0, -8], abs=1e-6)
    assert find_rim(nominal(), part().datums[1], -up).center[2] == pytest.approx(-8.0)
    samples = plane_samples(nominal().component("plate"), part().datums[0], 500)
    assert 400 < len(samples) < 600 and np.abs(samples[:, 2]).max() < 1e-9
    apart = np.linalg.norm(samples[:, None, :2] - np.array([[-50.0, 0.0], [50.0, 0.0]]), axis=2)
    assert apart.min() > 7.9
    plane = base_plane(nominal().component("plate"), up)
    assert plane is not None and plane.direction_in_model == pytest.approx((0, 0, 1), abs=1e-9)
    assert plane.point_in_model[2] == pytest.approx(0.0)


def test_datums_of_a_part_file(tmp_path: Path) -> None:
    (tmp_path / "part.obj").write_text(obj_text("plate", *box((0, 0, 0), (4, 3, 2))), encoding="utf-8")
    text = '[part]\ncad = "part.obj"\nunit = "mm"\n'
    names = [c.name for c in load_part(tmp_path / "part.obj", "mm").model.components]
    text += f'[datums.A1]\nfeature = "point"\ncomponent = "{names[0]}"\npoint_mm = [1, 2, 3]\nnormal = [0, 0, 2]\n'
    text += f'[datums.F]\nfeature = "fit"\ncomponent = "{names[0]}"\nlocks = ["rz", "tx"]\n'
    (tmp_path / "part.toml").write_text(text, encoding="utf-8")
    point, fit = load_part(tmp_path / "part.toml").datums
    assert point.feature == "point" and point.direction_in_model == (0.0, 0.0, 1.0) and len(point.locks) == 6
    assert fit.feature == "fit" and fit.locks == ("rz", "tx")
    (tmp_path / "part.toml").write_text(text.replace('"rz", "tx"', '"spin"'), encoding="utf-8")
    with pytest.raises(InputError, match=r'locks = .*"rx", "ry"'):
        load_part(tmp_path / "part.toml")


# --- the command -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_command(inspection: Inspection, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    seen: list[MeasureOptions] = []

    def fake(reconstruction: object, part: Part, options: MeasureOptions, progress: object) -> Inspection:
        seen.append(options)
        return inspection

    monkeypatch.setattr("arview.measurement.measure", fake)
    monkeypatch.setattr("arview.measurement.read_folder", lambda *args: None)
    monkeypatch.setattr("arview.cad.load_part", lambda path, unit: part())
    out = tmp_path / "inspection.json"
    arguments = ["measure", str(tmp_path), "--part", "p.toml", "-o", str(out)]
    result = CliRunner().invoke(main, [*arguments, "--guard", "0.5", "--methods", "edges,sweep", "--tolerance", "0.4"])
    assert result.exit_code == ExitCode.FAIL, result.output  # block_1 fails
    assert seen[0].methods == ("sweep", "edges") and seen[0].decision.guard == 0.5 and seen[0].tolerance_mm == 0.4
    assert load_inspection(out, nominal()) == inspection
    lines = result.output.splitlines()
    row = next(line for line in lines if line.startswith("block_1"))
    assert "fail" in row and "1.1" in row
    assert any(line.startswith("datum B (hole of plate) locks tx ty") for line in lines)
    assert any("missing: block_4" in line for line in lines)
    good = replace(inspection, components=tuple(c for c in inspection.components if c.name == "block_2"))
    monkeypatch.setattr("arview.measurement.measure", lambda *args, **named: good)
    assert CliRunner().invoke(main, arguments).exit_code == 0
    undecided = replace(good, components=(replace(good.components[0], verdict=Verdict.UNDECIDED),))
    monkeypatch.setattr("arview.measurement.measure", lambda *args, **named: undecided)
    assert CliRunner().invoke(main, arguments).exit_code == ExitCode.UNDECIDED


def test_folders_that_hold_no_measurement(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        read_folder(tmp_path / "absent")
    with pytest.raises(InputError, match=r"scale.json: is missing"):
        read_folder(tmp_path)
    scale = ScaleResult(None, None, None, None, (), (), "not found", Consistency(True, ""))
    (tmp_path / "scale.json").write_text(json.dumps(scale.provenance()), encoding="utf-8")
    with pytest.raises(InputError, match="arbitrary unit"):
        read_folder(tmp_path)
    (tmp_path / "scale.json").write_text(json.dumps(replace(scale, scale=2.0).provenance()), encoding="utf-8")
    with pytest.raises(InputError, match="no CAD frame, because the part was not found in the photos: not found"):
        read_folder(tmp_path)
    known = replace(scale, scale=2.0, scale_std=1e-4, model_from_scan=np.eye(4))
    (tmp_path / "scale.json").write_text(json.dumps(known.provenance()), encoding="utf-8")
    listed = {"photos": [{"name": "a.jpg", "lens": "x", "width": 640, "height": 480}]}
    (tmp_path / "photos.json").write_text(json.dumps(listed), encoding="utf-8")
    with pytest.raises(InputError, match=r"a.jpg: photo not found; give the folder of the photos"):
        read_folder(tmp_path)
    (tmp_path / "a.jpg").write_bytes(b"x")
    with pytest.raises(InputError, match="the sparse model is missing or damaged"):
        read_folder(tmp_path, tmp_path)
