"""Subjects: the parts that one stream shows, each with its guide views, its inspection and a name."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from arview import overlay as overlays
from arview import tracking
from arview.camera import Camera, guess_camera, load_camera
from arview.core.messages import sentence
from arview.fiducials import SerialNumbers
from arview.station.live.options import LiveOptions
from arview.station.live.stream.notices import Notice
from arview.station.live.stream.subject import OverlayStyle, Subject
from arview.video import load_square_camera

PHONE_FOV = "fov:66"
"""Camera assumed for phones: field of view along the longer side. Their main cameras have 65 to 72° (24 to 28 mm)."""
MAX_FILE_NAME = 80
"""Letters of the names of the parts in the name of a recording."""


class Subjects:
    """The parts, or specimens of one part, that are shown; safe to use from several threads.

    Args:
        parts: each with a name of its own where there are several.
    """

    def __init__(self, parts: Sequence[Subject]) -> None:
        self._parts = tuple(parts)
        self.options: LiveOptions = parts[0].options

    def __iter__(self) -> Iterator[Subject]:
        return iter(self._parts)

    def __len__(self) -> int:
        return len(self._parts)

    def __getitem__(self, number: int) -> Subject:
        return self._parts[number]

    @property
    def file_name(self) -> str:
        """The names of the parts, each once, for the names of files."""
        return "+".join(dict.fromkeys(one.part.name for one in self._parts))[:MAX_FILE_NAME]

    @property
    def revision(self) -> int:
        """Number of the part document, increased with each new inspection."""
        return sum(one.revision for one in self._parts) - len(self._parts) + 1

    @property
    def serial_numbers(self) -> list[SerialNumbers | None]:
        """Serial number to which the labels of each part belong."""
        return [one.serial_numbers for one in self._parts]

    def reload(self) -> bool:
        """Read changed inspections again; returns whether another one is shown now."""
        return sum(one.reload() for one in self._parts) > 0

    def notices(self) -> list[Notice]:
        """The notices about camera and inspections; with several parts each says which one it is of."""
        notices = []
        for one in self._parts:
            about = f"{one.name}: " if one.name else ""
            notices += [replace(notice, text=about + notice.text) for notice in one.notices()]
        if self.options.camera is None:
            notices.append(Notice("camera_guessed", "warning", sentence("told.camera_guessed")))
        return notices

    def camera(
        self,
        width: int,
        height: int,
        quarter_turns_clockwise: int = 0,
        unsquared_size: tuple[int, int] | None = None,
    ) -> Camera:
        """Intrinsics for the frames of a feed, whose pixels may have been made square.

        Raises:
            InputError, MismatchError: the camera file cannot be read or is for frames of another aspect ratio.
        """
        spec, source = self.options.camera, self.options.source
        if spec is not None:
            size = (width, height)
            return load_square_camera(spec, size, unsquared_size, quarter_turns_clockwise, source)
        if self.options.is_phone:
            return load_camera(PHONE_FOV, width, height)
        return guess_camera(width, height)

    def session(self, camera: Camera) -> tracking.TrackingSession:
        """The tracking of all parts for a feed with this camera, which is replaced while it runs if it is guessed."""
        parts = [one.tracked_part(camera) for one in self._parts]
        return tracking.TrackingSession(parts, camera, is_guessed=self.options.camera is None)

    def overlay(self, camera: Camera, style: OverlayStyle) -> overlays.OverlayRenderer:
        """The drawing of all parts for a feed with this camera."""
        overlay = self._parts[0].overlay(camera, style)
        for number, part in enumerate(self._parts[1:], 1):
            part.overlay(camera, style, number, overlay)
        return overlay
