"""`--masks auto`: masks hold all that may be displaced, and place a part whose background moves."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from arview.cad import Part, load_part
from arview.cad.model import Model, make_model
from arview.cli import main
from arview.errors import CannotMeasureError, InputError
from arview.geometry import Array, rigid, rotation_angle_rad
from arview.measurement.photo import edges, sweep
from arview.reconstruction.dense import DenseOptions
from arview.reconstruction.features import FeatureOptions
from arview.reconstruction.memory import SparseMemory
from arview.reconstruction.run import Reconstruction, ReconstructOptions, reconstruct
from arview.reconstruction.sparse import SparseOptions
from arview.workflow.job import InspectJob
from arview.workflow.prepare import measurement_key, prepare
from arview.workflow.silhouettes import MARGIN_MM, CadSilhouettes, SilhouetteOptions, silhouette_mask
from helpers.cad_files import obj_text, write_bench
from helpers.photo_scene import CAMERA, Picture, bench, photograph, ring, write_photos

POSES = ring(12, 420.0, (40.0, 60.0))
STEP_PX = 40
"""By this the background moves from photo to photo."""
MOVED_MM = np.array([1.2, -0.8, 0.0])
OPTIONS = ReconstructOptions(
    sparse=SparseOptions(features=FeatureOptions(max_features=2500), first_features=1500, threads=2),
    dense=DenseOptions(max_region_px=60_000), last_stage="scale",
)  # fmt: skip


def part_model() -> Model:
    """The plate with its blocks, without the bench."""
    return make_model("part", bench().components[1:])


def write_part(folder: Path) -> Part:
    """The CAD as a file, read again."""
    text, offset = "", 0
    for one in part_model().components:
        text += obj_text(one.name, one.vertices_in_model, one.faces.astype(np.int64), offset)
        offset += len(one.vertices_in_model)
    (folder / "part.obj").write_text(text, encoding="utf-8")
    return load_part(folder / "part.obj", "mm")


def part_pixels(pose: Array, moves: dict[str, Array] | None = None) -> np.ndarray:
    """(H,W) where the part, with moved components, is in its picture."""
    return np.asarray(np.abs(photograph(part_model(), pose, noise=0.0, moves=moves)[..., 0].astype(int) - 30) > 3)


def pictures(step_px: int) -> list[Picture]:
    """The part with one displaced block, before a wall with texture that moves by some px from photo to photo."""
    rng = np.random.default_rng(3)
    width = CAMERA.width + len(POSES) * step_px
    wall = np.full((CAMERA.height, width), 120.0)
    for size, weight in ((64, 30.0), (24, 30.0), (8, 30.0), (4, 20.0)):
        small = rng.uniform(-1.0, 1.0, (CAMERA.height // size + 2, width // size + 2))
        wall += weight * cv2.resize(small, (width, CAMERA.height), interpolation=cv2.INTER_CUBIC)
    result = []
    for i, pose in enumerate(POSES):
        clean = photograph(part_model(), pose, noise=0.0, moves={"block_2": rigid(np.eye(3), MOVED_MM)})[..., 0]
        part = cv2.erode((np.abs(clean.astype(int) - 30) > 0).astype(np.uint8), np.ones((3, 3))) > 0
        grey = np.where(part, clean, wall[:, step_px * i : step_px * i + CAMERA.width])
        noisy = np.clip(grey + rng.normal(0.0, 2.0, part.shape), 0, 255).astype(np.uint8)
        result.append(np.repeat(noisy[..., None], 3, axis=2))
    return result


def of_photos(folder: Path, step_px: int) -> tuple[Path, Part]:
    """A folder with photos, and the part."""
    write_photos(folder / "photos", pictures(step_px))
    return folder / "photos", write_part(folder)


def check_poses(found: Reconstruction, min_placed: int = 11) -> None:
    """The photos are placed, and turned to the CAD as they really were."""
    assert found.sparse is not None and len(found.sparse.photos) >= min_placed
    turns = [
        rotation_angle_rad(photo.cam_from_scan[:3, :3], POSES[int(photo.name[4:7])][:3, :3])
        for photo in found.sparse.photos
    ]
    assert np.degrees(max(turns)) < 0.2


def off_part_mm(found: Reconstruction) -> np.ndarray:
    """Distance of each sparse point from the box of the part."""
    assert found.sparse is not None and len(found.sparse.points_in_scan) > 300
    low, high = part_model().bounds_in_model
    points = found.sparse.points_in_scan
    return np.asarray(np.linalg.norm(np.maximum(0.0, np.maximum(low - points, points - high)), axis=1))


def test_the_margin_covers_what_is_searched() -> None:
    searched = max(sweep.CAPTURE_MM, edges.CAPTURE_MM, DenseOptions().band_mm)
    assert 2.0 * searched <= MARGIN_MM


@pytest.mark.parametrize("pose", POSES[:4])
@pytest.mark.parametrize("move", [(5.0, 0, 0), (0, -5.0, 0), (0, 0, 5.0), (-6.0, 6.0, 0)])
def test_displaced_components_are_inside(pose: Array, move: tuple[float, float, float]) -> None:
    # The plate's corner, the farthest outward of all, is displaced with the blocks.
    moves = {one.name: rigid(np.eye(3), np.array(move)) for one in part_model().components}
    seen = part_pixels(pose, moves)
    mask = silhouette_mask(part_model(), pose, CAMERA, MARGIN_MM)
    assert seen.sum() > 50_000 and mask.shape == seen.shape
    assert not (seen & ~mask).any()


def test_a_mask_without_margin_is_the_part_in_the_distorted_photo() -> None:
    pose = ring(16, 420.0, (40.0, 60.0))[1]
    seen, mask = part_pixels(pose), silhouette_mask(part_model(), pose, CAMERA, 0.0, SilhouetteOptions(edge_px=0.0))
    inner = cv2.erode(seen.astype(np.uint8), np.ones((5, 5))) > 0
    outer = cv2.dilate(cv2.morphologyEx(seen.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((9, 9))), np.ones((5, 5))) > 0
    assert inner.sum() > 40_000 and not (inner & ~mask).any() and not (mask & ~outer).any()


def test_masks_of_what_is_not_seen(tmp_path: Path) -> None:
    away = rigid(np.eye(3), np.array([5000.0, 0.0, 420.0]))
    assert not silhouette_mask(part_model(), away, CAMERA, 10.0).any()
    behind = rigid(np.eye(3), np.array([0.0, 0.0, -900.0]))
    assert not silhouette_mask(part_model(), behind, CAMERA, 10.0).any()
    beside = POSES[0].copy()
    beside[0, 3] += 260.0  # only a corner is in the photo
    mask = silhouette_mask(part_model(), beside, CAMERA, 10.0)
    assert 0.01 < mask.mean() < 0.5 and not mask[:, : CAMERA.width // 3].any()
    large = CAMERA.scaled(2560, 1920)
    assert silhouette_mask(part_model(), POSES[0], large, 10.0).shape == (750, 1000)


@pytest.mark.slow  # structure from motion of 12 photos, twice
def test_a_part_before_a_moving_background_is_placed_by_itself(tmp_path: Path) -> None:
    photos, part = of_photos(tmp_path, STEP_PX)
    memory = SparseMemory(tmp_path / "features")
    with pytest.raises(CannotMeasureError):
        reconstruct(photos, tmp_path / "whole", part, "fov:47", OPTIONS, memory=memory)
    options = replace(OPTIONS, silhouettes=CadSilhouettes(part))
    found = reconstruct(photos, tmp_path / "auto", part, "fov:47", options, memory=memory)
    check_poses(found)
    assert np.mean(off_part_mm(found) < 3.0) > 0.95  # the rest are features on the outline, with wall beside it
    assert found.scale is not None and any("by the part alone" in one for one in found.scale.warnings)
    masks = sorted((tmp_path / "auto" / "silhouettes").glob("*.png"))
    assert len(masks) >= 11
    listed = json.loads((tmp_path / "auto" / "reconstruction.json").read_text())["photos"]
    assert all(Path(one["mask"]).is_file() for one in listed.values())
    again = reconstruct(photos, tmp_path / "auto", part, "fov:47", options)
    assert "sparse" not in again.seconds and again.sparse is not None and found.sparse is not None
    assert [one.mask for one in again.sparse.photos] == [one.mask for one in found.sparse.photos]
    masks[0].unlink()
    with pytest.raises(InputError, match="mask is missing"):
        reconstruct(photos, tmp_path / "auto", part, "fov:47", options)


@pytest.mark.slow  # dense cloud and measurement, twice
def test_masks_do_not_change_what_is_measured(tmp_path: Path) -> None:
    from arview.measurement.folder import MetricReconstruction
    from arview.measurement.run import measure

    photos, part = of_photos(tmp_path, 0)
    options, memory = replace(OPTIONS, last_stage="dense"), SparseMemory(tmp_path / "features")
    results = []
    for name, silhouettes in (("whole", None), ("auto", CadSilhouettes(part))):
        chosen = replace(options, silhouettes=silhouettes)
        one = reconstruct(photos, tmp_path / name, part, "fov:47", chosen, memory=memory)
        check_poses(one)
        assert one.sparse is not None and one.scale is not None and one.cloud is not None
        measured = measure(MetricReconstruction(one.sparse, one.scale, one.cloud), part)
        results.append((one, {component.name: component for component in measured.components}))
    (whole, without), (auto, masked) = results
    assert whole.cloud is not None and auto.cloud is not None and len(whole.cloud.points) > 50_000
    assert len(auto.cloud.points) == len(whole.cloud.points)
    for name in ("block_1", "block_2", "block_3", "block_4"):
        here, there = (np.array(of_run[name].displacement_mm, dtype=float) for of_run in (without, masked))
        u_mm = masked[name].uncertainty_mm
        assert np.isfinite(there).all() and u_mm is not None and np.linalg.norm(here - there) <= u_mm
    moved, u_mm = np.array(masked["block_2"].displacement_mm, dtype=float), masked["block_2"].uncertainty_mm
    assert np.linalg.norm(moved - MOVED_MM) < 0.2 and u_mm is not None and u_mm < 0.2  # a pixel is 0.6 mm


def test_auto_folder_and_none_have_keys_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_bench(tmp_path)
    (tmp_path / "photos").mkdir()
    for i in range(4):
        (tmp_path / "photos" / f"{i}.jpg").write_bytes(bytes([i]) * 100)
    (tmp_path / "auto").mkdir()
    cv2.imwrite(str(tmp_path / "auto" / "0.jpg.png"), np.full((4, 4), 255, np.uint8))
    monkeypatch.chdir(tmp_path)
    job = InspectJob("bench.obj", "photos", unit="mm")
    prepared = [prepare(replace(job, masks=masks), tmp_path / "out") for masks in (None, "auto", "./auto")]
    assert len({measurement_key(one) for one in prepared}) == 3
    assert [one.reconstruct.silhouettes is not None for one in prepared] == [False, True, False]
    assert [one.reconstruct.masks for one in prepared] == [None, None, Path("auto")]
    with pytest.raises(InputError, match="atuo: no such folder; give the folder of the masks, or auto"):
        prepare(replace(job, masks="atuo"), tmp_path / "out")


def test_auto_needs_the_cad(tmp_path: Path) -> None:
    photos = write_photos(tmp_path / "photos", [np.zeros((8, 8, 3), np.uint8)])[0].parent
    result = CliRunner().invoke(main, ["reconstruct", str(photos), "-o", str(tmp_path / "out"), "--masks", "auto"])
    assert result.exit_code != 0 and "--part" in result.output and "Traceback" not in result.output
    assert not (tmp_path / "out").exists()
