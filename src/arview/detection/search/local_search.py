"""Local search: refines rough poses of a part in one image, and scores what they lead to.

Coarse to fine: a pattern search around the poses on response maps of growing resolution, refinement by edges and
colours from the best results, then verification. At each step fewer hypotheses are left and each costs more; profile
rankers choose which, and the verifiers score the last ones.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.core.parallel import pool
from arview.detection.confidence import outline_score
from arview.detection.features.denoiser import Denoiser
from arview.detection.features.edge_net import EdgeNet, mean_edge_response
from arview.detection.features.image_pyramid import STEPS_PER_OCTAVE, ImagePyramid, WorkPicture, step_for
from arview.detection.scoring.contour_verifier import ContourVerifier
from arview.detection.scoring.pose_verifier import PoseVerifier
from arview.detection.scoring.profile_ranker import FINE, ProfileRanker
from arview.detection.search.global_search import QUICK, PoseCandidate, weight_by_lines
from arview.detection.search.hypothesis import Hypothesis
from arview.detection.search.nms import distinct_poses
from arview.detection.search.pattern_search import search_poses
from arview.detection.search.polish import polish
from arview.detection.search.template_bank import ViewLineCounts
from arview.geometry import Array, are_near, exp_so3, rigid
from arview.guideviews import GuideViewSet
from arview.refinement import (
    DECISION_SCORE,
    NEAR_STAGES,
    SEARCH_STAGES,
    PartView,
    PoseEvidence,
    PoseRefiner,
    Stage,
    WorkingScaleOptions,
)

Schedule = tuple[Stage, ...]


COARSE_STAGES: Schedule = (
    Stage(region_scale=6, edge_reach=12, edge_step_px=2.0, edge_spread_px=10.0, stride=2),
    Stage(region_scale=4, edge_reach=12, edge_step_px=2.0, edge_spread_px=7.0, stride=2),
    Stage(region_scale=4, edge_reach=12, edge_step_px=1.5, edge_spread_px=5.0, stride=2),
    Stage(region_scale=3, edge_reach=10, edge_step_px=1.0, edge_spread_px=3.5, stride=2),
)
"""Coarse refinement in which edges dominate."""
COARSE_COLOUR_STAGES: Schedule = tuple(replace(stage, region_gain=20.0) for stage in COARSE_STAGES)
"""Coarse refinement in which colours dominate, for plain and glossy parts."""


@dataclass(frozen=True)
class PatternSearchLevel:
    """One level of the pattern search.

    Attributes:
        magnification: size of the part relative to that in the templates.
        turn_step_deg: first step of the rotations.
        stretch_step: first step of the distance as a share of it.
        rounds: maximum number of passes before the steps are halved.
        halvings: number of times that the steps are halved.
        distinct_deg: rotation within which hypotheses are duplicates; hundredths of it are diameters and shares.
        points: approximate numbers of outline points, and of design-edge points, that are scored.
    """

    magnification: float
    turn_step_deg: float
    stretch_step: float
    rounds: int
    halvings: int
    distinct_deg: float
    points: int


PAD_SHARE = 0.6
"""Border of the response maps as a share of ``radius_px``."""
RESPONSE_WEIGHT = 12.0
"""Weight of the mean response after a level of the pattern search beside the profile score."""
PREVIOUS_WEIGHT = 0.5
"""Weight of a candidate's score before the level; a wrong pose seldom fits at several levels."""
MAX_COARSE = 16
"""Results of the pattern search that are refined through the coarse schedules."""
COARSE_SCHEDULES: tuple[Schedule, ...] = (COARSE_STAGES, COARSE_COLOUR_STAGES)
"""Schedules tried from each result of the pattern search."""
MAX_FINE = 5
"""Hypotheses that are refined to the end."""
MAX_COMPETITORS = 3
"""Further hypotheses for clearly different poses that are refined to the end; the margin over them tells whether the
best one stands out."""
FINE_SCHEDULES: tuple[Schedule, ...] = (SEARCH_STAGES, NEAR_STAGES)
"""Schedules tried from each hypothesis: with edges and colours, and with nearby edges alone, because occluders shift
the colour statistics."""
SHADING_STAGES: Schedule = SEARCH_STAGES[-1:]
"""Stages before the shading is used."""
COARSE_TOLERANCE_PX = 3.5
FINE_TOLERANCE_PX = 1.5
"""Reach of the evidence after coarse and fine schedules."""
COARSE_DISTINCT_DEG = 3.0
DISTINCT_DEG = 5.0
"""Rotation within which hypotheses are duplicates after coarse and fine schedules; hundredths of it are diameters."""
COMPETITOR_DEG = 25.0
COMPETITOR_DISTINCT_DEG = 15.0
"""Rotation from the best pose, and from each other, of the competitors."""
MIN_SCORE = 0.35
"""Evidence score of the best pose below which no poses around it are tried."""
NEIGHBOURHOOD_RAD = 0.05
"""Rotation of the poses that are tried around the best one."""
MAX_SHADING_LOSS = 3.0
"""Largest drop in log odds accepted from the shading refinement."""
MIN_IN_IMAGE = 0.4
"""Share of the outline inside the image below which poses are dropped."""
MAX_SCALE = 0.8
"""Images are reduced as a whole, for all distances, by this factor or more or not at all."""
MAX_SIDE_PX = 1280
"""Longer side of an image above which it is reduced whatever the distances."""
SIDE_UNIT_PX = 8
"""Sides of reduced images are multiples of this, so that they can be halved."""
SCALE = WorkingScaleOptions(radius_px=120.0, max_enlargement=1.0)
"""Options of the images in which poses are refined and measured, by the size of the part."""
OUTLINE_SCALE = WorkingScaleOptions(radius_px=64.0, max_enlargement=1.0)
"""Options of the images in which the outline alone is judged: smaller, so that what differs between part and CAD by
less than some hundredths of the diameter does not count."""


