"""Frames of a video that determine the focal length together, kept small and few."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.geometry import Array
from arview.refinement import smoothed

MAX_FRAMES = 30
"""Frames kept at most; of more, those with the least information on the focal length are left out."""
SPAN_PX = 400.0
"""A larger part is reduced to this diameter in the kept picture, which bounds memory and time."""
CROP_REACH = 1.25
"""Half side of the kept picture, in half diameters of the part."""
TURN_DEG = 4.0
"""Rotation from all kept frames that makes a frame new."""
DISTANCE_SHARE = 0.05
"""Change of the distance that makes a frame new."""
SHIFT_SHARE = 0.08
"""Shift in the picture, as a share of its longer side, that makes a frame new."""
MIN_VISIBLE = 0.6
"""Share of the part's box inside the picture below which a frame is not kept."""


@dataclass(eq=False)
class CalibrationFrame:
    """The picture around the part in one frame, and the part's pose there.

    Attributes:
        gray: (h,w) uint8, smoothed, of the crop after reduction.
        scale: size of the kept picture relative to the frame, at most 1.
        left, top: first pixel of the crop in the reduced frame.
        cam_from_body: (4,4) pose about the part's centre, with the camera of ``focal_px``.
        focal_px: focal length in the frame with which the pose was found.
        information: of the frame alone on the logarithm of the focal length, 1/px².
    """

    gray: NDArray[np.uint8]
    scale: float
    left: int
    top: int
    cam_from_body: Array
    focal_px: float
    information: float = 0.0

    def pose_at(self, focal_px: float) -> Array:
        """The pose (4,4) at another focal length, at which the part's centre has the same place and size."""
        pose = self.cam_from_body.copy()
        pose[2, 3] *= focal_px / self.focal_px
        return pose

    def intrinsics(self, camera: Camera) -> Array:
        """Intrinsics (10,) of the kept picture, from those of the frame, in the form of the kernels."""
        s = self.scale
        cx, cy = (camera.cx + 0.5) * s - 0.5 - self.left, (camera.cy + 0.5) * s - 0.5 - self.top
        return np.array([camera.fx * s, camera.fy * s, cx, cy, *camera.dist, 1.0 if camera.is_distorted else 0.0])


def cropped_frame(
    image: NDArray[np.uint8], cam_from_body: Array, camera: Camera, diameter_mm: float
) -> CalibrationFrame | None:
    """The picture around the part at a pose (4,4) in a frame (H,W,3); None where too little of it is inside."""
    u, v = camera.project(cam_from_body[:3, 3])
    span_px = diameter_mm * camera.fx / max(float(cam_from_body[2, 3]), 1.0)
    reach = 0.5 * span_px * CROP_REACH
    if not np.isfinite(u + v + reach):
        return None
    box = np.array([u - reach, v - reach, u + reach, v + reach])
    inside = np.clip(box, 0, [camera.width, camera.height, camera.width, camera.height])
    sides = np.minimum(2.0 * reach, [camera.width, camera.height])
    if np.prod(inside[2:] - inside[:2]) < MIN_VISIBLE * np.prod(sides):
        return None
    scale = min(1.0, SPAN_PX / span_px)
    x0, y0, x1, y1 = (int(value) for value in (*np.floor(inside[:2]), *np.ceil(inside[2:])))
    gray = cv2.cvtColor(np.ascontiguousarray(image[y0:y1, x0:x1]), cv2.COLOR_RGB2GRAY)
    if scale == 1.0:
        return CalibrationFrame(smoothed(gray), 1.0, x0, y0, cam_from_body, camera.fx)
    # The reduced picture begins on a pixel of its own, so that one shift describes it.
    left, top = int(np.ceil(x0 * scale)), int(np.ceil(y0 * scale))
    width, height = int((x1 - x0) * scale) - 1, int((y1 - y0) * scale) - 1
    if min(width, height) < 16:
        return None
    to_source = np.array(
        [
            [1.0 / scale, 0.0, (left + 0.5) / scale - 0.5 - x0],
            [0.0, 1.0 / scale, (top + 0.5) / scale - 0.5 - y0],
        ]
    )
    soft = cv2.GaussianBlur(gray, (0, 0), 0.5 * max(1.0 / scale - 1.0, 0.3))
    reduced = cv2.warpAffine(
        soft, to_source, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE
    )
    return CalibrationFrame(smoothed(np.asarray(reduced)), scale, left, top, cam_from_body, camera.fx)


class FrameSet:
    """The frames kept for the estimation: distinct views, and of these the most informative ones.

    Args:
        camera: of the frames, for their size.
    """

    def __init__(self, camera: Camera) -> None:
        self.frames: list[CalibrationFrame] = []
        self._longer_px = float(max(camera.width, camera.height))

    def is_new(self, cam_from_body: Array, focal_px: float) -> bool:
        """Whether a pose (4,4), found with a focal length, differs enough from those of all kept frames."""
        if not self.frames:
            return True
        new = cam_from_body
        kept = np.stack([frame.cam_from_body for frame in self.frames])
        focals_px = np.array([frame.focal_px for frame in self.frames])
        cosines = 0.5 * (np.einsum("nij,ij->n", kept[:, :3, :3], new[:3, :3]) - 1.0)
        is_turned = cosines < np.cos(np.deg2rad(TURN_DEG))
        # Distances compare per focal length: a frame keeps the pose found with the camera of its time.
        ratios = (kept[:, 2, 3] / focals_px) / (new[2, 3] / focal_px)
        is_nearer = np.abs(np.log(ratios)) > DISTANCE_SHARE
        places_px = focals_px[:, None] * kept[:, :2, 3] / kept[:, 2:3, 3]
        shifts_px = np.linalg.norm(places_px - focal_px * new[:2, 3] / new[2, 3], axis=1)
        return bool(np.all(is_turned | is_nearer | (shifts_px > SHIFT_SHARE * self._longer_px)))

    def add(self, frame: CalibrationFrame) -> bool:
        """Keep a frame; of too many, the least informative one is left out. Returns whether the set has changed."""
        if len(self.frames) >= MAX_FRAMES:
            least = min(self.frames, key=lambda kept: kept.information)
            if least.information >= frame.information:
                return False
            self.frames.remove(least)
        self.frames.append(frame)
        return True
