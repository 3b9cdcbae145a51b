"""Tracker: follows the pose of a part from frame to frame on its guide views, without rendering.

Every frame runs one loop: poses are proposed (the predicted pose, other schedules, a wide search, a recheck by the
detector's local search, shading), refined, scored by the evidence of the picture, and the best is selected. The state
kept between frames is a `TrackerState`; the refinement is done by the stateless `PoseRefiner`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from types import NoneType
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.cad import Model
from arview.camera import Camera
from arview.core.checks import check_type
from arview.geometry import Array
from arview.guideviews import GuideViewSet
from arview.refinement import (
    FAR_STAGES,
    LAST_STAGES,
    NEAR_STAGES,
    PartView,
    PoseRefiner,
    RefinementPyramid,
    TextureModality,
    apply_twist,
    relative_twist,
)
from arview.tracking.covariance import POINTS_BETWEEN_FRAMES, POINTS_OF_FRAME, common_covariance, covariance_of
from arview.tracking.estimate import Estimate
from arview.tracking.motion import innovation, normalised_covariance, squared_motion_distance
from arview.tracking.search.wide_search import WideSearch
from arview.tracking.tracker_options import COLOR_SCALE, SCALE, STAGES, TrackerOptions
from arview.tracking.tracker_state import FrameContext, Proposal, RefinedPose, TrackerState

USE_SHADING = True
"""Use the brightness of curved surfaces."""
MIN_MATCHES = 12
"""Texture matches needed to use texture."""
MIN_MATCH_SHARE = 0.4
"""Share of the expected texture that must be found to use texture."""
TEXTURE_SCORE = 0.5
"""Score that texture adds to the quality when all of it is found, because it supports the pose where a hand hides the
outline."""
LEARNING_RATE = 0.2
"""Share by which the colour histograms follow each frame."""
MIN_LEARNING_QUALITY = 0.4
"""Quality below which colours are not learned, and the part is searched for around the predicted pose."""
MIN_EDGE_SUPPORT, NEW_EDGE_SUPPORT = 0.65, 0.7
"""Mean support of the outline of a smooth part by edges below which they are left out, and from which they count
again."""
SUPPORT_RATE = 0.2
"""Share by which that mean moves towards the support in a frame."""
SCORE_RATE = 0.1
"""Share by which the usual score follows each frame."""
OTHER_SCHEDULES_SHARE = 0.9
"""Share of the usual score in the working picture below which other schedules are tried."""
OTHER_SCHEDULES_FINE_SHARE = 0.7
"""Share of the usual score in the finest picture, in which scores vary more, below which other schedules are tried."""
NEAR_SCHEDULES_MIN_INNER_SHARE = 0.05
"""Share of design edges needed for schedules without colours, because the apparent outline of a rounded part moves with
the light."""
FUTILE_FRAMES, FUTILE_SHARE = 6, 0.9
"""Frames for which other schedules are left out after none of them gained anything, while the score does not fall below
this share of what it was: a hand or blur stays for a while."""
FAR_SCHEDULES_SHARE = 0.9
"""Share of the usual score below which schedules for a part that moved far are tried."""
WIDE_SEARCH_SHARE = 0.8
"""Share of the usual score below which the part is searched for around the predicted pose."""
SURPRISE_SHARE = 0.95
"""Share of the usual score below which the part is searched for around the predicted pose, where the squared motion
distance exceeds ``SURPRISE``."""
SURPRISE = 0.02
"""Squared motion distance of a surprising pose; 0.02 is about 6°."""
MOTION_PENALTY = 0.15
"""Score that a squared motion distance of 1 costs, because turned parts often look alike."""
MIN_GAIN = 0.02
"""Score by which a pose found far from the predicted one must be better, and largest loss of score accepted from the
shading refinement."""
MIN_KEYFRAME_IN_PICTURE = 0.9
"""Share of the outline in the picture needed for a keyframe. A part that enters the picture is located badly at first,
and so would be all that is later matched with the keyframe."""
MIN_KEYFRAME_QUALITY = 0.6
"""Quality needed for a keyframe."""
MIN_KEYFRAME_SUPPORT = 0.85
"""Share of the best recent support of the outline needed for a keyframe; with less, something is in front of the
part."""
SUPPORT_DECAY = 0.99
"""Factor by which the best recent support of the outline decreases in each frame."""
SPREAD_RATE = 0.3
"""Share by which the estimated blur of the edges follows each frame."""
VELOCITY_DECAY = 0.9
"""Share of the last frame's motion that is expected in the next frame."""


