"""Local search: what becomes of rough poses of a part in one picture, and how much speaks for each.

Coarse to fine: pattern search around them on response maps of growing resolution, the tracker's edges and
colours from the best of those, and the same evidence as for a tracked pose. At each level fewer hypotheses are left
and each costs more; which ones, the `judge` says, and of the last ones the `verifier`.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.core.parallel import pool
from arview.detection.confidence import appearance_score, confidence_weights, evidence_logit
from arview.detection.features.denoiser import Denoiser
from arview.detection.features.edge_net import EdgeNet, mean_edge_response
from arview.detection.features.image_pyramid import ImagePyramid, step_for
from arview.detection.scoring.contour_verifier import ContourVerifier
from arview.detection.scoring.pose_verifier import PoseVerifier
from arview.detection.scoring.profile_ranker import FINE, ProfileRanker
from arview.detection.search.global_search import QUICK, PoseCandidate, weighed
from arview.detection.search.pattern_search import search_poses
from arview.detection.search.template_bank import ViewLineCounts, select_distinct
from arview.geometry import Array, are_near, exp_so3, rigid
from arview.guideviews import GuideViewSet
from arview.refinement.evidence import DECISION_SCORE, PoseEvidence
from arview.refinement.refiner import PoseRefiner
from arview.refinement.schedules import NEAR_STAGES, SEARCH_STAGES, Stage
from arview.refinement.view_model import PartView


def _coarse_stages(region_gain: float) -> tuple[Stage, ...]:
    return (
        Stage(6, 12, 2.0, 10.0, 2, region_gain, 2),
        Stage(4, 12, 2.0, 7.0, 2, region_gain, 2),
        Stage(4, 12, 1.5, 5.0, 2, region_gain, 2),
        Stage(3, 10, 1.0, 3.5, 2, region_gain, 2),
    )


COARSE_STAGES = (_coarse_stages(1.0), _coarse_stages(20.0))
"""Tries from the likeliest starts: edges lead; colours lead, on plain and glossy parts."""
COPY_DEG = 5.0
"""Refined poses this near to each other are copies of one."""
HOPELESS_SCORE = 0.35
"""A pose worth less is not searched around: the part is not there."""
CLIMBED_WORTH = 12.0
"""A weighed response of 1 more after the pattern search is worth as much of what the judge says: in pictures of random
solids a right pose is among the first ten of its end in 75 with it, in 71 without, of 88 that have one at all."""
BEFORE_WORTH = 0.5
"""So much counts what spoke for a pose before: what fits by chance fits at one level. In 59 semi-synthetic frames with
something in the way the right pose is among the first forty of a level in 52 with it, in 48 without."""
COARSE_TOLERANCE_PX, FINE_TOLERANCE_PX = 3.5, 1.5
"""After the coarse and the fine stages edges are looked for this near."""
FINE_STAGES = (SEARCH_STAGES, NEAR_STAGES)
"""Both ways are gone: edges and colours; near edges alone, for what hides a part of the outline pulls the colours."""
LAST_STAGE = SEARCH_STAGES[-1:]
LARGEST_LOSS = 3.0
"""Shading may cost so much of what outline and edges say of a pose."""


@dataclass(frozen=True)
class Level:
    """One level of the pattern search.

    Attributes:
        magnification: the part's size against that of the templates.
        turn_step_deg, stretch_step: first steps of rotations and of the distance as a share.
        rounds, halvings: see `search_poses`.
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
class Hypothesis:
    """A refined pose about the model's centre, and what speaks for it.

    Attributes:
        cam_from_body: (4,4).
        evidence: of it.
        profile_score: of the networks for refined poses, see `judge`.
        verification: of the `verifier`, once it has looked at it.
        edge_response: what the line network sees along its lines, see there; once verified.
        contour_score: what the picture right across its outline says, see `ContourVerifier`; once verified.
        view_lines: distinct lines that its view shows.
        radius_px: half the part's diameter in the picture.
    """

    cam_from_body: Array
    evidence: PoseEvidence
    profile_score: float
    view_lines: float
    radius_px: float
    verifier_score: float | None = None
    edge_response: float = 0.0
    contour_score: float = 0.0

    @property
    def evidence_logit(self) -> float:
        """By the evidence alone, see `evidence_logit`."""
        return evidence_logit(self.evidence, self.view_lines, self.radius_px)

    @property
    def appearance_score(self) -> float:
        """What verifier and line network say of it, once verified: for `pose_probability`."""
        return appearance_score(self.verifier_score or 0.0, self.edge_response)

    @property
    def logit(self) -> float:
        """For comparing the hypotheses of one picture, either all verified or none."""
        if self.verifier_score is not None:
            return self.logit_without_contour + confidence_weights().verified.contour * self.contour_score
        return confidence_weights().unverified_evidence * self.evidence_logit + self.profile_score

    @property
    def logit_without_contour(self) -> float:
        """The same of a verified one, for comparing twins: their outlines are the same, what differs is chance."""
        weights = confidence_weights().verified
        others = weights.evidence * self.evidence_logit + weights.profile * self.profile_score
        return (self.verifier_score or 0.0) + others + weights.edge_response * self.edge_response


