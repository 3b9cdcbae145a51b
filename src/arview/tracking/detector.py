"""Detector: finds the part in a single frame from its guide views, with no pose to start from.

Coarse to fine: templates over all directions, rolls, distances and places, improved as outlines in the picture
(`first_search`); pattern search around the best on response maps of growing resolution (`climb`); the tracker's edges
and colours from the best of those; and the same evidence as for a tracked pose. At each level fewer hypotheses are
left and each costs more; which ones, the `judge` says. A quick search comes first; what it does not settle is looked
for among many more matches.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from arview.cad.model import Model
from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array, are_near, exp_so3, rigid
from arview.guideviews import GuideViewSet
from arview.guideviews.sphere import icosphere_directions
from arview.tracking.ambiguity import LEAD, TELLING, find_symmetries, telling
from arview.tracking.climb import climb
from arview.tracking.components import ComponentCheck
from arview.tracking.first_search import QUICK, WIDE, Candidate, Effort, FirstSearch, weighed
from arview.tracking.judge import FINE, judge
from arview.tracking.line_network import LineNetwork, line_support
from arview.tracking.picture import Picture
from arview.tracking.quality import (
    EVIDENCE_WEIGHT,
    FOUND_LINES,
    RIGHT_WORTH,
    VERIFIED_EVIDENCE,
    VERIFIED_JUDGEMENT,
    VERIFIED_LINES,
    Evidence,
    Leads,
    found_logit,
    found_probability,
)
from arview.tracking.templates import choose_apart
from arview.tracking.threads import pool
from arview.tracking.tracker import NEAR_STAGES, Stage, Tracker, TrackerOptions
from arview.tracking.verifier import Verifier
from arview.tracking.why_not import Rejected


def _coarse_stages(region_gain: float) -> tuple[Stage, ...]:
    return (
        Stage(6, 12, 2.0, 10.0, 2, region_gain, 2),
        Stage(4, 12, 2.0, 7.0, 2, region_gain, 2),
        Stage(4, 12, 1.5, 5.0, 2, region_gain, 2),
        Stage(3, 10, 1.0, 3.5, 2, region_gain, 2),
    )


COARSE_STAGES = (_coarse_stages(1.0), _coarse_stages(20.0))
"""Tries from the likeliest starts: edges lead; colours lead, on plain and glossy parts."""
TRIED = 16
"""So many starts are tried."""
COPY_DEG = 5.0
"""Refined poses this near to each other are copies of one."""
HOPELESS_WORTH = 0.35
"""A pose worth less is not searched around: the part is not there."""
SURE_QUALITY = 0.75
"""So much is wanted of a quick search alone: with few rivals looked at, a lead says less. Of 450 semi-synthetic frames
it is right in 9 and wrong in 6 of those in which it ends at 0.5 to 0.7."""
VERIFIED = 5
"""So many refined poses the verifier looks at: in 535 pictures in which it puts a right one first that was among the
best four before."""
ALIKE_ASIDE, ALIKE_ALONG, ALIKE_DEG = 0.12, 0.15, 20.0
"""Hypotheses this near, across in diameters and along as a share of the distance, are no rivals of each other."""
LEAD_TELLS = 0.4
"""A lead of 1 counts so much beside what edges tell of twins: of 56 semi-synthetic frames with twins the right one is
ahead of all in 45 with it, in 40 without; of 25 pictures of near-symmetric random solids in 7 and 3."""
HERE_ASIDE, HERE_ALONG = 0.35, 0.25
"""Rivals this near are at the same place."""
CLIMBED_WORTH = 12.0
"""A weighed response of 1 more after the pattern search is worth as much of what the judge says: in pictures of random
solids a right pose is among the first ten of its end in 75 with it, in 71 without, of 88 that have one at all."""
BEFORE_WORTH = 0.5
"""So much counts what spoke for a pose before: what fits by chance fits at one level. In 59 semi-synthetic frames with
something in the way the right pose is among the first forty of a level in 52 with it, in 48 without."""
COARSE_TOLERANCE_PX, FINE_TOLERANCE_PX = 3.5, 1.5
"""After the coarse and the fine stages edges are looked for this near."""
FINE_STAGES = (
    (
        Stage(2, 12, 1.5, 5.0, 2),
        Stage(2, 10, 1.0, 4.0, 2),
        Stage(1, 8, 1.0, 2.5, 2),
        Stage(1, 6, 1.0, 1.5, 2),
        Stage(1, 5, 1.0, 1.0, 2),
    ),
    NEAR_STAGES,
)
"""Both ways are gone: edges and colours; near edges alone, for what hides a part of the outline pulls the colours."""
LAST_STAGE = FINE_STAGES[0][-1:]
LARGEST_LOSS = 3.0
"""Shading may cost so much of what outline and edges say of a pose."""


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
class DetectorOptions:
    """Options of the detector.

    Attributes:
        radius_px: half the part's diameter in the templates.
        roll_step_deg: spacing of the templates.
        subdivisions: icosahedron level of the template directions (2: 162, about 17° apart).
        efforts: of the searches, each made if those before it did not settle the matter.
        levels: of the pattern search.
        finalists: how many of its results are refined to the end.
        rivals: how many more, for quite other poses.
        min_in_picture: less of the outline inside the picture is no detection.
        min_quality: a weaker result is no detection.
    """

    radius_px: float = 20.0
    roll_step_deg: float = 18.0
    subdivisions: int = 2
    efforts: tuple[Effort, ...] = (QUICK, WIDE)
    levels: tuple[Level, ...] = LEVELS
    finalists: int = 5
    rivals: int = 3
    min_quality: float = 0.5
    min_in_picture: float = 0.4

    def __post_init__(self) -> None:
        if not 10 <= self.radius_px <= 60:
            raise InputError(f"detector: radius_px = {self.radius_px}, expected 10 to 60")


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
        mismatches: components that are not seen where expected, see `Pose.mismatches`; empty without a model.
        alternatives: other poses (4,4) that the picture bears out as well; not empty: the view is ambiguous.
    """

    cam_from_model: Array
    quality: float
    mismatches: tuple[str, ...] = ()
    alternatives: tuple[Array, ...] = ()


