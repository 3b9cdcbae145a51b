"""Texture modality and ray caster against synthetic truth: a textured box drawn by an exact numpy renderer."""

import copy

import cv2
import numpy as np
import pytest

from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import apply, exp_se3, invert, look_at, rotation_angle_rad
from arview.refinement.gauss_newton import apply_twist, solve_step
from arview.refinement.modalities import keyframes
from arview.refinement.modalities import texture as texture_module
from arview.refinement.modalities.texture import TextureModality
from arview.refinement.modalities.texture_matching import add_matches
from arview.rendering.raycast import RayCaster

HALF = np.array([60.0, 40.0, 25.0])
CAMERA = Camera(640, 480, 700.0, 705.0, 322.0, 237.0)
LENS = Camera(640, 480, 700.0, 705.0, 322.0, 237.0, np.array([-0.15, 0.05, 0.001, -0.001, 0.0]))
START = look_at([180.0, -260.0, 240.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0])


def box(half=HALF, center=(0.0, 0.0, 0.0)):
    """Vertices (8,3) and faces (12,3) of a box."""
    signs = np.array(list(np.ndindex(2, 2, 2))) * 2 - 1
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return signs * half + np.asarray(center), np.array(faces, dtype=np.int32)


def box_texture(seed):
    """(512,512) float32 of blobs about 4 px wide on a slower pattern."""
    rng = np.random.default_rng(seed)
    fine = cv2.GaussianBlur(rng.normal(size=(512, 512)).astype(np.float32), (0, 0), 3.0)
    slow = cv2.GaussianBlur(rng.normal(size=(512, 512)).astype(np.float32), (0, 0), 20.0)
    return np.clip(128 + 45 * fine / fine.std() + 25 * slow / slow.std(), 5, 250)


TEXTURES = [box_texture(k) for k in range(3)]


RENDERED = {}
"""Pictures without noise, and the generators after them, by what they show."""


def picture(camera, cam_from_body, seed=0, gain=1.0, offset=0.0, noise=2.0):
    """Grey picture (H,W) of the textured box on a noisy background, 4 samples per pixel."""
    key = (camera.matrix.tobytes(), camera.dist.tobytes(), cam_from_body.tobytes(), seed)
    if key not in RENDERED:
        rng = np.random.default_rng(seed)
        RENDERED[key] = rendered(camera, cam_from_body, rng), rng
    total, rng = RENDERED[key][0], copy.deepcopy(RENDERED[key][1])
    return np.clip(gain * total + offset + rng.normal(0, noise, total.shape), 0, 255).astype(np.uint8)


def rendered(camera, cam_from_body, rng):
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    body_from_cam = invert(cam_from_body)
    total = np.zeros((camera.height, camera.width), dtype=np.float32)
    back = cv2.resize(rng.uniform(60, 200, (60, 80)).astype(np.float32), (camera.width, camera.height))
    for du, dv in ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)):
        rays = camera.unproject(np.stack([u + du, v + dv], axis=-1)) @ body_from_cam[:3, :3].T
        origin = body_from_cam[:3, 3]
        enter = (-np.sign(rays) * HALF - origin) / rays
        leave = (np.sign(rays) * HALF - origin) / rays
        axis = np.argmax(enter, axis=-1)
        distance = enter.max(axis=-1)
        hit = distance < leave.min(axis=-1)
        points = origin + distance[..., None] * rays
        value = back.copy()
        for a in range(3):
            x, y = (points[..., k].astype(np.float32) * 3.5 + 255 for k in range(3) if k != a)
            value = np.where(hit & (axis == a), cv2.remap(TEXTURES[a], x, y, cv2.INTER_LINEAR), value)
        total += value / 4
    return total


def modality(camera=CAMERA):
    return TextureModality(*box(), camera)


def errors_px(camera, cam_from_body, matches):
    truth = camera.project(apply(cam_from_body, matches.points_in_body))
    return np.linalg.norm(matches.pixels - truth, axis=1)


@pytest.fixture(scope="module")
def first():
    return picture(CAMERA, START, seed=1)


