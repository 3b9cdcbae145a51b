"""The whole run: photos of a rendered part → poses, millimetres, frame, cloud; resuming; bad input in clear words."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

import arview.reconstruction.run as run
from arview.cad import Model, Part, load_part
from arview.cad.model import make_model
from arview.cli import main
from arview.errors import CannotMeasureError
from arview.geometry import Array, apply, invert, rotation_angle_rad
from arview.reconstruction.dense import DenseOptions
from arview.reconstruction.features import FeatureOptions
from arview.reconstruction.run import Reconstruction, ReconstructOptions, reconstruct
from arview.reconstruction.scale.similarity import fit_points
from arview.reconstruction.sparse import SparseOptions
from helpers.cad_files import obj_text
from helpers.photo_scene import CAMERA, bench, photograph, ring, write_photos
from helpers.synthetic import bracket

OPTIONS = ReconstructOptions(
    sparse=SparseOptions(features=FeatureOptions(max_features=2500), first_features=1500),
    dense=DenseOptions(max_region_px=120_000),
)
POSES = ring(14)
SHIFT_MM = np.array([1.0, -0.6, 0.0])


def write_obj(path: Path, model: Model) -> None:
    """All components of a model as an OBJ file in mm."""
    text, offset = "", 0
    for one in model.components:
        text += obj_text(one.name, one.vertices_in_model, one.faces.astype(np.int64), offset)
        offset += len(one.vertices_in_model)
    path.write_text(text, encoding="utf-8")


def part_model() -> Model:
    """The scene without the bench it lies on: what the CAD holds."""
    return make_model("part", bench().components[1:])


def as_built() -> Model:
    """The scene with one block out of its place."""
    moved = [
        replace(one, vertices_in_model=one.vertices_in_model + SHIFT_MM) if one.name == "block_2" else one
        for one in bench().components
    ]
    return make_model("as_built", tuple(moved))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``photos/``, ``part.obj`` and ``part.toml``."""
    place = tmp_path_factory.mktemp("run")
    write_photos(place / "photos", [photograph(as_built(), pose) for pose in POSES])
    write_obj(place / "part.obj", part_model())
    text = '[part]\ncad = "part.obj"\nunit = "mm"\n[components.plate]\nrole = "base"\n'
    (place / "part.toml").write_text(text, encoding="utf-8")
    return place


@pytest.fixture(scope="module")
def part(folder: Path) -> Part:
    return load_part(folder / "part.toml")


@pytest.fixture(scope="module")
def found(folder: Path, part: Part, tmp_path_factory: pytest.TempPathFactory) -> Reconstruction:
    cache = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("arview.guideviews.cache.cache_folder", lambda: cache)
        return reconstruct(folder / "photos", folder / "out", part, options=OPTIONS)


def frame_error(found: Reconstruction) -> tuple[float, Array]:
    """Scale error, and what takes the found frame to the true one."""
    assert found.sparse is not None
    truth = {f"img_{i:03d}.png": pose for i, pose in enumerate(POSES)}
    centres = np.array([photo.centre_in_scan for photo in found.sparse.photos])
    true = np.array([invert(truth[photo.name])[:3, 3] for photo in found.sparse.photos])
    fit = fit_points(centres, true).similarity
    return fit.scale - 1.0, fit.model_from_scan


@pytest.mark.slow
def test_scale_and_frame_come_from_the_cad(found: Reconstruction) -> None:
    assert found.is_metric and found.sparse is not None and len(found.sparse.photos) == len(POSES)
    scale_error, true_from_found = frame_error(found)
    assert abs(scale_error) < 1.5e-3
    assert np.linalg.norm(apply(true_from_found, [0.0, 0.0, 0.0])) < 0.4
    assert np.degrees(rotation_angle_rad(true_from_found, np.eye(4))) < 0.15
    assert found.scale is not None and found.scale.consistency.is_consistent


@pytest.mark.slow
def test_cloud_lies_on_the_part_as_built(found: Reconstruction) -> None:
    assert found.cloud is not None and len(found.cloud.points) > 3000
    scale_error, true_from_found = frame_error(found)
    points = apply(true_from_found, (1.0 + scale_error) * found.cloud.points)
    on_plate = (np.abs(points[:, 2]) < 2.0) & (np.abs(points[:, :2]).max(axis=1) < 90)
    assert np.median(np.abs(points[on_plate, 2])) < 0.15
    # The displaced block: its sides stand where it was built, not where the CAD has it.
    low, high = as_built().components[3].bounds_in_model
    on_side = (np.abs(points[:, 0] - high[0]) < 2.5) & (points[:, 2] > 4) & (points[:, 2] < high[2] - 4)
    on_side &= (points[:, 1] > low[1] + 4) & (points[:, 1] < high[1] - 4)
    assert np.count_nonzero(on_side) > 30
    assert abs(np.median(points[on_side, 0]) - high[0]) < 0.25


@pytest.mark.slow
def test_summary_holds_what_was_found(found: Reconstruction, folder: Path) -> None:
    content = json.loads((folder / "out" / "reconstruction.json").read_text())
    assert content["unit"] == "mm" and len(content["photos"]) == len(POSES)
    assert content["quality"]["reprojection_rms_px"] < 1.0
    assert content["scale"]["evidence"][0]["kind"] == "cad"
    first = content["photos"]["img_000.png"]
    assert 0 < first["std_position"] < 2.0
    assert first["camera"]["fx"] == pytest.approx(CAMERA.fx, rel=2e-3)
    for name in (
        "photos.json",
        "scale.json",
        "cloud.ply",
        "sparse/points.ply",
        "sparse/model/images.bin",
        "metric/images.bin",
    ):
        assert (folder / "out" / name).stat().st_size > 0


