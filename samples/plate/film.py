"""The clip: a walk past the as-built plate, with the lens of the photos at a smaller size. Lengths in mm."""

from __future__ import annotations

import cv2
import mitsuba as mi
import numpy as np
import shots
from kinds import SetOptions
from rendering import denoise, develop, sensor, to_world, undistortion_maps
from sample import KIND
from scipy.spatial.transform import Rotation

FRAMES, FPS = 96, 24
ARC_FRAMES = 120  # duration of the whole path
WIDTH, HEIGHT = 960, 720
FILM = (1008, 756)  # undistorted picture that the distorted one is sampled from
SAMPLES = 3  # path samples per pixel; the result is denoised. The picture moves by 3 px per frame: no motion blur


def camera(seed: int) -> dict:
    """Intrinsics of the clip: those of the photos, scaled."""
    photo = shots.camera(SetOptions(seed))
    scale = WIDTH / photo["width"]
    cx, cy = ((photo[key] + 0.5) * scale - 0.5 for key in ("cx", "cy"))
    return {**photo, "width": WIDTH, "height": HEIGHT, "fx": photo["fx"] * scale, "fy": photo["fy"] * scale,
            "cx": cx, "cy": cy}  # fmt: skip


def _tremor(t: float, seed: int) -> np.ndarray:
    """Smooth random motion of unit size, six channels: (6,)."""
    rng = np.random.default_rng((seed, 8))
    frequency_hz = np.geomspace(0.4, 7.0, 9)
    phase = rng.uniform(0, 2 * np.pi, (6, 9))
    weight = frequency_hz**-0.9
    return np.sin(2 * np.pi * frequency_hz * t / FPS + phase) @ (weight / np.sqrt(np.sum(weight**2) / 2))


def cam_from_model(t: float, seed: int) -> np.ndarray:
    """(4,4) OpenCV camera pose at time ``t`` in frames."""
    u, shake = t / (ARC_FRAMES - 1), _tremor(t, seed)
    azimuth = np.deg2rad(-128.0 + 80.0 * (u + 0.04 * np.sin(4 * np.pi * u)))
    elevation = np.deg2rad(44.0 + 8.0 * np.sin(2 * np.pi * (0.8 * u + 0.1)))
    distance = 690.0 + 35.0 * np.sin(2 * np.pi * (u + 0.3))
    out = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    target = np.array([12.0 * np.sin(6 * u + 1), 12.0 * np.cos(5 * u), 10.0])
    position = target + distance * out + 0.9 * shake[:3]
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    turn = Rotation.from_rotvec(np.deg2rad((0.15 * shake[3], 0.15 * shake[4], 3.0 * np.sin(6.0 * u) + 0.2 * shake[5])))
    pose = np.eye(4)
    pose[:3, :3] = turn.as_matrix() @ np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ position
    return pose


class Shoot:
    """Takes the frames of the clip of one seed."""

    def __init__(self, seed: int):
        import studio

        self.seed, self.camera, self.exposure = seed, camera(seed), KIND.exposure
        film = sensor(FILM, self.camera["fx"], studio.APERTURE_MM, 690.0)
        self.scene = studio.build(KIND, SetOptions(seed), film)
        self.params = mi.traverse(self.scene)
        self.light = mi.load_dict({"type": "path", "max_depth": 4, "rr_depth": 3})
        self.guides = mi.load_dict({"type": "aov", "aovs": "alb:albedo,nn:sh_normal"})
        self.maps = undistortion_maps(self.camera, FILM)

    def frame(self, index: int) -> np.ndarray:
        """The finished BGR picture (H,W,3) uint8."""
        self.params["sensor.to_world"] = to_world(cam_from_model(index, self.seed))
        self.params.update()
        noise = (self.seed * ARC_FRAMES + index) * 2 + (1 << 24)
        color = np.array(mi.render(self.scene, integrator=self.light, spp=SAMPLES, seed=noise))
        guide = np.array(mi.render(self.scene, integrator=self.guides, spp=2, seed=noise + 1))
        linear = cv2.remap(denoise(color, guide), *self.maps, cv2.INTER_CUBIC)
        gain = 1.0 + 0.05 * np.sin(2 * np.pi * index / ARC_FRAMES + 0.5)
        return develop(linear, gain * self.exposure, np.random.default_rng((self.seed, 9, index)))
