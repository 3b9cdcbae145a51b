"""The ghost: the model rendered by z-buffer in a window around the part, shaded and blended over the frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.cad import Model
from arview.camera import Camera
from arview.core.kernel import kernel
from arview.geometry import Array, apply
from arview.overlay.mesh import Topology
from arview.rendering import rasterise

NEAR_MM = 1.0
"""Geometry nearer to the camera is clipped."""
CELL_PX = 8
"""Cell size of the coverage grid that the label layout uses."""
MAX_ANGLE_DEG = 75.0
"""Of a wide lens the ghost is drawn up to this angle off the axis, which is as far as parts are tracked."""
MAX_IDEAL_PX = 16000.0
"""Coordinates of the picture that such a ghost is rendered in are no larger."""
GAP_OPACITY = 0.2
"""Opacity of a hatched ghost between its lines, relative to that of the lines."""
_WINDOW_MARGIN_PX = 4
"""Margin of the window around the projected part."""


@dataclass(frozen=True)
class GhostView:
    """The model as rendered for one frame.

    Attributes:
        u0, v0: first column and row of the window in the image, px.
        inverse_depth: (h,w) 1/mm, 0 off the part.
        face_ids: (h,w) int32 index into the drawn faces, -1 off the part.
        shade: (D,) float32 of the drawn faces, |cos| of the angle between normal and line of sight.
        components: (D,) int32 component of the drawn faces.
    """

    u0: int
    v0: int
    inverse_depth: NDArray[np.float64]
    face_ids: NDArray[np.int32]
    shade: NDArray[np.float32]
    components: NDArray[np.int32]


class Ghost:
    """Renders a model at a pose, in the window of the image that the part covers.

    With lens distortion the model is rendered with the ideal camera and resampled to the pixels of the real image.
    """

    def __init__(self, model: Model, camera: Camera, shapes: list[Topology]) -> None:
        """Prepare a model, given the topology of each of its components."""
        self.camera = camera
        self._vertices_in_model, self._faces, self._component_of_face = model.mesh
        # Of a closed mesh only faces towards the camera are visible: 1, or -1 if it is wound inside out.
        winding = [(-1 if shape.is_inside_out else 1) if shape.is_closed else 0 for shape in shapes]
        self._winding = np.array(winding, dtype=np.int8)[self._component_of_face]
        self._all_faces = self._faces, self._winding, self._component_of_face
        self._distortion_limit_r2 = _monotone_limit_r2(camera)
        self._ideal_pixels = _ideal_pixels(camera) if camera.is_distorted else None

    def bent(self, points_in_cam: Array) -> Array:
        """Points (N,3) displaced sideways, so that a pinhole camera projects them where the real lens does.

        Beyond the field of view, where the lens polynomial may fold back, the factor of the displacement is kept at its
        value on the border.
        """
        if not self.camera.is_distorted:
            return points_in_cam
        z = points_in_cam[:, 2]
        safe_z = np.where(z > NEAR_MM, z, NEAR_MM)
        x, y = points_in_cam[:, 0] / safe_z, points_in_cam[:, 1] / safe_z
        shrink = np.sqrt(np.minimum(1.0, self._distortion_limit_r2 / np.maximum(x * x + y * y, 1e-12)))
        xd, yd = self.camera.distort(x * shrink, y * shrink)
        return np.stack([xd / shrink * safe_z, yd / shrink * safe_z, z], axis=-1)

    def project(self, points_in_cam: Array) -> Array:
        """Pixels (..., 2) of points (..., 3) in the real image; NaN for points that are not in front of the camera."""
        points = self.bent(points_in_cam.reshape(-1, 3)).reshape(points_in_cam.shape)
        return self.camera.without_distortion().project(points)

    def leave_out(self, is_left_out: NDArray[np.bool_]) -> None:
        """Leave some components (C,) out of the views that follow: they hide nothing, either."""
        faces, winding, component_of_face = self._all_faces
        kept = ~is_left_out[component_of_face]
        self._faces, self._winding, self._component_of_face = faces[kept], winding[kept], component_of_face[kept]

    def view(self, cam_from_model: Array) -> GhostView | None:
        """Render the model at a pose (4,4); None if the part is outside the image."""
        camera = self.camera
        points = apply(cam_from_model, self._vertices_in_model)
        window = _window(self.bent(points), camera)
        if window is None:
            return None
        shade = np.empty(len(self._faces), dtype=np.float32)
        faces, components, count = _faces_to_draw(points, self._faces, self._winding, self._component_of_face, shade)
        u0, v0, u1, v1 = window if self._ideal_pixels is None else self._ideal_window(self._ideal_pixels, window)
        inverse_depth, face_ids = rasterise(
            points,
            faces[:count],
            camera.fx,
            fy=camera.fy,
            cx=camera.cx,
            cy=camera.cy,
            width=u1 - u0,
            height=v1 - v0,
            near_mm=NEAR_MM,
            origin=(u0, v0),
        )
        if self._ideal_pixels is not None:
            inverse_depth, face_ids = _look_up(self._ideal_pixels, window, (u0, v0), inverse_depth, face_ids)
        return GhostView(window[0], window[1], inverse_depth, face_ids, shade[:count], components[:count])

    def _ideal_window(
        self, ideal_pixels: NDArray[np.int16], window: tuple[int, int, int, int]
    ) -> tuple[int, int, int, int]:
        """Window of the ideal image that contains all pixels of a window of the real one."""
        u0, v0, u1, v1 = window
        part = ideal_pixels[v0:v1, u0:u1]
        rim = np.concatenate([part[0], part[-1], part[:, 0], part[:, -1]])
        (low_u, low_v), (high_u, high_v) = rim.min(axis=0), rim.max(axis=0)
        return int(low_u), int(low_v), int(high_u) + 1, int(high_v) + 1


def _window(points: Array, camera: Camera) -> tuple[int, int, int, int] | None:
    """Window (u0, v0, u1, v1) of the image around projected points, end exclusive; None if it is empty."""
    z = points[:, 2]
    in_front = z > NEAR_MM
    if not in_front.any():
        return None
    if not in_front.all():
        return 0, 0, camera.width, camera.height
    u = camera.fx * points[:, 0] / z + camera.cx
    v = camera.fy * points[:, 1] / z + camera.cy
    u0 = int(np.clip(np.floor(u.min()) - _WINDOW_MARGIN_PX, 0, camera.width))
    v0 = int(np.clip(np.floor(v.min()) - _WINDOW_MARGIN_PX, 0, camera.height))
    u1 = int(np.clip(np.ceil(u.max()) + _WINDOW_MARGIN_PX + 1, 0, camera.width))
    v1 = int(np.clip(np.ceil(v.max()) + _WINDOW_MARGIN_PX + 1, 0, camera.height))
    if u1 <= u0 or v1 <= v0:
        return None
    return u0, v0, u1, v1


def _monotone_limit_r2(camera: Camera) -> float:
    """Largest squared normalised radius, up to 1.5 × the corner's, up to which the lens does not fold back."""
    if camera.lens is not None:
        return _lens_limit_r2(camera)
    corners = np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]], dtype=float)
    rays = (corners - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    r2 = np.linspace(0.0, 2.25 * float(np.max(np.sum(rays * rays, axis=1))), 400)
    k1, k2, _, _, k3 = camera.dist
    slope = 1.0 + r2 * (3.0 * k1 + r2 * (5.0 * k2 + r2 * 7.0 * k3))
    folded = np.flatnonzero(slope < 0.05)
    return float(r2[folded[0] - 1] if len(folded) else r2[-1])


def _lens_limit_r2(camera: Camera) -> float:
    """As `_monotone_limit_r2`, for other lens models: up to `MAX_ANGLE_DEG` while all directions go on outwards."""
    r = np.tan(np.radians(np.linspace(0.0, MAX_ANGLE_DEG, 400)))
    turn = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)[:, None]
    with np.errstate(all="ignore"):
        xd, yd = camera.distort(r * np.cos(turn), r * np.sin(turn))
        outwards = np.diff(xd * np.cos(turn) + yd * np.sin(turn), axis=1).min(axis=0)
    folded = np.flatnonzero(~(outwards > 0.0))
    end = int(folded[0]) if len(folded) else len(r) - 1
    return float(r[max(end, 1)] ** 2)


