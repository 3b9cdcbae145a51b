"""Evaluation protocols: tracking with resets, as in RBOT (Tjaden et al. 2018), and detection in single frames."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from arview.cad.model import Model
from arview.cad.shape.symmetry import Symmetry
from arview.cad.view_range import ViewRange
from arview.detection import Detector
from arview.detection.search.local_search import LocalSearch
from arview.geometry import Array
from arview.guideviews import GuideViewSet
from arview.tracking import Tracker
from arview.tracking.pose_recheck import LocalSearchRecheck
from arview_lab.evaluation.bop import Scene, SceneFrame
from arview_lab.evaluation.metrics import PoseError, PoseMeter
from arview_lab.evaluation.run import COARSE, IN_VIEW

EQUAL_SIDES = 0.05
"""Relative difference up to which sides of a box are equal."""
_DISTANCE_MARGIN = 0.05
"""Share by which a range of distances is widened at both ends."""


@dataclass(frozen=True)
class Tally:
    """Number of frames, and of those whose pose is within 5 cm and 5°.

    Attributes:
        frames: frames evaluated.
        right: frames with a right pose.
        ms: (N,) time of each frame without the first, which may include loading compiled code.
        left_open: wrong frames that were called ambiguous, with a right pose among the alternatives.
    """

    frames: int = 0
    right: int = 0
    ms: tuple[float, ...] = ()
    left_open: int = 0

    @property
    def share(self) -> float:
        """Share of right frames; 0 without frames."""
        return self.right / self.frames if self.frames else 0.0

    def __add__(self, other: Tally) -> Tally:
        return Tally(
            self.frames + other.frames,
            self.right + other.right,
            self.ms + other.ms,
            self.left_open + other.left_open,
        )


def full_sphere_range(nearest_mm: float, farthest_mm: float, ratio: float = 4.0) -> ViewRange:
    """All directions and rolls, over distances that cover the given ones with a margin of 5 %.

    The range of distances is widened by the same factor at both ends until the farthest is at least ``ratio`` times
    the nearest.
    """
    low, high = nearest_mm * (1.0 - _DISTANCE_MARGIN), farthest_mm * (1.0 + _DISTANCE_MARGIN)
    stretch = max(1.0, float(np.sqrt(ratio * low / high)))
    return ViewRange((low / stretch, high * stretch))


def box_symmetries(model: Model) -> tuple[Symmetry, ...]:
    """Rotations of the model's bounding box: half turns, and quarter turns where two sides are equal to 5 %."""
    size = model.bounds_in_model[1] - model.bounds_in_model[0]
    x, y, z = model.center_in_model.tolist()
    found = []
    for axis, direction in enumerate(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))):
        a, b = np.delete(size, axis)
        is_square = abs(a - b) <= EQUAL_SIDES * max(a, b)
        found.append(Symmetry(direction, (x, y, z), 4 if is_square else 2))
    return tuple(found)


def track_with_resets(scene: Scene, views: GuideViewSet, step: int = 1, max_frames: int | None = None) -> Tally:
    """Track a scene from the true pose, and restart from it after every frame that is off by over 5 cm or 5° (RBOT).

    Args:
        scene: with a pose in every frame.
        views: guide views of its part.
        step: interval between the frames that are tracked.
        max_frames: use only this many frames from the start of the scene.
    """
    frames = scene.frames[:max_frames:step]
    tracker = Tracker(
        views, scene.camera, model=scene.part.model, recheck=LocalSearchRecheck(LocalSearch(views, scene.camera))
    )
    meter = PoseMeter(scene.part.model, scene.camera, symmetries=scene.part.symmetries)
    tracker.start(scene.image(frames[0]), true_pose(frames[0]))
    right, ms = 0, []
    for frame in frames[1:]:
        image = scene.image(frame)
        began = time.perf_counter()
        estimate = tracker.track(image)
        ms.append(1e3 * (time.perf_counter() - began))
        if meter.measure(estimate.cam_from_model, true_pose(frame)).within(*COARSE):
            right += 1
        else:
            tracker.start(image, true_pose(frame))
    return Tally(len(frames) - 1, right, tuple(ms[1:]))


def detect_in_frames(
    scene: Scene,
    frames: Sequence[SceneFrame],
    detector: Detector,
    error_of: Callable[[Array, SceneFrame], PoseError],
) -> Tally:
    """Detect the part in single frames; the best detection counts.

    Args:
        scene: of the frames.
        frames: each with a pose.
        detector: of the scene's part and camera.
        error_of: error of an estimated ``cam_from_model`` (4,4) in a frame.
    """
    right, left_open, ms = 0, 0, []
    for frame in frames:
        image = scene.image(frame)
        began = time.perf_counter()
        detections = detector.detect(image, max_results=1)
        ms.append(1e3 * (time.perf_counter() - began))
        if not detections:
            continue
        best = detections[0]
        if error_of(best.cam_from_model, frame).within(*COARSE):
            right += 1
        elif any(error_of(pose, frame).within(*COARSE) for pose in best.alternatives):
            left_open += 1
    return Tally(len(frames), right, tuple(ms[1:]), left_open)


def spread_frames(scene: Scene, count: int) -> list[SceneFrame]:
    """At most ``count`` frames, evenly spread over those that have a pose and show at least half of the part."""
    fit = [f for f in scene.frames if f.cam_from_model is not None and (f.visible is None or f.visible >= IN_VIEW)]
    chosen = np.unique(np.linspace(0, len(fit) - 1, min(count, len(fit))).round().astype(int))
    return [fit[k] for k in chosen]


def true_pose(frame: SceneFrame) -> Array:
    """``cam_from_model`` (4,4) of a frame that has one."""
    assert frame.cam_from_model is not None
    return frame.cam_from_model
