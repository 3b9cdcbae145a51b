"""Has a picture changed since the part was last searched for in it? What does not change need not be searched again.

Pictures are compared at a small size, where noise is averaged out, and after their exposure and white balance are made
equal. A pixel has changed if it is darker or lighter than all pixels around its place before, so that the tremor of a
hand does not count.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.guideviews import GuideViewSet

WIDTH_PX = 64
"""Width of the reduced pictures that are compared."""
MIN_DIFFERENCE = 10
"""Difference in grey levels of one channel from which a pixel has changed."""
MIN_PART_SHARE = 0.2
"""Changed area from which the scene has changed, as a share of the square of the part's diameter in the picture at its
farthest distance; the part itself covers up to half of that square."""
MAX_SHARE = 0.05
"""The same as a share of the picture, for parts that are large at all distances."""
MAX_GAIN = 2.0
"""Largest factor by which exposure or white balance may have changed."""


class SceneChange:
    """Compares pictures of one camera in which a part is searched for.

    Args:
        views: guide views of the part, whose range says how small it may be in the picture.
        camera: of the pictures.
    """

    def __init__(self, views: GuideViewSet, camera: Camera) -> None:
        farthest_mm = views.view_range.for_camera(camera, views.diameter_mm).distance_mm[1]
        diameter_px = 0.5 * (camera.fx + camera.fy) * views.diameter_mm / farthest_mm
        share = MIN_PART_SHARE * diameter_px**2 / (camera.width * camera.height)
        self._min_share = min(share, MAX_SHARE)
        self._size = (WIDTH_PX, max(1, round(WIDTH_PX * camera.height / camera.width)))

    def reduced(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """A frame (H,W,3) uint8 RGB at the size at which pictures are compared."""
        return np.asarray(cv2.resize(image, self._size, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def has_changed(self, before: NDArray[np.uint8], after: NDArray[np.uint8]) -> bool:
        """Whether so much differs between two reduced pictures that the part may have come into view."""
        return self.changed_share(before, after) >= self._min_share

    def changed_share(self, before: NDArray[np.uint8], after: NDArray[np.uint8]) -> float:
        """Share 0–1 of the pixels that changed between two reduced pictures."""
        around = np.ones((3, 3), dtype=np.uint8)
        gains = np.median((after + 1.0) / (before + 1.0), axis=(0, 1)).clip(1.0 / MAX_GAIN, MAX_GAIN)
        before = np.round(before * gains).clip(0, 255).astype(np.uint8)
        lighter = cv2.subtract(after, cv2.dilate(before, around))
        darker = cv2.subtract(cv2.erode(before, around), after)
        return float(np.mean(np.maximum(lighter, darker).max(axis=2) >= MIN_DIFFERENCE))
