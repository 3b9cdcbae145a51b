"""Error metrics against values computed by hand, ranges that cover poses, and the BOP reader on a tiny scene."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from arview.cad import Component, Model, Symmetry, ViewRange, make_model
from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array, exp_so3, look_at, rigid, rotation_angle_rad
from arview.guideviews import GuideViewOptions, GuideViewSet, make_guide_views
from arview.pose import Pose, TrackingState
from arview_lab.evaluation import (
    FrameResult,
    PoseMeter,
    covering_range,
    evaluate_scene,
    find_scenes,
    load_scene,
    summarise,
    viewpoint,
)
from arview_lab.evaluation.metrics import about, symmetry_group
from arview_lab.evaluation.ranges import shortest_arc
from helpers.bop_scene import CAMERA, TRUTH, entry, write_json, write_scene
from helpers.cad_files import box

UP = [0.0, 0.0, 1.0]


def brick() -> Model:
    vertices, faces = box((10.0, 20.0, 0.0), (50.0, 40.0, 10.0))
    return make_model("brick", (Component("brick", vertices, faces.astype(np.int32)),))


@pytest.fixture(scope="module")
def views() -> GuideViewSet:
    options = GuideViewOptions(subdivisions=1, resolution_px=120, renderer="zbuffer")
    return make_guide_views(brick(), ViewRange((300.0, 500.0)), options)


# --- Metrics --------------------------------------------------------------------------------------------


def test_shift_is_split_along_the_line_of_sight() -> None:
    model = brick()
    # The centre (30, 30, 5) lies on the optical axis, 405 mm away.
    truth = rigid(np.eye(3), [-30.0, -30.0, 400.0])
    estimate = rigid(np.eye(3), [-27.0, -26.0, 412.0])
    error = PoseMeter(model, CAMERA).measure(estimate, truth)
    assert error.translation_mm == pytest.approx(13.0)
    assert error.across_mm == pytest.approx(5.0)
    assert error.depth_mm == pytest.approx(12.0)
    assert error.rotation_deg == pytest.approx(0.0, abs=1e-9)
    assert error.add_mm == pytest.approx(13.0)
    assert error.contour_px is None
    assert error.within(13.1, 0.1)
    assert not error.within(12.9, 0.1)


def test_turn_about_the_centre_moves_corners_and_not_the_centre() -> None:
    model = brick()
    truth = rigid(np.eye(3), [-30.0, -30.0, 400.0])
    turn = about(Symmetry((0.0, 0.0, 1.0), (30.0, 30.0, 5.0), 2), np.deg2rad(10.0))
    error = PoseMeter(model, CAMERA).measure(truth @ turn, truth)
    assert error.translation_mm == pytest.approx(0.0, abs=1e-9)
    assert error.rotation_deg == pytest.approx(10.0)
    # Corners are hypot(20, 10) from the axis: a chord of 2 r sin 5°.
    assert error.add_mm == pytest.approx(2 * np.hypot(20, 10) * np.sin(np.deg2rad(5.0)))


def test_contour_distance_is_that_of_the_picture(views: GuideViewSet) -> None:
    truth = look_at(np.array([30.0, 30.0, 405.0]), views.center_in_model, [0.0, 1.0, 0.0])
    estimate = rigid(np.eye(3), [2.0, 0.0, 0.0]) @ truth
    error = PoseMeter(brick(), CAMERA, views).measure(estimate, truth)
    # 2 mm at 395 mm (the visible face) and 400 px.
    assert error.contour_px == pytest.approx(2 * 400 / 395, rel=0.02)
    assert error.contour_median_px == pytest.approx(2 * 400 / 395, rel=0.02)


def test_declared_symmetry_accepts_only_its_rotations() -> None:
    half_turn = Symmetry((0.0, 0.0, 1.0), (30.0, 30.0, 5.0), 2)
    truth = rigid(exp_so3([0.3, -0.2, 0.5]), [5.0, -4.0, 400.0])
    turned = truth @ about(half_turn, np.pi)
    plain = PoseMeter(brick(), CAMERA).measure(turned, truth)
    forgiven = PoseMeter(brick(), CAMERA, symmetries=(half_turn,)).measure(turned, truth)
    assert plain.rotation_deg == pytest.approx(180.0)
    assert forgiven.rotation_deg == pytest.approx(0.0, abs=1e-5)
    assert forgiven.add_mm == pytest.approx(0.0, abs=1e-6)
    off = PoseMeter(brick(), CAMERA, symmetries=(half_turn,)).measure(truth @ about(half_turn, 1.0), truth)
    assert off.rotation_deg == pytest.approx(np.rad2deg(1.0))


def test_continuous_symmetry_accepts_any_angle() -> None:
    free = Symmetry((0.0, 0.6, 0.8), (3.0, -2.0, 7.0), None)
    truth = rigid(exp_so3([0.3, -0.2, 0.5]), [5.0, -4.0, 400.0])
    meter = PoseMeter(brick(), CAMERA, symmetries=(free,))
    for angle in (-2.9, -0.7, 0.4, 3.0):
        assert meter.measure(truth @ about(free, angle), truth).add_mm == pytest.approx(0.0, abs=1e-6)
    tilt = rigid(exp_so3(np.deg2rad(4.0) * np.array([1.0, 0.0, 0.0])), np.zeros(3))
    error = meter.measure(truth @ about(free, 1.1) @ tilt, truth)
    # The tilt is across the axis, so no turn about the axis can take any of it away.
    assert error.rotation_deg == pytest.approx(4.0, abs=1e-6)


def test_symmetries_make_a_group() -> None:
    about_z = Symmetry((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 4)
    about_x = Symmetry((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), 4)
    assert len(symmetry_group((about_z,))) == 4
    assert len(symmetry_group((about_z, about_x))) == 24  # the turns of a cube


# --- Ranges ---------------------------------------------------------------------------------------------


def pose_from(distance: float, elevation: float, azimuth: float, roll: float, aside: Array) -> Array:
    """cam_from_model from a viewpoint around (30, 30, 5), with the part pushed aside in the picture."""
    center = np.array([30.0, 30.0, 5.0])
    e, a = np.deg2rad(elevation), np.deg2rad(azimuth)
    away = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    upright = look_at(center + distance * away, center, UP)
    rolled = rigid(exp_so3([0.0, 0.0, np.deg2rad(roll)]), np.zeros(3)) @ upright
    return rigid(exp_so3(aside), np.zeros(3)) @ rolled


def test_viewpoint_is_that_of_the_pose_wherever_the_part_is_in_the_picture() -> None:
    for aside in ([0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [-0.1, 0.25, 0.0]):
        found = viewpoint(pose_from(420.0, 35.0, -150.0, 25.0, np.array(aside)), [30.0, 30.0, 5.0])
        assert found.distance_mm == pytest.approx(420.0)
        assert found.elevation_deg == pytest.approx(35.0)
        assert found.azimuth_deg == pytest.approx(-150.0)
        assert found.roll_deg == pytest.approx(25.0)


def test_shortest_arc_goes_the_short_way_round() -> None:
    assert shortest_arc([10.0, 50.0, 20.0]) == pytest.approx((10.0, 50.0))
    assert shortest_arc([170.0, -175.0, 178.0]) == pytest.approx((170.0, 185.0))
    assert shortest_arc([40.0]) == pytest.approx((40.0, 40.0))
    assert shortest_arc([540.0]) == pytest.approx((-180.0, -180.0))


def test_covering_range_has_the_margins() -> None:
    poses = [
        pose_from(400.0, 20.0, 170.0, -5.0, np.zeros(3)),
        pose_from(500.0, 40.0, -90.0, 5.0, np.zeros(3)),
    ]
    found = covering_range(poses, [30.0, 30.0, 5.0])
    assert found.distance_mm == pytest.approx((320.0, 600.0))
    assert found.elevation_deg == pytest.approx((5.0, 55.0))  # 15° is more than 20 % of 20°
    assert found.azimuth_deg == pytest.approx((150.0, 290.0))  # 20 % of 100° over the wrap
    assert found.roll_deg == pytest.approx((-20.0, 20.0))
    for pose in poses:
        eye = -pose[:3, :3].T @ pose[:3, 3] - [30.0, 30.0, 5.0]
        assert found.contains_direction(eye / np.linalg.norm(eye))


def test_covering_range_near_a_pole_leaves_azimuth_and_roll_free() -> None:
    found = covering_range([pose_from(400.0, 80.0, 10.0, 0.0, np.zeros(3))], [30.0, 30.0, 5.0])
    assert found.elevation_deg == pytest.approx((65.0, 90.0))
    assert found.azimuth_deg == found.roll_deg == (-180.0, 180.0)
    with pytest.raises(InputError, match="no pose"):
        covering_range([], [0.0, 0.0, 0.0])


# --- BOP scenes -----------------------------------------------------------------------------------------


def test_scene_is_read_with_its_own_frame_ids(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "brick")
    assert find_scenes(tmp_path / "brick") == [folder] == find_scenes(folder)
    scene = load_scene(folder)
    assert scene.name == "brick"
    assert [frame.index for frame in scene.frames] == [4, 5, 6]
    assert (scene.camera.width, scene.camera.height, scene.camera.fx) == (320, 240, 400.0)
    np.testing.assert_allclose(scene.frames[2].cam_from_model, rigid(np.eye(3), [2.0, 0, 0]) @ TRUTH)
    assert scene.frames[0].visible == 0.9
    assert scene.part.model.diameter_mm == pytest.approx(np.sqrt(40**2 + 20**2 + 10**2))
    image = scene.image(scene.frames[1])
    assert image.shape == (240, 320, 3) and image[5, 5].tolist() == [50, 50, 50]


def test_reference_file_is_used_for_frames_without_truth(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "brick", truths=1)
    peer = {str(k): {"R": np.eye(3).ravel().tolist(), "t_mm": [0.0, 0.0, 300.0 + k]} for k in (4, 5)}
    write_json(tmp_path / "brick" / "peer_visp.json", peer)
    scene = load_scene(folder)
    assert scene.reference == (tmp_path / "brick" / "peer_visp.json").resolve()
    assert scene.frames[0].is_truth and not scene.frames[1].is_truth
    assert scene.frames[0].cam_from_model is not None and scene.frames[1].cam_from_model is not None
    assert scene.frames[0].cam_from_model[2, 3] == 400.0
    assert scene.frames[1].cam_from_model[2, 3] == 305.0
    assert scene.frames[2].cam_from_model is None


def test_pictures_with_another_matrix_are_warped_to_the_first(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "brick")
    cameras = json.loads((folder / "scene_camera.json").read_text())
    cameras["5"]["cam_K"][2] += 20.0
    write_json(folder / "scene_camera.json", cameras)
    picture = np.zeros((240, 320), np.uint8)
    picture[:, 120] = 255
    cv2.imwrite(str(folder / "gray" / "000005.png"), picture)
    scene = load_scene(folder)
    assert scene.image(scene.frames[1])[100].sum(axis=-1).argmax() == 100


def test_symmetries_of_models_info_are_taken(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "brick")
    half = [-1, 0, 0, 60, 0, -1, 0, 60, 0, 0, 1, 0, 0, 0, 0, 1]
    axis = {"axis": [0, 0, 2], "offset": [30, 30, 0]}
    info = {"3": {"symmetries_discrete": [half], "symmetries_continuous": [axis]}}
    write_json(tmp_path / "brick" / "models" / "models_info.json", info)
    scene = load_scene(folder)
    assert scene.part.symmetries == (Symmetry((0.0, 0.0, 1.0), (30.0, 30.0, 0.0), None),)
    assert len(scene.symmetric_poses) == 1


def break_scene(folder: Path, how: str) -> None:
    truth, cameras = folder / "scene_gt.json", folder / "scene_camera.json"
    if how == "not JSON":
        truth.write_text("{")
    elif how == "a list":
        write_json(truth, [])
    elif how == "no picture":
        for path in (folder / "gray").iterdir():
            path.unlink()
    elif how == "no camera":
        write_json(cameras, {"4": {"cam_K": CAMERA.matrix.ravel().tolist()}})
    elif how == "NaN":
        cameras.write_text(cameras.read_text().replace("400.0", "NaN"))
    elif how == "mirrored":
        write_json(truth, {"4": [entry(np.diag([1.0, 1.0, -1.0, 1.0]))]})
    elif how == "several objects":
        write_json(truth, {"4": [entry(TRUTH, 3), entry(TRUTH, 5)]})
    elif how == "object twice":
        write_json(truth, {"4": [entry(TRUTH), entry(TRUTH)]})
    elif how == "no model":
        (folder.parent.parent / "models" / "obj_000003.ply").unlink()


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("not JSON", "not valid JSON"),
        ("a list", "expected an object"),
        ("no picture", "no numbered pictures"),
        ("no camera", "frame 5: cam_K is missing"),
        ("NaN", "finite numbers"),
        ("mirrored", "not a rotation"),
        ("several objects", "--object"),
        ("object twice", "2 times"),
        ("no model", "--part"),
    ],
)
def test_bad_scene_is_refused_in_one_line(tmp_path: Path, how: str, message: str) -> None:
    folder = write_scene(tmp_path / "brick")
    break_scene(folder, how)
    with pytest.raises(InputError, match=message) as raised:
        load_scene(folder)
    assert "\n" not in str(raised.value)


def test_no_scene_and_broken_picture(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="contains no scene"):
        find_scenes(tmp_path)
    with pytest.raises(InputError, match="no such folder"):
        find_scenes(tmp_path / "none")
    folder = write_scene(tmp_path / "brick")
    (folder / "gray" / "000005.png").write_bytes(b"")
    scene = load_scene(folder)
    with pytest.raises(InputError, match=r"000005\.png: cannot be read"):
        scene.image(scene.frames[1])


# --- Evaluation -----------------------------------------------------------------------------------------


class Script:
    """A session that gives prepared poses: None is lost."""

    def __init__(self, poses: list[Array | None]) -> None:
        self.poses = iter(poses)

    def process(self, image: object, index: int, time_s: float) -> tuple[Pose, ...]:
        pose = next(self.poses)
        state = TrackingState.LOST if pose is None else TrackingState.TRACKED
        return (Pose(pose, None, 0.9, state, time_s, index, ms=2.0 + index),)


def test_evaluation_counts_lost_wrong_and_good_frames(tmp_path: Path, views: GuideViewSet) -> None:
    scene = load_scene(write_scene(tmp_path / "brick", frames=4, truths=4))
    truths = scene.poses
    wrong = rigid(np.eye(3), [80.0, 0.0, 0.0]) @ truths[1]
    near = rigid(np.eye(3), [0.0, 3.0, 0.0]) @ truths[3]
    given: list[Array | None] = []

    def make_session(_: GuideViewSet, __: Camera, first: Array | None) -> Script:
        given.append(first)
        return Script([truths[0], wrong, None, near])

    result = evaluate_scene(scene, "truth", views=views, make_session=make_session)
    np.testing.assert_allclose(given[0], TRUTH)
    summary = result.summary
    assert (summary.frames, summary.evaluated, summary.lost, summary.false_tracked) == (4, 4, 1, 1)
    assert summary.states == {"tracked": 3, "lost": 1}
    assert summary.errors["translation_mm"].median == pytest.approx(3.0)
    assert summary.errors["translation_mm"].max == pytest.approx(80.0)
    assert summary.within_5cm_5deg == pytest.approx(0.5) == summary.within_2cm_2deg
    # Ids 4 to 7: the first does not count, and id 7 follows a lost frame, so it is a detection.
    assert summary.track_ms is not None and summary.track_ms.median == pytest.approx(7.5)
    assert summary.detect_ms is not None and summary.detect_ms.median == pytest.approx(9.0)
    assert json.loads(json.dumps(result.to_dict()))["frames"][2]["cam_from_model"] is None


def test_tracked_while_out_of_view_is_false_and_not_evaluated() -> None:
    pose = Pose(TRUTH, None, 0.9, TrackingState.TRACKED, 0.0, 0)
    error = PoseMeter(brick(), CAMERA).measure(TRUTH, TRUTH)
    gone = FrameResult(pose, error, True, True, 0.0, False, False)
    summary = summarise([gone])
    assert (summary.evaluated, summary.lost, summary.false_tracked) == (0, 0, 1)
    assert summary.within_5cm_5deg is None and not summary.errors
    searching = replace(gone, pose=replace(pose, cam_from_model=None, state=TrackingState.SEARCHING), error=None)
    assert summarise([searching]).false_tracked == 0


def test_start_from_truth_needs_a_truth(tmp_path: Path, views: GuideViewSet) -> None:
    scene = load_scene(write_scene(tmp_path / "brick", truths=0), object_id=3)
    with pytest.raises(InputError, match="--reference"):
        evaluate_scene(scene, "truth", views=views)


def test_rotation_of_equivalent_pose_is_least() -> None:
    cube = (Symmetry((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 4), Symmetry((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), 4))
    meter = PoseMeter(brick(), CAMERA, symmetries=cube)
    rng = np.random.default_rng(5)
    truth = rigid(exp_so3(rng.normal(size=3)), [0.0, 0.0, 400.0])
    for _ in range(20):
        estimate = rigid(exp_so3(rng.normal(size=3) * 2), [0.0, 0.0, 400.0])
        nearest = meter.nearest_equivalent(estimate, truth)
        # No orientation is more than 62.8° from one of a cube's.
        assert np.rad2deg(rotation_angle_rad(nearest, estimate)) < 62.9
