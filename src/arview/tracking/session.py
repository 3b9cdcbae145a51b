"""TrackingSession: one part in one stream of frames, as a machine of states with hysteresis.

``searching`` until the part is first found, ``tracked`` while the picture bears the pose out, ``critical`` while it
hardly does, ``lost`` when it no longer does; from ``searching`` and ``lost`` the detector looks for the part.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.assembly.monitor import AssemblyMonitor
from arview.cad.model import Model
from arview.camera import Camera
from arview.core.checks import check_type
from arview.detection.detector import (
    Detection,
    Detector,
    DetectorOptions,
    RejectedHypothesis,
    local_search_for,
)
from arview.errors import InputError, MismatchError
from arview.geometry import Array, apply, check_rigid, invert
from arview.guideviews import GuideViewSet
from arview.pose import Pose, TrackingState
from arview.tracking.appearance_memory import AppearanceMemory, Proposal
from arview.tracking.diagnosis import NOTHING, diagnose_loss, diagnose_search, poor_picture
from arview.tracking.disambiguation import HypothesisSet
from arview.tracking.estimate import Estimate
from arview.tracking.guided_init import GuidedInit
from arview.tracking.pose_recheck import LocalSearchRecheck
from arview.tracking.tracker import Tracker, TrackerOptions

ALIGN = "align the part with the outline"
"""The reason while the session waits for the part at its guide pose."""


@dataclass(frozen=True)
class SessionOptions:
    """Options of a session.

    Attributes:
        use_region, use_edge, use_texture: modalities of the tracker.
        use_recheck: ask the detector's local search where a tracked pose surprises, see `LocalSearchRecheck`.
        use_appearance_memory: remember how the part looks while it is tracked well, and look for that after a loss.
        lock_quality: a detection must be this good to be believed at once; a weaker one must hold a second frame.
        tracked_quality: at least this to be or become ``tracked``.
        critical_quality: a tracked pose turns ``critical`` only below this (hysteresis).
        lost_quality: below this the pose is dropped after ``lost_frames`` frames.
        lost_frames: frames in a row.
        critical_frames: so many critical frames in a row end in ``lost`` too.
        eager_frames, search_every: a lost part is looked for in so many frames at once, then in every n-th.
        likely_look: between these searches only what looks so much (correlation) as it did is looked at closer.
        align_again_frames: a part that is not found again in so many frames may be aligned with the guide again.
        min_in_picture: less of the outline inside the picture cannot hold a pose.
        detector: None chooses by the declared range.
    """

    use_region: bool = True
    use_edge: bool = True
    use_texture: bool = True
    use_recheck: bool = True
    use_appearance_memory: bool = True
    lock_quality: float = 0.8
    tracked_quality: float = 0.5
    critical_quality: float = 0.25
    lost_quality: float = 0.1
    lost_frames: int = 2
    critical_frames: int = 45
    eager_frames: int = 2
    search_every: int = 3
    likely_look: float = 0.7
    align_again_frames: int = 60
    min_in_picture: float = 0.25
    detector: DetectorOptions | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.lost_quality <= self.critical_quality <= self.tracked_quality <= 1:
            raise InputError("session: expected 0 ≤ lost_quality ≤ critical_quality ≤ tracked_quality ≤ 1")


class TrackingSession:
    """Detects and tracks a part through a stream of frames.

    Args:
        views: guide views of the model.
        camera: intrinsics of the frames.
        model: the CAD model of the guide views; the texture modality needs its surface.
        options: see SessionOptions.
        initial_cam_from_model: (4,4) mm; the first frame snaps to it and does not search.
        guide_cam_from_model: (4,4) mm; the part is first found by bringing it near this pose, not by a search,
            and by both when it has been lost for a while.

    ``learned`` holds how the part looked while it was tracked well: a lost part is looked for there first.

    Raises:
        MismatchError: guide views of another model.
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
    ) -> None:
        check_type(views, GuideViewSet, "TrackingSession: views")
        check_type(camera, Camera, "TrackingSession: camera")
        check_type(model, Model, "TrackingSession: model")
        self.options = options or SessionOptions()
        if views.model_hash != model.source_hash:
            raise MismatchError(
                f"guide views of model {views.model_name!r} ({views.model_hash[:12]}) do not belong to "
                f"{model.name!r} ({model.source_hash[:12]})"
            )
        self.camera = camera
        self._views = views
        self._local = local_search_for(views, camera, self.options.detector)
        self.tracker = Tracker(
            views,
            camera,
            model,
            TrackerOptions(
                use_region=self.options.use_region,
                use_edge=self.options.use_edge,
                use_texture=self.options.use_texture,
            ),
            recheck=LocalSearchRecheck(self._local) if self.options.use_recheck else None,
            part=self._local.refiner.part,
        )
        self._detector: Detector | None = None
        self._initial = None if initial_cam_from_model is None else check_rigid(initial_cam_from_model, "initial pose")
        self._guide = None if guide_cam_from_model is None else check_rigid(guide_cam_from_model, "guide pose")
        self._guided_init: GuidedInit | None = None
        self.components = AssemblyMonitor(views, camera, model)
        self.appearance_memory = AppearanceMemory(views, camera)
        self.reset()

    def __repr__(self) -> str:
        return f"<TrackingSession {self._views.model_name}: {self.state}, {len(self._views)} views, {self.camera!r}>"

    @property
    def detector(self) -> Detector:
        """The detector, made when first needed."""
        if self._detector is None:
            self._detector = Detector(self._views, self.camera, self.options.detector, local=self._local)
        return self._detector

    @property
    def guided_init(self) -> GuidedInit:
        """The search around a given pose, made when first needed."""
        if self._guided_init is None:
            self._guided_init = GuidedInit(self._views, self.camera)
        return self._guided_init

    @property
    def is_aligning(self) -> bool:
        """Whether the part can be found by bringing it near the guide pose."""
        has_waited = self.state == TrackingState.LOST and self._lost_frames > self.options.align_again_frames
        return self._guide is not None and (self.state == TrackingState.SEARCHING or has_waited)

    def reset(self) -> None:
        """Forget the part's place: search again. What was learned of its look is kept."""
        self.state = TrackingState.SEARCHING
        self._poor = 0
        self._critical = 0
        self._lost_frames = 0
        self._confirmed = False
        self._borne_out = False
        self._was_found = False
        self._recent: list[Array] = []
        self._last_seen: Array | None = None
        self._hypotheses = HypothesisSet([])
        self._why = self._why_lost = ""

    def process(self, image: NDArray[np.uint8], index: int, time_s: float) -> Pose:
        """Pose and state of the next frame.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            index, time_s: of the frame, copied into the pose.

        Raises:
            InputError: an image of another size or type.
        """
        if image.shape != (self.camera.height, self.camera.width, 3) or image.dtype != np.uint8:
            raise InputError(
                f"frame {index}: {image.shape} {image.dtype}, expected "
                f"({self.camera.height}, {self.camera.width}, 3) uint8 as the camera says"
            )
        started = time.perf_counter()
        if self.state in (TrackingState.TRACKED, TrackingState.CRITICAL):
            estimate, reason = self._follow(image)
        else:
            estimate, reason = self._search(image)
        if estimate is not None:
            estimate, reason = self._tell_apart(image, estimate, reason)
            reason = self._compare(image, estimate, reason)
            is_sure = self.state == TrackingState.TRACKED and self._confirmed
            if self.options.use_appearance_memory:
                self.appearance_memory.learn(image, estimate, is_sure)
            if is_sure:
                self._last_seen = estimate.cam_from_model
        ms = (time.perf_counter() - started) * 1e3
        if estimate is None:
            guide = self._guide if self.is_aligning else None
            return Pose(None, None, 0.0, self.state, time_s, index, ms, reason, guide_cam_from_model=guide)
        return Pose(
            cam_from_model=estimate.cam_from_model,
            covariance=self.tracker.covariance(estimate),
            quality=estimate.quality,
            state=self.state,
            time_s=time_s,
            index=index,
            ms=ms,
            reason=reason,
            mismatches=self.components.mismatches,
            unverified=self.components.unverified,
            alternatives=tuple(estimate.cam_from_model @ turn for turn in self._hypotheses.model_from_twins),
        )

    def _tell_apart(self, image: NDArray[np.uint8], estimate: Estimate, reason: str) -> tuple[Estimate, str]:
        """Watch the twins of an ambiguous pose until the frames say which is right."""
        if not self._hypotheses:
            return estimate, reason
        twins = [estimate.cam_from_model @ turn for turn in self._hypotheses.model_from_twins]
        better = self._hypotheses.update(estimate.evidence.score, self.tracker.scores_near(image, twins))
        if better is not None:
            self._hypotheses = HypothesisSet([])
            return self._begun(image, estimate.cam_from_model @ better), reason
        count = len(self._hypotheses.model_from_twins)
        if count == 0 or reason:
            return estimate, reason
        self.state = TrackingState.CRITICAL
        poses = "another pose fits" if count == 1 else f"{count} other poses fit"
        return estimate, f"ambiguous: {poses} as well; show another side"

    def _compare(self, image: NDArray[np.uint8], estimate: Estimate, reason: str) -> str:
        """Look whether the components are where the CAD has them; a part with one wrong is never `tracked`."""
        self._borne_out = self.state == TrackingState.TRACKED
        if self._borne_out:
            self.components.update(image, estimate.cam_from_model)
        reasons = [reason, *self.components.mismatches] if reason else [*self.components.mismatches]
        uncertain = self.components.uncertain
        if uncertain and not reasons:
            reasons = [f"in doubt: {', '.join(uncertain)}"]
        if reasons:
            self.state = TrackingState.CRITICAL
        return "; ".join(reasons)

    def _follow(self, image: NDArray[np.uint8]) -> tuple[Estimate | None, str]:
        o = self.options
        estimate = self.tracker.track(image)
        quality = estimate.quality
        is_possible = self._is_possible(estimate)
        outside = estimate.evidence.points_in_picture < o.min_in_picture or not is_possible
        poor = outside or quality < o.lost_quality
        self._poor = self._poor + 1 if poor else 0
        if self._poor >= o.lost_frames or (poor and not self._confirmed):
            recent = (self._recent[0], self._recent[1]) if len(self._recent) == 2 else None
            return self._lose(diagnose_loss(image, estimate, recent, self.camera, self._views, is_possible))
        if not poor:
            self._recent = [*self._recent[-1:], estimate.cam_from_model]
        if not poor and quality >= (o.critical_quality if self._borne_out else o.tracked_quality):
            self.state = TrackingState.TRACKED
            self._critical = 0
            self._confirmed = self._was_found = True
            return estimate, ""
        self.state = TrackingState.CRITICAL
        self._critical += 1
        if self._critical > o.critical_frames or not self._confirmed:
            return self._lose("the outline is not seen where it should be")
        return estimate, "the outline is hardly seen"

    def _lose(self, reason: str) -> tuple[None, str]:
        self._hypotheses = HypothesisSet([])
        self._poor = self._critical = 0
        if self._guide is not None and not self._confirmed:
            # It was aligned, but did not hold the second frame: go on as before.
            self.state = TrackingState.LOST if self._was_found else TrackingState.SEARCHING
            return None, self._why
        self.state = TrackingState.LOST
        self._lost_frames = 0
        self._confirmed = False
        self._why = self._why_lost = reason
        return None, reason

    def _is_possible(self, estimate: Estimate) -> bool:
        """In front of the camera and not much nearer or farther than declared."""
        center = apply(estimate.cam_from_model, self._views.center_in_model)
        low, high = self._views.view_range.distance_mm
        return bool(center[2] > 0 and 0.5 * low < np.linalg.norm(center) < 2.0 * high)

    def _search(self, image: NDArray[np.uint8]) -> tuple[Estimate | None, str]:
        o = self.options
        self._lost_frames += 1
        if self._initial is not None:
            found = self.guided_init.find(image, self._initial)
            self._initial = None
            if found is None:
                return None, "the part is outside the picture at the initial pose"
            start = found.cam_from_model
        elif self.state == TrackingState.SEARCHING and self._guide is not None:
            return self._align(image, self._guide)
        else:
            rests = self._lost_frames > o.eager_frames and self._lost_frames % o.search_every != 0
            rests = rests and self.state == TrackingState.LOST
            detections = self._detect(image, rests)
            if not detections and rests:
                if self._guide is not None and self.is_aligning:
                    return self._align(image, self._guide)
                return None, self._why
            if not detections:
                return None, self._why_not(image, self.detector.best_rejected)
            start = detections[0].cam_from_model
            self._hypotheses = HypothesisSet([invert(start) @ twin for twin in detections[0].alternatives])
        estimate = self._begun(image, start)
        if estimate.quality < o.tracked_quality or not self._is_possible(estimate):
            return None, self._why_not(
                image, RejectedHypothesis(estimate.cam_from_model, estimate.evidence, estimate.quality)
            )
        self._poor = self._critical = 0
        self._confirmed = estimate.quality >= o.lock_quality
        self._was_found |= self._confirmed
        self._recent = []
        self.state = TrackingState.TRACKED if self._confirmed else TrackingState.CRITICAL
        return estimate, "" if self._confirmed else "found, to be confirmed"

    def _begun(self, image: NDArray[np.uint8], cam_from_model: Array) -> Estimate:
        """Track from a pose on; nothing is known of the components yet."""
        self.tracker.start(image, cam_from_model)
        self.components.reset()
        return self.tracker.track(image)

    def _detect(self, image: NDArray[np.uint8], rests: bool) -> list[Detection]:
        """Look for the part, first where it looks as it did; nowhere else while the search rests."""
        o = self.options
        proposals: list[Proposal] = []
        if o.use_appearance_memory and self._last_seen is not None and (rests or self._lost_frames <= o.eager_frames):
            proposals = self.appearance_memory.propose(image, self._last_seen)
        if o.use_appearance_memory and not proposals and not rests:
            proposals = self.appearance_memory.propose(image)
        least = o.likely_look if rests else 0.0
        guesses = [proposal.cam_from_model for proposal in proposals if proposal.score >= least]
        if rests:
            return self.detector.detect_near(image, guesses) if guesses else []
        # The wide search takes long: not in every frame.
        turn = self._lost_frames % (2 * o.search_every)
        is_thorough = turn == 1 if self.state == TrackingState.SEARCHING else turn == 0
        return self.detector.detect(image, max_results=1, is_thorough=is_thorough, guesses=guesses)

    def _align(self, image: NDArray[np.uint8], guide_cam_from_model: Array) -> tuple[Estimate | None, str]:
        """Look whether the part has been brought near the guide pose; what is found must hold a second frame."""
        found = self.guided_init.lock(image, guide_cam_from_model, self.options.lock_quality)
        if found is not None:
            estimate = self._begun(image, found.cam_from_model)
            is_good = estimate.quality >= self.options.lock_quality and self._is_possible(estimate)
            if is_good and self.guided_init.is_near(estimate.cam_from_model, guide_cam_from_model):
                self._why = ALIGN
                self._poor = self._critical = 0
                self._confirmed = False
                self._recent = []
                self.state = TrackingState.CRITICAL
                return estimate, "found, to be confirmed"
        if self.state == TrackingState.SEARCHING and self._lost_frames % 10 == 1:
            self._why = poor_picture(image) or ALIGN
        return None, self._why

    def _why_not(self, image: NDArray[np.uint8], rejected: RejectedHypothesis | None) -> str:
        """Why a search found nothing; a lost part's loss says more than that nothing is in view."""
        reason = diagnose_search(image, self.camera, self._views, rejected)
        is_told = self.state == TrackingState.LOST and reason.startswith(NOTHING)
        self._why = self._why_lost if is_told else reason
        if self.is_aligning and self.state == TrackingState.LOST:
            self._why += f"; {ALIGN}"
        return self._why
