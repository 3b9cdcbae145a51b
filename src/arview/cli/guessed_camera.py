"""A guessed camera: what is said of its estimated focal length, and how it is kept as a profile."""

from __future__ import annotations

from typing import TYPE_CHECKING

from arview.cli.common import say
from arview.errors import InputError

if TYPE_CHECKING:
    from arview.camera import Camera
    from arview.tracking.self_calibration.estimator import FocalEstimate


def check_profile(name: str | None, camera_spec: str | None) -> None:
    """Check that an estimated camera can be kept under a name.

    Raises:
        InputError: a camera was given, so that nothing is estimated, or the name is no name of a profile.
    """
    from arview.camera.profiles import profile_path

    if name is None:
        return
    if camera_spec is not None:
        raise InputError("--save-profile keeps a camera that was estimated; leave out --camera to have it estimated")
    profile_path(name)


def report_estimate(estimate: FocalEstimate, profile: str | None, source: str, turns: int) -> None:
    """Say what was estimated, and keep it as a profile if one was asked for.

    Args:
        estimate: the result.
        profile: name of the profile; None: none was asked for.
        source: video that it was estimated from.
        turns: quarter turns clockwise applied to its frames.
    """
    from arview.tracking.self_calibration.profile import keep_profile

    can_be_kept = estimate.is_determined and profile is None
    say(estimate.text + ("; keep it with --save-profile NAME" if can_be_kept else ""))
    if profile is None:
        return
    if not estimate.is_determined:
        say(f"profile {profile} was not written")
        return
    path = keep_profile(estimate, profile, source, turns)
    say(f"wrote {path}; use it with --camera profile:{profile}")


def likely_cause(camera: Camera) -> str:
    """What to try when a part was not found with a guessed camera."""
    return (
        f"a likely cause: the camera was guessed, with a focal length of {camera.fx:.0f} px and no distortion; "
        "give --camera with a file, fov:DEG or exif"
    )
