"""Semi-synthetic sequences: true poses against the pictures, speed, determinism, look-alikes, files, errors."""

from __future__ import annotations

import json
import runpy
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from arview.cad import Model, Symmetry, make_model
from arview.detection import Detection
from arview.errors import InputError, OutputError
from arview.geometry import Array, apply, exp_so3, look_at, rigid, rotation_angle_rad
from arview.guideviews.surface import Surface, reduced_surface, surface_about
from arview.rendering.renderers import ZBufferRenderer
from arview.video import Image
from arview_lab.evaluation import PoseError, PoseMeter, SceneFrame, load_scene
from arview_lab.evaluation.protocols import (
    Tally,
    box_symmetries,
    detect_in_frames,
    full_sphere_range,
    spread_frames,
    true_pose,
)
from arview_lab.semisynthetic import (
    CAMERA,
    SHAPES,
    Job,
    SequenceFrame,
    SequenceOptions,
    frames_without_part,
    indistinguishable_poses,
    look_alike_job,
    look_alikes,
    make_sequence,
    near_symmetries,
    nearest_error,
    read_record,
    render_sequence,
    shape,
    shape_job,
    trajectory,
)
from arview_lab.semisynthetic.ambiguity import changed_share
from arview_lab.semisynthetic.look_alikes import different_share
from arview_lab.semisynthetic.shading import corner_normals, muted
from arview_lab.semisynthetic.solids import circle, cylinder, prism, rectangle, triangulate
from helpers.cad_files import box
from helpers.paths import TOOLS
from helpers.synthetic import background, component

TOOL = TOOLS / "benchmarks" / "make_sequences.py"


def brick() -> Model:
    return make_model("brick", (component("brick", box((0, 0, 0), (140, 90, 60)), (0.6, 0.6, 0.6)),))


def one_frame(model: Model, pose: Array, photo_level: int = 0, **options: float) -> SequenceFrame:
    photo = np.full((600, 800, 3), photo_level, np.uint8)
    frames = render_sequence(model, pose[None], photo, SequenceOptions(sensor_noise=0.0, **options))  # type: ignore[arg-type]
    return next(frames)


def oblique(model: Model, distance_mm: float = 600.0) -> Array:
    center = model.center_in_model
    return look_at(center + distance_mm * np.array([0.55, -0.62, 0.56]), center, [0.1, 0.0, 1.0])


@pytest.fixture
def photos(tmp_path: Path) -> tuple[Path, ...]:
    folder = tmp_path / "photos"
    folder.mkdir()
    for k in range(3):
        cv2.imwrite(str(folder / f"{k}.png"), background(k, 800, 600))
    return tuple(sorted(folder.iterdir()))


# --- Shapes ---------------------------------------------------------------------------------------------


def test_polygon_with_holes_keeps_its_area() -> None:
    holes = (circle((20, 20), 6), circle((60, 20), 6))
    points, triangles = triangulate(rectangle((0, 0), (80, 40)), holes)
    a, b, c = points[triangles].transpose(1, 0, 2)
    area = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    hole = 0.5 * 32 * 36 * np.sin(2 * np.pi / 32)
    assert np.all(area > 0)
    assert area.sum() == pytest.approx(80 * 40 - 2 * hole)


@pytest.mark.parametrize("name", SHAPES)
def test_shapes_are_closed_and_of_a_hand_s_size(name: str) -> None:
    model = shape(name)
    assert 100 <= model.diameter_mm <= 260
    for part in model.components:
        sides = np.concatenate([part.faces[:, [k, (k + 1) % 3]] for k in range(3)]).astype(np.int64)
        there, back = (np.sort(s[:, 0] * 10**6 + s[:, 1]) for s in (sides, sides[:, ::-1]))
        assert np.array_equal(there, back), part.name
        a, b, c = part.vertices_in_model[part.faces].transpose(1, 0, 2)
        assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6 > 0


