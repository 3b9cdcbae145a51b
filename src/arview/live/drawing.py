"""Drawing: the annotated picture of a feed's frames, drawn once however many want it."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from functools import cached_property

from arview.camera import Camera
from arview.live.feed import Tracked
from arview.live.frames import to_jpeg
from arview.live.subject import Look, Subject
from arview.overlay import OverlayRenderer
from arview.video import Image


@dataclass(frozen=True, eq=False)
class Drawn:
    """An annotated frame."""

    tracked: Tracked
    image: Image  # (H,W,3) uint8 RGB

    @cached_property
    def jpeg(self) -> bytes:
        """The annotated picture as JPEG."""
        return to_jpeg(self.image)


class Drawing:
    """Draws frames of one feed; the last drawing is kept for whoever asks next. Safe to use from several threads."""

    def __init__(self, subject: Subject) -> None:
        self._subject = subject
        self._lock = threading.Lock()
        self._look = Look()
        self._overlay: OverlayRenderer | None = None
        self._made_for: tuple[Camera, int, Look] | None = None
        self._last: Drawn | None = None

    @property
    def look(self) -> Look:
        """What is drawn."""
        return self._look

    @look.setter
    def look(self, look: Look) -> None:
        with self._lock:
            self._look, self._last = look, None

    def draw(self, tracked: Tracked) -> Drawn:
        """The annotated picture of a frame; takes some milliseconds, so never call it in the event loop."""
        with self._lock:
            if self._last is not None and self._last.tracked is tracked:
                return self._last
            self._last = Drawn(tracked, self._renderer(tracked.camera).draw(tracked.picture.image, tracked.pose))
            return self._last

    def _renderer(self, camera: Camera) -> OverlayRenderer:
        revision = self._subject.revision
        made_for = self._made_for
        is_same = made_for is not None and made_for[0] is camera and made_for[1:] == (revision, self._look)
        if self._overlay is None or not is_same:
            self._overlay = self._subject.overlay(camera, self._look)
            self._made_for = camera, revision, self._look
        return self._overlay
