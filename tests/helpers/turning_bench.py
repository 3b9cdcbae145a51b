"""Films of a bench with one or two specimens of the assembly, seen by a camera that turns on the spot.

Of such a camera every frame is a homography of one wide picture, so that the poses are exact.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.geometry import Array, apply, exp_so3, rigid
from helpers.synthetic import assembly, background, part_box, picture, pose_from

WIDE = Camera(1500, 640, 700.0, 700.0, 749.5, 319.5)
CAMERA = Camera(960, 480, 700.0, 700.0, 479.5, 239.5)


def at_place(pose: Array, pixel: tuple[float, float]) -> Array:
    """A pose (4,4) turned about the camera so that the part's centre is at a pixel of the wide picture."""
    ray = np.array([(pixel[0] - WIDE.cx) / WIDE.fx, (pixel[1] - WIDE.cy) / WIDE.fy, 1.0])
    ray /= np.linalg.norm(ray)
    now = apply(pose, assembly().center_in_model)
    now = now / np.linalg.norm(now)
    axis = np.cross(now, ray)
    sine = float(np.linalg.norm(axis))
    turn = np.eye(3) if sine < 1e-9 else exp_so3(axis / sine * np.arcsin(sine))
    return rigid(turn, np.zeros(3)) @ pose


LEFT = at_place(pose_from(35, 40, 560), (600.0, 330.0))
RIGHT = at_place(pose_from(5, 45, 580), (900.0, 310.0))


@cache
def bench(with_left: bool, with_right: bool) -> NDArray[np.uint8]:
    """The wide picture (640,1500,3) without noise."""
    image = background(3, WIDE.width, WIDE.height).copy()
    for pose, is_there in ((LEFT, with_left), (RIGHT, with_right)):
        if is_there:
            drawn = picture(pose, camera=WIDE, scene=3, noise=0.0)
            plain = picture(None, camera=WIDE, scene=3, noise=0.0)
            seen = np.any(drawn != plain, axis=2)
            image[seen] = drawn[seen]
    return image


def covered(image: NDArray[np.uint8], pose: Array) -> NDArray[np.uint8]:
    """The wide picture with a card before the part at a pose (4,4)."""
    left, top, right, bottom = part_box(pose, WIDE, margin_px=8)
    image = image.copy()
    image[top:bottom, left:right] = background(503, WIDE.width, WIDE.height)[top:bottom, left:right]
    return image


def frame(wide: NDArray[np.uint8], yaw_deg: float, seed: int) -> tuple[NDArray[np.uint8], Array]:
    """What the camera sees of a wide picture when it is turned, with noise, and its rotation (4,4) from the bench."""
    turn = exp_so3([0.0, np.deg2rad(yaw_deg), 0.0])
    homography = CAMERA.matrix @ turn @ np.linalg.inv(WIDE.matrix)
    seen = cv2.warpPerspective(wide, homography, (CAMERA.width, CAMERA.height)).astype(np.float32)
    noisy = seen + np.random.default_rng(seed).normal(0.0, 2.0, seen.shape)
    return np.asarray(np.clip(np.round(noisy), 0, 255), dtype=np.uint8), rigid(turn, np.zeros(3))