def brute_force(vertices, faces, origin, direction):
    """Nearest hit by Möller & Trumbore over all triangles, plain numpy."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    p = np.cross(direction, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        det = np.sum((b - a) * p, axis=1)
        s = origin - a
        u = np.sum(s * p, axis=1) / det
        q = np.cross(s, b - a)
        v = q @ direction / det
        t = np.sum((c - a) * q, axis=1) / det
    t[~((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0))] = np.inf
    return t.min()


def test_ray_caster_equals_brute_force():
    rng = np.random.default_rng(0)
    centers = rng.normal(size=(3000, 1, 3)) * 50
    vertices = (centers + rng.normal(size=(3000, 3, 3)) * 5).reshape(-1, 3)
    faces = np.arange(9000).reshape(-1, 3)
    origins = rng.normal(size=(300, 3)) * 150
    directions = rng.normal(size=(300, 3)) * 30 - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distances, hit = RayCaster(vertices, faces).cast(origins, directions)
    expected = np.array([brute_force(vertices, faces, o, d) for o, d in zip(origins, directions, strict=True)])
    assert 100 < np.count_nonzero(hit >= 0) < 300
    np.testing.assert_array_equal(np.isfinite(expected), hit >= 0)
    seen = hit >= 0
    np.testing.assert_allclose(distances[seen], expected[seen], atol=1e-6)
    corners = vertices[faces[hit[seen]]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = origins[seen] + distances[seen, None] * directions[seen]
    assert np.abs(np.sum((points - corners[:, 0]) * normals, axis=1)).max() < 1e-6


def test_ray_caster_axis_parallel_rays_and_refusals():
    caster = RayCaster(*box())
    distances, faces = caster.cast([[0.0, 0, 100], [40, 0, 100], [61, 0, 100]], [[0.0, 0, -1]] * 3)
    np.testing.assert_allclose(distances, [75, 75, np.inf])
    assert faces[2] == -1
    with pytest.raises(InputError, match=r"expected \(N, 3\)"):
        caster.cast([[0.0, 0, 1]], [[0.0, 1]])


@pytest.mark.slow
@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
def test_matches_are_exact_under_motion_noise_and_exposure(camera):
    texture = modality(camera)
    assert texture.add_keyframe(picture(camera, START, seed=1), START) >= 80
    moved = START @ exp_se3([0.05, -0.04, 0.06, 3.0, -4.0, 5.0])
    for gain, offset in ((1.0, 0.0), (0.7, 0.0), (1.0, 25.0)):
        pyramid = texture.pyramid(picture(camera, moved, seed=2, gain=gain, offset=offset))
        matches = texture.measure(pyramid, START)
        error = errors_px(camera, moved, matches)
        assert len(error) >= 0.85 * matches.tried
        assert np.median(error) <= 0.15
        assert np.mean(error < 1.0) >= 0.97
        pose = texture.align(matches, START)
        assert rotation_angle_rad(pose, moved) < np.deg2rad(0.1)
        assert np.linalg.norm(pose[:3, 3] - moved[:3, 3]) < 0.6


@pytest.mark.slow
def test_prediction_wrong_by_25_px(first):
    texture = modality()
    texture.add_keyframe(first, START)
    for du, dv in ((25, 0), (-18, 18), (0, -25)):
        distance = START[2, 3]
        moved = START.copy()
        moved[:2, 3] += du * distance / CAMERA.fx, dv * distance / CAMERA.fy
        matches = texture.measure(texture.pyramid(picture(CAMERA, moved, seed=3)), START)
        error = errors_px(CAMERA, moved, matches)
        assert len(error) >= 0.8 * matches.tried
        assert np.median(error) <= 0.15


def test_hidden_half_is_rejected(first):
    texture = modality()
    texture.add_keyframe(first, START)
    moved = START @ exp_se3([0.02, 0.01, -0.02, 1.0, 1.0, 0.0])
    image = picture(CAMERA, moved, seed=4)
    split = int(CAMERA.project(moved[:3, 3])[0])
    other = cv2.GaussianBlur(np.random.default_rng(5).normal(size=image.shape), (0, 0), 2.0)
    image[:, split:] = np.clip(128 + 400 * other, 0, 255)[:, split:]
    matches = texture.measure(texture.pyramid(image), START)
    truth = CAMERA.project(apply(moved, matches.points_in_body))
    hidden = truth[:, 0] > split + 5
    assert np.count_nonzero(hidden) <= 0.03 * matches.tried
    assert np.median(errors_px(CAMERA, moved, matches)[~hidden]) <= 0.15
    assert np.count_nonzero(~hidden) >= 0.3 * matches.tried


def test_nothing_is_found_without_the_part(first):
    texture = modality()
    texture.add_keyframe(first, START)
    rng = np.random.default_rng(6)
    other = cv2.GaussianBlur(rng.normal(size=first.shape), (0, 0), 3.0)
    matches = texture.measure(texture.pyramid(np.clip(128 + 500 * other, 0, 255).astype(np.uint8)), START)
    assert len(matches.pixels) <= 0.05 * matches.tried
    flat = texture.measure(texture.pyramid(np.full_like(first, 90)), START)
    assert len(flat.pixels) == 0


def test_points_hidden_by_the_part_itself_are_not_expected(first, monkeypatch):
    vertices, faces = box()
    wall, wall_faces = box(np.array([30.0, 1.0, 30.0]), center=(30.0, -100.0, 30.0))
    both = np.concatenate([vertices, wall])
    both_faces = np.concatenate([faces, wall_faces + 8]).astype(np.int32)
    seen = TextureModality(both, both_faces, CAMERA)
    aware = TextureModality(both, both_faces, CAMERA)
    above = look_at([0.0, -160.0, 330.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    image = picture(CAMERA, above, seed=7)
    assert seen.add_keyframe(image, above) == aware.add_keyframe(image, above)
    lower = look_at([0.0, -300.0, 150.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    pyramid = seen.pyramid(picture(CAMERA, lower, seed=8))
    tried = aware.measure(pyramid, lower).tried
    monkeypatch.setattr(texture_module, "CHECK_OCCLUSION", False)
    assert tried <= 0.85 * seen.measure(pyramid, lower).tried


def test_corners_keep_off_edges_and_background(first):
    texture = modality()
    texture.add_keyframe(first, START)
    points = texture.keyframes[0].anchors.points
    to_faces = HALF - np.abs(points)
    np.testing.assert_allclose(to_faces.min(axis=1), 0.0, atol=1e-6)
    # The second smallest is the distance to the nearest edge of the box, at about 1.8 px per mm.
    assert np.sort(to_faces, axis=1)[:, 1].min() > 1.5


@pytest.mark.slow
def test_keyframe_bank_is_bounded_and_returns_to_known_views(monkeypatch):
    monkeypatch.setattr(texture_module, "MAX_KEYFRAMES", 3)
    monkeypatch.setattr(keyframes, "MAX_CORNERS", 40)
    texture = modality()
    poses = [START @ exp_se3([0.0, 0.0, 0.3 * k, 0.0, 0.0, 0.0]) for k in range(4)]
    for k, pose in enumerate(poses):
        assert texture.wants_keyframe(pose, 100)
        assert texture.add_keyframe(picture(CAMERA, pose, seed=k), pose) > 0
        assert not texture.wants_keyframe(pose, 0)
    assert len(texture.keyframes) == 3
    assert texture.wants_keyframe(poses[0], 100)
    near = poses[2] @ exp_se3([0.0, 0.02, 0.03, 0.0, 0.0, 0.0])
    assert not texture.wants_keyframe(near, 100)
    matches = texture.measure(texture.pyramid(picture(CAMERA, near, seed=9)), near)
    assert matches.tried <= 40
    assert np.median(errors_px(CAMERA, near, matches)) <= 0.15
    assert texture.add_keyframe(picture(CAMERA, near, seed=9), near) > 0
    assert len(texture.keyframes) == 3


def test_corners_that_disagree_lose_trust(first):
    texture = modality()
    pasted = first.copy()
    pasted[200:260, 300:360] = TEXTURES[0][:60, :60]
    texture.add_keyframe(pasted, START)
    moved = START.copy()
    moved[0, 3] += 2.6 * START[2, 3] / CAMERA.fx
    image = picture(CAMERA, moved, seed=10)
    image[200:260, 300:360] = pasted[200:260, 300:360]
    pyramid = texture.pyramid(image)
    before = texture.measure(pyramid, START)
    for _ in range(30):
        texture.measure(pyramid, START)
        texture.update_trust(moved)
    after = texture.measure(pyramid, START)
    wrong = errors_px(CAMERA, moved, before) > 2
    assert np.count_nonzero(wrong) >= 3
    assert np.count_nonzero(errors_px(CAMERA, moved, after) > 2) < 0.3 * np.count_nonzero(wrong)
    assert len(after.pixels) >= 0.8 * np.count_nonzero(~wrong)


def test_add_matches_solves_the_pose_despite_outliers():
    rng = np.random.default_rng(11)
    points = rng.uniform(-1, 1, (60, 3)) * HALF
    truth = START @ exp_se3([0.02, -0.03, 0.01, 1.0, -2.0, 3.0])
    pixels = LENS.project(apply(truth, points))
    pixels[:15] += rng.uniform(20, 60, (15, 2))
    intrinsics = np.array([LENS.fx, LENS.fy, LENS.cx, LENS.cy, *LENS.dist, 1.0])
    pose = START
    for robust_px in (40.0, 20.0, 10.0, 5.0, 5.0, 5.0):
        hessian, gradient = np.zeros((6, 6)), np.zeros(6)
        cost, weight, inliers = add_matches(
            hessian, gradient, points, pose, intrinsics, pixels, np.ones(60), 0.5, robust_px
        )
        pose = apply_twist(pose, solve_step(hessian, gradient, np.full(6, 1e-9)))
    assert inliers == 45
    assert cost / weight < 1e-2
    assert np.linalg.norm(pose[:3, 3] - truth[:3, 3]) < 0.02
    assert np.all(np.triu(hessian, 1) == 0)


def test_bad_input_is_refused(first):
    texture = modality()
    with pytest.raises(InputError, match="image is 320×240"):
        texture.pyramid(first[::2, ::2])
    assert texture.add_keyframe(np.full_like(first, 128), START) == 0
    away = START.copy()
    away[0, 3] += 5000
    assert texture.add_keyframe(first, away) == 0
    assert texture.measure(texture.pyramid(first), START).tried == 0
