"""Detector: finds the part in a single frame from its guide views, with no pose to start from.

Coarse to fine: templates over all directions, rolls, distances and places, improved as outlines in the picture
(`first_search`); then the `local_search` around the best. A quick search comes first; what it does not settle is
looked for among many more matches.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.core.checks import check_type
from arview.core.parallel import pool
from arview.detection.confidence import ConfidenceTerms, Margins, confidence_terms, pose_probability
from arview.detection.features.image_pyramid import ImagePyramid
from arview.detection.scoring.pair_comparator import PairComparator
from arview.detection.search.global_search import (
    GRADIENTS_ONLY,
    QUICK,
    UNTRIMMED,
    WIDE,
    GlobalSearch,
    PoseCandidate,
    SearchBudget,
    reach_mm,
)
from arview.detection.search.local_search import Hypothesis, LocalSearch, LocalSearchOptions
from arview.detection.symmetry import LEAD, TELLING, find_symmetries, rotations_about, telling
from arview.errors import InputError
from arview.geometry import Array, turned
from arview.guideviews import GuideViewSet
from arview.guideviews.sphere import icosphere_directions
from arview.refinement.evidence import PoseEvidence

MIN_QUICK_QUALITY = 0.6
"""So much is wanted of a quick search alone: with few rivals looked at, a lead says less. Of 600 semi-synthetic frames
it is right in 9 of the 12 in which it ends at 0.6 to 0.75, and in 30 of the 36 in which it ends at 0.75 to 0.9."""
ALIKE_ASIDE, ALIKE_ALONG, ALIKE_DEG = 0.12, 0.15, 20.0
"""Hypotheses this near, across in diameters and along as a share of the distance, are no rivals of each other."""
MOST_RIVALS = 12
"""Of more twins the likeliest are told apart."""
SPINS_DEG = range(0, 360, 5)
"""Turns about the axis of a nearly round part that are looked at."""
MOST_SPUN = 6
"""Of those so many are refined: in 98 pictures of a flange the right one is among the first four by its edges in 90."""
LEAD_TELLS = 0.2
"""A lead of 1 counts so much beside what the pair comparator and the edges tell of two twins. Of 162 pictures of nearly
symmetric random solids in which the right pose is among the twins it is ahead in 135 with all three, in 130 without the
edges, in 129 by the network alone, and in 113 by what speaks for each pose on its own."""
HERE_ASIDE, HERE_ALONG = 0.35, 0.25
"""Rivals this near are at the same place."""


@dataclass(frozen=True)
class DetectorOptions:
    """Options of the detector.

    Attributes:
        radius_px: half the part's diameter in the templates.
        roll_step_deg: spacing of the templates.
        subdivisions: icosahedron level of the template directions (2: 162, about 17° apart).
        budgets: of the searches, each made if those before it did not settle the matter.
        local: of the search around the best matches; its radius_px is that of the templates.
        min_quality: a weaker result is no detection.
    """

    radius_px: float = 20.0
    roll_step_deg: float = 18.0
    subdivisions: int = 2
    budgets: tuple[SearchBudget, ...] = (QUICK, WIDE, GRADIENTS_ONLY, UNTRIMMED)
    local: LocalSearchOptions = field(default_factory=LocalSearchOptions)
    min_quality: float = 0.5

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
        alternatives: other poses (4,4) that the picture bears out as well; not empty: the view is ambiguous.
    """

    cam_from_model: Array
    quality: float
    alternatives: tuple[Array, ...] = ()


@dataclass(frozen=True)
class RejectedHypothesis:
    """The best hypothesis that the detector did not believe: ``cam_from_model`` (4,4), evidence and quality."""

    cam_from_model: Array
    evidence: PoseEvidence
    quality: float


def local_search_for(views: GuideViewSet, camera: Camera, options: DetectorOptions | None = None) -> LocalSearch:
    """The local search that a detector with these options uses."""
    o = options or options_for(views)
    return LocalSearch(views, camera, replace(o.local, radius_px=o.radius_px), reach_mm(views.view_range))


