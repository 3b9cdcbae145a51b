"""Scale and rough frame: targets, rig and CAD against exact truth, with noise, and what is said when they fail."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from arview.cad import Part, ViewRange
from arview.cad.model import Component, Model, make_model
from arview.cad.part import ComponentSettings
from arview.cad.part_file import load_part
from arview.camera import Camera
from arview.errors import InputError
from arview.fiducials.board import Board, parse_board, parse_tags
from arview.geometry import Array, apply, exp_se3, exp_so3, invert, look_at, rigid, rotation_angle_rad
from arview.reconstruction.scale import (
    CadOptions,
    Rig,
    ScaleEvidence,
    ScaleResult,
    ScaleSources,
    Similarity,
    find_scale,
    load_rig,
    load_scale_file,
    parse_scale_bar,
)
from arview.reconstruction.scale.find import combine
from arview.reconstruction.scale.similarity import fit_points
from arview.reconstruction.scale.vote import Sighting, vote
from arview.reconstruction.types import PosedPhoto, SparseModel
from helpers.cad_files import box
from helpers.paths import SHARED
from helpers.synthetic import assembly, component, picture, pose_from, post

PLATE = SHARED / "plate"
LENS = Camera(1280, 960, 1500.0, 1502.0, 641.3, 476.8, np.array([-0.08, 0.03, 4e-4, -3e-4, 0.0]))
PLAIN = Camera(960, 720, 1080.0, 1083.0, 477.0, 363.0)
TRUTH = Similarity(123.4, rigid(exp_so3([0.4, -1.1, 0.7]), [310.0, -45.0, 200.0]))
"""Takes the frame of the reconstructions made here to the model."""


def scan_pose(cam_from_model: Array) -> Array:
    """``cam_from_scan`` in the unit of TRUTH."""
    pose = cam_from_model @ TRUTH.model_from_scan
    return rigid(pose[:3, :3], pose[:3, 3] / TRUTH.scale)


def sparse_of(
    poses: list[Array], camera: Camera, points_in_model: Array | None = None, noise_px: float = 0.3
) -> SparseModel:
    """A reconstruction with these ``cam_from_model``, and of points that all photos see."""
    photos = tuple(PosedPhoto(f"{i:02d}.png", Path(), camera, scan_pose(pose)) for i, pose in enumerate(poses))
    points = np.zeros((0, 3)) if points_in_model is None else points_in_model
    count, views = len(points), len(poses)
    return SparseModel(
        photos,
        apply(invert(TRUTH.model_from_scan), points) / TRUTH.scale,
        np.zeros((count, 3), np.uint8),
        np.full(count, noise_px),
        np.tile(np.arange(count, dtype=np.int32), views),
        np.repeat(np.arange(views, dtype=np.int32), count),
        np.concatenate([camera.project(apply(pose, points)) for pose in poses]) if count else np.zeros((0, 2)),
    )


def reader(pictures: list[NDArray[np.uint8]]) -> Callable[[PosedPhoto], NDArray[np.uint8]]:
    return lambda photo: pictures[int(photo.name[:2])]


def frame_error(result: ScaleResult, model: Model) -> tuple[float, float, float]:
    """Scale in %, middle of the part in mm, rotation in deg."""
    assert result.similarity is not None
    in_scan = apply(invert(TRUTH.model_from_scan), model.center_in_model) / TRUTH.scale
    away = result.similarity.points_in_model(in_scan) - model.center_in_model
    angle = rotation_angle_rad(result.similarity.model_from_scan, TRUTH.model_from_scan)
    return (
        100.0 * abs(result.similarity.scale / TRUTH.scale - 1.0), float(np.linalg.norm(away)), float(np.rad2deg(angle))
    )  # fmt: skip


# --- similarities, votes, combination -------------------------------------------------------------------


def test_fit_points_and_its_uncertainty() -> None:
    rng = np.random.default_rng(1)
    z = []
    for _ in range(200):
        points = rng.normal(size=(12, 3)) * [80, 60, 5]
        in_scan = apply(invert(TRUTH.model_from_scan), points) / TRUTH.scale
        fit = fit_points(in_scan, points + rng.normal(size=points.shape) * 0.3)
        z.append(np.log(fit.similarity.scale / TRUTH.scale) / fit.scale_std)
        assert rotation_angle_rad(fit.similarity.model_from_scan, TRUTH.model_from_scan) < np.deg2rad(2.5)
    assert abs(np.mean(z)) < 0.25 and 0.8 < np.std(z) < 1.3
    with pytest.raises(InputError, match="at least three"):
        fit_points(np.zeros((2, 3)), np.zeros((2, 3)))
    with pytest.raises(InputError, match="same place"):
        fit_points(np.ones((5, 3)), np.ones((5, 3)))


def test_moved_is_a_step_about_the_centre() -> None:
    center = np.array([40.0, 10.0, 5.0])
    moved = TRUTH.moved(np.array([0, 0, 0, 0, 0, 0, 0.01]), center)
    assert np.log(moved.scale / TRUTH.scale) == pytest.approx(0.01)
    in_scan = apply(invert(TRUTH.model_from_scan), center) / TRUTH.scale
    np.testing.assert_allclose(moved.points_in_model(in_scan), center, atol=1e-9)
    twist = np.array([0.01, -0.02, 0.005, 0.3, 0.1, -0.2])
    about = rigid(np.eye(3), center)
    for pose in (np.eye(4), scan_pose(pose_from(30, 40, 500))):
        wanted = TRUTH.cam_from_model(pose) @ about @ exp_se3(twist) @ invert(about)
        np.testing.assert_allclose(TRUTH.moved(np.r_[twist, 0], center).cam_from_model(pose), wanted, atol=1e-9)


def test_vote_rejects_wrong_and_near_symmetric_detections() -> None:
    rng = np.random.default_rng(2)
    center, diameter = np.array([80.0, 60.0, 33.0]), 211.0
    about = rigid(np.eye(3), center)
    twin = about @ rigid(exp_so3([0, 0, np.pi]), np.zeros(3)) @ invert(about)
    sightings = []
    for i, azimuth in enumerate((0, 60, 120, 180, 240, 300)):
        pose = pose_from(azimuth, 40, 600)
        noisy = pose @ about @ exp_se3(rng.normal(size=6) * [0.005, 0.005, 0.005, 1, 1, 1]) @ invert(about)
        if i == 1:
            noisy = pose_from(200, 70, 500)
        if i in (2, 4):
            sightings.append(Sighting(i, scan_pose(pose), noisy @ twin, 0.97))
        if i != 2:
            sightings.append(Sighting(i, scan_pose(pose), noisy, 0.9))
    best, *others = vote(sightings, center, diameter)
    assert {s.photo for s in best.sightings} == {0, 3, 4, 5}
    assert np.rad2deg(rotation_angle_rad(best.similarity.model_from_scan, TRUTH.model_from_scan)) < 0.6
    assert best.similarity.scale == pytest.approx(TRUTH.scale, rel=0.01)
    assert others and {s.photo for s in others[0].sightings} == {2, 4}
    assert vote(sightings[:1], center, diameter) == []


def test_combination_by_inverse_variance_and_disagreement() -> None:
    board = ScaleEvidence("board", 100.00, 2e-4, "the board")
    cad = ScaleEvidence("cad", 100.03, 1e-4, "the CAD")
    both = combine([cad, board])
    assert both is not None and both.scale == pytest.approx(100.024, abs=1e-3) and not both.warnings
    assert both.std == pytest.approx(1 / np.sqrt(1 / 4e-8 + 1 / 1e-8) * 1.34, rel=0.01)
    apart = combine([replace(cad, mm_per_unit=101.0), board])
    assert apart is not None and apart.scale == pytest.approx(100.0) and apart.std == pytest.approx(2e-4)
    assert [e.is_used for e in apart.evidence] == [True, False]
    assert "the CAD" in apart.warnings[0] and "the board" in apart.warnings[0] and "+1.000 %" in apart.warnings[0]
    assert combine([]) is None


# --- what is described by the user ----------------------------------------------------------------------


def test_specs() -> None:
    assert parse_board("charuco:8x6:30:22:DICT_5X5_100") == Board("charuco", 8, 6, 30.0, 22.0, "DICT_5X5_100")
    assert parse_board("grid:5x7:30:6:apriltag36h11") == Board("grid", 5, 7, 36.0, 30.0, "DICT_APRILTAG_36h11")
    assert parse_tags("tag36h11:20").side_mm == 20.0
    bar = parse_scale_bar("4x4_50:3:7:500.02")
    assert (bar.dictionary, bar.first, bar.second, bar.length_mm) == ("DICT_4X4_50", 3, 7, 500.02)
    assert parse_scale_bar("3:7:500").dictionary == "DICT_APRILTAG_36h11"


@pytest.mark.parametrize(
    ("parse", "text", "says"),
    [
        (parse_board, "charuco:8x6:30", "expected charuco:COLUMNSxROWS"),
        (parse_board, "charuco:8x6:20:22:DICT_5X5_100", "do not fit"),
        (parse_board, "charuco:8x6:30:22:DICT_9X9", "unknown marker dictionary"),
        (parse_board, "charuco:1x1:30:22:5x5_100", "at least 3×3"),
        (parse_tags, "20", "expected DICTIONARY:SIDE_MM"),
        (parse_tags, "apriltag36h11:-3", "not a positive length"),
        (parse_scale_bar, "3:3:500", "both ends are tag 3"),
        (parse_scale_bar, "3-7-500", "expected ID1:ID2:LENGTH_MM"),
    ],
)
def test_wrong_specs_are_named(parse: Callable[[str], object], text: str, says: str) -> None:
    with pytest.raises(InputError, match=says):
        parse(text)


def test_scale_file(tmp_path: Path) -> None:
    path = tmp_path / "scale.toml"
    path.write_text(
        '[[board]]\nspec = "charuco:8x6:30:22:DICT_5X5_100"\n[[tag]]\ndictionary = "apriltag36h11"\nside_mm = 20\n'
        "ids = [1, 2]\n[[scale_bar]]\nids = [1, 2]\nlength_mm = 400.5\n"
        '[rig]\ndistances_mm = [["a.jpg", "b.jpg", 120.0]]\n'
    )
    sources = load_scale_file(path)
    assert sources.boards[0].columns == 8 and sources.tags[0].ids == (1, 2) and sources.bars[0].length_mm == 400.5
    assert sources.rig == Rig({}, (("a.jpg", "b.jpg", 120.0),))
    for text, says in (
        ("[[boards]]\n", "unknown key 'boards'"),
        ("[[tag]]\nside_mm = 3\n", "'dictionary' is missing"),
        ("[[scale_bar]]\nids = [1]\nlength_mm = 3\n", "expected the ids of two tags"),
        ('[[tag]]\ndictionary = "4x4_50"\nside_mm = 3\nids = [inf, 2]\n', "expected the ids of tags"),
        (f'[[tag]]\ndictionary = "4x4_50"\nside_mm = 1{"0" * 400}\n', "is not a positive length"),
        ("[[scale_bar]]\nids = [1, nan]\nlength_mm = 3\n", "expected the ids of tags"),
        ("[rig]\n", "expected one of"),
        ("[[", "not valid TOML"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=says):
            load_scale_file(path)
    rig = tmp_path / "rig.json"
    rig.write_text(json.dumps({"cam_from_rig_mm": {"a.jpg": rigid(np.eye(3), [1, 2, 3]).tolist()}}))
    np.testing.assert_allclose(load_rig(rig).centres_mm["a.jpg"], [-1, -2, -3])
    for values in ("[1, 2]", f"[1, 2, 1{'0' * 400}]"):
        rig.write_text(f'{{"centres_mm": {{"a": {values}}}}}')
        with pytest.raises(InputError, match="a value is invalid"):
            load_rig(rig)


# --- targets and rig ------------------------------------------------------------------------------------


@cache
def _rays_of(width: int) -> Array:
    u, v = np.meshgrid(np.arange(width), np.arange(LENS.height))
    return LENS.unproject(np.stack([u, v], axis=-1))


def plane_picture(
    sheet: NDArray[np.uint8], mm_per_px: float, cam_from_model: Array, camera: Camera, seed: int
) -> NDArray[np.uint8]:
    """A printed sheet at z = 0, its first pixel's corner at the origin, seen through the lens, with noise."""
    rays = _rays_of(camera.width) @ cam_from_model[:3, :3]
    eye = -cam_from_model[:3, :3].T @ cam_from_model[:3, 3]
    on_plane = eye[:2] - rays[..., :2] * (eye[2] / rays[..., 2])[..., None]
    size = (2 * camera.width, 2 * camera.height)
    place = cv2.resize(on_plane / mm_per_px - 0.5, size, interpolation=cv2.INTER_LINEAR).astype(np.float32)
    seen = cv2.remap(sheet.astype(np.float32), place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderValue=205)
    seen = cv2.resize(cv2.GaussianBlur(seen, (0, 0), 1.0), (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    # The lens blurs light, then the camera applies its curve.
    light = (seen * 0.75 + 4.0) / 255.0
    encoded = 255.0 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    noisy = encoded + np.random.default_rng(seed).normal(0, 2.5, seen.shape)
    return np.asarray(np.clip(noisy, 0, 255).astype(np.uint8))


@cache
def target_scene() -> tuple[list[Array], list[NDArray[np.uint8]]]:
    """Six views of a sheet with a ChArUco board, three tags of 24 mm, and tag 7 at 150 mm from tag 3."""
    mm_per_px = 0.1
    sheet = np.full((2400, 3200), 225, np.uint8)
    charuco = cv2.aruco.CharucoBoard(
        (6, 5), 24.0, 17.0, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    ).generateImage((1440, 1200))
    sheet[150:1350, 150:1590] = charuco
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36H11)
    for index, (x, y) in {3: (400, 1700), 7: (1900, 1700), 9: (2300, 500)}.items():
        sheet[y : y + 240, x : x + 240] = cv2.aruco.generateImageMarker(tags, index, 240)
    middle = np.array([150.0, 110.0, 0.0])
    poses = []
    for azimuth, elevation in ((0, 50), (60, 65), (120, 45), (180, 55), (240, 70), (300, 50)):
        a, e = np.deg2rad([azimuth, elevation])
        eye = middle + 430.0 * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), -np.sin(e)])
        poses.append(look_at(eye, middle, [0.0, 0.0, -1.0]))
    return poses, [
        np.repeat(plane_picture(sheet, mm_per_px, pose, LENS, i)[..., None], 3, axis=2) for i, pose in enumerate(poses)
    ]


