"""Identity: labels of one specimen never on another, and never withheld where only one is in view."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from arview.cad import load_part
from arview.cad.model import Model
from arview.camera import Camera
from arview.camera.read import load_camera
from arview.geometry import Array, apply
from arview.guideviews import GuideViewSet
from arview.guideviews.cache import cached_guide_views
from arview.pose import Pose, TrackingState
from arview.tracking import SpecimenTracking
from arview.video import Image
from arview.video.sources import open_source
from arview_lab.evaluation import Scene
from arview_lab.semisynthetic import shape
from arview_lab.semisynthetic.random_solids import random_solid
from photos import background_photos
from recordings import ROOT, SHARED, skip
from rows import ResultRow, watched
from suites.bench_film import CAMERA, FILM_HZ, BenchFilm, BenchOptions, Kind
from suites.detection import full_sphere_views

CASE = SHARED.parent / "cases" / "two_parts"
CLIPS = ("bracket_plate", "plate")
FILMS: tuple[tuple[Kind, int], ...] = (
    ("covered", 5), ("covered", 15), ("covered", 40), ("taken away", 15), ("out of view", 15),
)  # fmt: skip
"""What happens to the followed specimen of a bench, and for how many frames."""
NEAR = 0.3
"""Distance of a pose's centre from the true one, in diameters, up to which it lies on a specimen."""
MAX_BACK_S = 1.0


@dataclass
class TwoSpecimens:
    """What the labels of a film with two specimens did, in frames.

    Attributes:
        name: of the film.
        right, other, astray: labels shown on the followed specimen, on the other one, on neither.
        withheld: a pose, but no labels.
        without_pose: nothing was tracked.
        other_frames: the frames of ``other``.
        on_other: poses on the other specimen, with labels or without.
    """

    name: str
    right: int = 0
    other: int = 0
    astray: int = 0
    withheld: int = 0
    without_pose: int = 0
    on_other: int = 0
    other_frames: list[int] = field(default_factory=list)

    def add(self, pose: Pose, views: GuideViewSet, truth: tuple[Array, ...], is_there: bool) -> None:
        """Take a frame into account; the first of the true poses (4,4) is that of the followed specimen."""
        if pose.cam_from_model is None:
            self.without_pose += 1
            return
        center = apply(pose.cam_from_model, views.center_in_model)
        away = [float(np.linalg.norm(apply(one, views.center_in_model) - center)) for one in truth]
        is_near = [one <= NEAR * views.diameter_mm for one in away]
        self.on_other += is_near[1]
        if pose.is_label_withheld:
            self.withheld += 1
        elif is_near[1]:
            self.other += 1
            self.other_frames.append(pose.index)
        elif is_near[0] and is_there:
            self.right += 1
        else:
            self.astray += 1

    @property
    def row(self) -> ResultRow:
        """Row of the table; a film without a single right label shows nothing."""
        text = f"{self.other} frames with labels on the other specimen, {self.right} right, {self.astray} on neither, "
        text += f"{self.withheld} withheld, {self.without_pose} without a pose; {self.on_other} poses on the other"
        is_reached = self.other == 0 and self.right > 0
        return ResultRow("identity, two in view", self.name, text, "0 on the other", is_reached)


@dataclass
class OneSpecimen:
    """How soon labels are shown after each lock where one specimen is in view.

    Attributes:
        name: of the film.
        hz: frames per second.
        locks: how often the part was found.
        longest_s: longest time from a lock to the first frame with labels.
        withheld: frames with a pose and without labels.
        reasons: why, with the number of frames.
    """

    name: str
    hz: float
    locks: int = 0
    longest_s: float = 0.0
    withheld: int = 0
    reasons: dict[str, int] = field(default_factory=dict)
    _had_pose: bool = False
    _since: int | None = None

    def add(self, pose: Pose, number: int) -> None:
        """Take the next frame into account."""
        if pose.cam_from_model is None:
            self._had_pose, self._since = False, None
            return
        if not self._had_pose and pose.state is TrackingState.TRACKED:
            self._had_pose, self._since = True, number
            self.locks += 1
        if pose.is_label_withheld:
            self.withheld += 1
            self.reasons[pose.identity_reason] = self.reasons.get(pose.identity_reason, 0) + 1
        if self._since is not None:
            self.longest_s = max(self.longest_s, (number - self._since) / self.hz)
            self._since = self._since if pose.is_label_withheld else None

    @property
    def row(self) -> ResultRow:
        """Row of the table."""
        why = "; ".join(f"{reason} {count}" for reason, count in self.reasons.items())
        text = f"{self.locks} locks, labels after at most {self.longest_s:.2f} s, {self.withheld} frames withheld"
        text += f" ({why})" if why else ""
        is_reached = self.locks > 0 and self.longest_s <= MAX_BACK_S and self.withheld == 0
        return ResultRow("identity, one in view", self.name, text, "≤ 1 s after each lock, 0 withheld", is_reached)