def test_bent_sheet_keeps_its_volume() -> None:
    model = shape("bracket")
    (part,) = model.components
    a, b, c = part.vertices_in_model[part.faces].transpose(1, 0, 2)
    volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
    # Flat pattern by hand: foot, web and top without their holes, and two bends, 2 mm thick.
    bend = 0.5 * np.pi * 5.0
    foot = 80 * 90 - 0.5 * 24 * 24 - np.pi * (49 + 25 + 36) - 22 * 12
    web = 0.5 * (90 + 70) * 60 - np.pi * (256 + 16)
    top = 0.5 * (40 + 62) * 36 + 62 * 34 - np.pi * (36 + 16)
    assert volume == pytest.approx(2.0 * (foot + web + top + bend * (90 + 70)), rel=0.005)


def test_unknown_shape_names_the_known() -> None:
    with pytest.raises(InputError, match=r"teapot.*block, organic"):
        shape("teapot")


# --- Drawing --------------------------------------------------------------------------------------------


def offsets_px(model: Model, pose: Array, picture: Array) -> Array:
    """How far outside a convex part's outline, place by place, a picture falls to half of what it is inside."""
    pixels = CAMERA.project(apply(pose, model.mesh[0])).astype(np.float32)
    hull = cv2.convexHull(pixels)[:, 0].astype(np.float64)
    found = []
    for start, end in zip(hull, np.roll(hull, -1, axis=0), strict=True):
        along = end - start
        length = np.linalg.norm(along)
        if length < 30:
            continue
        outward = np.array([along[1], -along[0]]) / length
        outward *= np.sign(outward @ (start - hull.mean(axis=0)))
        places = start + along * np.linspace(0.2, 0.8, 40)[:, None]
        steps = np.arange(-2.5, 2.5, 0.02)
        samples = (places[:, None] + steps[None, :, None] * outward).astype(np.float32)
        values = cv2.remap(picture.astype(np.float32), samples[..., 0], samples[..., 1], cv2.INTER_LINEAR)
        found.append(steps[np.argmax(values < 0.5 * values[:, :1], axis=1)])
    return np.concatenate(found)


def test_mask_and_picture_agree_with_the_cad_s_outline() -> None:
    model = brick()
    for turn in np.linspace(0.0, 2.4, 5):
        pose = rigid(exp_so3([0.0, 0.0, turn]), [3.3 * turn, -5.1 * turn, 0.0]) @ oblique(model)
        frame = one_frame(model, pose)
        for picture in (frame.mask, frame.image.max(axis=2)):
            offsets = offsets_px(model, pose, picture)
            assert len(offsets) >= 5 * 40
            assert np.abs(offsets).mean() < 0.1
            assert abs(offsets.mean()) < 0.06


def test_area_of_the_mask_is_that_of_the_projection() -> None:
    model = brick()
    pose = oblique(model)
    frame = one_frame(model, pose)
    hull = cv2.convexHull(CAMERA.project(apply(pose, model.mesh[0])).astype(np.float32))
    assert frame.mask.sum() == pytest.approx(cv2.contourArea(hull), rel=1e-3)
    assert frame.visible == pytest.approx(1.0)


def test_what_is_outside_the_picture_counts_as_not_visible() -> None:
    model = brick()
    pose = oblique(model)
    whole = one_frame(model, pose)
    left = apply(pose, model.center_in_model)
    # The centre at the picture's left border: half of the part is outside.
    shift = rigid(np.eye(3), [(-0.5 - CAMERA.cx) / CAMERA.fx * left[2] - left[0], 0.0, 0.0])
    half = one_frame(model, shift @ pose)
    assert half.pixels == pytest.approx(whole.pixels, rel=0.1)
    assert half.visible == pytest.approx(0.5, abs=0.08)
    assert half.pixels_in_picture == pytest.approx(half.mask.sum())


def test_the_occluder_hides_what_the_mask_leaves_out() -> None:
    model, options = shape("block"), SequenceOptions("occlusion", frames=5, seed=3, sensor_noise=0.0)
    poses = trajectory(model, options)
    photo = background(1, 800, 600)
    hidden = list(render_sequence(model, poses, photo, options, occluder=shape("flange")))
    alone = list(render_sequence(model, poses, photo, options))
    assert 0.4 < np.mean([frame.visible for frame in hidden]) < 0.95
    for front, free in zip(hidden, alone, strict=True):
        assert front.visible <= free.visible + 1e-6
        assert front.pixels == pytest.approx(free.pixels)


