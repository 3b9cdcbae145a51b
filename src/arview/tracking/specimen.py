"""SpecimenTracking: detects one specimen of a part and tracks it through a stream of frames.

The part is ``searching`` until first found, ``tracked`` while the picture supports its pose, ``critical`` while the
support is weak, and ``lost`` when there is none. Every frame follows the last pose or examines what the search
proposes; a pose is then disambiguated, its components are checked. The transitions between the
states are a table, see `session_state`.
"""

from __future__ import annotations

import copy
import math
import time

import numpy as np
from numpy.typing import NDArray

from arview.assembly import AssemblyMonitor
from arview.cad import Model
from arview.camera import Camera, FrameView
from arview.core.checks import check_type
from arview.core.messages import joined, sentence
from arview.detection import RejectedHypothesis
from arview.errors import MismatchError
from arview.fiducials import SerialNumbers
from arview.geometry import Array, are_near, direction_from, invert
from arview.guideviews import GuideViewSet
from arview.pose import Identity, Pose, TrackingState
from arview.tracking.diagnosis import diagnose_loss
from arview.tracking.disambiguation import HypothesisSet, RoundTurns
from arview.tracking.estimate import Estimate, PosePrior
from arview.tracking.identity import IdentityMonitor
from arview.tracking.part_search import ALIGN, ALTERNATIVE_SHARE, FoundPose, PartSearch
from arview.tracking.pose_recheck import LocalSearchRecheck
from arview.tracking.probability import pose_features, pose_probability
from arview.tracking.session_options import CRITICAL_QUALITY, LOST_QUALITY, TRACKED_QUALITY, SessionOptions
from arview.tracking.session_state import Event, SessionState
from arview.tracking.several.specimens import CoveredPlace
from arview.tracking.tracker import Tracker
from arview.tracking.tracker_options import TrackerOptions

LOST_FRAMES = 2
"""Frames in a row below ``LOST_QUALITY`` after which the part is lost."""
CRITICAL_FRAMES = 45
"""Critical frames in a row after which the part is lost."""
CONFIRMING_DEG = 10.0
"""Angle between two directions of view; a pose that is ``tracked`` from both is right or symmetric."""
MIN_IN_PICTURE = 0.25
"""Share of the outline inside the picture below which no pose is kept."""
GIVEN_SEARCHES = (1, 4, 7, 10)
"""Weak frames from a given pose in which the part is searched for elsewhere too; later it is every
``CRITICAL_FRAMES``."""
LITTLE_SEEN = "little of the outline is seen: the part is hidden, or differs from its CAD"
"""Reason given while a part is followed from a given pose that the picture never supported clearly."""
FACE_LINES = 5.0
"""Distinct lines that a view must show more of than one face of a box does, which any rectangle in the picture fits."""
PLAIN_FACE = "ambiguous: one plain face fits any other of its shape; show another side"
"""Reason given while that is all that has been seen."""
SAME_SPECIMEN = (Identity.FOLLOWED, Identity.CONFIRMED)
"""With these identities what was known of the components before a loss is taken up."""


