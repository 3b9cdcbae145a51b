"""A sequence under real conditions frame by frame: a decorated part, shadows, and a camera with its faults."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.cad.model import Model, make_model
from arview.camera import Camera
from arview.geometry import Array, apply
from arview.rendering.rasterizer import rasterise
from arview.video import Image
from arview_lab.semisynthetic.backgrounds import CropPath, mosaic, surroundings
from arview_lab.semisynthetic.camera_effects import CameraEffects, Motion, Sensor, disc_blurred, through_codec
from arview_lab.semisynthetic.conditions import Conditions
from arview_lab.semisynthetic.decoration import Decoration, decorate, surface_samples
from arview_lab.semisynthetic.sequence import SequenceFrame, generator, paste, scene_lights
from arview_lab.semisynthetic.shading import Light, ShadedModel, UnlitSamples
from arview_lab.semisynthetic.shadows import ShadowMap, ShadowOptions, light_reach, shadow_behind, shadow_map
from arview_lab.semisynthetic.trajectory import random_trajectory, smooth_noise

MAX_EXPOSURES = 6
"""Moments over which motion blur is averaged, at most."""
BLUR_STEP_PX = 1.3
"""Motion between two of these moments, px."""
MAX_EDGE_SHARE = 0.08
"""Longest side of a triangle, as a share of the part's diameter, when the shutter rolls: its corners move alone."""
MAX_FACES = 60_000
SHADOW_FRAMES = 150.0
"""Frames after which the shadows of other things have changed completely."""


def real_trajectory(model: Model, conditions: Conditions, frames: int, seed: int) -> Array:
    """``cam_from_model`` (frames,4,4) of a part under conditions, cut by the picture's border where they say so."""
    camera = conditions.pinhole
    rng = generator(seed, model.name, "trajectory", conditions.name)
    motion = conditions.motion_of(model)
    poses = random_trajectory(camera, model.center_in_model, model.diameter_mm, frames, rng, motion)
    if conditions.in_view is None:
        return poses
    low, high = conditions.in_view
    noise = smooth_noise(frames, 2, 14.0, rng)
    # A margin on both sides, because the wish is met in steps.
    wanted = 0.5 * (low + high) + (0.5 * (high - low) - 0.03) * np.tanh(1.2 * noise[:, 0])
    angle = rng.uniform(0.0, 2.0 * np.pi) + 1.5 * noise[:, 1]
    return np.stack([
        _moved_to_the_border(model, camera, pose, float(share), float(way))
        for pose, share, way in zip(poses, wanted, angle, strict=True)
    ])  # fmt: skip


def _moved_to_the_border(model: Model, camera: Camera, pose: Array, wanted: float, angle_rad: float) -> Array:
    """The pose moved across the view until a share of the part's area is inside the picture."""
    depth = float(apply(pose, model.center_in_model)[2])
    centered = pose.copy()
    centered[:2, 3] -= apply(pose, model.center_in_model)[:2]
    way = np.array([np.cos(angle_rad), np.sin(angle_rad), 0.0])
    low, high = 0.0, 2.0 * camera.width / camera.fx * depth
    for _ in range(14):
        middle = 0.5 * (low + high)
        moved = centered.copy()
        moved[:3, 3] += middle * way
        if share_in_view(model, camera, moved) > wanted:
            low = middle
        else:
            high = middle
    centered[:3, 3] += low * way
    return centered


