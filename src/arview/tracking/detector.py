"""Detector: finds the part in a single frame from its guide views, with no pose to start from.

Coarse to fine: templates over all directions, rolls, distances and places (`templates`); pattern search around the
best of them on response maps of growing resolution (`climb`); the tracker's edges and colours from the best of
those; and the same evidence as for a tracked pose. At each level fewer hypotheses are left and each costs more.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from functools import lru_cache
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array, exp_so3, rigid
from arview.guideviews import GuideViewSet
from arview.guideviews.sphere import icosphere_directions
from arview.guideviews.uniqueness import view_lines
from arview.tracking.ambiguity import LEAD, find_symmetries
from arview.tracking.climb import climb, climb_outlines
from arview.tracking.matching import response_maps
from arview.tracking.quality import RIGHT_WORTH, Evidence, found_logit, found_probability
from arview.tracking.templates import choose_apart, decimate, make_bank, make_outlines, match_templates
from arview.tracking.tracker import Stage, Tracker, TrackerOptions, intrinsics_of, smoothed
from arview.tracking.why_not import Rejected


def _coarse_stages(region_gain: float) -> tuple[Stage, ...]:
    return (
        Stage(6, 12, 2.0, 10.0, 2, region_gain, 2),
        Stage(4, 12, 2.0, 7.0, 2, region_gain, 2),
        Stage(4, 12, 1.5, 5.0, 2, region_gain, 2),
        Stage(3, 10, 1.0, 3.5, 2, region_gain, 2),
    )


COARSE_STAGES: tuple[tuple[Stage, ...], ...] = ((), _coarse_stages(1.0), _coarse_stages(20.0))
"""Tries from every start: it is near enough already; edges lead; colours lead, on plain and glossy parts."""
LOWEST_SCORE = 0.3
"""Template matches below this are noise."""
HOPELESS_WORTH = 0.35
"""A pose worth less is not searched around: the part is not there."""
SURE_QUALITY = 0.8
"""A pose of this quality ends the search."""
COARSE_TOLERANCE_PX, FINE_TOLERANCE_PX = 3.5, 1.5
"""After the coarse and the fine stages edges are looked for this near."""
FINE_STAGES = (
    Stage(2, 12, 1.5, 5.0, 2),
    Stage(2, 10, 1.0, 4.0, 2),
    Stage(1, 8, 1.0, 2.5, 2),
    Stage(1, 6, 1.0, 1.5, 2),
    Stage(1, 5, 1.0, 1.0, 2),
)


STEPS_PER_OCTAVE = 4
"""Scales at which response maps are made: the distances of the templates, shared by all levels of the search."""
IMPROVED_STEPS, IMPROVED_ROLL, IMPROVED_STRETCH, IMPROVED_SHIFT = 2, 0.16, 0.07, 2
CELL_PX, CELL_ROLL = 4.0, 0.33
SPREAD_PX = 1
"""How far edges may lie from where a pose has them, in pixels of the maps."""
LARGEST_SCALE = 1.5
"""The picture is not enlarged more than this."""


@dataclass(frozen=True)
class Level:
    """One level of the pattern search.

    Attributes:
        magnification: the part's size against that of the templates.
        turn_step_deg, stretch_step: first steps of rotations and of the distance as a share.
        rounds, halvings: see `climb`.
        apart_deg: no two hypotheses nearer than this are left.
        points: of outline and, as many, of design edges that are looked at.
    """

    magnification: float
    turn_step_deg: float
    stretch_step: float
    rounds: int
    halvings: int
    apart_deg: float
    points: int


LEVELS = (
    Level(2.6, 4.0, 0.04, 2, 0, 4.0, 64),
    Level(5.2, 2.0, 0.017, 2, 1, 2.5, 96),
)


@dataclass(frozen=True)
class Effort:
    """How far a search goes.

    Attributes:
        matches: of templates that are improved once as outlines; skipped: the best of them, which were tried before.
        improved: of these, how many are improved further.
        starts: of these, how many poses are searched around.
        kept: hypotheses left after each level of that search.
    """

    matches: int
    skipped: int
    improved: int
    starts: int
    kept: tuple[int, ...]


QUICK = Effort(2500, 0, 800, 40, (12, 5))
WIDE = Effort(20000, 2500, 6000, 200, (24, 8))
"""For clutter, in which thousands of wrong matches come before the right one."""


@dataclass(frozen=True)
class DetectorOptions:
    """Options of the detector.

    Attributes:
        radius_px: half the part's diameter in the templates.
        points: per template, a multiple of 4.
        roll_step_deg: spacing of the templates.
        subdivisions: icosahedron level of the template directions (2: 162, about 17° apart).
        grid_px: places looked at are so far apart.
        efforts: of the searches, each made if those before it did not settle the matter.
        levels: of the pattern search.
        finalists: how many of its results are refined to the end.
        rivals: how many more, for quite other poses.
        min_in_picture: less of the outline inside the picture is no detection.
        min_quality: a weaker result is no detection.
    """

    radius_px: float = 20.0
    points: int = 64
    roll_step_deg: float = 18.0
    subdivisions: int = 2
    grid_px: int = 4
    efforts: tuple[Effort, ...] = (QUICK, WIDE)
    levels: tuple[Level, ...] = LEVELS
    finalists: int = 5
    rivals: int = 3
    min_quality: float = 0.5
    min_in_picture: float = 0.4

    def __post_init__(self) -> None:
        if not 10 <= self.radius_px <= 60:
            raise InputError(f"detector: radius_px = {self.radius_px}, expected 10 to 60")
        if self.points < 20 or self.points % 4:
            raise InputError(f"detector: points = {self.points}, expected a multiple of 4 from 20 on")


NARROW_DETAIL = DetectorOptions(radius_px=26.0, roll_step_deg=12.0, subdivisions=3)
"""Finer templates, for ranges in which they are few."""
FEW_TEMPLATES = 1500


def options_for(views: GuideViewSet) -> DetectorOptions:
    """The options that suit the declared range."""
    fine = NARROW_DETAIL
    directions = views.view_range.contains_direction(icosphere_directions(fine.subdivisions), 3.0)
    count = np.count_nonzero(directions) * len(views.view_range.rolls_deg(fine.roll_step_deg))
    return fine if count <= FEW_TEMPLATES else DetectorOptions()


@dataclass(frozen=True)
class Detection:
    """A place where the part was found.

    Attributes:
        cam_from_model: (4,4) mm.
        quality: 0–1, probability that the pose is right.
        mismatches: components that are not seen where expected, see `Pose.mismatches`.
        alternatives: other poses (4,4) that the picture bears out as well; not empty: the view is ambiguous.
    """

    cam_from_model: Array
    quality: float
    mismatches: tuple[str, ...] = ()
    alternatives: tuple[Array, ...] = ()


@dataclass(frozen=True)
class Candidate:
    """A hypothesis: score for comparing, and the pose it stands for, about the model's centre."""

    score: float
    cam_from_body: Array