@pytest.mark.slow
def test_moving_light_changes_the_part_and_not_its_place() -> None:
    model = shape("block")
    pictures = {}
    for variant in ("regular", "light"):
        options = SequenceOptions(variant, frames=12, seed=2, sensor_noise=0.0)  # type: ignore[arg-type]
        poses = np.repeat(oblique(model)[None], 12, axis=0)
        frames = list(render_sequence(model, poses, np.full((600, 800, 3), 90, np.uint8), options))
        inside = frames[0].mask > 0.99
        pictures[variant] = np.array([frame.image[inside].mean() for frame in frames])
        assert all(np.array_equal(frame.mask, frames[0].mask) for frame in frames)
    assert np.ptp(pictures["regular"]) < 1.0
    assert np.ptp(pictures["light"]) > 25.0


def test_noise_has_the_wanted_standard_deviation() -> None:
    model = shape("block")
    photo = np.full((600, 800, 3), 128, np.uint8)
    frame = next(render_sequence(model, oblique(model)[None], photo, SequenceOptions("noise", noise=12.0)))
    corner = frame.image[:100, :100].astype(float)
    assert corner.std() == pytest.approx(np.hypot(12.0, 2.0), rel=0.05)


def test_motion_blur_spreads_the_edges() -> None:
    model = shape("block")
    poses = np.stack([rigid(np.eye(3), [15.0 * k, 0.0, 0.0]) @ oblique(model) for k in range(3)])
    photo = np.zeros((600, 800, 3), np.uint8)
    soft = {}
    for shutter in (0.0, 0.5):
        frames = list(render_sequence(model, poses, photo, SequenceOptions(shutter=shutter)))
        mask = frames[1].mask
        soft[shutter] = np.count_nonzero((mask > 0.02) & (mask < 0.98))
        # Truth is the middle of the exposure.
        columns = np.arange(CAMERA.width)
        soft[shutter, "middle"] = float((mask.sum(axis=0) * columns).sum() / mask.sum())
    assert soft[0.5] > 3 * soft[0.0]
    assert soft[0.5, "middle"] == pytest.approx(soft[0.0, "middle"], abs=0.1)


def test_normals_are_smooth_on_round_and_sharp_on_flat_faces() -> None:
    vertices, faces = prism(circle((0, 0), 10.0, 48), (), 0.0, 20.0)
    normals = corner_normals(vertices, faces.astype(np.int32), 40.0)
    corners = vertices[faces]
    flat = np.abs(normals[..., 2]) > 0.99
    wall = ~flat.any(axis=1)
    outward = corners[wall][..., :2] / 10.0
    assert np.allclose(np.einsum("fki,fki->fk", normals[wall][..., :2], outward), 1.0, atol=2e-3)
    assert np.all(flat[~wall])


def test_colours_of_cad_become_those_of_a_real_part() -> None:
    vivid, white, black, steel = muted(np.array([(0.9, 0.3, 0.1), (1.0, 1, 1), (0.0, 0, 0), (0.56, 0.57, 0.58)]))
    assert vivid.max() == pytest.approx(0.65)
    assert 1 - vivid.min() / vivid.max() == pytest.approx(0.35)
    assert (vivid[1] - vivid[2]) / (vivid[0] - vivid[2]) == pytest.approx(0.25)
    assert np.allclose(white, 0.65)
    assert np.allclose(steel, (0.56, 0.57, 0.58))
    assert np.allclose(black, 0.3)


