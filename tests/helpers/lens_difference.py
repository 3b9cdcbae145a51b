"""How far two calibrated cameras are apart in the picture."""

from __future__ import annotations

import numpy as np

from arview.calibration.projection import project
from arview.camera import Camera
from arview.core.fits import without_span
from arview.geometry import Array


def pixel_difference(camera: Camera, other: Camera, pixels: Array) -> Array:
    """(N,2) px from where ``camera`` sees rays to where ``other`` does, at pixels (N,2), less the best rotation."""
    rays = camera.unproject(pixels)
    _, _, pose = project(rays, camera, np.eye(4))
    return without_span(pose[:, :3], (other.project(rays) - pixels).ravel()).reshape(-1, 2)
