"""TrackingSession: one part in one stream of frames, as a machine of states with hysteresis.

``searching`` until the part is first found, ``tracked`` while the picture bears the pose out, ``critical`` while it
hardly does, ``lost`` when it no longer does; from ``searching`` and ``lost`` the detector looks for the part.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.cad.model import Model
from arview.camera import Camera
from arview.errors import InputError, MismatchError
from arview.geometry import Array, apply, check_rigid
from arview.guideviews import GuideViewSet
from arview.pose import Pose, TrackingState
from arview.tracking.detector import Detector, DetectorOptions
from arview.tracking.tracker import Estimate, Tracker, TrackerOptions


@dataclass(frozen=True)
class SessionOptions:
    """Options of a session.

    Attributes:
        use_region, use_edge, use_feature: modalities of the tracker.
        lock_quality: a detection must be this good to be believed at once; a weaker one must hold a second frame.
        tracked_quality: at least this to be or become ``tracked``.
        critical_quality: a tracked pose turns ``critical`` only below this (hysteresis).
        lost_quality: below this the pose is dropped after ``lost_frames`` frames.
        lost_frames: frames in a row.
        critical_frames: so many critical frames in a row end in ``lost`` too.
        eager_frames, search_every: a lost part is looked for in so many frames at once, then in every n-th.
        min_in_picture: less of the outline inside the picture cannot hold a pose.
        detector: None chooses by the declared range.
    """

    use_region: bool = True
    use_edge: bool = True
    use_feature: bool = True
    lock_quality: float = 0.8
    tracked_quality: float = 0.5
    critical_quality: float = 0.25
    lost_quality: float = 0.1
    lost_frames: int = 2
    critical_frames: int = 45
    eager_frames: int = 2
    search_every: int = 3
    min_in_picture: float = 0.25
    detector: DetectorOptions | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.lost_quality <= self.critical_quality <= self.tracked_quality <= 1:
            raise InputError("session: expected 0 ≤ lost_quality ≤ critical_quality ≤ tracked_quality ≤ 1")


class TrackingSession:
    """Detects and tracks a part through a stream of frames.

    Args:
        views: guide views of the model.
        model: the same model; its surface is needed by the feature modality.
        camera: intrinsics of the frames.
        options: see SessionOptions.
        initial_cam_from_model: (4,4) mm; the first frame snaps to it and does not search.

    Raises:
        MismatchError: guide views of another model.
        InputError: an initial pose that is not a rigid transform.
    """

    def __init__(
        self,
        views: GuideViewSet,
        model: Model,
        camera: Camera,
        options: SessionOptions | None = None,
        initial_cam_from_model: Array | None = None,
    ) -> None:
        self.options = options or SessionOptions()
        if views.model_hash != model.source_hash:
            raise MismatchError(
                f"guide views of model {views.model_name!r} ({views.model_hash[:12]}) do not belong to "
                f"{model.name!r} ({model.source_hash[:12]})"
            )
        self.camera = camera
        self._views = views
        self.tracker = Tracker(
            views,
            camera,
            TrackerOptions(
                use_region=self.options.use_region,
                use_edge=self.options.use_edge,
                use_feature=self.options.use_feature,
            ),
            model,
        )
        self._detector: Detector | None = None
        self._initial = None if initial_cam_from_model is None else check_rigid(initial_cam_from_model, "initial pose")
        self.reset()

    @property
    def detector(self) -> Detector:
        """The detector, made when first needed."""
        if self._detector is None:
            self._detector = Detector(self._views, self.camera, self.options.detector)
        return self._detector

    def reset(self) -> None:
        """Forget the part's place: search again."""
        self.state = TrackingState.SEARCHING
        self._poor = 0
        self._critical = 0
        self._lost_frames = 0
        self._confirmed = False
        self._why = ""

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
        ms = (time.perf_counter() - started) * 1e3
        if estimate is None:
            return Pose(None, None, 0.0, self.state, time_s, index, ms, reason)
        return Pose(
            cam_from_model=estimate.cam_from_model,
            covariance=self.tracker.covariance(estimate),
            quality=estimate.quality,
            state=self.state,
            time_s=time_s,
            index=index,
            ms=ms,
            reason=reason,
        )

    def _follow(self, image: NDArray[np.uint8]) -> tuple[Estimate | None, str]:
        o = self.options
        estimate = self.tracker.track(image)
        quality = estimate.quality
        outside = estimate.evidence.points_in_picture < o.min_in_picture or not self._is_possible(estimate)
        poor = outside or quality < o.lost_quality
        self._poor = self._poor + 1 if poor else 0
        if self._poor >= o.lost_frames or (poor and not self._confirmed):
            return self._lose("the part left the picture" if outside else "the part is hidden or moved too fast")
        was_tracked = self.state == TrackingState.TRACKED
        if not poor and quality >= (o.critical_quality if was_tracked else o.tracked_quality):
            self.state = TrackingState.TRACKED
            self._critical = 0
            self._confirmed = True
            return estimate, ""
        self.state = TrackingState.CRITICAL
        self._critical += 1
        if self._critical > o.critical_frames or not self._confirmed:
            return self._lose("the outline is not seen where it should be")
        return estimate, "the outline is hardly seen"

    def _lose(self, reason: str) -> tuple[None, str]:
        self.state = TrackingState.LOST
        self._poor = self._critical = self._lost_frames = 0
        self._confirmed = False
        self._why = reason
        return None, reason

    def _is_possible(self, estimate: Estimate) -> bool:
        """In front of the camera and not much nearer or farther than declared."""
        center = apply(estimate.cam_from_model, self._views.center_in_model)
        low, high = self._views.view_range.distance_mm
        return bool(center[2] > 0 and 0.5 * low < np.linalg.norm(center) < 2.0 * high)

    def _search(self, image: NDArray[np.uint8]) -> tuple[Estimate | None, str]:
        o = self.options
        if self._initial is not None:
            detection = self.detector.snap(image, self._initial)
            self._initial = None
        else:
            self._lost_frames += 1
            rests = self._lost_frames > o.eager_frames and self._lost_frames % o.search_every != 0
            if self.state == TrackingState.LOST and rests:
                return None, self._why
            is_thorough = self.state == TrackingState.SEARCHING or self._lost_frames % (2 * o.search_every) == 0
            detections = self.detector.detect(image, max_results=1, is_thorough=is_thorough)
            if not detections:
                self._why = self._why_not(image)
                return None, self._why
            detection = detections[0]
        self.tracker.start(image, detection.cam_from_model)
        estimate = self.tracker.track(image)
        if estimate.quality < o.tracked_quality or not self._is_possible(estimate):
            return None, self._why_not(image)
        self._poor = self._critical = 0
        self._confirmed = estimate.quality >= o.lock_quality
        self.state = TrackingState.TRACKED if self._confirmed else TrackingState.CRITICAL
        return estimate, "" if self._confirmed else "found, to be confirmed"

    def _why_not(self, image: NDArray[np.uint8]) -> str:
        """The likeliest reason in words: light and blur first."""
        small = cv2.cvtColor(image[::2, ::2], cv2.COLOR_RGB2GRAY)
        if float(np.percentile(small, 95)) < 40:
            return "too dark"
        if float(np.percentile(small, 5)) > 225:
            return "overexposed"
        if float(np.percentile(np.abs(cv2.Laplacian(small, cv2.CV_32F)), 99)) < 8:
            return "blurred or nothing in view"
        return "no view of the part fits"
