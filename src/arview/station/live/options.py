"""Options of the live server."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from arview.camera import UndistortOptions
from arview.errors import InputError

PHONE = "phone"
MIN_SIDE_PX, MAX_SIDE_PX = 120, 1920
"""Range of the sides of the pictures that a phone is asked for."""


UNDISTORT = UndistortOptions(max_growth=1.25, min_scale=0.3)
"""Of a wide lens: pictures are undistorted for the page, too, so they stay about as large as the frames."""


@dataclass(frozen=True)
class RecordingOptions:
    """When a recording ends by itself."""

    quota_bytes: int = 20_000_000_000  # size of all recordings in the folder, those of earlier runs included


@dataclass(frozen=True)
class RequestLimits:
    """Bounds on the requests of a client."""

    per_s: float = 80.0  # requests of one address; a page that sends JPEGs needs about 35
    burst: float = 240.0
    unauthenticated_per_s: float = 20.0  # requests of one address without the token
    unauthenticated_burst: float = 60.0
    joins_per_s: float = 1.0  # of one address; each join costs a tracker and a handshake
    joins_burst: float = 12.0
    images_per_s: float = 2.0  # of one page; drawing and packing a PNG takes 50 ms of a core
    images_burst: float = 6.0


@dataclass(frozen=True)
class JobOptions:
    """Bounds on the inspections that pages start, and on what they upload."""

    folder: Path = Path("arview_jobs")  # made when the first inspection is started
    min_free_bytes: int = 500_000_000  # free disk space that is left to results and other programs
    archive_days: float | None = None  # signed jobs unchanged for so long are moved to archive/; None: never
    workers: int = 1  # measurements that run at once; each uses both of two cores, unless they are on a cluster
    scheduler: str | None = None  # tcp://host:port of a Dask cluster that measures; None: this machine
    resources: Mapping[str, float] = field(default_factory=dict)  # that its workers must have, such as GPU: 1


@dataclass(frozen=True)
class LiveOptions:
    """What is served to whom, and within which limits.

    Raises:
        InputError: a value is outside its range.
    """

    source: str = PHONE  # "phone": each page sends its own camera; else a source of arview.video.open_source
    camera: str | None = None  # camera of arview.camera.read.load_camera; None: guessed, and the page says so
    photo_camera: str | None = None  # of the full-size photos of phones, whose view differs from that of their video
    profile: str | None = None  # name of the profile in which an estimated camera is kept; None: it is not kept
    devices: Path | None = None  # file of the paired devices; None: they are forgotten at the end of the run
    inspections: tuple[Path, ...] = ()  # inspection.json of the parts, in their order, read again when they change
    serial: str | None = None  # serial number of the part at the station; None: that of the part file, if any
    max_age_s: float | None = 86400.0  # age above which the page calls an inspection old; None: never
    guide: str | None = None  # name of a guide view to align with; None: the part is searched for
    record: Path | None = None  # video recorded from the start; None: only when the page asks for one
    record_folder: Path = Path()  # folder of the recordings that pages ask for
    width: int = 1280  # size of the phone's pictures in landscape, px; phones and tracker manage it at 30 fps
    height: int = 720
    fps: float = 30.0
    clients: int | None = None  # pages at once; None: 2 phones (one tracker each), or 8 that watch a station
    recording: RecordingOptions = field(default_factory=RecordingOptions)
    jobs: JobOptions = field(default_factory=JobOptions)
    requests: RequestLimits = field(default_factory=RequestLimits)

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            value = getattr(self, name)
            if not MIN_SIDE_PX <= value <= MAX_SIDE_PX or value % 2:
                raise InputError(
                    f"live: {name} is {value} px, expected an even number from {MIN_SIDE_PX} to {MAX_SIDE_PX}"
                )
        if not 1.0 <= self.fps <= 120.0:
            raise InputError(f"live: {self.fps:g} frames per second, expected 1 to 120")
        if self.clients is not None and not 1 <= self.clients <= 64:
            raise InputError(f"live: {self.clients} clients, expected 1 to 64")
        if self.max_age_s is not None and not self.max_age_s > 0:
            raise InputError(f"live: a maximum age of {self.max_age_s:g} s, expected a positive number")

    @property
    def is_phone(self) -> bool:
        """Whether each page sends its own camera."""
        return self.source == PHONE

    @property
    def job_camera(self) -> str | None:
        """Camera of the photos of inspections that pages start; None: estimated from them.

        A station's photos are its frames. Full-size photos of phones show all of the sensor, 4:3, so a camera of their
        video is theirs only if it has that shape.
        """
        if not self.is_phone:
            return self.camera
        is_whole = abs(self.width * 3 - self.height * 4) <= 0.02 * self.width
        return self.photo_camera or (self.camera if is_whole else None)

    @property
    def max_clients(self) -> int:
        """Number of pages that may take part at once."""
        return self.clients if self.clients is not None else 2 if self.is_phone else 8
