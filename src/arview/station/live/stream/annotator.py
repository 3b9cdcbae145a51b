"""Annotated pictures of the frames of a feed, each drawn once for all who ask for it."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from arview import overlay
from arview.camera import Camera
from arview.station.live.stream.feed import TrackedFrame
from arview.station.live.stream.frames import to_jpeg
from arview.station.live.stream.subject import OverlayStyle
from arview.station.live.stream.subjects import Subjects
from arview.video import Image

DRAW_TIMEOUT_S = 10.0
"""A picture that is drawn for longer is given up, and others are drawn without it."""
KEPT_STYLES = 6
"""Overlay styles that keep a renderer and their last picture: pages, recording and screens."""


@dataclass(frozen=True)
class Screen:
    """The size that a page shows its picture at.

    Attributes:
        width, height: px of the screen.
        density: px of the screen for each CSS px.
        text_css_px: size of the text on labels, CSS px.
    """

    width: int
    height: int
    density: float
    text_css_px: float = 13.0

    def fitted(self, camera: Camera) -> Camera:
        """The camera of the picture that is drawn: with even sides, and no larger than the screen or its own frames."""
        share = min(1.0, self.width / camera.width, self.height / camera.height)
        width, height = (max(64, 2 * round(share * side / 2)) for side in (camera.width, camera.height))
        return camera if share == 1.0 else camera.scaled(width, height)

    def text_px(self, camera: Camera) -> int:
        """Size of the text in a picture of this camera that is shown on the whole width of the screen."""
        return max(9, round(self.text_css_px * self.density * camera.width / self.width))


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
    """Draws in one style, for one screen, and keeps the last annotated frame."""

    def __init__(self, subjects: Subjects, style: OverlayStyle, screen: Screen | None) -> None:
        self._subjects, self._style, self._screen = subjects, style, screen
        self._camera: Camera | None = None
        self._overlay: overlay.OverlayRenderer | None = None
        self._made_for: tuple[Camera, int] | None = None
        self._last: AnnotatedFrame | None = None

    def draw(self, tracked: TrackedFrame) -> AnnotatedFrame:
        if self._last is not None and self._last.tracked is tracked:
            return self._last
        revision, camera = self._subjects.revision, tracked.camera
        made_for = self._made_for
        if self._overlay is None or made_for is None or made_for[0] is not camera or made_for[1] != revision:
            self._camera = camera if self._screen is None else self._screen.fitted(camera)
            text_px = None if self._screen is None else self._screen.text_px(self._camera)
            self._overlay = self._subjects.overlay(self._camera, replace(self._style, text_px=text_px))
            self._made_for = camera, revision
        image = tracked.frame.image
        if self._camera is not None and self._camera is not camera:
            size = self._camera.width, self._camera.height
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
        self._last = AnnotatedFrame(tracked, self._overlay.draw(image, tracked.poses))
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
        self._renderers: OrderedDict[tuple[OverlayStyle, Screen | None], _StyleRenderer] = OrderedDict()

    def draw(
        self, tracked: TrackedFrame, style: OverlayStyle | None = None, screen: Screen | None = None
    ) -> AnnotatedFrame:
        """The annotated frame. Drawing takes some milliseconds, so do not call this in the event loop.

        Args:
            tracked: the frame and its pose.
            style: overlay style; default: the one that the pages have chosen.
            screen: where the picture is shown: it is made no larger, and its labels can be read there; default: the
                picture has the size of the frame.
        """
        wanted = style or self.style, screen
        lock, renderers = self._lock, self._renderers
        if not lock.acquire(timeout=DRAW_TIMEOUT_S):
            # The thread that draws does not come back: it keeps its renderers, and others get new ones.
            if lock is self._lock:
                self._lock, self._renderers = threading.Lock(), OrderedDict()
            return self.draw(tracked, style, screen)
        try:
            renderer = renderers.pop(wanted, None) or _StyleRenderer(self._subjects, *wanted)
            renderers[wanted] = renderer
            if len(renderers) > KEPT_STYLES:
                renderers.popitem(last=False)
            return renderer.draw(tracked)
        finally:
            lock.release()

    def show(self, subjects: Subjects) -> None:
        """Draw other parts, or the same ones with other numbers, from the next frame on."""
        self._subjects = subjects
        self._renderers = OrderedDict()

    def close(self) -> None:
        """Release pictures and renderers."""
        self._renderers = OrderedDict()

    def draw_with_status(self, tracked: TrackedFrame) -> AnnotatedFrame:
        """As `draw`, with the status line: for files, which are viewed without the page around them."""
        return self.draw(tracked, replace(self.style, status=True))