@dataclass(frozen=True)
class Hypothesis:
    """A refined pose about the model's centre, and what speaks for it.

    Attributes:
        cam_from_body: (4,4).
        evidence: of it.
        judgement: of the networks for refined poses, see `judge`.
        verification: of the `verifier`, once it has looked at it.
        line_support: what the line network sees along its lines, see there; once verified.
        lines: distinct lines that its view shows.
        radius_px: half the part's diameter in the picture.
    """

    cam_from_body: Array
    evidence: Evidence
    judgement: float
    lines: float
    radius_px: float
    verification: float | None = None
    line_support: float = 0.0

    @property
    def own_logit(self) -> float:
        """By the evidence alone, see `found_logit`."""
        return found_logit(self.evidence, self.lines, self.radius_px)

    @property
    def seen(self) -> float:
        """What verifier and line network say of it, once verified: for `found_probability`."""
        return (self.verification or 0.0) + FOUND_LINES * self.line_support

    @property
    def logit(self) -> float:
        """For comparing the hypotheses of one picture, either all verified or none."""
        if self.verification is not None:
            others = VERIFIED_EVIDENCE * self.own_logit + VERIFIED_JUDGEMENT * self.judgement
            return self.verification + others + VERIFIED_LINES * self.line_support
        return EVIDENCE_WEIGHT * self.own_logit + self.judgement


