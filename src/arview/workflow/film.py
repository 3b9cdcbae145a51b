"""The film: a video with the ghost and the measured errors of each component."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from arview import annotation
from arview.cad import Part
from arview.camera import Camera
from arview.camera.read import guess_camera, load_camera
from arview.core.progress import StepProgress
from arview.guideviews.cache import cached_guide_views
from arview.inspection import Inspection
from arview.overlay import OverlayRenderer
from arview.tracking import TrackingSession
from arview.video import VideoSink, open_source


def camera_of_video(video: str, spec: str | None, of_photos: Camera | None, is_from_video: bool) -> tuple[Camera, str]:
    """Camera of a video's frames, and a warning or nothing.

    Args:
        video: its file.
        spec: camera file, ``fov:DEG`` or None.
        of_photos: that of the photos, or None.
        is_from_video: the photos are frames of this video.

    Raises:
        InputError, MismatchError: the camera file cannot be used for this video.
    """
    with open_source(video) as frames:
        width, height = frames.width, frames.height
        if spec is not None:
            return load_camera(spec, width, height, video, frames.quarter_turns_clockwise), ""
    if of_photos is not None and abs(of_photos.width * height - of_photos.height * width) <= max(width, height):
        warning = "the video's camera is taken to be that of the photos; if it is not, give --video-camera"
        return of_photos.scaled(width, height), "" if is_from_video else warning
    guessed = guess_camera(width, height)
    return guessed, (
        f"the video's camera is guessed, focal length {guessed.fx:.0f} px: ghosts may be off; give --video-camera"
    )


def make_film(
    video: str, part: Part, camera: Camera, inspection: Inspection, film: Path, poses: Path,
    progress: StepProgress,
) -> str:  # fmt: skip
    """Follow the part through a video, draw what was measured, and say in how many frames it was followed.

    Both files appear complete or not at all, on Ctrl-C too.

    Args:
        video: file.
        part: what is in it.
        camera: of its frames.
        inspection: what is drawn.
        film: file to write, .mp4.
        poses: file to write, a JSON line a frame.
        progress: called with (frames done, frames in all).

    Raises:
        InputError: the video cannot be read.
        OutputError: a file cannot be written.
    """
    unfinished = film.with_name(f".unfinished.{film.name}"), poses.with_name(f".unfinished.{poses.name}")
    views = cached_guide_views(part.model, part.effective_view_range)
    try:
        with open_source(video) as frames:
            total = frames.frame_count or 0
            summary = annotation.annotate(
                frames,
                TrackingSession(views, camera, part.model),
                OverlayRenderer(part.model, camera, inspection),
                VideoSink(unfinished[0], frames.width, frames.height, frames.fps, frames),
                unfinished[1],
                lambda done, pose: progress(done, total),
            )
        if summary.is_interrupted:
            raise KeyboardInterrupt
        for made, path in zip(unfinished, (film, poses), strict=True):
            made.replace(path)
    finally:
        for made in unfinished:
            with suppress(OSError):
                made.unlink(missing_ok=True)
    seen = sum(summary.states.get(state, 0) for state in ("tracked", "critical"))
    notes = [f"the part followed in {seen} of {summary.frames} frames"]
    if summary.ended_reason:
        notes.append(summary.ended_reason)
    if seen == 0:
        notes.append(annotation.reasons_text(next(iter(summary.reasons.values()), {})))
    return "; ".join(note for note in notes if note)