@pytest.mark.slow
def test_boards_tags_and_bars_through_a_lens() -> None:
    poses, pictures = target_scene()
    sparse = sparse_of(poses, LENS)
    everything = ScaleSources(
        boards=(parse_board("charuco:6x5:24:17:DICT_5X5_100"),),
        tags=(parse_tags("apriltag36h11:24"),),
        bars=(parse_scale_bar("3:7:150"),),
    )
    result = find_scale(sparse, None, everything, read=reader(pictures))
    assert [e.kind for e in result.evidence] == ["board", "tag", "scale_bar"] and not result.warnings
    for evidence, percent in zip(result.evidence, (0.02, 0.1, 0.03), strict=True):
        off = evidence.mm_per_unit / TRUTH.scale - 1.0
        assert abs(off) < percent / 100 and abs(off) < 3.5 * evidence.std < 2e-2, (evidence, off)
    assert result.scale == pytest.approx(TRUTH.scale, rel=2e-4)
    assert result.scale_std is not None and 1e-4 < result.scale_std < 4e-4
    assert result.model_from_scan is None and result.why_no_frame == "no part was given"
    assert json.loads(json.dumps(result.provenance()))["evidence"][0]["kind"] == "board"


@pytest.mark.slow
def test_a_layout_of_tags_through_a_lens(tmp_path: Path) -> None:
    poses, pictures = target_scene()
    square = np.array([[0.0, 0.0, 0.0], [24.0, 0.0, 0.0], [24.0, 24.0, 0.0], [0.0, 24.0, 0.0]])
    places = {3: [40.0, 170.0, 0.0], 7: [190.0, 170.0, 0.0], 9: [230.0, 50.0, 0.0]}
    path = tmp_path / "layout.json"
    corners = {str(index): (square + place).tolist() for index, place in places.items()}
    path.write_text(json.dumps({"tag_layout": [{"corners_mm": corners, "std_mm": 0.005}]}))
    result = find_scale(sparse_of(poses, LENS), None, load_scale_file(path), read=reader(pictures))
    (evidence,) = result.evidence
    assert evidence.kind == "tag_layout" and "12 corners of 3 tags over" in evidence.detail and not result.warnings
    assert abs(evidence.mm_per_unit / TRUTH.scale - 1.0) < 2.0 * evidence.std < 1e-3
    again = ScaleResult.from_provenance(json.loads(json.dumps(result.provenance())))
    assert again.evidence == result.evidence


