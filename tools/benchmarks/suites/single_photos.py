"""Recorded photos that are no video: each alone, started at its true pose."""

from __future__ import annotations

import time
from collections import Counter

import numpy as np

from arview.cad import Model, Symmetry
from arview.detection import Detector
from arview.pose import TrackingState
from arview.tracking import SpecimenTracking
from arview_lab.evaluation import FrameResult, PoseMeter, Scene, SceneResult, scene_guide_views, summarise
from arview_lab.evaluation.run import COARSE
from rows import ResultRow, timing, watched

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
        session = SpecimenTracking(views, scene.camera, scene.part.model, initial_cam_from_model=truth)
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


def half_turn(model: Model) -> Symmetry:
    """The half turn about the shortest side of a model's box, by which a crate looks nearly the same."""
    low, high = model.bounds_in_model
    axis = np.eye(3)[int(np.argmin(high - low))].tolist()
    x, y, z = model.center_in_model.tolist()
    return Symmetry((axis[0], axis[1], axis[2]), (x, y, z), 2)


def photo_detection_row(name: str, scene: Scene) -> ResultRow:
    """The detector on every photo, up to the half turn, which must be right or called ambiguous."""
    part = scene.part
    detector = Detector(scene_guide_views(scene), scene.camera)
    exact = PoseMeter(part.model, scene.camera, None, part.symmetries, scene.symmetric_poses)
    upto = PoseMeter(part.model, scene.camera, None, (*part.symmetries, half_turn(part.model)), scene.symmetric_poses)
    found = turned = total = 0
    ms = []
    for frame in watched(scene.frames, f"detect {name}"):
        truth = frame.cam_from_model
        if truth is None:
            continue
        total += 1
        image = scene.image(frame)
        began = time.perf_counter()
        detections = detector.detect(image, max_results=1)
        ms.append(1e3 * (time.perf_counter() - began))
        if not detections or not upto.measure(detections[0].cam_from_model, truth).within(*COARSE):
            continue
        found += 1
        poses = (detections[0].cam_from_model, *detections[0].alternatives)
        turned += not any(exact.measure(pose, truth).within(*COARSE) for pose in poses)
    text = f"{found} of {total} up to the half turn, {turned} of them turned and not ambiguous, {timing(ms[1:])}"
    target = "at most 1 not found within 5 cm/5°, none turned unless ambiguous, declared range, no hint"
    return ResultRow("detect", name, text, target, total > 0 and found >= total - MAX_FAILURES and turned == 0)