def share_in_view(model: Model, camera: Camera, pose: Array, shrink: int = 6) -> float:
    """Share of the area that a part covers in the plane of the picture that lies inside the picture."""
    small = camera.scaled(camera.width // shrink, camera.height // shrink)
    width, height = small.width, small.height
    points = apply(pose, model.mesh[0])
    _, ids = rasterise(
        points, model.mesh[1], small.fx, small.fy, small.cx, small.cy, 5 * width, 5 * height,
        origin=(-2 * width, -2 * height),
    )  # fmt: skip
    seen = ids >= 0
    inside = seen[2 * height : 3 * height, 2 * width : 3 * width]
    return float(inside.sum()) / max(float(seen.sum()), 1.0)


def render_real(
    model: Model, poses: Array, photo: Image, printed: list[Image], conditions: Conditions, seed: int = 0,
    name: str | None = None,
) -> Iterator[SequenceFrame]:  # fmt: skip
    """The frames of a sequence under conditions.

    Args:
        model: rendered; its decoration is drawn from the seed.
        poses: (N,4,4) ``cam_from_model`` at the middle row of each frame, for instance from `real_trajectory`.
        photo: (H,W,3) background.
        printed: photographs that are printed on the part.
        conditions: see `Conditions`.
        seed: of all random numbers.
        name: of the sequence, for its random numbers; None: the model's.
    """
    frames = _exposed(model, poses, photo, printed, conditions, seed, name or model.name)
    rate = conditions.camera.mbit_per_s
    return through_codec(frames, rate) if rate > 0.0 else frames


def _exposed(
    model: Model, poses: Array, photo: Image, printed: list[Image], conditions: Conditions, seed: int, name: str
) -> Iterator[SequenceFrame]:
    """The frames as they leave the sensor."""
    camera, effects = conditions.pinhole, conditions.camera
    rng = generator(seed, name, conditions.name)
    scale = camera.height / 512.0
    path = CropPath(mosaic(photo, camera.width, camera.height), camera.width, camera.height, len(poses), rng)
    lights = scene_lights("light", len(poses), surroundings(photo), rng)
    sensor = Sensor(effects, len(poses), scale, rng)
    scene = _Scene(model, conditions, printed, generator(seed, name, conditions.name, "decoration"))
    for number, light in enumerate(lights):
        part = scene.drawn(poses, number, light)
        behind = _background(path, number, effects, camera.width, camera.height) * (1.0 - part.shadow[..., None])
        radius = float(sensor.defocus_px[number])
        sigma = effects.lens_px * scale
        behind = disc_blurred(behind, radius + effects.behind_px * scale, sigma, cv2.BORDER_REFLECT_101)
        soft = disc_blurred(part.color, radius, sigma)
        picture = behind * (1.0 - soft[..., 3:]) + 255.0 * soft[..., :3]
        image = sensor.expose(picture.astype(np.float32), number)
        coverage = np.ascontiguousarray(part.color[..., 3])
        yield SequenceFrame(image, poses[number], part.pixels, float(coverage.sum()), coverage)


class _DrawnPart:
    """A part in the picture: colour times coverage and coverage (H,W,4), its whole area, and its shadow (H,W)."""

    def __init__(self, height: int, width: int) -> None:
        self.color = np.zeros((height, width, 4), np.float32)
        self.shadow = np.zeros((height, width), np.float32)
        self.pixels = 0.0


class _Scene:
    """A decorated part under conditions."""

    def __init__(self, model: Model, conditions: Conditions, printed: list[Image], rng: np.random.Generator) -> None:
        self._conditions, self._camera = conditions, conditions.pinhole
        fine = model
        if conditions.camera.readout > 0.0:
            fine = subdivided(model, MAX_EDGE_SHARE * model.diameter_mm)
        self._part = ShadedModel(fine, conditions.reflectance, conditions.vivid)
        self._decoration: Decoration = decorate(fine, conditions.decoration, printed, rng)
        self._is_plain = conditions.decoration == type(conditions.decoration)()

    def drawn(self, poses: Array, number: int, light: Light) -> _DrawnPart:
        """The part in a frame: the mean over its exposure."""
        camera, effects = self._camera, self._conditions.camera
        motion = Motion(poses, number)
        count = self._exposures(motion, effects.shutter)
        drawn = _DrawnPart(camera.height, camera.width)
        half = 0.5 * effects.shutter * (1.0 - 1.0 / count)
        for time in np.linspace(-half, half, count):
            points = motion.points(
                self._part.vertices, float(time), effects.readout, np.array([camera.fy, camera.cy]), camera.height
            )
            surface = self._surface(points, light, number)
            supersampling = 3 if count == 1 else 2
            layer = self._part.draw(motion.at(float(time)), camera, light, surface, points, supersampling)
            if layer is not None:
                drawn.pixels += float(layer.coverage.sum()) / count
                paste(np.dstack([layer.color, layer.coverage]) / np.float32(count), layer, drawn.color)
        shadows = self._conditions.shadows
        if shadows is not None:
            middle = apply(poses[number], self._part.vertices)
            toward = light.toward_in_cam[0]
            diameter = self._part.model.diameter_mm
            drawn.shadow = shadow_behind(middle, self._part.faces, toward, camera, diameter, shadows)
        return drawn

    def _exposures(self, motion: Motion, shutter: float) -> int:
        """Number of moments over which a frame is averaged."""
        if shutter <= 0.0:
            return 1
        start, end = (self._camera.project(apply(motion.at(t * shutter), self._part.vertices)) for t in (-0.5, 0.5))
        length = float(np.percentile(np.linalg.norm(end - start, axis=1), 90))
        return int(np.clip(np.ceil(length / BLUR_STEP_PX), 1, MAX_EXPOSURES))

    def _surface(self, points: Array, light: Light, number: int) -> _RealSurface:
        shadows, diameter = self._conditions.shadows, self._part.model.diameter_mm
        shadow = None
        if shadows is not None:
            shadow = shadow_map(points, self._part.faces, light.toward_in_cam[0], diameter)
        return _RealSurface(self._decoration, self._is_plain, shadow, shadows, diameter, number / SHADOW_FRAMES)


@dataclass(frozen=True)
class _RealSurface:
    """A decorated surface in a shadowed light, at a time of the other things' shadows."""

    decoration: Decoration
    is_plain: bool
    shadow: ShadowMap | None
    shadows: ShadowOptions | None
    diameter_mm: float
    time: float

    def __call__(self, samples: UnlitSamples, light: Light) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """See `arview_lab.semisynthetic.shading.SurfaceAppearance`."""
        own, reach = np.zeros((0, 0, 4), np.float32), np.zeros((0, 0), np.float32)
        d = self.decoration
        if not self.is_plain:
            own = surface_samples(
                samples.inverse_depth, samples.face_ids, np.ascontiguousarray(samples.points[samples.faces]),
                samples.colors, samples.lens, d.corners, d.texture_px, d.patch_of_face, d.patches, d.texels,
                d.lattice, d.wear,
            )  # fmt: skip
        if self.shadow is not None and self.shadows is not None:
            reach = light_reach(
                samples.inverse_depth, samples.lens, self.shadow, self.diameter_mm, self.shadows, d.lattice,
                4.0 * self.time,
            )  # fmt: skip
        return own, reach


def _background(
    path: CropPath, number: int, effects: CameraEffects, width: int, height: int
) -> NDArray[np.float32]:  # fmt: skip
    """The moving background (H,W,3) in grey levels, exposed like the part."""
    count = 1 if effects.shutter <= 0.0 else 4
    half = 0.5 * effects.shutter * (1.0 - 1.0 / count)
    total = np.zeros((height, width, 3), np.float32)
    u = np.arange(width, dtype=np.float32)
    v = np.arange(height, dtype=np.float32)
    knots = np.linspace(-0.5, 0.5, 9)
    late = (np.arange(height) - 0.5 * (height - 1)) / height
    for time in np.linspace(-half, half, count):
        maps = np.stack([path.photo_from_crop_at(number + time + effects.readout * k) for k in knots])
        rows = np.stack([np.interp(late, knots, maps[:, i, k]) for i in (0, 1) for k in (0, 1, 2)], axis=1)
        rows = rows.astype(np.float32)
        x = rows[:, :1] * u + (rows[:, 1] * v + rows[:, 2])[:, None]
        y = rows[:, 3:4] * u + (rows[:, 4] * v + rows[:, 5])[:, None]
        total += cv2.remap(path.photo, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    return total / np.float32(count)


def subdivided(model: Model, max_edge_mm: float) -> Model:
    """The model with every side of a triangle longer than a length halved, again and again; its surface is the same."""
    components = []
    for component in model.components:
        vertices, faces = component.vertices_in_model, component.faces.astype(np.int64)
        while len(faces) < MAX_FACES:
            split = _with_long_sides_halved(vertices, faces, max_edge_mm)
            if split is None:
                break
            vertices, faces = split
        components.append(replace(component, vertices_in_model=vertices, faces=faces.astype(np.int32)))
    return make_model(model.name, tuple(components))


def _with_long_sides_halved(
    vertices: Array, faces: NDArray[np.int64], max_edge_mm: float
) -> tuple[Array, NDArray[np.int64]] | None:
    """Vertices and faces with the long sides halved in both triangles they belong to; None when there is none."""
    sides = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2), axis=2)
    unique, inverse = np.unique(sides.reshape(-1, 2), axis=0, return_inverse=True)
    is_long = np.linalg.norm(np.subtract(*vertices[unique].transpose(1, 0, 2)), axis=1) > max_edge_mm
    if not is_long.any():
        return None
    middle = np.full(len(unique), -1, dtype=np.int64)
    middle[is_long] = len(vertices) + np.arange(np.count_nonzero(is_long))
    middles = middle[inverse.reshape(-1, 3)]
    # Turned so that the halved sides come first: ab, then bc, then ca.
    halved = middles >= 0
    count = halved.sum(axis=1)
    first = np.where(count == 2, (np.argmin(halved, axis=1) + 1) % 3, np.argmax(halved, axis=1))
    order = (first[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(faces, order, axis=1).T
    ab, bc, ca = np.take_along_axis(middles, order, axis=1).T
    pieces = {
        0: [(a, b, c)],
        1: [(a, ab, c), (ab, b, c)],
        2: [(ab, b, bc), (a, ab, bc), (a, bc, c)],
        3: [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)],
    }
    made = [np.stack(piece, axis=1)[count == k] for k, several in pieces.items() for piece in several]
    return np.concatenate([vertices, vertices[unique[is_long]].mean(axis=1)]), np.concatenate(made)