def test_boards_without_markers_give_no_scale() -> None:
    with pytest.raises(InputError, match="checkerboard 9×6, 25 mm: nothing tells its corners apart"):
        ScaleSources(boards=(parse_board("checkerboard:9x6:25"),))


@pytest.mark.slow
def test_wrong_board_size_is_noticed_and_absent_targets_are_named() -> None:
    poses, pictures = target_scene()
    sources = ScaleSources(
        boards=(parse_board("charuco:6x5:24:17:DICT_5X5_100"),),
        bars=(parse_scale_bar("3:7:153"), parse_scale_bar("3:8:100")),
    )
    result = find_scale(sparse_of(poses, LENS), None, sources, read=reader(pictures))
    assert result.scale == pytest.approx(TRUTH.scale, rel=2e-4)
    assert any("tag 3 to tag 8" in w and "not seen" in w for w in result.warnings)
    assert any("153 mm" in w and "ChArUco" in w and "+2.0" in w for w in result.warnings)
    nothing = find_scale(
        sparse_of(poses, LENS), None, ScaleSources(bars=(parse_scale_bar("1:2:5"),)), read=reader(pictures)
    )
    assert nothing.scale is None and nothing.evidence == () and len(nothing.warnings) == 1


@pytest.mark.slow
def test_an_outlying_photo_does_not_move_the_board() -> None:
    poses, pictures = target_scene()
    sparse = sparse_of(poses, LENS)
    moved = replace(sparse.photos[2], cam_from_scan=sparse.photos[2].cam_from_scan @ exp_se3([0.01, 0, 0, 0.05, 0, 0]))
    sparse = replace(sparse, photos=(*sparse.photos[:2], moved, *sparse.photos[3:]))
    sources = ScaleSources(boards=(parse_board("charuco:6x5:24:17:DICT_5X5_100"),))
    result = find_scale(sparse, None, sources, read=reader(pictures))
    assert result.scale == pytest.approx(TRUTH.scale, rel=4e-4)


