"""Guided initialisation: guide views by name, the search around them, the session that waits, the outline."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from arview.cad import Part, ViewRange, load_part
from arview.cad.part import ComponentSettings, Guide
from arview.cad.viewpoint import Viewpoint, pose_at, viewpoint
from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array, apply, exp_se3, rigid
from arview.guideviews import GuideViewOptions, make_guide_views
from arview.overlay import OverlayOptions, OverlayRenderer
from arview.pose import Pose, TrackingState
from arview.tracking import SpecimenTracking
from arview.tracking.guide_pose import guide_names, guide_pose
from arview.tracking.part_search import ALIGN
from arview.tracking.search.guided_init import GuidedInit
from helpers.cad_files import box, obj_text
from helpers.synthetic import CAMERA, RANGE, assembly, assembly_views, block, error, picture, pose_from

SPHERE = ViewRange((300.0, 900.0))
LENS = Camera(640, 480, 610.0, 612.0, 331.0, 228.0, np.array([-0.28, 0.09, 0.001, -0.002, 0.0]))


def part_of(*guides: Guide) -> Part:
    settings = tuple(ComponentSettings(component.name) for component in assembly().components)
    return Part("assembly", Path("a.obj"), Path("a.obj"), assembly(), settings, guides=guides)


@cache
def guided_init() -> GuidedInit:
    return GuidedInit(assembly_views(), CAMERA)


def moved(
    pose: Array, rng: np.random.Generator, turn_deg: float, depth: float, aside: float, reach: float = 1.0
) -> Array:
    """A pose turned about the part's centre, nearer or farther, and shifted by diameters, each up to its limit."""
    center = apply(pose, assembly().center_in_model)
    axis = rng.normal(size=3)
    angle = np.deg2rad(turn_deg) * rng.uniform(1.0 - reach, 1.0) ** (1 / 3)
    turn = exp_se3([*(angle * axis / np.linalg.norm(axis)), 0, 0, 0])[:3, :3] @ pose[:3, :3]
    place = center * (1.0 + rng.uniform(-depth, depth))
    way = rng.uniform(0, 2 * np.pi)
    place[:2] += aside * assembly().diameter_mm * np.sqrt(rng.uniform()) * np.array([np.cos(way), np.sin(way)])
    return rigid(turn, place - turn @ assembly().center_in_model)