@dataclass(frozen=True)
class LocalSearchOptions:
    """Options of the local search.

    Attributes:
        radius_px: half the part's diameter in images of magnification 1.
        levels: of the pattern search.
        use_shading: refine curved parts by shading before they are verified.
        max_verified: refined poses that are verified.
    """

    radius_px: float = 20.0
    levels: tuple[PatternSearchLevel, ...] = (
        PatternSearchLevel(
            magnification=2.6, turn_step_deg=4.0, stretch_step=0.04, rounds=2, halvings=0, distinct_deg=4.0, points=64
        ),
        PatternSearchLevel(
            magnification=5.2, turn_step_deg=2.0, stretch_step=0.017, rounds=2, halvings=1, distinct_deg=2.5, points=96
        ),
    )
    use_shading: bool = True
    max_verified: int = 5


class LocalSearch:
    """The search around rough poses of one part with one camera.

    Args:
        views: guide views of the part.
        camera: of the images.
        options: see `LocalSearchOptions`.
        distances_mm: range of the distances outside of which poses are dropped.

    Attributes:
        reduced_camera: of the images in which the part is searched: where it is large at all distances, they are
            smaller than those of ``camera``.
    """

    def __init__(
        self,
        views: GuideViewSet,
        camera: Camera,
        options: LocalSearchOptions | None = None,
        distances_mm: tuple[float, float] = (0.0, math.inf),
    ) -> None:
        self.views = views
        self.camera = camera
        self.options = options or LocalSearchOptions()
        self.refiner = PoseRefiner(PartView.of(views), camera)
        part = self.refiner.part
        self._distances_mm = distances_mm
        self.reduced_camera = self._reduced(camera)
        self._edge_net = EdgeNet()
        self._denoiser = Denoiser()
        self._rough_ranker = ProfileRanker(part)
        self._fine_ranker = ProfileRanker(part, FINE)
        self._pose_verifier = PoseVerifier(part)
        self._contour_verifier = ContourVerifier(part)
        self._line_counts = ViewLineCounts(views)

    def pyramid(self, image: NDArray[np.uint8]) -> ImagePyramid:
        """The pyramid of a frame (H,W,3) uint8 RGB, reduced to `reduced_camera` and denoised if it is noisy."""
        camera, reduced = self.reduced_camera, image
        if camera is not self.camera:
            reduced = np.asarray(cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA))
        clean = self._denoiser.denoise(reduced)
        pyramid = ImagePyramid(clean, camera, round(PAD_SHARE * self.options.radius_px), self._edge_net)
        if clean is reduced:
            pyramid.finest = (image, self.camera)
        return pyramid

    def _reduced(self, camera: Camera) -> Camera:
        """The camera of images in which the part at the farthest distance is as large as it is measured at most."""
        farthest_px = 0.25 * (camera.fx + camera.fy) * self.views.diameter_mm / self._distances_mm[1]
        scale = min(SCALE.radius_px / max(farthest_px, 1e-9), MAX_SIDE_PX / max(camera.width, camera.height))
        if scale > MAX_SCALE:
            return camera
        # Sides that can be halved several times.
        width, height = (
            max(SIDE_UNIT_PX * round(scale * side / SIDE_UNIT_PX), SIDE_UNIT_PX)
            for side in (camera.width, camera.height)
        )
        return camera.scaled(width, height)

    def with_options(self, options: LocalSearchOptions) -> LocalSearch:
        """The same search with other options and at any distance; it shares the networks with this one."""
        other = copy.copy(self)
        other.options, other._distances_mm = options, (0.0, math.inf)
        other.reduced_camera = other._reduced(other.camera)
        return other

    def with_camera(self, camera: Camera) -> LocalSearch:
        """The same search for images of another camera, such as that of a window."""
        other = copy.copy(self)
        other.camera, other.refiner = camera, self.refiner.with_camera(camera)
        other.reduced_camera = other._reduced(camera)
        return other

    def pattern_search(
        self, pyramid: ImagePyramid, starts: list[PoseCandidate], kept: tuple[int, ...] = QUICK.kept
    ) -> list[PoseCandidate]:
        """The best candidates after all levels of the pattern search from some starts, best first.

        Args:
            pyramid: of the image.
            starts: rough poses.
            kept: number of candidates kept after each level.
        """
        for level, count in zip(self.options.levels, kept, strict=True):
            starts = self._search_level(pyramid, starts, level, count)
        return starts

    def _search_level(
        self, pyramid: ImagePyramid, candidates: list[PoseCandidate], level: PatternSearchLevel, count: int
    ) -> list[PoseCandidate]:
        """The best candidates after a pattern search around each, apart from each other, best first."""
        o = self.options
        by_step: dict[int, list[PoseCandidate]] = {}
        for candidate in candidates:
            radius_px = float(pyramid.radii_px(self.views.diameter_mm, candidate.cam_from_body[None])[0])
            step = min(0, round(step_for(radius_px, level.magnification * o.radius_px)))
            by_step.setdefault(step, []).append(candidate)
        pyramid.make_maps(list(by_step))
        jobs = []
        for step, group in by_step.items():
            size = max(2, -(-len(group) // 4))
            poses_of = np.stack([candidate.cam_from_body for candidate in group])
            jobs += [(step, poses_of[i : i + size]) for i in range(0, len(group), size)]

        def search(job: tuple[int, Array]) -> tuple[Array, Array]:
            maps, intrinsics = pyramid.maps(job[0])
            found: tuple[Array, Array] = search_poses(
                maps, self.refiner.part.resolvable, job[1], intrinsics, 0.01 * self.views.diameter_mm,
                np.deg2rad(level.turn_step_deg), level.stretch_step, level.rounds, level.halvings, 2, 2,
                level.points, level.points,
            )  # fmt: skip
            return found

        found = [(np.empty(0), np.empty((0, 4, 4))), *pool().map(search, jobs)]
        responses, poses = (np.concatenate(parts) for parts in zip(*found, strict=True))
        before = np.array([candidate.score for group in by_step.values() for candidate in group])
        is_in_range = self._are_in_range(poses)
        responses, poses, before = responses[is_in_range], poses[is_in_range], before[is_in_range]
        if not len(poses):
            return []
        view_lines = np.array([self.view_lines(pose) for pose in poses])
        scores = self._rough_ranker.scores(pyramid, poses, view_lines)
        scores = scores + RESPONSE_WEIGHT * weight_by_lines(responses, view_lines)
        scores += PREVIOUS_WEIGHT * before
        found_scores, poses = distinct_poses(scores, poses, self.views.diameter_mm, level.distinct_deg, count)
        return [PoseCandidate(float(score), pose) for score, pose in zip(found_scores, poses, strict=True)]

    def refine_and_verify(self, pyramid: ImagePyramid, starts: list[PoseCandidate]) -> list[Hypothesis]:
        """Verified hypotheses that some starts lead to, apart from each other, best first."""
        return sorted(self.verify(pyramid, self.refine_starts(pyramid, starts)), key=lambda h: -h.logit)

    def refine_starts(self, pyramid: ImagePyramid, starts: list[PoseCandidate]) -> list[Hypothesis]:
        """Refined hypotheses before verification, apart from each other, best first."""
        o = self.options
        unrefined = self._refine_coarse(pyramid, [start.cam_from_body for start in starts], ())
        best = [h.cam_from_body for h in sorted(unrefined, key=lambda h: -h.logit)[:MAX_COARSE]]
        coarse = [h for stages in COARSE_SCHEDULES for h in self._refine_coarse(pyramid, best, stages)]
        ranked = self.deduplicate([*unrefined, *coarse], COARSE_DISTINCT_DEG)
        others = [
            h for h in ranked[MAX_FINE:] if not self._same(h.cam_from_body, ranked[0].cam_from_body, COMPETITOR_DEG)
        ]
        chosen = ranked[:MAX_FINE] + self.deduplicate(others, COMPETITOR_DISTINCT_DEG, MAX_COMPETITORS)
        refined = self.refine_fine(pyramid, [h.cam_from_body for h in chosen])
        if refined and MIN_SCORE <= refined[0].evidence.score < DECISION_SCORE:
            refined += self.refine_fine(pyramid, _poses_around(refined[0].cam_from_body, NEIGHBOURHOOD_RAD))
        return self.deduplicate(refined, DISTINCT_DEG, o.max_verified)

    def verify(self, pyramid: ImagePyramid, hypotheses: list[Hypothesis]) -> list[Hypothesis]:
        """Hypotheses with the scores of both verifiers, in their order; curved parts are refined by shading first."""
        if not hypotheses:
            return []
        part, step_mm = self.refiner.part, 0.01 * self.views.diameter_mm
        if part.is_curved and self.options.use_shading:
            hypotheses = self._refine_by_shading(pyramid, hypotheses)
        known = np.array([(h.evidence_logit, h.profile_score, h.evidence.scatter_px) for h in hypotheses])
        poses = np.stack([h.cam_from_body for h in hypotheses])
        scores = self._pose_verifier.scores(pyramid, poses, known).tolist()
        contours = self._contour_verifier.scores(pyramid, poses).tolist()
        edges = [pyramid.edge_responses(self.work_step(pyramid, pose)) for pose in poses]
        responses = [
            mean_edge_response(some.maps, part.resolvable, pose, some.intrinsics, step_mm)
            for some, pose in zip(edges, poses, strict=True)
        ]
        outlines = [
            outline_score(h.evidence, self._outline(pyramid, h.cam_from_body), contour)
            for h, contour in zip(hypotheses, contours, strict=True)
        ]
        return [
            replace(
                h, verifier_score=score, edge_response=float(response), contour_score=contour, outline_score=outline
            )
            for h, score, response, contour, outline in zip(
                hypotheses, scores, responses, contours, outlines, strict=True
            )
        ]

    def _outline(self, pyramid: ImagePyramid, cam_from_body: Array) -> PoseEvidence:
        """Evidence of a pose (4,4) at the scale at which the outline alone is judged."""
        image, gray, camera = pyramid.picture(self._step(pyramid, cam_from_body, OUTLINE_SCALE))
        refiner = self.refiner.with_camera(camera)
        appearance = refiner.appearance_at(image, cam_from_body)
        return refiner.evidence(image, gray, cam_from_body, appearance, FINE_TOLERANCE_PX)

    def _refine_by_shading(self, pyramid: ImagePyramid, hypotheses: list[Hypothesis]) -> list[Hypothesis]:
        """Hypotheses refined by the shading of the surface, each unless its log odds drop too far."""

        def refine(h: Hypothesis) -> tuple[Array, Schedule]:
            picture = self.work_picture(pyramid, h.cam_from_body)
            refiner = self.refiner.with_camera(picture.camera)
            appearance = refiner.appearance_at(picture.image, h.cam_from_body)
            pose, information = refiner.refine(picture.image, picture.gray, h.cam_from_body, SHADING_STAGES, appearance)
            return refiner.refine_shading(picture.gray, pose, information)[0], ()

        shaded = self.refine_through(pyramid, list(pool().map(refine, hypotheses)), FINE_TOLERANCE_PX)
        return [
            new if new.logit > old.logit - MAX_SHADING_LOSS else old
            for old, new in zip(hypotheses, shaded, strict=True)
        ]

    def _refine_coarse(self, pyramid: ImagePyramid, starts: Sequence[Array], stages: Schedule) -> list[Hypothesis]:
        """Hypotheses after some coarse stages from each start."""
        return self.refine_through(pyramid, [(start, stages) for start in starts], COARSE_TOLERANCE_PX)

    def refine_fine(self, pyramid: ImagePyramid, starts: Sequence[Array]) -> list[Hypothesis]:
        """Hypotheses after all fine schedules from each start, best first, without those mostly outside the image."""
        scheduled = [(start, stages) for start in starts for stages in FINE_SCHEDULES]
        found = self.refine_through(pyramid, scheduled, FINE_TOLERANCE_PX)
        is_in_range = self._are_in_range(np.array([h.cam_from_body for h in found]).reshape(-1, 4, 4))
        kept = [
            h
            for h, is_ok in zip(found, is_in_range, strict=True)
            if is_ok and h.evidence.points_in_picture >= MIN_IN_IMAGE
        ]
        return self.deduplicate(kept, 0.0)

    def evaluate(self, pyramid: ImagePyramid, poses: Sequence[Array]) -> list[Hypothesis]:
        """Hypotheses of poses (4,4) as they are."""
        return self.refine_through(pyramid, [(pose, ()) for pose in poses], FINE_TOLERANCE_PX)

    def work_step(self, pyramid: ImagePyramid, cam_from_body: Array) -> int:
        """The scale step at which a pose (4,4) is refined and its evidence measured."""
        return self._step(pyramid, cam_from_body, SCALE)

    def _step(self, pyramid: ImagePyramid, cam_from_body: Array, scale: WorkingScaleOptions) -> int:
        """The scale step of the working picture at a pose (4,4)."""
        radius_px = float(pyramid.radii_px(self.views.diameter_mm, cam_from_body[None])[0])
        # A part at the camera itself would be infinitely large.
        radius_px = min(radius_px, float(pyramid.image.shape[1]))
        return round(STEPS_PER_OCTAVE * math.log2(scale.scales(radius_px)[0]))

    def work_picture(self, pyramid: ImagePyramid, cam_from_body: Array) -> WorkPicture:
        """The image at the scale of `work_step`."""
        return pyramid.picture(self.work_step(pyramid, cam_from_body))

    def polish(self, pyramid: ImagePyramid, cam_from_body: Array) -> Array:
        """A found pose (4,4) refined in the image at full resolution, see `polish.polish`.

        Of curved parts it would undo the refinement by shading, which weighs down the edges of smooth contours.
        """
        if self.refiner.part.is_curved:
            return cam_from_body
        measured = self.work_picture(pyramid, cam_from_body)
        return polish(self.refiner, pyramid, measured, cam_from_body, SCALE)

    def refine_through(
        self, pyramid: ImagePyramid, scheduled: Sequence[tuple[Array, Schedule]], tolerance_px: float
    ) -> list[Hypothesis]:
        """Hypotheses after refinement, in the order of the starts.

        Args:
            pyramid: of the image.
            scheduled: starts (4,4) with the stages to refine them through.
            tolerance_px: distance within which edges support a pose.
        """

        def refine(start: tuple[Array, Schedule]) -> tuple[Array, PoseEvidence, float]:
            image, gray, camera = self.work_picture(pyramid, start[0])
            refiner = self.refiner.with_camera(camera)
            pose = refiner.refine_fresh(image, gray, *start)
            evidence = refiner.evidence(image, gray, pose, refiner.appearance_at(image, pose), tolerance_px)
            return pose, evidence, refiner.radius_px(pose)

        refined = list(pool().map(refine, scheduled))
        poses = np.array([pose for pose, *_ in refined]).reshape(-1, 4, 4)
        view_lines = np.array([self.view_lines(pose) for pose in poses])
        scores = self._fine_ranker.scores(pyramid, poses, view_lines)
        return [
            Hypothesis(
                cam_from_body=pose,
                evidence=evidence,
                profile_score=float(score),
                view_lines=float(count),
                radius_px=radius_px,
            )
            for (pose, evidence, radius_px), score, count in zip(refined, scores, view_lines, strict=True)
        ]

    def deduplicate(self, hypotheses: Iterable[Hypothesis], apart_deg: float, count: int = 1000) -> list[Hypothesis]:
        """The best ``count`` hypotheses, best first, without those close to a better one.

        Of copies of one pose, closer than `DISTINCT_DEG`, the one with the best evidence stays.

        Args:
            hypotheses: of one image.
            apart_deg: rotation within which hypotheses are close; hundredths of it are diameters.
            count: number returned at most.
        """
        copies: list[list[Hypothesis]] = []
        for hypothesis in sorted(hypotheses, key=lambda h: -h.logit):
            near = [some for some in copies if self._same(hypothesis.cam_from_body, some[0].cam_from_body, apart_deg)]
            if near:
                near[0].append(hypothesis)
            elif len(copies) < count:
                copies.append([hypothesis])
        if apart_deg > DISTINCT_DEG:
            return [some[0] for some in copies]
        chosen = [max(some, key=lambda h: h.evidence_logit) for some in copies]
        return sorted(chosen, key=lambda h: -h.logit)

    def view_lines(self, cam_from_body: Array) -> float:
        """Distinct lines of the view nearest to a pose (4,4)."""
        return self._line_counts.towards(-cam_from_body[:3, :3].T @ cam_from_body[:3, 3])

    @property
    def mean_view_lines(self) -> float:
        """Geometric mean of the distinct lines over the views."""
        return self._line_counts.mean

    def _are_in_range(self, poses: Array) -> NDArray[np.bool_]:
        """Which poses (N,4,4) are in front of the camera and within the range of distances."""
        low, high = self._distances_mm
        distances_mm = np.linalg.norm(poses[:, :3, 3], axis=1)
        return np.asarray((low <= distances_mm) & (distances_mm <= high) & (poses[:, 2, 3] > 0))

    def _same(self, a: Array, b: Array, angle_deg: float) -> bool:
        return are_near(a, b, 0.01 * angle_deg * self.views.diameter_mm, angle_deg)


def _poses_around(cam_from_body: Array, angle_rad: float) -> list[Array]:
    """Poses rotated by ± an angle about 7 axes through the part's centre: the coordinate axes and the diagonals."""
    axes = [np.array(a, dtype=np.float64) for a in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]
    axes += [np.array([1.0, b, c]) for b in (-1, 1) for c in (-1, 1)]
    poses = []
    for axis in axes:
        for sign in (-1.0, 1.0):
            turn = exp_so3(axis / np.linalg.norm(axis) * sign * angle_rad)
            poses.append(rigid(turn @ cam_from_body[:3, :3], cam_from_body[:3, 3]))
    return poses