def _ideal_pixels(camera: Camera) -> NDArray[np.int16]:
    """For every pixel of the image, the nearest pixel (H,W,2) u, v of a lens without distortion.

    Computed at nodes CELL_PX apart and interpolated between them.
    """
    nodes_u = np.arange(0, camera.width + CELL_PX, CELL_PX, dtype=np.float64)
    nodes_v = np.arange(0, camera.height + CELL_PX, CELL_PX, dtype=np.float64)
    with np.errstate(all="ignore"):
        rays = camera.unproject(np.stack(np.meshgrid(nodes_u, nodes_v), axis=-1))
        ideal = rays[..., :2] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    # Where the lens model folds back there is no ray; such pixels are kept near the image.
    size = np.array([camera.width, camera.height])
    low, high = -0.5 * size, 1.5 * size
    if camera.lens is not None:
        # A wide lens sees far more than a lens without distortion of the same focal length shows in a picture.
        reach = np.tan(np.radians(MAX_ANGLE_DEG)) * np.array([camera.fx, camera.fy])
        center = np.array([camera.cx, camera.cy])
        low, high = np.minimum(low, center - reach), np.maximum(high, center + reach)
    ideal = np.clip(np.nan_to_num(ideal, nan=-1.0), np.maximum(low, -MAX_IDEAL_PX), np.minimum(high, MAX_IDEAL_PX))
    v, fraction_v = np.divmod(np.arange(camera.height), CELL_PX)
    share_v = (fraction_v / CELL_PX)[:, None, None]
    rows = ideal[v] * (1.0 - share_v) + ideal[v + 1] * share_v
    u, fraction_u = np.divmod(np.arange(camera.width), CELL_PX)
    share_u = (fraction_u / CELL_PX)[:, None]
    pixels: Array = rows[:, u] * (1.0 - share_u) + rows[:, u + 1] * share_u
    return np.round(pixels).astype(np.int16)


