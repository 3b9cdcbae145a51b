"""Specimens of one part in one picture: whether two poses are of one of them, and pictures in which some are hidden."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.geometry import Array, apply
from arview.guideviews import GuideViewSet

SAME_PLACE = 0.3
"""Distance of the centres, in diameters of the part, within which two specimens are one."""
MARGIN = 0.06
"""Share by which the area that hides a specimen is larger than the specimen."""
NEAR_SHARE = 0.1
"""Depth, in diameters, below which points are left out because they may be behind the camera."""
WORK_PX = 160
"""Longer side of the reduced picture in which the surroundings are spread into the area."""
SOFT_PX = 2.0
"""Standard deviation with which the border of the area is blurred."""


class CoveredPlace(NamedTuple):
    """Where another part is: its pose (4,4), and its guide views."""

    cam_from_model: Array
    views: GuideViewSet


def specimen_names(part_names: Sequence[str]) -> list[str]:
    """Names of specimens: that of the part, with a number where several have the same: ``plate#1``, ``plate#2``."""
    total, seen = Counter(part_names), Counter[str]()
    names = []
    for name in part_names:
        seen[name] += 1
        names.append(f"{name}#{seen[name]}" if total[name] > 1 else name)
    return names


def is_same_specimen(one: Array, other: Array, views: GuideViewSet) -> bool:
    """Whether the centre of a part is at about the same place at two poses (4,4)."""
    apart = apply(one, views.center_in_model) - apply(other, views.center_in_model)
    return bool(np.linalg.norm(apart) < SAME_PLACE * views.diameter_mm)


def hide_specimens(
    image: NDArray[np.uint8],
    poses: Sequence[Array],
    views: GuideViewSet,
    camera: Camera,
) -> NDArray[np.uint8]:
    """A picture in which a part is covered by its surroundings at some poses, so that others of its kind are found.

    The surroundings are spread inwards (Telea, "An image inpainting technique based on the fast marching method",
    2004), because a patch of one colour would have an outline of its own.

    Args:
        image: (H,W,3) uint8 RGB of the camera's size.
        poses: (4,4) of specimens that are not to be found again.
        views: of the part.
        camera: of the image.

    Returns:
        (H,W,3) uint8; the image itself where no specimen is in it.
    """
    covered = np.zeros(image.shape[:2], dtype=np.uint8)
    for pose in poses:
        outline = views.nearest(pose).features.contour_points
        points = apply(pose, views.center_in_model + (1.0 + MARGIN) * (outline - views.center_in_model))
        pixels = camera.project(points[points[:, 2] > NEAR_SHARE * views.diameter_mm])
        pixels = pixels[np.isfinite(pixels).all(axis=1)]
        if len(pixels) >= 3:
            hull = cv2.convexHull(np.clip(pixels, -1e4, 1e4).astype(np.float32))
            cv2.fillConvexPoly(covered, np.round(hull).astype(np.int32), 255)
    if not covered.any():
        return image
    size, scale = image.shape[1::-1], min(1.0, WORK_PX / max(image.shape[:2]))
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    is_covered = cv2.resize(covered, small.shape[1::-1], interpolation=cv2.INTER_AREA) > 0
    area = cv2.dilate(is_covered.astype(np.uint8), np.ones((3, 3), np.uint8))
    spread = cv2.resize(cv2.inpaint(small, area, 3, cv2.INPAINT_TELEA), size, interpolation=cv2.INTER_LINEAR)
    share = (cv2.GaussianBlur(covered, (0, 0), SOFT_PX).astype(np.float32) / 255.0)[..., None]
    return np.asarray(np.round((1.0 - share) * image + share * spread), dtype=np.uint8)


def searched_picture(
    image: NDArray[np.uint8],
    others: Sequence[Array],
    covers: Sequence[CoveredPlace],
    views: GuideViewSet,
    camera: Camera,
) -> NDArray[np.uint8]:
    """A picture without other specimens of a part, at poses (4,4), and without other parts."""
    searched = hide_specimens(image, others, views, camera)
    for one in covers:
        searched = hide_specimens(searched, [one.cam_from_model], one.views, camera)
    return searched
