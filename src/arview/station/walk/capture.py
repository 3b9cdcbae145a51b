"""Guided capture on a film or a camera of the station: the frames worth measuring become the photos of a job."""

from __future__ import annotations

import hashlib
import io
import json
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from PIL import Image

from arview import reconstruction
from arview.cad import Part
from arview.camera import PHOTO_SUFFIXES, Camera
from arview.core.atomic import write_file
from arview.errors import OutputError
from arview.pose import Pose
from arview.station import capture
from arview.station.walk.job import FORMAT, VERSION, JobFolder
from arview.version import __version__
from arview.video import Frame, FrameSource, PictureSource

FRAME_TRIGGER = capture.TriggerOptions(motion_per_s=(0.4, 0.6), still_s=0.0, min_focus=0.85, min_interval_s=0.2)
"""Trigger where the frame is the photo: there is no delay between the two, and blur is seen in the photo itself."""
JPEG_QUALITY = 97
_MAKE, _MODEL, _SOFTWARE, _EXIF_IFD = 0x010F, 0x0110, 0x0131, 0x8769
_TAKEN, _FOCAL_LENGTH_35MM = 0x9003, 0xA405


class Tracks(Protocol):
    """What tracks one part: `arview.tracking.TrackingSession`."""

    def process(self, image: Any, index: int, time_s: float) -> tuple[Pose, ...]:
        """The pose in a frame."""
        ...


@dataclass(frozen=True)
class CaptureSummary:
    """What a guided capture found.

    Attributes:
        photos: names of the photos.
        frames: examined.
        advice: at the last frame; None without any.
        reasons: why no photo was taken, and at how many frames.
        is_interrupted: it was ended by Ctrl-C.
        ended_reason: why the source ended early, or empty.
    """

    photos: tuple[str, ...] = ()
    frames: int = 0
    advice: capture.CaptureAdvice | None = None
    reasons: Mapping[str, int] = field(default_factory=dict)
    is_interrupted: bool = False
    ended_reason: str = ""


def open_folder(folder: Path, part: Part, serial: str | None, camera: str | None) -> JobFolder:
    """The folder for the photos of a guided capture, made like that of a job.

    Args:
        folder: new, or an empty one.
        part: the part.
        serial: of the specimen; with it the folder is a job that can be measured as one.
        camera: calibrated camera of the frames as the user gave it, or None.

    Raises:
        OutputError: the folder holds something, or cannot be made.
    """
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise OutputError(f"{folder}: is there already and not empty; give a new folder")
        (folder / "photos").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made ({error.strerror or error})") from error
    document = {
        "format": FORMAT,
        "version": VERSION,
        "id": folder.resolve().name,
        "part": str(part.path.resolve()),
        "part_name": part.name,
        "model_hash": part.model.source_hash,
        "serial": serial or "",
        "created": datetime.now(UTC).isoformat(),
        "camera": camera,
        "parent": None,
        "components": None,
    }
    if serial:
        write_file(folder / "job.json", (json.dumps(document, ensure_ascii=False, indent=1) + "\n").encode())
    return JobFolder(folder, document)


def capture_photos(
    source: FrameSource,
    session: Tracks,
    part: Part,
    camera_of: Callable[[int], Camera],
    job: JobFolder,
    options: capture.CaptureOptions | None = None,
    progress: Callable[[int, capture.CaptureAdvice], None] | None = None,
) -> CaptureSummary:
    """Track a part through a source and keep the frames that guided capture asks for, until they suffice.

    Each photo is on the disk with its hash and its pose before the next frame is examined. Ctrl-C ends the run in good
    order.

    Args:
        source: of the frames.
        session: tracks the part.
        part: CAD, tolerances, range of views.
        camera_of: camera of the frame of an index.
        job: folder of the photos.
        options: see `CaptureOptions`; by default with `FRAME_TRIGGER`.
        progress: called after each frame with the number of frames and the advice.

    Raises:
        OutputError: a photo cannot be written; those before it are kept.
    """
    options = options or capture.CaptureOptions(trigger=FRAME_TRIGGER)
    guide = _FollowingGuide(part, options)
    began = datetime.now(UTC)
    photos: list[str] = []
    reasons: Counter[str] = Counter()
    advice: capture.CaptureAdvice | None = None
    frames, is_interrupted = 0, False
    try:
        for frame in source:
            frames += 1
            (pose,) = session.process(frame.image, frame.index, frame.time_s)
            camera = camera_of(frame.index)
            advice = guide.of(camera).update(pose, frame.image, frame.time_s)
            if advice.takes and pose.cam_from_model is not None:
                taken = began + timedelta(seconds=frame.time_s)
                content = _content(frame, source, camera, taken)
                hint = {
                    "cam_from_model": pose.cam_from_model.ravel().tolist(),
                    "camera": reconstruction.camera_summary(camera),
                    "quality": pose.quality,
                }
                photos.append(job.add_photo(content, hashlib.sha256(content).hexdigest(), "station", hint, taken))
                guide.taken(pose)
                advice = guide.of(camera).update(pose, None, frame.time_s)
            elif advice.reason:
                reasons[advice.reason] += 1
            if progress is not None:
                progress(frames, advice)
            if advice.is_enough:
                break
    except KeyboardInterrupt:
        is_interrupted = True
    if photos:
        job.end()
    return CaptureSummary(tuple(photos), frames, advice, dict(reasons), is_interrupted, source.ended_reason)


