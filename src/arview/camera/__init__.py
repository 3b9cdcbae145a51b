"""Cameras: the pinhole model with distortion, calibration files, profiles, and EXIF data of photos."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.camera.exif import PHOTO_SUFFIXES as PHOTO_SUFFIXES
    from arview.camera.exif import PhotoExif as PhotoExif
    from arview.camera.exif import check_jpeg_scans as check_jpeg_scans
    from arview.camera.exif import exif_of as exif_of
    from arview.camera.exif import focal_length_px as focal_length_px
    from arview.camera.exif import open_picture as open_picture
    from arview.camera.exif import read_exif as read_exif
    from arview.camera.lens import LensDistortion as LensDistortion
    from arview.camera.lens import LensModel as LensModel
    from arview.camera.model import Camera as Camera
    from arview.camera.profiles import exif_of_video as exif_of_video
    from arview.camera.profiles import lens_record as lens_record
    from arview.camera.profiles import list_profiles as list_profiles
    from arview.camera.profiles import profile_folder as profile_folder
    from arview.camera.profiles import profile_name as profile_name
    from arview.camera.profiles import profile_of_photo as profile_of_photo
    from arview.camera.profiles import profile_path as profile_path
    from arview.camera.read import guess_camera as guess_camera
    from arview.camera.read import load_camera as load_camera
    from arview.camera.read import load_cameras as load_cameras
    from arview.camera.read import save_camera as save_camera
    from arview.camera.read import split_spec as split_spec
    from arview.camera.undistort import MAX_HALF_ANGLE_DEG as MAX_HALF_ANGLE_DEG
    from arview.camera.undistort import FrameView as FrameView
    from arview.camera.undistort import UndistortOptions as UndistortOptions
    from arview.camera.undistort import brown_camera as brown_camera
    from arview.camera.undistort import require_brown as require_brown
    from arview.camera.write import format_and_path as format_and_path
    from arview.camera.write import holds_distortion as holds_distortion
    from arview.camera.write import write_camera as write_camera

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "exif": (
            "PHOTO_SUFFIXES",
            "PhotoExif",
            "check_jpeg_scans",
            "exif_of",
            "focal_length_px",
            "open_picture",
            "read_exif",
        ),
        "lens": (
            "LensDistortion",
            "LensModel",
        ),
        "model": ("Camera",),
        "profiles": (
            "exif_of_video",
            "lens_record",
            "list_profiles",
            "profile_folder",
            "profile_name",
            "profile_of_photo",
            "profile_path",
        ),
        "read": (
            "guess_camera",
            "load_camera",
            "load_cameras",
            "save_camera",
            "split_spec",
        ),
        "undistort": (
            "FrameView",
            "MAX_HALF_ANGLE_DEG",
            "UndistortOptions",
            "brown_camera",
            "require_brown",
        ),
        "write": (
            "format_and_path",
            "holds_distortion",
            "write_camera",
        ),
    },
)