class SpecimenTracking:
    """Detects and tracks one specimen of a part through a stream of frames.

    Args:
        views: guide views of the model.
        camera: of the frames.
        model: the CAD model of the guide views; the texture modality needs its surface.
        options: see `SessionOptions`.
        initial_cam_from_model: (4,4) mm, rough pose in the first frame, which is refined instead of a search.
        guide_cam_from_model: (4,4) mm, guide pose. The part is first found when it is brought near this pose, not by
            a search, and by both after it has been lost for a while.
        like: tracking of another specimen with the same guide views, camera and options, whose preparation is shared.
        serials: serial number of the part to which the labels belong, to be read from codes in the frames; None: codes
            are not read.

    Attributes:
        views: guide views of the model.
        frames, camera: how frames become the pictures that are tracked, and the camera of these.
        search: the searches for the specimen.
        components: says whether the components are where the CAD has them.
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
        like: SpecimenTracking | None = None,
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
        self.search: PartSearch = PartSearch(
            views,
            camera,
            model,
            o,
            initial_cam_from_model=initial_cam_from_model,
            guide_cam_from_model=guide_cam_from_model,
            like=None if like is None else like.search,
        )
        self._part = self.search.local.refiner.part
        self.tracker = Tracker(
            views,
            camera,
            model,
            TrackerOptions(use_region=o.use_region, use_edge=o.use_edge, use_texture=o.use_texture, matcher=o.matcher),
            recheck=LocalSearchRecheck(self.search.local) if o.use_recheck else None,
            part=self._part,
        )
        self.components: AssemblyMonitor = AssemblyMonitor(
            views, camera, model, like=None if like is None else like.components
        )
        self.identity = IdentityMonitor(views, camera, self.search.near, self.search.anywhere, serials)
        self._turns: RoundTurns = RoundTurns(model, self._part, camera) if like is None else copy.copy(like._turns)
        self._state = SessionState()

    def __repr__(self) -> str:
        return f"<SpecimenTracking {self.views.model_name}: {self.state}, {len(self.views)} views, {self.camera!r}>"

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

    def process(
        self,
        image: NDArray[np.uint8],
        index: int,
        time_s: float,
        others: tuple[Array, ...] = (),
        covers: tuple[CoveredPlace, ...] = (),
        prior: PosePrior | None = None,
    ) -> Pose:
        """Pose and state of the next frame.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            index: index of the frame, copied into the pose.
            time_s: time stamp of the frame, copied into the pose.
            others: poses (4,4) of other specimens of the part, which are not taken for this one.
            covers: where other parts are, at which this one is searched for in every second round of searches only.
            prior: what is known of the pose in this frame from elsewhere.

        Raises:
            InputError: an image of another size or type.
        """
        started = time.perf_counter()
        image, steps = self.frames.picture(image, index), self.components.steps
        self.search.others, self.search.covers = others, covers
        self.search.prior = None if prior is None else prior.cam_from_model
        estimate, reason = self._follow(image) if self._state.has_pose else self._search(image)
        if estimate is not None:
            estimate, reason = self._disambiguate(image, estimate, reason)
            reason = self._check_components(image, estimate, reason, time_s)
            self._remember(estimate)
        known = self.identity.update(image, estimate, index, time_s, others, self._state.is_confirmed)
        if known.cam_from_model is not None and estimate is not None:
            estimate = self._restart(image, known.cam_from_model)
        elif estimate is not None and self._state.is_confirmed and known.identity in SAME_SPECIMEN:
            self.components.resume(estimate.cam_from_model, self._state.frames_without_pose)
        ms = (time.perf_counter() - started) * 1e3
        if estimate is None:
            return Pose(
                None,
                None,
                0.0,
                state=self.state,
                time_s=time_s,
                index=index,
                ms=ms,
                reason=reason,
                guide_cam_from_model=self.search.guide_pose(self._state),
                steps=None if steps is None else steps.report,
            )
        pose, covariance = estimate.cam_from_model, self.tracker.covariance(estimate)
        quality = self._quality(estimate, covariance)
        if prior is not None:
            body = pose @ self._part.model_from_body
            body, covariance = prior.joined(body, self._part.body_from_model, covariance)
            pose = body @ self._part.body_from_model
        return Pose(
            cam_from_model=pose,
            covariance=covariance,
            quality=quality,
            state=self.state,
            time_s=time_s,
            index=index,
            ms=ms,
            reason=reason,
            mismatches=self.components.mismatches,
            unverified=self.components.unverified,
            alternatives=(
                *self._state.hypotheses.poses(pose),
                *(pose @ turn for turn in self._turns.fitting),
                *self.components.other_poses(pose),
            ),
            identity=known.identity,
            identity_reason=known.reason,
            serial=known.serial,
            components=self.components.presence(pose, bool(self._state.hypotheses)),
            steps=None if steps is None else steps.report,
        )

    def _quality(self, estimate: Estimate, covariance: Array) -> float:
        """Quality of a pose: until other views have supported it, it is no surer than what found it."""
        s = self._state
        if s.found_direction is not None and self.state == TrackingState.TRACKED:
            direction = direction_from(estimate.cam_from_model, self.views.center_in_model)
            cosine = float(direction @ s.found_direction)
            if cosine < math.cos(math.radians(CONFIRMING_DEG)):
                s.found_quality, s.found_direction = 1.0, None
        return min(pose_probability(pose_features(estimate, covariance, self.views.diameter_mm)), s.found_quality)

    def _note_found(self, found: FoundPose, estimate: Estimate) -> None:
        """Note how sure what found the pose is, and from where the part is seen in that frame."""
        direction = direction_from(estimate.cam_from_model, self.views.center_in_model)
        self._state.found_quality, self._state.found_direction = found.quality, direction

    # --- Follow a pose ------------------------------------------------------------------------------------

    def _follow(self, image: NDArray[np.uint8]) -> tuple[Estimate | None, str]:
        """Track the part into this frame; the reason says why the pose is weak or was given up."""
        s = self._state
        estimate = self.tracker.track(image, self.search.prior)
        is_possible = self.search.is_possible(estimate.cam_from_model)
        is_outside = estimate.evidence.points_in_picture < MIN_IN_PICTURE or not is_possible
        is_poor = is_outside or estimate.quality < LOST_QUALITY
        s.poor_frames = s.poor_frames + 1 if is_poor else 0
        if s.poor_frames >= LOST_FRAMES or (is_poor and not (s.is_confirmed or s.is_given)):
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
        is_given = s.is_given and not s.is_confirmed
        if is_given and (s.critical_frames in GIVEN_SEARCHES or s.critical_frames > CRITICAL_FRAMES):
            if self._is_elsewhere(image, estimate, s.critical_frames == GIVEN_SEARCHES[0]):
                return self._give_up("the part is not at the given pose")
            if s.critical_frames > CRITICAL_FRAMES:
                s.critical_frames = GIVEN_SEARCHES[-1] + 1
        if s.critical_frames > CRITICAL_FRAMES or not (s.is_confirmed or is_given):
            return self._give_up("the outline is not seen where it should be")
        if is_given:
            return estimate, LITTLE_SEEN
        return estimate, "the pose jumps" if estimate.is_restless else "the outline is hardly seen"

    def _is_elsewhere(self, image: NDArray[np.uint8], estimate: Estimate, is_thorough: bool) -> bool:
        """Whether a search finds the part, or its base alone, at another pose than a weakly supported one."""
        found = [one.cam_from_model for one in self.search.anywhere(image, 1, is_thorough)]
        if not found and self.components.may_be_bare:
            base = self.search.find_base(image, None if is_thorough else [0], self.components)
            found = [] if base is None else [base.cam_from_model]
        apart_mm = ALTERNATIVE_SHARE * self.views.diameter_mm
        return any(not are_near(pose, estimate.cam_from_model, apart_mm, CONFIRMING_DEG) for pose in found)

    def _give_up(self, reason: str) -> tuple[None, str]:
        """Give the pose up; one from the guide view that was never confirmed leaves the session waiting as before."""
        if self.search.has_guide and not self._state.is_confirmed:
            self._state.retract()
        else:
            recent = self._state.recent_poses
            self._state.lose(reason)
            # Poses shortly before a loss may be wrong; the identity rests on the last one without doubt.
            last = self.identity.last_pose
            self.components.set_aside(recent[-1] if last is None and recent else last)
        return None, self._state.reason

    # --- Search -------------------------------------------------------------------------------------------

    def _search(self, image: NDArray[np.uint8]) -> tuple[Estimate | None, str]:
        """Find the part: the first acceptable pose that the search proposes; the reason says why there is none."""
        s = self._state
        s.frames_without_pose += 1
        for found in self.search.proposals(image, s, self.components):
            estimate = self._begin(image, found)
            if estimate is not None:
                weak = LITTLE_SEEN if s.is_given else "found, to be confirmed"
                return estimate, "" if s.is_confirmed else weak
        return None, s.reason

    def _begin(self, image: NDArray[np.uint8], found: FoundPose) -> Estimate | None:
        """Accept a found pose if it is good enough; one below its lock quality must be confirmed by the next frame."""
        s = self._state
        estimate = self._restart(image, found.cam_from_model, rests_on_base=found.rests_on_base)
        is_possible = self.search.is_possible(estimate.cam_from_model, found.guide_cam_from_model)
        if estimate.quality < found.min_quality or not is_possible:
            if found.guide_cam_from_model is None:
                rejected = RejectedHypothesis(estimate.cam_from_model, estimate.evidence, estimate.quality)
                s.reason = self.search.diagnose(image, s, rejected)
            return None
        if found.guide_cam_from_model is not None:
            s.reason = ALIGN
        s.hypotheses = _alternatives_of(found)
        self._note_found(found, estimate)
        self._turns.reset()
        s.begin(estimate.quality >= found.lock_quality, found.is_given)
        return estimate

    def _restart(
        self, image: NDArray[np.uint8], cam_from_model: Array, is_turned: bool = False, rests_on_base: bool = False
    ) -> Estimate:
        """Track from a pose on; nothing is known of the components yet, unless it is the pose so far, turned.

        Where only the base was found, no other component is expected until it is seen.
        """
        if rests_on_base:
            lines = self.components.lines(self._part, cam_from_model, self.search.base_part, is_base_only=True)
            self.tracker.expect(lines)
        self.tracker.start(image, cam_from_model)
        if is_turned:
            self.components.turn()
        else:
            self.components.reset(is_placed=not rests_on_base)
        return self.tracker.track(image)

    # --- Examine a pose -----------------------------------------------------------------------------------

    def _disambiguate(self, image: NDArray[np.uint8], estimate: Estimate, reason: str) -> tuple[Estimate, str]:
        """Compare an ambiguous pose with its alternatives until the frames decide between them."""
        s = self._state
        if self.search.is_base_due(self.components, estimate.is_restless):
            estimate = self._recheck_base(image, estimate)
        if self.components.rests_on_base:
            estimate = self._recheck_whole(image, estimate)
        if (turn := self.components.better_turn) is not None:
            return self._restart(image, estimate.cam_from_model @ turn.model_from_model, is_turned=True), reason
        pose = estimate.cam_from_model
        if self._turns.is_due():
            colors, covariance = self.tracker.state.appearance.colors, self.tracker.covariance(estimate)
            if (better := self._turns.better(image, pose, covariance, colors)) is not None:
                return self._restart(image, pose @ better), reason
        self.tracker.hold_turn(self._turns.unknown_twist)
        if self._turns.fitting and not s.hypotheses and not reason:
            s.apply(Event.CONTRADICTED)
            return estimate, "ambiguous: it looks the same when it is turned; show another side"
        if not s.hypotheses:
            if reason or not self._is_plain(estimate):
                return estimate, reason
            s.apply(Event.CONTRADICTED)
            return estimate, PLAIN_FACE
        others = s.hypotheses.poses(pose)
        score, *other_scores = [score for _, score in self.tracker.refined_near(image, [pose, *others])]
        if (better := s.hypotheses.update(score, other_scores)) is not None:
            s.hypotheses = HypothesisSet([])
            return self._restart(image, pose @ better), reason
        if not s.hypotheses or reason:
            return estimate, reason
        s.apply(Event.CONTRADICTED)
        poses = "another pose fits" if len(s.hypotheses) == 1 else f"{len(s.hypotheses)} other poses fit"
        return estimate, f"ambiguous: {poses} as well; show another side"

    def _is_plain(self, estimate: Estimate) -> bool:
        """Whether the part, found by a search, has shown no more than one plain face; it is in doubt then."""
        s = self._state
        if s.is_given:
            return False
        if s.lines_shown < FACE_LINES:
            lines = self.search.local.view_lines(estimate.cam_from_model @ self._part.model_from_body)
            s.lines_shown = max(s.lines_shown, lines)
        return s.lines_shown < FACE_LINES

    def _recheck_base(self, image: NDArray[np.uint8], estimate: Estimate) -> Estimate:
        """Search again for a part of which little is seen, and go on where it is if that is elsewhere."""
        found = self.search.find_base(image, [0], self.components)
        if found is None or self._is_placed_by(found, estimate):
            return estimate
        restarted = self._restart(image, found.cam_from_model, rests_on_base=True)
        self._note_found(found, restarted)
        return restarted

    def _recheck_whole(self, image: NDArray[np.uint8], estimate: Estimate) -> Estimate:
        """Go on where the whole part is found, if only its base was found before and that elsewhere."""
        found = self.search.find_whole(image, self.components, estimate.cam_from_model)
        if found is None or self._is_placed_by(found, estimate):
            return estimate
        self._state.hypotheses = _alternatives_of(found)
        restarted = self._restart(image, found.cam_from_model)
        self._note_found(found, restarted)
        return restarted

    def _is_placed_by(self, found: FoundPose, estimate: Estimate) -> bool:
        """Whether a search found the part where it is followed, by which its pose is known to be right."""
        is_same = self.search.is_same(self.components, found, estimate.cam_from_model)
        if is_same:
            self.components.is_placed = True
        return is_same

    def _check_components(self, image: NDArray[np.uint8], estimate: Estimate, reason: str, time_s: float) -> str:
        """Check that the components are where the CAD has them; a part with a wrong one is never ``tracked``."""
        s = self._state
        s.is_supported = s.state == TrackingState.TRACKED
        self.components.update(image, estimate.cam_from_model, estimate.quality, s.is_supported, time_s)
        pose, base_part = estimate.cam_from_model, self.search.base_part
        self.tracker.expect(self.components.lines(self._part, pose, base_part))
        reasons = [text for text in (reason, *self.components.mismatches) if text]
        if self.components.uncertain and not reasons:
            reasons = [sentence("tracking.in_doubt", names=", ".join(self.components.uncertain))]
        if not reasons:
            return ""
        s.apply(Event.CONTRADICTED)
        return joined(reasons)

    def _remember(self, estimate: Estimate) -> None:
        """Remember the pose of a part that is tracked without doubt."""
        if self.state == TrackingState.TRACKED and self._state.is_confirmed:
            self._state.last_sure_pose = estimate.cam_from_model


def _alternatives_of(found: FoundPose) -> HypothesisSet:
    return HypothesisSet([invert(found.cam_from_model) @ other for other in found.alternatives])
