"""Annotated pictures of the frames of a feed, each drawn once for all who ask for it."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass, replace
from functools import cached_property

from arview.camera import Camera
from arview.live.stream.feed import TrackedFrame
from arview.live.stream.frames import to_jpeg
from arview.live.stream.subject import OverlayStyle
from arview.live.stream.subjects import FrameOverlay, Subjects
from arview.video import Image


@dataclass(frozen=True, eq=False)
class AnnotatedFrame:
    """A tracked frame with its overlay.

    Attributes:
        tracked: the frame and its pose.
        image: (H,W,3) uint8 RGB with the overlay.
    """

    tracked: TrackedFrame
    image: Image

    @cached_property
    def jpeg(self) -> bytes:
        """The annotated picture as JPEG."""
        return to_jpeg(self.image)


class _StyleRenderer:
    """Draws in one style and keeps the last annotated frame."""

    def __init__(self, subjects: Subjects, style: OverlayStyle) -> None:
        self._subjects, self._style = subjects, style
        self._overlay: FrameOverlay | None = None
        self._made_for: tuple[Camera, int] | None = None
        self._last: AnnotatedFrame | None = None

    def draw(self, tracked: TrackedFrame) -> AnnotatedFrame:
        if self._last is not None and self._last.tracked is tracked:
            return self._last
        revision, camera = self._subjects.revision, tracked.camera
        made_for = self._made_for
        if self._overlay is None or made_for is None or made_for[0] is not camera or made_for[1] != revision:
            self._overlay = self._subjects.overlay(camera, self._style)
            self._made_for = camera, revision
        self._last = AnnotatedFrame(tracked, self._overlay.draw(tracked.frame.image, tracked.poses))
        return self._last


class FrameAnnotator:
    """Draws the overlay on the frames of one feed; safe to use from several threads.

    The renderers of the most recently used styles are kept, each with its last annotated frame.

    Attributes:
        style: overlay style that the pages of the feed have chosen.
    """

    def __init__(self, subjects: Subjects) -> None:
        self.style = OverlayStyle()
        self._subjects = subjects
        self._lock = threading.Lock()
        self._renderers: OrderedDict[OverlayStyle, _StyleRenderer] = OrderedDict()

    def draw(self, tracked: TrackedFrame, style: OverlayStyle | None = None) -> AnnotatedFrame:
        """The annotated frame. Drawing takes some milliseconds, so do not call this in the event loop.

        Args:
            tracked: the frame and its pose.
            style: overlay style; default: the one that the pages have chosen.
        """
        wanted = style or self.style
        lock, renderers = self._lock, self._renderers
        if not lock.acquire(timeout=self._subjects.options.feed.draw_timeout_s):
            # The thread that draws does not come back: it keeps its renderers, and others get new ones.
            if lock is self._lock:
                self._lock, self._renderers = threading.Lock(), OrderedDict()
            return self.draw(tracked, style)
        try:
            renderer = renderers.pop(wanted, None) or _StyleRenderer(self._subjects, wanted)
            renderers[wanted] = renderer
            if len(renderers) > self._subjects.options.feed.kept_styles:
                renderers.popitem(last=False)
            return renderer.draw(tracked)
        finally:
            lock.release()

    def close(self) -> None:
        """Release pictures and renderers."""
        self._renderers = OrderedDict()

    def draw_with_status(self, tracked: TrackedFrame) -> AnnotatedFrame:
        """As `draw`, with the status line: for files, which are viewed without the page around them."""
        return self.draw(tracked, replace(self.style, status=True))