def test_rig() -> None:
    rng = np.random.default_rng(4)
    sparse = sparse_of([pose_from(a, 40 + a / 20, 600) for a in range(0, 360, 40)], PLAIN)
    centres = {p.name: TRUTH.points_in_model(p.centre_in_scan) + rng.normal(size=3) * 0.1 for p in sparse.photos}
    result = find_scale(sparse, None, ScaleSources(rig=Rig(centres)))
    assert result.scale == pytest.approx(TRUTH.scale, rel=4e-4) and result.scale_std is not None
    assert abs(result.scale / TRUTH.scale - 1) < 3.5 * result.scale_std < 2e-3
    names = list(centres)
    pairs = tuple((a, b, float(np.linalg.norm(centres[a] - centres[b]))) for a, b in pairwise(names))
    result = find_scale(sparse, None, ScaleSources(rig=Rig({}, pairs)))
    assert result.scale == pytest.approx(TRUTH.scale, rel=1e-3)
    result = find_scale(sparse, None, ScaleSources(rig=Rig({"00.png": np.zeros(3)}, (("x", "y", 3.0),))))
    assert result.scale is None and len(result.warnings) == 2


# --- the CAD itself -------------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Guide views of these tests are made once a session, away from the user's."""
    folder = tmp_path_factory.getbasetemp() / "arview-cache"
    monkeypatch.setattr("arview.guideviews.cache.cache_folder", lambda: folder)


