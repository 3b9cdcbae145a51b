"""Which searches the detector makes in a frame without a pose.

A lost part is not searched for soon after a search, nor where nothing has changed since. The thorough search for it is
spread over several frames.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.detection.detector import Detector
from arview.detection.scene_change import SceneChange
from arview.guideviews import GuideViewSet
from arview.pose import TrackingState
from arview.tracking.session_options import SessionOptions
from arview.tracking.session_state import SessionState


class SearchPlan:
    """Plans the searches for one part; what it remembers of a loss is in the state of the session.

    Args:
        views: guide views of the part.
        camera: of the frames.
        options: of the session.
    """

    def __init__(self, views: GuideViewSet, camera: Camera, options: SessionOptions) -> None:
        self._options = options
        self._scene = SceneChange(views, camera, options.scene_change)

    def searches(self, image: NDArray[np.uint8], state: SessionState, detector: Detector) -> list[int] | None:
        """The searches of the detector in this frame; None: all until one gives a sure result, empty: none.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            state: of the session, in which the planned searches are noted.
            detector: of the part.
        """
        o, s = self._options, state
        frame = s.frames_without_pose
        if s.state == TrackingState.SEARCHING:
            return None if frame % (2 * o.search_every) == 1 else [0]
        if frame > o.eager_frames and frame - s.last_search_frame < o.search_every:
            return []
        picture = self._scene.reduced(image)
        is_known = s.searched_picture is not None and not self._scene.has_changed(s.searched_picture, picture)
        is_known = is_known and frame - s.last_search_frame < o.max_unchanged_frames
        if not is_known:
            # Compared with this picture from now on, so that slow changes add up.
            s.searched_picture, s.parts_left = picture, o.thorough_parts
        searches = [] if is_known and frame > o.eager_frames else [0]
        if s.parts_left and (s.thorough_part or frame >= max(s.next_thorough_frame, 2 * o.search_every)):
            # A wider search finds what the quick one would find.
            searches = self._next_thorough_part(s, detector) or searches
        if searches:
            s.last_search_frame = frame
        return searches

    def hides_parts(self, state: SessionState) -> bool:
        """Whether other parts are hidden in this frame: in every second round, as the part may stand on another."""
        return state.frames_without_pose // (2 * self._options.search_every) % 2 == 0

    def _next_thorough_part(self, state: SessionState, detector: Detector) -> list[int]:
        """The next part of the thorough search for a lost part; after the last one it is done for a while."""
        o, s = self._options, state
        part = np.array_split(detector.wider_searches, o.thorough_parts)[s.thorough_part]
        s.thorough_part = (s.thorough_part + 1) % o.thorough_parts
        s.parts_left -= 1
        if s.thorough_part == 0:
            s.next_thorough_frame = s.frames_without_pose + o.thorough_every
        return [int(k) for k in part]