# --- Trajectory -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["block", "flange"])
def test_trajectory_has_the_wanted_speed_and_shows_every_side(name: str) -> None:
    model = shape(name)
    center = model.center_in_model
    poses = trajectory(model, SequenceOptions(frames=400, seed=5))
    turns = [np.rad2deg(rotation_angle_rad(a, b)) for a, b in pairwise(poses)]
    centers = apply_all(poses, center)
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    assert np.mean(turns) == pytest.approx(7.0, rel=0.03)
    assert np.mean(steps) == pytest.approx(15.0, rel=0.05)
    assert max(turns) < 15
    assert steps.max() < 35
    distances = np.linalg.norm(centers, axis=1)
    assert distances.min() > 445
    assert distances.max() < 1005
    pixels = CAMERA.project(centers)
    assert np.all((pixels > 0) & (pixels < [640, 512]))
    eyes = np.stack([-pose[:3, :3].T @ pose[:3, 3] - center for pose in poses])
    eyes /= np.linalg.norm(eyes, axis=1, keepdims=True)
    assert len(np.unique(np.sign(eyes), axis=0)) == 8  # all octants


def apply_all(poses: Array, point: Array) -> Array:
    return np.stack([apply(pose, point) for pose in poses])


def test_pictures_depend_only_on_their_seed() -> None:
    model, photo = shape("bracket"), background(2, 800, 600)
    options = SequenceOptions("noise", frames=2, seed=4)
    first, again = (
        [frame.image for frame in render_sequence(model, trajectory(model, options), photo, options)] for _ in range(2)
    )
    assert len(first) == 2
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    other = replace(options, seed=5)
    assert not np.allclose(trajectory(model, options), trajectory(model, other))
    assert np.allclose(trajectory(model, options), trajectory(model, replace(options, variant="regular")))


# --- Look-alikes ----------------------------------------------------------------------------------------


def test_look_alikes_list_their_faulty_components() -> None:
    model = shape("assembly")
    found = {look_alike.name: look_alike for look_alike in look_alikes(model)}
    places = {c.name: c.bounds_in_model for c in model.components}
    missing = found["missing_post_2"]
    assert missing.components == ("post_2",)
    assert {c.name for c in missing.model.components} == set(places) - {"post_2"}
    moved = found["moved_block_1"]
    shifts = {c.name: np.linalg.norm((c.bounds_in_model - places[c.name])[0]) for c in moved.model.components}
    assert shifts.pop("block_1") == pytest.approx(20.0)
    assert max(shifts.values()) == 0
    swaps = [look_alike for look_alike in found.values() if look_alike.fault == "swapped"]
    assert swaps
    for swap in swaps:
        one, other = ({c.name: c for c in swap.model.components}[name] for name in swap.components)
        for moved_part, from_name in ((one, other.name), (other, one.name)):
            middle = moved_part.bounds_in_model.mean(axis=0)
            assert np.allclose(middle[:2], places[from_name].mean(axis=0)[:2])
            assert moved_part.bounds_in_model[0, 2] == pytest.approx(places[from_name][0, 2])
    assert not any("plate" in look_alike.components for look_alike in found.values())


def test_a_fault_shows_from_above_and_not_from_below() -> None:
    model = shape("assembly")
    center = model.center_in_model
    wrong = next(look_alike for look_alike in look_alikes(model) if look_alike.name == "missing_post_2")
    above, below = (look_at(center + np.array([0, -200.0, z]), center, [0, 0, 1.0]) for z in (600, -600))
    assert different_share(model, wrong.model, CAMERA, above) > 0.01
    assert different_share(model, wrong.model, CAMERA, below) == 0


def test_look_alike_of_one_component_is_refused() -> None:
    with pytest.raises(InputError, match="one component"):
        look_alikes(shape("block"))


# --- Ambiguity ------------------------------------------------------------------------------------------


