"""Relocalization after a loss on the recorded sequences."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from arview.pose import TrackingState
from arview.tracking import SessionOptions, SpecimenTracking
from arview_lab.evaluation import PoseMeter, Scene
from arview_lab.evaluation.protocols import box_symmetries
from arview_lab.evaluation.run import COARSE, IN_VIEW
from rows import ResultRow, watched
from suites.detection import BOXES, recorded_views

LOSSES = 30


@dataclass(frozen=True)
class Relocalized:
    """Results after losses of the part.

    Attributes:
        losses: number of losses.
        found, wrong: of them, those that the next frame ended with a right and with a wrong pose.
        cpu_ms: CPU time of each of these frames.
    """

    losses: int
    found: int
    wrong: int
    cpu_ms: tuple[float, ...]

    @property
    def median_ms(self) -> float:
        """Median CPU time of the frames after a loss."""
        return float(np.median(self.cpu_ms)) if self.cpu_ms else float("inf")

    def format(self) -> str:
        """As text for the table."""
        return f"{self.found} of {self.losses}, {self.wrong} wrong, median {self.median_ms:.0f} ms CPU"


def relocalization_rows(found: dict[str, Scene], details: dict[str, Any], losses: int | None = None) -> list[ResultRow]:
    """A row for each sequence."""
    rows = []
    for name, scene in watched(found.items(), "relocalization"):
        one = lose_and_find(name, scene, losses or LOSSES)
        details.setdefault("relocalization", {})[name] = asdict(one)
        reached = one.wrong == 0 and one.found == one.losses
        rows.append(ResultRow("found in the frame after a loss", name, one.format(), "all, 0 wrong", reached))
    return rows


def lose_and_find(name: str, scene: Scene, losses: int) -> Relocalized:
    """Track the first half; in the second half, cover the camera before some frames until the part is lost.

    The guide views cover the full sphere. Where a frame does not find the part, the session continues from the truth.
    """
    views, model = recorded_views(scene), scene.part.model
    meter = PoseMeter(
        model,
        scene.camera,
        symmetries=box_symmetries(model) if name in BOXES else scene.part.symmetries,
        symmetric_poses=scene.symmetric_poses,
    )
    options = SessionOptions()
    frames = [f for f in scene.frames if f.cam_from_model is not None]
    half = len(frames) // 2
    step = max(1, round((len(frames) - half) / losses))
    session = SpecimenTracking(views, scene.camera, model, options, initial_cam_from_model=frames[0].cam_from_model)
    session.search.detector.detect(scene.image(frames[0]), max_results=1)  # compiled code is loaded
    covered = np.full((scene.camera.height, scene.camera.width, 3), 90, dtype=np.uint8)
    count, right, wrong, cpu_ms = 0, 0, 0, []
    for number, frame in enumerate(frames):
        image = scene.image(frame)
        is_tried = number >= half and number % step == 0 and (frame.visible is None or frame.visible >= IN_VIEW)
        is_tried = is_tried and session.state == TrackingState.TRACKED
        while is_tried and session.state != TrackingState.LOST:
            session.process(covered, frame.index, number / 30.0)
        began = time.process_time()
        pose = session.process(image, frame.index, number / 30.0)
        if not is_tried:
            continue
        cpu_ms.append(1e3 * (time.process_time() - began))
        count += 1
        assert frame.cam_from_model is not None
        is_right = pose.cam_from_model is not None and meter.measure(pose.cam_from_model, frame.cam_from_model).within(
            *COARSE
        )
        right += is_right
        wrong += pose.cam_from_model is not None and not is_right
        if not is_right:
            session = SpecimenTracking(views, scene.camera, model, options, initial_cam_from_model=frame.cam_from_model)
            session.process(image, frame.index, number / 30.0)
    return Relocalized(count, right, wrong, tuple(cpu_ms))