class Detector:
    """Detection of one part with one camera over the declared range of its guide views.

    ``best_rejected`` is the best hypothesis of the last frame when nothing was found, for the diagnosis.
    ``exact_rotations`` (N,3,3) are the rotations that map the part onto itself, the identity among them; ``turns`` also
    hold those that nearly do. ``local`` is the search around rough poses, see `local_search_for`.
    """

    def __init__(
        self,
        views: GuideViewSet,
        camera: Camera,
        options: DetectorOptions | None = None,
        *,
        local: LocalSearch | None = None,
    ) -> None:
        check_type(views, GuideViewSet, "Detector: views")
        check_type(camera, Camera, "Detector: camera")
        self.options = o = options or options_for(views)
        self.views = views
        self.camera = camera
        self.best_rejected: RejectedHypothesis | None = None
        self.local = local or local_search_for(views, camera, o)
        self._pair_comparator = PairComparator(self.local.refiner.part)
        self.symmetries = find_symmetries(views)
        self.exact_rotations = np.concatenate([np.eye(3)[None], self.symmetries.exact])
        self.turns = np.concatenate([self.exact_rotations, self.symmetries.near])
        self.global_search = GlobalSearch(
            views, self.local.refiner.part, camera, o.radius_px, o.roll_step_deg, o.subdivisions, self.symmetries.exact
        )

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
            guesses: rough poses (4,4) ``cam_from_model``; where one of them leads to the part, that is all.
        """
        picture = self.local.pyramid(image)
        if found := self._found_near(picture, guesses):
            return found
        least = self.options.min_quality if is_thorough else max(MIN_QUICK_QUALITY, self.options.min_quality)
        return self._found(picture, self.hypotheses(picture, is_thorough), max_results, least)

    def detect_near(self, image: NDArray[np.uint8], guesses: Sequence[Array]) -> list[Detection]:
        """The best pose (or none) that one of some rough poses (4,4) ``cam_from_model`` leads to."""
        return self._found_near(self.local.pyramid(image), guesses)

    def _found_near(self, picture: ImagePyramid, guesses: Sequence[Array]) -> list[Detection]:
        starts = [PoseCandidate(1.0, guess @ self.local.refiner.part.model_from_body) for guess in guesses]
        settled = self.local.refine_and_verify(picture, self.local.pattern_search(picture, starts)) if starts else []
        return self._found(picture, settled, 1, self.options.min_quality)

    def _found(
        self, picture: ImagePyramid, settled: list[Hypothesis], max_results: int, least: float
    ) -> list[Detection]:
        """The hypotheses of at least a quality, best first."""
        qualities = self.qualities(settled)
        self.best_rejected = None
        if not settled or qualities[0] < least:
            if settled:
                best = settled[0]
                self.best_rejected = RejectedHypothesis(self._in_model(best), best.evidence, qualities[0])
            return []
        best, twins = self._disambiguate(picture, settled[0], settled[1:])
        found = [self._detection(best, qualities[0], twins)]
        for hypothesis, quality in zip(settled[1:], qualities[1:], strict=True):
            is_apart = all(not self._is_equal(hypothesis, h, self.turns, 0.25) for h in (best, *twins))
            if quality >= least and is_apart:
                found.append(self._detection(hypothesis, min(quality, qualities[0]), []))
        return sorted(found, key=lambda detection: -detection.quality)[:max_results]

    def _detection(self, hypothesis: Hypothesis, quality: float, twins: list[Hypothesis]) -> Detection:
        return Detection(self._in_model(hypothesis), quality, tuple(map(self._in_model, twins)))

    def hypotheses(self, picture: ImagePyramid, is_thorough: bool = True) -> list[Hypothesis]:
        """All that came out of the search, right or wrong, apart from each other, best first."""
        settled: list[Hypothesis] = []
        least = max(MIN_QUICK_QUALITY, self.options.min_quality)
        for effort in self.options.budgets if is_thorough else self.options.budgets[:1]:
            starts = self.local.pattern_search(picture, self.global_search.starts(picture, effort), effort.kept)
            settled = self.local.deduplicate([*settled, *self.local.refine_and_verify(picture, starts)], 5.0)
            if settled and self.qualities(settled)[0] >= least:
                break
        return settled

    def qualities(self, hypotheses: list[Hypothesis]) -> list[float]:
        """Probability that each of several hypotheses, best first, is right: see `pose_probability`."""
        return [pose_probability(self.terms(h, hypotheses[k + 1 :])) for k, h in enumerate(hypotheses)]

    def terms(self, best: Hypothesis, others: list[Hypothesis]) -> ConfidenceTerms:
        """What speaks for a hypothesis before others, see `confidence_terms`."""
        leads, shown = self.margins(best, others), best.view_lines / self.local.mean_view_lines
        return confidence_terms(
            best.appearance_score,
            best.evidence_logit,
            best.profile_score,
            best.contour_score,
            leads,
            shown,
            best.radius_px,
        )

    def margins(self, best: Hypothesis, others: list[Hypothesis]) -> Margins:
        """Margins of a hypothesis over others for other poses; one a little aside of it is the same, badly settled."""
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
        return Margins(best.logit - here, best.logit - elsewhere)

    def _in_model(self, hypothesis: Hypothesis) -> Array:
        return np.asarray(hypothesis.cam_from_body @ self.local.refiner.part.body_from_model)

    def _disambiguate(
        self, picture: ImagePyramid, best: Hypothesis, others: list[Hypothesis]
    ) -> tuple[Hypothesis, list[Hypothesis]]:
        """The pose that is borne out best among the near symmetries of one found, and those that do as well.

        What tells is what the pair comparator says of two, the edges that only one of them has, and all that speaks for
        either. Those from which these do not part the best one are alternatives, unless an exact symmetry makes them
        the same pose.
        """
        pose = best.cam_from_body
        starts = turned(pose, self.symmetries.near) + self._rotation_sweep(picture, pose)
        reach_mm = 0.25 * self.views.diameter_mm
        rivals = [h for h in others if np.linalg.norm(h.cam_from_body[:3, 3] - pose[:3, 3]) < reach_mm]
        rivals = self.local.deduplicate(
            [best, *self.local.verify(picture, self.local.refine_fine(picture, starts)), *rivals], 5.0
        )
        first = rivals[0]
        near = [h for h in rivals[1:] if h.logit_without_contour > first.logit_without_contour - LEAD]
        rivals = [first, *(h for h in near if self._is_twin(h, first) or self._is_spun(h, first))][:MOST_RIVALS]
        if len(rivals) == 1:
            return first, []
        ahead = self._evidence_margins(picture, rivals)
        # Ahead of all others, or by the least behind any.
        leader = int(np.argmax((ahead + np.diag(np.full(len(rivals), np.inf))).min(axis=1)))
        best = rivals[leader]
        twins = [h for k, h in enumerate(rivals) if k != leader and ahead[leader, k] < TELLING]
        return best, [h for h in twins if not self._is_turned(h, best, self.exact_rotations, ALIKE_DEG)]

    def _rotation_sweep(self, picture: ImagePyramid, pose: Array) -> list[Array]:
        """A pose turned about each axis about which the part is nearly round, to where its edges are seen best.

        Such an outline holds at any turn; what breaks it are a few small edges, which no search is led by.
        """
        refiner = self.local.refiner

        def seen(spun: Array) -> float:
            support = refiner.edge_steps(picture.gray, spun).support
            return float(support.mean()) if len(support) else 0.0

        starts = []
        for axis in self.symmetries.axes:
            poses = turned(pose, rotations_about(axis, SPINS_DEG))
            support = np.array(list(pool().map(seen, poses)))
            peaks = np.flatnonzero((support >= np.roll(support, 1)) & (support > np.roll(support, -1)))
            starts += [poses[k] for k in peaks[np.argsort(-support[peaks], kind="stable")][:MOST_SPUN]]
        return starts

    def _is_twin(self, a: Hypothesis, b: Hypothesis) -> bool:
        """Whether one of the turns that nearly take the part onto itself brings a pose to another, or near it.

        One a little aside of another is the same, badly settled: what speaks for either tells them apart.
        """
        is_alike = self._is_turned(a, b, self.exact_rotations, ALIKE_DEG)
        return not is_alike and self._is_turned(a, b, self.turns, ALIKE_DEG)

    def _is_spun(self, a: Hypothesis, b: Hypothesis) -> bool:
        """Whether two are turned against each other about an axis about which the part is nearly round, if at all."""
        axes = self.symmetries.axes
        cosines = np.sum((axes @ a.cam_from_body[:3, :3].T) * (axes @ b.cam_from_body[:3, :3].T), axis=1)
        return bool(np.any(cosines > np.cos(np.deg2rad(ALIKE_DEG))))

    def _evidence_margins(self, picture: ImagePyramid, rivals: list[Hypothesis]) -> Array:
        """By how much each of some twins is borne out better than each other (N,N)."""
        refiner = self.local.refiner
        logits = np.array([h.logit_without_contour for h in rivals])
        ahead = self._pair_comparator.log_odds(picture, [h.cam_from_body for h in rivals])
        ahead += LEAD_TELLS * (logits[:, None] - logits)
        steps = list(pool().map(lambda h: refiner.edge_steps(picture.gray, h.cam_from_body), rivals))
        for a, b in combinations(range(len(rivals)), 2):
            told = telling(steps[a], steps[b])
            ahead[a, b] += told
            ahead[b, a] -= told
        return ahead

    def _is_equal(self, a: Hypothesis, b: Hypothesis, turns: Array, reach: float = 0.08) -> bool:
        """Whether two are the same pose, by one of some turns (N,3,3); ``reach`` is in diameters."""
        apart_mm = np.linalg.norm(a.cam_from_body[:3, 3] - b.cam_from_body[:3, 3])
        return bool(apart_mm <= reach * self.views.diameter_mm) and self._is_turned(a, b, turns, 8.0)

    def _is_turned(self, a: Hypothesis, b: Hypothesis, turns: Array, angle_deg: float) -> bool:
        """Whether one of some turns (N,3,3) brings a rotation nearer to another than an angle."""
        cosine = 0.5 * (np.einsum("ij,nij->n", a.cam_from_body[:3, :3], b.cam_from_body[:3, :3] @ turns) - 1.0)
        return bool(np.any(cosine > np.cos(np.deg2rad(angle_deg))))