class Detector:
    """Detection of one part with one camera over the declared range of its guide views.

    With the ``model`` too, detections say which components are not where expected. ``best_rejected`` is the best
    hypothesis of the last frame when nothing was found, for `why_not`. ``same_turns`` (N,3,3) are those that take the
    part onto itself, with none at all; ``turns`` those that nearly do, too.
    """

    def __init__(
        self, views: GuideViewSet, camera: Camera, options: DetectorOptions | None = None, model: Model | None = None
    ) -> None:
        self.options = o = options or options_for(views)
        self.views = views
        self.camera = camera
        self.best_rejected: Rejected | None = None
        self.tracker = Tracker(views, camera, TrackerOptions(use_feature=False))
        self._line_network = LineNetwork()
        self._verifier = Verifier(self.tracker.part)
        self._components = ComponentCheck(views, model, camera) if model and len(model.components) > 1 else None
        self.symmetries = find_symmetries(views)
        self.same_turns = np.concatenate([np.eye(3)[None], self.symmetries.exact])
        self.turns = np.concatenate([self.same_turns, self.symmetries.near])
        self.search = FirstSearch(
            views, self.tracker.part, camera, o.radius_px, o.roll_step_deg, o.subdivisions, self.symmetries.exact
        )

    def detect(self, image: NDArray[np.uint8], max_results: int = 3, is_thorough: bool = True) -> list[Detection]:
        """Poses of the part in a frame, best first; an empty list when it is not found.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            max_results: at most so many, all above the quality threshold and apart from each other.
            is_thorough: search on among less likely matches when the likeliest come to nothing.
        """
        picture = self.picture(image)
        least = self.options.min_quality if is_thorough else max(SURE_QUALITY, self.options.min_quality)
        return self._found(picture, self.hypotheses(picture, is_thorough), max_results, least)

    def detect_near(self, image: NDArray[np.uint8], guesses: Sequence[Array]) -> list[Detection]:
        """The best pose (or none) that one of some rough poses (4,4) ``cam_from_model`` leads to."""
        picture = self.picture(image)
        starts = [Candidate(1.0, guess @ self.tracker.part.model_from_body) for guess in guesses]
        return self._found(picture, self.settled(picture, self.climbed(picture, starts)), 1, self.options.min_quality)

    def _found(self, picture: Picture, settled: list[Hypothesis], max_results: int, least: float) -> list[Detection]:
        """The hypotheses of at least a quality, best first."""
        qualities = self.qualities(settled)
        self.best_rejected = None
        if not settled or qualities[0] < least:
            if settled:
                best = settled[0]
                self.best_rejected = Rejected(self._in_model(best), best.evidence, qualities[0])
            return []
        best, twins = self._told_apart(picture, settled[0], settled[1:])
        found = [self._detection(picture, best, qualities[0], twins)]
        for hypothesis, quality in zip(settled[1:], qualities[1:], strict=True):
            is_apart = all(not self._is_equal(hypothesis, h, self.turns, 0.25) for h in (best, *twins))
            if quality >= least and is_apart:
                found.append(self._detection(picture, hypothesis, min(quality, qualities[0]), []))
        return sorted(found, key=lambda detection: -detection.quality)[:max_results]

    def _detection(
        self, picture: Picture, hypothesis: Hypothesis, quality: float, twins: list[Hypothesis]
    ) -> Detection:
        pose = self._in_model(hypothesis)
        mismatches = self._components.single_look(picture.image, pose) if self._components else ()
        return Detection(pose, quality, mismatches, tuple(map(self._in_model, twins)))

    def hypotheses(self, picture: Picture, is_thorough: bool = True) -> list[Hypothesis]:
        """All that came out of the search, right or wrong, apart from each other, best first."""
        settled: list[Hypothesis] = []
        least = max(SURE_QUALITY, self.options.min_quality)
        for effort in self.options.efforts if is_thorough else self.options.efforts[:1]:
            starts = self.climbed(picture, self.search.starts(picture, effort), effort)
            settled = self._ordered([*settled, *self.settled(picture, starts)], 5.0)
            if settled and self.qualities(settled)[0] >= least:
                break
        return settled

    def qualities(self, hypotheses: list[Hypothesis]) -> list[float]:
        """Probability that each of several hypotheses, best first, is right: see `found_probability`."""
        return [
            found_probability(h.seen, h.own_logit, h.judgement, self.leads(h, hypotheses[k + 1 :]))
            for k, h in enumerate(hypotheses)
        ]

    def leads(self, best: Hypothesis, others: list[Hypothesis]) -> Leads:
        """Leads of a hypothesis over others for other poses; one a little aside of it is the same, badly settled."""
        here = elsewhere = -math.inf
        place = best.cam_from_body[:3, 3]
        distance_mm = float(np.linalg.norm(place))
        for other in others:
            offset = other.cam_from_body[:3, 3] - place
            along_mm = abs(float(offset @ place)) / distance_mm
            aside = math.sqrt(max(float(offset @ offset) - along_mm**2, 0.0)) / self.views.diameter_mm
            is_alike = self._is_turned(best, other, self.turns, ALIKE_DEG)
            if aside < ALIKE_ASIDE and along_mm < ALIKE_ALONG * distance_mm and is_alike:
                continue
            if aside < HERE_ASIDE and along_mm < HERE_ALONG * distance_mm:
                here = max(here, other.logit)
            else:
                elsewhere = max(elsewhere, other.logit)
        return Leads(best.logit - here, best.logit - elsewhere)

    def _in_model(self, hypothesis: Hypothesis) -> Array:
        return np.asarray(hypothesis.cam_from_body @ self.tracker.part.body_from_model)

    def _told_apart(
        self, picture: Picture, best: Hypothesis, others: list[Hypothesis]
    ) -> tuple[Hypothesis, list[Hypothesis]]:
        """The pose that is borne out best among the near symmetries of one found, and those that do as well.

        What tells is the edges that only one of two twins has, and all that speaks for either. Those from which these
        do not part the best one are alternatives, unless an exact symmetry makes them the same pose.
        """
        pose = best.cam_from_body
        starts = [rigid(pose[:3, :3] @ turn, pose[:3, 3]) for turn in self.symmetries.near]
        reach_mm = 0.25 * self.views.diameter_mm
        rivals = [h for h in others if np.linalg.norm(h.cam_from_body[:3, 3] - pose[:3, 3]) < reach_mm]
        rivals = self._ordered([best, *self._verified(picture, self._finished(picture, starts)), *rivals], 5.0)
        first = rivals[0]
        near = [h for h in rivals[1:] if h.logit > first.logit - LEAD]
        rivals = [first, *(h for h in near if self._is_turned(h, first, self.turns, ALIKE_DEG))]
        seen = pool().map(lambda h: self.tracker.edge_steps(picture.gray, h.cam_from_body), rivals)
        steps = {id(h): one for h, one in zip(rivals, seen, strict=True)}

        def ahead(a: Hypothesis, b: Hypothesis) -> float:
            return telling(steps[id(a)], steps[id(b)]) + LEAD_TELLS * (a.logit - b.logit)

        best = first
        for rival in rivals[1:]:
            if ahead(rival, best) > 0.0:
                best = rival
        twins = [h for h in rivals if h is not best and ahead(best, h) < TELLING]
        return best, [h for h in twins if not self._is_turned(h, best, self.same_turns, ALIKE_DEG)]

    def _is_equal(self, a: Hypothesis, b: Hypothesis, turns: Array, reach: float = 0.08) -> bool:
        """Whether two are the same pose, by one of some turns (N,3,3); ``reach`` is in diameters."""
        apart_mm = np.linalg.norm(a.cam_from_body[:3, 3] - b.cam_from_body[:3, 3])
        return bool(apart_mm <= reach * self.views.diameter_mm) and self._is_turned(a, b, turns, 8.0)

    def _is_turned(self, a: Hypothesis, b: Hypothesis, turns: Array, angle_deg: float) -> bool:
        """Whether one of some turns (N,3,3) brings a rotation nearer to another than an angle."""
        cosine = 0.5 * (np.einsum("ij,nij->n", a.cam_from_body[:3, :3], b.cam_from_body[:3, :3] @ turns) - 1.0)
        return bool(np.any(cosine > np.cos(np.deg2rad(angle_deg))))

    def picture(self, image: NDArray[np.uint8]) -> Picture:
        """A frame (H,W,3) as the searches take it."""
        o = self.options
        return Picture(image, self.camera, round(0.6 * o.radius_px), self._line_network)

    def climbed(self, picture: Picture, starts: list[Candidate], effort: Effort = QUICK) -> list[Candidate]:
        """The likeliest hypotheses after all levels of the search from some starts, best first."""
        for level, kept in zip(self.options.levels, effort.kept, strict=True):
            starts = self._climb(picture, starts, level, kept)
        return starts

    def _climb(self, picture: Picture, candidates: list[Candidate], level: Level, kept: int) -> list[Candidate]:
        """The hypotheses after a pattern search around each, apart from each other, best first."""
        by_step: dict[int, list[Candidate]] = {}
        for candidate in candidates:
            distance_mm = float(np.linalg.norm(candidate.cam_from_body[:3, 3]))
            step = min(0, round(self.search.step_at(distance_mm, level.magnification)))
            by_step.setdefault(step, []).append(candidate)
        picture.make(list(by_step))
        jobs = []
        for step, group in by_step.items():
            size = max(2, -(-len(group) // 4))
            poses_of = np.stack([candidate.cam_from_body for candidate in group])
            jobs += [(step, poses_of[i : i + size]) for i in range(0, len(group), size)]

        def search(job: tuple[int, Array]) -> tuple[Array, Array]:
            maps, intrinsics = picture.maps(job[0])
            found: tuple[Array, Array] = climb(
                maps, self.tracker.part.arrays, job[1], intrinsics, 0.01 * self.views.diameter_mm,
                np.deg2rad(level.turn_step_deg), level.stretch_step, level.rounds, level.halvings, 2, 2,
                level.points, level.points,
            )  # fmt: skip
            return found

        found = [(np.empty(0), np.empty((0, 4, 4))), *pool().map(search, jobs)]
        responses, poses = (np.concatenate(parts) for parts in zip(*found, strict=True))
        before = np.array([candidate.score for group in by_step.values() for candidate in group])
        is_in_range = self.search.are_in_range(poses)
        responses, poses, before = responses[is_in_range], poses[is_in_range], before[is_in_range]
        if not len(poses):
            return []
        lines = np.array([self.view_lines(pose) for pose in poses])
        scores = judge(picture, self.tracker.part, poses, lines) + CLIMBED_WORTH * weighed(responses, lines)
        scores += BEFORE_WORTH * before
        order = np.argsort(-scores, kind="stable")
        scores, poses = scores[order], poses[order]
        reach = np.full(len(poses), 0.01 * level.apart_deg * self.views.diameter_mm) / poses[:, 2, 3]
        chosen = choose_apart(
            np.ascontiguousarray(poses[:, :3, :3]), np.ascontiguousarray(poses[:, :3, 3]), reach,
            np.cos(np.deg2rad(level.apart_deg)), 1.0 + 0.01 * level.apart_deg, kept,
        )  # fmt: skip
        return [Candidate(float(scores[i]), poses[i]) for i in chosen]

    def settled(self, picture: Picture, starts: list[Candidate]) -> list[Hypothesis]:
        """Refine starts, keep the best, search around them; apart from each other, best first."""
        o = self.options
        as_found = self._tried(picture, [start.cam_from_body for start in starts], ())
        likely = [h.cam_from_body for h in sorted(as_found, key=lambda h: -h.logit)[:TRIED]]
        tried = [h for stages in COARSE_STAGES for h in self._tried(picture, likely, stages)]
        refined = self._ordered([*as_found, *tried], 3.0)
        # Besides the best, some for quite other poses: the lead over these says whether the best stands out.
        others = [h for h in refined[o.finalists :] if not self._same(h.cam_from_body, refined[0].cam_from_body, 25.0)]
        coarse = refined[: o.finalists] + self._ordered(others, 15.0, o.rivals)
        finished = self._finished(picture, [found.cam_from_body for found in coarse])
        if finished and HOPELESS_WORTH <= finished[0].evidence.worth < RIGHT_WORTH:
            finished += self._finished(picture, _around(finished[0].cam_from_body, 0.05))
        return self._verified(picture, self._ordered(finished, 5.0, VERIFIED))

    def _verified(self, picture: Picture, found: list[Hypothesis]) -> list[Hypothesis]:
        """Refined poses after shading was heard, too, and the verifier has looked at them, best first."""
        if not found:
            return []
        if self.tracker.part.is_curved:
            found = self._shaded(picture, found)
        known = np.array([(h.own_logit, h.judgement, h.evidence.scatter_px) for h in found])
        scores = self._verifier.scores(picture, np.stack([h.cam_from_body for h in found]), known)
        seen, part, step_mm = picture.lines(), self.tracker.part.arrays, 0.01 * self.views.diameter_mm
        verified = []
        for h, score in zip(found, scores.tolist(), strict=True):
            support = float(line_support(seen.answers, part, h.cam_from_body, seen.intrinsics, step_mm))
            verified.append(replace(h, verification=score, line_support=support))
        return sorted(verified, key=lambda h: -h.logit)

    def _shaded(self, picture: Picture, found: list[Hypothesis]) -> list[Hypothesis]:
        """Refined poses after the shading of the surface was heard, too, unless the outline says no to it."""

        def shaded(h: Hypothesis) -> tuple[Array, tuple[Stage, ...]]:
            tracker = self.tracker
            look = tracker.fresh_appearance(picture.image, h.cam_from_body)
            pose, information = tracker.refine(picture.image, picture.gray, h.cam_from_body, LAST_STAGE, look)
            return tracker.shaded(picture.gray, pose, information)[0], ()

        after = self._refined(picture, list(pool().map(shaded, found)), FINE_TOLERANCE_PX)
        return [new if new.logit > old.logit - LARGEST_LOSS else old for old, new in zip(found, after, strict=True)]

    def _tried(self, picture: Picture, starts: Sequence[Array], stages: tuple[Stage, ...]) -> list[Hypothesis]:
        """Poses after some coarse stages from each start."""
        return self._refined(picture, [(start, stages) for start in starts], COARSE_TOLERANCE_PX)

    def _finished(self, picture: Picture, starts: Sequence[Array]) -> list[Hypothesis]:
        """Poses refined to the end, best first; those of which too little is in the picture are left out."""
        found = self._refined(picture, [(s, stages) for s in starts for stages in FINE_STAGES], FINE_TOLERANCE_PX)
        is_in_range = self.search.are_in_range(np.array([h.cam_from_body for h in found]).reshape(-1, 4, 4))
        low = self.options.min_in_picture
        kept = [h for h, is_ok in zip(found, is_in_range, strict=True) if is_ok and h.evidence.points_in_picture >= low]
        return self._ordered(kept, 0.0)

    def _refined(
        self, picture: Picture, ways: Sequence[tuple[Array, tuple[Stage, ...]]], tolerance_px: float
    ) -> list[Hypothesis]:
        """Where some stages lead from each of some starts."""

        def refine(way: tuple[Array, tuple[Stage, ...]]) -> tuple[Array, Evidence]:
            pose = self.tracker.refine_fresh(picture.image, picture.gray, *way)
            look = self.tracker.fresh_appearance(picture.image, pose)
            return pose, self.tracker.evidence(picture.image, picture.gray, pose, tolerance_px, look)

        refined = list(pool().map(refine, ways))
        poses = np.array([pose for pose, _ in refined]).reshape(-1, 4, 4)
        lines = np.array([self.view_lines(pose) for pose in poses])
        judgements = judge(picture, self.tracker.part, poses, lines, FINE)
        return [
            Hypothesis(pose, evidence, float(judgement), float(shown), self.tracker.radius_px(pose))
            for (pose, evidence), judgement, shown in zip(refined, judgements, lines, strict=True)
        ]

    def _ordered(self, found: Iterable[Hypothesis], apart_deg: float, most: int = 1000) -> list[Hypothesis]:
        """Best first, without those near a better one; of copies of one pose the evidence says which stays."""
        copies: list[list[Hypothesis]] = []
        for hypothesis in sorted(found, key=lambda h: -h.logit):
            near = [some for some in copies if self._same(hypothesis.cam_from_body, some[0].cam_from_body, apart_deg)]
            if near:
                near[0].append(hypothesis)
            elif len(copies) < most:
                copies.append([hypothesis])
        if apart_deg > COPY_DEG:
            return [some[0] for some in copies]
        chosen = [max(some, key=lambda h: h.own_logit) for some in copies]
        return sorted(chosen, key=lambda h: -h.logit)

    def view_lines(self, cam_from_body: Array) -> float:
        """Distinct lines of the view nearest to a pose."""
        ray = cam_from_body[:3, :3].T @ cam_from_body[:3, 3]
        outlines = self.search.outlines
        return float(outlines.lines[np.argmax(outlines.rotations[:, 2] @ ray)])

    def _same(self, a: Array, b: Array, angle_deg: float) -> bool:
        return are_near(a, b, 0.01 * angle_deg * self.views.diameter_mm, angle_deg)


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