@dataclass(frozen=True)
class LocalSearchOptions:
    """Options of the local search.

    Attributes:
        radius_px: half the part's diameter in pictures of magnification 1.
        levels: of the pattern search.
        tried: so many of its results are refined from coarse stages on.
        finalists: how many of them are refined to the end.
        rivals: how many more, for quite other poses.
        verified: so many refined poses the verifier looks at: in 535 pictures in which it puts a right one first that
            was among the best four before.
        min_in_picture: poses with less of the outline inside the picture are left out.
    """

    radius_px: float = 20.0
    levels: tuple[Level, ...] = LEVELS
    tried: int = 16
    finalists: int = 5
    rivals: int = 3
    verified: int = 5
    min_in_picture: float = 0.4


class LocalSearch:
    """The search around rough poses of one part with one camera.

    Args:
        views: of the part.
        camera: of the pictures.
        options: see `LocalSearchOptions`.
        reach_mm: poses nearer or farther are left out.
    """

    def __init__(
        self,
        views: GuideViewSet,
        camera: Camera,
        options: LocalSearchOptions | None = None,
        reach_mm: tuple[float, float] = (0.0, math.inf),
    ) -> None:
        self.views = views
        self.camera = camera
        self.options = options or LocalSearchOptions()
        self.refiner = PoseRefiner(PartView(views), camera)
        self._reach_mm = reach_mm
        self._line_network = EdgeNet()
        self._denoiser = Denoiser()
        self._rough_ranker = ProfileRanker(self.refiner.part)
        self._fine_ranker = ProfileRanker(self.refiner.part, FINE)
        self._verifier = PoseVerifier(self.refiner.part)
        self._strips = ContourVerifier(self.refiner.part)
        self._shown_lines = ViewLineCounts(views)

    def pyramid(self, image: NDArray[np.uint8]) -> ImagePyramid:
        """A frame (H,W,3) as the searches take it: without the grain of noisy ones."""
        clean = self._denoiser.denoise(image)
        return ImagePyramid(clean, self.camera, round(0.6 * self.options.radius_px), self._line_network)

    def with_options(self, options: LocalSearchOptions) -> LocalSearch:
        """The same with other options and at any distance, beside which this one can be used: see `with_camera`."""
        other = copy.copy(self)
        other.options, other._reach_mm = options, (0.0, math.inf)
        return other

    def with_camera(self, camera: Camera) -> LocalSearch:
        """The same for pictures of another camera, such as that of a window."""
        other = copy.copy(self)
        other.camera, other.refiner = camera, self.refiner.with_camera(camera)
        return other

    def pattern_search(
        self, picture: ImagePyramid, starts: list[PoseCandidate], kept: tuple[int, ...] = QUICK.kept
    ) -> list[PoseCandidate]:
        """The likeliest hypotheses after all levels of the search from some starts, best first; so many of each."""
        for level, most in zip(self.options.levels, kept, strict=True):
            starts = self._climb(picture, starts, level, most)
        return starts

    def _climb(
        self, picture: ImagePyramid, candidates: list[PoseCandidate], level: Level, kept: int
    ) -> list[PoseCandidate]:
        """The hypotheses after a pattern search around each, apart from each other, best first."""
        by_step: dict[int, list[PoseCandidate]] = {}
        for candidate in candidates:
            radius_px = float(picture.radii_px(self.views.diameter_mm, candidate.cam_from_body[None])[0])
            step = min(0, round(step_for(radius_px, level.magnification * self.options.radius_px)))
            by_step.setdefault(step, []).append(candidate)
        picture.make_maps(list(by_step))
        jobs = []
        for step, group in by_step.items():
            size = max(2, -(-len(group) // 4))
            poses_of = np.stack([candidate.cam_from_body for candidate in group])
            jobs += [(step, poses_of[i : i + size]) for i in range(0, len(group), size)]

        def search(job: tuple[int, Array]) -> tuple[Array, Array]:
            maps, intrinsics = picture.maps(job[0])
            found: tuple[Array, Array] = search_poses(
                maps, self.refiner.part.resolvable, job[1], intrinsics, 0.01 * self.views.diameter_mm,
                np.deg2rad(level.turn_step_deg), level.stretch_step, level.rounds, level.halvings, 2, 2,
                level.points, level.points,
            )  # fmt: skip
            return found

        found = [(np.empty(0), np.empty((0, 4, 4))), *pool().map(search, jobs)]
        responses, poses = (np.concatenate(parts) for parts in zip(*found, strict=True))
        before = np.array([candidate.score for group in by_step.values() for candidate in group])
        is_in_range = self._are_in_reach(poses)
        responses, poses, before = responses[is_in_range], poses[is_in_range], before[is_in_range]
        if not len(poses):
            return []
        lines = np.array([self.view_lines(pose) for pose in poses])
        scores = self._rough_ranker.scores(picture, poses, lines) + CLIMBED_WORTH * weighed(responses, lines)
        scores += BEFORE_WORTH * before
        order = np.argsort(-scores, kind="stable")
        scores, poses = scores[order], poses[order]
        reach = np.full(len(poses), 0.01 * level.apart_deg * self.views.diameter_mm) / poses[:, 2, 3]
        chosen = select_distinct(
            np.ascontiguousarray(poses[:, :3, :3]), np.ascontiguousarray(poses[:, :3, 3]), reach,
            np.cos(np.deg2rad(level.apart_deg)), 1.0 + 0.01 * level.apart_deg, kept,
        )  # fmt: skip
        return [PoseCandidate(float(scores[i]), poses[i]) for i in chosen]

    def refine_and_verify(self, picture: ImagePyramid, starts: list[PoseCandidate]) -> list[Hypothesis]:
        """Refine starts, keep the best, search around them; apart from each other, best first."""
        return sorted(self.verify(picture, self.refine_starts(picture, starts)), key=lambda h: -h.logit)

    def refine_starts(self, picture: ImagePyramid, starts: list[PoseCandidate]) -> list[Hypothesis]:
        """What starts lead to, apart from each other, best first, before the verifier has looked at it."""
        o = self.options
        as_found = self._tried(picture, [start.cam_from_body for start in starts], ())
        likely = [h.cam_from_body for h in sorted(as_found, key=lambda h: -h.logit)[: o.tried]]
        tried = [h for stages in COARSE_STAGES for h in self._tried(picture, likely, stages)]
        refined = self.deduplicate([*as_found, *tried], 3.0)
        # Besides the best, some for quite other poses: the lead over these says whether the best stands out.
        others = [h for h in refined[o.finalists :] if not self._same(h.cam_from_body, refined[0].cam_from_body, 25.0)]
        coarse = refined[: o.finalists] + self.deduplicate(others, 15.0, o.rivals)
        finished = self.refine_fine(picture, [found.cam_from_body for found in coarse])
        if finished and HOPELESS_SCORE <= finished[0].evidence.score < DECISION_SCORE:
            finished += self.refine_fine(picture, _around(finished[0].cam_from_body, 0.05))
        return self.deduplicate(finished, 5.0, o.verified)

    def verify(self, picture: ImagePyramid, found: list[Hypothesis]) -> list[Hypothesis]:
        """Refined poses, in the same order, after shading was heard and verifier and strips have looked at them."""
        if not found:
            return []
        if self.refiner.part.is_curved:
            found = self._shaded(picture, found)
        known = np.array([(h.evidence_logit, h.profile_score, h.evidence.scatter_px) for h in found])
        poses = np.stack([h.cam_from_body for h in found])
        scores = self._verifier.scores(picture, poses, known).tolist()
        strips = self._strips.scores(picture, poses).tolist()
        seen, part, step_mm = picture.edge_responses(), self.refiner.part.resolvable, 0.01 * self.views.diameter_mm
        supports = [mean_edge_response(seen.maps, part, pose, seen.intrinsics, step_mm) for pose in poses]
        return [
            replace(h, verifier_score=score, edge_response=float(support), contour_score=across)
            for h, score, support, across in zip(found, scores, supports, strips, strict=True)
        ]

    def _shaded(self, picture: ImagePyramid, found: list[Hypothesis]) -> list[Hypothesis]:
        """Refined poses after the shading of the surface was heard, too, unless the outline says no to it."""

        def shaded(h: Hypothesis) -> tuple[Array, tuple[Stage, ...]]:
            refiner = self.refiner
            look = refiner.appearance_at(picture.image, h.cam_from_body)
            pose, information = refiner.refine(picture.image, picture.gray, h.cam_from_body, LAST_STAGE, look)
            return refiner.refine_shading(picture.gray, pose, information)[0], ()

        after = self.refine_starts_through(picture, list(pool().map(shaded, found)), FINE_TOLERANCE_PX)
        return [new if new.logit > old.logit - LARGEST_LOSS else old for old, new in zip(found, after, strict=True)]

    def _tried(self, picture: ImagePyramid, starts: Sequence[Array], stages: tuple[Stage, ...]) -> list[Hypothesis]:
        """Poses after some coarse stages from each start."""
        return self.refine_starts_through(picture, [(start, stages) for start in starts], COARSE_TOLERANCE_PX)

    def refine_fine(self, picture: ImagePyramid, starts: Sequence[Array]) -> list[Hypothesis]:
        """Poses refined to the end, best first; those of which too little is in the picture are left out."""
        found = self.refine_starts_through(
            picture, [(s, stages) for s in starts for stages in FINE_STAGES], FINE_TOLERANCE_PX
        )
        is_in_range = self._are_in_reach(np.array([h.cam_from_body for h in found]).reshape(-1, 4, 4))
        low = self.options.min_in_picture
        kept = [h for h, is_ok in zip(found, is_in_range, strict=True) if is_ok and h.evidence.points_in_picture >= low]
        return self.deduplicate(kept, 0.0)

    def refine_starts_through(
        self, picture: ImagePyramid, ways: Sequence[tuple[Array, tuple[Stage, ...]]], tolerance_px: float
    ) -> list[Hypothesis]:
        """Where some stages lead from each of some starts."""

        def refine(way: tuple[Array, tuple[Stage, ...]]) -> tuple[Array, PoseEvidence]:
            pose = self.refiner.refine_fresh(picture.image, picture.gray, *way)
            look = self.refiner.appearance_at(picture.image, pose)
            return pose, self.refiner.evidence(picture.image, picture.gray, pose, look, tolerance_px)

        refined = list(pool().map(refine, ways))
        poses = np.array([pose for pose, _ in refined]).reshape(-1, 4, 4)
        lines = np.array([self.view_lines(pose) for pose in poses])
        judgements = self._fine_ranker.scores(picture, poses, lines)
        return [
            Hypothesis(pose, evidence, float(profile_score), float(shown), self.refiner.radius_px(pose))
            for (pose, evidence), profile_score, shown in zip(refined, judgements, lines, strict=True)
        ]

    def deduplicate(self, found: Iterable[Hypothesis], apart_deg: float, most: int = 1000) -> list[Hypothesis]:
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
        chosen = [max(some, key=lambda h: h.evidence_logit) for some in copies]
        return sorted(chosen, key=lambda h: -h.logit)

    def view_lines(self, cam_from_body: Array) -> float:
        """Distinct lines of the view nearest to a pose."""
        return self._shown_lines.towards(-cam_from_body[:3, :3].T @ cam_from_body[:3, 3])

    @property
    def mean_view_lines(self) -> float:
        """Distinct lines that the views show in the (geometric) mean."""
        return self._shown_lines.usual

    def _are_in_reach(self, poses: Array) -> NDArray[np.bool_]:
        """Which poses (N,4,4) about the centre are in front of the camera and near and far enough."""
        low, high = self._reach_mm
        distances_mm = np.linalg.norm(poses[:, :3, 3], axis=1)
        return np.asarray((low <= distances_mm) & (distances_mm <= high) & (poses[:, 2, 3] > 0))

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