@kernel
def _look_up(
    ideal_pixels: NDArray[np.int16],
    window: tuple[int, ...],
    origin: tuple[int, int],
    inverse_depth: NDArray[np.float64],
    face_ids: NDArray[np.int32],
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Inverse depth and faces of a window of the real image, from those of the ideal image."""
    u0, v0, u1, v1 = window
    depth = np.zeros((v1 - v0, u1 - u0))
    faces = np.full((v1 - v0, u1 - u0), -1, dtype=np.int32)
    for row in range(v1 - v0):
        for column in range(u1 - u0):
            u = ideal_pixels[v0 + row, u0 + column, 0] - origin[0]
            v = ideal_pixels[v0 + row, u0 + column, 1] - origin[1]
            if 0 <= u < face_ids.shape[1] and 0 <= v < face_ids.shape[0]:
                depth[row, column] = inverse_depth[v, u]
                faces[row, column] = face_ids[v, u]
    return depth, faces


@kernel(fastmath=True)
def _faces_to_draw(
    points: NDArray[np.float64],
    faces: NDArray[np.int32],
    winding: NDArray[np.int8],
    component_of_face: NDArray[np.int32],
    shade: NDArray[np.float32],
) -> tuple[NDArray[np.int32], NDArray[np.int32], int]:
    """Faces that may be visible (first ``count`` rows), their components, and ``count``; fills ``shade``."""
    kept = np.empty_like(faces)
    components = np.empty_like(component_of_face)
    count = 0
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, az = points[a, 0], points[a, 1], points[a, 2]
        e1x, e1y, e1z = points[b, 0] - ax, points[b, 1] - ay, points[b, 2] - az
        e2x, e2y, e2z = points[c, 0] - ax, points[c, 1] - ay, points[c, 2] - az
        nx, ny, nz = e1y * e2z - e1z * e2y, e1z * e2x - e1x * e2z, e1x * e2y - e1y * e2x
        along = nx * ax + ny * ay + nz * az
        if winding[f] * along > 0:
            continue
        norm = np.sqrt((nx * nx + ny * ny + nz * nz) * (ax * ax + ay * ay + az * az))
        shade[count] = abs(along) / norm if norm > 1e-12 else 0.0
        kept[count, 0], kept[count, 1], kept[count, 2] = a, b, c
        components[count] = component_of_face[f]
        count += 1
    return kept, components, count


@kernel(fastmath=True)
def blend(
    image: NDArray[np.uint8],
    u0: int,
    v0: int,
    face_ids: NDArray[np.int32],
    shade: NDArray[np.float32],
    components: NDArray[np.int32],
    ghost_style: NDArray[np.float32],
    edge_cover: NDArray[np.uint8],
    edge_owner: NDArray[np.int16],
    edge_style: NDArray[np.float32],
    patterns: NDArray[np.int8],
    hatch_px: int,
) -> None:
    """Blend ghost and edges over the image in place.

    ``ghost_style`` and ``edge_style`` are (C,4) float32: r, g, b in 0–255 and alpha in 0–1 of each component;
    ``edge_cover`` (h,w) uint8 and ``edge_owner`` (h,w) int16 are from `Edges.draw`. ``patterns`` (C,) int8: 0 for a
    plain ghost, 1 for one of stripes, 2 for one of crossed lines, ``hatch_px`` apart.
    """
    height, width = face_ids.shape
    for row in range(height):
        for column in range(width):
            face = face_ids[row, column]
            cover = edge_cover[row, column]
            alpha = np.float32(0.0)
            if face >= 0:
                component = components[face]
                alpha = ghost_style[component, 3]
            if alpha == 0 and cover == 0:
                continue
            r = np.float32(image[v0 + row, u0 + column, 0])
            g = np.float32(image[v0 + row, u0 + column, 1])
            b = np.float32(image[v0 + row, u0 + column, 2])
            if alpha > 0:
                # Faces at a grazing angle are a little denser, like glass; faces towards the camera are brighter.
                facing = shade[face]
                pattern = patterns[component]
                if pattern > 0:
                    on = (row + column) % hatch_px < (hatch_px + 1) // (2 * pattern)
                    if pattern == 2:
                        on = on or (row - column) % hatch_px < (hatch_px + 1) // 4
                    if not on:
                        alpha *= np.float32(GAP_OPACITY)
                alpha = min(np.float32(1.0), alpha * (np.float32(1.25) - np.float32(0.35) * facing))
                light = np.float32(0.45) + np.float32(0.55) * facing
                r += alpha * (ghost_style[component, 0] * light - r)
                g += alpha * (ghost_style[component, 1] * light - g)
                b += alpha * (ghost_style[component, 2] * light - b)
            if cover > 0:
                component = edge_owner[row, column]
                alpha = edge_style[component, 3] * cover * np.float32(1.0 / 255.0)
                r += alpha * (edge_style[component, 0] - r)
                g += alpha * (edge_style[component, 1] - g)
                b += alpha * (edge_style[component, 2] - b)
            image[v0 + row, u0 + column, 0] = np.uint8(r + np.float32(0.5))
            image[v0 + row, u0 + column, 1] = np.uint8(g + np.float32(0.5))
            image[v0 + row, u0 + column, 2] = np.uint8(b + np.float32(0.5))


@kernel
def count_cells(
    u0: int,
    v0: int,
    face_ids: NDArray[np.int32],
    components: NDArray[np.int32],
    weight: NDArray[np.float32],
    cells: NDArray[np.float32],
    seen_px: NDArray[np.int64],
) -> None:
    """Add the weighted area (``weight`` (C,) times pixels) to each cell, and the visible pixels to each component.

    Every second pixel of every second row is counted as four.
    """
    height, width = face_ids.shape
    for row in range(0, height, 2):
        for column in range(0, width, 2):
            face = face_ids[row, column]
            if face >= 0:
                component = components[face]
                seen_px[component] += 4
                cells[(v0 + row) // CELL_PX, (u0 + column) // CELL_PX] += 4 * weight[component]
