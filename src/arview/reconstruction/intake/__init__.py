"""Intake: photos or a video become upright photos, each with a first camera, and with messages about what is wrong."""

from arview.reconstruction.intake.checks import PhotoCheck
from arview.reconstruction.intake.lenses import Lens
from arview.reconstruction.intake.photos import Intake, intake_photos
from arview.reconstruction.intake.reading import read_photo
from arview.reconstruction.intake.undistorted import undistort_photos
from arview.reconstruction.intake.video import VideoIntakeOptions, intake_frames, intake_video

__all__ = [
    "Intake",
    "Lens",
    "PhotoCheck",
    "VideoIntakeOptions",
    "intake_frames",
    "intake_photos",
    "intake_video",
    "read_photo",
    "undistort_photos",
]
