"""PartOutline: place, size and outline of the part in a picture, from the nearest guide view."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.geometry import Array, exp_so3, rigid
from arview.guideviews import GuideViewSet


class PartPlace(NamedTuple):
    """Where a part is in a picture.

    Attributes:
        center_px: (2,) image of its centre.
        distance_mm: from the camera to its centre.
        diameter_px: its diameter at that distance.
    """

    center_px: Array
    distance_mm: float
    diameter_px: float


class PartOutline:
    """Projects the part into the pictures of a camera.

    Args:
        views: guide views of the part.
        camera: intrinsics of the pictures.
    """

    def __init__(self, views: GuideViewSet, camera: Camera) -> None:
        self.views = views
        self.camera = camera
        self._focal_px = 0.5 * (camera.fx + camera.fy)
        self._contour_start = np.array(views.arrays["contour_start"])
        self._contour_points = views.arrays["contour_points"]

    def place(self, cam_from_model: Array) -> PartPlace:
        """Place of the part at a pose (4,4)."""
        center = self.center_in_cam(cam_from_model)
        distance_mm = float(np.linalg.norm(center))
        diameter_px = self._focal_px * self.views.diameter_mm / max(distance_mm, 1e-6)
        return PartPlace(self.camera.project(center), distance_mm, diameter_px)

    def hull_px(self, cam_from_model: Array) -> NDArray[np.float32]:
        """Convex hull (N,2) of the outline at a pose (4,4), px."""
        index = self.views.nearest_index(cam_from_model)
        first, last = self._contour_start[index : index + 2]
        points = self._contour_points[first:last] @ cam_from_model[:3, :3].T + cam_from_model[:3, 3]
        pixels = self.camera.project(points[points[:, 2] > 1e-3])
        pixels = pixels[np.isfinite(pixels).all(axis=1)].astype(np.float32)
        if len(pixels) < 3:
            return np.zeros((0, 2), dtype=np.float32)
        return np.asarray(cv2.convexHull(pixels)[:, 0], dtype=np.float32)

    def contains(self, cam_from_model: Array, pixel: Array, margin: float = 0.0) -> bool:
        """Whether a pixel (2,) lies in the hull of the outline, or within ``margin`` diameters of it."""
        hull = self.hull_px(cam_from_model)
        if len(hull) < 3:
            return False
        inside_px = cv2.pointPolygonTest(hull, (float(pixel[0]), float(pixel[1])), True)
        return bool(inside_px >= -margin * self.place(cam_from_model).diameter_px)

    def mask(self, poses: list[Array], scale: float, size: tuple[int, int], margin: float) -> NDArray[np.uint8]:
        """Mask (rows,columns) of a reduced picture, 0 on the part at some poses (4,4) and 255 elsewhere.

        Args:
            poses: of the part.
            scale: reduced over full size.
            size: (rows, columns) of the reduced picture.
            margin: width of the border around the part that is left out too, in diameters.
        """
        mask = np.full(size, 255, dtype=np.uint8)
        for pose in poses:
            hull = self.hull_px(pose)
            if len(hull) < 3:
                continue
            limit = 8.0 * max(size)
            corners = np.round(np.clip(hull * scale, -limit, limit)).astype(np.int32)
            cv2.fillConvexPoly(mask, corners, 0)
            width = max(round(2.0 * margin * self.place(pose).diameter_px * scale), 1)
            cv2.polylines(mask, [corners], True, 0, min(width, 255))
        return mask

    def is_in_picture(self, place: PartPlace, min_room: float) -> bool:
        """Whether at least a share of the part's box lies in the picture, along both axes."""
        half = 0.5 * place.diameter_px
        for middle, size in zip(place.center_px, (self.camera.width, self.camera.height), strict=True):
            seen = min(middle + half, size) - max(middle - half, 0.0)
            if seen < min_room * min(2.0 * half, size):
                return False
        return True

    def moved(self, cam_from_model: Array, homography: Array) -> Array:
        """The pose (4,4) of a part that moves in the picture as a homography (3,3) of the background does."""
        place = self.place(cam_from_model)
        pixel, scale, roll_rad = transfer(homography, place.center_px)
        x, y = self.camera.unproject(pixel)[:2]
        ray = np.array([x, y, 1.0]) / np.sqrt(x * x + y * y + 1.0)
        center = self.center_in_cam(cam_from_model)
        before = center / place.distance_mm
        axis = np.cross(before, ray)
        sine = float(np.linalg.norm(axis))
        turn = np.eye(3) if sine < 1e-9 else exp_so3(axis / sine * np.arctan2(sine, before @ ray))
        rotation = exp_so3(ray * roll_rad) @ turn @ cam_from_model[:3, :3]
        moved_center = ray * place.distance_mm / scale
        return rigid(rotation, moved_center - rotation @ self.views.center_in_model)

    def center_in_cam(self, cam_from_model: Array) -> Array:
        """Centre (3,) of the part at a pose (4,4), mm."""
        return np.asarray(cam_from_model[:3, :3] @ self.views.center_in_model + cam_from_model[:3, 3])


def transfer(homography: Array, pixel: Array) -> tuple[Array, float, float]:
    """Image (2,) of a pixel (2,) under a homography (3,3), and its scale and rotation (rad) there."""
    x, y, w = homography @ np.array([pixel[0], pixel[1], 1.0])
    image = np.array([x / w, y / w])
    jacobian = (homography[:2, :2] - np.outer(image, homography[2, :2])) / w
    scale = float(np.sqrt(abs(np.linalg.det(jacobian))))
    roll_rad = float(np.arctan2(jacobian[1, 0] - jacobian[0, 1], jacobian[0, 0] + jacobian[1, 1]))
    return image, scale, roll_rad
