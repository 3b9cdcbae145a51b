"""Photos of a textured assembly with exact truth: rendered from its triangles, with solid noise for texture."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from arview.cad.model import Component, Model, make_model
from arview.camera import Camera
from arview.geometry import Array, apply, invert, look_at
from arview.rendering.rasterizer import rasterise
from helpers.cad_files import box

Picture = NDArray[np.uint8]
CAMERA = Camera(640, 480, 720.0, 720.0, 319.5, 239.5, np.array([-0.06, 0.01, 0.0, 0.0, 0.0]))
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
    moves: Mapping[str, Array] | None = None,
) -> Picture:  # fmt: skip
    """The picture of a model, (H,W,3) uint8: twice the size, then through the lens, with noise.

    Components are taken along by ``moves`` (4,4), and their texture with them.
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
    columns, rows = np.meshgrid(np.arange(twice.width), np.arange(twice.height))
    rays = np.stack([(columns - twice.cx) / twice.fx, (rows - twice.cy) / twice.fy, np.ones(columns.shape)], -1)
    hit = face >= 0
    points = apply(invert(cam_from_model), rays[hit] / inverse_depth[hit][:, None])
    owner = np.repeat(np.arange(len(parts)), [len(faces) for _, faces in parts])[face[hit]]
    texture = np.empty_like(points)
    for i, place in enumerate(places):
        texture[owner == i] = apply(invert(place), points[owner == i])
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    light = 0.65 + 0.35 * normals @ (0.3, -0.4, 0.87)
    grey = np.full(face.shape, 30.0)
    tones = {"bench": 0.45, "plate": 1.25}
    tone = np.concatenate([np.full(len(one.faces), tones.get(one.name, 0.8)) for one in model.components])
    grey[hit] = _texture(texture, seed) * (light * tone)[face[hit]]
    small = cv2.resize(grey, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    through = _through_lens(small, camera)
    through += np.random.default_rng(int(abs(cam_from_model[:3].sum()) * 1e3) + seed).normal(0.0, noise, through.shape)
    return np.repeat(np.clip(through, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def _texture(points: Array, seed: int) -> Array:
    """Grey values of points: noise of octaves from 16 mm down to 1 mm, filling space."""
    grid = np.random.default_rng(seed).uniform(-1.0, 1.0, (_GRID, _GRID, _GRID))
    value = np.full(len(points), 120.0)
    for size_mm, weight in ((16.0, 30.0), (6.0, 30.0), (2.5, 30.0), (1.0, 20.0)):
        value += weight * map_coordinates(grid, (points / size_mm + 0.37 * size_mm).T, order=1, mode="grid-wrap")
    return value


def _through_lens(image: Array, camera: Camera) -> Array:
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    ideal = camera.unproject(np.stack([columns, rows], -1).astype(float))
    return cv2.remap(
        image.astype(np.float32),
        (ideal[..., 0] * camera.fx + camera.cx).astype(np.float32),
        (ideal[..., 1] * camera.fy + camera.cy).astype(np.float32),
        cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT,
    ).astype(np.float64)  # fmt: skip


def write_photos(folder: Path, pictures: list[Picture], stem: str = "img") -> list[Path]:
    """Pictures as PNG files."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{stem}_{i:03d}.png" for i in range(len(pictures))]
    for path, picture in zip(paths, pictures, strict=True):
        cv2.imwrite(str(path), picture[..., ::-1])
    return paths
