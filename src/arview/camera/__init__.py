"""Cameras: the pinhole model with distortion, calibration files and what a photo says of its camera."""

from arview.camera.model import Camera

__all__ = ["Camera"]
