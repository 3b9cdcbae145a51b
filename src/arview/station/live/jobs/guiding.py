"""Guided capture of a client: its frames go through a `CaptureGuide`, whose newest advice goes out with the poses."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from arview.camera import Camera
from arview.errors import ArviewError
from arview.geometry import Array
from arview.station import capture, walk
from arview.station.live.jobs.board import JobBoard
from arview.station.live.jobs.subject import JobSubject
from arview.station.live.stream.documents import Document
from arview.station.live.stream.feed import TrackedFrame

logger = logging.getLogger("arview.station.live")

REPEAT_S = 1.0
"""Time after which the rows of the components are sent again, though nothing has changed."""
RECHECK_PHOTOS = 5
"""Photos that are wanted of a re-check."""
CAMERA_CHANGE = 0.02
"""Change of the focal length, as a share, from which on the guide is made anew."""


class Guiding:
    """Guided capture for one client; safe to use from several threads.

    The guide is made in a thread of its own, because it draws the part from all directions; until then there is no
    advice.

    Args:
        subject: the part with its job.
        number: of the part among those of the stream.
        board: knows the photos and uploads of the job.

    Attributes:
        gyro_rad_s: rate of turn that the page has told last; None without a gyroscope.
    """

    def __init__(self, subject: JobSubject, number: int, board: JobBoard) -> None:
        self.gyro_rad_s: float | None = None
        self._subject, self._number, self._board = subject, number, board
        self._lock = threading.Lock()
        self._guide: capture.CaptureGuide | None = None
        self._camera: Camera | None = None
        self._is_making = False
        self._advice: capture.CaptureAdvice | None = None
        self._sent: tuple[int, tuple[str, ...]] | None = None
        self._sent_s = 0.0

    def listen(self, tracked: TrackedFrame) -> None:
        """Take a tracked frame, in the thread of the tracker; it takes some milliseconds."""
        if self._camera is None or _differs(self._camera, tracked.camera):
            self._make(tracked.camera)
        with self._lock:
            if self._guide is not None:
                pose = tracked.poses[self._number]
                self._advice = self._guide.update(pose, tracked.frame.image, tracked.arrived_s, self.gyro_rad_s)

    def document(self) -> Document | None:
        """The newest advice for the page; the rows of the components are in it when they have changed."""
        advice = self._advice
        if advice is None:
            return None
        news = advice.revision, tuple(one.text for one in advice.components)
        has_components = news != self._sent or time.monotonic() - self._sent_s > REPEAT_S
        if has_components:
            self._sent, self._sent_s = news, time.monotonic()
        return capture.capture_document(advice, self._subject.job.id, has_components)

    def photo_taken(self, cam_from_model: Array) -> None:
        """A photo of the job was taken."""
        with self._lock:
            if self._guide is not None:
                try:
                    self._guide.photo_taken(cam_from_model)
                except ArviewError as error:
                    logger.warning("%s", error)

    def start_again(self) -> None:
        """Count the photos anew: one of them did not arrive."""
        if (camera := self._camera) is not None:
            self._make(camera)

    def layout(self) -> Document | None:
        """Cells and distances; None while the guide is being made."""
        with self._lock:
            return None if self._guide is None else self._guide.layout()

    def _make(self, camera: Camera) -> None:
        with self._lock:
            if self._is_making:
                return
            self._is_making, self._camera = True, camera
            dome = None
            if self._guide is not None and self._is_same_camera(camera):
                dome = self._guide.dome

        def run() -> None:
            try:
                poses = known_poses(self._board, self._subject)
                options = guide_options(self._subject, self._board, camera)
                guide = capture.CaptureGuide(self._subject.part, camera, options, poses, dome)
                with self._lock:
                    self._guide, self._made_for = guide, camera
            except ArviewError as error:
                logger.warning("no guided capture: %s", error)
            finally:
                self._is_making = False

        threading.Thread(target=run, name="arview-guide", daemon=True).start()

    _made_for: Camera | None = None

    def _is_same_camera(self, camera: Camera) -> bool:
        return self._made_for is not None and not _differs(self._made_for, camera)


def guide_options(subject: JobSubject, board: JobBoard, camera: Camera) -> capture.CaptureOptions:
    """Options of the guide of a job: a re-check wants few photos, of its components; stills have more pixels."""
    options = capture.CaptureOptions()
    if (components := subject.job.components) is not None:
        options = replace(options, wanted_photos=RECHECK_PHOTOS, components=components)
    ratio = _still_ratio(subject.job.photos(), subject, camera)
    return options if ratio is None else replace(options, photo_px_per_px=ratio)


def known_poses(board: JobBoard, subject: JobSubject) -> list[Array]:
    """Poses of the photos of a job, and of those that are still being uploaded."""
    poses = [photo.cam_from_model for photo in subject.job.photos()]
    for upload in board.uploads(subject.job).listed():
        given = None if upload.hint is None else upload.hint.get("cam_from_model")
        poses.append(None if given is None else np.array(given, dtype=np.float64).reshape(4, 4))
    return [pose for pose in poses if pose is not None]


def _still_ratio(photos: Sequence[walk.StoredPhoto], subject: JobSubject, camera: Camera) -> float | None:
    """Width of the last full-size photo over that of the stream; None without one."""
    from PIL import Image as Pillow

    for photo in reversed(photos):
        if photo.source == "still":
            try:
                with Pillow.open(subject.job.path / "photos" / photo.name) as header:
                    return max(1.0, max(header.size) / max(camera.width, camera.height))
            except (OSError, ValueError, Pillow.DecompressionBombError):
                return None
    return None


def _differs(one: Camera, other: Camera) -> bool:
    """Whether two cameras differ so much that directions and distances are others."""
    if one is other:
        return False
    is_other_size = (one.width, one.height) != (other.width, other.height)
    return is_other_size or abs(one.fx - other.fx) > CAMERA_CHANGE * one.fx