@dataclass(frozen=True)
class Hypothesis:
    """A refined pose about the model's centre, its evidence, and the distinct lines that its view shows."""

    cam_from_body: Array
    evidence: Evidence
    lines: float

    @property
    def logit(self) -> float:
        """For comparing the hypotheses of one picture, see `found_logit`."""
        return found_logit(self.evidence, self.lines)


@dataclass(frozen=True)
class Matches:
    """Matches of outlines in the picture: keys (M,) by which they compare, scale steps (M,), views (M,) of the
    outlines, rolls (M,) rad, half diameters (M,) px and places (M,2) px of the part's centre, both at that scale."""

    keys: Array
    steps: NDArray[np.int64]
    views: NDArray[np.int32]
    rolls: Array
    radii_px: Array
    places: Array

    def best(self, most: int) -> Matches:
        return self.of(np.argsort(-self.keys, kind="stable")[:most])

    def of(self, index: NDArray[np.intp]) -> Matches:
        return Matches(*(getattr(self, field.name)[index] for field in fields(self)))


def _joined(parts: list[Matches]) -> Matches:
    return Matches(*(np.concatenate([getattr(p, field.name) for p in parts]) for field in fields(Matches)))


class _Picture:
    """A frame with what was made from it: response maps by scale, kept until the frame is done with."""

    def __init__(self, image: NDArray[np.uint8], camera: Camera, pad_px: int) -> None:
        self.image = image
        self.gray = smoothed(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        self.pad_px = pad_px
        self._camera = camera
        self._maps: dict[int, tuple[NDArray[np.uint8], Array]] = {}

    def make(self, steps: Sequence[int]) -> None:
        """Make the maps of several scales at once."""
        missing = [step for step in dict.fromkeys(steps) if step not in self._maps]
        self._maps.update(zip(missing, _pool().map(self._make, sorted(missing, reverse=True)), strict=True))

    def maps(self, step: int) -> tuple[NDArray[np.uint8], Array]:
        """Response maps (8,H,W) at a scale, padded, and the intrinsics (10,) that belong to them."""
        if step not in self._maps:
            self._maps[step] = self._make(step)
        return self._maps[step]

    def _make(self, step: int) -> tuple[NDArray[np.uint8], Array]:
        camera = self._camera
        scale = 2.0 ** (step / STEPS_PER_OCTAVE)
        width, height = max(8, round(camera.width * scale)), max(8, round(camera.height * scale))
        # Edges are found at twice the resolution as long as the picture has it.
        pool = 2 if scale <= 0.5 else 1
        way = cv2.INTER_AREA if pool * scale < 0.6 else cv2.INTER_LINEAR
        size = (pool * width, pool * height)
        image = self.image if size == (camera.width, camera.height) else cv2.resize(self.image, size, interpolation=way)
        intrinsics = intrinsics_of(camera.scaled(width, height))
        intrinsics[2:4] += self.pad_px
        return response_maps(np.asarray(image), SPREAD_PX, self.pad_px, pool), intrinsics


class Detector:
    """Detection of one part with one camera over the declared range of its guide views.

    ``best_rejected`` is the best hypothesis of the last frame when nothing was found, for `why_not`.
    """

    def __init__(self, views: GuideViewSet, camera: Camera, options: DetectorOptions | None = None) -> None:
        self.options = o = options or options_for(views)
        self.views = views
        self.camera = camera
        self.best_rejected: Rejected | None = None
        self.tracker = Tracker(views, camera, TrackerOptions(use_feature=False))
        self.outlines = make_outlines(views, self.tracker.part.model_from_body, o.points, max(3, o.subdivisions))
        self._clusters = np.argmax(self.outlines.rotations[:, 2] @ icosphere_directions(1).T, axis=1)
        self.symmetries = find_symmetries(views)
        self._turns = np.concatenate([self.symmetries.exact, self.symmetries.near])
        self._focal = 0.5 * (camera.fx + camera.fy)
        # Scale steps of the templates, large distances (large pictures) first.
        low, high = views.view_range.distance_mm
        near, far = self._step_at(low), self._step_at(high)
        top = int(np.floor(STEPS_PER_OCTAVE * np.log2(LARGEST_SCALE)))
        self._steps = [s for s in range(int(np.floor(far + 0.4)), int(np.ceil(near - 0.4)) - 1, -1) if s <= top]
        self.banks = {
            step: make_bank(
                views, self.outlines, o.radius_px, o.radius_px / (self._focal * 2.0 ** (step / STEPS_PER_OCTAVE)),
                o.roll_step_deg, o.subdivisions,
            )
            for step in self._steps
        }  # fmt: skip
        self._lines: dict[int, float] = {}

    def _step_at(self, distance_mm: float, magnification: float = 1.0) -> float:
        """Scale step at which the part at a distance has the size of the templates, times the magnification."""
        radius_px = self._focal * 0.5 * self.views.diameter_mm / distance_mm
        return STEPS_PER_OCTAVE * float(np.log2(magnification * self.options.radius_px / radius_px))

    def detect(
        self,
        image: NDArray[np.uint8],
        max_results: int = 3,
        is_thorough: bool = True,
        guesses: Sequence[Array] = (),
    ) -> list[Detection]:
        """Poses of the part in a frame, best first; an empty list when it is not found.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            max_results: at most so many, all above the quality threshold and apart from each other.
            is_thorough: search on among less likely matches when the likeliest come to nothing.
            guesses: rough poses (4,4) ``cam_from_model`` that are tried first, and alone if one settles the matter.
        """
        picture = self._picture(image)
        settled = self.hypotheses(picture, is_thorough, guesses)
        qualities = self.qualities(settled)
        self.best_rejected = None
        if not settled or qualities[0] < self.options.min_quality:
            if settled:
                best = settled[0]
                self.best_rejected = Rejected(self._in_model(best), best.evidence, qualities[0])
            return []
        best, twins = self._told_apart(picture, settled[0], settled[1:])
        found = [Detection(self._in_model(best), qualities[0], alternatives=tuple(map(self._in_model, twins)))]
        for hypothesis, quality in zip(settled[1:], qualities[1:], strict=True):
            is_apart = all(not self._is_equal(hypothesis, h, self._turns, 0.25) for h in (best, *twins))
            if quality >= self.options.min_quality and is_apart:
                found.append(Detection(self._in_model(hypothesis), quality))
        return found[:max_results]

    def hypotheses(
        self, picture: _Picture, is_thorough: bool = True, guesses: Sequence[Array] = ()
    ) -> list[Hypothesis]:
        """All that came out of the search, right or wrong, apart from each other, best first."""
        settled: list[Hypothesis] = []
        if guesses:
            known = [Candidate(1.0, guess @ self.tracker.part.model_from_body) for guess in guesses]
            settled = self._settle(picture, self.climbed(picture, known))
            if settled and self.qualities(settled)[0] >= SURE_QUALITY:
                return settled
        for effort in self.options.efforts if is_thorough else self.options.efforts[:1]:
            starts = self.climbed(picture, self.starts(picture, effort), effort)
            settled = self._ordered([*settled, *self._settle(picture, starts)], 5.0)
            if settled and self.qualities(settled)[0] >= SURE_QUALITY:
                break
        return settled

    def qualities(self, hypotheses: list[Hypothesis]) -> list[float]:
        """Probability that each of several hypotheses, best first, is right: see `found_probability`."""
        result = []
        for k, hypothesis in enumerate(hypotheses):
            rivals = (h.logit for h in hypotheses[k + 1 :] if not self._is_equal(hypothesis, h, self._turns))
            margin = hypothesis.logit - max(rivals, default=-math.inf)
            result.append(found_probability(hypothesis.evidence, hypothesis.lines, margin))
        return result

    def _in_model(self, hypothesis: Hypothesis) -> Array:
        return np.asarray(hypothesis.cam_from_body @ self.tracker.part.body_from_model)

    def _told_apart(
        self, picture: _Picture, best: Hypothesis, others: list[Hypothesis]
    ) -> tuple[Hypothesis, list[Hypothesis]]:
        """The pose that is borne out best among the near symmetries of one found, and those that do as well.

        Hypotheses at the same place whose evidence is as good are alternatives too, unless an exact symmetry makes
        them the same pose.
        """
        pose = best.cam_from_body
        starts = [rigid(pose[:3, :3] @ turn, pose[:3, 3]) for turn in self.symmetries.near]
        reach_mm = 0.25 * self.views.diameter_mm
        rivals = [h for h in others if np.linalg.norm(h.cam_from_body[:3, 3] - pose[:3, 3]) < reach_mm]
        rivals = self._ordered([best, *self._finished(picture, starts), *rivals], 5.0)
        rivals.sort(key=lambda h: -h.evidence.worth)
        if best.evidence.worth < rivals[0].evidence.worth - LEAD:
            best = rivals[0]
        twins = [h for h in rivals if h is not best and h.evidence.worth > best.evidence.worth - LEAD]
        return best, [h for h in twins if not self._is_equal(h, best, self.symmetries.exact)]

    def _is_equal(self, a: Hypothesis, b: Hypothesis, turns: Array, reach: float = 0.08) -> bool:
        """Whether two are the same pose, if need be by one of some turns (N,3,3); ``reach`` is in diameters."""
        if np.linalg.norm(a.cam_from_body[:3, 3] - b.cam_from_body[:3, 3]) > reach * self.views.diameter_mm:
            return False
        turned = b.cam_from_body[:3, :3] @ np.concatenate([np.eye(3)[None], turns])
        cosine = 0.5 * (np.einsum("ij,nij->n", a.cam_from_body[:3, :3], turned) - 1.0)
        return bool(cosine.max() > np.cos(np.deg2rad(8.0)))

    def _picture(self, image: NDArray[np.uint8]) -> _Picture:
        o = self.options
        return _Picture(image, self.camera, round(0.6 * o.radius_px))

    def climbed(self, picture: _Picture, starts: list[Candidate], effort: Effort = QUICK) -> list[Candidate]:
        """The likeliest hypotheses after all levels of the search from some starts, best first."""
        for level, kept in zip(self.options.levels, effort.kept, strict=True):
            starts = self._climb(picture, starts, level, kept)
        return starts

    def starts(self, picture: _Picture, effort: Effort = QUICK) -> list[Candidate]:
        """The best template matches over the whole range, apart from each other, improved, best first."""
        picture.make(self._steps)
        count = len(next(iter(self.banks.values())).bins)
        halves = [0, count // 2, count]
        # Small pictures first: what is found there raises the bar for the large ones.
        votes = np.zeros(1024, dtype=np.int64)
        jobs = [(step, first, last) for step in reversed(self._steps) for first, last in pairwise(halves)]
        found = _pool().map(lambda job: self._match(picture, votes, effort.matches, *job), jobs)
        raw = [m for m in found if m is not None]
        if not raw:
            return []
        matches = self._distinct(_joined(raw), effort.matches, effort.skipped)
        if not len(matches.keys):
            return []
        matches = self._improved(picture, self._improved(picture, matches, 1).best(effort.improved), 2)
        matches = self._best_apart(matches, 6.0, 0.15, 1.06, effort.starts)
        return [Candidate(float(k), rigid(r, p)) for k, r, p in zip(matches.keys, *self._posed(matches), strict=True)]

    def _match(self, picture: _Picture, votes: NDArray[np.int64], kept: int, step: int, first: int, last: int) -> Matches | None:
        """The matches of some templates at one scale."""
        o = self.options
        bank = self.banks[step]
        maps, _ = picture.maps(step)
        if min(maps.shape[1:]) < 24 + 2 * picture.pad_px:
            return None
        keys, templates, places = match_templates(
            decimate(maps, o.grid_px), bank.offsets, bank.bins, bank.gains, first, last, kept, LOWEST_SCORE, votes
        )
        return Matches(
            keys, np.full(len(keys), step), bank.views[templates], bank.rolls[templates],
            np.full(len(keys), o.radius_px), places + bank.origins[templates] - picture.pad_px,
        )  # fmt: skip

    def _posed(self, matches: Matches) -> tuple[Array, Array]:
        """Rotations (M,3,3) and positions (M,3) mm of the part's centre."""
        scales = 2.0 ** (matches.steps / STEPS_PER_OCTAVE)
        rays = self.camera.unproject((matches.places + 0.5) / scales[:, None] - 0.5)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        distances_mm = self._focal * 0.5 * self.views.diameter_mm * scales / matches.radii_px
        c, s, zero = np.cos(matches.rolls), np.sin(matches.rolls), np.zeros(len(matches.rolls))
        turns = np.stack([c, -s, zero, s, c, zero, zero, zero, zero + 1.0], axis=1).reshape(-1, 3, 3)
        rotations = turns @ self.outlines.rotations[matches.views]
        return _turned_with_rays(rotations, rays), rays * distances_mm[:, None]

    def _best_apart(self, matches: Matches, reach_px: float, angle_rad: float, ratio: float, most: int) -> Matches:
        """The best, none near a better one."""
        matches = matches.of(np.argsort(-matches.keys, kind="stable"))
        rotations, positions = self._posed(matches)
        # Pixels of the templates' scale: as many times further off as the part is larger than there.
        reach = np.full(len(positions), reach_px / self.options.radius_px) * 0.5 * self.views.diameter_mm
        return matches.of(
            choose_apart(rotations, positions, reach / positions[:, 2], np.cos(angle_rad), ratio, most)
        )

    def _distinct(self, matches: Matches, most: int, skipped: int) -> Matches:
        """The best, one for each cell of places, scales and rotations, but the first."""
        matches = matches.best(len(matches.keys))
        cells = np.floor(matches.places / CELL_PX).astype(np.int64) + 4096
        rolls = np.floor(matches.rolls / CELL_ROLL).astype(np.int64) + 64
        code = ((cells[:, 0] * 8192 + cells[:, 1]) * 128 + rolls) * 1024 + self._clusters[matches.views]
        code = code * 128 + matches.steps + 64
        _, first = np.unique(code, return_index=True)
        return matches.of(np.sort(first)[skipped:most])

    def _improved(self, picture: _Picture, matches: Matches, rounds: int) -> Matches:
        shapes = self.outlines
        jobs = []
        for step in np.unique(matches.steps):
            group = np.flatnonzero(matches.steps == step)
            # Those that have been improved once lie on their maps.
            up = 0 if rounds > 1 else IMPROVED_STEPS
            jobs += [(min(0, step + up), part) for part in np.array_split(group, 2)]
        picture.make([step for step, _ in jobs])

        def improve(job: tuple[int, NDArray[np.intp]]) -> Matches:
            step, index = job
            some = matches.of(index)
            scale = 2.0 ** ((step - some.steps) / STEPS_PER_OCTAVE)
            maps, _ = picture.maps(step)
            places = (some.places + 0.5) * scale[:, None] - 0.5 + picture.pad_px
            scores, views, rolls, radii, places = climb_outlines(
                maps, shapes.points, shapes.angles, shapes.neighbours, shapes.turns, some.views, some.rolls,
                some.radii_px * scale, places, self._focal * 2.0 ** (step / STEPS_PER_OCTAVE), IMPROVED_ROLL, IMPROVED_STRETCH, rounds, 2, IMPROVED_SHIFT,
            )  # fmt: skip
            keys = scores * shapes.lines[views] ** 0.25
            return Matches(keys, np.full(len(keys), step), views, rolls, radii, places - picture.pad_px)

        return _joined(list(_pool().map(improve, jobs)))

    def _climb(self, picture: _Picture, candidates: list[Candidate], level: Level, kept: int) -> list[Candidate]:
        """The hypotheses after a pattern search around each, apart from each other, best first."""
        by_step: dict[int, list[Array]] = {}
        for candidate in candidates:
            distance_mm = float(np.linalg.norm(candidate.cam_from_body[:3, 3]))
            step = min(0, round(self._step_at(distance_mm, level.magnification)))
            by_step.setdefault(step, []).append(candidate.cam_from_body)
        picture.make(list(by_step))
        jobs = []
        for step, group in by_step.items():
            size = max(2, -(-len(group) // 4))
            jobs += [(step, np.stack(group[i : i + size])) for i in range(0, len(group), size)]

        def search(job: tuple[int, Array]) -> tuple[Array, Array]:
            maps, intrinsics = picture.maps(job[0])
            scores, poses = climb(
                maps, self.tracker.part.arrays, job[1], intrinsics, 0.01 * self.views.diameter_mm,
                np.deg2rad(level.turn_step_deg), level.stretch_step, level.rounds, level.halvings, 2, 2,
                level.points, level.points,
            )  # fmt: skip
            return scores, poses

        results = list(_pool().map(search, jobs))
        if not results:
            return []
        scores, poses = np.concatenate([r[0] for r in results]), np.concatenate([r[1] for r in results])
        scores = scores * np.array([self._view_lines(pose) for pose in poses]) ** 0.25
        order = np.argsort(-scores, kind="stable")
        scores, poses = scores[order], poses[order]
        reach = np.full(len(poses), 0.01 * level.apart_deg * self.views.diameter_mm) / poses[:, 2, 3]
        chosen = choose_apart(
            np.ascontiguousarray(poses[:, :3, :3]), np.ascontiguousarray(poses[:, :3, 3]), reach,
            np.cos(np.deg2rad(level.apart_deg)), 1.0 + 0.01 * level.apart_deg, kept,
        )  # fmt: skip
        return [Candidate(float(scores[i]), poses[i]) for i in chosen]

    def _settle(self, picture: _Picture, starts: list[Candidate]) -> list[Hypothesis]:
        """Refine starts, keep the best, search around them; apart from each other, best first."""
        o = self.options
        tries = [(start.cam_from_body, stages) for start in starts for stages in COARSE_STAGES]
        tried = _pool().map(lambda item: self._refined(picture, item[0], item[1], COARSE_TOLERANCE_PX), tries)
        refined = self._ordered(tried, 3.0)
        # Besides the best, some for quite other poses: the lead over these says whether the best stands out.
        others = [h for h in refined[o.finalists :] if not self._same(h.cam_from_body, refined[0].cam_from_body, 25.0)]
        coarse = refined[: o.finalists] + self._ordered(others, 15.0, o.rivals)
        finished = self._finished(picture, [found.cam_from_body for found in coarse])
        if finished and HOPELESS_WORTH <= finished[0].evidence.worth < RIGHT_WORTH:
            finished += self._finished(picture, _around(finished[0].cam_from_body, 0.05))
        return self._ordered(finished, 5.0)

    def _finished(self, picture: _Picture, starts: Sequence[Array]) -> list[Hypothesis]:
        """Poses refined to the end, best first; those of which too little is in the picture are left out."""
        found = _pool().map(lambda start: self._refined(picture, start, FINE_STAGES, FINE_TOLERANCE_PX), starts)
        low = self.options.min_in_picture
        return self._ordered((h for h in found if h.evidence.points_in_picture >= low and self._is_plausible(h)), 0.0)

    def _refined(self, picture: _Picture, start: Array, stages: tuple[Stage, ...], tolerance_px: float) -> Hypothesis:
        pose = self.tracker.refine_fresh(picture.image, picture.gray, start, stages)
        look = self.tracker.fresh_appearance(picture.image, pose)
        evidence = self.tracker.evidence(picture.image, picture.gray, pose, tolerance_px, look)
        return Hypothesis(pose, evidence, self._view_lines(pose))

    def _ordered(self, found: Iterable[Hypothesis], apart_deg: float, most: int = 1000) -> list[Hypothesis]:
        """Best first, without those near a better one."""
        result: list[Hypothesis] = []
        for hypothesis in sorted(found, key=lambda h: -h.logit):
            if len(result) >= most:
                break
            if not any(self._same(hypothesis.cam_from_body, other.cam_from_body, apart_deg) for other in result):
                result.append(hypothesis)
        return result

    def _view_lines(self, cam_from_body: Array) -> float:
        """Distinct lines of the view nearest to a pose."""
        index = self.tracker.part.nearest(cam_from_body)
        if index not in self._lines:
            self._lines[index] = max(view_lines(self.views.view(index), self.views.diameter_mm), 1.0)
        return self._lines[index]

    def _same(self, a: Array, b: Array, angle_deg: float = 5.0) -> bool:
        near = np.linalg.norm(a[:3, 3] - b[:3, 3]) < 0.01 * angle_deg * self.views.diameter_mm
        # cos of the angle between them from the trace: cheap, it is asked often.
        cosine = 0.5 * (float(np.sum(a[:3, :3] * b[:3, :3])) - 1.0)
        return bool(near and cosine > np.cos(np.deg2rad(angle_deg)))

    def _is_plausible(self, hypothesis: Hypothesis) -> bool:
        """Within a margin of the declared distances and in front of the camera."""
        low, high = self.views.view_range.distance_mm
        distance = float(np.linalg.norm(hypothesis.cam_from_body[:3, 3]))
        return bool(0.85 * low <= distance <= 1.18 * high and hypothesis.cam_from_body[2, 3] > 0)


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    """Threads for candidates: the kernels release the interpreter."""
    return ThreadPoolExecutor(max(1, min(4, os.cpu_count() or 1)), thread_name_prefix="detector")


def _turned_with_rays(rotations: Array, rays: Array) -> Array:
    """Rotations (N,3,3) of views seen along the optical axis, turned to be seen along unit rays (N,3)."""
    # The smallest rotation that takes +Z to the ray (Rodrigues with the axis z × ray).
    x, y, z = rays.T
    turn = np.empty((len(rays), 3, 3))
    k = 1.0 / (1.0 + z)
    turn[:, 0] = np.stack([1.0 - k * x * x, -k * x * y, x], axis=1)
    turn[:, 1] = np.stack([-k * x * y, 1.0 - k * y * y, y], axis=1)
    turn[:, 2] = np.stack([-x, -y, z], axis=1)
    return turn @ rotations


def _around(cam_from_body: Array, angle_rad: float) -> list[Array]:
    """Poses turned by an angle about 14 axes through the part's centre: the coordinate axes and the diagonals."""
    axes = [np.array(a, dtype=np.float64) for a in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]
    axes += [np.array([1.0, b, c]) for b in (-1, 1) for c in (-1, 1)]
    turned = []
    for axis in axes:
        for sign in (-1.0, 1.0):
            turn = exp_so3(axis / np.linalg.norm(axis) * sign * angle_rad)
            turned.append(rigid(turn @ cam_from_body[:3, :3], cam_from_body[:3, 3]))
    return turned