class _FollowingGuide:
    """The guide for a camera that may be replaced while it is estimated; the photos taken are kept."""

    def __init__(self, part: Part, options: capture.CaptureOptions) -> None:
        self._part, self._options = part, options
        self._camera: Camera | None = None
        self._guide: capture.CaptureGuide | None = None
        self._poses: list[Any] = []

    def of(self, camera: Camera) -> capture.CaptureGuide:
        """The guide for a camera."""
        if self._guide is None or camera is not self._camera:
            self._camera = camera
            self._guide = capture.CaptureGuide(self._part, camera, self._options, self._poses)
        return self._guide

    def taken(self, pose: Pose) -> None:
        """Count a photo that was taken at the pose of its frame."""
        if self._guide is not None and pose.cam_from_model is not None:
            self._poses.append(pose.cam_from_model)
            self._guide.photo_taken(pose.cam_from_model)


def _content(frame: Frame, source: FrameSource, camera: Camera, taken: datetime) -> bytes:
    """Content of the file of a photo: the picture file itself where the source is of those, else a JPEG."""
    path = _picture(frame, source)
    if path is not None:
        try:
            return path.read_bytes()
        except OSError:
            pass  # it was read a moment ago: the frame is still there
    exif = Image.Exif()
    exif[_MAKE], exif[_MODEL], exif[_SOFTWARE] = "arview", "capture", f"arview {__version__}"
    longer, diagonal = max(camera.width, camera.height), float(np.hypot(camera.width, camera.height))
    equivalent_mm = round(capture.focal_px(camera) * float(np.hypot(36.0, 24.0)) / diagonal)
    details: dict[int, Any] = {_TAKEN: f"{taken:%Y:%m:%d %H:%M:%S}"}
    if 1 <= equivalent_mm <= 1000 and longer > 0:
        details[_FOCAL_LENGTH_35MM] = equivalent_mm
    exif.get_ifd(_EXIF_IFD).update(details)
    buffer = io.BytesIO()
    Image.fromarray(frame.image).save(buffer, "JPEG", quality=JPEG_QUALITY, subsampling=0, exif=exif)
    return buffer.getvalue()


def _picture(frame: Frame, source: FrameSource) -> Path | None:
    """File of a frame whose EXIF data are worth keeping, or None for frames of films and cameras."""
    if not isinstance(source, PictureSource) or not frame.file or source.unsquared_size is not None:
        return None
    path = source.first_path.parent / frame.file
    return path if path.is_file() and path.suffix.lower() in PHOTO_SUFFIXES else None


def summary_lines(summary: CaptureSummary, part: Part) -> list[str]:
    """A capture in words: what each component was seen from, and what is lacking."""
    if summary.advice is None:
        return ["no frame was examined"]
    advice = summary.advice
    filled = sum(cell.is_filled for cell in advice.cells)
    lines = [
        f"{len(summary.photos)} photos of {summary.frames} frames, from {filled} of {len(advice.cells)} directions",
        "",
        f"{'component':20} {'photos':>6} {'directions':>10} {'expected U':>11}  lacking",
    ]
    for need in advice.components:
        tolerance = part.component_settings(need.name).position_tolerance_mm
        expected = "–" if need.predicted_u_mm is None else f"{need.predicted_u_mm:.3f} mm"
        is_wide = tolerance is not None and need.predicted_u_mm is not None and need.predicted_u_mm > 0.25 * tolerance
        note = need.text or (f"U is more than a quarter of ±{tolerance:g} mm" if is_wide else "")
        lines.append(f"{need.name:20} {need.photos:>6} {need.directions:>10} {expected:>11}  {note}".rstrip())
    if not advice.is_enough:
        lines += ["", f"still wanted: {advice.text}"]
        if summary.reasons:
            common = sorted(summary.reasons.items(), key=lambda item: -item[1])[:4]
            lines.append("no photo was taken because: " + ", ".join(f"{name} ({count})" for name, count in common))
    return lines


def capture_options(count: int | None) -> capture.CaptureOptions:
    """Options for a film or a station camera; ``count``: photos wanted, None for the usual number."""
    options = capture.CaptureOptions(trigger=FRAME_TRIGGER)
    if count is None:
        return options
    return replace(options, wanted_photos=count, max_photos=max(count, options.max_photos))
