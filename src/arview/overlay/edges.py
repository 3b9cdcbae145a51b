"""Feature edges of a model: creases are found once, silhouettes per pose; hidden edges are removed by z-buffer.

The silhouette of a mesh are the edges between a face towards the camera and one away from it (Isenberg et al., "A
developer's guide to silhouette algorithms", IEEE CG&A 2003). Lines are rasterised along their major axis, with pixels
weighted by their distance from the line (Gupta and Sproull, SIGGRAPH 1981).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.geometry import Array, apply, invert
from arview.overlay.ghost import NEAR_MM, Ghost, GhostView
from arview.overlay.mesh import Topology

_CREASE_COS = float(np.cos(np.deg2rad(30.0)))
"""Cosine of the angle above which two faces form a crease."""
_FLAT_COS = float(np.cos(np.deg2rad(0.05)))
"""Cosine of the angle below which two faces are coplanar: no silhouette can lie between them."""
_HIDDEN_COVER = 0.4
"""Opacity of a hidden edge, relative to a visible one."""
_DASH_PX = 5
"""Length of the dashes of hidden edges, and of the gaps between them."""


class Edges:
    """The edges of a model that may be drawn: creases, open borders and candidates for the silhouette."""

    def __init__(self, shapes: list[Topology], pieces_mm: float | None = None) -> None:
        """Edges of one topology per component; cut into pieces of ``pieces_mm`` if the lens distorts."""
        points, normals, face_points, ends, faces, creases, closed, owners = [], [], [], [], [], [], [], []
        vertex_offset = face_offset = 0
        for index, shape in enumerate(shapes):
            cosine = np.sum(shape.normals[shape.edge_faces[:, 0]] * shape.normals[shape.edge_faces[:, 1]], axis=1)
            is_crease = (shape.edge_faces[:, 1] < 0) | (cosine < _CREASE_COS)
            keep = is_crease | (cosine < _FLAT_COS)
            points.append(shape.vertices)
            normals.append(shape.normals)
            face_points.append(shape.vertices[shape.faces[:, 0]])
            ends.append(shape.ends[keep] + vertex_offset)
            faces.append(np.where(shape.edge_faces >= 0, shape.edge_faces + face_offset, -1)[keep])
            creases.append(is_crease[keep])
            closed.append(np.full(int(keep.sum()), shape.is_closed))
            owners.append(np.full(int(keep.sum()), index, dtype=np.int16))
            vertex_offset += len(shape.vertices)
            face_offset += len(shape.faces)
        self._points, self._normals = np.concatenate(points), np.concatenate(normals)
        self._face_points = np.concatenate(face_points)
        self._ends, self._faces = np.concatenate(ends), np.concatenate(faces)
        self._is_crease, self._is_closed = np.concatenate(creases), np.concatenate(closed)
        self._owner = np.concatenate(owners)
        self._components = len(shapes)
        if pieces_mm is not None:
            self._split(pieces_mm)

    def _split(self, longest_mm: float) -> None:
        """Cut edges into pieces no longer than ``longest_mm``, so that they can follow the distortion."""
        a, b = self._points[self._ends[:, 0]], self._points[self._ends[:, 1]]
        pieces = np.maximum(1, np.ceil(np.linalg.norm(b - a, axis=1) / longest_mm)).astype(np.int64)
        edge = np.repeat(np.arange(len(pieces)), pieces)
        step = np.arange(len(edge)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
        span = (b - a)[edge] / pieces[edge][:, None]
        start = a[edge] + step[:, None] * span
        self._points = np.concatenate([start, start + span])
        self._ends = np.stack([np.arange(len(edge)), np.arange(len(edge)) + len(edge)], axis=1)
        self._faces = self._faces[edge]
        self._is_crease, self._is_closed = self._is_crease[edge], self._is_closed[edge]
        self._owner = self._owner[edge]

    def draw(
        self,
        ghost: Ghost,
        view: GhostView,
        cam_from_model: Array,
        width_px: float,
        with_hidden: bool,
        dashed: NDArray[np.bool_] | None = None,
    ) -> tuple[NDArray[np.uint8], NDArray[np.int16]]:
        """Rasterise the edges in the window of a view; ``dashed`` (C,) tells the components with dashed edges.

        Returns:
            coverage (h,w) 0–255, and index (h,w) of the component that each edge belongs to.
        """
        camera = ghost.camera
        eye_in_model = invert(cam_from_model)[:3, 3]
        points = ghost.bent(apply(cam_from_model, self._points))
        cover = np.zeros(view.face_ids.shape, dtype=np.uint8)
        owner = np.zeros(view.face_ids.shape, dtype=np.int16)
        if dashed is None:
            dashed = np.zeros(self._components, dtype=np.bool_)
        dash_px = round(2.0 + 3.0 * width_px)
        _draw_edges(
            points,
            self._ends,
            self._faces,
            is_crease=self._is_crease,
            is_closed=self._is_closed,
            owners=self._owner,
            normals=self._normals,
            face_points=self._face_points,
            eye=eye_in_model,
            fx=camera.fx,
            fy=camera.fy,
            cx=camera.cx - view.u0,
            cy=camera.cy - view.v0,
            inverse_depth=view.inverse_depth,
            width_px=width_px,
            with_hidden=with_hidden,
            dashed=dashed,
            dash_px=dash_px,
            cover=cover,
            owner=owner,
        )
        return cover, owner


@kernel(fastmath=True)
def _faces_camera(
    normals: NDArray[np.float64], face_points: NDArray[np.float64], eye: NDArray[np.float64], face: int
) -> bool:
    return (
        normals[face, 0] * (eye[0] - face_points[face, 0])
        + normals[face, 1] * (eye[1] - face_points[face, 1])
        + normals[face, 2] * (eye[2] - face_points[face, 2])
    ) > 0.0


@kernel(fastmath=True)
def _is_visible(column: int, row: int, limit: float, inverse_depth: NDArray[np.float64]) -> bool:
    """Whether some surface within one pixel is no nearer than the inverse depth ``limit``."""
    height, width = inverse_depth.shape
    if 0 <= row < height and 0 <= column < width and inverse_depth[row, column] <= limit:
        return True
    for r in range(max(0, row - 1), min(height, row + 2)):
        for c in range(max(0, column - 1), min(width, column + 2)):
            if inverse_depth[r, c] <= limit:
                return True
    return False


@kernel(fastmath=True)
def _draw_edges(
    points: NDArray[np.float64], ends: NDArray[np.int64], faces: NDArray[np.int64], is_crease: NDArray[np.bool_],
    is_closed: NDArray[np.bool_], owners: NDArray[np.int16], normals: NDArray[np.float64],
    face_points: NDArray[np.float64], eye: NDArray[np.float64], fx: float, fy: float, cx: float, cy: float,
    inverse_depth: NDArray[np.float64], width_px: float, with_hidden: bool, dashed: NDArray[np.bool_], dash_px: int,
    cover: NDArray[np.uint8], owner: NDArray[np.int16]
) -> None:  # fmt: skip
    height, width = inverse_depth.shape
    # One pixel of tolerance, in the image and in depth, keeps edges complete on faces at a grazing angle.
    slack = 1.0 / (1.0 - 1.0 / fx - 5e-4)
    for edge in range(ends.shape[0]):
        front_a = _faces_camera(normals, face_points, eye, faces[edge, 0])
        front_b = front_a
        if faces[edge, 1] >= 0:
            front_b = _faces_camera(normals, face_points, eye, faces[edge, 1])
        if not is_crease[edge] and front_a == front_b:
            continue
        surely_hidden = is_closed[edge] and not front_a and not front_b
        if surely_hidden and not with_hidden:
            continue

        i, j = ends[edge, 0], ends[edge, 1]
        x0, y0, z0 = points[i, 0], points[i, 1], points[i, 2]
        x1, y1, z1 = points[j, 0], points[j, 1], points[j, 2]
        if z0 <= NEAR_MM and z1 <= NEAR_MM:
            continue
        if z0 <= NEAR_MM:
            t = (NEAR_MM - z0) / (z1 - z0)
            x0, y0, z0 = x0 + t * (x1 - x0), y0 + t * (y1 - y0), NEAR_MM
        elif z1 <= NEAR_MM:
            t = (NEAR_MM - z1) / (z0 - z1)
            x1, y1, z1 = x1 + t * (x0 - x1), y1 + t * (y0 - y1), NEAR_MM
        u0, v0, w0 = fx * x0 / z0 + cx, fy * y0 / z0 + cy, 1.0 / z0
        u1, v1, w1 = fx * x1 / z1 + cx, fy * y1 / z1 + cy, 1.0 / z1

        # (a, b): along the major axis and across it.
        steep = abs(v1 - v0) > abs(u1 - u0)
        a0, b0, a1, b1 = (v0, u0, v1, u1) if steep else (u0, v0, u1, v1)
        a_size, b_size = (height, width) if steep else (width, height)
        if a0 > a1:
            a0, b0, w0, a1, b1, w1 = a1, b1, w1, a0, b0, w0
        length = np.sqrt((a1 - a0) ** 2 + (b1 - b0) ** 2)
        cosine = (a1 - a0) / length if length > 1e-9 else 1.0
        reach = (0.5 * width_px + 0.5) / cosine
        is_dashed = dashed[owners[edge]]
        first = int(np.round(max(a0, -1.0)))
        last = int(np.round(min(a1, a_size + 1.0)))
        for a in range(max(first, 0), min(last, a_size - 1) + 1):
            if is_dashed and (a // dash_px) % 2 == 1:
                continue
            t = (a - a0) / (a1 - a0) if a1 - a0 > 1e-9 else 0.0
            t = min(1.0, max(0.0, t))
            b = b0 + t * (b1 - b0)
            if b < -reach or b > b_size - 1 + reach:
                continue
            w = w0 + t * (w1 - w0)
            nearest = int(np.round(b))
            strength = 1.0
            column, row = (nearest, a) if steep else (a, nearest)
            if surely_hidden or not _is_visible(column, row, w * slack, inverse_depth):
                if not with_hidden or (a // _DASH_PX) % 2 == 1:
                    continue
                strength = _HIDDEN_COVER
            for k in range(max(0, int(np.ceil(b - reach))), min(b_size - 1, int(np.floor(b + reach))) + 1):
                weight = min(1.0, 0.5 * width_px + 0.5 - abs(k - b) * cosine)
                value = int(255.0 * strength * weight)
                r, c = (a, k) if steep else (k, a)
                if value > cover[r, c]:
                    cover[r, c] = value
                    owner[r, c] = owners[edge]