class PoseRecheck(Protocol):
    """Independent search that confirms or replaces a tracked pose, see `arview.tracking.pose_recheck`."""

    def better(self, image: NDArray[np.uint8], cam_from_body: Array, predicted: list[Array]) -> Array | None:
        """A pose (4,4) that is likelier than the tracked one, in a frame (H,W,3) uint8 RGB; None if there is none.

        The search starts at the tracked pose and at predicted ones, all (4,4).
        """
        ...


class Tracker:
    """6-DoF tracking of one part with one camera.

    Args:
        views: guide views of the part.
        camera: intrinsics of the frames.
        model: the part's CAD model; without it the texture modality is left out.
        options: see `TrackerOptions`.
        recheck: recheck of poses far from the predicted one; None leaves it out.
        part: the guide views in the form of the kernels; created when None.
    """

    def __init__(
        self,
        views: GuideViewSet,
        camera: Camera,
        model: Model | None = None,
        options: TrackerOptions | None = None,
        *,
        recheck: PoseRecheck | None = None,
        part: PartView | None = None,
    ) -> None:
        check_type(views, GuideViewSet, "Tracker: views")
        check_type(camera, Camera, "Tracker: camera")
        check_type(model, (Model, NoneType), "Tracker: model")
        self.options = options or TrackerOptions()
        self.camera = camera
        part = part or PartView.of(views)
        self.refiner = PoseRefiner(part, camera, self.options)
        # Only edges gain from an enlarged picture.
        self._recheck = recheck
        self._search = WideSearch(self.refiner.part.arrays, camera, self.diameter_mm)
        self._state: TrackerState | None = None
        self._texture: TextureModality | None = None
        if self.options.use_texture and model is not None:
            vertices, faces, _ = model.mesh
            self._texture = TextureModality(vertices - views.center_in_model, faces, camera)

    @property
    def diameter_mm(self) -> float:
        """Diameter of the part."""
        return self.refiner.diameter_mm

    @property
    def state(self) -> TrackerState:
        """What the tracker knows from earlier frames.

        Raises:
            RuntimeError: before `start`.
        """
        if self._state is None:
            raise RuntimeError("Tracker.track was called before Tracker.start")
        return self._state

    def expect(self, part: PartView) -> None:
        """Track with other guide views of the part from now on, which lack the lines of absent components."""
        self.refiner.part = part

    def start(self, image: NDArray[np.uint8], cam_from_model: Array) -> None:
        """Start at a pose (4,4): colours are learned from this frame (H,W,3) uint8 RGB, and no motion is expected."""
        state = self._state = TrackerState(cam_from_model @ self.refiner.part.model_from_body)
        if self._texture is not None:
            self._texture.clear()
        state.uses_edges = self.options.use_edge and not self.refiner.part.is_smooth
        levels = self._levels(image, [state.cam_from_body])
        self._measure_spread(levels, 1.0)
        levels = self._levels(image, [state.cam_from_body])
        levels.finest_colors.learn_colors(state.cam_from_body, state.appearance, 1.0)
        if self._texture is not None and not (self.options.use_region or self.options.use_edge):
            # Nothing else can support the pose before there is a keyframe.
            gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
            self._texture.add_keyframe(self._texture.pyramid(gray), state.cam_from_body)
        evidence = levels.working.evidence(state.cam_from_body, state.appearance)
        state.usual_score, state.edge_support = evidence.score, evidence.contour_support
        self._choose_modalities()

    def track(self, image: NDArray[np.uint8], prior: Array | None = None) -> Estimate:
        """Track the part into the next frame (H,W,3) uint8 RGB, in which a pose (4,4) may be known from elsewhere.

        Raises:
            RuntimeError: before `start`.
        """
        frame = self._prepare(image)
        if prior is not None:
            frame.prior = prior @ self.refiner.part.model_from_body
        for propose in (
            self._predicted,
            self._other_schedules,
            self._searched,
            self._rechecked,
            self._shaded,
        ):
            for proposal in propose(frame):
                candidate = self._refine(frame, proposal)
                if self._is_better(frame, candidate, proposal):
                    frame.best = candidate
        if self.state.unknown_twist is not None:
            frame.best = self._as_predicted(frame, self.state.unknown_twist)
        best = frame.found
        quality = self._quality(frame)
        self._update(frame, quality)
        cam_from_model = best.cam_from_body @ self.refiner.part.body_from_model
        texture_share = 0.0 if best.matches is None else frame.found_share
        return Estimate(
            cam_from_model, best.information, quality, best.evidence, self.state.motion.is_restless, texture_share
        )

    def hold_turn(self, twist: Array | None) -> None:
        """Leave a turn (6,) as it is predicted, from the next frame on, because frames do not tell it; None: none.

        Args:
            twist: turn by 1 rad, on the right of the pose about the part's centre.
        """
        self.state.unknown_twist = twist

    # --- Propose ------------------------------------------------------------------------------------------

    def _predicted(self, frame: FrameContext) -> Iterator[Proposal]:
        """The pose predicted from the motion so far, refined by near edges and the texture found."""
        # Wide schedules may lock on to a stronger edge nearby, so they are left for where the near one fails. So is a
        # start from texture alone, which carries the error of the pose at which the texture was learned.
        uses_edges = self.state.uses_edges
        stages = LAST_STAGES if uses_edges else STAGES
        yield Proposal(frame.predicted, stages, frame.matches, first_level=-1)
        if frame.prior is not None:
            frame.levels.cover([frame.prior])
            yield Proposal(frame.prior, stages, None, first_level=-1)
            # What was expected is that of both which came true: neither a jump that is known from elsewhere is unusual,
            # nor the motion of a part whose prior is wrong.
            if self._motion(frame, frame.found) > self._motion(frame, frame.found, frame.prior):
                frame.predicted = frame.prior

    def _other_schedules(self, frame: FrameContext) -> Iterator[Proposal]:
        """Other schedules, where the scores are lower than usual."""
        # What is usual is not yet known in the first frame, whose start may be off.
        if self.state.is_started and self._is_usual(frame):
            return
        first = frame.found
        is_expected = self._motion(frame, first) < SURPRISE
        if is_expected and self.state.is_futile(first.scores.mean, FUTILE_FRAMES, FUTILE_SHARE):
            return
        if frame.matches is not None:
            yield Proposal(frame.start, LAST_STAGES, frame.matches, first_level=-1)
            if self.state.is_started and self._is_usual(frame):
                return
        for level in (-2, 0):
            yield Proposal(frame.start, STAGES, frame.matches, first_level=level)
            if self.state.is_started and self._is_usual(frame):
                return
        if self.state.uses_edges and first.evidence.inner_share > NEAR_SCHEDULES_MIN_INNER_SHARE:
            yield Proposal(frame.start, NEAR_STAGES, frame.matches)
            yield Proposal(first.cam_from_body, NEAR_STAGES, frame.matches)
        for stages in FAR_STAGES:
            if frame.found.evidence.score >= FAR_SCHEDULES_SHARE * self.state.usual_score:
                return
            yield Proposal(frame.start, stages, frame.matches, MIN_GAIN)
        if self.state.is_started and frame.found.scores.mean <= first.scores.mean + MIN_GAIN:
            self.state.futile = (self.state.frames, first.scores.mean)

    def _searched(self, frame: FrameContext) -> Iterator[Proposal]:
        """Poses of a wide search around the predicted one, where the best pose so far is suspicious."""
        if not self._is_suspicious(frame):
            return
        state = self.state
        starts = self._search.find(frame.image, state.appearance.colors, frame.predicted)
        frame.levels.cover(starts)
        for start in starts:
            yield Proposal(start, STAGES, None, MIN_GAIN, MOTION_PENALTY)
        # This score is usual from now on, because a search of the whole neighbourhood found nothing better.
        state.usual_score = frame.found.evidence.score
        state.usual_fine_score = frame.found.scores.fine_score

    def _rechecked(self, frame: FrameContext) -> Iterator[Proposal]:
        """The pose of the recheck, where the motion to the best pose so far is unusual in this stream."""
        if self._recheck is None or not self._is_unusual(frame):
            return
        frame.is_rechecked = True
        pose = self._recheck.better(frame.image, frame.found.cam_from_body, [frame.predicted, self.state.cam_from_body])
        if pose is not None:
            frame.levels.cover([pose])
            # Refinement with the learned colours would lead it back, because they misled the best pose.
            yield Proposal(pose, LAST_STAGES[-1:], None, -math.inf, is_final=True, first_level=-1)

    def _shaded(self, frame: FrameContext) -> Iterator[Proposal]:
        """The best pose so far, refined by the shading of a curved surface."""
        if USE_SHADING and self.refiner.part.is_curved:
            best = frame.found
            yield Proposal(best.cam_from_body, (), best.matches, -MIN_GAIN)

    # --- Refine, score, select ----------------------------------------------------------------------------

    def _refine(self, frame: FrameContext, proposal: Proposal) -> RefinedPose:
        """Refine a proposal and collect its evidence."""
        appearance, levels = self.state.appearance, frame.levels
        if proposal.stages:
            pose, information = levels.refine(
                proposal.cam_from_body, proposal.stages, appearance, proposal.matches, proposal.first_level
            )
            if proposal.is_final:
                pose = proposal.cam_from_body
        else:
            pose, information = levels.working.refine_shading(proposal.cam_from_body, frame.found.information)
        return RefinedPose(pose, information, levels.scores(pose, appearance), proposal.matches)

    def _is_usual(self, frame: FrameContext) -> bool:
        """Whether the scores of the best pose so far are as usual in the working and in the finest picture."""
        state = self.state
        return (
            frame.found.evidence.score >= OTHER_SCHEDULES_SHARE * state.usual_score
            and frame.found.scores.fine_score >= OTHER_SCHEDULES_FINE_SHARE * state.usual_fine_score
        )

    def _is_better(self, frame: FrameContext, candidate: RefinedPose, proposal: Proposal) -> bool:
        """Whether a refined proposal gains enough over the best pose so far."""
        if frame.best is None:
            return True
        penalty = proposal.motion_penalty
        score, best = candidate.scores.mean, frame.best.scores.mean
        if penalty:
            score -= penalty * self._motion(frame, candidate)
            best -= penalty * self._motion(frame, frame.best)
        return score > best + proposal.min_gain

    def _motion(self, frame: FrameContext, candidate: RefinedPose, origin: Array | None = None) -> float:
        """Squared motion distance of a pose from the predicted one, or from another one (4,4)."""
        start = frame.predicted if origin is None else origin
        return squared_motion_distance(candidate.cam_from_body, start, self.diameter_mm)

    def _is_unusual(self, frame: FrameContext) -> bool:
        """Whether the best pose differs from the predicted one more than usual, and than its covariance explains."""
        return self.state.motion.is_unusual(self._innovation(frame), lambda: self._innovation_covariance(frame))

    def _innovation(self, frame: FrameContext) -> Array:
        """Normalised difference (6,) of the best pose from the predicted one."""
        return innovation(frame.found.cam_from_body, frame.predicted, self.diameter_mm)

    def _innovation_covariance(self, frame: FrameContext) -> Array:
        """Normalised covariance (6,6) of the best pose."""
        best = frame.found
        covariance = covariance_of(best.information, best.evidence.quality, self.diameter_mm, POINTS_BETWEEN_FRAMES)
        return normalised_covariance(covariance, best.cam_from_body, self.diameter_mm)

    def _is_suspicious(self, frame: FrameContext) -> bool:
        """Whether the best pose may be wrong: its score is low, or lower than usual, or it is off the prediction."""
        evidence = frame.found.evidence
        share = evidence.score / max(self.state.usual_score, 1e-6)
        is_less = share < WIDE_SEARCH_SHARE or (share < SURPRISE_SHARE and self._motion(frame, frame.found) > SURPRISE)
        return is_less or evidence.quality < MIN_LEARNING_QUALITY

    def _quality(self, frame: FrameContext) -> float:
        """Quality of the selected pose by the evidence of edges and colours, and by texture."""
        evidence = frame.found.evidence
        return evidence.quality_with(0.0 if frame.found.matches is None else TEXTURE_SCORE * frame.found_share)

    def _as_predicted(self, frame: FrameContext, unknown_twist: Array) -> RefinedPose:
        """The best pose with the predicted turn about an axis, and without what its information says of that turn."""
        best = frame.found
        turn_rad = float(relative_twist(frame.predicted, best.cam_from_body)[:3] @ unknown_twist[:3])
        pose = apply_twist(best.cam_from_body, -turn_rad * unknown_twist)
        told = best.information @ unknown_twist
        information = best.information - np.outer(told, told) / max(float(told @ unknown_twist), 1e-12)
        return best._replace(cam_from_body=pose, information=information)

    # --- State --------------------------------------------------------------------------------------------

    def _prepare(self, image: NDArray[np.uint8]) -> FrameContext:
        """A frame with its predicted pose and the texture found in it."""
        state = self.state
        predicted = apply_twist(state.cam_from_body, state.velocity)
        frame = FrameContext(image, self._levels(image, [state.cam_from_body, predicted]), predicted, predicted)
        state.follow_exposure(frame.levels.gray)
        if self._texture is not None:
            frame.pyramid = self._texture.pyramid(frame.levels.gray)
            matches = self._texture.measure(frame.pyramid, predicted)
            frame.found_share = len(matches.weights) / max(matches.tried, 1)
            if len(matches.weights) >= MIN_MATCHES and frame.found_share >= MIN_MATCH_SHARE:
                frame.matches, frame.start = matches, self._texture.align(matches, predicted)
        if self.options.matcher is not None:
            part = self.refiner.part
            points = self.options.matcher.match(image, predicted @ part.body_from_model)
            if len(points.weights):
                frame.matches = points.joined(frame.matches, part.views.center_in_model)
                frame.found_share = len(frame.matches.weights) / frame.matches.tried
        return frame

    def _update(self, frame: FrameContext, quality: float) -> None:
        """Update pose, velocity, usual score, colours and texture for the next frame."""
        state, o = self.state, self.options
        pose, evidence = frame.found.cam_from_body, frame.found.evidence
        fine_score = frame.found.scores.fine_score
        if state.is_started:
            state.motion.learn(self._innovation(frame), self._is_unusual(frame), frame.is_rechecked)
            state.usual_score += SCORE_RATE * (evidence.score - state.usual_score)
            state.usual_fine_score += SCORE_RATE * (fine_score - state.usual_fine_score)
            state.velocity = VELOCITY_DECAY * relative_twist(state.cam_from_body, pose)
        else:
            # The start may have been off, so neither its scores nor the motion from it mean anything.
            state.is_started, state.usual_score, state.usual_fine_score = True, evidence.score, fine_score
        state.cam_from_body = pose
        state.edge_support += SUPPORT_RATE * (evidence.contour_support - state.edge_support)
        self._choose_modalities()
        state.frames += 1
        self._measure_spread(frame.levels, SPREAD_RATE)
        if quality > MIN_LEARNING_QUALITY:
            if o.use_region:
                frame.levels.finest_colors.learn_colors(pose, state.appearance, LEARNING_RATE)
            if self._texture is not None:
                self._remember_texture(frame)

    def _choose_modalities(self) -> None:
        """Edges of a smooth part count in the next frame only where they have agreed with its outline in the last ones.

        The outline of a smooth surface is no edge of the part but its limb, beside which light, gloss and shadows make
        stronger steps; colours alone then find it better.
        """
        state = self.state
        if self.refiner.part.is_smooth and self.options.use_edge and self.options.use_region:
            state.uses_edges = state.edge_support >= (MIN_EDGE_SUPPORT if state.uses_edges else NEW_EDGE_SUPPORT)

    def _levels(self, image: NDArray[np.uint8], poses: list[Array]) -> RefinementPyramid:
        """The frame at the scales of the last of some poses (4,4), around the part at all of them."""
        if self.state.uses_edges:
            return RefinementPyramid(self.refiner, image, poses, self.state.spread_px, SCALE)
        return RefinementPyramid(self.refiner.by_colors(), image, poses, self.state.spread_px, COLOR_SCALE)

    def _measure_spread(self, levels: RefinementPyramid, rate: float) -> None:
        """Move the estimated blur of the part's edges by a share towards that of a frame at the last pose."""
        state = self.state
        spread_px = levels.finest.edge_spread_px(state.cam_from_body)
        if spread_px is not None:
            state.spread_px += rate * (spread_px - state.spread_px)

    def _remember_texture(self, frame: FrameContext) -> None:
        """Update the trust in the keyframes, and add one where it is missing and nothing hides the outline."""
        assert self._texture is not None and frame.pyramid is not None
        state, best = self.state, frame.found
        pose, evidence, matches = best.cam_from_body, best.evidence, best.matches
        if matches is not None:
            self._texture.update_trust(pose)
        state.best_contour_support = max(SUPPORT_DECAY * state.best_contour_support, evidence.contour_support)
        is_unhidden = evidence.contour_support > MIN_KEYFRAME_SUPPORT * state.best_contour_support
        is_unhidden &= evidence.points_in_picture > MIN_KEYFRAME_IN_PICTURE
        tracked_count = 0 if matches is None else len(matches.weights)
        if (
            is_unhidden
            and state.motion.is_calm
            and evidence.quality > MIN_KEYFRAME_QUALITY
            and self._texture.wants_keyframe(pose, tracked_count)
        ):
            self._texture.add_keyframe(frame.pyramid, pose)

    # --- Other poses of the last frame, and covariance ----------------------------------------------------

    def refined_near(self, image: NDArray[np.uint8], cams_from_model: list[Array]) -> list[tuple[Array, float]]:
        """Poses (4,4) after a fine refinement in the last frame, each with its score, see `PoseScores.mean`."""
        appearance, fine = self.state.appearance, STAGES[-2:]
        in_body = [pose @ self.refiner.part.model_from_body for pose in cams_from_model]
        levels = self._levels(image, in_body)
        poses = [levels.refine(pose, fine, appearance, first=-1)[0] for pose in in_body]
        return [(pose @ self.refiner.part.body_from_model, levels.scores(pose, appearance).mean) for pose in poses]

    def covariance(self, estimate: Estimate) -> Array:
        """Covariance (6,6) of the twist (rad, mm) about the model's centre.

        It holds for the error of the pose in this frame, see `common_covariance`.
        """
        cam_from_body = estimate.cam_from_model @ self.refiner.part.model_from_body
        own = covariance_of(estimate.information, estimate.quality, self.diameter_mm, POINTS_OF_FRAME)
        radius_px, motion = self.refiner.radius_px(cam_from_body), self.state.velocity / VELOCITY_DECAY
        return own + common_covariance(cam_from_body, radius_px, self.diameter_mm, motion)
