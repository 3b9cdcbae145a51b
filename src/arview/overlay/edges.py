"""Feature edges of a model: creases found once, silhouettes found per pose, hidden parts removed by z-buffer.

Silhouette of a mesh: edges between a face that looks at the camera and one that looks away (e.g. Isenberg
et al., "A developer's guide to silhouette algorithms", IEEE CG&A 2003). Lines are drawn by walking along the
major axis and weighing pixels by their distance from the line (Gupta & Sproull, SIGGRAPH 1981).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from arview.cad.model import Component, Model
from arview.geometry import Array, apply, invert
from arview.overlay.ghost import NEAR_MM, Ghost, GhostView

_CREASE_COS = float(np.cos(np.deg2rad(30.0)))
"""Faces that meet at a larger angle form a crease."""
_FLAT_COS = float(np.cos(np.deg2rad(0.05)))
"""Faces that meet at a smaller angle lie in one plane: no silhouette can run between them."""
_WELD_MM = 1e-4
"""Vertices closer than this are one: exporters repeat vertices at creases and seams."""
_HIDDEN_COVER = 0.4
"""Strength of a hidden edge against a visible one."""
_DASH_PX = 5


class Edges:
    """The edges of a model worth drawing: creases, open borders and candidates for the silhouette."""

    def __init__(self, model: Model, pieces_mm: float | None = None) -> None:
        parts = [_component_edges(component) for component in model.components]
        offsets_v = np.cumsum([0, *(len(part.vertices) for part in parts)])
        offsets_f = np.cumsum([0, *(len(part.normals) for part in parts)])
        self._points = np.concatenate([part.vertices for part in parts])
        self._normals = np.concatenate([part.normals for part in parts])
        self._face_points = np.concatenate([part.face_points for part in parts])
        self._ends = np.concatenate(
            [part.ends + offset for part, offset in zip(parts, offsets_v, strict=False)]
        )
        self._faces = np.concatenate(
            [
                np.where(part.faces >= 0, part.faces + offset, -1)
                for part, offset in zip(parts, offsets_f, strict=False)
            ]
        )
        self._is_crease = np.concatenate([part.is_crease for part in parts])
        self._is_closed = np.concatenate([np.full(len(part.ends), part.is_closed) for part in parts])
        self._owner = np.concatenate(
            [np.full(len(part.ends), i, dtype=np.int16) for i, part in enumerate(parts)]
        )
        if pieces_mm is not None:
            self._split(pieces_mm)

    def _split(self, longest_mm: float) -> None:
        """Cut edges into pieces no longer than ``longest_mm``, so that distortion can bend them."""
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
        self, ghost: Ghost, view: GhostView, cam_from_model: Array, width_px: float, with_hidden: bool
    ) -> tuple[NDArray[np.uint8], NDArray[np.int16]]:
        """Edges in the window of ``view``: coverage (h,w) 0–255 and index of the owning component (h,w)."""
        camera = ghost.camera
        eye_in_model = invert(cam_from_model)[:3, 3]
        points = ghost.bent(apply(cam_from_model, self._points))
        cover = np.zeros(view.face_ids.shape, dtype=np.uint8)
        owner = np.zeros(view.face_ids.shape, dtype=np.int16)
        _draw_edges(
            points, self._ends, self._faces, self._is_crease, self._is_closed, self._owner,
            self._normals, self._face_points, eye_in_model,
            camera.fx, camera.fy, camera.cx - view.u0, camera.cy - view.v0,
            view.inverse_depth, width_px, with_hidden, cover, owner,
        )  # fmt: skip
        return cover, owner


@dataclass(frozen=True)
class _ComponentEdges:
    """Edges of one component.

    ``vertices`` (V,3) welded, mm; ``normals`` and ``face_points`` (F,3); ``ends`` (E,2) vertex indices;
    ``faces`` (E,2) the faces at each edge, -1 for none; ``is_crease`` (E,).
    """

    vertices: Array
    normals: Array
    face_points: Array
    ends: NDArray[np.int64]
    faces: NDArray[np.int64]
    is_crease: NDArray[np.bool_]
    is_closed: bool


def _component_edges(component: Component) -> _ComponentEdges:
    keys = np.round(component.vertices_in_model / _WELD_MM).astype(np.int64)
    _, first, welded = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    vertices = component.vertices_in_model[first]
    faces = welded.reshape(-1)[component.faces]
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    solid = area > 1e-9
    faces, corners, cross, area = faces[solid], corners[solid], cross[solid], area[solid]
    normals = cross / area[:, None]

    half = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    face_of_half = np.tile(np.arange(len(faces)), 3)
    ends, edge_of_half, count = np.unique(
        np.sort(half, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    order = np.argsort(edge_of_half.reshape(-1), kind="stable")
    start = np.cumsum(count) - count
    face_a = face_of_half[order[start]]
    face_b = np.where(count == 2, face_of_half[order[np.minimum(start + 1, len(order) - 1)]], -1)
    cosine = np.sum(normals[face_a] * normals[face_b], axis=1)
    is_crease = (count != 2) | (cosine < _CREASE_COS)
    keep = is_crease | (cosine < _FLAT_COS)
    is_closed = bool(np.all(count == 2))
    if is_closed and np.sum(corners[:, 0] * cross) < 0:
        normals = -normals  # wound inside out
    return _ComponentEdges(
        vertices,
        normals,
        corners[:, 0],
        ends[keep],
        np.stack([face_a, face_b], axis=1)[keep],
        is_crease[keep],
        is_closed,
    )


@njit(cache=True, nogil=True, fastmath=True)
def _faces_camera(normals, face_points, eye, face):  # type: ignore[no-untyped-def]
    return (
        normals[face, 0] * (eye[0] - face_points[face, 0])
        + normals[face, 1] * (eye[1] - face_points[face, 1])
        + normals[face, 2] * (eye[2] - face_points[face, 2])
    ) > 0.0


@njit(cache=True, nogil=True, fastmath=True)
def _is_visible(column, row, w, focal_px, inverse_depth):  # type: ignore[no-untyped-def]
    """True when the farthest surface within one pixel is not nearer than the point at inverse depth ``w``.

    One pixel of slack, in the image and in depth, keeps edges whole on faces seen at a grazing angle.
    """
    height, width = inverse_depth.shape
    z = 1.0 / w
    limit = 1.0 / (z - z / focal_px - 5e-4 * z)
    for r in range(max(0, row - 1), min(height, row + 2)):
        for c in range(max(0, column - 1), min(width, column + 2)):
            if inverse_depth[r, c] <= limit:
                return True
    return False


@njit(cache=True, nogil=True, fastmath=True)
def _draw_edges(  # type: ignore[no-untyped-def]
    points, ends, faces, is_crease, is_closed, owners, normals, face_points, eye,
    fx, fy, cx, cy, inverse_depth, width_px, with_hidden, cover, owner,
):  # fmt: skip
    height, width = inverse_depth.shape
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
        first = int(np.round(max(a0, -1.0)))
        last = int(np.round(min(a1, a_size + 1.0)))
        for a in range(max(first, 0), min(last, a_size - 1) + 1):
            t = (a - a0) / (a1 - a0) if a1 - a0 > 1e-9 else 0.0
            t = min(1.0, max(0.0, t))
            b = b0 + t * (b1 - b0)
            if b < -reach or b > b_size - 1 + reach:
                continue
            w = w0 + t * (w1 - w0)
            nearest = int(np.round(b))
            strength = 1.0
            column, row = (nearest, a) if steep else (a, nearest)
            if surely_hidden or not _is_visible(column, row, w, fx, inverse_depth):
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
