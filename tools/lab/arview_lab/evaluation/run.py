"""evaluate_scene: track a part through a recorded scene and compare every frame with its reference pose."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from arview.annotation import Session
from arview.camera import Camera
from arview.core.progress import StepProgress
from arview.errors import InputError
from arview.geometry import Array
from arview.guideviews import GuideViewOptions, GuideViewSet
from arview.guideviews.cache import cached_guide_views
from arview.pose import Pose, TrackingState
from arview.tracking import SessionOptions, TrackedPart, TrackingSession
from arview.tracking.guide_pose import GUIDE_PREFIX, guide_pose
from arview_lab.evaluation.bop import Scene, SceneFrame
from arview_lab.evaluation.metrics import PoseError, PoseMeter
from arview_lab.evaluation.ranges import covering_range

COARSE = (50.0, 5.0)
"""5 cm and 5°, in mm and degrees: a pose beyond is wrong."""
FINE = (20.0, 2.0)
"""2 cm and 2°, in mm and degrees."""
IN_VIEW = 0.5
"""Frames that show at least this share of the part are evaluated; with less, losing it is no error."""
OUT_OF_VIEW = 0.02
"""With less than this share in view, the state `tracked` is an error."""


@dataclass(frozen=True)
class FrameResult:
    """One frame: the tracker's pose and its error.

    Attributes:
        pose: of the tracker.
        error: against the reference; None without a pose or a reference.
        has_reference, is_truth: whether there is a reference pose, and whether it is exact.
        visible: share of the part in view, or None when not known.
        is_detection: the part was searched for in this frame, so ``ms`` is the time of a detection.
        is_first: its ``ms`` includes loading compiled code and does not count.
    """

    pose: Pose
    error: PoseError | None
    has_reference: bool
    is_truth: bool
    visible: float | None
    is_detection: bool
    is_first: bool

    @property
    def is_evaluated(self) -> bool:
        """True when the part should be tracked: there is a reference, and enough of it is in view."""
        return self.has_reference and (self.visible is None or self.visible >= IN_VIEW)

    @property
    def is_false_tracked(self) -> bool:
        """True when the state is `tracked` but the pose is off by 5 cm/5°, or the part is out of view."""
        if self.pose.state is not TrackingState.TRACKED:
            return False
        if self.visible is not None and self.visible < OUT_OF_VIEW:
            return True
        return self.error is not None and not self.error.within(*COARSE)

    def to_dict(self) -> dict[str, Any]:
        """As plain values, for JSON."""
        pose = self.pose
        return {
            "index": pose.index,
            "state": str(pose.state),
            "quality": pose.quality,
            "ms": pose.ms,
            "visible": self.visible,
            "reference": ("truth" if self.is_truth else "file") if self.has_reference else None,
            "error": None if self.error is None else asdict(self.error),
            "false_tracked": self.is_false_tracked,
            "cam_from_model": None if pose.cam_from_model is None else pose.cam_from_model.tolist(),
        }


@dataclass(frozen=True)
class Spread:
    """Median, 95th percentile and maximum of a quantity over frames."""

    median: float
    p95: float
    max: float


@dataclass(frozen=True)
class Summary:
    """Errors and times of one scene.

    Evaluated frames have a reference pose and at least half of the part in view (where the scene says how much).
    Errors are over evaluated frames with a pose in the states `tracked` and `critical`; shares are of all evaluated
    frames, so that a lost frame lowers them.

    Attributes:
        frames, evaluated: how many.
        states: frames by state.
        lost: evaluated frames without a pose.
        false_tracked: frames called `tracked` although the pose is off by 5 cm/5° or the part out of view.
        errors: by name, see PoseError; of depth_mm the absolute value.
        within_5cm_5deg, within_2cm_2deg: shares; None when no frame is evaluated.
        track_ms, detect_ms: time per frame while tracking and while searching, without the first frame.
    """

    frames: int
    evaluated: int
    states: dict[str, int]
    lost: int
    false_tracked: int
    errors: dict[str, Spread]
    within_5cm_5deg: float | None
    within_2cm_2deg: float | None
    track_ms: Spread | None
    detect_ms: Spread | None


@dataclass(frozen=True)
class SceneResult:
    """Frames and summary of one scene."""

    scene: str
    init: str
    reference: str
    frames: tuple[FrameResult, ...]
    summary: Summary

    def to_dict(self) -> dict[str, Any]:
        """As plain values, for JSON."""
        return {
            "scene": self.scene,
            "init": self.init,
            "reference": self.reference,
            "summary": asdict(self.summary),
            "frames": [frame.to_dict() for frame in self.frames],
        }


def scene_guide_views(
    scene: Scene,
    options: GuideViewOptions | None = None,
    progress: StepProgress | None = None,
) -> GuideViewSet:
    """Cached guide views for a scene, over the part's declared range or else the range that covers its poses."""
    part = scene.part
    view_range = part.view_range or covering_range(scene.poses, part.model.center_in_model)
    return cached_guide_views(part.model, view_range, options, progress=progress)


