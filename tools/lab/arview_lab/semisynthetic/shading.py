"""Rendering of a textureless part like metal or paint: per-pixel normals, two lights, reflections.

The part is rendered at three times the picture's resolution and averaged, so that edges are exact to a fraction of a
pixel. Colours are linear in the picture's grey levels, as in RBOT: no tone curve is applied.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.cad.model import Model
from arview.camera import Camera
from arview.core.kernel import kernel
from arview.geometry import Array, apply
from arview.rendering.rasterizer import rasterise

SUPERSAMPLING = 3
"""Rendered samples per pixel in each direction."""
SMOOTH_BELOW_DEG = 40.0
"""Faces that meet at a smaller angle are shaded as one smooth surface."""
MAX_SATURATION = 0.35
BRIGHTNESS = (0.3, 0.65)
"""Largest saturation, and range of brightness, to which CAD colours are limited, as those of real parts."""


@dataclass(frozen=True)
class Light:
    """Lights of the scene.

    Attributes:
        toward_in_cam: (L,3) unit vectors towards the lights.
        strength: (L,) of each light.
        ambient: light from all sides, strongest from above.
        surroundings: (H,W,3) float32 in 0–1, environment map by latitude and longitude, for reflections.
    """

    toward_in_cam: Array
    strength: Array
    ambient: float
    surroundings: NDArray[np.float32]


@dataclass(frozen=True)
class Reflectance:
    """Reflectance of a part: weights of diffuse light, highlights (Phong) and mirrored surroundings, and gloss."""

    diffuse: float = 0.75
    specular: float = 0.35
    mirror: float = 0.25
    gloss: float = 24.0


@dataclass(frozen=True)
class Layer:
    """A part rendered alone.

    Attributes:
        left, top: of the window in the picture, px; it may extend beyond the picture.
        color: (h,w,3) float32 in 0–1, multiplied by coverage.
        coverage: (h,w) float32, share of each pixel that the part covers.
    """

    left: int
    top: int
    color: NDArray[np.float32]
    coverage: NDArray[np.float32]


@dataclass(frozen=True)
class UnlitSamples:
    """The rendered samples of a part before they are lit, for a `SurfaceAppearance`.

    Attributes:
        inverse_depth: (H,W) in 1/mm, 0 where there is nothing.
        face_ids: (H,W), -1 where there is nothing.
        points: (V,3) vertices in the camera frame, mm.
        faces: (F,3) vertex indices.
        colors: (F,3) of the plain part.
        lens: (fx, fy, cx, cy) of the samples, px.
    """

    inverse_depth: Array
    face_ids: NDArray[np.int32]
    points: Array
    faces: NDArray[np.int32]
    colors: Array
    lens: Array


class SurfaceAppearance(Protocol):
    """What a part's surface is like from sample to sample, where it is not plain."""

    def __call__(self, samples: UnlitSamples, light: Light) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Albedo and factor of highlights (H,W,4), and share of the first light that arrives (H,W)."""


class ShadedModel:
    """A model prepared for rendering: normals at the corners of its faces, and colours.

    Args:
        model: rendered.
        reflectance: of its surface.
        vivid: keep the CAD's colours as they are, instead of muting them.
    """

    def __init__(self, model: Model, reflectance: Reflectance | None = None, vivid: bool = False) -> None:
        self.model = model
        self.reflectance = reflectance or Reflectance()
        self.vertices, self.faces, owners = model.mesh
        self._normals = corner_normals(self.vertices, self.faces, SMOOTH_BELOW_DEG)
        colors = np.array([component.color for component in model.components])
        self._colors = (colors if vivid else muted(colors))[owners]

    def draw(
        self,
        cam_from_model: Array,
        camera: Camera,
        light: Light,
        surface: SurfaceAppearance | None = None,
        points: Array | None = None,
        supersampling: int = SUPERSAMPLING,
    ) -> Layer | None:
        """Render the part at a pose (4,4), also beyond the picture's borders; None if it cannot be seen.

        Args:
            cam_from_model: (4,4); orients the normals.
            camera: free of distortion.
            light: of the scene.
            surface: None for a plain one.
            points: (V,3) vertices in the camera frame, where they are not at one pose; None: at ``cam_from_model``.
            supersampling: samples per pixel in each direction.
        """
        points = apply(cam_from_model, self.vertices) if points is None else points
        if points[:, 2].min() < 1.0:
            return None
        pixels = camera.project(points)
        # Two pixels of margin for the blur; at most the picture's size beyond its borders.
        size = np.array([camera.width, camera.height])
        left, top = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - 2, -size).tolist()
        right, bottom = np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + 3, 2 * size).tolist()
        if right <= left or bottom <= top:
            return None
        n = supersampling
        fine = camera.scaled(n * camera.width, n * camera.height)
        inverse_depth, face_ids = rasterise(
            points, self.faces, fine.fx, fine.fy, fine.cx, fine.cy, n * (right - left), n * (bottom - top),
            origin=(n * left, n * top),
        )  # fmt: skip
        s = self.reflectance
        lens = np.array([fine.fx, fine.fy, fine.cx - n * left, fine.cy - n * top])
        own, reach = np.zeros((0, 0, 4), np.float32), np.zeros((0, 0), np.float32)
        if surface is not None:
            own, reach = surface(UnlitSamples(inverse_depth, face_ids, points, self.faces, self._colors, lens), light)
        color = _shade(
            inverse_depth, face_ids, points, self.faces, self._normals @ cam_from_model[:3, :3].T, self._colors, lens,
            light.toward_in_cam, light.strength, light.ambient, light.surroundings,
            s.diffuse, s.specular, s.mirror, s.gloss, own, reach,
        )  # fmt: skip
        seen = (face_ids >= 0).astype(np.float32)
        color *= _openness(inverse_depth, seen, fine, self.model.diameter_mm)[..., None]
        window = (right - left, bottom - top)
        return Layer(
            left,
            top,
            np.asarray(cv2.resize(color, window, interpolation=cv2.INTER_AREA)),
            np.asarray(cv2.resize(seen, window, interpolation=cv2.INTER_AREA)),
        )


def muted(colors: Array) -> Array:
    """Colours (N,3) in 0–1 limited in saturation and brightness, as of metal or paint; hues are kept."""
    colors = np.maximum(colors, 1e-3)
    value = colors.max(axis=1, keepdims=True)
    saturation = 1.0 - colors.min(axis=1, keepdims=True) / value
    kept = np.minimum(1.0, MAX_SATURATION / np.maximum(saturation, 1e-6))
    pale = value - kept * (value - colors)
    return np.asarray(pale * np.clip(value, *BRIGHTNESS) / value)


def corner_normals(vertices: Array, faces: NDArray[np.int32], smooth_below_deg: float) -> Array:
    """(F,3,3) unit normals at the faces' corners: means over the adjacent faces that meet at less than an angle."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    doubled = np.cross(b - a, c - a)
    normals = doubled / np.maximum(np.linalg.norm(doubled, axis=1, keepdims=True), 1e-12)
    order = np.argsort(faces.ravel(), kind="stable")
    starts = np.searchsorted(faces.ravel()[order], np.arange(len(vertices) + 1))
    return np.asarray(
        _corner_normals(faces, normals, doubled, order // 3, starts, float(np.cos(np.deg2rad(smooth_below_deg))))
    )


@kernel
def _corner_normals(
    faces: NDArray[np.int32], normals: NDArray[np.float64], doubled: NDArray[np.float64], owners: NDArray[np.int64],
    starts: NDArray[np.int64], smooth_cosine: float
) -> NDArray[np.float64]:  # fmt: skip
    corners = np.empty((faces.shape[0], 3, 3))
    for face in range(faces.shape[0]):
        for k in range(3):
            x = y = z = 0.0
            vertex = faces[face, k]
            for i in range(starts[vertex], starts[vertex + 1]):
                other = owners[i]
                cosine = (
                    normals[face, 0] * normals[other, 0]
                    + normals[face, 1] * normals[other, 1]
                    + normals[face, 2] * normals[other, 2]
                )
                if cosine > smooth_cosine:
                    x += doubled[other, 0]
                    y += doubled[other, 1]
                    z += doubled[other, 2]
            length = max((x * x + y * y + z * z) ** 0.5, 1e-12)
            corners[face, k, 0], corners[face, k, 1], corners[face, k, 2] = x / length, y / length, z / length
    return corners


@kernel
def _shade(
    inverse_depth: NDArray[np.float64], face_ids: NDArray[np.int32], points: NDArray[np.float64],
    faces: NDArray[np.int32], normals: NDArray[np.float64], colors: NDArray[np.float64], lens: NDArray[np.float64],
    toward: NDArray[np.float64], strength: NDArray[np.float64], ambient: float, surroundings: NDArray[np.float32],
    diffuse: float, specular: float, mirror: float, gloss: float, own: NDArray[np.float32],
    reach: NDArray[np.float32]
) -> NDArray[np.float32]:  # fmt: skip
    height, width = face_ids.shape
    is_plain, is_all_lit = own.shape[0] == 0, reach.shape[0] == 0
    fx, fy, cx, cy = lens
    map_height, map_width = surroundings.shape[:2]
    out = np.zeros((height, width, 3), dtype=np.float32)
    for r in range(height):
        for col in range(width):
            face = face_ids[r, col]
            if face < 0:
                continue
            z = 1.0 / inverse_depth[r, col]
            x, y = (col - cx) / fx * z, (r - cy) / fy * z
            i, j, k = faces[face, 0], faces[face, 1], faces[face, 2]
            # Barycentric weights of the corners.
            e1x, e1y, e1z = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
            e2x, e2y, e2z = points[k, 0] - points[i, 0], points[k, 1] - points[i, 1], points[k, 2] - points[i, 2]
            px, py, pz = x - points[i, 0], y - points[i, 1], z - points[i, 2]
            d11 = e1x * e1x + e1y * e1y + e1z * e1z
            d12 = e1x * e2x + e1y * e2y + e1z * e2z
            d22 = e2x * e2x + e2y * e2y + e2z * e2z
            p1 = px * e1x + py * e1y + pz * e1z
            p2 = px * e2x + py * e2y + pz * e2z
            determinant = max(d11 * d22 - d12 * d12, 1e-18)
            wj = min(max((d22 * p1 - d12 * p2) / determinant, 0.0), 1.0)
            wk = min(max((d11 * p2 - d12 * p1) / determinant, 0.0), 1.0 - wj)
            wi = 1.0 - wj - wk
            nx = wi * normals[face, 0, 0] + wj * normals[face, 1, 0] + wk * normals[face, 2, 0]
            ny = wi * normals[face, 0, 1] + wj * normals[face, 1, 1] + wk * normals[face, 2, 1]
            nz = wi * normals[face, 0, 2] + wj * normals[face, 1, 2] + wk * normals[face, 2, 2]
            length = max((nx * nx + ny * ny + nz * nz) ** 0.5, 1e-12)
            distance = (x * x + y * y + z * z) ** 0.5
            vx, vy, vz = -x / distance, -y / distance, -z / distance
            facing = (nx * vx + ny * vy + nz * vz) / length
            if facing < 0.0:
                length, facing = -length, -facing
            nx, ny, nz = nx / length, ny / length, nz / length
            rx, ry, rz = 2.0 * facing * nx - vx, 2.0 * facing * ny - vy, 2.0 * facing * nz - vz
            # The camera's +Y is down: surfaces that face up get more ambient light.
            matt = ambient * (0.75 - 0.25 * ny)
            shine = 0.0
            for s in range(toward.shape[0]):
                cosine = nx * toward[s, 0] + ny * toward[s, 1] + nz * toward[s, 2]
                if cosine > 0.0:
                    arriving = strength[s]
                    if s == 0 and not is_all_lit:
                        arriving *= reach[r, col]
                    matt += diffuse * arriving * cosine
                    along = rx * toward[s, 0] + ry * toward[s, 1] + rz * toward[s, 2]
                    if along > 0.0:
                        shine += specular * arriving * along**gloss
            # Reflected surroundings, stronger at grazing angles (Schlick's approximation).
            share = mirror * (0.4 + 0.6 * (1.0 - facing) ** 3)
            column = (np.arctan2(rx, rz) / (2.0 * np.pi) + 0.5) * map_width
            row = min(max((np.arcsin(min(max(ry, -1.0), 1.0)) / np.pi + 0.5) * map_height, 0.0), map_height - 1.001)
            c0, r0 = int(column) % map_width, int(row)
            c1, r1 = (c0 + 1) % map_width, min(r0 + 1, map_height - 1)
            fc, fr = column - int(column), row - r0
            for c in range(3):
                upper = (1.0 - fc) * surroundings[r0, c0, c] + fc * surroundings[r0, c1, c]
                lower = (1.0 - fc) * surroundings[r1, c0, c] + fc * surroundings[r1, c1, c]
                mirrored = (1.0 - fr) * upper + fr * lower
                if is_plain:
                    value = colors[face, c] * matt + share * mirrored + shine
                else:
                    value = own[r, col, c] * matt + own[r, col, 3] * (share * mirrored + shine)
                # Highlights roll off towards white, as in a camera.
                out[r, col, c] = value if value < 0.8 else 1.0 - 0.2 * np.exp(-(value - 0.8) / 0.2)
    return out


def _openness(inverse_depth: Array, seen: NDArray[np.float32], fine: Camera, diameter_mm: float) -> NDArray[np.float32]:
    """Ambient occlusion (H,W) in 0.45–1: less light where the surface lies behind its surroundings in the picture.

    Unsharp masking of the depth buffer (Luft et al. 2006), which darkens inner corners and recessed surfaces.
    """
    if not seen.any():
        return seen
    depth = np.where(seen > 0, 1.0 / np.maximum(inverse_depth, 1e-9), 0.0).astype(np.float32)
    sigma = max(2.0, 0.03 * diameter_mm * fine.fx * float(inverse_depth.max()))
    # Smoothed on a coarser grid, because the window is wide.
    shrink = max(1, int(sigma / 4.0))
    small = (max(1, depth.shape[1] // shrink), max(1, depth.shape[0] // shrink))
    parts = [cv2.resize(x, small, interpolation=cv2.INTER_AREA) for x in (depth, seen)]
    parts = [cv2.GaussianBlur(x, (0, 0), sigma / shrink) for x in parts]
    smooth, weight = (cv2.resize(x, depth.shape[::-1], interpolation=cv2.INTER_LINEAR) for x in parts)
    behind = (depth - smooth / np.maximum(weight, 1e-3)) / (0.06 * diameter_mm)
    return np.asarray(np.clip(1.0 - 0.35 * np.clip(behind, 0.0, None), 0.45, 1.0), dtype=np.float32)
