"""Presence of components: assemblies of which some or all but the base are absent, and right ones."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.cad import Part, load_part
from arview.cad.model import Model
from arview.camera.read import load_camera
from arview.geometry import Array
from arview.guideviews import GuideViewSet
from arview.guideviews.cache import cached_guide_views
from arview.inspection import Verdict, load_inspection
from arview.overlay import OverlayRenderer
from arview.pose import Pose, Presence
from arview.rendering.renderers import ZBufferRenderer
from arview.tracking import SpecimenTracking
from arview.video.sources import open_source
from arview_lab.evaluation import Scene, load_scene
from arview_lab.semisynthetic import (
    WALK_ROUND,
    LookAlike,
    SequenceOptions,
    Variant,
    look_alike_job,
    make_sequence,
    shape,
    with_absent,
)
from arview_lab.semisynthetic.random_solids import random_solid
from photos import background_photos
from recordings import ROOT, SHARED, skip
from rows import ResultRow, watched
from suites.detection import full_sphere_views, percent

SOLIDS = (400, 401, 405, 408, 410)
"""Seeds of the random assemblies beside the test shape of that name; none of them served to fit weights."""
FRAMES = 120
SEED = 1
VARIANTS: tuple[Variant, ...] = ("regular", "occlusion")
"""Plain, and with another part that circles in front under a moving light."""
CASE = SHARED.parent / "cases" / "presence"
CLIPS = ("bracket_plate", "plate")
FAIR_PIXELS, FAIR_FRAMES = 80, 3
"""A component had a fair look when this many of its pixels were visible in this many frames."""


@dataclass
class PresenceResult:
    """What a session said of the components in one sequence.

    Attributes:
        name: of the sequence.
        frames, followed: how many frames, and in how many of them there was a pose.
        last: presence of each component after the last frame.
        ever: every presence that any frame gave each component.
        absent, there: names of the components that are absent, and of those that are there, without the base; of both
            only those that had a fair look.
        probabilities: of each component after the last frame with a pose.
        is_ambiguous: other poses fit as well in the last frame.
    """

    name: str
    frames: int = 0
    followed: int = 0
    last: dict[str, str] = field(default_factory=dict)
    ever: dict[str, list[str]] = field(default_factory=dict)
    absent: list[str] = field(default_factory=list)
    there: list[str] = field(default_factory=list)
    probabilities: dict[str, float] = field(default_factory=dict)
    is_ambiguous: bool = False

    def add(self, pose: Pose) -> None:
        """Take a frame into account."""
        self.frames += 1
        if pose.cam_from_model is None:
            return
        self.followed += 1
        self.is_ambiguous = bool(pose.alternatives)
        for name, one in pose.components.items():
            self.last[name] = str(one.presence)
            self.probabilities[name] = round(one.probability, 4)
            seen = self.ever.setdefault(name, [])
            if str(one.presence) not in seen:
                seen.append(str(one.presence))

    def is_last(self, name: str, presence: Presence) -> bool:
        """Whether a component has this presence at the end, or is uncertain where the pose is ambiguous."""
        last = self.last.get(name)
        return last == presence or (self.is_ambiguous and last == Presence.UNCERTAIN)

    def was(self, name: str, *presences: Presence) -> bool:
        """Whether any frame gave a component one of these."""
        return any(presence in self.ever.get(name, ()) for presence in presences)


class PresenceSuite:
    """The section ``presence`` of the evaluation.

    Args:
        recorded: scenes by name.
        details: for evaluation.json.
        folder: of the sequences, which are made when missing.
        frames: of each sequence, and at most of a recording; None for the default, and for all.
        assemblies: how many of the assemblies; None: all.
        backgrounds: folder of photos, or None for the default.
    """

    def __init__(
        self,
        recorded: dict[str, Scene],
        details: dict[str, Any],
        folder: Path,
        frames: int | None = None,
        assemblies: int | None = None,
        backgrounds: Path | None = None,
    ) -> None:
        self._recorded, self._details, self._folder = recorded, details, folder / "presence"
        self._frames, self._limit = frames or FRAMES, frames
        self._assemblies, self._backgrounds = assemblies, backgrounds

    def rows(self) -> list[ResultRow]:
        """All rows of the section."""
        return [*self.case_rows(), *self.absent_rows(), *self.right_rows()]

    def case_rows(self) -> list[ResultRow]:
        """The case of a panel of which only two components are there, and what is drawn of the others."""
        if not (CASE / "part.toml").is_file():
            skip("presence case", f"{CASE / 'part.toml'} is not here")
            return []
        part, camera = load_part(CASE / "part.toml"), load_camera(CASE / "three.camera.json")
        inspection = load_inspection(CASE / "inspection.json", part.model)
        session = SpecimenTracking(declared_views(part), camera, part.model)
        renderer = OverlayRenderer(part.model, camera, inspection, serial=part.serial)
        result = PresenceResult("case", there=["bolt_1", "hose_clamp"])
        names = [component.name for component in part.model.components]
        result.absent = [name for name in names[1:] if name not in result.there]
        false_pass: list[tuple[int, str]] = []
        labels = 0
        for number, frame in enumerate(open_source(CASE / "three.mp4")):
            pose = session.process(frame.image, number, number / 30.0)
            result.add(pose)
            renderer.draw(frame.image, pose, now=inspection.created)
            texts = [placed.text for placed in renderer.laid_out.labels]
            labels += len(texts)
            false_pass += [
                (number, text.name)
                for text in texts
                if text.name in result.absent and text.verdict is Verdict.PASS and not text.is_dimmed
            ]
        self._details["presence-case"] = {**asdict(result), "false_pass": false_pass, "labels": labels}
        frames = len({number for number, _ in false_pass})
        text = f"{frames} of {result.frames} frames with an undimmed PASS on an absent component; {labels} labels drawn"
        row = ResultRow("presence, drawn", "panel with two of ten", text, "0 frames", labels > 0 and not false_pass)
        return [row, *absent_rows("panel with two of ten", [result])]

    def absent_rows(self) -> list[ResultRow]:
        """Assemblies of which some components are absent, walked round."""
        photos = background_photos(self._backgrounds)
        results = []
        for name, model in watched(list(self._models())[: self._assemblies], "presence"):
            for variant in VARIANTS:
                for look_alike in absences(model):
                    options = SequenceOptions(variant, self._frames, SEED)
                    made = make_sequence(look_alike_job(name, model, look_alike, options, photos), self._folder)
                    scene = load_scene(made / "test" / "000001")
                    views = full_sphere_views(scene.part.model, WALK_ROUND.distance_mm)
                    session = SpecimenTracking(views, scene.camera, scene.part.model)
                    results.append(self._walk(f"{name}_{look_alike.name}_{variant}", scene, session, look_alike))
        self._details["presence"] = [asdict(result) for result in results]
        return absent_rows(f"{len(results)} sequences of {self._frames} frames", results) if results else []

    def right_rows(self) -> list[ResultRow]:
        """Recorded assemblies and the sample clips, of which every component is there."""
        rows = []
        for name, scene in self._recorded.items():
            if len(scene.part.model.components) > 1:
                result = PresenceResult(name, there=[one.name for one in scene.part.model.components])
                distances = [float(np.linalg.norm(pose[:3, 3])) for pose in scene.poses]
                views = full_sphere_views(scene.part.model, (min(distances), max(distances)))
                start = None if name == "plate" else scene.frames[0].cam_from_model
                session = SpecimenTracking(views, scene.camera, scene.part.model, initial_cam_from_model=start)
                for number, shown in enumerate(scene.frames[: self._limit]):
                    result.add(session.process(scene.image(shown), number, number / 30.0))
                rows.append(self._right_row(result))
        for name in CLIPS:
            clip = ROOT / "samples" / name / "clip.mp4"
            if clip.is_file():
                part, camera = load_part(clip.parent / "part.toml"), load_camera(clip.parent / "camera.json")
                first = next(iter(open_source(clip))).image
                camera = camera.scaled(first.shape[1], first.shape[0])
                result = PresenceResult(f"sample {name}", there=[one.name for one in part.model.components])
                session = SpecimenTracking(declared_views(part), camera, part.model)
                for number, frame in enumerate(open_source(clip)):
                    if self._limit is not None and number >= self._limit:
                        break
                    result.add(session.process(frame.image, number, number / 30.0))
                rows.append(self._right_row(result))
        return rows

    def _right_row(self, result: PresenceResult) -> ResultRow:
        self._details[f"presence {result.name}"] = asdict(result)
        wrong = [name for name in result.there if result.was(name, Presence.MISSING, Presence.DISPLACED)]
        found = sum(result.last.get(name) == Presence.PRESENT for name in result.there)
        text = f"{len(wrong)} ever missing ({', '.join(wrong) or 'none'}), {found} of {len(result.there)} present"
        text += f" at the end; {result.followed} of {result.frames} frames with a pose"
        return ResultRow("presence, right part", result.name, text, "none missing", not wrong and result.followed > 0)

    def _models(self) -> Iterator[tuple[str, Model]]:
        yield "assembly", shape("assembly")
        for seed in SOLIDS:
            yield f"random_{seed}", random_solid(seed)

    def _walk(self, name: str, scene: Scene, session: SpecimenTracking, look_alike: LookAlike) -> PresenceResult:
        """Follow a sequence with a session."""
        result = PresenceResult(name)
        model = scene.part.model
        kept = {one.name for one in look_alike.model.components}
        fair = had_fair_look(model, scene)
        for frame in scene.frames:
            result.add(session.process(scene.image(frame), frame.index, frame.index / 30.0))
        result.absent = [one for one in look_alike.components if one in fair]
        result.there = [one for one in fair if one in kept and one != base_name(model)]
        return result


def absences(model: Model) -> list[LookAlike]:
    """The assembly with 1, 2, half and all but the base of its components removed."""
    others = len(model.components) - 1
    counts = sorted({1, min(2, others), max(1, others // 2), others})
    return [with_absent(model, count, np.random.default_rng([SEED, count])) for count in counts]


def declared_views(part: Part) -> GuideViewSet:
    """Guide views of a part over its declared range."""
    assert part.view_range is not None, f"{part.name} has no view range"
    return cached_guide_views(part.model, part.view_range)


def base_name(model: Model) -> str:
    """The component with the largest box, which is never removed."""
    return max(model.components, key=lambda c: float(np.prod(np.ptp(c.bounds_in_model, axis=0) + 1e-3))).name


def had_fair_look(model: Model, scene: Scene) -> list[str]:
    """Names of the components whose place enough frames show: neither hidden by the part nor outside the picture."""
    renderer = ZBufferRenderer(model, scene.camera)
    frames = np.zeros(len(model.components), dtype=int)
    for frame in scene.frames:
        pose = frame.cam_from_model
        if pose is not None:
            frames += pixels_of(renderer, pose, len(frames)) >= FAIR_PIXELS
    return [one.name for one, count in zip(model.components, frames, strict=True) if count >= FAIR_FRAMES]


def pixels_of(renderer: ZBufferRenderer, pose: Array, count: int) -> NDArray[np.int64]:
    """(C,) visible pixels of each component."""
    ids = renderer.render(pose).component_ids
    return np.bincount(ids[ids >= 0].ravel(), minlength=count)


def absent_rows(on: str, results: Sequence[PresenceResult]) -> list[ResultRow]:
    """Rows of sequences in which some components are absent."""
    absent = [(one, name) for one in results for name in one.absent]
    there = [(one, name) for one in results for name in one.there]
    missing = sum(one.is_last(name, Presence.MISSING) for one, name in absent)
    wrongly_present = sum(one.was(name, Presence.PRESENT) for one, name in absent)
    present = sum(one.is_last(name, Presence.PRESENT) for one, name in there)
    wrongly_missing = sum(one.was(name, Presence.MISSING, Presence.DISPLACED) for one, name in there)
    unfound = [one.name for one in results if not one.followed]
    note = f"; never found: {', '.join(unfound)}" if unfound else ""
    text = f"{percent(missing, len(absent))} of {len(absent)} missing at the end, {wrongly_present} ever present{note}"
    other = f"{percent(present, len(there))} of {len(there)} present at the end, {wrongly_missing} ever missing{note}"
    is_absent_right = len(absent) > 0 and missing >= 0.97 * len(absent) and wrongly_present == 0
    is_there_right = len(there) > 0 and present >= 0.97 * len(there) and wrongly_missing == 0
    return [
        ResultRow("presence, absent", on, text, "≥ 97 % missing, none ever present", is_absent_right),
        ResultRow("presence, there", on, other, "≥ 97 % present, none ever missing", is_there_right),
    ]
