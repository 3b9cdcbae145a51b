"""Search for one part: at an initial pose, near a guide pose, where it was remembered, in the picture, or by its base.

A frame without a pose asks for proposals and examines one after another, until one is accepted. Each is searched for
only when the one before was rejected.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.assembly import AssemblyMonitor
from arview.cad import Model
from arview.camera import Camera
from arview.core.messages import joined, key_of, sentence
from arview.core.parallel import single_threaded_blas
from arview.detection import Detection, Detector, LocalSearch, RejectedHypothesis, local_search_for
from arview.geometry import Array, apply, are_near, check_rigid
from arview.guideviews import GuideViewSet
from arview.pose import TrackingState
from arview.refinement import PartView
from arview.tracking.base_detection import BaseDetection
from arview.tracking.diagnosis import NOTHING_IN_VIEW, diagnose_picture, diagnose_search
from arview.tracking.search.guided_init import GuidedInit, GuidedPose
from arview.tracking.search.search_plan import EAGER_FRAMES, SearchPlan
from arview.tracking.session_options import LOST_QUALITY, TRACKED_QUALITY, SessionOptions
from arview.tracking.session_state import SessionState
from arview.tracking.several.specimens import CoveredPlace, is_same_specimen, searched_picture

ALTERNATIVE_SHARE = 0.25
ALTERNATIVE_DEG = 8.0
"""Distance in diameters and rotation from which another pose that was found is an alternative."""
USE_BASE_DETECTION = True
"""Search for the base alone where the search for the whole part fails."""
LOCK_QUALITY = 0.8
"""A detection of this quality is accepted at once; a weaker one must be confirmed by a second frame. Near a given
initial pose ``TRACKED_QUALITY`` is enough."""
ALIGN_AGAIN_FRAMES = 60
"""Frames after a loss from which the part may be aligned with the guide view again."""
ALIGN_ADVICE_EVERY = 10
"""Frames between two checks of the picture while the session waits for the alignment."""
DISTANCE_MARGIN = 2.0
"""Factor by which a pose may be nearer or farther than the declared range."""

ALIGN = sentence("tracking.align")
"""Reason given while the session waits for the part at its guide pose."""


class FoundPose(NamedTuple):
    """A pose at which the part may be.

    Attributes:
        cam_from_model: (4,4) mm.
        lock_quality: quality from which it is accepted at once; a weaker one must be confirmed by the next frame.
        min_quality: quality below which it is rejected.
        alternatives: poses (4,4) that fit as well.
        rests_on_base: whether only the base was found, which says nothing of the other components.
        guide_cam_from_model: (4,4) guide pose to which it must stay near; None: it was not found by alignment.
        quality: 0–1, probability by what found it that it is right; 1 for what was not found by the detector.
        is_given: whether it is near the initial pose; the part is followed from there with weak support, too.
    """

    cam_from_model: Array
    lock_quality: float = LOCK_QUALITY
    min_quality: float = TRACKED_QUALITY
    alternatives: tuple[Array, ...] = ()
    rests_on_base: bool = False
    guide_cam_from_model: Array | None = None
    quality: float = 1.0
    is_given: bool = False


class PartSearch:
    """The searches for one specimen of a part with one camera.

    Args:
        views: guide views of the part.
        camera: of the pictures.
        model: of the guide views.
        options: of the session.
        initial_cam_from_model: (4,4) mm, rough pose in the first frame.
        guide_cam_from_model: (4,4) mm, pose near which the part is first brought by the user.
        like: search for another specimen of the same part, whose detectors are shared.

    Attributes:
        local: the local search of the detector.
        others: poses (4,4) of other specimens of the part, which are not taken for this one.
        covers: where other parts are, at which this one is searched for in every second round of searches only.
        prior: (4,4) pose in this frame that is known from elsewhere, near which the part is searched for first.

    Raises:
        InputError: an initial or guide pose that is not a rigid transform.
    """

    def __init__(
        self,
        views: GuideViewSet,
        camera: Camera,
        model: Model,
        options: SessionOptions,
        *,
        initial_cam_from_model: Array | None = None,
        guide_cam_from_model: Array | None = None,
        like: PartSearch | None = None,
    ) -> None:
        self._views, self._camera, self._options = views, camera, options
        self.local: LocalSearch = local_search_for(views, camera, options.detector) if like is None else like.local
        self._detector: Detector | None = None if like is None else like.detector
        self._base: BaseDetection = (
            BaseDetection(views, camera, model, options.detector) if like is None else like._base
        )
        self._guided_init: GuidedInit | None = None
        self._plan = SearchPlan(views, camera)
        self._initial = None if initial_cam_from_model is None else check_rigid(initial_cam_from_model, "initial pose")
        self._guide = None if guide_cam_from_model is None else check_rigid(guide_cam_from_model, "guide pose")
        self.others: tuple[Array, ...] = ()
        self.covers: tuple[CoveredPlace, ...] = ()
        self.prior: Array | None = None

    @property
    def detector(self) -> Detector:
        """The detector, created when first needed."""
        if self._detector is None:
            with single_threaded_blas():
                self._detector = Detector(self._views, self._camera, self._options.detector, local=self.local)
        return self._detector

    @property
    def base_part(self) -> PartView | None:
        """Guide views of the base alone for the tracker; None before the first search for it."""
        return self._base.part

    @property
    def has_guide(self) -> bool:
        """Whether the part is first found when it is brought near a guide pose."""
        return self._guide is not None

    def guide_pose(self, state: SessionState) -> Array | None:
        """The guide pose (4,4) while the part can be found by bringing it there, else None."""
        has_waited = state.state == TrackingState.LOST and state.frames_without_pose > ALIGN_AGAIN_FRAMES
        return self._guide if state.state == TrackingState.SEARCHING or has_waited else None

    def proposals(
        self, image: NDArray[np.uint8], state: SessionState, components: AssemblyMonitor
    ) -> Iterator[FoundPose]:
        """Poses at which the part may be, to be examined in this order; after the last one the state holds a reason.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            state: of the session, in which planned searches and the reason are noted.
            components: what is known of the components of the part.
        """
        if self._initial is not None:
            yield from self._at_initial_pose(image, state, self._initial)
            return
        if self.prior is not None and (near := self._guided.find(image, self.prior)) is not None:
            yield FoundPose(near.cam_from_model)
        if self._guide is not None and state.state == TrackingState.SEARCHING:
            yield from self._at_guide_pose(image, state, self._guide)
            return
        searches = self._plan.searches(image, state, self.detector)
        covers = self.covers if self._plan.hides_parts(state) else ()
        shown = searched_picture(image, self.others, covers, self._views, self._camera)
        is_bare = USE_BASE_DETECTION and components.may_be_bare and self._options.finder is None
        found = self._detect(shown, state, searches)
        whole = next((one for one in found if not self.is_other(one.cam_from_model)), None)
        if whole is not None:
            if is_bare and state.state == TrackingState.LOST:
                whole = self._turned(image, whole, components, state.frames_without_pose)
            yield FoundPose(whole.cam_from_model, alternatives=whole.alternatives, quality=whole.quality)
        if searches != []:
            base = self.find_base(shown, searches, components, state.frames_without_pose) if is_bare else None
            if base is not None:
                yield base
            if whole is None:
                state.reason = self.diagnose(image, state, self.detector.best_rejected)
        elif whole is None and (guide := self.guide_pose(state)) is not None:
            yield from self._at_guide_pose(image, state, guide)

    def find_base(
        self,
        image: NDArray[np.uint8],
        searches: list[int] | None,
        components: AssemblyMonitor,
        frames_lost: int | None = None,
    ) -> FoundPose | None:
        """The base of the part alone, turned as the picture (H,W,3) uint8 RGB shows the other components.

        Args:
            image: of the camera's size.
            searches: those that were made for the whole part, see `Detector.detect`.
            components: of the part.
            frames_lost: frames without a pose; None: the part is followed.
        """
        found = [one for one in self._base.detect(image, searches) if not self.is_other(one.cam_from_model)]
        if not found:
            return None
        base = self._turned(image, found[0], components, frames_lost)
        return FoundPose(
            base.cam_from_model, math.inf, alternatives=base.alternatives, rests_on_base=True, quality=base.quality
        )

    def find_whole(
        self, image: NDArray[np.uint8], components: AssemblyMonitor, cam_from_model: Array
    ) -> FoundPose | None:
        """The whole part, now and then, for a pose (4,4) that rests on the base, see `BaseDetection.find_whole`."""
        found = self._base.find_whole(image, self.detector, components, cam_from_model, LOCK_QUALITY)
        if found is None or self.is_other(found.cam_from_model):
            return None
        return FoundPose(found.cam_from_model, alternatives=found.alternatives, quality=found.quality)

    def is_base_due(self, components: AssemblyMonitor, is_restless: bool) -> bool:
        """Whether the base of a part that is followed is to be searched for again; asked in each frame."""
        is_absent = USE_BASE_DETECTION and components.has_absent
        return is_absent and self._base.is_recheck_due(components.is_bare, is_restless)

    def is_same(self, components: AssemblyMonitor, found: FoundPose, cam_from_model: Array) -> bool:
        """Whether a found pose is a given one (4,4), or would be if the base had no other components."""
        return self._base.is_same(components, found.cam_from_model, cam_from_model)

    def is_other(self, cam_from_model: Array) -> bool:
        """Whether a pose (4,4) is that of another specimen."""
        return any(is_same_specimen(cam_from_model, other, self._views) for other in self.others)

    def is_possible(self, cam_from_model: Array, guide_cam_from_model: Array | None = None) -> bool:
        """Whether a pose (4,4) is in front of the camera, about as far as declared, and near a guide pose (4,4)."""
        center = apply(cam_from_model, self._views.center_in_model)
        low, high = self._views.view_range.distance_mm
        is_in_range = center[2] > 0 and low / DISTANCE_MARGIN < np.linalg.norm(center) < DISTANCE_MARGIN * high
        is_near = guide_cam_from_model is None or self._guided.is_near(cam_from_model, guide_cam_from_model)
        return bool(is_in_range and is_near)

    def near(self, image: NDArray[np.uint8], cam_from_model: Array) -> GuidedPose | None:
        """The best pose near a given one (4,4) in an image (H,W,3) uint8 RGB, see `GuidedInit.find`."""
        return self._guided.find(image, cam_from_model)

    def anywhere(self, image: NDArray[np.uint8], max_results: int, is_thorough: bool) -> Sequence[Detection]:
        """Poses of the part in an image (H,W,3) uint8 RGB, best first, see `Detector.detect`."""
        return self.detector.detect(image, max_results, is_thorough)

    def diagnose(self, image: NDArray[np.uint8], state: SessionState, rejected: RejectedHypothesis | None) -> str:
        """Why a search found nothing; of a lost part the loss says more than that nothing is in view."""
        reason = diagnose_search(image, self._camera, self._views, rejected)
        if state.state != TrackingState.LOST:
            return reason
        reason = state.loss_reason if key_of(reason) == NOTHING_IN_VIEW else reason
        return reason if self.guide_pose(state) is None else joined((reason, ALIGN))

    @property
    def _guided(self) -> GuidedInit:
        """The search around a given pose, created when first needed."""
        if self._guided_init is None:
            self._guided_init = GuidedInit(self._views, self._camera)
        return self._guided_init

    def _at_initial_pose(
        self, image: NDArray[np.uint8], state: SessionState, cam_from_model: Array
    ) -> Iterator[FoundPose]:
        """The part near the initial pose, which is used only once."""
        found = self._guided.find(image, cam_from_model)
        self._initial = None
        if found is None:
            state.reason = "the part is outside the picture at the initial pose"
        else:
            # Where the part should be is known, so that less can be mistaken for it than in a search.
            yield FoundPose(found.cam_from_model, TRACKED_QUALITY, LOST_QUALITY, is_given=True)

    def _at_guide_pose(
        self, image: NDArray[np.uint8], state: SessionState, guide_cam_from_model: Array
    ) -> Iterator[FoundPose]:
        """The part near the guide pose; what is found must be confirmed by the next frame."""
        found = self._guided.lock(image, guide_cam_from_model, LOCK_QUALITY)
        if found is not None:
            yield FoundPose(found.cam_from_model, math.inf, LOCK_QUALITY, guide_cam_from_model=guide_cam_from_model)
        if state.state == TrackingState.SEARCHING and state.frames_without_pose % ALIGN_ADVICE_EVERY == 1:
            state.reason = diagnose_picture(image) or ALIGN

    def _detect(self, image: NDArray[np.uint8], state: SessionState, searches: list[int] | None) -> list[Detection]:
        """Detect the part, shortly after a loss where it was last; nothing without searches."""
        if searches == []:
            return []
        if self._options.finder is not None:
            return list(self._options.finder.detect(image))
        last = state.last_sure_pose if state.frames_without_pose <= EAGER_FRAMES else None
        guesses = [] if last is None else [last]
        return self.detector.detect(image, max_results=1, guesses=guesses, searches=searches)

    def _turned(
        self, image: NDArray[np.uint8], found: Detection, components: AssemblyMonitor, frames_lost: int | None
    ) -> Detection:
        """A detection, turned as the picture shows the components, and as the part lay before a short loss."""
        pose = components.best_turned(image, found.cam_from_model, frames_lost)
        apart_mm = ALTERNATIVE_SHARE * self._views.diameter_mm
        others = [other for other in found.alternatives if not are_near(other, pose, apart_mm, ALTERNATIVE_DEG)]
        return replace(found, cam_from_model=pose, alternatives=tuple(others))