def test_an_occluded_notch_leaves_the_pose_ambiguous() -> None:
    model, near = shape("flange"), near_symmetries("flange")
    center = model.center_in_model
    above = look_at(center + np.array([100.0, 50.0, 550.0]), center, [0, 1.0, 0])
    in_view = ZBufferRenderer(model, CAMERA).render(above).depth_mm > 0
    assert len(indistinguishable_poses(model, CAMERA, above, near, in_view)) == 1
    # Something lies over the notch, at +X of the disc's rim, and over the next place that a twin's notch has.
    mask = in_view.astype(np.uint8)
    for angle in np.deg2rad([0.0, 60.0]):
        rim_px = CAMERA.project(apply(above, np.array([85.0 * np.cos(angle), 85.0 * np.sin(angle), 9.0])[None]))[0]
        cv2.circle(mask, (round(rim_px[0]), round(rim_px[1])), 30, 0, -1)
    alike = indistinguishable_poses(model, CAMERA, above, near, mask > 0)
    # The places of the other twins' notches are seen to have none.
    assert len(alike) == 2
    assert np.rad2deg(rotation_angle_rad(alike[1][:3, :3], above[:3, :3])) == pytest.approx(60.0, abs=1e-4)


def test_the_flange_is_ambiguous_only_where_its_notch_is_hidden() -> None:
    model, near = shape("flange"), near_symmetries("flange")
    center = model.center_in_model
    above = look_at(center + np.array([100.0, 50.0, 550.0]), center, [0, 1.0, 0])
    assert len(indistinguishable_poses(model, CAMERA, above, near)) == 1
    # Exactly from the side opposite to the notch nothing but the rim and the hub is seen.
    aside = look_at(center + np.array([-700.0, 0.0, -22.0]), center, [0, 0, 1.0])
    alike = indistinguishable_poses(model, CAMERA, aside, near)
    assert len(alike) > 1
    meter = PoseMeter(model, CAMERA)
    estimate = alike[1]
    assert meter.measure(estimate, aside).rotation_deg > 50
    assert nearest_error(meter, estimate, alike).rotation_deg == pytest.approx(0.0, abs=1e-6)


# --- Files ----------------------------------------------------------------------------------------------


def test_scene_is_read_back_with_its_truth(tmp_path: Path, photos: tuple[Path, ...]) -> None:
    options = SequenceOptions("occlusion", frames=3, seed=1)
    job = shape_job("assembly", options, photos)
    target = make_sequence(job, tmp_path)
    scene = load_scene(target / "test" / "000001")
    assert [c.name for c in scene.part.model.components] == [c.name for c in shape("assembly").components]
    assert np.allclose(scene.camera.matrix, CAMERA.matrix)
    assert (scene.camera.width, scene.camera.height) == (640, 512)
    assert np.allclose(scene.poses, trajectory(shape("assembly"), options), atol=1e-9)
    assert len(scene.frames) == 3
    for frame in scene.frames:
        assert scene.image(frame).shape == (512, 640, 3)
        mask = scene.mask(frame)
        info = json.loads((scene.folder / "scene_gt_info.json").read_text())[str(frame.index)][0]
        assert frame.visible is not None and 0.0 < frame.visible <= 1.0
        assert mask is not None and np.count_nonzero(mask) == pytest.approx(info["px_count_visib"], rel=0.03)
        assert info["visib_fract"] == pytest.approx(info["px_count_visib"] / info["px_count_all"], abs=1e-3)


def test_an_existing_sequence_is_reused_unless_its_options_differ(tmp_path: Path, photos: tuple[Path, ...]) -> None:
    job = shape_job("block", SequenceOptions(frames=2), photos)
    picture = make_sequence(job, tmp_path) / "test" / "000001" / "rgb" / "000000.jpg"
    made = picture.stat().st_mtime_ns
    make_sequence(job, tmp_path)
    assert picture.stat().st_mtime_ns == made
    make_sequence(replace(job, options=SequenceOptions(frames=3)), tmp_path)
    assert picture.stat().st_mtime_ns != made
    assert len(list(picture.parent.iterdir())) == 3
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


def test_folder_of_something_else_is_left_alone(tmp_path: Path, photos: tuple[Path, ...]) -> None:
    (tmp_path / "block_regular").mkdir()
    with pytest.raises(OutputError, match="not a sequence made by arview"):
        make_sequence(shape_job("block", SequenceOptions(frames=1), photos), tmp_path)


