"""Which searches the detector makes in a frame without a pose.

A lost part is not searched for soon after a search, nor where nothing has changed since. The thorough search for it is
spread over several frames.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.detection import Detector, SceneChange
from arview.guideviews import GuideViewSet
from arview.pose import TrackingState
from arview.tracking.session_state import SessionState

EAGER_FRAMES = 2
"""Frames after a loss in each of which the part is searched for."""
SEARCH_EVERY = 3
"""After ``EAGER_FRAMES`` the part is searched for only so many frames after the last search."""
FIRST_FRAMES = 12
"""Frames in each of which a part that was never found is searched for; later it is searched for like a lost one."""
THOROUGH_EVERY = 24
"""Frames from the end of one thorough search for a lost part to the next."""
THOROUGH_PARTS = 3
"""Number of searches over which a thorough one is spread, so that no frame takes long."""
MAX_UNCHANGED_FRAMES = 30
"""Frames after which a picture in which nothing has changed is searched again."""


class SearchPlan:
    """Plans the searches for one part; what it remembers of a loss is in the state of the session.

    Args:
        views: guide views of the part.
        camera: of the frames.
    """

    def __init__(self, views: GuideViewSet, camera: Camera) -> None:
        self._scene = SceneChange(views, camera)

    def searches(self, image: NDArray[np.uint8], state: SessionState, detector: Detector) -> list[int] | None:
        """The searches of the detector in this frame; None: all until one gives a sure result, empty: none.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            state: of the session, in which the planned searches are noted.
            detector: of the part.
        """
        s = state
        frame = s.frames_without_pose
        if s.state == TrackingState.SEARCHING and frame <= FIRST_FRAMES:
            return None if frame % (2 * SEARCH_EVERY) == 1 else [0]
        if frame > EAGER_FRAMES and frame - s.last_search_frame < SEARCH_EVERY:
            return []
        picture = self._scene.reduced(image)
        is_known = s.searched_picture is not None and not self._scene.has_changed(s.searched_picture, picture)
        is_known = is_known and frame - s.last_search_frame < MAX_UNCHANGED_FRAMES
        if not is_known:
            # Compared with this picture from now on, so that slow changes add up.
            s.searched_picture, s.parts_left = picture, THOROUGH_PARTS
        searches = [] if is_known and frame > EAGER_FRAMES else [0]
        if s.parts_left and (s.thorough_part or frame >= max(s.next_thorough_frame, 2 * SEARCH_EVERY)):
            # A wider search finds what the quick one would find.
            searches = self._next_thorough_part(s, detector) or searches
        if searches:
            s.last_search_frame = frame
        return searches

    def hides_parts(self, state: SessionState) -> bool:
        """Whether other parts are hidden in this frame: in every second round, as the part may stand on another."""
        return state.frames_without_pose // (2 * SEARCH_EVERY) % 2 == 0

    def _next_thorough_part(self, state: SessionState, detector: Detector) -> list[int]:
        """The next part of the thorough search for a lost part; after the last one it is done for a while."""
        s = state
        part = np.array_split(detector.wider_searches, THOROUGH_PARTS)[s.thorough_part]
        s.thorough_part = (s.thorough_part + 1) % THOROUGH_PARTS
        s.parts_left -= 1
        if s.thorough_part == 0:
            s.next_thorough_frame = s.frames_without_pose + THOROUGH_EVERY
        return [int(k) for k in part]