@pytest.fixture(autouse=True)
def _few_views_and_tries(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer guide views and tries than usual, for time."""
    monkeypatch.setattr("arview.reconstruction.scale.cad.SUBDIVISIONS", 2)
    monkeypatch.setattr("arview.reconstruction.scale.cad.FIRST_DETECTIONS", 3)


def find(
    sparse: SparseModel, part: Part, sources: ScaleSources | None = None, *, pictures: list[NDArray[np.uint8]]
) -> ScaleResult:
    return find_scale(sparse, part, sources, CadOptions(), reader(pictures))


def part_of(model: Model, base: str) -> Part:
    settings = tuple(ComponentSettings(c.name, "base" if c.name == base else "inspect") for c in model.components)
    return Part(model.name, Path(), Path(), model, settings, ViewRange((300.0, 900.0), (25.0, 70.0)))


def shifted(model: Model, moves: dict[str, tuple[float, float, float]]) -> Model:
    return make_model(
        "as built",
        tuple(
            replace(c, vertices_in_model=c.vertices_in_model + moves.get(c.name, (0, 0, 0))) for c in model.components
        ),
    )


def ring(model: Model, count: int = 8, distance_mm: float = 480.0) -> list[Array]:
    rng = np.random.default_rng(5)
    return [
        pose_from(
            360.0 * i / count - 170.0,
            rng.uniform(35, 60),
            distance_mm * rng.uniform(0.9, 1.1),
            model,
            rng.uniform(-9, 9),
        )
        for i in range(count)
    ]


MOVES = {"post_1": (1.2, -0.8, 0.0), "rail": (0.0, 0.5, 0.0), "block_2": (-0.3, 0.2, 0.0)}


@cache
def assembly_photos() -> tuple[list[Array], list[NDArray[np.uint8]]]:
    """Photos of an assembly of which three components are displaced, before different clutter."""
    poses = ring(assembly())
    built = shifted(assembly(), MOVES)
    return poses, [picture(pose, built, PLAIN, seed=i, scene=i, gain=0.8 + 0.05 * i) for i, pose in enumerate(poses)]


def surface_points(model: Model, seed: int = 0) -> Array:
    """Points on the top of the plate, clear of what stands on it."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(5, 155, 2000), rng.uniform(5, 115, 2000), np.full(2000, 12.0)])
    for c in model.components[1:]:
        low, high = c.bounds_in_model
        points = points[~np.all((points[:, :2] > low[:2] - 14) & (points[:, :2] < high[:2] + 14), axis=1)]
    return points + rng.normal(size=points.shape) * 0.1


@cache
def usual_result() -> tuple[SparseModel, ScaleResult]:
    """The assembly's photos with exact poses and points of its surface."""
    poses, pictures = assembly_photos()
    sparse = sparse_of(poses, PLAIN, surface_points(assembly()))
    return sparse, find(sparse, part_of(assembly(), "plate"), pictures=pictures)


@pytest.mark.slow
def test_cad_gives_scale_and_frame_though_components_are_displaced() -> None:
    poses, _ = assembly_photos()
    sparse, result = usual_result()
    assert result.why_no_frame == "" and [e.kind for e in result.evidence] == ["cad"]
    scale_percent, middle_mm, angle_deg = frame_error(result, assembly())
    assert scale_percent < 0.05 and middle_mm < 0.15 and angle_deg < 0.05
    assert result.scale_std is not None and result.covariance is not None
    assert scale_percent / 100 < 3.5 * result.scale_std < 2e-3
    assert 0 < np.sqrt(result.covariance[3, 3]) < 0.2 and 0 < np.rad2deg(np.sqrt(result.covariance[0, 0])) < 0.1
    assert result.consistency.is_consistent and result.consistency.misfits == () and not result.warnings
    assert result.consistency.points_near is not None and result.consistency.points_near > 0.95
    moved = sparse.transformed(float(result.scale or 0), np.asarray(result.model_from_scan))
    np.testing.assert_allclose(moved.photos[3].cam_from_scan, poses[3], atol=0.4)


@pytest.mark.slow
def test_noise_of_the_poses_is_in_the_uncertainty() -> None:
    poses, pictures = assembly_photos()
    rng = np.random.default_rng(6)
    noisy = [exp_se3(rng.normal(size=6) * [4e-4, 4e-4, 4e-4, 0.2, 0.2, 0.2]) @ pose for pose in poses]
    _, exact = usual_result()
    result = find(sparse_of(noisy, PLAIN), part_of(assembly(), "plate"), pictures=pictures)
    scale_percent, middle_mm, _ = frame_error(result, assembly())
    assert result.scale_std is not None and exact.scale_std is not None and result.covariance is not None
    assert result.scale_std > exact.scale_std
    assert scale_percent / 100 < 4 * result.scale_std
    assert middle_mm < 4 * np.sqrt(np.trace(result.covariance[3:, 3:]))


@pytest.mark.slow
def test_scale_of_a_rig_moves_the_frame_with_it() -> None:
    poses, pictures = assembly_photos()
    sparse = sparse_of(poses, PLAIN)
    centres = {p.name: TRUTH.points_in_model(p.centre_in_scan) for p in sparse.photos}
    result = find(sparse, part_of(assembly(), "plate"), ScaleSources(rig=Rig(centres)), pictures=pictures)
    assert [e.kind for e in result.evidence] == ["rig", "cad"] and all(e.is_used for e in result.evidence)
    scale_percent, middle_mm, angle_deg = frame_error(result, assembly())
    assert scale_percent < 1e-3 and middle_mm < 0.15 and angle_deg < 0.05
    wrong = {name: 1.01 * centre for name, centre in centres.items()}
    result = find(sparse, part_of(assembly(), "plate"), ScaleSources(rig=Rig(wrong)), pictures=pictures)
    assert result.scale == pytest.approx(1.01 * TRUTH.scale, rel=1e-5)
    assert not result.consistency.is_consistent and "the size of the CAD contradicts" in result.consistency.reason
    assert any("CAD edges" in w and "camera rig" in w for w in result.warnings)


@pytest.mark.slow
def test_absent_part_gives_no_frame_and_no_scale() -> None:
    poses, _ = assembly_photos()
    empty = [picture(None, assembly(), PLAIN, seed=i, scene=i) for i in range(len(poses))]
    result = find(sparse_of(poses, PLAIN), part_of(assembly(), "plate"), pictures=empty)
    assert result.scale is None and result.scale_std is None and result.model_from_scan is None
    assert result.evidence == () and result.why_no_frame and result.provenance()["mm_per_unit"] is None


@pytest.mark.slow
def test_one_photo_is_too_few() -> None:
    poses, pictures = assembly_photos()
    result = find(sparse_of(poses[:1], PLAIN), part_of(assembly(), "plate"), pictures=pictures)
    assert result.scale is None and "fewer than two photos" in result.why_no_frame


@pytest.mark.slow
def test_bent_reconstruction_is_noticed() -> None:
    poses, pictures = assembly_photos()
    about = rigid(np.eye(3), assembly().center_in_model)
    bend = about @ rigid(exp_so3([0, 0, np.deg2rad(3.0)]), [5.0, 0, 0]) @ invert(about)
    bent = [pose @ bend if i in (1, 2, 3) else pose for i, pose in enumerate(poses)]
    result = find(sparse_of(bent, PLAIN), part_of(assembly(), "plate"), pictures=pictures)
    assert not result.consistency.is_consistent and result.warnings
    assert result.model_from_scan is not None
    assert set(result.consistency.misfits) == {"01.png", "02.png", "03.png"}


@pytest.mark.slow
def test_points_off_the_surface_are_noticed() -> None:
    poses, pictures = assembly_photos()
    points = surface_points(assembly()) - [0, 0, 6.0]
    result = find(sparse_of(poses, PLAIN, points), part_of(assembly(), "plate"), pictures=pictures)
    assert not result.consistency.is_consistent and "behind" in result.consistency.reason
    assert result.consistency.points_behind is not None and result.consistency.points_behind > 0.9


@cache
def nearly_symmetric() -> Model:
    """A square plate with four equal posts and one small block off the middle."""
    parts: list[Component] = [component("plate", box((-70, -70, 0), (70, 70, 10)), (0.6, 0.6, 0.62))]
    for i, (x, y) in enumerate(((-45, -45), (45, -45), (45, 45), (-45, 45))):
        parts.append(component(f"post_{i}", post((x, y), 10, 10, 45), (0.75, 0.45, 0.3)))
    parts.append(component("key", box((20, -10, 10), (48, 10, 26)), (0.3, 0.5, 0.7)))
    return make_model("nearly symmetric", tuple(parts))


@pytest.mark.slow
def test_components_decide_between_near_symmetric_frames() -> None:
    model = nearly_symmetric()
    poses = ring(model, 6)
    pictures = [picture(pose, model, PLAIN, seed=i, scene=i + 20) for i, pose in enumerate(poses)]
    result = find(sparse_of(poses, PLAIN), part_of(model, "plate"), pictures=pictures)
    scale_percent, middle_mm, angle_deg = frame_error(result, model)
    assert scale_percent < 0.06 and middle_mm < 0.2 and angle_deg < 0.06
    assert not any("twin" in w for w in result.warnings)


@pytest.mark.slow
@pytest.mark.shared
def test_plate_scale_within_half_a_thousandth() -> None:
    truth = json.loads((PLATE / "truth.json").read_text())
    matrix, (k1, k2) = np.array(truth["K"]), truth["dist_k1_k2"]
    camera = Camera(1600, 1200, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], np.array([k1, k2, 0, 0, 0]))
    rng = np.random.default_rng(7)
    photos = []
    for name, pose in truth["cam_from_model_mm"].items():
        noisy = exp_se3(rng.normal(size=6) * [5e-5, 5e-5, 5e-5, 0.06, 0.06, 0.06]) @ np.array(pose)
        photos.append(PosedPhoto(name, PLATE / "photos" / name, camera, scan_pose(noisy)))
    part = load_part(PLATE / "plate.glb")
    sparse = replace(sparse_of([], camera), photos=tuple(photos))
    result = find_scale(sparse, part)
    scale_percent, middle_mm, angle_deg = frame_error(result, part.model)
    assert scale_percent < 0.05 and middle_mm < 0.1 and angle_deg < 0.03
    assert result.scale_std is not None and scale_percent / 100 < 3.5 * result.scale_std < 1e-3
    assert result.consistency.is_consistent and CadOptions().max_views >= len(photos)