def test_look_alike_scene_records_its_fault(tmp_path: Path, photos: tuple[Path, ...]) -> None:
    model = shape("assembly")
    wrong = look_alikes(model)[0]
    target = make_sequence(look_alike_job("assembly", model, wrong, SequenceOptions(frames=2), photos), tmp_path)
    assert read_record(target)["look_alike"] == {"fault": "missing", "components": ["post_1"]}
    scene = load_scene(target / "test" / "000001")
    assert {c.name for c in scene.part.model.components} == {c.name for c in model.components}
    info = json.loads((scene.folder / "scene_gt_info.json").read_text())
    assert len(info) == 2
    assert all("different_fract" in entries[0] for entries in info.values())


def test_recorded_trajectory_is_followed(tmp_path: Path, photos: tuple[Path, ...]) -> None:
    first = make_sequence(shape_job("block", SequenceOptions(frames=3), photos), tmp_path)
    followed = load_scene(first / "test" / "000001")
    model = shape("bracket")
    job = Job("other", model, SequenceOptions(frames=2), photos, follow=followed)
    scene = load_scene(make_sequence(job, tmp_path) / "test" / "000001")
    assert len(scene.poses) == 2
    for ours, theirs in zip(scene.poses, followed.poses[:2], strict=True):
        assert rotation_angle_rad(ours, theirs) < 1e-9
        assert np.allclose(
            apply(ours, model.center_in_model), apply(theirs, followed.part.model.center_in_model), atol=1e-3
        )


def test_no_background_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--backgrounds"):
        make_sequence(shape_job("block", SequenceOptions(frames=1), ()), tmp_path)
    small = tmp_path / "small.png"
    cv2.imwrite(str(small), np.zeros((20, 20, 3), np.uint8))
    with pytest.raises(InputError, match="too small"):
        make_sequence(shape_job("block", SequenceOptions(frames=1), (small,)), tmp_path)


def test_frames_without_the_part_have_the_wanted_number(tmp_path: Path, photos: tuple[Path, ...]) -> None:
    other = make_sequence(shape_job("flange", SequenceOptions(frames=4), photos), tmp_path)
    scene = load_scene(other / "test" / "000001")
    found = list(frames_without_part(photos, [scene], 320, 240, 12))
    assert len(found) == 12
    assert all(image.shape == (240, 320, 3) and image.dtype == np.uint8 for _, image in found)
    whole = [origin for origin, _ in found if not origin.endswith("(part)")]
    assert len(whole) == len(set(whole)) == 7  # 3 photos, and 4 of the scene's frames


