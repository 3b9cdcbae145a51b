"""Real conditions: decoration, shadows, the camera's faults, the codec, borders; plain pictures stay as they are."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from arview.cad import Model, make_model
from arview.errors import InputError
from arview.geometry import Array, apply, exp_so3, look_at, rigid
from arview_lab.evaluation import load_scene
from arview_lab.semisynthetic import (
    CONDITIONS,
    CURVED_SHAPES,
    SHAPES,
    Conditions,
    SequenceFrame,
    SequenceOptions,
    conditions_job,
    curved_shape,
    make_sequence,
    real_trajectory,
    render_real,
    render_sequence,
    shape,
    trajectory,
)
from arview_lab.semisynthetic.camera_effects import CameraEffects, Motion, disc_blurred, through_codec
from arview_lab.semisynthetic.decoration import DecorationOptions, decorate
from arview_lab.semisynthetic.real_sequence import share_in_view, subdivided
from arview_lab.semisynthetic.shadows import ShadowOptions
from helpers.cad_files import box
from helpers.synthetic import background, component

SMALL = (320, 256)
QUIET = CameraEffects(read_noise=0.0)


def brick() -> Model:
    return make_model("brick", (component("brick", box((0, 0, 0), (140, 90, 60)), (0.6, 0.6, 0.6)),))


def oblique(model: Model, distance_mm: float = 600.0) -> Array:
    center = model.center_in_model
    return look_at(center + distance_mm * np.array([0.55, -0.62, 0.56]), center, [0.1, 0.0, 1.0])


def rendered(model: Model, poses: Array, conditions: Conditions, level: int = 30, seed: int = 3) -> list[SequenceFrame]:
    photo = np.full((600, 800, 3), level, np.uint8)
    return list(render_real(model, poses, photo, [background(2, 400, 300)], conditions, seed))


def middle_of(picture: Array) -> Array:
    """Mean column of what is brighter than half, in each row; nan where there is nothing."""
    weights = np.clip(picture, 0.0, None)
    total = weights.sum(axis=1)
    columns = np.arange(picture.shape[1])
    return np.where(total > 1.0, (weights * columns).sum(axis=1) / np.maximum(total, 1e-9), np.nan)


# --- Plain sequences stay as they are -------------------------------------------------------------------


def test_plain_pictures_are_the_same_as_before_there_were_real_conditions() -> None:
    # Of pictures made by the code before decoration, shadows and rolling shutters existed.
    options = SequenceOptions("light", frames=3, seed=3)
    model = shape("block")
    frames = list(render_sequence(model, trajectory(model, options), background(1, 800, 600), options))
    content = b"".join(frame.image.tobytes() + frame.mask.tobytes() for frame in frames)
    assert hashlib.sha256(content).hexdigest()[:16] == "229285cd9d18f2f6"


def test_real_conditions_are_no_shape_and_no_variant() -> None:
    assert SHAPES == ("block", "organic", "assembly", "bracket", "flange", "ribbed")
    assert not set(CURVED_SHAPES) & set(SHAPES)
    assert {"printed", "worn", "large", "border", "hd", "phone", "curved"} <= set(CONDITIONS)


# --- Curved shapes --------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", CURVED_SHAPES)
def test_curved_shapes_are_closed_and_smooth(name: str) -> None:
    model = curved_shape(name)
    assert 100 <= model.diameter_mm <= 300
    (part,) = model.components
    sides = np.concatenate([part.faces[:, [k, (k + 1) % 3]] for k in range(3)]).astype(np.int64)
    there, back = (np.sort(s[:, 0] * 10**6 + s[:, 1]) for s in (sides, sides[:, ::-1]))
    assert np.array_equal(there, back)
    assert len(np.unique(there)) == len(there)
    a, b, c = part.vertices_in_model[part.faces].transpose(1, 0, 2)
    crosses = np.cross(b - a, c - a)
    assert np.einsum("ij,ij->", a, crosses) / 6 > 0
    # Neighbouring triangles hardly fold: 99 % of all sides by less than 30°.
    normals = crosses / np.linalg.norm(crosses, axis=1, keepdims=True)
    owner = np.tile(np.arange(len(part.faces)), 3)
    keys = np.sort(sides, axis=1) @ np.array([10**6, 1])
    pairs = owner[np.argsort(keys, kind="stable")].reshape(-1, 2)
    folds = np.rad2deg(np.arccos(np.clip((normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(axis=1), -1, 1)))
    assert np.quantile(folds, 0.99) < 30.0


def test_unknown_curved_shape_names_the_known() -> None:
    with pytest.raises(InputError, match=r"teapot.*duck"):
        curved_shape("teapot")


# --- Decoration -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_decoration_changes_the_surface_and_not_the_outline() -> None:
    model = brick()
    poses = oblique(model)[None]
    plain = Conditions("plain", camera=QUIET)
    rich = DecorationOptions(photos=1.0, stickers=2.0, tapes=1.0, scratches=30.0, rust=0.3, dirt=0.3)
    (bare,), (rich_frame,) = rendered(model, poses, plain), rendered(model, poses, replace(plain, decoration=rich))
    assert np.array_equal(bare.mask, rich_frame.mask)
    inside, outside = cv2.erode(bare.mask, np.ones((7, 7))) > 0.999, cv2.dilate(bare.mask, np.ones((7, 7))) == 0
    assert np.array_equal(bare.image[outside], rich_frame.image[outside])
    assert np.count_nonzero(inside) > 5000
    change = np.abs(bare.image.astype(float) - rich_frame.image)[inside].mean()
    assert change > 12.0
    # The CAD that is to be found knows nothing of it.
    assert np.array_equal(model.components[0].color, (0.6, 0.6, 0.6))


@pytest.mark.slow
def test_decoration_depends_only_on_its_seed() -> None:
    model, options = brick(), DecorationOptions(photos=0.5, stickers=1.0, scratches=20.0, rust=0.2)
    photos = [background(2, 400, 300)]
    one, same, other = (decorate(model, options, photos, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert np.array_equal(one.texels, same.texels)
    assert np.array_equal(one.wear, same.wear)
    assert not np.array_equal(one.texels, other.texels)


@pytest.mark.slow
def test_a_print_stays_at_its_place_on_the_part() -> None:
    model = brick()
    conditions = Conditions("print", camera=QUIET, decoration=DecorationOptions(photos=1.0))
    poses = np.stack([oblique(model), rigid(exp_so3([0, 0, 0.35]), [8.0, -5.0, 0.0]) @ oblique(model)])
    first, second = rendered(model, poses, conditions)
    # Points of the upper face, seen in both pictures: the same print, so their values go together.
    places = np.stack(np.meshgrid(np.linspace(10, 130, 40), np.linspace(10, 80, 25)), axis=-1).reshape(-1, 2)
    points = np.column_stack([places, np.full(len(places), 60.0)])
    camera = conditions.pinhole
    values = []
    for frame, pose in ((first, poses[0]), (second, poses[1])):
        pixels = camera.project(apply(pose, points)).astype(np.float32)
        gray = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY).astype(np.float32)
        values.append(cv2.remap(gray, pixels[None, :, 0], pixels[None, :, 1], cv2.INTER_LINEAR)[0])
    assert np.std(values[0]) > 4.0
    assert np.corrcoef(values)[0, 1] > 0.95


@pytest.mark.slow
def test_rust_covers_the_wanted_share() -> None:
    model = brick()
    poses = oblique(model)[None]
    plain = Conditions("plain", camera=QUIET)
    shares = []
    for rust in (0.1, 0.4):
        (bare,), (rusty,) = (
            rendered(model, poses, replace(plain, decoration=DecorationOptions(rust=r))) for r in (0.0, rust)
        )
        inside = bare.mask > 0.999
        shares.append(float(np.mean(np.abs(bare.image.astype(int) - rusty.image).max(axis=2)[inside] > 6)))
    assert 0.02 < shares[0] < 0.25
    assert shares[1] > shares[0] + 0.1


# --- Shadows --------------------------------------------------------------------------------------------


def test_shadows_darken_the_background_and_leave_the_truth() -> None:
    model = brick()
    poses = oblique(model)[None]
    plain = Conditions("plain", camera=QUIET)
    (bare,) = rendered(model, poses, plain, 200)
    (shaded,) = rendered(model, poses, replace(plain, shadows=ShadowOptions(others=0.0)), 200)
    assert np.array_equal(bare.mask, shaded.mask)
    outside = cv2.dilate(bare.mask, np.ones((9, 9))) == 0
    darker = bare.image[outside].astype(int) - shaded.image[outside]
    assert darker.min() >= -1
    assert darker.max() > 60
    # A convex part casts no shadow on itself: what the light reaches stays as bright.
    inside = cv2.erode(bare.mask, np.ones((9, 9))) > 0.999
    assert np.median(np.abs(bare.image[inside].astype(int) - shaded.image[inside])) <= 1


def test_one_part_of_an_assembly_shades_another() -> None:
    model = shape("assembly")
    center = model.center_in_model
    poses = look_at(center + np.array([60.0, -150.0, 600.0]), center, [0.0, 1.0, 0.0])[None]
    plain = Conditions("plain", camera=QUIET)
    (bare,) = rendered(model, poses, plain)
    (shaded,) = rendered(model, poses, replace(plain, shadows=ShadowOptions(others=0.0, behind_strength=0.0)))
    inside = cv2.erode(bare.mask, np.ones((5, 5))) > 0.999
    darker = (bare.image[inside].astype(int) - shaded.image[inside]).max(axis=1)
    assert 0.01 < np.mean(darker > 15) < 0.7


# --- Camera ---------------------------------------------------------------------------------------------


def moving(model: Model, shift_mm: Array, count: int = 3) -> Array:
    """Poses that move by a shift from frame to frame; the middle one shows the part in the middle."""
    pose = rigid(np.eye(3), np.array([0.0, 0.0, 600.0]) - model.center_in_model)
    return np.stack([rigid(np.eye(3), (k - count // 2) * np.asarray(shift_mm)) @ pose for k in range(count)])


def test_rolling_shutter_shifts_rows_by_the_motion_and_keeps_the_middle_row() -> None:
    bar = make_model("bar", (component("bar", box((0, 0, 0), (40, 300, 20)), (0.6, 0.6, 0.6)),))
    poses = moving(bar, [12.0, 0.0, 0.0])
    still = Conditions("still", camera=QUIET)
    rolling = replace(still, camera=replace(QUIET, readout=0.8))
    first, second = (rendered(bar, poses, c)[1] for c in (still, rolling))
    camera = still.pinhole
    columns = [middle_of(frame.mask) for frame in (first, second)]
    rows = np.arange(camera.height)
    shift = columns[1] - columns[0]
    # The near face's outline: 590 mm away.
    expected = 12.0 * camera.fx / 590.0 * 0.8 * (rows - 0.5 * (camera.height - 1)) / camera.height
    known = np.isfinite(shift) & (np.abs(rows - camera.cy) < 140)
    assert np.count_nonzero(known) > 200
    # Samples are a third of a pixel apart.
    assert np.abs(shift - expected)[known].max() < 0.17
    assert np.abs(shift - expected)[known].mean() < 0.08
    assert np.ptp(shift[known]) > 4.0
    assert np.array_equal(second.cam_from_model, poses[1])


@pytest.mark.slow
def test_rolling_shutter_follows_rotations_too() -> None:
    model = brick()
    pose = oblique(model)
    spin = rigid(exp_so3([0.05, 0.02, 0.09]), np.zeros(3))
    poses = np.stack([pose @ np.linalg.inv(spin), pose, pose @ spin])
    camera = CONDITIONS["phone"].pinhole
    vertices = subdivided(model, 15.0).mesh[0]
    points = Motion(poses, 1).points(vertices, 0.0, 0.7, np.array([camera.fy, camera.cy]), camera.height)
    rows = camera.project(points)[:, 1]
    # Every vertex is where the part is at the moment at which its row is exposed.
    times = 0.7 * (rows - 0.5 * (camera.height - 1)) / camera.height
    exact = np.stack([apply(Motion(poses, 1).at(t), v) for t, v in zip(times, vertices, strict=True)])
    assert np.abs(camera.project(exact) - camera.project(points)).max() < 0.02
    assert np.abs(camera.project(apply(pose, vertices)) - camera.project(points)).max() > 1.0


@pytest.mark.slow
def test_motion_blur_is_as_long_as_the_motion_while_the_shutter_is_open() -> None:
    model = brick()
    poses = moving(model, [14.0, 0.0, 0.0])
    for shutter in (0.0, 0.5):
        frame = rendered(model, poses, Conditions("blur", camera=replace(QUIET, shutter=shutter)))[1]
        profile = frame.mask[round(CONDITIONS["printed"].pinhole.cy)]
        ramp = np.count_nonzero((profile > 0.02) & (profile < 0.98)) / 2
        wanted = shutter * 14.0 * 650.0 / 570.0
        assert ramp == pytest.approx(wanted, abs=1.6)


def test_defocus_keeps_the_light_and_widens_edges() -> None:
    image = np.zeros((64, 64, 1), np.float32)
    image[28:36, 28:36] = 1.0
    blurred = disc_blurred(image, 3.0, 0.8)
    assert blurred.sum() == pytest.approx(64.0, rel=1e-3)
    assert np.count_nonzero(blurred > 0.01) > 150
    assert np.array_equal(disc_blurred(image, 0.0, 0.0), image)


def test_exposure_and_white_balance_drift_but_stay_usable() -> None:
    model = brick()
    poses = np.repeat(oblique(model)[None], 20, axis=0)
    effects = replace(QUIET, light_ev=0.6, exposure_lag=5.0, white_balance=0.06)
    frames = rendered(model, poses, Conditions("auto", SMALL, camera=effects), 120)
    means = np.array([frame.image.mean(axis=(0, 1)) for frame in frames])
    brightness = means.mean(axis=1)
    assert np.ptp(brightness) > 8.0
    assert brightness.min() > 40.0 and brightness.max() < 215.0
    assert np.ptp(means[:, 0] / means[:, 1]) > 0.02


# --- Codec ----------------------------------------------------------------------------------------------


def numbered(count: int, size: tuple[int, int] = (320, 240)) -> list[SequenceFrame]:
    """Frames that show their own number as a bar code of 8 bits."""
    frames = []
    for number in range(count):
        image = background(number, *size)
        for bit in range(8):
            image[20:60, 20 + 30 * bit : 44 + 30 * bit] = 235 if number >> bit & 1 else 20
        pose = rigid(np.eye(3), [float(number), 0.0, 500.0])
        frames.append(SequenceFrame(image, pose, 10.0, 10.0, np.zeros(size[::-1], np.float32)))
    return frames


def number_in(image: Array) -> int:
    return sum(int(image[40, 32 + 30 * bit].mean() > 128) << bit for bit in range(8))


@pytest.mark.parametrize("mbit", [0.6, 6.0])
def test_codec_keeps_number_order_and_truth_of_the_frames(mbit: float) -> None:
    sent = numbered(40)
    got = list(through_codec(iter(sent), mbit))
    assert [number_in(frame.image) for frame in got] == list(range(40))
    assert [frame.cam_from_model[0, 3] for frame in got] == list(range(40))
    error = np.mean([np.abs(a.image.astype(float) - b.image).mean() for a, b in zip(sent, got, strict=True)])
    assert 0.5 < error < 60.0


def test_a_lower_bit_rate_is_worse() -> None:
    model = brick()
    poses = np.repeat(oblique(model)[None], 6, axis=0)
    clean = Conditions("clean", SMALL, camera=replace(QUIET, mbit_per_s=0.0))
    truth = rendered(model, poses, clean, 120)

    def error(mbit: float) -> float:
        frames = rendered(model, poses, replace(clean, camera=replace(QUIET, mbit_per_s=mbit)), 120)
        pairs = zip(truth, frames, strict=True)
        return float(np.mean([np.abs(a.image.astype(float) - b.image).mean() for a, b in pairs]))

    assert error(0.05) > error(4.0)


# --- Sizes and borders ----------------------------------------------------------------------------------


def test_the_part_has_the_same_share_of_the_height_at_every_size() -> None:
    model = brick()
    pose = oblique(model)
    heights = []
    for size in ((640, 512), (1280, 720), (1920, 1080)):
        camera = replace(CONDITIONS["printed"], size=size).pinhole
        assert (camera.width, camera.height) == size
        rows = camera.project(apply(pose, model.mesh[0]))[:, 1]
        heights.append(np.ptp(rows) / size[1])
    assert np.ptp(heights) < 1e-9


@pytest.mark.slow
def test_border_cuts_the_part_as_wanted() -> None:
    conditions = CONDITIONS["border"]
    model = shape("block")
    poses = real_trajectory(model, conditions, 24, 1)
    shares = np.array([share_in_view(model, conditions.pinhole, pose, 4) for pose in poses])
    assert conditions.in_view == (0.4, 0.9)
    assert shares.min() > 0.37 and shares.max() < 0.93
    assert np.ptp(shares) > 0.1
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert steps.max() < 60.0
    frame = rendered(model, poses[:1], replace(conditions, camera=QUIET))[0]
    assert frame.visible == pytest.approx(shares[0], abs=0.03)


def test_large_parts_fill_the_picture() -> None:
    conditions = CONDITIONS["large"]
    model = shape("assembly")
    camera = conditions.pinhole
    for pose in real_trajectory(model, conditions, 10, 1):
        extent = np.ptp(camera.project(apply(pose, model.mesh[0])), axis=0)
        assert extent.max() > 0.55 * camera.height


def test_halved_sides_leave_the_surface() -> None:
    model = shape("block")
    fine = subdivided(model, 20.0)
    a, b, c = fine.components[0].vertices_in_model[fine.components[0].faces].transpose(1, 0, 2)
    longest = max(np.linalg.norm(x - y, axis=1).max() for x, y in ((a, b), (b, c), (c, a)))
    assert longest <= 20.0
    first = model.components[0]
    p, q, r = first.vertices_in_model[first.faces].transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(q - p, r - p), axis=1).sum()
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() == pytest.approx(area)
    assert np.einsum("ij,ij->", a, np.cross(b, c)) == pytest.approx(np.einsum("ij,ij->", p, np.cross(q, r)))


# --- Files ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_sequence_under_real_conditions_is_read_back_and_reused(tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for k in range(3):
        cv2.imwrite(str(folder / f"{k}.png"), background(k, 800, 600))
    photos = tuple(sorted(folder.iterdir()))
    job = conditions_job("duck", CONDITIONS["phone"], 3, 1, photos)
    assert job.photo not in job.printed_photos()
    target = make_sequence(job, tmp_path / "out")
    scene = load_scene(target / "test" / "000001")
    assert (scene.camera.width, scene.camera.height) == (1280, 720)
    assert len(scene.frames) == 3
    expected = real_trajectory(curved_shape("duck"), CONDITIONS["phone"], 3, 1)
    assert np.allclose(scene.poses, expected, atol=1e-9)
    assert json.loads((target / "sequence.json").read_text())["conditions"]["name"] == "phone"
    picture = target / "test" / "000001" / "rgb" / "000000.jpg"
    content, made = picture.read_bytes(), picture.stat().st_mtime_ns
    make_sequence(job, tmp_path / "out")
    assert picture.stat().st_mtime_ns == made
    again = make_sequence(job, tmp_path / "again")
    assert (again / "test" / "000001" / "rgb" / "000000.jpg").read_bytes() == content
