"""Evaluation on semi-synthetic sequences under real conditions: prints, wear, borders, phones, curved parts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from arview.detection import Detector
from arview.geometry import Array
from arview.guideviews import GuideViewSet
from arview.pose import TrackingState
from arview_lab.evaluation import PoseError, PoseMeter, Scene, SceneFrame, SceneResult, evaluate_scene, load_scene
from arview_lab.evaluation.protocols import Tally, detect_in_frames, spread_frames, true_pose
from arview_lab.semisynthetic import BOX_SHAPES, CONDITIONS, CURVED_SHAPES, conditions_job, make_sequence
from photos import background_photos
from rows import ResultRow, watched
from suites.detection import detection_text, full_sphere_views, shares, summed

REAL_SHAPES = ("block", "assembly", "bracket")
"""Shapes under real conditions unless others are asked for."""
REAL_FRAMES = 45
"""Frames of a sequence."""
DETECT_FRAMES = 12
"""Frames of a sequence in which the part is detected."""
SEED = 1
DETECT_TARGET, TRACK_TARGET = 0.90, 0.95


@dataclass(frozen=True)
class RealConditionsSuite:
    """Sections of the evaluation under real conditions, and what they share.

    Attributes:
        details: for evaluation.json; each section adds its own.
        folder: of the sequences, which are made when missing.
        conditions: names of the conditions.
        shapes: names of the shapes; under ``printed`` boxes are added, and under ``curved`` the curved ones of them
            are used, or all curved ones.
        length: frames of a sequence.
        frames: largest number of frames that are detected or tracked in each; None for the default.
        backgrounds: folder of photos, or None for the default.
    """

    details: dict[str, Any]
    folder: Path
    conditions: tuple[str, ...] = tuple(CONDITIONS)
    shapes: tuple[str, ...] = REAL_SHAPES
    length: int = REAL_FRAMES
    frames: int | None = None
    backgrounds: Path | None = None

    def names(self, conditions: str) -> tuple[str, ...]:
        """Shapes that are shown under conditions."""
        if conditions == "printed":
            return (*self.shapes, *(name for name in BOX_SHAPES if name not in self.shapes))
        if conditions != "curved":
            return self.shapes
        return tuple(name for name in self.shapes if name in CURVED_SHAPES) or CURVED_SHAPES

    def scene(self, name: str, conditions: str) -> Scene:
        """A sequence of a shape under conditions, made when it is missing."""
        photos = background_photos(self.backgrounds)
        job = conditions_job(name, CONDITIONS[conditions], self.length, SEED, photos)
        return load_scene(make_sequence(job, self.folder) / "test" / "000001")

    def scenes(self, conditions: str) -> Iterator[tuple[str, Scene, GuideViewSet]]:
        """Name, sequence and guide views over the full sphere of every shape under conditions."""
        for name in watched(self.names(conditions), conditions):
            scene = self.scene(name, conditions)
            model = scene.part.model
            yield name, scene, full_sphere_views(model, CONDITIONS[conditions].motion_of(model).distance_mm)

    def detect(self) -> list[ResultRow]:
        """The detector, without a prior, on single frames."""
        rows = []
        for conditions in self.conditions:
            tallies: dict[str, Tally] = {}
            for name, scene, views in self.scenes(conditions):
                frames = spread_frames(scene, self.frames or DETECT_FRAMES)
                tallies[name] = detect_in_frames(scene, frames, Detector(views, scene.camera), _Meter(scene))
            records = {name: asdict(tally) for name, tally in tallies.items()}
            self.details.setdefault("real-detect", {})[conditions] = records
            total = summed(tallies.values())
            text = f"{detection_text(total)} ({shares(tallies)})"
            target = f"≥ {100 * DETECT_TARGET:.0f} % within 5 cm/5°, full sphere, no hint"
            rows.append(ResultRow("real detect", conditions, text, target, total.share >= DETECT_TARGET))
        return rows

    def track(self) -> list[ResultRow]:
        """A session started at the first true pose, and its states."""
        rows = []
        for conditions in self.conditions:
            results: dict[str, SceneResult] = {}
            for name, scene, views in self.scenes(conditions):
                results[name] = evaluate_scene(_shortened(scene, self.frames), "truth", views=views)
            records = {name: result.to_dict() for name, result in results.items()}
            self.details.setdefault("real-track", {})[conditions] = records
            tallies = {name: _tally(result) for name, result in results.items()}
            total = summed(tallies.values())
            text = f"{100 * total.share:.1f} % of {total.frames} ({shares(tallies)}); {_states(results)}"
            target = f"≥ {100 * TRACK_TARGET:.0f} % within 5 cm/5°"
            rows.append(ResultRow("real track", conditions, text, target, total.share >= TRACK_TARGET))
        return rows


class _Meter:
    """Error of an estimated pose in a frame."""

    def __init__(self, scene: Scene) -> None:
        part = scene.part
        self._meter = PoseMeter(part.model, scene.camera, None, part.symmetries, scene.symmetric_poses)

    def __call__(self, estimate: Array, frame: SceneFrame) -> PoseError:
        return self._meter.measure(estimate, true_pose(frame))


def _shortened(scene: Scene, frames: int | None) -> Scene:
    return scene if frames is None else replace(scene, frames=scene.frames[:frames])


def _tally(result: SceneResult) -> Tally:
    """Evaluated frames, and those whose pose is within 5 cm and 5°; times of tracked frames."""
    summary = result.summary
    share = summary.within_5cm_5deg or 0.0
    ms = tuple(f.pose.ms for f in result.frames if not f.is_detection and not f.is_first)
    return Tally(summary.evaluated, round(share * summary.evaluated), ms)


def _states(results: dict[str, SceneResult]) -> str:
    """Frames by state, poses called `tracked` that are wrong, and median errors, as text."""
    frames = [frame for result in results.values() for frame in result.frames]
    counts = {str(state): sum(f.pose.state is state for f in frames) for state in TrackingState}
    false = sum(frame.is_false_tracked for frame in frames)
    errors = sorted(f.error.translation_mm for f in frames if f.error is not None)
    turns = sorted(f.error.rotation_deg for f in frames if f.error is not None)
    text = ", ".join(f"{count} {state}" for state, count in counts.items() if count)
    if errors:
        text += f", {false} false; median {errors[len(errors) // 2]:.2f} mm / {turns[len(turns) // 2]:.2f}°"
    return text
