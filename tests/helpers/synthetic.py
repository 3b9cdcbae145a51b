"""Makers of ground truth: small assemblies made in code, and pictures of them at known poses.

A picture is shaded per face with a procedural texture, drawn at twice the size and averaged, before a background of
gradients, blobs and lines; gain, an occluding card and sensor noise come last. Everything follows from seeds.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from arview.cad.model import Component, Model, make_model
from arview.cad.view_range import ViewRange
from arview.camera import Camera
from arview.geometry import Array, apply, exp_se3, exp_so3, look_at, rigid, rotation_angle_rad
from arview.guideviews import GuideViewOptions, GuideViewSet
from arview.guideviews.cache import cached_guide_views
from arview.rendering.rasterizer import rasterise
from helpers.cad_files import box

CAMERA = Camera(640, 480, 720.0, 722.0, 318.0, 242.0)
RANGE = ViewRange((420.0, 640.0), elevation_deg=(15.0, 75.0), azimuth_deg=(-80.0, 80.0), roll_deg=(-20.0, 20.0))
LIGHT_IN_MODEL = np.array([0.5, -0.35, 0.79])


def post(
    center: tuple[float, float], radius: float, low: float, high: float, sides: int = 24
) -> tuple[Array, NDArray[np.int64]]:
    """Vertices and outward faces of a closed upright cylinder."""
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([center[0] + radius * np.cos(angle), center[1] + radius * np.sin(angle)], axis=1)
    rings = [np.column_stack([ring, np.full(sides, z)]) for z in (low, high)]
    vertices = np.concatenate([*rings, [[*center, low], [*center, high]]])
    i, j = np.arange(sides), (np.arange(sides) + 1) % sides
    faces = [(i, j, sides + j), (i, sides + j, sides + i)]
    faces += [(np.full(sides, 2 * sides), j, i), (np.full(sides, 2 * sides + 1), sides + i, sides + j)]
    return vertices, np.concatenate([np.stack(f, axis=1) for f in faces])


def component(name: str, mesh: tuple[Array, NDArray[np.int64]], color: tuple[float, float, float]) -> Component:
    return Component(name, mesh[0], mesh[1].astype(np.int32), color)


@cache
def bracket() -> Model:
    """An L of two blocks with a step, 120 × 90 × 70 mm: no symmetry, no curve."""
    return make_model(
        "bracket",
        (
            component("base", box((0, 0, 0), (120, 90, 18)), (0.75, 0.42, 0.25)),
            component("wall", box((0, 0, 18), (26, 90, 70)), (0.35, 0.50, 0.70)),
            component("step", box((70, 12, 18), (108, 48, 40)), (0.80, 0.75, 0.30)),
        ),
    )


@cache
def assembly() -> Model:
    """Plate with posts of different heights and blocks, 160 × 120 × 66 mm, seven components."""
    return make_model(
        "assembly",
        (
            component("plate", box((0, 0, 0), (160, 120, 12)), (0.62, 0.62, 0.64)),
            component("post_1", post((28, 26), 11, 12, 60), (0.80, 0.35, 0.25)),
            component("post_2", post((126, 30), 8, 12, 44), (0.30, 0.55, 0.75)),
            component("post_3", post((122, 92), 14, 12, 34), (0.85, 0.70, 0.25)),
            component("block_1", box((20, 66, 12), (62, 104, 38)), (0.35, 0.65, 0.40)),
            component("block_2", box((72, 42, 12), (94, 74, 66)), (0.55, 0.40, 0.65)),
            component("rail", box((52, 10, 12), (104, 20, 24)), (0.25, 0.30, 0.35)),
        ),
    )


def changed(model: Model, **shifts_mm: tuple[float, float] | None) -> Model:
    """A look-alike: components moved along x and y, or left out."""
    kept = [part for part in model.components if shifts_mm.get(part.name, ()) is not None]
    ways = [np.array([*(shifts_mm.get(part.name) or (0.0, 0.0)), 0.0]) for part in kept]
    moved = [
        replace(part, vertices_in_model=part.vertices_in_model + way) for part, way in zip(kept, ways, strict=True)
    ]
    return make_model("look-alike", tuple(moved))


@cache
def block() -> Model:
    """A lone plain block, 80 × 60 × 40 mm."""
    return make_model("block", (component("block", box((0, 0, 0), (80, 60, 40)), (0.6, 0.6, 0.6)),))


@cache
def assembly_views() -> GuideViewSet:
    """Guide views of the assembly over RANGE, about 4° apart, from the user's cache: the code's hash keeps it fresh."""
    return cached_guide_views(assembly(), RANGE, GuideViewOptions(renderer="zbuffer"))


def pose_from(
    azimuth_deg: float, elevation_deg: float, distance_mm: float, model: Model | None = None, roll_deg: float = 0.0
) -> Array:
    """``cam_from_model`` looking at the model's centre from there."""
    center = (model or assembly()).center_in_model
    a, e = np.deg2rad([azimuth_deg, elevation_deg])
    eye = center + distance_mm * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    return exp_se3([0, 0, np.deg2rad(roll_deg), 0, 0, 0]) @ look_at(eye, center, [0.0, 0.0, 1.0])


