"""Evaluation of the detector and of tracking on semi-synthetic sequences, of false alarms and of look-alikes."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from arview.cad import Model, ViewRange, load_part
from arview.detection import Detector
from arview.geometry import Array, apply
from arview.guideviews import GuideViewSet
from arview.guideviews.cache import cached_guide_views
from arview.pose import TrackingState
from arview.tracking import SpecimenTracking
from arview.video import Image
from arview_lab.evaluation import PoseError, PoseMeter, Scene, SceneFrame, load_scene
from arview_lab.evaluation.protocols import (
    Tally,
    box_symmetries,
    detect_in_frames,
    full_sphere_range,
    spread_frames,
    track_with_resets,
    true_pose,
)
from arview_lab.semisynthetic import (
    SHAPES,
    VARIANTS,
    WALK_ROUND,
    LookAlike,
    SequenceOptions,
    Variant,
    frames_without_part,
    indistinguishable_poses,
    look_alike_job,
    look_alikes,
    make_sequence,
    near_symmetries,
    nearest_error,
    shape,
    shape_job,
)
from photos import all_photos, background_photos
from recordings import PHOTO_SEQUENCES, SAMPLE, VIDEOS
from rows import ResultRow, timing, watched
from suites.single_photos import photo_detection_row

SCENE_FRAMES = 200
"""Frames of a semi-synthetic sequence."""
LOOK_ALIKE_FRAMES = 60
SEED = 1
DETECT_FRAMES = {"real": 60, "semisynthetic": 25, "look-alike": 6}
FALSE_ALARM_FRAMES = 1000
BOXES = ("cube", "teabox")
TRACK_TARGETS = {1: 0.95, 2: 0.88, 3: 0.75, 4: 0.60}
DETECT_TARGETS: dict[Variant, float] = {"regular": 0.95, "light": 0.93, "noise": 0.90, "occlusion": 0.85}
MIN_DIFFERENT = 0.01
"""Smallest share of the part's pixels that a fault changes in frames that show it."""


