"""Options of the live server."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from arview.camera.undistort import UndistortOptions
from arview.errors import InputError

PHONE = "phone"
MIN_SIDE_PX, MAX_SIDE_PX = 120, 1920
"""Range of the sides of the pictures that a phone is asked for."""


@dataclass(frozen=True)
class FeedOptions:
    """How the frames of one stream are tracked and drawn."""

    stuck_s: float = 90.0  # a frame that is tracked for longer is given up with its thread; compiling takes a minute
    max_lost: int = 4  # threads given up; then the stream ends, with a notice
    draw_timeout_s: float = 10.0  # a picture that is drawn for longer is given up, and others are drawn without it
    kept_frames: int = 12  # tracked frames kept for snapshots while the network is slow; 33 MB at 720p
    kept_styles: int = 6  # overlay styles that keep a renderer and their last picture: pages, recording and screens
    rate_window_s: float = 2.0  # window over which frame rates are counted
    silence_s: float = 1.5  # a feed without a frame for longer than this is waiting
    max_unreadable: int = 15  # consecutive frames without a readable stamp, half a second, that raise a notice
    min_scale: float = 0.95  # a frame received at less than this share of its size raises a notice
    # A wide lens: pictures are undistorted for the page, too, so they stay about as large as the frames.
    undistort: UndistortOptions = field(default_factory=lambda: UndistortOptions(max_growth=1.25, min_scale=0.3))


@dataclass(frozen=True)
class StationOptions:
    """How a station camera is opened, and opened again after it broke."""

    first_pause_s: float = 0.5  # pause before the first reconnection; it doubles with each further one
    max_pause_s: float = 8.0
    open_timeout_s: float = 10.0
    read_timeout_s: float = 3.0
    stuck_s: float = 30.0  # a reader that neither delivers nor fails for so long is given up with its thread
    max_lost: int = 8  # readers given up; then the camera counts as broken
    frozen_s: float = 2.0  # pictures that stay equal, pixel for pixel, for so long: sensors have noise
    sample_step_px: int = 7  # distance of the pixels that are compared


@dataclass(frozen=True)
class RecordingOptions:
    """When a recording ends by itself."""

    quota_bytes: int = 20_000_000_000  # size of all recordings in the folder, those of earlier runs included
    min_free_bytes: int = 500_000_000  # free disk space that is left to other programs
    low_bytes: int = 2_000_000_000  # free disk space or rest of the quota below which the page warns
    stop_timeout_s: float = 60.0  # time for the encoder to finish a file that a page stops
    max_duration_s: float = 3600.0
    check_interval_s: float = 5.0  # time between two checks of the free disk space


@dataclass(frozen=True)
class RequestLimits:
    """Bounds on the requests of a client."""

    jpeg_bytes: int = 4_000_000  # size of an uploaded frame
    offer_bytes: int = 64_000  # size of a join request with its WebRTC offer
    control_bytes: int = 4_000
    body_timeout_s: float = 10.0  # time in which a body must arrive
    per_s: float = 80.0  # requests of one address; a page that sends JPEGs needs about 35
    burst: float = 240.0
    strangers_per_s: float = 20.0  # requests of one address without the token
    strangers_burst: float = 60.0
    joins_per_s: float = 1.0  # of one address; each join costs a tracker and a handshake
    joins_burst: float = 12.0
    images_per_s: float = 2.0  # of one page; drawing and packing a PNG takes 50 ms of a core
    images_burst: float = 6.0


@dataclass(frozen=True)
class ConnectionLimits:
    """Bounds on the connections of the server."""

    handshake_timeout_s: float = 5.0  # time for the TLS handshake
    closing_timeout_s: float = 2.0  # time for the other end to answer the end of a TLS connection
    headers_timeout_s: float = 10.0  # time to send a whole request; later the connection is closed (Slowloris)
    write_timeout_s: float = 20.0  # a client that accepts no data for so long is disconnected
    keep_alive_s: int = 20  # time between two requests of a connection
    max_header_bytes: int = 16_384
    strangers_of_address: int = 64  # connections of one address that have not shown the token; an idle one is 0.3 MB
    max_strangers: int = 256  # of all addresses
    max_guests: int = 256  # connections that have shown the token
    handshakes_per_s: float = 30.0  # new connections of one address: about a tenth of a core at most
    handshakes_burst: float = 300.0


@dataclass(frozen=True)
class WebrtcOptions:
    """Bounds and bitrates of the WebRTC connections."""

    offer_timeout_s: float = 10.0  # time to answer an offer
    connect_timeout_s: float = 20.0  # time from the offer to a connection
    max_candidates: int = 32  # ICE candidates in an offer
    max_buffered_bytes: int = 32_768  # messages waiting on the data channel, about fifteen; later ones are dropped


@dataclass(frozen=True)
class JobOptions:
    """Bounds on the inspections that pages start, and on what they upload."""

    folder: Path = Path("arview_jobs")  # made when the first inspection is started
    max_jobs: int = 5000  # of which the folder may hold so many
    max_photos: int = 400  # of one inspection
    max_open_uploads: int = 64  # begun and not complete, of one inspection
    photo_bytes: int = 60_000_000  # size of one photo
    photo_pixels: int = 120_000_000
    piece_bytes: int = 1 << 20  # body of one request of an upload
    piece_timeout_s: float = 60.0  # time in which it must arrive; a slow network is no reason to start again
    text_bytes: int = 16_000  # bodies of the other requests: hints, decisions
    quota_bytes: int = 200_000_000_000  # size of the folder
    min_free_bytes: int = 500_000_000  # free disk space that is left to results and other programs
    upload_days: float = 7.0  # an upload that is not continued for so long is dropped
    workers: int = 1  # measurements that run at once; each uses both of two cores
    worker_pauses_s: tuple[float, ...] = (2.0, 10.0, 60.0)  # before a measurement that broke is started again
    worker_stop_s: float = 2.5  # time for a measurement to end in good order
    patience_s: float = 30.0  # a measurement that only waits for photos makes room for others after so long
    idle_s: float = 900.0  # and ends after so long, until a photo comes
    recent_s: float = 86400.0  # a walk of an earlier run that was not ended is continued if it is younger


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
    watchers: int = 4  # screens that only watch, as motion JPEG
    watch_fps: float = 15.0  # frame rate of these: enough to watch, at half the encoding work
    watch_timeout_s: float = 10.0  # a screen that takes no picture for so long is disconnected
    watch_repeat_s: float = 2.0  # without a new picture the last one is sent again, to notice closed connections
    jpeg_silence_s: float = 15.0  # a page without WebRTC that sends no request for so long is removed
    tracking_timeout_s: float = 10.0  # time in which an uploaded frame must be tracked
    frame_wait_s: float = 5.0  # time that a request for a station's next frame waits
    tick_s: float = 0.25  # interval of the regular work: clients that are gone, changed inspections, status messages
    status_interval_s: float = 1.0  # a status is sent at least this often
    reload_interval_s: float = 1.0  # time between two checks of the inspection file
    renewal_interval_s: float = 12 * 3600.0  # time between two checks of the age of the certificate
    worker_timeout_s: float = 30.0  # a thread for drawing, JPEG or files that takes longer is given up and replaced
    closing_timeout_s: float = 1.2  # at the end, time for each of pages, camera and tracking to close
    workers: int = 16  # threads for drawing, JPEG and files; most of them wait for a renderer
    feed: FeedOptions = field(default_factory=FeedOptions)
    station: StationOptions = field(default_factory=StationOptions)
    recording: RecordingOptions = field(default_factory=RecordingOptions)
    jobs: JobOptions = field(default_factory=JobOptions)
    requests: RequestLimits = field(default_factory=RequestLimits)
    webrtc: WebrtcOptions = field(default_factory=WebrtcOptions)
    connections: ConnectionLimits = field(default_factory=ConnectionLimits)

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
