"""TrackingSession: detects one part and tracks it through a stream of frames.

The part is ``searching`` until first found, ``tracked`` while the picture supports its pose, ``critical`` while the
support is weak, and ``lost`` when there is none. Every frame follows the last pose or searches for the part; a pose is
then disambiguated, its components are checked, and the part's appearance is remembered. The transitions between the
states are a table, see `session_state`.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from arview.assembly import AssemblyMonitor, Turn
from arview.cad import Model
from arview.camera import Camera, FrameView
from arview.core.checks import check_type
from arview.core.parallel import single_threaded_blas
from arview.detection import Detection, Detector, LocalSearch, RejectedHypothesis, local_search_for
from arview.errors import MismatchError
from arview.fiducials import SerialNumbers
from arview.geometry import Array, apply, are_near, check_rigid, invert
from arview.guideviews import GuideViewSet
from arview.pose import Identity, Pose, TrackingState
from arview.tracking.appearance_memory import AppearanceMemory
from arview.tracking.base_detection import BaseDetection
from arview.tracking.diagnosis import NOTHING_IN_VIEW, diagnose_loss, diagnose_picture, diagnose_search
from arview.tracking.disambiguation import HypothesisSet
from arview.tracking.estimate import Estimate
from arview.tracking.guided_init import GuidedInit
from arview.tracking.identity import IdentityMonitor
from arview.tracking.pose_recheck import LocalSearchRecheck
from arview.tracking.search_plan import EAGER_FRAMES, SearchPlan
from arview.tracking.session_options import CRITICAL_QUALITY, LOST_QUALITY, TRACKED_QUALITY, SessionOptions
from arview.tracking.session_state import Event, SessionState
from arview.tracking.several.specimens import CoveredPlace, is_same_specimen, searched_picture
from arview.tracking.tracker import Tracker
from arview.tracking.tracker_options import TrackerOptions

ALTERNATIVE_SHARE = 0.25
ALTERNATIVE_DEG = 8.0
"""Distance in diameters and rotation from which another pose that was found is an alternative."""
USE_BASE_DETECTION = True
"""Search for the base alone where the search for the whole part fails."""
LOCK_QUALITY = 0.8
"""A detection of this quality is accepted at once; a weaker one must be confirmed by a second frame. Near a given
initial pose ``TRACKED_QUALITY`` is enough."""
LOST_FRAMES = 2
"""Frames in a row below ``LOST_QUALITY`` after which the part is lost."""
CRITICAL_FRAMES = 45
"""Critical frames in a row after which the part is lost."""
MIN_RESTING_SCORE = 0.7
"""Correlation with the remembered appearance from which a place is examined in frames between two searches of the whole
picture."""
ALIGN_AGAIN_FRAMES = 60
"""Frames after a loss from which the part may be aligned with the guide view again."""
ALIGN_ADVICE_EVERY = 10
"""Frames between two checks of the picture while the session waits for the alignment."""
MIN_IN_PICTURE = 0.25
"""Share of the outline inside the picture below which no pose is kept."""
DISTANCE_MARGIN = 2.0
"""Factor by which a pose may be nearer or farther than the declared range."""

ALIGN = "align the part with the outline"
"""Reason given while the session waits for the part at its guide pose."""
SAME_SPECIMEN = (Identity.FOLLOWED, Identity.CONFIRMED)
"""With these identities what was known of the components before a loss is taken up."""


class TrackingSession:
    """Detects and tracks a part through a stream of frames.

    Args:
        views: guide views of the model.
        camera: of the frames.
        model: the CAD model of the guide views; the texture modality needs its surface.
        options: see `SessionOptions`.
        initial_cam_from_model: (4,4) mm, rough pose in the first frame, which is refined instead of a search.
        guide_cam_from_model: (4,4) mm, guide pose. The part is first found when it is brought near this pose, not by
            a search, and by both after it has been lost for a while.
        like: another session of the same guide views, camera and options, whose detector and preparation are shared.
        serials: serial number of the part to which the labels belong, to be read from codes in the frames; None: codes
            are not read.

    Attributes:
        views: guide views of the model.
        frames, camera: how frames become the pictures that are tracked, and the camera of these.
        others: poses (4,4) of other specimens of the part, which are not taken for this one.
        covers: where other parts are, at which this one is searched for in every second round of searches only.
        identity: says whether the specimen in view is the one that was followed.

    Raises:
        MismatchError: the guide views belong to another model.
        InputError: an initial or guide pose that is not a rigid transform.
    """

    def __init__(
        self,
        views: GuideViewSet,
        camera: Camera,
        model: Model,
        options: SessionOptions | None = None,
        *,
        initial_cam_from_model: Array | None = None,
        guide_cam_from_model: Array | None = None,
        like: TrackingSession | None = None,
        serials: SerialNumbers | None = None,
    ) -> None:
        check_type(views, GuideViewSet, "TrackingSession: views")
        check_type(camera, Camera, "TrackingSession: camera")
        check_type(model, Model, "TrackingSession: model")
        self.options = o = options or SessionOptions()
        if views.model_hash != model.source_hash:
            raise MismatchError(
                f"guide views of model {views.model_name!r} ({views.model_hash[:12]}) do not belong to "
                f"{model.name!r} ({model.source_hash[:12]})"
            )
        self.frames: FrameView = FrameView(camera) if like is None else like.frames
        self.camera = camera = self.frames.tracked_camera
        self.views = views
        self.others: tuple[Array, ...] = ()
        self.covers: tuple[CoveredPlace, ...] = ()
        self._local: LocalSearch = local_search_for(views, camera, o.detector) if like is None else like._local
        self.tracker = Tracker(
            views,
            camera,
            model,
            TrackerOptions(use_region=o.use_region, use_edge=o.use_edge, use_texture=o.use_texture),
            recheck=LocalSearchRecheck(self._local) if o.use_recheck else None,
            part=self._local.refiner.part,
        )
        self._detector: Detector | None = None if like is None else like.detector
        self._initial = None if initial_cam_from_model is None else check_rigid(initial_cam_from_model, "initial pose")
        self._guide = None if guide_cam_from_model is None else check_rigid(guide_cam_from_model, "guide pose")
        self._guided_init: GuidedInit | None = None
        self._base: BaseDetection = BaseDetection(views, camera, model, o.detector) if like is None else like._base
        self.components: AssemblyMonitor = AssemblyMonitor(
            views, camera, model, like=None if like is None else like.components
        )
        self.appearance_memory = AppearanceMemory(views, camera)
        self._search_plan = SearchPlan(views, camera)
        self.identity = IdentityMonitor(views, camera, serials)
        self._state = SessionState()

    def __repr__(self) -> str:
        return f"<TrackingSession {self.views.model_name}: {self.state}, {len(self.views)} views, {self.camera!r}>"

    @property
    def state(self) -> TrackingState:
        """State after the last frame."""
        return self._state.state

    @property
    def has_pose(self) -> bool:
        """Whether the part was found and is followed."""
        return self._state.has_pose

    @property
    def reason(self) -> str:
        """Why the last search found nothing, or why the part was lost."""
        return self._state.reason

    @property
    def detector(self) -> Detector:
        """The detector, created when first needed."""
        if self._detector is None:
            with single_threaded_blas():
                self._detector = Detector(self.views, self.camera, self.options.detector, local=self._local)
        return self._detector

    @property
    def guided_init(self) -> GuidedInit:
        """The search around a given pose, created when first needed."""
        if self._guided_init is None:
            self._guided_init = GuidedInit(self.views, self.camera)
        return self._guided_init

    @property
    def is_aligning(self) -> bool:
        """Whether the part can be found by bringing it near the guide pose."""
        s = self._state
        has_waited = s.state == TrackingState.LOST and s.frames_without_pose > ALIGN_AGAIN_FRAMES
        return self._guide is not None and (s.state == TrackingState.SEARCHING or has_waited)

    def reset(self) -> None:
        """Forget the part's pose and search again. The remembered appearance is kept."""
        self._state = SessionState()
        self.components.forget()
        self.identity.reset()

    def confirm(self) -> None:
        """Say that the specimen tracked now is the one to which the labels belong, see `Identity`."""
        self.identity.confirm()

    def name_at(self, index: int, pixel: tuple[float, float]) -> None:
        """As `IdentityMonitor.name_at`, for a pixel of the frames as they come; raises InputError outside them."""
        self.identity.name_at(index, self.frames.pixel(pixel))

    def give_up(self, reason: str) -> None:
        """Give the pose up, for a reason in words, and search again."""
        if self.has_pose:
            self._give_up(reason)

    def process(self, image: NDArray[np.uint8], index: int, time_s: float) -> Pose:
        """Pose and state of the next frame.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            index: index of the frame, copied into the pose.
            time_s: time stamp of the frame, copied into the pose.

        Raises:
            InputError: an image of another size or type.
        """
        started = time.perf_counter()
        image = self.frames.picture(image, index)
        estimate, reason = self._follow(image) if self._state.has_pose else self._search(image)
        if estimate is not None:
            estimate, reason = self._disambiguate(image, estimate, reason)
            reason = self._check_components(image, estimate, reason)
            self._remember(image, estimate)
        known = self.identity.update(image, estimate, index, time_s, self, self._state.is_confirmed)
        if known.cam_from_model is not None and estimate is not None:
            estimate = self._restart(image, known.cam_from_model)
        elif estimate is not None and self._state.is_confirmed and known.identity in SAME_SPECIMEN:
            self.components.resume(estimate.cam_from_model, self._state.frames_without_pose)
        ms = (time.perf_counter() - started) * 1e3
        if estimate is None:
            guide = self._guide if self.is_aligning else None
            return Pose(
                None,
                None,
                0.0,
                state=self.state,
                time_s=time_s,
                index=index,
                ms=ms,
                reason=reason,
                guide_cam_from_model=guide,
            )
        pose = estimate.cam_from_model
        return Pose(
            cam_from_model=pose,
            covariance=self.tracker.covariance(estimate),
            quality=estimate.quality,
            state=self.state,
            time_s=time_s,
            index=index,
            ms=ms,
            reason=reason,
            mismatches=self.components.mismatches,
            unverified=self.components.unverified,
            alternatives=(*self._state.hypotheses.poses(pose), *self.components.other_poses(pose)),
            identity=known.identity,
            identity_reason=known.reason,
            serial=known.serial,
            components=self.components.presence(pose, bool(self._state.hypotheses)),
        )

    # --- Follow a pose ------------------------------------------------------------------------------------

    def _follow(self, image: NDArray[np.uint8]) -> tuple[Estimate | None, str]:
        """Track the part into this frame; the reason says why the pose is weak or was given up."""
        s = self._state
        estimate = self.tracker.track(image)
        is_possible = self._is_possible(estimate)
        is_outside = estimate.evidence.points_in_picture < MIN_IN_PICTURE or not is_possible
        is_poor = is_outside or estimate.quality < LOST_QUALITY
        s.poor_frames = s.poor_frames + 1 if is_poor else 0
        if s.poor_frames >= LOST_FRAMES or (is_poor and not s.is_confirmed):
            recent = (s.recent_poses[0], s.recent_poses[1]) if len(s.recent_poses) == 2 else None
            return self._give_up(diagnose_loss(image, estimate, recent, self.camera, self.views, is_possible))
        if not is_poor:
            s.recent_poses = (*s.recent_poses[-1:], estimate.cam_from_model)
            is_supported = estimate.quality >= (CRITICAL_QUALITY if s.is_supported else TRACKED_QUALITY)
            if is_supported and not estimate.is_restless:
                s.confirm()
                return estimate, ""
        s.apply(Event.WEAK)
        s.critical_frames += 1
        if s.critical_frames > CRITICAL_FRAMES or not s.is_confirmed:
            return self._give_up("the outline is not seen where it should be")
        return estimate, "the pose jumps" if estimate.is_restless else "the outline is hardly seen"

    def _give_up(self, reason: str) -> tuple[None, str]:
        """Give the pose up; one from the guide view that was never confirmed leaves the session waiting as before."""
        if self._guide is not None and not self._state.is_confirmed:
            self._state.retract()
        else:
            recent = self._state.recent_poses
            self._state.lose(reason)
            # Poses shortly before a loss may be wrong; the identity rests on the last one without doubt.
            last = self.identity.last_pose
            self.components.set_aside(recent[-1] if last is None and recent else last)
        return None, self._state.reason

    def _is_possible(self, estimate: Estimate) -> bool:
        """Whether the part is in front of the camera and not much nearer or farther than declared."""
        center = apply(estimate.cam_from_model, self.views.center_in_model)
        low, high = self.views.view_range.distance_mm
        margin = DISTANCE_MARGIN
        return bool(center[2] > 0 and low / margin < np.linalg.norm(center) < margin * high)

    # --- Search -------------------------------------------------------------------------------------------

    def _search(self, image: NDArray[np.uint8]) -> tuple[Estimate | None, str]:
        """Find the part: at the initial pose, at the guide pose, or by detection; the reason says why not."""
        s = self._state
        s.frames_without_pose += 1
        if self._initial is not None:
            return self._initialize(image, self._initial)
        if s.state == TrackingState.SEARCHING and self._guide is not None:
            return self._align(image, self._guide)
        searches = self._search_plan.searches(image, s, self.detector)
        is_resting = searches == []
        covers = self.covers if self._search_plan.hides_parts(s) else ()
        searched = searched_picture(image, self.others, covers, self.views, self.camera)
        detections = self._detect_remembered(searched) if is_resting else self._detect(searched, searches)
        detections = [one for one in detections if not self._is_other(one.cam_from_model)]
        reason, is_bare = "", USE_BASE_DETECTION and self.components.may_be_bare
        if detections:
            found = detections[0]
            if is_bare and s.state == TrackingState.LOST:
                found = self._as_before(image, found)
            estimate, reason = self._begin_detected(image, found, LOCK_QUALITY)
            if estimate is not None or is_resting:
                return estimate, reason
        if not is_resting:
            bare = self._detect_base(searched, searches) if is_bare else None
            if bare is not None:
                self._expect_base(bare.cam_from_model)
                estimate, base_reason = self._begin_detected(image, bare, math.inf)
                if estimate is not None:
                    self.components.is_placed = False
                    return estimate, base_reason
            return None, reason or self._diagnose(image, self.detector.best_rejected)
        if self._guide is not None and self.is_aligning:
            return self._align(image, self._guide)
        return None, s.reason

    def _begin_detected(
        self, image: NDArray[np.uint8], found: Detection, lock_quality: float
    ) -> tuple[Estimate | None, str]:
        """Accept a detection and its alternatives, see `_begin`."""
        self._state.hypotheses = _alternatives_of(found)
        return self._begin(image, found.cam_from_model, lock_quality)

    def _detect_base(self, image: NDArray[np.uint8], searches: list[int] | None) -> Detection | None:
        """Detect the base of the part alone, and turn it as the picture shows the other components."""
        found = [one for one in self._base.detect(image, searches) if not self._is_other(one.cam_from_model)]
        return self._as_before(image, found[0]) if found else None

    def _as_before(self, image: NDArray[np.uint8], found: Detection) -> Detection:
        """A detection, turned as the picture shows the components, and as the part lay before a short loss."""
        frames_lost = None if self.has_pose else self._state.frames_without_pose
        pose = self.components.best_turned(image, found.cam_from_model, frames_lost)
        apart_mm = ALTERNATIVE_SHARE * self.views.diameter_mm
        others = [other for other in found.alternatives if not are_near(other, pose, apart_mm, ALTERNATIVE_DEG)]
        return replace(found, cam_from_model=pose, alternatives=tuple(others))

    def _expect_base(self, cam_from_model: Array) -> None:
        """Let the tracker expect no component but the base until they are seen."""
        whole = self._local.refiner.part
        self.tracker.refiner.part = self.components.base_lines(whole, cam_from_model, self._base.part)

    def _is_other(self, cam_from_model: Array) -> bool:
        """Whether a pose (4,4) is that of another specimen."""
        return any(is_same_specimen(cam_from_model, other, self.views) for other in self.others)

    def _initialize(self, image: NDArray[np.uint8], cam_from_model: Array) -> tuple[Estimate | None, str]:
        """Find the part near the initial pose, which is used only once."""
        found = self.guided_init.find(image, cam_from_model)
        self._initial = None
        if found is None:
            return None, "the part is outside the picture at the initial pose"
        # Where the part should be is known, so that less can be mistaken for it than in a search.
        return self._begin(image, found.cam_from_model, TRACKED_QUALITY)

    def _begin(
        self, image: NDArray[np.uint8], cam_from_model: Array, lock_quality: float
    ) -> tuple[Estimate | None, str]:
        """Accept a found pose if it is good enough; one below a quality must be confirmed by the next frame."""
        estimate = self._restart(image, cam_from_model)
        if estimate.quality < TRACKED_QUALITY or not self._is_possible(estimate):
            rejected = RejectedHypothesis(estimate.cam_from_model, estimate.evidence, estimate.quality)
            return None, self._diagnose(image, rejected)
        is_confirmed = estimate.quality >= lock_quality
        self._state.begin(is_confirmed)
        return estimate, "" if is_confirmed else "found, to be confirmed"

    def _restart(self, image: NDArray[np.uint8], cam_from_model: Array, turn: Turn | None = None) -> Estimate:
        """Track from a pose on; nothing is known of the components yet, unless it is the pose so far, turned."""
        self.tracker.start(image, cam_from_model)
        if turn is None:
            self.components.reset()
        else:
            self.components.turn(turn)
        return self.tracker.track(image)

    def _detect(self, image: NDArray[np.uint8], searches: list[int] | None) -> list[Detection]:
        """Detect the part in the whole picture, with the remembered appearance as a hint."""
        o, s = self.options, self._state
        guesses: list[Array] = []
        if o.use_appearance_memory:
            if s.last_sure_pose is not None and s.frames_without_pose <= EAGER_FRAMES:
                guesses = self._remembered(image, s.last_sure_pose)
            guesses = guesses or self._remembered(image)
        return self.detector.detect(image, max_results=1, guesses=guesses, searches=searches)

    def _detect_remembered(self, image: NDArray[np.uint8]) -> list[Detection]:
        """Detect the part only where the picture looks like the last sure view of it."""
        near = self._state.last_sure_pose
        if not self.options.use_appearance_memory or near is None:
            return []
        guesses = self._remembered(image, near, MIN_RESTING_SCORE)
        return self.detector.detect_near(image, guesses) if guesses else []

    def _remembered(self, image: NDArray[np.uint8], near: Array | None = None, min_score: float = 0.0) -> list[Array]:
        """Rough poses (4,4) where the picture looks like a remembered view, best first."""
        matches = self.appearance_memory.propose(image, near)
        return [match.cam_from_model for match in matches if match.score >= min_score]

    def _align(self, image: NDArray[np.uint8], guide_cam_from_model: Array) -> tuple[Estimate | None, str]:
        """Find the part near the guide pose; what is found must be confirmed by the next frame."""
        s = self._state
        found = self.guided_init.lock(image, guide_cam_from_model, LOCK_QUALITY)
        if found is not None:
            estimate = self._restart(image, found.cam_from_model)
            is_good = estimate.quality >= LOCK_QUALITY and self._is_possible(estimate)
            if is_good and self.guided_init.is_near(estimate.cam_from_model, guide_cam_from_model):
                s.reason = ALIGN
                s.begin(is_confirmed=False)
                return estimate, "found, to be confirmed"
        if s.state == TrackingState.SEARCHING and s.frames_without_pose % ALIGN_ADVICE_EVERY == 1:
            s.reason = diagnose_picture(image) or ALIGN
        return None, s.reason

    def _diagnose(self, image: NDArray[np.uint8], rejected: RejectedHypothesis | None) -> str:
        """Why a search found nothing; of a lost part the loss says more than that nothing is in view."""
        s = self._state
        reason = diagnose_search(image, self.camera, self.views, rejected)
        is_lost = s.state == TrackingState.LOST
        s.reason = s.loss_reason if is_lost and reason.startswith(NOTHING_IN_VIEW) else reason
        if is_lost and self.is_aligning:
            s.reason += f"; {ALIGN}"
        return s.reason

    # --- Examine a pose -----------------------------------------------------------------------------------

    def _disambiguate(self, image: NDArray[np.uint8], estimate: Estimate, reason: str) -> tuple[Estimate, str]:
        """Compare an ambiguous pose with its alternatives until the frames decide between them."""
        s = self._state
        has_absent = USE_BASE_DETECTION and self.components.has_absent
        if has_absent and self._base.is_recheck_due(self.components.is_bare, estimate.is_restless):
            estimate = self._recheck_base(image, estimate)
        if self.components.rests_on_base:
            estimate = self._recheck_whole(image, estimate)
        if (turn := self.components.better_turn) is not None:
            return self._restart(image, estimate.cam_from_model @ turn.model_from_model, turn), reason
        if not s.hypotheses:
            return estimate, reason
        others = s.hypotheses.poses(estimate.cam_from_model)
        score, *other_scores = self.tracker.scores_near(image, [estimate.cam_from_model, *others])
        if (better := s.hypotheses.update(score, other_scores)) is not None:
            s.hypotheses = HypothesisSet([])
            return self._restart(image, estimate.cam_from_model @ better), reason
        if not s.hypotheses or reason:
            return estimate, reason
        s.apply(Event.CONTRADICTED)
        poses = "another pose fits" if len(s.hypotheses) == 1 else f"{len(s.hypotheses)} other poses fit"
        return estimate, f"ambiguous: {poses} as well; show another side"

    def _recheck_base(self, image: NDArray[np.uint8], estimate: Estimate) -> Estimate:
        """Search again for a part of which little is seen, and go on where it is if that is elsewhere."""
        found = self._detect_base(image, [0])
        if found is None or self._is_placed_by(found, estimate):
            return estimate
        self._expect_base(found.cam_from_model)
        estimate = self._restart(image, found.cam_from_model)
        self.components.is_placed = False
        return estimate

    def _recheck_whole(self, image: NDArray[np.uint8], estimate: Estimate) -> Estimate:
        """Go on where the whole part is found, if only its base was found before and that elsewhere."""
        pose, min_quality = estimate.cam_from_model, LOCK_QUALITY
        found = self._base.find_whole(image, self.detector, self.components, pose, min_quality)
        if found is None or self._is_other(found.cam_from_model) or self._is_placed_by(found, estimate):
            return estimate
        self._state.hypotheses = _alternatives_of(found)
        return self._restart(image, found.cam_from_model)

    def _is_placed_by(self, found: Detection, estimate: Estimate) -> bool:
        """Whether a search found the part where it is followed, by which its pose is known to be right."""
        is_same = self._base.is_same(self.components, found.cam_from_model, estimate.cam_from_model)
        self.components.is_placed |= is_same
        return is_same

    def _check_components(self, image: NDArray[np.uint8], estimate: Estimate, reason: str) -> str:
        """Check that the components are where the CAD has them; a part with a wrong one is never ``tracked``."""
        s = self._state
        s.is_supported = s.state == TrackingState.TRACKED
        self.components.update(image, estimate.cam_from_model, estimate.quality, s.is_supported)
        whole = self._local.refiner.part
        self.tracker.refiner.part = self.components.present_lines(whole, estimate.cam_from_model, self._base.part)
        reasons = [one for one in (reason, *self.components.mismatches) if one]
        if self.components.uncertain and not reasons:
            reasons = [f"in doubt: {', '.join(self.components.uncertain)}"]
        if reasons:
            s.apply(Event.CONTRADICTED)
        return "; ".join(reasons)

    def _remember(self, image: NDArray[np.uint8], estimate: Estimate) -> None:
        """Remember pose and appearance of a part that is tracked without doubt."""
        is_sure = self.state == TrackingState.TRACKED and self._state.is_confirmed
        if self.options.use_appearance_memory:
            self.appearance_memory.learn(image, estimate, is_sure)
        if is_sure:
            self._state.last_sure_pose = estimate.cam_from_model


def _alternatives_of(found: Detection) -> HypothesisSet:
    return HypothesisSet([invert(found.cam_from_model) @ other for other in found.alternatives])