@dataclass(frozen=True)
class DetectionSuite:
    """Sections of the evaluation, and what they share.

    Attributes:
        recorded: scenes by name.
        details: for evaluation.json; each section adds its own.
        folder: of the semi-synthetic sequences, which are made when missing.
        shapes: names of the shapes.
        frames: largest number of frames of a scene; None for the default of each section.
        backgrounds: folder of photos, or None for the default.
    """

    recorded: dict[str, Scene]
    details: dict[str, Any]
    folder: Path
    shapes: tuple[str, ...] = SHAPES
    frames: int | None = None
    backgrounds: Path | None = None

    # --- Real sequences ---------------------------------------------------------------------------------

    def detect(self) -> list[ResultRow]:
        """The detector, without a prior, on single frames of the recorded sequences."""
        rows = []
        for name, scene in watched(self.recorded.items(), "detect"):
            if name in PHOTO_SEQUENCES:
                rows.append(photo_detection_row(name, scene))
                continue
            model = scene.part.model
            symmetries = box_symmetries(model) if name in BOXES else scene.part.symmetries
            meter = PoseMeter(model, scene.camera, symmetries=symmetries, symmetric_poses=scene.symmetric_poses)
            detector = Detector(recorded_views(scene), scene.camera)
            frames = spread_frames(scene, self.frames or DETECT_FRAMES["real"])
            tally = detect_in_frames(scene, frames, detector, partial(_plain_error, meter))
            self.details.setdefault("detect", {})[name] = asdict(tally)
            target = "≥ 95 % within 5 cm/5°, full sphere, no hint"
            rows.append(ResultRow("detect", name, detection_text(tally), target, tally.share >= 0.95))
        return rows

    # --- Semi-synthetic sequences -----------------------------------------------------------------------

    @cached_property
    def photos(self) -> tuple[Path, ...]:
        """Backgrounds of the sequences."""
        return background_photos(self.backgrounds)

    def scene(self, name: str, variant: Variant) -> Scene:
        """A sequence of a shape, made when it is missing."""
        options = SequenceOptions(variant, SCENE_FRAMES, SEED)
        made = make_sequence(shape_job(name, options, self.photos), self.folder)
        return load_scene(made / "test" / "000001")

    def semisynthetic_track(self) -> list[ResultRow]:
        """Tracking by the protocol of RBOT, at four frame steps."""
        tallies: dict[tuple[int, Variant, str], Tally] = {}
        for name in watched(self.shapes, "semisynthetic-track"):
            for variant in VARIANTS:
                scene = self.scene(name, variant)
                views = shape_views(scene.part.model)
                for step in TRACK_TARGETS:
                    tallies[step, variant, name] = track_with_resets(scene, views, step, self.frames)
        records = [{"step": s, "variant": v, "shape": n, **asdict(t)} for (s, v, n), t in tallies.items()]
        self.details["semisynthetic-track"] = records
        rows = []
        for step, target in TRACK_TARGETS.items():
            of_step = {key: tally for key, tally in tallies.items() if key[0] == step}
            total = summed(of_step.values())
            by_variant = {v: summed(t for key, t in of_step.items() if key[1] == v) for v in VARIANTS}
            by_shape = {n: summed(t for key, t in of_step.items() if key[2] == n) for n in self.shapes}
            text = f"{100 * total.share:.1f} % of {total.frames} ({shares(by_variant)}; {shares(by_shape)})"
            wanted = f"≥ {100 * target:.0f} % within 5 cm/5°"
            rows.append(ResultRow("semisynthetic track", f"frame step {step}", text, wanted, total.share >= target))
        return rows

    def semisynthetic_detect(self) -> list[ResultRow]:
        """The detector, without a prior, on single frames of every variant."""
        tallies: dict[tuple[Variant, str], Tally] = {}
        for name in watched(self.shapes, "semisynthetic-detect"):
            for variant in VARIANTS:
                scene = self.scene(name, variant)
                detector = Detector(shape_views(scene.part.model), scene.camera)
                frames = spread_frames(scene, self.frames or DETECT_FRAMES["semisynthetic"])
                measure = _IndistinguishableMeter(scene, name)
                tallies[variant, name] = detect_in_frames(scene, frames, detector, measure)
        records = [{"variant": v, "shape": n, **asdict(t)} for (v, n), t in tallies.items()]
        self.details["semisynthetic-detect"] = records
        rows = []
        for variant, target in DETECT_TARGETS.items():
            by_shape = {n: tallies[variant, n] for n in self.shapes}
            total = summed(by_shape.values())
            text = f"{detection_text(total)} ({shares(by_shape)})"
            wanted = f"≥ {100 * target:.0f} % within 5 cm/5°, full sphere, no hint"
            rows.append(ResultRow("semisynthetic detect", variant, text, wanted, total.share >= target))
        return rows

    # --- Other things -----------------------------------------------------------------------------------

    def false_alarms(self) -> list[ResultRow]:
        """False alarms: the detector of each part on pictures without it."""
        parts = [*self.shapes, *(name for name in self.recorded if name in VIDEOS)]
        each = self.frames or -(-FALSE_ALARM_FRAMES // len(parts))
        parts += [name for name in self.recorded if name not in VIDEOS]
        false: dict[str, list[str]] = {}
        looked = 0
        for number, name in enumerate(watched(parts, "false-alarms")):
            false[name] = []
            for detector, origin, image in self.pictures_without(name, each, number):
                looked += 1
                if detector.detect(image, max_results=1):
                    false[name].append(origin)
        self.details["false-alarms"] = false
        count = sum(len(origins) for origins in false.values())
        named = ", ".join(f"{name} {len(origins)}" for name, origins in false.items() if origins)
        text = f"{count} of {looked}" + (f" ({named})" if named else "")
        return [ResultRow("false alarms", f"{len(parts)} parts", text, "none", count == 0)]

    def pictures_without(self, name: str, count: int, seed: int) -> Iterator[tuple[Detector, str, Image]]:
        """Pictures without a part: photos and, for the shapes, frames of other shapes.

        Yields:
            the detector of the part, where the picture comes from, and the picture.
        """
        detector, camera = self._detector_of(name)
        # The backgrounds of the semi-synthetic scenes show the recorded parts.
        others = [other for other in self.shapes if other != name] if name in self.shapes else []
        scenes = [self.scene(other, "regular") for other in others]
        photos = all_photos(self.backgrounds, name)
        for origin, image in frames_without_part(photos, scenes, camera.width, camera.height, count, seed):
            yield detector, origin, image

    def _detector_of(self, name: str) -> tuple[Detector, Any]:
        if name in self.recorded:
            scene = self.recorded[name]
            return Detector(recorded_views(scene), scene.camera), scene.camera
        scene = self.scene(name, "regular")
        return Detector(shape_views(scene.part.model), scene.camera), scene.camera

    def look_alikes(self) -> list[ResultRow]:
        """Whether a session names the fault of a look-alike, in single frames and while the camera moves around it."""
        models = {"assembly": shape("assembly")} if "assembly" in self.shapes else {}
        if (SAMPLE / "part.toml").is_file() and self.frames is None:
            models[SAMPLE.name] = load_part(SAMPLE / "part.toml").model
        results: list[LookAlikeResult] = []
        walks: list[LookAlikeResult] = []
        for name, model in models.items():
            variants = look_alikes(model)
            every = max(1, len(variants) // self.frames) if self.frames else 1
            for look_alike in watched(variants[::every], f"lookalike {name}"):
                walk = self._walk(name, model, look_alike)
                if walk is not None:
                    results += walk.single_frames(self.frames or DETECT_FRAMES["look-alike"])
                    walks.append(walk.to_the_end())
        self.details["lookalike"] = [asdict(result) for result in results]
        self.details["lookalike-walk"] = [asdict(result) for result in walks]
        total = len(results)
        silent = sum(not r.is_locked for r in results)
        clean, clean_walks = (sum(r.is_clean for r in of) for of in (results, walks))
        named, named_walks = (sum(r.is_named for r in of) for of in (results, walks))
        on = f"{', '.join(models)}: {total} frames"
        after = f"{len(walks)} of them, walked round for {LOOK_ALIKE_FRAMES / 30.0:.0f} s"
        text = f"{percent(named, total)} named, {percent(silent, total)} not found"
        unnamed = sum(r.is_unnamed for r in results)
        cleanly = f"{clean} of {total}; {unnamed} with those whose wrong component is said to be unseen"
        all_named = percent(named_walks, len(walks))
        return [
            ResultRow("lookalike named", on, text, "≥ 90 %", total > 0 and named >= 0.9 * total),
            ResultRow("lookalike clean lock", on, cleanly, "none", total > 0 and clean == 0),
            ResultRow("lookalike named at last", after, all_named, "≥ 90 %", named_walks >= 0.9 * len(walks) > 0),
            ResultRow(
                "lookalike clean at last",
                after,
                f"{clean_walks} of {len(walks)}",
                "none",
                len(walks) > 0 and clean_walks == 0,
            ),
        ]

    def _walk(self, name: str, model: Model, look_alike: LookAlike) -> LookAlikeWalk | None:
        """A sequence around a look-alike; None when no frame shows its fault."""
        options = SequenceOptions("regular", LOOK_ALIKE_FRAMES, SEED)
        made = make_sequence(look_alike_job(name, model, look_alike, options, self.photos), self.folder / "look_alikes")
        scene = load_scene(made / "test" / "000001")
        infos = json.loads((scene.folder / "scene_gt_info.json").read_text())
        shown = tuple(f for f in scene.frames if infos[str(f.index)][0]["different_fract"] >= MIN_DIFFERENT)
        if not shown:
            return None
        session = SpecimenTracking(
            full_sphere_views(scene.part.model, WALK_ROUND.distance_mm), scene.camera, scene.part.model
        )
        return LookAlikeWalk(look_alike, scene, shown, session)


@dataclass(frozen=True)
class LookAlikeWalk:
    """A look-alike, a sequence around it, the frames that show its fault, and a session for the right part."""

    look_alike: LookAlike
    scene: Scene
    shown: tuple[SceneFrame, ...]
    session: SpecimenTracking

    def single_frames(self, count: int) -> Iterator[LookAlikeResult]:
        """Results for some single frames that show the fault."""
        for frame in spread_frames(replace(self.scene, frames=self.shown), count):
            self.session.reset()
            # A session confirms a detection in a second frame.
            picture = frame, self.scene.image(frame)
            yield self._result_after([picture, picture])

    def to_the_end(self) -> LookAlikeResult:
        """The result after the whole sequence."""
        self.session.reset()
        return self._result_after((frame, self.scene.image(frame)) for frame in self.scene.frames)

    def _result_after(self, pictures: Iterable[tuple[SceneFrame, Image]]) -> LookAlikeResult:
        """The result after some pictures."""
        for frame, image in pictures:
            pose = self.session.process(image, frame.index, frame.index / 30.0)
        found = pose.mismatches
        is_named = any(part in words(text) for text in found for part in self.look_alike.components)
        wrong = tuple(self.look_alike.components)
        return LookAlikeResult(
            self.look_alike.name, frame.index, str(pose.state), is_named, found, pose.unverified, wrong
        )


@dataclass(frozen=True)
class LookAlikeResult:
    """Result of a session for pictures of a look-alike, after the last of them.

    Attributes:
        look_alike: its name.
        frame: index of the last picture.
        state: of the session.
        is_named: a wrong component is named.
        mismatches, unverified: of the pose.
        components: the wrong components.
    """

    look_alike: str
    frame: int
    state: str
    is_named: bool
    mismatches: tuple[str, ...]
    unverified: tuple[str, ...]
    components: tuple[str, ...]

    @property
    def is_locked(self) -> bool:
        """True when the look-alike was found."""
        return self.state in (TrackingState.TRACKED, TrackingState.CRITICAL)

    @property
    def is_unnamed(self) -> bool:
        """True when it was tracked and no component was named, whatever is still unverified."""
        return self.state == TrackingState.TRACKED and not self.mismatches

    @property
    def is_clean(self) -> bool:
        """True when it was taken for the right part: nothing is named, and the wrong components count as verified."""
        return self.is_unnamed and not any(part in self.unverified for part in self.components)


def _plain_error(meter: PoseMeter, estimate: Array, frame: SceneFrame) -> PoseError:
    return meter.measure(estimate, true_pose(frame))


class _IndistinguishableMeter:
    """Errors to the nearest of the true poses that are indistinguishable in a picture."""

    def __init__(self, scene: Scene, name: str) -> None:
        self._scene, self._near = scene, near_symmetries(name)
        self._meter = PoseMeter(scene.part.model, scene.camera, symmetries=scene.part.symmetries)

    def __call__(self, estimate: Array, frame: SceneFrame) -> PoseError:
        mask = self._scene.mask(frame) if self._near else None
        truths = indistinguishable_poses(self._scene.part.model, self._scene.camera, true_pose(frame), self._near, mask)
        return nearest_error(self._meter, estimate, truths)


def shape_views(model: Model) -> GuideViewSet:
    """Guide views of a shape over the full sphere."""
    return full_sphere_views(model, SequenceOptions().motion.distance_mm)


def recorded_views(scene: Scene) -> GuideViewSet:
    """Guide views of a recorded part over the full sphere, at the distances of the recording."""
    center = scene.part.model.center_in_model
    distances = [float((apply(pose, center) ** 2).sum() ** 0.5) for pose in scene.poses]
    return full_sphere_views(scene.part.model, (min(distances), max(distances)))


def full_sphere_views(model: Model, distance_mm: tuple[float, float]) -> GuideViewSet:
    """Guide views over the full sphere, cached between runs."""
    view_range: ViewRange = full_sphere_range(*distance_mm)
    return cached_guide_views(model, view_range)


def summed(tallies: Iterable[Tally]) -> Tally:
    return sum(tallies, Tally())


def shares(tallies: dict[Any, Tally]) -> str:
    return ", ".join(f"{name} {100 * tally.share:.0f}" for name, tally in tallies.items())


def detection_text(tally: Tally) -> str:
    left_open = f", right pose among ambiguous ones {tally.left_open}" if tally.left_open else ""
    return f"{100 * tally.share:.0f} % of {tally.frames}{left_open}, {timing(tally.ms)}"


def percent(part: int, whole: int) -> str:
    return f"{100 * part / whole:.0f} %" if whole else "0 %"


def words(text: str) -> list[str]:
    """The words of a message, without the punctuation around them."""
    return [word.strip(".,:;()'\"") for word in text.split()]
