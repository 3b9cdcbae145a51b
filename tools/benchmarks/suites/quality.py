"""Whether quality separates right from wrong poses on every set with reference poses, and its calibration."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from arview.geometry import Array, apply, exp_so3, rigid
from arview.guideviews import GuideViewSet
from arview.pose import Pose, TrackingState
from arview.refinement.modalities.edge import smoothed
from arview.tracking import SpecimenTracking, Tracker
from arview.tracking.tracker_options import STAGES
from arview.video import Image
from arview_lab.evaluation import PoseMeter, Scene, SceneFrame, scene_guide_views
from arview_lab.evaluation.protocols import box_symmetries
from arview_lab.evaluation.run import COARSE, IN_VIEW
from recordings import PHOTO_SEQUENCES
from rows import ResultRow, watched
from suites.real_conditions import RealConditionsSuite

TURNS_DEG = (6.0, 25.0)
"""Range of the rotations by which true poses are perturbed."""
SHIFTS = (0.3, 0.8)
"""Range of the shifts, in diameters of the part; at least by `MIN_SHIFT_MM`."""
MIN_SHIFT_MM = 60.0
PERTURBED_EVERY = 3
"""Every so many frames poses are perturbed."""
FAR_OFF_DEG = 15.0
"""A pose rotated farther than this must not be `tracked` twice running."""
MAX_FRAMES = 90
"""Largest number of frames of a scene, evenly cut from its start."""
AUC_TARGET = 0.95
SEED = 5
DECILES = 10


@dataclass(frozen=True)
class PoseSample:
    """A pose that a tracker may present.

    Attributes:
        scene: name of the set.
        kind: ``tracked``, ``critical`` (of a session); ``truth``, ``turned``, ``shifted``,
            ``half turned`` (refined from there).
        quality: 0–1.
        is_right: within 5 cm and 5° of the reference.
        rotation_deg: error of the rotation.
    """

    scene: str
    kind: str
    quality: float
    is_right: bool
    rotation_deg: float


def quality_rows(
    recorded: dict[str, Scene], real: RealConditionsSuite, details: dict[str, Any], frames: int | None = None
) -> list[ResultRow]:
    """Rows of the separation, of the calibration, and of wrong poses that are `tracked`."""
    samples: list[PoseSample] = []
    runs: dict[str, int] = {}
    for name, scene, views in watched(_scenes(recorded, real), "quality"):
        kept = replace(scene, frames=scene.frames[: frames or MAX_FRAMES])
        found, runs[name] = _PoseSampler(name, kept, views).sample()
        samples += found
    by_scene = {name: [s for s in samples if s.scene == name] for name in runs}
    aucs = {name: separation(group) for name, group in by_scene.items()}
    table = reliability(samples)
    details["quality"] = {
        "auc": aucs,
        "counts": {name: _counts(group) for name, group in by_scene.items()},
        "deciles": table,
        "longest_wrong_run": runs,
    }
    total = separation(samples)
    known = {name: auc for name, auc in aucs.items() if auc is not None}
    worst = ", ".join(f"{name} {auc:.3f}" for name, auc in sorted(known.items(), key=lambda item: item[1]))
    wrong = sum(not s.is_right for s in samples)
    text = f"{total or 0.0:.3f} of {len(samples) - wrong} right and {wrong} wrong poses ({worst})"
    gap = sum(row["count"] * abs(row["quality"] - row["right"]) for row in table) / max(len(samples), 1)
    cells = ", ".join(f"{row['quality']:.2f}→{row['right']:.2f}" for row in table)
    longest = ", ".join(f"{name} {run}" for name, run in runs.items() if run > 0)
    most = max(runs.values(), default=0)
    on = f"{len(runs)} sets"
    return [
        ResultRow(
            "quality, AUC", on, text, f"≥ {AUC_TARGET} on every set",
            len(known) > 0 and min(known.values()) >= AUC_TARGET,
        ),
        ResultRow(
            "quality, share right per decile", on, f"mean gap {gap:.3f}: {cells}", "mean gap ≤ 0.10", gap <= 0.10
        ),
        ResultRow(
            f"`tracked` {FAR_OFF_DEG:.0f}° off, longest run", on, f"{most} frames ({longest or 'none'})",
            "at most 1 frame", most <= 1,
        ),
    ]  # fmt: skip


def _scenes(recorded: dict[str, Scene], real: RealConditionsSuite) -> Iterator[tuple[str, Scene, GuideViewSet]]:
    for name, scene in recorded.items():
        yield name, scene, scene_guide_views(scene)
    for conditions in real.conditions:
        for shape, scene, views in real.scenes(conditions):
            yield f"{shape}_{conditions}", scene, views


class _PoseSampler:
    """Tracks a scene from its first reference pose, and perturbs reference poses in it."""

    def __init__(self, name: str, scene: Scene, views: GuideViewSet) -> None:
        self._name, self._scene, self._views = name, scene, views
        model = scene.part.model
        # A printed box is not symmetric, but the plain CAD of it is.
        symmetries = box_symmetries(model) if name in ("cube", "teabox") else scene.part.symmetries
        self._meter = PoseMeter(model, scene.camera, symmetries=symmetries, symmetric_poses=scene.symmetric_poses)
        self._center, self._diameter = model.center_in_model, model.diameter_mm
        self._rng = np.random.default_rng(SEED)

    def sample(self) -> tuple[list[PoseSample], int]:
        """Poses with their quality, and the longest run of frames `tracked` far off."""
        samples: list[PoseSample] = []
        run = longest = 0
        session: SpecimenTracking | None = None
        for number, frame in enumerate(self._scene.frames):
            truth, image = frame.cam_from_model, self._scene.image(frame)
            if session is None or self._name in PHOTO_SEQUENCES:
                if truth is None:
                    continue
                session = SpecimenTracking(
                    self._views, self._scene.camera, self._scene.part.model, initial_cam_from_model=truth
                )
            pose = session.process(image, frame.index, number / 30.0)
            run = run + 1 if self._is_far_off(pose, truth) else 0
            longest = max(longest, run)
            if truth is None or not is_shown(frame):
                continue
            is_alone = self._name in PHOTO_SEQUENCES
            is_right = is_alone
            if pose.cam_from_model is not None:
                sample = self._sampled(str(pose.state), pose.cam_from_model, truth, pose.quality)
                samples.append(sample)
                is_right = sample.is_right
            # A tracker that is off knows the wrong colours; one just started at the truth does not.
            if is_right and (is_alone or number % PERTURBED_EVERY == 0):
                samples += self._perturbed(session.tracker, image, truth)
        return samples, longest

    def _is_far_off(self, pose: Pose, truth: Array | None) -> bool:
        """Whether a pose is `tracked` although it is rotated by far from the true one."""
        if pose.state is not TrackingState.TRACKED or pose.cam_from_model is None or truth is None:
            return False
        return self._meter.measure(pose.cam_from_model, truth).rotation_deg >= FAR_OFF_DEG

    def _perturbed(self, tracker: Tracker, image: Image, truth: Array) -> Iterator[PoseSample]:
        """The true pose, and one turned, one shifted and one half turned, each refined as a tracker refines them."""
        smooth = smoothed(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        part, appearance = tracker.refiner.part, tracker.state.appearance
        starts = {
            "truth": truth,
            "turned": self._turned(truth),
            "shifted": self._shifted(truth),
            "half turned": self._half_turned(truth),
        }
        for kind, start in starts.items():
            body = start @ part.model_from_body
            refined = tracker.refiner.refine(image, smooth, body, STAGES[-2:], appearance)[0]
            quality = tracker.refiner.evidence(image, smooth, refined, appearance).quality
            yield self._sampled(kind, refined @ part.body_from_model, truth, quality)

    def _turned(self, truth: Array) -> Array:
        axis = self._rng.normal(size=3)
        turn = exp_so3(np.deg2rad(self._rng.uniform(*TURNS_DEG)) * axis / np.linalg.norm(axis))
        return truth @ rigid(turn, self._center - turn @ self._center)

    def _shifted(self, truth: Array) -> Array:
        way = self._rng.normal(size=3)
        length = max(MIN_SHIFT_MM, self._rng.uniform(*SHIFTS) * self._diameter)
        limit = 0.5 * float(np.linalg.norm(apply(truth, self._center)))
        return rigid(np.eye(3), min(length, limit) * way / np.linalg.norm(way)) @ truth

    def _half_turned(self, truth: Array) -> Array:
        """Turned by 180° about one of the model's axes, as detectors confuse poses of nearly symmetric parts."""
        turn = exp_so3(np.pi * np.eye(3)[int(self._rng.integers(3))])
        return truth @ rigid(turn, self._center - turn @ self._center)

    def _sampled(self, kind: str, estimate: Array, truth: Array, quality: float) -> PoseSample:
        error = self._meter.measure(estimate, truth)
        return PoseSample(self._name, kind, quality, error.within(*COARSE), error.rotation_deg)


