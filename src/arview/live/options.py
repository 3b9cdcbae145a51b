"""Options of the live server."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from arview.errors import InputError

PHONE = "phone"
LEAST_SIDE_PX, MOST_SIDE_PX = 120, 1920


@dataclass(frozen=True)
class LiveOptions:
    """What is served to whom, and within which limits.

    Raises:
        InputError: a value is outside its range.
    """

    source: str = PHONE  # "phone": each page sends its own camera; else a spec of arview.video.open_source
    camera: str | None = None  # spec of arview.camera.read.load_camera; None: guessed, and said so on the page
    inspection: Path | None = None  # inspection.json, read again whenever it changes
    serial: str | None = None  # of the specimen at the station; None: what the part file says, if anything
    max_age_s: float | None = 86400.0  # an older inspection is called old on the page; None: never. A day: one shift
    guide: str | None = None  # name of a guide view to align with; None: the part is searched for
    record: Path | None = None  # video of what is shown, from the start; None: only when the page asks
    record_folder: Path = Path()  # where recordings that a page asks for are put
    width: int = 1280  # of the phone's pictures, px, held sideways; phones and trackers manage this at 30 fps
    height: int = 720
    fps: float = 30.0
    clients: int | None = None  # pages at once; None: 2 phones (one tracker each), or 8 that look at a station
    watchers: int = 4  # screens that only watch, as motion JPEG
    watch_fps: float = 15.0  # of them: enough to watch, half the encoding
    requests_per_s: float = 80.0  # by one address; a page that sends JPEGs needs about 35
    requests_burst: float = 240.0
    joins_per_s: float = 1.0  # by one address; each join costs a tracker and a handshake
    joins_burst: float = 12.0
    jpeg_silence_s: float = 15.0  # a page without WebRTC that is silent for so long has gone
    connect_timeout_s: float = 20.0  # from the offer to a connection

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            value = getattr(self, name)
            if not LEAST_SIDE_PX <= value <= MOST_SIDE_PX or value % 2:
                raise InputError(f"live: {name} is {value} px, expected an even number {LEAST_SIDE_PX}–{MOST_SIDE_PX}")
        if not 1.0 <= self.fps <= 120.0:
            raise InputError(f"live: {self.fps:g} frames per second, expected 1 to 120")
        if self.clients is not None and not 1 <= self.clients <= 64:
            raise InputError(f"live: {self.clients} clients, expected 1 to 64")
        if self.max_age_s is not None and not self.max_age_s > 0:
            raise InputError(f"live: an age of {self.max_age_s:g} s, expected a positive one")

    @property
    def is_phone(self) -> bool:
        """Whether each page sends its own camera."""
        return self.source == PHONE

    @property
    def most_clients(self) -> int:
        """Pages that may take part at once."""
        return self.clients if self.clients is not None else 2 if self.is_phone else 8