def evaluate_scene(
    scene: Scene,
    init: str = "truth",
    options: SessionOptions | None = None,
    views: GuideViewSet | None = None,
    progress: StepProgress | None = None,
    make_session: Callable[[GuideViewSet, Camera, Array | None], Session] | None = None,
) -> SceneResult:
    """Track the part through the scene.

    Args:
        scene: see `load_scene`.
        init: ``truth`` starts from the reference pose of the first frame that has one; ``detect`` starts at the first
            frame and detects the part; ``guide:NAME`` waits for the part near a guide view.
        options: of the session.
        views: guide views of the part; None makes them with `scene_guide_views`.
        progress: called with (frames done, frames in all).
        make_session: makes the session from views, camera and first pose; None: a TrackingSession.

    Raises:
        InputError: ``truth`` without a reference pose; no such guide view; a picture that cannot be read.
    """
    frames = scene.frames
    first_pose = None
    if init == "truth":
        start = next((k for k, frame in enumerate(frames) if frame.cam_from_model is not None), None)
        if start is None:
            raise InputError(
                f"{scene.folder}: no frame has a reference pose to start from; give --reference FILE or --init detect"
            )
        frames = frames[start:]
        first_pose = frames[0].cam_from_model
    views = views or scene_guide_views(scene)
    model = scene.part.model
    guide = None
    if init.startswith(GUIDE_PREFIX):
        guide = guide_pose(init.removeprefix(GUIDE_PREFIX), scene.part, views.view_range, scene.camera)
    if make_session is None:
        part = TrackedPart(views, model, initial_cam_from_model=first_pose, guide_cam_from_model=guide)
        session: Session = TrackingSession([part], scene.camera, options)
    else:
        session = make_session(views, scene.camera, first_pose)
    meter = PoseMeter(model, scene.camera, views, scene.part.symmetries, scene.symmetric_poses)
    results = []
    for result in _track(scene, frames, session, meter, has_pose=first_pose is not None):
        results.append(result)
        if progress:
            progress(len(results), len(frames))
    return SceneResult(
        scene=scene.name,
        init=init,
        reference=_reference_text(scene),
        frames=tuple(results),
        summary=summarise(results),
    )


def _track(
    scene: Scene, frames: tuple[SceneFrame, ...], session: Session, meter: PoseMeter, has_pose: bool
) -> Iterator[FrameResult]:
    for number, frame in enumerate(frames):
        (pose,) = session.process(scene.image(frame), frame.index, number / 30.0)
        truth = frame.cam_from_model
        is_known = pose.cam_from_model is not None and truth is not None
        yield FrameResult(
            pose=pose,
            error=meter.measure(pose.cam_from_model, truth) if is_known else None,  # type: ignore[arg-type]
            has_reference=truth is not None,
            is_truth=frame.is_truth,
            visible=frame.visible,
            is_detection=not has_pose,
            is_first=number == 0,
        )
        has_pose = pose.cam_from_model is not None


def _reference_text(scene: Scene) -> str:
    true = sum(frame.is_truth for frame in scene.frames)
    other = sum(frame.cam_from_model is not None and not frame.is_truth for frame in scene.frames)
    texts = [f"{true} of {len(scene.frames)} frames from scene_gt.json"]
    if other and scene.reference is not None:
        texts.append(f"{other} from {scene.reference.name}")
    return ", ".join(texts)


def summarise(results: list[FrameResult]) -> Summary:
    """Summary of a scene from its frames."""
    evaluated = [result for result in results if result.is_evaluated]
    trusted = (TrackingState.TRACKED, TrackingState.CRITICAL)
    errors = [r.error for r in evaluated if r.error is not None and r.pose.state in trusted]
    names = ("translation_mm", "across_mm", "depth_mm", "rotation_deg", "add_mm", "contour_px")
    spreads = {name: spread([getattr(error, name) for error in errors]) for name in names}
    counted = [result for result in results if not result.is_first]
    return Summary(
        frames=len(results),
        evaluated=len(evaluated),
        states={str(state): count for state, count in Counter(r.pose.state for r in results).items()},
        lost=sum(r.pose.cam_from_model is None or r.pose.state not in trusted for r in evaluated),
        false_tracked=sum(result.is_false_tracked for result in results),
        errors={name: value for name, value in spreads.items() if value is not None},
        within_5cm_5deg=_share(errors, COARSE, len(evaluated)),
        within_2cm_2deg=_share(errors, FINE, len(evaluated)),
        track_ms=spread([r.pose.ms for r in counted if not r.is_detection]),
        detect_ms=spread([r.pose.ms for r in counted if r.is_detection]),
    )


def spread(values: list[float | None]) -> Spread | None:
    """Median, 95th percentile and maximum of absolute values; None when there are none."""
    known = np.abs([value for value in values if value is not None])
    if known.size == 0:
        return None
    return Spread(float(np.median(known)), float(np.percentile(known, 95)), float(known.max()))


def _share(errors: list[PoseError], limit: tuple[float, float], count: int) -> float | None:
    return sum(error.within(*limit) for error in errors) / count if count else None
