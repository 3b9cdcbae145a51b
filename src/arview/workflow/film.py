"""The film: the video with the overlay of the model and the measured deviations of each component."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from arview import annotation, guideviews, overlay, tracking
from arview.cad import Part
from arview.camera import Camera, guess_camera
from arview.core.progress import StepProgress
from arview.inspection import Inspection
from arview.video import VideoSink, load_camera_of, open_source


def camera_of_video(video: str, spec: str | None, of_photos: Camera | None, is_from_video: bool) -> tuple[Camera, str]:
    """Intrinsics of the frames of a video, and a warning or an empty text.

    Args:
        video: the video.
        spec: camera file, ``fov:DEG`` or None.
        of_photos: intrinsics of the photos, or None.
        is_from_video: whether the photos are frames of this video.

    Raises:
        InputError, MismatchError: the camera file cannot be used for this video.
    """
    with open_source(video) as frames:
        width, height = frames.width, frames.height
        if spec is not None:
            return load_camera_of(frames, spec, video), ""
    if of_photos is not None and abs(of_photos.width * height - of_photos.height * width) <= max(width, height):
        warning = "the video is assumed to have the camera of the photos; if it does not, give --video-camera"
        return of_photos.scaled(width, height), "" if is_from_video else warning
    guessed = guess_camera(width, height)
    return guessed, (
        f"the video's camera is guessed, focal length {guessed.fx:.0f} px: the overlay may be off; give --video-camera"
    )


def make_film(
    video: str,
    part: Part,
    camera: Camera,
    inspection: Inspection,
    film: Path,
    poses: Path,
    progress: StepProgress,
) -> str:
    """Track the part through a video and draw the inspection; returns in how many frames the part was tracked.

    Both files are written atomically, also when Ctrl-C interrupts.

    Args:
        video: the video.
        part: the part that it shows.
        camera: intrinsics of its frames.
        inspection: measured deviations to draw.
        film: video file to write, .mp4.
        poses: file to write with a line of JSON for each frame.
        progress: called with (frames done, total number of frames).

    Raises:
        InputError: the video cannot be read.
        OutputError: a file cannot be written.
    """
    unfinished = film.with_name(f".unfinished.{film.name}"), poses.with_name(f".unfinished.{poses.name}")
    views = guideviews.cached_guide_views(part.model, part.effective_view_range)
    try:
        with open_source(video) as frames:
            total = frames.frame_count or 0
            summary = annotation.annotate(
                frames,
                tracking.TrackingSession.of(views, camera, part.model),
                overlay.OverlayRenderer(part.model, camera, inspection),
                VideoSink(unfinished[0], frames.width, frames.height, frames.fps, frames),
                unfinished[1],
                progress=lambda done, pose: progress(done, total),
            )
        if summary.is_interrupted:
            raise KeyboardInterrupt
        for made, path in zip(unfinished, (film, poses), strict=True):
            made.replace(path)
    finally:
        for made in unfinished:
            with suppress(OSError):
                made.unlink(missing_ok=True)
    tracked = sum(summary.states.get(state, 0) for state in ("tracked", "critical"))
    notes = [f"the part was tracked in {tracked} of {summary.frames} frames"]
    notes += [*frames.notes, summary.ended_reason]
    if tracked == 0:
        notes.append(annotation.reasons_text(next(iter(summary.reasons.values()), {})))
    return "; ".join(note for note in notes if note)