class IdentitySuite:
    """The section ``identity`` of the evaluation.

    Args:
        recorded: scenes by name.
        details: for evaluation.json.
        two_parts: folder of a film of two specimens of the castle; None: made by its script where that is here.
        work: folder for what that script makes.
        frames: at most so many of each recording; None: all.
        backgrounds: folder of photos, or None for the default.
    """

    def __init__(
        self,
        recorded: dict[str, Scene],
        details: dict[str, Any],
        two_parts: Path | None,
        work: Path,
        frames: int | None = None,
        backgrounds: Path | None = None,
    ) -> None:
        self._recorded, self._details, self._frames = recorded, details, frames
        self._two_parts, self._work, self._backgrounds = two_parts, work / "two_parts", backgrounds

    def rows(self) -> list[ResultRow]:
        """All rows of the section."""
        return [*self.castle_rows(), *self.bench_rows(), *self.one_rows()]

    def castle_rows(self) -> list[ResultRow]:
        """Two castles in one picture, of which the left one is blurred for ten frames."""
        folder = self._two_parts or made_two_parts(self._work)
        if folder is None or "castle" not in self._recorded:
            skip("two_parts", f"neither a folder nor {CASE / 'make.py'} and the castle are here")
            return []
        scene = self._recorded["castle"]
        truth = [tuple(np.array(pose) for pose in frame) for frame in json.loads((folder / "truth.json").read_text())]
        images = (one.image for one in open_source(folder / "frames"))
        camera = camera_of(folder / "camera.json")
        distances = [float(np.linalg.norm(pose[:3, 3])) for frame in truth for pose in frame]
        views = full_sphere_views(scene.part.model, (min(distances), max(distances)))
        session = SpecimenTracking(views, camera, scene.part.model, initial_cam_from_model=truth[0][0])
        found = follow_two("two castles", session, images, truth, [True] * len(truth))
        self._details["identity-two_parts"] = asdict(found)
        return [found.row]

    def bench_rows(self) -> list[ResultRow]:
        """Films of a bench with two specimens, rendered."""
        photos = background_photos(self._backgrounds)
        results = []
        for name, model in watched(list(bench_models()), "identity"):
            for kind, hidden in FILMS:
                film = BenchFilm(model, photos, BenchOptions(kind, hidden))
                distances = [float(np.linalg.norm(apply(pose[0], model.center_in_model))) for pose in film.truth]
                views = full_sphere_views(model, (0.8 * min(distances), 1.25 * max(distances)))
                session = SpecimenTracking(views, CAMERA, model, initial_cam_from_model=film.truth[0][0])
                title = f"{name}, {kind} for {hidden} frames"
                results.append(follow_two(title, session, film.images(), film.truth, film.is_there))
        self._details["identity-bench"] = [asdict(one) for one in results]
        return [one.row for one in results]

    def one_rows(self) -> list[ResultRow]:
        """Recordings and sample clips, as they are and hidden twice for ten frames, from detection."""
        results = []
        for is_hidden in (False, True):
            for name, session, images, hz in watched(list(self._alone()), "one in view"):
                found = OneSpecimen(f"{name}, hidden twice" if is_hidden else name, hz)
                count = len(images)
                for number, image in enumerate(images):
                    is_gone = is_hidden and any(0 <= number - int(share * count) < 10 for share in (0.33, 0.66))
                    shown = cv2.GaussianBlur(image, (0, 0), 25.0) if is_gone else image
                    found.add(session.process(np.asarray(shown), number, number / hz), number)
                results.append(found)
        self._details["identity-one"] = [asdict(one) for one in results]
        return [one.row for one in results]

    def _alone(self) -> Iterator[tuple[str, SpecimenTracking, Frames, float]]:
        """Name, session, frames and rate of the films in which one specimen is in view."""
        for name, scene in self._recorded.items():
            distances = [float(np.linalg.norm(pose[:3, 3])) for pose in scene.poses]
            views = full_sphere_views(scene.part.model, (min(distances), max(distances)))
            session = SpecimenTracking(views, scene.camera, scene.part.model)
            yield name, session, Frames(scene, self._frames), FILM_HZ
        for name in CLIPS:
            clip = ROOT / "samples" / name / "clip.mp4"
            if clip.is_file():
                part, frames = load_part(clip.parent / "part.toml"), Frames(clip, self._frames)
                first = next(iter(frames))
                camera = load_camera(str(clip.parent / "camera.json"), first.shape[1], first.shape[0])
                views = cached_guide_views(part.model, part.effective_view_range)
                yield f"sample {name}", SpecimenTracking(views, camera, part.model), frames, FILM_HZ


class Frames:
    """Frames of a scene or film, read one by one each time."""

    def __init__(self, source: Scene | Path, limit: int | None) -> None:
        self._source = source
        count = len(source.frames) if isinstance(source, Scene) else sum(1 for _ in open_source(source))
        self._count = count if limit is None else min(limit, count)

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[Image]:
        if isinstance(self._source, Scene):
            for frame in self._source.frames[: self._count]:
                yield self._source.image(frame)
        else:
            for shown in open_source(self._source, end=self._count):
                yield shown.image


def bench_models() -> Iterator[tuple[str, Model]]:
    """Parts that lie on the bench."""
    yield "assembly", shape("assembly")
    yield "random_401", random_solid(401)
    yield "bracket", load_part(ROOT / "samples" / "bracket_plate" / "part.toml").model


def follow_two(
    name: str,
    session: SpecimenTracking,
    images: Iterable[Image],
    truth: list[tuple[Array, ...]],
    is_there: list[bool],
) -> TwoSpecimens:
    """Follow the first specimen of a film."""
    found = TwoSpecimens(name)
    for k, (image, poses, there) in enumerate(zip(images, truth, is_there, strict=True)):
        found.add(session.process(image, k, k / FILM_HZ), session.views, poses, there)
    return found


def made_two_parts(folder: Path) -> Path | None:
    """The folder of the two castles, made by its script; None where the script is not here."""
    if (CASE / "make.py").is_file() and not (folder / "truth.json").is_file():
        folder.mkdir(parents=True, exist_ok=True)
        subprocess.run([sys.executable, str(CASE / "make.py"), str(folder.resolve())], cwd=ROOT, check=True)
    return folder if (folder / "truth.json").is_file() else None


def camera_of(path: Path) -> Camera:
    """The camera of a file of width, height, fx, fy, cx, cy."""
    return Camera(**json.loads(path.read_text(encoding="utf-8")))
