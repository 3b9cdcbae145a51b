"""Photos of a textured assembly with exact truth: rendered from its triangles, with solid noise for texture."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from arview.cad.model import Component, Model, make_model
from arview.camera import Camera
from arview.geometry import Array, apply, invert, look_at
from arview.rendering.rasterizer import rasterise
from helpers.cad_files import box

Picture = NDArray[np.uint8]
CAMERA = Camera(640, 480, 720.0, 720.0, 319.5, 239.5, np.array([-0.06, 0.01, 0.0, 0.0, 0.0]))
PAINT: Callable[[Array], Array] | None = None
"""Grey values of points (N,3) of the model where they shall have no texture; tests set it."""
_GRID = 48


def bench(seed: int = 0) -> Model:
    """A plate of 200 mm with four blocks on a bench; ``seed`` moves the blocks."""
    rng = np.random.default_rng(seed)
    boxes = {"bench": ((-260, -260, -12), (260, 260, -8)), "plate": ((-100, -100, -8), (100, 100, 0))}
    for i, (x, y) in enumerate([(-50, -45), (45, -50), (50, 40), (-40, 55)]):
        half = rng.uniform(10, 22, 3)
        boxes[f"block_{i + 1}"] = ((x - half[0], y - half[1], 0), (x + half[0], y + half[1], 2 * half[2]))
    parts = []
    for name, (low, high) in boxes.items():
        vertices, faces = box(low, high)
        parts.append(Component(name, vertices, faces.astype(np.int32)))
    return make_model("bench", tuple(parts))


def ring(count: int, distance_mm: float = 520.0, elevations_deg: tuple[float, ...] = (35.0, 60.0)) -> list[Array]:
    """``cam_from_model`` of cameras around the plate, at two heights in turn."""
    poses = []
    for i in range(count):
        azimuth, elevation = 2 * np.pi * i / count, np.radians(elevations_deg[i % len(elevations_deg)])
        direction = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        poses.append(look_at(np.array(direction) * distance_mm, [0.0, 0.0, 5.0], [0.0, 0.0, 1.0]))
    return poses


def photograph(
    model: Model, cam_from_model: Array, camera: Camera = CAMERA, seed: int = 0, noise: float = 2.0,
    moves: Mapping[str, Array] | None = None, is_linear: bool = False,
) -> Picture:  # fmt: skip
    """The picture of a model, (H,W,3) uint8: twice the size, then through the lens, with noise.

    Components are taken along by ``moves`` (4,4), and their texture with them. With ``is_linear`` a pixel averages the
    light that falls on it, as that of a camera does, not grey levels: an edge is then where it is found.
    """
    twice = camera.without_distortion().scaled(2 * camera.width, 2 * camera.height)
    places = [(moves or {}).get(component.name, np.eye(4)) for component in model.components]
    parts = [
        (apply(place, component.vertices_in_model), component.faces)
        for place, component in zip(places, model.components, strict=True)
    ]
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    vertices = np.concatenate([vertices for vertices, _ in parts])
    faces = np.concatenate([faces + start for (_, faces), start in zip(parts, starts, strict=False)])
    inverse_depth, face = rasterise(
        apply(cam_from_model, vertices), faces, twice.fx, twice.fy, twice.cx, twice.cy, twice.width, twice.height
    )
    owner = np.repeat(np.arange(len(parts)), [len(faces) for _, faces in parts])
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    light = 0.65 + 0.35 * normals @ (0.3, -0.4, 0.87)
    tones = {"bench": 0.45, "plate": 1.25}
    tone = np.concatenate([np.full(len(one.faces), tones.get(one.name, 0.8)) for one in model.components])
    texture_from_cam = np.stack([invert(place) @ invert(cam_from_model) for place in places])
    intrinsics = np.array([twice.fx, twice.fy, twice.cx, twice.cy])
    if PAINT is None:
        grey = _shaded(face, inverse_depth, owner, light * tone, texture_from_cam, intrinsics, _grid(seed))
    else:
        v, u = np.nonzero(face >= 0)
        seen, depth = face[v, u], 1.0 / inverse_depth[v, u]
        in_cam = np.stack([(u - twice.cx) / twice.fx * depth, (v - twice.cy) / twice.fy * depth, depth], axis=1)
        place = texture_from_cam[owner[seen]]
        grey = np.full(face.shape, 30.0)
        grey[v, u] = PAINT(np.einsum("nij,nj->ni", place[:, :3, :3], in_cam) + place[:, :3, 3]) * (light * tone)[seen]
    if is_linear:
        grey = 255.0 * (np.clip(grey, 0.0, 255.0) / 255.0) ** 2.2
    small = cv2.resize(grey, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    through = _through_lens(small, camera)
    if is_linear:
        through = 255.0 * (np.maximum(through, 0.0) / 255.0) ** (1.0 / 2.2)
    through += np.random.default_rng(int(abs(cam_from_model[:3].sum()) * 1e3) + seed).normal(0.0, noise, through.shape)
    return np.repeat(np.clip(through, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


@cache
def _grid(seed: int) -> Array:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (_GRID, _GRID, _GRID))


@njit(cache=True)
def _noise(grid: Array, x: float, y: float, z: float) -> float:
    """Value of a grid at a point, between its nodes; the grid is repeated in all directions."""
    i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    a, b, c = x - i, y - j, z - k
    n = grid.shape[0]
    i, j, k = i % n, j % n, k % n
    i_next, j_next, k_next = (i + 1) % n, (j + 1) % n, (k + 1) % n
    low = (1 - b) * ((1 - c) * grid[i, j, k] + c * grid[i, j, k_next]) + b * (
        (1 - c) * grid[i, j_next, k] + c * grid[i, j_next, k_next]
    )
    high = (1 - b) * ((1 - c) * grid[i_next, j, k] + c * grid[i_next, j, k_next]) + b * (
        (1 - c) * grid[i_next, j_next, k] + c * grid[i_next, j_next, k_next]
    )
    return (1 - a) * low + a * high


@njit(cache=True)
def _shaded(
    face: NDArray[np.int32], inverse_depth: Array, owner: NDArray[np.int64], brightness: Array, texture_from_cam: Array,
    intrinsics: Array, grid: Array,
) -> Array:  # fmt: skip
    """Grey values of a picture: solid noise of octaves from 16 mm down to 1 mm, times the brightness of the face."""
    fx, fy, cx, cy = intrinsics
    grey = np.full(face.shape, 30.0)
    for row in range(face.shape[0]):
        for column in range(face.shape[1]):
            k = face[row, column]
            if k < 0:
                continue
            depth = 1.0 / inverse_depth[row, column]
            u, v = (column - cx) / fx * depth, (row - cy) / fy * depth
            place = texture_from_cam[owner[k]]
            x = place[0, 0] * u + place[0, 1] * v + place[0, 2] * depth + place[0, 3]
            y = place[1, 0] * u + place[1, 1] * v + place[1, 2] * depth + place[1, 3]
            z = place[2, 0] * u + place[2, 1] * v + place[2, 2] * depth + place[2, 3]
            value = 120.0
            for size_mm, weight in ((16.0, 30.0), (6.0, 30.0), (2.5, 30.0), (1.0, 20.0)):
                value += weight * _noise(
                    grid, x / size_mm + 0.37 * size_mm, y / size_mm + 0.37 * size_mm, z / size_mm + 0.37 * size_mm
                )
            grey[row, column] = value * brightness[k]
    return grey


def _through_lens(image: Array, camera: Camera) -> Array:
    columns, rows = _lens_map(
        camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, tuple(camera.dist.tolist())
    )
    return cv2.remap(image.astype(np.float32), columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT).astype(
        np.float64
    )


@cache
def _lens_map(
    width: int, height: int, fx: float, fy: float, cx: float, cy: float, dist: tuple[float, ...]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Column and row, in the picture without distortion, of each pixel of a picture."""
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    camera = Camera(width, height, fx, fy, cx, cy, np.array(dist))
    ideal = camera.unproject(np.stack([columns, rows], -1).astype(float))
    return (ideal[..., 0] * fx + cx).astype(np.float32), (ideal[..., 1] * fy + cy).astype(np.float32)


def write_photos(folder: Path, pictures: list[Picture], stem: str = "img") -> list[Path]:
    """Pictures as PNG files."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{stem}_{i:03d}.png" for i in range(len(pictures))]
    for path, picture in zip(paths, pictures, strict=True):
        cv2.imwrite(str(path), picture[..., ::-1])
    return paths