@pytest.mark.slow
def test_finished_stages_are_read_not_repeated(
    found: Reconstruction, folder: Path, part: Part, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*args: Any, **kwargs: Any) -> Any:
        raise AssertionError("was repeated")

    for name in ("reconstruct_sparse", "find_scale", "reconstruct_dense"):
        monkeypatch.setattr(run, name, refuse)
    again = reconstruct(folder / "photos", folder / "out", part, options=OPTIONS)
    assert again.sparse is not None and found.sparse is not None and again.cloud is not None and found.cloud is not None
    assert np.allclose(again.sparse.points_in_scan, found.sparse.points_in_scan)
    assert np.allclose(again.cloud.points, found.cloud.points, atol=1e-3)
    assert again.sparse.pose_covariance is not None
    other = replace(OPTIONS, dense=replace(OPTIONS.dense, seed=5))
    with pytest.raises(AssertionError, match="repeated"):
        reconstruct(folder / "photos", folder / "out", part, options=other)


def test_results_after_a_repeated_stage_are_removed(tmp_path: Path) -> None:
    """A cloud of an earlier run never stands beside a new scale, whether or not this run reaches the cloud."""
    files = ("photos.json", "sparse/points.ply", "sparse/covariance.npy", "scale.json", "metric/a.bin", "cloud.ply")

    def left(begin: run.StageName | None, options: ReconstructOptions) -> list[str]:
        for name in files:
            (tmp_path / name).parent.mkdir(exist_ok=True)
            (tmp_path / name).write_text("old")
        one = run._ReconstructionRun(tmp_path, None, options, lambda what, done, total: None)
        if begin:
            one._restart(begin)
        return [name for name in files if (tmp_path / name).exists()]

    assert left(None, ReconstructOptions()) == list(files)
    assert left("dense", ReconstructOptions()) == list(files[:5])
    assert left("scale", ReconstructOptions()) == list(files[:3])
    assert left("sparse", ReconstructOptions()) == ["photos.json"]
    assert left(None, ReconstructOptions(starts_over=True)) == []


# --- bad input -------------------------------------------------------------------------------------------


def command(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["reconstruct", *(str(argument) for argument in arguments)])


def says(result: Result, *words: str) -> bool:
    """One line on stderr with the words, exit code 64, no traceback."""
    lines = result.stderr.strip().splitlines()
    return result.exit_code == 64 and "Traceback" not in result.stderr and all(word in lines[-1] for word in words)


def test_missing_and_empty_folders(tmp_path: Path) -> None:
    assert says(command(tmp_path / "none", "-o", tmp_path / "out"), "no such folder")
    (tmp_path / "empty").mkdir()
    assert says(command(tmp_path / "empty", "-o", tmp_path / "out"), "no photos")


@pytest.mark.slow
def test_two_photos_are_too_few(folder: Path, tmp_path: Path) -> None:
    for name in ("img_000.png", "img_001.png"):
        shutil.copy(folder / "photos" / name, tmp_path)
    assert says(command(tmp_path, "-o", tmp_path / "out"), "2")


@pytest.mark.slow
def test_output_cannot_be_a_file_or_the_photos(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    assert says(command(folder / "photos", "-o", tmp_path / "file"), "is a file")
    assert says(command(folder / "photos", "-o", folder / "photos"), "folder of the photos")


@pytest.mark.slow
def test_wrong_board_is_named(folder: Path, tmp_path: Path) -> None:
    assert says(command(folder / "photos", "-o", tmp_path / "o", "--board", "charuco:8"), "charuco:8")


@pytest.mark.slow
def test_a_broken_photo_among_good_ones_is_named(folder: Path, tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    shutil.copytree(folder / "photos", photos)
    whole = (photos / "img_003.png").read_bytes()
    (photos / "img_003.png").write_bytes(whole[: len(whole) // 2])
    (photos / "img_005.png").write_bytes(b"")
    result = command(photos, "-o", tmp_path / "out", "--until", "photos")
    assert result.exit_code == 0, result.output
    assert "left out img_003.png" in result.stderr and "left out img_005.png" in result.stderr


@pytest.mark.slow
def test_photos_of_another_part_give_no_frame(
    found: Reconstruction, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The photos are good, but the CAD is another part's: no scale, no frame, and it is said."""
    monkeypatch.setattr("arview.guideviews.cache.cache_folder", lambda: tmp_path)
    monkeypatch.setattr("arview.reconstruction.scale.cad.FIRST_DETECTIONS", 2)
    write_obj(tmp_path / "other.obj", bracket())
    shutil.copytree(folder / "out" / "sparse", tmp_path / "out" / "sparse")
    shutil.copy(folder / "out" / "stages.json", tmp_path / "out")
    other = load_part(tmp_path / "other.obj", "mm")
    options = replace(OPTIONS, last_stage="scale")
    result = reconstruct(folder / "photos", tmp_path / "out", other, options=options)
    assert result.scale is not None and result.scale.model_from_scan is None
    assert result.scale.scale is None and result.scale.why_no_frame
    assert not result.is_metric
    with pytest.raises(CannotMeasureError, match=r"was not found in the photos: .* Is it this part"):
        reconstruct(folder / "photos", tmp_path / "out", other, options=replace(OPTIONS, needs_scale=True))
    assert not (tmp_path / "out" / "cloud.ply").exists()
