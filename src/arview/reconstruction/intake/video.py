"""Intake of a video: sharp, well-spread frames become photos."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import PhotoExif
from arview.core.atomic import write_file
from arview.core.progress import StepProgress
from arview.errors import InputError
from arview.reconstruction.intake.checks import check_photo, thumbnail
from arview.reconstruction.intake.photos import MIN_PHOTOS, Intake, ReadPhoto, assess, read_and_check
from arview.reconstruction.intake.reading import GLANCE_PX, Pixels
from arview.video import Frame, FrameSource, open_source

_QUANTUM = 0.01  # of the diagonal; smaller motions may be tremble of the hand, and are not added up
_MIN_TRACKED = 20  # tracked corners below which the track has broken
_MIN_TRACKED_SHARE = 0.3  # the same as a share of the corners found


MIN_STEP = 0.025
"""Motion between frames, as a share of the diagonal: about 6° around a part that fills a third of the picture."""
LOOKS_PER_S = 10.0
"""Frames examined per second; a hand-held camera hardly moves in a tenth of a second."""
TRACKED_PX = 480
"""Longest side of the pictures in which motion is tracked."""
MIDDLE = 0.7
"""Share of each step from which its frame is chosen, so that two frames are not adjacent."""


@dataclass(frozen=True)
class VideoIntakeOptions:
    """How frames are chosen. Raises InputError for values that choose none."""

    max_frames: int = 60  # number that sparse reconstruction places in about a minute

    def __post_init__(self) -> None:
        if self.max_frames < MIN_PHOTOS or not MIN_STEP > 0 or not LOOKS_PER_S > 0:
            raise InputError(
                f"max_frames {self.max_frames}, min_step {MIN_STEP}, looks_per_s {LOOKS_PER_S}: expected at "
                f"least {MIN_PHOTOS} frames and positive numbers"
            )


def intake_video(
    path: str | Path,
    folder: str | Path,
    options: VideoIntakeOptions | None = None,
    camera: str | Path | None = None,
    progress: StepProgress | None = None,
) -> Intake:
    """Choose frames of a video and write them into ``folder`` as ``frame_000123.png``, numbered as in the video.

    A first pass measures the motion of the picture (median motion of tracked corners) and the sharpness of each frame.
    The path of the motion is cut into equal steps, and the sharpest frame in the middle of each step is chosen.

    Args:
        path: video file, or folder or glob of its frames.
        folder: where the frames are written; created if missing. Each file appears complete or not at all.
        options: how frames are chosen.
        camera: camera file or ``fov:DEG``, as for `intake_photos`.
        progress: called with frames done and in all, over both passes; not if the number is unknown.

    Raises:
        InputError: the video cannot be read, the camera does not move, or there is no texture.
        MismatchError: the camera file does not fit the video.
        OutputError: the frames cannot be written.
    """
    options = options or VideoIntakeOptions()
    with open_source(path) as source:
        if source.is_live:
            raise InputError(f"{path}: is a live source; record a video first and give its file")
        stride = max(1, round((source.fps or 30.0) / LOOKS_PER_S))
    with open_source(path, stride=stride) as source:
        total = 2 * (source.frame_count or 0)
        indices, travel, sharpness = _measure_motion(source, progress, total)
        chosen = {indices[k] for k in choose_frames(travel, sharpness, options)}
        if len(chosen) < MIN_PHOTOS:
            raise InputError(
                f"{path}: the camera hardly moves (the picture shifts by {100 * travel[-1]:.1f} % of its diagonal in "
                "all); walk around the part while recording"
            )
        seen = []
        for done, frame in enumerate(source, 1):
            if frame.index in chosen:
                seen.append(_written(frame, Path(folder), source.quarter_turns_clockwise))
            if progress and total:
                progress(min(total // 2 + done, total), total)
            if len(seen) == len(chosen):
                break
        notes = tuple(note for note in (*source.notes, source.ended_reason) if note)
    intake = assess(str(path), seen, {}, camera)
    return replace(intake, warnings=(*intake.warnings, *notes))


def intake_frames(
    path: str | Path,
    folder: str | Path,
    options: VideoIntakeOptions | None = None,
    camera: str | Path | None = None,
    progress: StepProgress | None = None,
) -> Intake:
    """Intake of frames that `intake_video` wrote into ``folder`` before.

    The video is opened only for its orientation, which a calibrated camera needs. Raises as `intake_video` does.
    """
    options = options or VideoIntakeOptions()
    frames = sorted(Path(folder).glob("frame_*.png"))
    with open_source(path) as source:
        turns = source.quarter_turns_clockwise
    seen, rejected = [], {}
    for done, frame in enumerate(frames, 1):
        result = read_and_check(frame, frame.name)
        if isinstance(result, ReadPhoto):
            seen.append(replace(result, exif=replace(result.exif, quarter_turns_clockwise=turns)))
        else:
            rejected[frame.name] = result
        if progress:
            progress(done, len(frames))
    return assess(str(path), seen, rejected, camera)


def choose_frames(
    travel: NDArray[np.float64], sharpness: NDArray[np.float64], options: VideoIntakeOptions
) -> list[int]:
    """Indices of the sharpest frame in the middle of each of equal steps of ``travel`` (N,), which never decreases."""
    count = min(options.max_frames, int(travel[-1] / MIN_STEP) + 1)
    place = travel / max(travel[-1], 1e-12) * count
    step = np.minimum(place.astype(int), count - 1)
    in_middle = np.abs(place - step - 0.5) <= 0.5 * MIDDLE
    chosen = []
    for k in range(count):
        candidates = np.flatnonzero((step == k) & in_middle)
        if len(candidates) == 0:
            candidates = np.flatnonzero(step == k)
        if len(candidates):
            chosen.append(int(candidates[np.argmax(sharpness[candidates])]))
    return chosen


def _measure_motion(
    source: FrameSource, progress: StepProgress | None, total: int
) -> tuple[list[int], NDArray[np.float64], NDArray[np.float64]]:
    """Index of each frame, accumulated motion of the picture (diagonals, non-decreasing), and its sharpness."""
    indices: list[int] = []
    travel: list[float] = []
    sharpness: list[float] = []
    motion = _Motion()
    for done, frame in enumerate(source, 1):
        gray = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
        travel.append(motion.add(_shrunk(gray, TRACKED_PX)))
        # Neighbouring frames show the same, so the contrast of fine detail is a measure of sharpness.
        sharpness.append(float(cv2.Laplacian(_shrunk(gray, 2 * TRACKED_PX), cv2.CV_32F).var()))
        indices.append(frame.index)
        if progress and total:
            progress(min(done, total // 2), total)
    if not indices:
        raise InputError(f"{source.name}: no frame could be read; record or copy the video again")
    return indices, np.maximum.accumulate(np.array(travel)), np.array(sharpness)


class _Motion:
    """Accumulates the picture's motion: corners are tracked from a reference that is renewed after each real move."""

    def __init__(self) -> None:
        self._lost_step = MIN_STEP  # added when the track breaks, because the view has changed
        self._travelled = 0.0
        self._previous: Pixels | None = None
        self._reference: NDArray[np.float32] | None = None  # (N,1,2) px, in the reference picture
        self._now: NDArray[np.float32] | None = None  # the same corners in the previous picture
        self._found = 0

    def add(self, gray: Pixels) -> float:
        """Accumulated motion up to this picture, in diagonals."""
        previous, self._previous = self._previous, gray
        if previous is None or self._now is None or self._reference is None:
            self._restart(gray)
            return self._travelled
        now, forward, _ = cv2.calcOpticalFlowPyrLK(previous, gray, self._now, None)
        back, backward, _ = cv2.calcOpticalFlowPyrLK(gray, previous, now, None)
        good = (forward.ravel() > 0) & (backward.ravel() > 0) & (np.abs(back - self._now).max(axis=(1, 2)) < 1.0)
        self._now, self._reference = now[good], self._reference[good]
        if good.sum() < max(_MIN_TRACKED, _MIN_TRACKED_SHARE * self._found):
            self._travelled += self._lost_step
            self._restart(gray)
            return self._travelled
        moved_px = float(np.median(np.linalg.norm(self._now - self._reference, axis=2)))
        moved = moved_px / float(np.hypot(*gray.shape))
        if moved >= _QUANTUM:
            self._travelled += moved
            self._restart(gray)
            return self._travelled
        return self._travelled + moved

    def _restart(self, gray: Pixels) -> None:
        corners = cv2.goodFeaturesToTrack(gray, 300, 0.01, 8)
        enough = corners is not None and len(corners) >= _MIN_TRACKED
        self._reference = self._now = corners if enough else None
        self._found = len(corners) if enough else 0


def _shrunk(gray: Pixels, max_side_px: int) -> Pixels:
    """The picture reduced to a longest side."""
    scale = max_side_px / max(gray.shape)
    if scale >= 1:
        return gray
    size = round(gray.shape[1] * scale), round(gray.shape[0] * scale)
    return np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA))


def _written(frame: Frame, folder: Path, turns: int) -> ReadPhoto:
    """Write the frame as PNG and check it."""
    name = f"frame_{frame.index:06d}.png"
    bgr = cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR)
    _, png = cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    write_file(folder / name, png.tobytes(), makes_folder=True)
    gray = _shrunk(cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY), GLANCE_PX)
    height, width = frame.image.shape[:2]
    exif = PhotoExif(width, height, quarter_turns_clockwise=turns)
    return ReadPhoto(name, folder / name, exif, check_photo(name, gray), thumbnail(gray))
