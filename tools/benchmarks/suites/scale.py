"""The same pictures at other sizes and sharpness: acceptance at the true pose, and tracking."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from arview.pose import TrackingState
from arview.tracking import SpecimenTracking
from arview.video import Image
from arview_lab.evaluation import Scene, SceneResult, evaluate_scene, scene_guide_views
from arview_lab.evaluation.bop import SceneFrame
from rows import ResultRow, watched

ACCEPTED = ((0.5, 0.0), (0.75, 0.0), (1.0, 0.0), (2.0, 0.0), (1.0, 0.6), (1.0, 1.2), (1.0, 2.0))
"""Scale and blur, px of the original, at which photos are shown at their true poses."""
TRACKED = (0.5, 0.75, 1.0, 1.5, 2.0, 3.0)
"""Scales at which sequences are tracked."""
SCALED = ("castle", "dragon", "plate")
"""Sequences tracked at several scales."""
TOLERANCE = 0.1
"""Relative difference of median errors and of tracked frames from those at the original size."""


@dataclass(frozen=True)
class ResizedScene(Scene):
    """A scene whose pictures are resized and blurred.

    Attributes:
        scale: of the pictures.
        blur_px: standard deviation of the blur, px of the original.
        original: camera of the original pictures.
    """

    scale: float = 1.0
    blur_px: float = 0.0
    original: Scene | None = None

    def image(self, frame: SceneFrame) -> Image:
        """Picture (H,W,3) uint8 RGB, as `Scene.image`."""
        assert self.original is not None
        image = self.original.image(frame)
        if self.blur_px > 0:
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), self.blur_px))
        if self.scale == 1.0:
            return image
        how = cv2.INTER_AREA if self.scale < 1.0 else cv2.INTER_CUBIC
        return np.asarray(cv2.resize(image, (self.camera.width, self.camera.height), interpolation=how))


def resized(scene: Scene, scale: float, blur_px: float = 0.0, step: int = 1) -> ResizedScene:
    """A scene at another size; only every ``step``-th frame of it."""
    size = round(scale * scene.camera.width), round(scale * scene.camera.height)
    values: dict[str, Any] = {name: getattr(scene, name) for name in Scene.__dataclass_fields__}
    values |= {"camera": scene.camera.scaled(*size), "frames": scene.frames[::step]}
    return ResizedScene(**values, scale=scale, blur_px=blur_px, original=scene)


def acceptance_rows(scene: Scene) -> list[ResultRow]:
    """Photos shown alone, at their true poses: all but one must be ``tracked`` at once."""
    rows = []
    views = scene_guide_views(scene)
    for scale, blur_px in watched(ACCEPTED, "accepted at truth"):
        shown = resized(scene, scale, blur_px)
        tracked, failed = 0, []
        for frame in shown.frames:
            if frame.cam_from_model is None:
                continue
            session = SpecimenTracking(
                views, shown.camera, scene.part.model, initial_cam_from_model=frame.cam_from_model
            )
            pose = session.process(shown.image(frame), frame.index, 0.0)
            is_tracked = pose.state is TrackingState.TRACKED
            tracked += is_tracked
            if not is_tracked:
                failed.append(frame.index)
        total = tracked + len(failed)
        text = f"{tracked} of {total} tracked" + (f", not {failed}" if failed else "")
        on = f"{scene.name} × {scale:g}, blur {blur_px:g} px"
        rows.append(ResultRow("accepted at truth", on, text, f"≥ {total - 1}", len(failed) <= 1 < total))
    return rows


def scale_rows(scene: Scene, init: str, details: dict[str, Any], max_width: int = 2000) -> list[ResultRow]:
    """A sequence tracked at several sizes; states and accuracy must be as at the original size."""
    rows = []
    views = scene_guide_views(scene)
    results: dict[float, SceneResult] = {}
    for scale in watched(TRACKED, f"scale {scene.name}"):
        if scale * scene.camera.width <= max_width:
            results[scale] = evaluate_scene(resized(scene, scale), init, views=views)
    at_one = _figures(results[1.0])
    for scale, result in results.items():
        shift, turn, tracked, ms = found = _figures(result)
        details[f"{scene.name} × {scale:g}"] = result.to_dict()
        text = f"{shift:.2f} mm / {turn:.2f}°, {tracked} tracked, {ms:.1f} ms"
        is_same = all(abs(a - b) <= TOLERANCE * b for a, b in zip(found[:3], at_one[:3], strict=True))
        target = "within 10 % of × 1"
        rows.append(ResultRow("scale", f"{scene.name} × {scale:g}", text, target, is_same))
    return rows


def _figures(result: SceneResult) -> tuple[float, float, int, float]:
    """Median errors, mm and deg, tracked frames, and median time of a frame."""
    errors, ms = result.summary.errors, result.summary.track_ms
    shift = errors["translation_mm"].median if errors else np.inf
    turn = errors["rotation_deg"].median if errors else np.inf
    return shift, turn, result.summary.states.get("tracked", 0), ms.median if ms else np.inf
