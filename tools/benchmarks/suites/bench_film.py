"""Films of a bench on which two specimens of one part lie, with exact truth: the followed one is covered a while."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.cad.model import Model
from arview.camera import Camera
from arview.geometry import Array, apply, exp_so3, rigid
from arview.video import Image
from arview_lab.semisynthetic.backgrounds import read_photo, surroundings
from arview_lab.semisynthetic.sequence import JOIN_BLUR_PX, generator, paste, scene_lights
from arview_lab.semisynthetic.shading import Light, ShadedModel

Kind = Literal["covered", "taken away", "out of view"]
"""The followed specimen is covered by a board; the same, and is gone afterwards; the camera turns away from it."""

CAMERA = Camera(960, 540, 800.0, 800.0, 479.5, 269.5)
BEFORE, AFTER, SLIDE = 25, 45, 3
"""Frames before and after the occlusion, and in which the board comes and goes."""
FILM_HZ = 30.0


@dataclass(frozen=True)
class BenchOptions:
    """How a film is made.

    Attributes:
        kind: what happens to the followed specimen.
        hidden: frames in which nothing is seen of it.
        seed: of all random numbers.
        apart: distance of the specimens, diameters.
        distance: of the camera, diameters.
        elevation_deg, sway_deg: of the camera above the bench, and by how much it goes to and fro round it.
        period_frames: of that motion.
        noise: standard deviation, grey levels.
    """

    kind: Kind = "covered"
    hidden: int = 15
    seed: int = 0
    apart: float = 1.25
    distance: float = 4.2
    elevation_deg: float = 48.0
    sway_deg: float = 11.0
    period_frames: float = 70.0
    noise: float = 2.0

    @property
    def frames(self) -> int:
        """Length of the film."""
        return BEFORE + 2 * SLIDE + self.hidden + AFTER


class BenchFilm:
    """A film of two specimens of a model on a bench; the first is the followed one.

    Attributes:
        truth: poses (4,4) ``cam_from_model`` of both specimens in each frame.
        is_there: whether the followed specimen is on the bench, in each frame.
    """

    def __init__(self, model: Model, photos: tuple[Path, ...], options: BenchOptions) -> None:
        self.model, self.options = model, options
        rng = generator(options.seed, model.name, "bench")
        order = rng.permutation(len(photos))
        self._bench, self._board = (read_photo(photos[k]) for k in order[:2])
        self._phases = rng.uniform(0.0, 2.0 * np.pi, 3)
        self._lying = [
            self._world_from_model(side, angle) for side, angle in zip((-1, 1), rng.uniform(-0.9, 0.9, 2), strict=True)
        ]
        self.truth = [tuple(self._cam_from_world(k) @ one for one in self._lying) for k in range(options.frames)]
        gone = BEFORE + SLIDE + options.hidden // 2 if options.kind == "taken away" else options.frames
        self.is_there = [k < gone for k in range(options.frames)]

    def images(self) -> Iterator[Image]:
        """All frames, (H,W,3) uint8 RGB."""
        o = self.options
        rng = generator(o.seed, self.model.name, "bench film")
        part = ShadedModel(self.model)
        lights = scene_lights("regular", o.frames, surroundings(self._bench), rng)
        for k, light in enumerate(lights):
            picture = self._background(k)
            for number, pose in sorted(enumerate(self.truth[k]), key=lambda of: -of[1][2, 3]):
                if number == 1 or self.is_there[k]:
                    picture = drawn_over(picture, part, pose, light)
            if o.kind != "out of view":
                self._cover(picture, k)
            picture += o.noise * rng.standard_normal(picture.shape, dtype=np.float32)
            yield np.clip(np.round(picture), 0, 255).astype(np.uint8)

    def _world_from_model(self, side: int, angle_rad: float) -> Array:
        """Where a specimen lies on the bench, the plane z = 0, on one side of the middle."""
        model = self.model
        rotation = exp_so3(np.array([0.0, 0.0, angle_rad]))
        low = min(float(one.bounds_in_model[0][2]) for one in model.components)
        at = np.array([0.5 * side * self.options.apart * model.diameter_mm, 0.0, 0.0])
        center = model.center_in_model.copy()
        center[2] = low
        return rigid(rotation, at - rotation @ center)

    def _cam_from_world(self, k: int) -> Array:
        """The camera looks at the middle of the bench, goes to and fro, and turns away where the film says so."""
        o = self.options
        swing = np.sin(2.0 * np.pi * k / (o.period_frames * np.array([1.0, 1.3, 1.7])) + self._phases)
        azimuth = np.deg2rad(o.sway_deg * swing[0])
        elevation = np.deg2rad(o.elevation_deg + 4.0 * swing[1])
        distance_mm = o.distance * self.model.diameter_mm * (1.0 + 0.05 * swing[2])
        flat = np.cos(elevation)
        toward = np.array([np.sin(azimuth) * flat, -np.cos(azimuth) * flat, np.sin(elevation)])
        right = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        rotation = np.stack([right, np.cross(-toward, right), -toward])
        if o.kind == "out of view":
            rotation = exp_so3(np.array([0.0, -np.deg2rad(self._aside_deg(k)), 0.0])) @ rotation
        return rigid(rotation, -rotation @ (distance_mm * toward))

    def _aside_deg(self, k: int) -> float:
        """By how much the camera is turned aside, so that the followed specimen is out of view for the time."""
        o, turn_frames = self.options, 8
        half = 0.5 * CAMERA.width / CAMERA.fx
        aside_deg = float(np.rad2deg(np.arctan(half) + np.arctan(0.05 / o.distance)))
        rise = (k - BEFORE) / turn_frames
        fall = (BEFORE + 2 * SLIDE + o.hidden + turn_frames - k) / turn_frames
        return aside_deg * float(np.clip(min(rise, fall), 0.0, 1.0))

    def _background(self, k: int) -> NDArray[np.float32]:
        """The bench as the camera sees it, (H,W,3)."""
        pose = self._cam_from_world(k)
        height, width = self._bench.shape[:2]
        mm_per_px = 5.0 * self.model.diameter_mm / width
        world_from_photo = np.array(
            [[mm_per_px, 0.0, -0.5 * width * mm_per_px], [0.0, -mm_per_px, 0.5 * height * mm_per_px], [0.0, 0.0, 1.0]]
        )
        picture_from_photo = CAMERA.matrix @ np.stack([pose[:3, 0], pose[:3, 1], pose[:3, 3]], axis=1)
        picture_from_photo = picture_from_photo @ world_from_photo
        seen = cv2.warpPerspective(
            self._bench, picture_from_photo, (CAMERA.width, CAMERA.height), borderMode=cv2.BORDER_REFLECT_101
        )
        return np.asarray(seen, dtype=np.float32)

    def _cover(self, picture: NDArray[np.float32], k: int) -> None:
        """Put the board before the followed specimen, in place; it comes from below and goes there again."""
        rise = (k - BEFORE + 1) / (SLIDE + 1)
        fall = (BEFORE + 2 * SLIDE + self.options.hidden - k) / (SLIDE + 1)
        share = float(np.clip(min(rise, fall), 0.0, 1.0))
        if share <= 0.0:
            return
        pixels = CAMERA.project(apply(self.truth[k][0], self.model.mesh[0]))
        left, top = np.floor(pixels.min(axis=0)).astype(int) - 10
        right = int(np.ceil(pixels[:, 0].max())) + 10
        left, right, top = max(left, 0), min(right, CAMERA.width), max(top, 0)
        row = round(CAMERA.height - share * (CAMERA.height - top))
        board = cv2.resize(self._board, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA)
        picture[row:, left:right] = board[: CAMERA.height - row, left:right]


def drawn_over(picture: NDArray[np.float32], part: ShadedModel, pose: Array, light: Light) -> NDArray[np.float32]:
    """A picture (H,W,3) with a part before it."""
    layer = part.draw(pose, CAMERA, light)
    if layer is None:
        return picture
    both = np.zeros((*picture.shape[:2], 4), np.float32)
    stacked = np.dstack([layer.color, layer.coverage])
    paste(cv2.GaussianBlur(stacked, (0, 0), JOIN_BLUR_PX, borderType=cv2.BORDER_CONSTANT), layer, both)
    return np.asarray(picture * (1.0 - both[..., 3:]) + 255.0 * both[..., :3], dtype=np.float32)
