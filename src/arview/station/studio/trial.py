"""A trial of the part that is set up: is it found in a picture, or followed in a clip?"""

from __future__ import annotations

import itertools
import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from arview import guideviews, overlay, tracking
from arview.cad import Part
from arview.camera import Camera, guess_camera, load_camera
from arview.detection import Detector
from arview.errors import InputError
from arview.pose import Pose, TrackingState
from arview.video import open_source

Image = NDArray[np.uint8]

MAX_FRAMES = 60
"""Frames of a clip that are tried."""


class Trials:
    """Tries the part, one picture or clip at a time.

    Attributes:
        picture: JPEG of the last trial, with the part drawn where it was found.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.picture: bytes | None = None

    def run(self, part: Part, path: Path, camera_spec: str | None) -> dict[str, Any]:
        """Find the part in a picture, or follow it through the first frames of a clip.

        Args:
            part: as it is set up.
            path: of the picture or clip.
            camera_spec: camera file or ``fov:DEG``; None: guessed.

        Raises:
            InputError: the file cannot be read, or the camera does not fit it.
        """
        with self._lock:
            with open_source(str(path)) as source:
                images = [frame.image for frame in itertools.islice(source, MAX_FRAMES)]
            if not images:
                raise InputError(f"{path.name}: there is no picture in it")
            height, width = images[0].shape[:2]
            camera = load_camera(camera_spec, width, height) if camera_spec else guess_camera(width, height)
            views = guideviews.cached_guide_views(part.model, part.effective_view_range)
            found = self._detect(part, views, camera, images[0]) if len(images) == 1 else None
            return found or self._track(part, views, camera, images)

    def _detect(self, part: Part, views: guideviews.GuideViewSet, camera: Camera, image: Image) -> dict[str, Any]:
        found = Detector(views, camera).detect(image)
        best = found[0] if found else None
        pose = Pose(
            cam_from_model=best.cam_from_model if best else None,
            covariance=None,
            quality=best.quality if best else 0.0,
            state=TrackingState.TRACKED if best else TrackingState.SEARCHING,
            time_s=0.0,
            index=0,
        )
        self._draw(part, camera, image, pose)
        reason = "" if best else "not found: is the part whole in the picture, in the range, and not too small?"
        if best and best.alternatives:
            reason = f"ambiguous: {len(best.alternatives)} other poses fit as well"
        return {"frames": 1, "tracked": int(best is not None), "quality": pose.quality, "reason": reason}

    def _track(self, part: Part, views: guideviews.GuideViewSet, camera: Camera, images: list[Image]) -> dict[str, Any]:
        session = tracking.TrackingSession.of(views, camera, part.model)
        poses = [session.process(image, index, index / 30.0)[0] for index, image in enumerate(images)]
        tracked = [pose for pose in poses if pose.state is TrackingState.TRACKED]
        shown = max(poses, key=lambda pose: pose.quality)
        self._draw(part, camera, images[shown.index], shown)
        components = {name: str(one.presence) for name, one in poses[-1].components.items()}
        return {
            "frames": len(poses),
            "tracked": len(tracked),
            "quality": shown.quality,
            "reason": next((pose.reason for pose in reversed(poses) if pose.reason), ""),
            "components": components,
        }

    def _draw(self, part: Part, camera: Camera, image: Image, pose: Pose) -> None:
        drawn = overlay.OverlayRenderer(part.model, camera).draw(image, pose)
        _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(drawn, cv2.COLOR_RGB2BGR))
        self.picture = jpeg.tobytes()