def test_command_line_makes_a_scene_and_reports_errors(
    tmp_path: Path, photos: tuple[Path, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(str(TOOL.parent))

    def run(*words: str) -> int:
        monkeypatch.setattr(sys, "argv", [str(TOOL), *words, "-o", str(tmp_path / "out")])
        return int(runpy.run_path(str(TOOL))["main"]())

    assert run("--shape", "block", "--frames", "1", "--backgrounds", str(photos[0].parent)) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "out" / "block_regular")
    assert (tmp_path / "out" / "block_regular" / "test" / "000001" / "rgb" / "000000.jpg").is_file()
    assert run("--shape", "block", "--backgrounds", str(tmp_path / "none")) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ")
    assert said.count("\n") == 1


# --- Protocols ------------------------------------------------------------------------------------------


def test_full_sphere_range_is_stretched_to_four_to_one() -> None:
    low, high = full_sphere_range(500.0, 600.0).distance_mm
    assert high / low == pytest.approx(4.0)
    assert low * high == pytest.approx(0.95 * 500 * 1.05 * 600)
    assert full_sphere_range(100.0, 900.0).distance_mm == pytest.approx((95.0, 945.0))
    assert full_sphere_range(500.0, 600.0).is_full_sphere


def test_box_symmetries_turn_a_box_onto_itself() -> None:
    orders = [symmetry.order for symmetry in box_symmetries(brick())]
    assert orders == [2, 2, 2]
    bar = make_model("bar", (component("bar", box((0, 0, 0), (40, 41, 100)), (0.5, 0.5, 0.5)),))
    assert [symmetry.order for symmetry in box_symmetries(bar)] == [2, 2, 4]
    assert box_symmetries(bar)[2] == Symmetry((0.0, 0.0, 1.0), (20.0, 20.5, 50.0), 4)


class _Answers:
    """A detector that says what it is told to, picture by picture."""

    def __init__(self, *answers: list[Detection]) -> None:
        self._answers = list(answers)

    def detect(self, image: Image, max_results: int) -> list[Detection]:
        return self._answers.pop(0)


def test_ambiguous_detections_with_the_right_pose_are_counted_separately(
    tmp_path: Path, photos: tuple[Path, ...]
) -> None:
    made = make_sequence(shape_job("flange", SequenceOptions(frames=4), photos), tmp_path)
    scene = load_scene(made / "test" / "000001")
    meter = PoseMeter(scene.part.model, scene.camera)
    frames = scene.frames
    wrong = [true_pose(f) @ rigid(exp_so3([0.0, 0.0, np.deg2rad(60.0)]), np.zeros(3)) for f in frames]
    detector = _Answers(
        [Detection(true_pose(frames[0]), 0.9, alternatives=(wrong[0],))],
        [Detection(wrong[1], 0.9, alternatives=(true_pose(frames[1]),))],
        [Detection(wrong[2], 0.9)],
        [],
    )

    def error_of(estimate: Array, frame: SceneFrame) -> PoseError:
        return meter.measure(estimate, true_pose(frame))

    tally = detect_in_frames(scene, frames, detector, error_of)  # type: ignore[arg-type]
    assert (tally.frames, tally.right, tally.left_open) == (4, 1, 1)


def test_tallies_add_up() -> None:
    total = Tally(10, 9, (1.0,)) + Tally(30, 15, (2.0,))
    assert total.share == pytest.approx(0.6)
    assert total.ms == (1.0, 2.0)
    assert Tally().share == 0.0


def test_spread_frames_leave_out_what_is_hidden(tmp_path: Path, photos: tuple[Path, ...]) -> None:
    made = make_sequence(shape_job("block", SequenceOptions(frames=6), photos), tmp_path)
    scene = load_scene(made / "test" / "000001")
    frames = tuple(replace(frame, visible=0.3 if frame.index == 0 else 0.9) for frame in scene.frames)
    chosen = spread_frames(replace(scene, frames=frames), 3)
    assert [frame.index for frame in chosen] == [1, 3, 5]


def test_a_turned_part_changes_when_tilted_but_not_when_rotated_about_its_axis() -> None:
    shaft = [cylinder((0.0, 0.0), radius, *ends) for radius, ends in ((20.0, (-40.0, 10.0)), (12.0, (10.0, 40.0)))]
    plain = make_model("shaft", tuple(component(f"part_{k}", mesh, (0.6, 0.6, 0.6)) for k, mesh in enumerate(shaft)))
    key = component("key", box((-2, 12, 12), (2, 16, 38)), (0.6, 0.6, 0.6))
    keyed = make_model("keyed", (*plain.components, key))
    pose = rigid(exp_so3([1.9, 0.2, 0.1]), [15.0, -10.0, 400.0])

    def surface(of: Model) -> Surface:
        return surface_about(*reduced_surface(of), np.zeros(3))

    def changed(of: Model, axis: int, angle_deg: float) -> float:
        turn = exp_so3(np.deg2rad(angle_deg) * np.eye(3)[axis])
        return changed_share(surface(of), of.diameter_mm, rigid(pose[:3, :3] @ turn, pose[:3, 3]), pose)

    assert max(changed(plain, 2, angle) for angle in (4.0, 15.0, 37.0, 160.0)) < 0.01
    assert min(changed(plain, axis, 7.0) for axis in (0, 1)) > 0.05
    # The key is behind the shaft, and comes into view.
    assert changed(keyed, 2, 37.0) < 0.01
    assert changed(keyed, 2, 160.0) > 0.02
    aside = pose.copy()
    aside[0, 3] += 8.0
    assert changed_share(surface(plain), plain.diameter_mm, aside, pose) > 0.1
