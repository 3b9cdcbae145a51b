"""Cameras: the pinhole model with distortion, calibration files, profiles, and EXIF data of photos."""

from arview.camera.model import Camera
from arview.camera.read import guess_camera, load_camera, save_camera
from arview.camera.write import write_camera

__all__ = ["Camera", "guess_camera", "load_camera", "save_camera", "write_camera"]
