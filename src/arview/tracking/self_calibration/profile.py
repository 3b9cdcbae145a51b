"""An estimated camera as a profile, which later commands take as their camera."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from arview.camera import PhotoExif, exif_of_video, lens_record, profile_path, write_camera
from arview.errors import OutputError
from arview.tracking.self_calibration.estimator import FocalEstimate
from arview.version import __version__


def keep_profile(estimate: FocalEstimate, name: str, source: str, quarter_turns_clockwise: int) -> Path:
    """Store an estimated camera as a profile; returns its file.

    Args:
        estimate: one that is determined.
        name: of the profile.
        source: video that it was estimated from; its metadata may name the camera.
        quarter_turns_clockwise: turns applied to its frames. The profile describes the picture of the sensor.

    Raises:
        InputError: not a name of a profile.
        OutputError: the file cannot be written.
    """
    path = profile_path(name)
    camera = estimate.camera.rotated(-quarter_turns_clockwise)
    video = Path(source)
    exif = exif_of_video(video, camera.width, camera.height) if video.is_file() else None
    lens = lens_record(exif or PhotoExif(camera.width, camera.height), camera.width, camera.height)
    extra: dict[str, Any] = {
        "calibration": {
            "tool": f"arview {__version__}",
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
            "method": "focal length estimated from the edges of a tracked part",
            "frames_used": estimate.frames,
            "uncertainty_k": 2,
            "uncertainty": {"fx": 2.0 * estimate.std_px, "fy": 2.0 * estimate.std_px},
            "focal_uncertainty": 2.0 * estimate.std_px / estimate.focal_px,
        },
        "lens": lens,
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{path.parent}: cannot be made ({error.strerror or error})") from error
    write_camera(camera, path, "arview", extra)
    return path
