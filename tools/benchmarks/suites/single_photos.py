"""Recorded photos that are no video: each alone, started at its true pose."""

from __future__ import annotations

from collections import Counter

from arview.evaluation import FrameResult, PoseMeter, Scene, SceneResult, scene_guide_views, summarise
from arview.pose import TrackingState
from arview.tracking import TrackingSession
from rows import ResultRow

MAX_FAILURES = 1
"""Photos that may be refused at their true pose."""


def evaluate_photos(scene: Scene) -> SceneResult:
    """Every photo with a true pose in a session of its own, started there."""
    views = scene_guide_views(scene)
    meter = PoseMeter(scene.part.model, scene.camera, views, scene.part.symmetries, scene.symmetric_poses)
    results: list[FrameResult] = []
    for frame in scene.frames:
        truth = frame.cam_from_model
        if truth is None:
            continue
        session = TrackingSession(views, scene.camera, scene.part.model, initial_cam_from_model=truth)
        pose = session.process(scene.image(frame), frame.index, 0.0)
        error = None if pose.cam_from_model is None else meter.measure(pose.cam_from_model, truth)
        results.append(FrameResult(pose, error, True, frame.is_truth, frame.visible, False, not results))
    return SceneResult(scene.name, "truth", "every photo alone", tuple(results), summarise(results))


def photo_rows(name: str, result: SceneResult) -> list[ResultRow]:
    """Row of a set of photos: how many are `tracked` at their true pose."""
    total = len(result.frames)
    states = Counter(frame.pose.state for frame in result.frames)
    text = f"{states[TrackingState.TRACKED]}/{total} tracked"
    text += "".join(f", {count} {state}" for state, count in states.items() if state is not TrackingState.TRACKED)
    turn = result.summary.errors.get("rotation_deg")
    text += f"; median {turn.median:.2f}° from the reference" if turn else ""
    target = f"at most {MAX_FAILURES} photo not `tracked` at its true pose"
    is_reached = total > 0 and states[TrackingState.TRACKED] >= total - MAX_FAILURES
    return [ResultRow("each photo at truth", name, text, target, is_reached)]
