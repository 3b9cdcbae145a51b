"""Detector: finds the part in a single image from its guide views, without a pose to start from.

Coarse to fine: the global search matches templates over all directions, rolls, distances and places and improves them
as outlines in the image; the local search refines and verifies the best of them. A quick search comes first; where it
does not give a sure result, wider searches follow.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera, FrameView
from arview.core.checks import check_type
from arview.detection.confidence import ConfidenceTerms, Margins, confidence_terms, pose_probability
from arview.detection.disambiguation import Disambiguator, is_rotated_by
from arview.detection.features.image_pyramid import ImagePyramid
from arview.detection.search.global_search import (
    CUT_FILL,
    GRADIENTS_ONLY,
    QUICK,
    QUICK_OUTER,
    UNTRIMMED,
    WIDE,
    WIDE_OUTER,
    GlobalSearch,
    GlobalSearchOptions,
    PoseCandidate,
    SearchBudget,
    search_distances_mm,
)
from arview.detection.search.hypothesis import Hypothesis
from arview.detection.search.local_search import DISTINCT_DEG, LocalSearch, LocalSearchOptions
from arview.detection.symmetry import find_rotational_symmetries
from arview.errors import InputError
from arview.geometry import Array
from arview.guideviews import GuideViewSet, icosphere_directions
from arview.refinement import PoseEvidence

SAME_ASIDE = 0.12
SAME_ALONG = 0.15
SAME_DEG = 20.0
"""Offset across the line of sight in diameters, offset along it as a share of the distance, and rotation within which
two hypotheses are one, badly refined."""
LAST_BUDGETS = (GRADIENTS_ONLY, UNTRIMMED)
HOPELESS_QUALITY = 0.1
"""Searches that are left out after the others found no hypothesis of at least this quality."""
MIN_MORE_QUALITY = 0.01
"""Gain by a wider search below which no wider one follows for a result that is good enough, if not sure."""
NEARBY_ASIDE = 0.35
NEARBY_ALONG = 0.25
"""Offsets within which competing hypotheses are at the same place."""


GLOBAL_SEARCH = GlobalSearchOptions()
"""Options of the search for rough poses; its radius, roll step and subdivisions are those of `DetectorOptions`."""
LOCAL = LocalSearchOptions()
"""Options of the search around rough poses; its radius is that of `DetectorOptions`."""


@dataclass(frozen=True)
class DetectorOptions:
    """Options of the detector.

    Attributes:
        radius_px: half the part's diameter in the templates, 10 to 60.
        roll_step_deg: spacing of the templates in roll.
        subdivisions: icosahedron level of the template directions (2: 162, about 17° apart).
        budgets: of the searches; each is made only if those before it gave no sure result.
        min_quality: probability below which a result is no detection.
        min_quick_quality: probability above which a search ends without a wider one; margins over few competitors
            overstate it.

    Raises:
        InputError: ``radius_px`` is out of range.
    """

    radius_px: float = 20.0
    roll_step_deg: float = 18.0
    subdivisions: int = 2
    budgets: tuple[SearchBudget, ...] = (QUICK, QUICK_OUTER, WIDE, WIDE_OUTER, GRADIENTS_ONLY, UNTRIMMED)
    min_quality: float = 0.5
    min_quick_quality: float = 0.6

    def __post_init__(self) -> None:
        if not 10 <= self.radius_px <= 60:
            raise InputError(f"detector: radius_px = {self.radius_px}, expected 10 to 60")


NARROW_RANGE = DetectorOptions(radius_px=26.0, roll_step_deg=12.0, subdivisions=3)
"""Finer templates, for declared ranges in which they are few."""


def options_for(views: GuideViewSet, max_templates: int = 1500) -> DetectorOptions:
    """The options that suit the declared range of guide views.

    Args:
        views: of the part.
        max_templates: number of fine templates per scale up to which `NARROW_RANGE` is used.
    """
    fine = NARROW_RANGE
    directions = views.view_range.contains_direction(icosphere_directions(fine.subdivisions), 3.0)
    count = np.count_nonzero(directions) * len(views.view_range.rolls_deg(fine.roll_step_deg))
    return fine if count <= max_templates else DetectorOptions()


@dataclass(frozen=True)
class Detection:
    """A pose at which the part was found.

    Attributes:
        cam_from_model: (4,4) mm.
        quality: 0–1, probability that the pose is right.
        alternatives: other poses (4,4) that the image supports equally well; if there are any, the view is ambiguous.
    """

    cam_from_model: Array
    quality: float
    alternatives: tuple[Array, ...] = ()

    def to_dict(self) -> dict[str, object]:
        """The detection as JSON values, under the names of its attributes."""
        others = [pose.tolist() for pose in self.alternatives]
        return {"cam_from_model": self.cam_from_model.tolist(), "quality": self.quality, "alternatives": others}


@dataclass(frozen=True)
class RejectedHypothesis:
    """The best hypothesis of an image in which nothing was found.

    Attributes:
        cam_from_model: (4,4) mm.
        evidence: edge and colour evidence at the pose.
        quality: 0–1, probability that the pose is right.
    """

    cam_from_model: Array
    evidence: PoseEvidence
    quality: float


def local_search_for(views: GuideViewSet, camera: Camera, options: DetectorOptions | None = None) -> LocalSearch:
    """The local search that a detector with these options uses."""
    o = options or options_for(views)
    return LocalSearch(views, camera, replace(LOCAL, radius_px=o.radius_px), search_distances_mm(views, camera))


class Detector:
    """Detection of one part with one camera over the declared range of its guide views.

    Args:
        views: guide views of the part.
        camera: of the images.
        options: see `DetectorOptions`; None: those of `options_for`.
        local: local search to share; None: that of `local_search_for`.

    Attributes:
        best_rejected: best hypothesis of the last image, if nothing was found in it.
        symmetries: rotational symmetries of the part.
        disambiguator: chooses among near-symmetric poses.

    Raises:
        InputError: no guide view shows an outline.
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
        self.frames = FrameView(camera)
        self.camera = camera = self.frames.tracked_camera
        self.best_rejected: RejectedHypothesis | None = None
        self.local = local or local_search_for(views, camera, o)
        self.symmetries = find_rotational_symmetries(views)
        self.disambiguator = Disambiguator(self.local, self.symmetries)
        searched = replace(
            GLOBAL_SEARCH, radius_px=o.radius_px, roll_step_deg=o.roll_step_deg, subdivisions=o.subdivisions
        )
        self.global_search = GlobalSearch(
            views, self.local.refiner.part, self.local.reduced_camera, searched, self.symmetries.exact
        )

    def detect(
        self,
        image: NDArray[np.uint8],
        max_results: int = 3,
        is_thorough: bool = True,
        guesses: Sequence[Array] = (),
        searches: Sequence[int] | None = None,
    ) -> list[Detection]:
        """Poses of the part in an image, best first; an empty list when it is not found.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            max_results: maximum number of poses; all are above the quality threshold and apart from each other.
            is_thorough: search more widely when the quick search gives no sure result.
            guesses: rough poses (4,4) ``cam_from_model``; if one of them leads to the part, nothing else is searched.
            searches: indices of the only budgets that are used, so that a thorough search can be spread over several
                frames; a result must then be as sure as one of the quick search.

        Raises:
            InputError: an image of another size or type.
        """
        pyramid = self.local.pyramid(self._picture(image))
        if found := self._detect_near(pyramid, guesses):
            return found
        o = self.options
        is_complete = is_thorough and searches is None
        min_quality = o.min_quality if is_complete else max(o.min_quick_quality, o.min_quality)
        hypotheses = self.hypotheses(pyramid, is_thorough, searches)
        return self._detections(pyramid, hypotheses, max_results, min_quality)

    def detect_near(self, image: NDArray[np.uint8], guesses: Sequence[Array]) -> list[Detection]:
        """The best pose, or none, that some rough poses lead to.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            guesses: rough poses (4,4) ``cam_from_model``.
        """
        return self._detect_near(self.local.pyramid(self._picture(image)), guesses)

    def _picture(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The image, undistorted where its lens is one that the kernels do not know."""
        return self.frames.picture(np.asarray(image), 0)

    @property
    def wider_searches(self) -> list[int]:
        """Indices of the budgets after the first one that apply to this part."""
        has_outer = self.global_search.has_outer
        return [k for k, budget in enumerate(self.options.budgets) if k and (has_outer or not budget.is_outer)]

    def hypotheses(
        self, pyramid: ImagePyramid, is_thorough: bool = True, searches: Sequence[int] | None = None
    ) -> list[Hypothesis]:
        """All verified hypotheses of the searches, right or wrong, apart from each other, best first.

        Args:
            pyramid: of the image, see `LocalSearch.pyramid`.
            is_thorough: make all searches until one gives a sure result, not only the first.
            searches: indices of the only budgets that are used; None leaves the choice to ``is_thorough``.
        """
        o, local = self.options, self.local
        hypotheses: list[Hypothesis] = []
        min_quality = max(o.min_quick_quality, o.min_quality)
        if searches is None:
            searches = [0, *self.wider_searches] if is_thorough else [0]
        quality = 0.0
        for budget in (o.budgets[k] for k in searches):
            if budget in LAST_BUDGETS and quality < HOPELESS_QUALITY and hypotheses:
                break
            starts = local.pattern_search(pyramid, self.global_search.starts(pyramid, budget), budget.kept)
            found = local.refine_and_verify(pyramid, starts)
            hypotheses = local.deduplicate([*hypotheses, *found], DISTINCT_DEG)
            before, quality = quality, self.qualities(hypotheses)[0] if hypotheses else 0.0
            if hypotheses and quality < min_quality:
                # The search may have found a near-symmetric pose of the right one, which fits worse.
                counterparts = self.disambiguator.counterparts(pyramid, hypotheses[0])
                hypotheses = local.deduplicate([*hypotheses, *counterparts], DISTINCT_DEG)
                quality = self.qualities(hypotheses)[0]
            if quality >= min_quality or (o.min_quality <= quality <= before + MIN_MORE_QUALITY):
                break
        return hypotheses

    def qualities(self, hypotheses: list[Hypothesis]) -> list[float]:
        """Probability that each of several hypotheses, best first, is right; see `pose_probability`."""
        return [
            pose_probability(self.terms(h, hypotheses[k + 1 :]), self._share_cut_off(h))
            for k, h in enumerate(hypotheses)
        ]

    def _share_cut_off(self, hypothesis: Hypothesis) -> float:
        """Share of the outline that the picture's border cuts off a part so large that cut poses of it are searched."""
        camera = self.local.reduced_camera
        distance_mm = float(np.linalg.norm(hypothesis.cam_from_body[:3, 3]))
        span_px = 0.5 * (camera.fx + camera.fy) * self.views.diameter_mm / distance_mm
        is_large = span_px >= CUT_FILL * min(camera.width, camera.height)
        return 1.0 - hypothesis.evidence.points_in_picture if is_large else 0.0

    def terms(self, best: Hypothesis, others: list[Hypothesis]) -> ConfidenceTerms:
        """Terms of the probability of a hypothesis that competes with others."""
        return confidence_terms(
            appearance=best.appearance_score,
            evidence=best.evidence_logit,
            outline=best.outline_score,
            profile=best.profile_score,
            contour=best.contour_score,
            margins=self.margins(best, others),
            relative_lines=best.view_lines / self.local.mean_view_lines,
            radius_px=best.radius_px,
        )

    def margins(self, best: Hypothesis, others: list[Hypothesis]) -> Margins:
        """Margins of a hypothesis over competing ones; copies of it that are badly refined do not compete."""
        nearby = distant = -math.inf
        place = best.cam_from_body[:3, 3]
        distance_mm = float(np.linalg.norm(place))
        for other in others:
            offset = other.cam_from_body[:3, 3] - place
            along_mm = abs(float(offset @ place)) / distance_mm
            aside = math.sqrt(max(float(offset @ offset) - along_mm**2, 0.0)) / self.views.diameter_mm
            is_similar = is_rotated_by(best, other, self.disambiguator.all_rotations, SAME_DEG)
            if aside < SAME_ASIDE and along_mm < SAME_ALONG * distance_mm and is_similar:
                continue
            if aside < NEARBY_ASIDE and along_mm < NEARBY_ALONG * distance_mm:
                nearby = max(nearby, other.logit)
            else:
                distant = max(distant, other.logit)
        return Margins(best.logit - nearby, best.logit - distant)

    def _detect_near(self, pyramid: ImagePyramid, guesses: Sequence[Array]) -> list[Detection]:
        local = self.local
        starts = [PoseCandidate(1.0, guess @ local.refiner.part.model_from_body) for guess in guesses]
        found = local.refine_and_verify(pyramid, local.pattern_search(pyramid, starts)) if starts else []
        return self._detections(pyramid, found, 1, self.options.min_quality)

    def _detections(
        self, pyramid: ImagePyramid, hypotheses: list[Hypothesis], max_results: int, min_quality: float
    ) -> list[Detection]:
        """The hypotheses above a quality, best first; of none the best one is remembered as rejected."""
        qualities = self.qualities(hypotheses)
        self.best_rejected = None
        if not hypotheses or qualities[0] < min_quality:
            if hypotheses:
                rejected = hypotheses[0]
                self.best_rejected = RejectedHypothesis(self._in_model(rejected), rejected.evidence, qualities[0])
            return []
        best, alternatives = self.disambiguator.choose(pyramid, hypotheses[0], hypotheses[1:])
        found = [self._detection(pyramid, best, qualities[0], alternatives)]
        for hypothesis, quality in zip(hypotheses[1:], qualities[1:], strict=True):
            is_apart = all(not self._is_equal(hypothesis, h) for h in (best, *alternatives))
            if quality >= min_quality and is_apart:
                found.append(self._detection(pyramid, hypothesis, min(quality, qualities[0]), []))
        return sorted(found, key=lambda detection: -detection.quality)[:max_results]

    def _detection(
        self, pyramid: ImagePyramid, hypothesis: Hypothesis, quality: float, alternatives: list[Hypothesis]
    ) -> Detection:
        body_from_model = self.local.refiner.part.body_from_model
        pose, *others = (
            self.local.polish(pyramid, h.cam_from_body) @ body_from_model for h in (hypothesis, *alternatives)
        )
        return Detection(pose, quality, tuple(others))

    def _in_model(self, hypothesis: Hypothesis) -> Array:
        return np.asarray(hypothesis.cam_from_body @ self.local.refiner.part.body_from_model)

    def _is_equal(self, a: Hypothesis, b: Hypothesis, place_share: float = 0.25, angle_deg: float = 8.0) -> bool:
        """Whether two hypotheses are one pose up to a symmetry; ``place_share`` is in diameters."""
        apart_mm = np.linalg.norm(a.cam_from_body[:3, 3] - b.cam_from_body[:3, 3])
        is_near = bool(apart_mm <= place_share * self.views.diameter_mm)
        return is_near and is_rotated_by(a, b, self.disambiguator.all_rotations, angle_deg)