def is_shown(frame: SceneFrame) -> bool:
    """Whether enough of the part is in view for its pose to be right or wrong."""
    return frame.visible is None or frame.visible >= IN_VIEW


def separation(samples: list[PoseSample]) -> float | None:
    """Area under the ROC curve: the probability that a right pose has the higher quality than a wrong one.

    None without right or without wrong poses; equal qualities count half (Mann and Whitney 1947).
    """
    right = np.sort([s.quality for s in samples if s.is_right])
    wrong = np.array([s.quality for s in samples if not s.is_right])
    if right.size == 0 or wrong.size == 0:
        return None
    above = right.size - np.searchsorted(right, wrong, side="right")
    equal = np.searchsorted(right, wrong, side="right") - np.searchsorted(right, wrong, side="left")
    return float((above + 0.5 * equal).sum() / (right.size * wrong.size))


def reliability(samples: list[PoseSample]) -> list[dict[str, float]]:
    """Mean quality and share of right poses in ten groups of equal size, from the lowest quality up."""
    order = sorted(samples, key=lambda s: s.quality)
    groups = [g for g in np.array_split(np.arange(len(order)), DECILES) if g.size]
    return [
        {
            "count": float(group.size),
            "quality": float(np.mean([order[k].quality for k in group])),
            "right": float(np.mean([order[k].is_right for k in group])),
        }
        for group in groups
    ]


def _counts(samples: list[PoseSample]) -> dict[str, dict[str, int]]:
    kinds = sorted({s.kind for s in samples})
    return {
        kind: {
            "right": sum(s.is_right for s in samples if s.kind == kind),
            "wrong": sum(not s.is_right for s in samples if s.kind == kind),
        }
        for kind in kinds
    }
