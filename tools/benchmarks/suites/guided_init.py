"""Guided initialisation on the recorded sequences: success near the guide pose, false locks far from it, and time."""

from __future__ import annotations

import time

import numpy as np

from arview.geometry import Array, apply, exp_so3, rigid, rotation_angle_rad
from arview.tracking.part_search import LOCK_QUALITY
from arview.tracking.search.guided_init import GuidedInit
from arview.video import Image
from arview_lab.evaluation import PoseMeter, Scene, scene_guide_views
from arview_lab.evaluation.protocols import box_symmetries
from rows import ResultRow, timing, watched
from suites.detection import BOXES

NEAR_COUNT, FAR_COUNT = 60, 120
FRAMES = 20
SEED = 7
LIMITS = {"cube": (6.0, 9.0, 5.0), "dragon": (4.0, 12.0, 4.0)}
"""Limits of the error: mm across, mm in depth, deg; wider where the reference poses are less exact."""
USUAL_LIMITS = (5.0, 13.0, 2.0)


def guided_init_rows(found: dict[str, Scene], frames: int | None = None) -> list[ResultRow]:
    """Two rows for each sequence: guide poses near the part; guide poses far from it, or pictures without it."""
    rows = []
    pictures = {name: _pictures(scene, frames or FRAMES) for name, scene in found.items()}
    for name, scene in watched(found.items(), "guided init"):
        others = [image for other, shown in pictures.items() if other != name for image, _ in shown]
        rows += _GuidedInitTrial(name, scene, pictures[name], others).result_rows()
    return rows


def _pictures(scene: Scene, count: int) -> list[tuple[Image, Array]]:
    """Frames, spread over a scene, that show the whole part, with their poses."""
    known = [(frame, frame.cam_from_model) for frame in scene.frames if (frame.visible or 1.0) > 0.9]
    usable = [(frame, pose) for frame, pose in known if pose is not None]
    step = max(1, len(usable) // count)
    return [(scene.image(frame), pose) for frame, pose in usable[::step][:count]]


class _GuidedInitTrial:
    """Trials of one scene: its pictures, and pictures without its part."""

    def __init__(self, name: str, scene: Scene, shown: list[tuple[Image, Array]], others: list[Image]) -> None:
        self.name, self.shown = name, shown
        size = (scene.camera.height, scene.camera.width)
        self.others = [image for image in others if image.shape[:2] == size]
        self.model = scene.part.model
        self.guided_init = GuidedInit(scene_guide_views(scene), scene.camera)
        self.meter = PoseMeter(
            self.model,
            scene.camera,
            symmetries=box_symmetries(self.model) if name in BOXES else scene.part.symmetries,
            symmetric_poses=scene.symmetric_poses,
        )
        self.rng = np.random.default_rng(SEED)
        self.ms: list[float] = []

    def result_rows(self) -> list[ResultRow]:
        """The rows of the scene."""
        right = wrong = 0
        for k in range(NEAR_COUNT):
            image, truth = self.shown[k % len(self.shown)]
            verdict = self.try_at(image, self.moved(truth, 15.0, 0.15, 0.15), truth)
            right, wrong = right + (verdict is True), wrong + (verdict is False)
        text = f"{right} of {NEAR_COUNT} locked, {wrong} wrong, {timing(self.ms[1:])}"
        target = "≥ 80 % within 15°, 15 %, 15 % aside; 0 wrong"
        reached = right >= 0.8 * NEAR_COUNT and wrong == 0
        rows = [ResultRow("guided init", f"{self.name}, near", text, target, reached)]
        self.ms.clear()
        wrong = 0
        for k in range(FAR_COUNT):
            image, truth = self.shown[k % len(self.shown)]
            if k % 4 == 3:
                image = self.others[int(self.rng.integers(len(self.others)))] if self.others else 0 * image
                wrong += self.try_at(image, truth, None) is False
            else:
                wrong += self.try_at(image, self.far_from(truth, k % 4), truth) is False
        text = f"{wrong} of {FAR_COUNT} locked wrongly, {timing(self.ms[1:])}"
        reached = wrong == 0 and float(np.median(self.ms)) <= 60
        return [*rows, ResultRow("guided init", f"{self.name}, far", text, "0 wrong, ≤ 60 ms", reached)]

    def try_at(self, image: Image, guide: Array, truth: Array | None) -> bool | None:
        """Whether the pose that guided initialisation locks on is right; None when it does not lock."""
        began = time.perf_counter()
        found = self.guided_init.lock(image, guide, LOCK_QUALITY)
        self.ms.append(1000.0 * (time.perf_counter() - began))
        if found is None:
            return None
        if truth is None:
            return False
        error = self.meter.measure(found.cam_from_model, truth)
        across_mm, depth_mm, turn_deg = LIMITS.get(self.name, USUAL_LIMITS)
        return error.across_mm <= across_mm and abs(error.depth_mm) <= depth_mm and error.rotation_deg <= turn_deg

    def moved(self, pose: Array, turn_deg: float, depth: float, aside: float) -> Array:
        """A random pose within a rotation, a share of the distance, and a lateral shift in diameters, of a pose."""
        axis = self.rng.normal(size=3)
        angle = np.deg2rad(turn_deg) * self.rng.uniform() ** (1 / 3)
        rotation = exp_so3(angle * axis / np.linalg.norm(axis)) @ pose[:3, :3]
        place = apply(pose, self.model.center_in_model) * (1.0 + self.rng.uniform(-depth, depth))
        way, far = self.rng.uniform(0, 2 * np.pi), aside * np.sqrt(self.rng.uniform())
        place[:2] += far * self.model.diameter_mm * np.array([np.cos(way), np.sin(way)])
        return rigid(rotation, place - rotation @ self.model.center_in_model)

    def far_from(self, pose: Array, kind: int) -> Array:
        """A guide pose far from the part: rotated, shifted, or nearer or farther."""
        if kind == 0:
            turned = pose
            while rotation_angle_rad(turned, pose) < np.deg2rad(25.0):
                turned = self.moved(pose, 180.0, 0.1, 0.1)
            return turned
        guide = self.moved(pose, 15.0, 0.1, 0.0)
        if kind == 1:
            way, far = self.rng.uniform(0, 2 * np.pi), self.rng.uniform(0.4, 1.2)
            guide[:2, 3] += far * self.model.diameter_mm * np.array([np.cos(way), np.sin(way)])
            return guide
        factor = self.rng.uniform(1.35, 2.0) if self.rng.uniform() < 0.5 else self.rng.uniform(0.5, 0.7)
        place = factor * apply(guide, self.model.center_in_model)
        return rigid(guide[:3, :3], place - guide[:3, :3] @ self.model.center_in_model)