def turned_about(pose: Array, angle_deg: float, count: int) -> Array:
    """A pose (4,4) turned by an angle about random axes through its origin, (count,4,4)."""
    axes = np.random.default_rng(2).normal(size=(count, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return np.stack([rigid(exp_so3(np.deg2rad(angle_deg) * axis) @ pose[:3, :3], pose[:3, 3]) for axis in axes])


def path(count: int, seed: int = 0, model: Model | None = None) -> list[Array]:
    """A smooth hand-like motion: up to about 8 px and 0.7° from frame to frame."""
    rng = np.random.default_rng(seed)
    phases = rng.uniform(0, 2 * np.pi, 6)
    poses = []
    for i in range(count):
        t = 2 * np.pi * i / 60.0
        s = np.sin(t + phases) - np.sin(phases)
        pose = pose_from(40 + 12 * s[0], 42 + 6 * s[1], 520 + 35 * s[2], model, 4 * s[3])
        pose[:2, 3] += [25 * s[4], 15 * s[5]]
        poses.append(pose)
    return poses


def error(cam_from_model: Array, truth: Array, model: Model | None = None) -> tuple[float, float, float]:
    """Distance of the centres in mm, its part across the line of sight in mm, angle in deg."""
    center = (model or assembly()).center_in_model
    a, b = apply(cam_from_model, center), apply(truth, center)
    sight = b / np.linalg.norm(b)
    apart = a - b
    across = apart - apart @ sight * sight
    angle = np.rad2deg(rotation_angle_rad(cam_from_model, truth))
    return float(np.linalg.norm(apart)), float(np.linalg.norm(across)), float(angle)


def wrong(
    pose: Array, rng: np.random.Generator, angle_deg: float, shift_mm: float, model: Model | None = None
) -> Array:
    """The pose turned about the part's centre about a random axis, and shifted in a random direction."""
    center = np.eye(4)
    center[:3, 3] = (model or assembly()).center_in_model
    axis, way = rng.normal(size=(2, 3))
    turn = exp_se3([*(np.deg2rad(angle_deg) * axis / np.linalg.norm(axis)), 0, 0, 0])
    turn[:3, 3] = shift_mm * way / np.linalg.norm(way)
    return pose @ center @ turn @ np.linalg.inv(center)


@cache
def _texture(seed: int) -> NDArray[np.float32]:
    """(512,512) of mean 0, deviation 1: blobs about 4 samples wide on a slower pattern."""
    rng = np.random.default_rng(seed)
    fine = cv2.GaussianBlur(rng.normal(size=(512, 512)).astype(np.float32), (0, 0), 2.5)
    slow = cv2.GaussianBlur(rng.normal(size=(512, 512)).astype(np.float32), (0, 0), 20.0)
    both = fine / fine.std() + 0.6 * slow / slow.std()
    return np.asarray(both / both.std(), dtype=np.float32)


@cache
def background(seed: int, width: int = CAMERA.width, height: int = CAMERA.height) -> NDArray[np.uint8]:
    """(H,W,3) clutter of gradients, blobs, boxes and lines."""
    rng = np.random.default_rng(1000 + seed)
    corners = rng.uniform(60, 190, (2, 2, 3)).astype(np.float32)
    image = cv2.resize(corners, (width, height), interpolation=cv2.INTER_LINEAR)
    for _ in range(14):
        color = rng.uniform(20, 235, 3).tolist()
        u, v = int(rng.uniform(0, width)), int(rng.uniform(0, height))
        a, b = (int(x) for x in rng.uniform(8, 70, 2))
        cv2.ellipse(image, (u, v), (a, b), float(rng.uniform(0, 180)), 0, 360, color, -1, cv2.LINE_AA)
    for _ in range(8):
        color = rng.uniform(20, 235, 3).tolist()
        corner, size = rng.uniform([0, 0], [width, height]), rng.uniform(15, 90, 2)
        points = cv2.boxPoints((corner.tolist(), size.tolist(), float(rng.uniform(0, 90))))
        cv2.fillPoly(image, [np.round(points).astype(np.int32)], color, cv2.LINE_AA)
    for _ in range(12):
        ends = np.round(rng.uniform([0, 0], [width, height], (2, 2))).astype(int)
        cv2.line(image, ends[0].tolist(), ends[1].tolist(), rng.uniform(20, 235, 3).tolist(), 2, cv2.LINE_AA)
    return np.asarray(np.clip(image, 0, 255).astype(np.uint8))


@njit(cache=True)
def _texture_places(
    face: NDArray[np.int32], inverse_depth: Array, cam_from_model: Array, lens: Array, largest: NDArray[np.int64],
    owners: NDArray[np.int32],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:  # fmt: skip
    """Column and row in the texture, (H,W) each, of the pixels that show a face.

    Texture lies on the surface: the two axes across the normal's largest component, shifted per component.
    """
    x, y = np.zeros(face.shape, np.float32), np.zeros(face.shape, np.float32)
    fx, fy, cx, cy = lens
    for row in range(face.shape[0]):
        for column in range(face.shape[1]):
            k = face[row, column]
            if k < 0:
                continue
            z = 1.0 / inverse_depth[row, column]
            a, b, c = (column - cx) / fx * z, (row - cy) / fy * z, z
            a, b, c = a - cam_from_model[0, 3], b - cam_from_model[1, 3], c - cam_from_model[2, 3]
            first, second = (1 if largest[k] == 0 else 0), (1 if largest[k] == 2 else 2)
            shift = 97.0 * owners[k] + 41.0 * largest[k]
            u = cam_from_model[0, first] * a + cam_from_model[1, first] * b + cam_from_model[2, first] * c
            v = cam_from_model[0, second] * a + cam_from_model[1, second] * b + cam_from_model[2, second] * c
            x[row, column] = 510.0 - abs((2.0 * u + shift) % 1020.0 - 510.0)
            y[row, column] = 510.0 - abs((2.0 * v + shift) % 1020.0 - 510.0)
    return x, y


@njit(cache=True)
def _painted(face: NDArray[np.int32], colors: Array, pattern: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H,W,3) the color of each pixel's face and the pattern on it; black beside the part."""
    image = np.zeros((*face.shape, 3), np.float32)
    for row in range(face.shape[0]):
        for column in range(face.shape[1]):
            k = face[row, column]
            if k >= 0:
                for channel in range(3):
                    image[row, column, channel] = colors[k, channel] + pattern[row, column]
    return image


def _seen_box(face: NDArray[np.int32]) -> tuple[int, int, int, int]:
    """left, top, right, bottom of the pixels that show a face, even numbers; two pixels where none does."""
    rows, columns = np.flatnonzero((face >= 0).any(axis=1)), np.flatnonzero((face >= 0).any(axis=0))
    if not len(rows):
        return 0, 0, 2, 2
    left, top = int(columns[0]) // 2 * 2, int(rows[0]) // 2 * 2
    return left, top, int(columns[-1]) // 2 * 2 + 2, int(rows[-1]) // 2 * 2 + 2


@njit(cache=True)
def _exposed(image: NDArray[np.float32], gain: float, noise: float, deviations: Array) -> NDArray[np.uint8]:
    """Grey levels of a picture with a gain and noise."""
    result = np.empty(image.shape, np.uint8)
    flat, given, normal = result.reshape(-1), image.reshape(-1), deviations.reshape(-1)
    for i in range(len(flat)):
        flat[i] = np.uint8(min(max(np.rint(np.float32(gain) * given[i] + noise * normal[i]), 0.0), 255.0))
    return result


def picture(
    cam_from_model: Array | None,
    model: Model | None = None,
    camera: Camera = CAMERA,
    seed: int = 0,
    scene: int = 0,
    gain: float = 1.0,
    noise: float = 2.0,
    contrast: float = 12.0,
    card: tuple[int, int, int, int] | None = None,
) -> NDArray[np.uint8]:
    """What an ideal camera sees.

    Args:
        cam_from_model: None leaves the part out.
        seed: of the sensor's noise; scene: of the background.
        gain: of the exposure; noise: deviation in grey levels; contrast: of the part's texture in grey levels.
        card: left, top, right, bottom in px of an opaque card in front of everything.
    """
    model = model or assembly()
    rng = np.random.default_rng(seed)
    image = background(scene, camera.width, camera.height).astype(np.float32)
    if cam_from_model is not None:
        big = camera.scaled(2 * camera.width, 2 * camera.height)
        vertices, faces, owners = model.mesh
        inverse_depth, ids = rasterise(
            apply(cam_from_model, vertices), faces, big.fx, big.fy, big.cx, big.cy, big.width, big.height
        )
        corners = vertices[faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        light = 0.55 + 0.45 * np.clip(normals @ LIGHT_IN_MODEL, -0.6, 1.0)
        colors = np.array([c.color for c in model.components])[owners] * 230.0 * light[:, None]
        lens = np.array([big.fx, big.fy, big.cx, big.cy])
        largest = np.argmax(np.abs(normals), axis=1)
        left, top, right, bottom = _seen_box(ids)
        seen, depth = ids[top:bottom, left:right], inverse_depth[top:bottom, left:right]
        lens[2:] -= left, top
        x, y = _texture_places(seen, depth, cam_from_model, lens, largest, owners)
        large = _painted(seen, colors, contrast * cv2.remap(_texture(7), x, y, cv2.INTER_LINEAR))
        size = ((right - left) // 2, (bottom - top) // 2)
        covered = cv2.resize((seen >= 0).astype(np.float32), size, interpolation=cv2.INTER_AREA)[..., None]
        place = np.s_[top // 2 : bottom // 2, left // 2 : right // 2]
        image[place] = image[place] * (1.0 - covered) + cv2.resize(large, size, interpolation=cv2.INTER_AREA)
    if card is not None:
        left, top, right, bottom = card
        image[top:bottom, left:right] = background(scene + 500, camera.width, camera.height)[top:bottom, left:right]
    return _exposed(image, gain, noise, rng.standard_normal(image.shape))


def part_box(
    cam_from_model: Array, camera: Camera = CAMERA, model: Model | None = None, margin_px: int = 12
) -> tuple[int, int, int, int]:
    """left, top, right, bottom in px of the part in the picture, with a margin, inside the picture."""
    pixels = camera.project(apply(cam_from_model, (model or assembly()).mesh[0]))
    left, top = np.floor(pixels.min(axis=0)).astype(int) - margin_px
    right, bottom = np.ceil(pixels.max(axis=0)).astype(int) + margin_px
    return max(left, 0), max(top, 0), min(right, camera.width), min(bottom, camera.height)


def half_hidden(pose: Array) -> tuple[int, int, int, int]:
    """The card, see `picture`, that hides the left half of the part."""
    left, top, right, bottom = part_box(pose)
    return left, top, (left + right) // 2, bottom