# --- Names ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ray", [(0.0, 0.0, 1.0), (0.2, -0.15, 1.0)])
def test_a_viewpoint_gives_its_pose_and_back(ray: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(4)
    for _ in range(20):
        place = Viewpoint(rng.uniform(300, 900), rng.uniform(-88, 88), rng.uniform(-179, 179), rng.uniform(-179, 179))
        pose = pose_at(place, [10.0, -20.0, 5.0], ray)
        found = viewpoint(pose, [10.0, -20.0, 5.0])
        assert vars(found) == pytest.approx(vars(place), abs=1e-6)
        center = apply(pose, [10.0, -20.0, 5.0])
        assert center / np.linalg.norm(center) == pytest.approx(np.array(ray) / np.linalg.norm(ray))


@pytest.mark.parametrize(
    "name,camera_side,up,right",
    [
        ("front", (0, -1, 0), (0, 0, 1), (1, 0, 0)),
        ("back", (0, 1, 0), (0, 0, 1), (-1, 0, 0)),
        ("left", (-1, 0, 0), (0, 0, 1), (0, -1, 0)),
        ("right", (1, 0, 0), (0, 0, 1), (0, 1, 0)),
        ("top", (0, 0, 1), (0, 1, 0), (1, 0, 0)),
        ("bottom", (0, 0, -1), (0, -1, 0), (1, 0, 0)),
    ],
)
def test_standard_views_look_from_where_they_say(
    name: str, camera_side: tuple[int, ...], up: tuple[int, ...], right: tuple[int, ...]
) -> None:
    pose = guide_pose(name, part_of(), SPHERE, CAMERA)
    # A principal point beside the picture's middle turns the camera a little.
    assert np.array(camera_side) @ pose[:3, :3].T == pytest.approx([0, 0, -1], abs=0.01)
    assert np.array(up) @ pose[:3, :3].T == pytest.approx([0, -1, 0], abs=0.01)
    assert np.array(right) @ pose[:3, :3].T == pytest.approx([1, 0, 0], abs=0.01)


def test_the_part_is_in_the_middle_of_the_picture_and_fills_it_well() -> None:
    for name in ("iso", "middle", "az20_el45"):
        pose = guide_pose(name, part_of(), SPHERE, LENS)
        center = apply(pose, assembly().center_in_model)
        assert LENS.project(center) == pytest.approx([319.5, 239.5], abs=0.05)
        assert assembly().diameter_mm * LENS.fx / np.linalg.norm(center) == pytest.approx(0.6 * 480)
    # Where the range does not allow that size there stays room to bring the part nearer and farther.
    far = guide_pose("middle", part_of(), ViewRange((900.0, 1500.0)), CAMERA)
    assert np.linalg.norm(apply(far, assembly().center_in_model)) == pytest.approx(1.15 * 900.0)


def test_directions_and_names_of_the_part_file() -> None:
    part = part_of(Guide("start", 30.0, 40.0, 5.0, 480.0), Guide("iso", 10.0, 20.0))
    assert guide_names(part, RANGE) == ["start", "iso", "middle"]
    assert guide_names(part_of(), SPHERE) == ["front", "back", "left", "right", "top", "bottom", "iso", "middle"]
    for name, expected in (
        ("start", (480.0, 40.0, 30.0, 5.0)),
        ("az-12.5_el33_d600_r-10", (600.0, 33.0, -12.5, -10.0)),
        ("iso", (None, 20.0, 10.0, 0.0)),
        ("middle", (None, 45.0, 0.0, 0.0)),
    ):
        found = viewpoint(guide_pose(name, part, RANGE, CAMERA), assembly().center_in_model)
        distance_mm = found.distance_mm if expected[0] is None else expected[0]
        assert list(vars(found).values()) == pytest.approx([distance_mm, *expected[1:]], abs=1e-6)
        assert RANGE.distance_mm[0] <= found.distance_mm <= RANGE.distance_mm[1]


def test_views_follow_the_rolls_of_the_range_and_the_azimuths_straight_above() -> None:
    sideways = ViewRange((400.0, 800.0), (20.0, 90.0), (-30.0, 30.0), (80.0, 120.0))
    assert viewpoint(guide_pose("middle", part_of(), sideways, CAMERA), assembly().center_in_model).roll_deg == (
        pytest.approx(100.0)
    )
    top = guide_pose("top", part_of(), ViewRange((400.0, 800.0), (20.0, 90.0), (-30.0, 30.0)), CAMERA)
    # From azimuth -30° the part's far side, which is up, is the other way.
    up = -np.array([np.cos(np.deg2rad(-30)), np.sin(np.deg2rad(-30)), 0.0])
    assert top[:3, :3] @ up == pytest.approx([0, -1, 0], abs=0.01)


@pytest.mark.parametrize(
    "name,words",
    [
        ("midle", "did you mean 'middle'? There are: iso, middle; or a direction like az45_el30"),
        ("front", "azimuth -90°, elevation 0° is outside the declared range (azimuth -80 to 80°, elevation 15 to 75°)"),
        ("az120_el30", "azimuth 120°, elevation 30° is outside the declared range"),
        ("az0_el95", "elevation 95° is not within -90 to 90°"),
        ("az0_el30_d900", "900 mm is outside the declared distances (420 to 640 mm)"),
        ("az0", "no guide view 'az0'"),
    ],
)
def test_guide_views_that_do_not_exist_are_refused(name: str, words: str) -> None:
    with pytest.raises(InputError) as caught:
        guide_pose(name, part_of(), RANGE, CAMERA)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_guides_of_a_part_file(tmp_path: Path) -> None:
    (tmp_path / "block.obj").write_text(obj_text("block", *box((0, 0, 0), (80, 60, 40)), 0))
    path = tmp_path / "part.toml"
    head = '[part]\ncad = "block.obj"\nunit = "mm"\n[guides.start]\n'
    path.write_text(head + "azimuth_deg = -60\nelevation_deg = 40\n[guides.low]\n"
                    "azimuth_deg = 10\nelevation_deg = 5\nroll_deg = 90\ndistance_mm = 500\n")  # fmt: skip
    assert load_part(path).guides == (Guide("start", -60.0, 40.0), Guide("low", 10.0, 5.0, 90.0, 500.0))
    for text, words in (
        ("azimuth_deg = 10\n", "[guides.start] the key 'elevation_deg' is missing"),
        ("azimuth_deg = 10\nelevation_deg = 91\n", "elevation_deg = 91: expected a number from -90 to 90"),
        ("azimuth_deg = 10\nelevation_deg = 9\ndistance_mm = -5\n", "distance_mm = -5: expected a positive number"),
        ("azimuth_deg = 10\nelevation_deg = 9\nrol_deg = 5\n", "unknown key 'rol_deg' (did you mean 'roll_deg'?)"),
    ):
        path.write_text(head + text)
        with pytest.raises(InputError) as caught:
            load_part(path)
        assert words in str(caught.value)


# --- Guided initialisation ------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_part_is_found_within_15_degrees_and_15_percent() -> None:
    rng = np.random.default_rng(21)
    found_count = 0
    for k in range(10):
        truth = pose_from(
            rng.uniform(-70, 70), rng.uniform(22, 68), rng.uniform(450, 600), roll_deg=rng.uniform(-15, 15)
        )
        guide = moved(truth, rng, 15.0, 0.15, 0.15)
        found = guided_init().lock(picture(truth, seed=k, scene=k % 9, noise=4.0), guide, 0.8)
        if found is not None:
            mm, _, deg = error(found.cam_from_model, truth)
            assert mm < 5.0 and deg < 2.0
            found_count += 1
    assert found_count >= 9


@pytest.mark.slow
def test_nothing_is_found_without_the_part_or_when_it_is_far_away() -> None:
    rng = np.random.default_rng(22)
    for k in range(20):
        truth = pose_from(rng.uniform(-70, 70), rng.uniform(22, 68), rng.uniform(450, 600))
        seen: Array | None = truth
        if k % 4 == 0:
            guide, seen = truth, None
        elif k % 4 == 1:
            guide = moved(truth, rng, 120.0, 0.1, 0.1, reach=0.9)
        elif k % 4 == 2:
            guide = rigid(truth[:3, :3], truth[:3, 3] * (1.4 if k % 8 == 2 else 0.65))
        else:
            guide = truth.copy()
            guide[0, 3] += 0.6 * assembly().diameter_mm
        if k % 4 == 1 and guided_init().is_near(guide, truth):
            continue
        assert guided_init().lock(picture(seen, seed=k, scene=k, noise=4.0), guide, 0.8) is None


def test_a_figure_inside_a_larger_one_is_not_taken_for_the_part() -> None:
    """A small block in front of a large one of the same shape could be print on it."""
    views = make_guide_views(block(), ViewRange((200.0, 800.0), (10.0, 70.0), (0.0, 90.0), (-20.0, 20.0)),
                             GuideViewOptions(subdivisions=3, renderer="zbuffer"))  # fmt: skip
    small, large = pose_from(40, 35, 560, block()), pose_from(40, 35, 260, block())
    image = picture(small, block(), noise=3.0, contrast=3.0)
    of_block = GuidedInit(views, CAMERA)
    found = of_block.lock(image, small, 0.8)
    assert found is not None
    assert error(found.cam_from_model, small, block())[0] < 5.0
    # The same small block, now with the large one behind it.
    behind = picture(large, block(), noise=3.0, contrast=3.0)
    corners = CAMERA.project(apply(small, block().mesh[0])).astype(np.float32)
    mask = np.zeros(image.shape[:2], np.uint8)
    cv2.fillConvexPoly(mask, np.round(cv2.convexHull(corners)).astype(np.int32), 1)
    both = np.where(mask[..., None] > 0, image // 2 + 90, behind).astype(np.uint8)
    assert of_block.find(both, small).quality > 0.8  # type: ignore[union-attr]
    assert of_block.lock(both, small, 0.8) is None


def test_a_pose_behind_the_camera_or_outside_the_picture_finds_nothing() -> None:
    image = picture(pose_from(30, 40, 520), seed=1)
    behind, outside = pose_from(30, 40, 520), pose_from(30, 40, 520)
    behind[2, 3] -= 2000.0
    outside[0, 3] += 5000.0
    for pose in (behind, outside):
        assert guided_init().lock(image, pose, 0.8) is None
    assert guided_init().find(image, behind) is None


# --- Session --------------------------------------------------------------------------------------------

GUIDE = pose_from(30, 40, 520)


def aligning(count: int) -> list[Array]:
    """The part comes from 40° and a quarter of the picture away to the guide pose."""
    poses = []
    for k in range(count):
        rest = max(0.0, 1.0 - k / 10)
        pose = pose_from(30 - 40 * rest, 40 + 15 * rest, 520 + 60 * rest)
        pose[0, 3] += 150 * rest
        poses.append(pose)
    return poses


@pytest.mark.slow
def test_the_session_waits_for_the_part_and_tracks_it() -> None:
    session = SpecimenTracking(assembly_views(), CAMERA, assembly(), guide_cam_from_model=GUIDE)
    poses = aligning(16)
    results = [session.process(picture(pose, seed=k, scene=3), k, 0.0) for k, pose in enumerate(poses)]
    states = [result.state for result in results]
    first = states.index(TrackingState.CRITICAL)
    assert 4 <= first <= 11
    assert states[:first] == [TrackingState.SEARCHING] * first
    for result in results[:first]:
        assert result.reason == ALIGN
        np.testing.assert_allclose(result.guide_cam_from_model, GUIDE, atol=1e-9)
    assert results[first].reason == "found, to be confirmed"
    assert states[first + 1 :] == [TrackingState.TRACKED] * (15 - first)
    for result, truth in zip(results[first:], poses[first:], strict=True):
        assert result.guide_cam_from_model is None
        assert result.cam_from_model is not None
        mm, _, deg = error(result.cam_from_model, truth)
        assert mm < 3.0 and deg < 1.0


@pytest.mark.slow
def test_the_outline_comes_back_when_a_lost_part_is_not_found_for_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("arview.tracking.part_search.ALIGN_AGAIN_FRAMES", 4)
    session = SpecimenTracking(assembly_views(), CAMERA, assembly(), guide_cam_from_model=GUIDE)
    for k in range(4):
        result = session.process(picture(GUIDE, seed=k, scene=3), k, 0.0)
    assert result.state == TrackingState.TRACKED
    gone = [session.process(picture(None, seed=k, scene=3), k, 0.0) for k in range(9)]
    lost = [result for result in gone if result.state == TrackingState.LOST]
    assert len(lost) >= 7
    assert [result.guide_cam_from_model is not None for result in lost[:4]] == [False] * 4
    assert all(result.guide_cam_from_model is not None for result in lost[5:])
    assert lost[-1].reason.endswith(ALIGN)
    back = [session.process(picture(GUIDE, seed=k, scene=3), k, 0.0) for k in range(5)]
    assert back[-1].state == TrackingState.TRACKED


def test_an_unconfirmed_pose_goes_back_to_waiting() -> None:
    session = SpecimenTracking(assembly_views(), CAMERA, assembly(), guide_cam_from_model=GUIDE)
    assert session.process(picture(GUIDE, seed=0, scene=3), 0, 0.0).state == TrackingState.CRITICAL
    result = session.process(picture(None, seed=1, scene=3), 1, 0.0)
    assert (result.state, result.cam_from_model, result.reason) == (TrackingState.SEARCHING, None, ALIGN)
    np.testing.assert_allclose(result.guide_cam_from_model, GUIDE, atol=1e-9)


def test_a_dark_picture_is_said_to_be_dark_while_aligning() -> None:
    session = SpecimenTracking(assembly_views(), CAMERA, assembly(), guide_cam_from_model=GUIDE)
    result = session.process(picture(GUIDE, gain=0.1), 0, 0.0)
    assert (result.state, result.reason) == (TrackingState.SEARCHING, "too dark")


# --- Outline --------------------------------------------------------------------------------------------


@cache
def renderer(has_lens: bool) -> OverlayRenderer:
    return OverlayRenderer(assembly(), LENS if has_lens else CAMERA, options=OverlayOptions(show_status=False))


def drawn(image: NDArray[np.uint8], guide: Array | None, has_lens: bool = False) -> NDArray[np.uint8]:
    pose = Pose(None, None, 0.0, TrackingState.SEARCHING, 0.0, 0, guide_cam_from_model=guide)
    return renderer(has_lens).draw(image, pose)


@pytest.mark.parametrize("has_lens", [False, True], ids=["pinhole", "lens"])
def test_the_outline_lies_where_the_part_should_be(has_lens: bool) -> None:
    camera = LENS if has_lens else CAMERA
    grey = np.full((480, 640, 3), 118, dtype=np.uint8)
    changed = np.any(drawn(grey, GUIDE, has_lens) != grey, axis=-1).astype(np.uint8)
    vertices, faces, _ = assembly().mesh
    expected = np.zeros((480, 640), dtype=np.uint8)
    for triangle in camera.project(apply(GUIDE, vertices))[faces]:
        cv2.fillConvexPoly(expected, np.round(triangle).astype(np.int32), 1)
    rim = expected - cv2.erode(expected, np.ones((3, 3), np.uint8))
    # All of the part's rim is drawn, and nothing farther than the halo outside of it.
    assert np.all(cv2.dilate(changed, np.ones((5, 5), np.uint8))[rim > 0])
    assert not np.any(changed & (cv2.dilate(expected, np.ones((13, 13), np.uint8)) == 0))
    np.testing.assert_array_equal(drawn(grey, None, has_lens), grey)


@pytest.mark.parametrize("level", [0, 60, 128, 200, 255])
def test_the_outline_shows_on_any_brightness(level: int) -> None:
    image = np.full((480, 640, 3), level, dtype=np.uint8)
    picture_of_it = drawn(image, GUIDE)
    nearby = np.ones((5, 5), np.uint8)
    contrast = (cv2.dilate(picture_of_it, nearby).astype(int) - cv2.erode(picture_of_it, nearby)).max(axis=-1)
    is_drawn = np.any(picture_of_it != level, axis=-1)
    assert is_drawn.sum() > 3000
    assert np.mean(contrast[is_drawn] > 90) > 0.95
