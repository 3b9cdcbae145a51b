"""Drawing: the annotated picture of a feed's frames, drawn once however many want it."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass, replace
from functools import cached_property

from arview.camera import Camera
from arview.live.stream.feed import Tracked
from arview.live.stream.frames import to_jpeg
from arview.live.stream.subject import Look, Subject
from arview.overlay import OverlayRenderer
from arview.video import Image

KEPT_LOOKS = 4
"""Pages, recording and screens; each keeps a renderer and a picture."""


@dataclass(frozen=True, eq=False)
class Drawn:
    """An annotated frame."""

    tracked: Tracked
    image: Image  # (H,W,3) uint8 RGB

    @cached_property
    def jpeg(self) -> bytes:
        """The annotated picture as JPEG."""
        return to_jpeg(self.image)


class _Pencil:
    """Draws one look, and keeps its last drawing."""

    def __init__(self, subject: Subject, look: Look) -> None:
        self._subject, self._look = subject, look
        self._overlay: OverlayRenderer | None = None
        self._made_for: tuple[Camera, int] | None = None
        self._last: Drawn | None = None

    def draw(self, tracked: Tracked) -> Drawn:
        if self._last is not None and self._last.tracked is tracked:
            return self._last
        revision, camera = self._subject.revision, tracked.camera
        made_for = self._made_for
        if self._overlay is None or made_for is None or made_for[0] is not camera or made_for[1] != revision:
            self._overlay = self._subject.overlay(camera, self._look)
            self._made_for = camera, revision
        self._last = Drawn(tracked, self._overlay.draw(tracked.picture.image, tracked.pose))
        return self._last


class Drawing:
    """Draws frames of one feed; safe to use from several threads.

    The last drawing of each of the last few looks is kept for whoever asks next.

    Attributes:
        look: what the pages of the feed have asked for.
    """

    def __init__(self, subject: Subject) -> None:
        self.look = Look()
        self._subject = subject
        self._lock = threading.Lock()
        self._pencils: OrderedDict[Look, _Pencil] = OrderedDict()

    def draw(self, tracked: Tracked, look: Look | None = None) -> Drawn:
        """The annotated picture of a frame; takes some milliseconds, so never call it in the event loop.

        Args:
            tracked: the frame.
            look: default: what the pages have asked for.
        """
        wanted = look or self.look
        with self._lock:
            pencil = self._pencils.pop(wanted, None) or _Pencil(self._subject, wanted)
            self._pencils[wanted] = pencil
            if len(self._pencils) > KEPT_LOOKS:
                self._pencils.popitem(last=False)
            return pencil.draw(tracked)

    def close(self) -> None:
        """Let go of pictures and renderers."""
        with self._lock:
            self._pencils.clear()

    def draw_record(self, tracked: Tracked) -> Drawn:
        """As `draw`, with the status line: for files, which nothing else explains."""
        return self.draw(tracked, replace(self.look, status=True))
