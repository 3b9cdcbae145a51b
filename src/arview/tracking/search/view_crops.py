"""Crops of the part: small pictures of fixed size with the silhouette, as the appearance memory keeps them."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.geometry import Array, turns_to_rays
from arview.guideviews import GuideViewSet

CROP_PX = 24
"""Side of a crop."""
PART_PX = 21.0
"""Diameter of the part in a crop."""
CHANNELS = 3
"""Colour channels of a crop."""
MIN_SIDE_PX = CROP_PX / 2
"""Side in the frame below which the part is too small for a crop."""


class ViewCrop(NamedTuple):
    """The part in a frame.

    Attributes:
        picture: (CROP_PX,CROP_PX,3) uint8 RGB.
        mask: (CROP_PX,CROP_PX) uint8, 255 on the part.
    """

    picture: NDArray[np.uint8]
    mask: NDArray[np.uint8]


class AxisPose(NamedTuple):
    """A pose split into direction of view and position.

    Attributes:
        rotation: (3,3) rotation from the model, as if the part were on the optical axis.
        ray: (3,) unit ray from the camera to the part's centre.
        distance_mm: distance of the centre from the camera.
    """

    rotation: Array
    ray: Array
    distance_mm: float


class ViewCropper:
    """Cuts the part out of frames.

    Args:
        views: guide views of the part, from which its silhouettes are drawn.
        camera: intrinsics of the frames.
    """

    def __init__(self, views: GuideViewSet, camera: Camera) -> None:
        self.views = views
        self.camera = camera
        self.focal_px = 0.5 * (camera.fx + camera.fy)
        self._contour_start = np.array(views.arrays["contour_start"])
        self._contour_points = views.arrays["contour_points"]

    def axis_pose(self, cam_from_model: Array) -> AxisPose:
        """Direction of view and position of a pose (4,4)."""
        center = cam_from_model[:3, :3] @ self.views.center_in_model + cam_from_model[:3, 3]
        distance_mm = float(np.sqrt(center @ center))
        ray = center / distance_mm
        return AxisPose(turns_to_rays(ray).T @ cam_from_model[:3, :3], ray, distance_mm)

    def crop(self, image: NDArray[np.uint8], cam_from_model: Array) -> ViewCrop | None:
        """Cut the part at a pose (4,4) out of a frame (H,W,3) uint8 RGB; None where it is too small or outside."""
        _, ray, distance_mm = self.axis_pose(cam_from_model)
        u, v = self.camera.project(ray)
        half = 0.5 * CROP_PX / PART_PX * self.focal_px * self.views.diameter_mm / distance_mm
        if not np.isfinite(half + u + v) or 2.0 * half < MIN_SIDE_PX:
            return None
        left, top = round(u + 0.5 - half), round(v + 0.5 - half)
        side = round(2.0 * half)
        inside = np.s_[max(top, 0) : max(top + side, 0), max(left, 0) : max(left + side, 0)]
        window = image[inside]
        if window.size == 0:
            return None
        above, before = max(-top, 0), max(-left, 0)
        below, behind = side - above - window.shape[0], side - before - window.shape[1]
        if above + before + below + behind > 0:
            window = cv2.copyMakeBorder(window, above, below, before, behind, cv2.BORDER_REPLICATE)
        picture = cv2.resize(window, (CROP_PX, CROP_PX), interpolation=cv2.INTER_AREA)
        mask = self.silhouette(cam_from_model)
        # The part of the crop outside the frame is masked.
        visible = np.zeros((side, side), dtype=np.uint8)
        visible[above : side - below, before : side - behind] = 255
        mask &= cv2.resize(visible, (CROP_PX, CROP_PX), interpolation=cv2.INTER_NEAREST)
        if np.count_nonzero(mask) < CROP_PX:
            return None
        return ViewCrop(np.asarray(picture), mask)

    def silhouette(self, cam_from_model: Array) -> NDArray[np.uint8]:
        """Mask (CROP_PX,CROP_PX), 255 inside the outline of the nearest guide view at a pose (4,4).

        The contour points are so dense at this size that they form a closed line when dilated. All pixels that a flood
        fill from outside does not reach belong to the part.
        """
        index = self.views.nearest_index(cam_from_model)
        first, last = self._contour_start[index : index + 2]
        points = self._contour_points[first:last] @ cam_from_model[:3, :3].T + cam_from_model[:3, 3]
        center = cam_from_model[:3, :3] @ self.views.center_in_model + cam_from_model[:3, 3]
        scale = PART_PX / self.views.diameter_mm * np.sqrt(center @ center)
        pixels = scale * (points[:, :2] / points[:, 2:] - center[:2] / center[2]) + 0.5 * (CROP_PX - 1)
        lines = np.zeros((CROP_PX + 2, CROP_PX + 2), dtype=np.uint8)
        u, v = np.clip(np.round(pixels) + 1, 0, CROP_PX + 1).astype(np.int64).T
        lines[v, u] = 1
        lines = cv2.dilate(lines, np.ones((3, 3), dtype=np.uint8))
        lines[[0, -1]] = 0
        lines[:, [0, -1]] = 0
        outside = np.zeros((CROP_PX + 4, CROP_PX + 4), dtype=np.uint8)
        outside[1:-1, 1:-1] = lines
        cv2.floodFill(lines, outside, (0, 0), 2)
        part = np.where(lines == 2, 0, 255).astype(np.uint8)
        return np.ascontiguousarray(cv2.erode(part, np.ones((3, 3), dtype=np.uint8))[1:-1, 1:-1])
