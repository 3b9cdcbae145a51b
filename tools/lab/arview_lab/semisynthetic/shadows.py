"""Soft shadows: of a part on itself and on what is behind it, and of things that are not in the picture."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.core.kernel import kernel
from arview.geometry import Array, apply, rigid
from arview.rendering.rasterizer import rasterise
from arview_lab.semisynthetic.decoration import fractal_noise

MAP_PX = 480
"""Side of the shadow map."""
DISTANCE = 25.0
"""Distance of the map's camera, in diameters of the part: the light is nearly parallel."""


@dataclass(frozen=True)
class ShadowOptions:
    """Shadows of the key light.

    Attributes:
        penumbra: half width of the soft edge of shadows, as a share of the part's diameter.
        others: share of the light that is taken away by shadows of things outside the picture.
        behind: distance of the surface behind the part on which its shadow falls, in diameters.
        behind_strength: share of the background's light that the shadow takes away.
    """

    penumbra: float = 0.012
    others: float = 0.55
    behind: float = 0.55
    behind_strength: float = 0.5


@dataclass(frozen=True)
class ShadowMap:
    """Depth of a part seen from a light.

    Attributes:
        light_from_cam: (4,4), mm.
        focal_px: of the map.
        inverse_depth: (MAP_PX, MAP_PX) in 1/mm, 0 where there is nothing.
    """

    light_from_cam: Array
    focal_px: float
    inverse_depth: Array


def shadow_map(points_in_cam: Array, faces: NDArray[np.int32], toward_in_cam: Array, diameter_mm: float) -> ShadowMap:
    """Shadow map of a part (V,3) for a light in a direction (3,); see Williams, "Casting curved shadows", 1978."""
    center = 0.5 * (points_in_cam.min(axis=0) + points_in_cam.max(axis=0))
    forward = -np.asarray(toward_in_cam) / np.linalg.norm(toward_in_cam)
    across = np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.9 else [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    rotation = np.stack([across, np.cross(forward, across), forward])
    light_from_cam = rigid(rotation, np.array([0.0, 0.0, DISTANCE * diameter_mm]) - rotation @ center)
    focal = DISTANCE * MAP_PX / 1.3
    middle = 0.5 * (MAP_PX - 1)
    points = apply(light_from_cam, points_in_cam)
    inverse_depth, _ = rasterise(points, faces, focal, focal, middle, middle, MAP_PX, MAP_PX)
    return ShadowMap(light_from_cam, focal, inverse_depth)


def light_reach(
    inverse_depth: Array, lens: Array, shadow: ShadowMap, diameter_mm: float, options: ShadowOptions,
    lattice: NDArray[np.float32], time: float,
) -> NDArray[np.float32]:  # fmt: skip
    """Share (H,W) of the key light that reaches every sample of a rendered part.

    Args:
        inverse_depth: (H,W) of the rendered part, 1/mm.
        lens: (fx, fy, cx, cy) of it.
        shadow: of the key light.
        diameter_mm: of the part.
        options: see `ShadowOptions`.
        lattice: random values, for the shadows of other things.
        time: place of the other things, in units in which they change completely.
    """
    return np.asarray(
        _light_reach(
            inverse_depth, lens, shadow.light_from_cam, shadow.focal_px, shadow.inverse_depth,
            options.penumbra * diameter_mm, 0.006 * diameter_mm, diameter_mm, options.others, lattice, time,
        )
    )  # fmt: skip


def shadow_behind(
    points_in_cam: Array, faces: NDArray[np.int32], toward_in_cam: Array, camera: Camera, diameter_mm: float,
    options: ShadowOptions,
) -> NDArray[np.float32]:  # fmt: skip
    """Share (H,W) of the light that the part's shadow takes from a plane behind it that faces the camera."""
    center = 0.5 * (points_in_cam.min(axis=0) + points_in_cam.max(axis=0))
    plane_mm = center[2] + options.behind * diameter_mm
    toward = np.asarray(toward_in_cam) / np.linalg.norm(toward_in_cam)
    # A light nearly beside the part would cast the shadow out of the picture.
    slope = toward[:2] / min(toward[2], -0.6)
    thrown = points_in_cam.copy()
    thrown[:, :2] += (plane_mm - points_in_cam[:, 2:]) * slope
    thrown[:, 2] = plane_mm
    shrink = 2
    small = camera.scaled(max(1, camera.width // shrink), max(1, camera.height // shrink))
    _, face_ids = rasterise(thrown, faces, small.fx, small.fy, small.cx, small.cy, small.width, small.height)
    covered = (face_ids >= 0).astype(np.float32)
    blur = 2.5 * options.penumbra * diameter_mm * (1.0 + 2.0 * options.behind) * small.fx / plane_mm
    soft = cv2.GaussianBlur(covered, (0, 0), max(blur, 0.8))
    full = cv2.resize(soft, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(options.behind_strength * full)


@kernel
def _light_reach(
    inverse_depth: NDArray[np.float64], lens: NDArray[np.float64], light_from_cam: NDArray[np.float64],
    focal: float, map_depth: NDArray[np.float64], penumbra_mm: float, bias_mm: float, diameter_mm: float,
    others: float, lattice: NDArray[np.float32], time: float
) -> NDArray[np.float32]:  # fmt: skip
    height, width = inverse_depth.shape
    side = map_depth.shape[0]
    middle = 0.5 * (side - 1)
    fx, fy, cx, cy = lens
    t = light_from_cam
    out = np.zeros((height, width), dtype=np.float32)
    for r in range(height):
        for col in range(width):
            if inverse_depth[r, col] <= 0.0:
                continue
            z = 1.0 / inverse_depth[r, col]
            x, y = (col - cx) / fx * z, (r - cy) / fy * z
            lx = t[0, 0] * x + t[0, 1] * y + t[0, 2] * z + t[0, 3]
            ly = t[1, 0] * x + t[1, 1] * y + t[1, 2] * z + t[1, 3]
            lz = t[2, 0] * x + t[2, 1] * y + t[2, 2] * z + t[2, 3]
            u, v = focal * lx / lz + middle, focal * ly / lz + middle
            # Percentage-closer filtering (Reeves et al. 1987) over a window that is weighted towards its middle.
            step = penumbra_mm * focal / lz / 3.0
            free = weight = 0.0
            for i in range(-3, 4):
                for k in range(-3, 4):
                    share = (4.0 - abs(i)) * (4.0 - abs(k))
                    weight += share
                    column, row = int(np.floor(u + i * step + 0.5)), int(np.floor(v + k * step + 0.5))
                    if column < 0 or row < 0 or column >= side or row >= side:
                        free += share
                        continue
                    near = map_depth[row, column]
                    # Grazing light: the depth changes within a step.
                    slack = bias_mm + 0.6 * (abs(i) + abs(k)) / 3.0 * penumbra_mm
                    if near <= 0.0 or lz - 1.0 / near <= slack:
                        free += share
            reach = free / weight
            if others > 0.0:
                scale = 1.6 / diameter_mm
                value = fractal_noise(lattice, lx * scale + 3.0, ly * scale + 5.0, time)
                dark = min(max((value - 0.52) / 0.07, 0.0), 1.0)
                reach *= 1.0 - others * dark * dark * (3.0 - 2.0 * dark)
            out[r, col] = reach
    return out
