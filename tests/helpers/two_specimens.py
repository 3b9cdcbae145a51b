"""Frames with two specimens of the sample's part: two frames of the clip, each turned about the camera's centre."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from arview.camera import Camera
from arview.geometry import Array
from arview.video import Image
from helpers import live_sample
from helpers.live_browser import camera

SHARE_ASIDE = 0.42
"""Angle by which a frame is turned aside, as the tangent in widths of the frame over the focal length."""


def wide_camera() -> Camera:
    """Camera of the frames, without distortion, twice as wide as that of the clip's frames."""
    lens = camera(live_sample.WIDTH, live_sample.HEIGHT)
    width = round(1.7 * lens.width)
    return Camera(width, lens.height, lens.fx, lens.fy, 0.5 * (width - 1), lens.cy)


@cache
def frames() -> list[tuple[Image, tuple[Array, Array]]]:
    """Frames (H,W,3) with the part on the left, going on in time, and on the right, going back, with both poses."""
    images, poses = live_sample.frames(), live_sample.truth()
    last = len(images) - 1
    made = []
    for k in range(len(images)):
        left, left_pose = _turned(images[k], poses[k], -1.0)
        right, right_pose = _turned(images[last - k], poses[last - k], 1.0)
        middle = left.shape[1] // 2
        made.append((np.concatenate([left[:, :middle], right[:, middle:]], axis=1), (left_pose, right_pose)))
    return made


def _turned(image: Image, cam_from_model: Array, side: float) -> tuple[Image, Array]:
    """A frame as seen by the wide camera after a turn to one side, and its pose.

    A turn about the optical centre is a homography of the picture, whatever the scene.
    """
    lens, wide = camera(live_sample.WIDTH, live_sample.HEIGHT), wide_camera()
    angle = side * np.arctan(SHARE_ASIDE * lens.width / lens.fx)
    turn = np.array([[np.cos(angle), 0.0, np.sin(angle)], [0.0, 1.0, 0.0], [-np.sin(angle), 0.0, np.cos(angle)]])
    plain = cv2.undistort(image, lens.matrix, lens.dist)
    moved = wide.matrix @ turn @ np.linalg.inv(lens.matrix)
    shown = cv2.warpPerspective(plain, moved, (wide.width, wide.height), borderMode=cv2.BORDER_REPLICATE)
    pose = cam_from_model.copy()
    pose[:3] = turn @ cam_from_model[:3]
    return np.asarray(shown), pose
