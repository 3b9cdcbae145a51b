"""Line drawings of components in a parallel view: outlines and creases that are not hidden, in mm of the drawing plane.

An edge is drawn where one of its faces is turned to the viewer and the other is not, or where the two meet at an angle
(Appel 1967); what lies behind something is found with a z-buffer.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.cad import Component, make_model
from arview.geometry import Array
from arview.rendering import rasterise
from arview.rendering.mesh_edges import mesh_edges

Window = tuple[float, float, float, float]
"""Left, lower, right and upper edge in the drawing plane, mm."""


@dataclass(frozen=True)
class ParallelView:
    """A view without perspective.

    Attributes:
        origin_in_model: (3,) point at (0, 0) of the drawing plane, mm.
        axes: (3,3) orthonormal rows in the model: right, up, and towards the viewer.
        words: from where it is seen.
    """

    origin_in_model: Array
    axes: Array
    words: str

    def to_plane(self, points_in_model: Array) -> Array:
        """(N,3) right, up and height above the plane, mm, of points (N,3)."""
        return np.asarray((points_in_model - self.origin_in_model) @ self.axes.T)


CREASE_DEG = 30.0
"""Angle between two faces above which their edge is drawn."""
PIXELS = 900
"""Pixels of the z-buffer along the longer side of a window."""
STEP_PX = 2.0
"""Distance of the points at which an edge is tested."""
MAX_FACES = 400_000
"""Faces; of components with more only the bounding box is drawn."""


def visible_lines(
    shown: Sequence[Component],
    hiding: Sequence[Component],
    view: ParallelView,
    window: Window,
) -> list[Array]:
    """Polylines (K,2), mm in the drawing plane, of what is visible of components in a window.

    Args:
        shown: components that are drawn.
        hiding: components behind which lines are hidden; those shown as well, for a drawing as it is seen.
        view: the view.
        window: part of the plane; lines that leave it are not cut exactly.
    """
    pitch = max(window[2] - window[0], window[3] - window[1]) / PIXELS
    heights = _heights(hiding, view, window, pitch)
    lines = []
    for component in shown:
        if not _touches(component, view, window):
            continue
        if len(component.faces) > MAX_FACES:
            low, high = view.to_plane(component.vertices_in_model)[:, :2].min(0), None
            high = view.to_plane(component.vertices_in_model)[:, :2].max(0)
            lines.append(np.array([low, [high[0], low[1]], high, [low[0], high[1]], low]))
            continue
        starts, ends = _drawn_edges(component, view)
        lines += _chained(_visible_pieces(starts, ends, heights, window, pitch))
    return lines


def _touches(component: Component, view: ParallelView, window: Window) -> bool:
    corners = np.array(np.meshgrid(*component.bounds_in_model.T)).reshape(3, -1).T
    flat = view.to_plane(corners)[:, :2]
    low, high = flat.min(axis=0), flat.max(axis=0)
    return bool(low[0] <= window[2] and high[0] >= window[0] and low[1] <= window[3] and high[1] >= window[1])


def _drawn_edges(component: Component, view: ParallelView) -> tuple[Array, Array]:
    """Ends (N,3) of the edges that are outlines or creases turned to the viewer, in the drawing plane."""
    edges = mesh_edges(make_model(component.name, (component,)), CREASE_DEG)
    facing = edges.face_normals @ view.axes[2]
    is_open = edges.faces[:, 1] < 0
    first = facing[edges.faces[:, 0]] > 1e-4
    second = np.where(is_open, False, facing[edges.faces[:, 1]] > 1e-4)
    is_drawn = (first != second) | is_open | (edges.is_crease & (first | second))
    flat = view.to_plane(edges.vertices_in_model)
    starts, ends = flat[edges.ends[is_drawn, 0]], flat[edges.ends[is_drawn, 1]]
    has_length = np.linalg.norm((ends - starts)[:, :2], axis=1) > 1e-6
    return starts[has_length], ends[has_length]


def _heights(components: Sequence[Component], view: ParallelView, window: Window, pitch: float) -> Array:
    """(H,W) height of the uppermost surface above the plane, -inf where there is none; one pixel around the window."""
    width = int(np.ceil((window[2] - window[0]) / pitch)) + 3
    height = int(np.ceil((window[3] - window[1]) / pitch)) + 3
    found = np.full((height, width), -np.inf)
    for component in components:
        if not _touches(component, view, window):
            continue
        flat = view.to_plane(component.vertices_in_model)
        # From so far away the perspective moves nothing by more than a thousandth of a pixel.
        far = 1e4 * max(float(np.abs(flat).max()), width * pitch)
        points = np.stack([flat[:, 0] - window[0] + pitch, flat[:, 1] - window[1] + pitch, far - flat[:, 2]], axis=1)
        inverse, _ = rasterise(
            points,
            component.faces,
            far / pitch,
            fy=far / pitch,
            cx=0.0,
            cy=0.0,
            width=width,
            height=height,
            near_mm=1.0,
        )
        with np.errstate(divide="ignore"):
            found = np.maximum(found, far - 1.0 / inverse)
    return found


def _visible_pieces(
    starts: Array, ends: Array, heights: Array, window: Window, pitch: float
) -> list[tuple[Array, Array]]:
    """The pieces of edges that are not hidden, as pairs of points (2,)."""
    pieces: list[tuple[Array, Array]] = []
    if not len(starts):
        return pieces
    tolerance = 2.0 * pitch + 0.02
    counts = np.maximum(1, np.ceil(np.linalg.norm((ends - starts)[:, :2], axis=1) / (STEP_PX * pitch))).astype(int)
    owner = np.repeat(np.arange(len(counts)), counts)
    place = (np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts) + 0.5) / counts[owner]
    points = starts[owner] + place[:, None] * (ends - starts)[owner]
    column = np.round((points[:, 0] - window[0]) / pitch + 1.0).astype(int)
    row = np.round((points[:, 1] - window[1]) / pitch + 1.0).astype(int)
    inside = (column > 0) & (row > 0) & (column < heights.shape[1] - 1) & (row < heights.shape[0] - 1)
    lowest = np.full(len(points), np.inf)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            around = heights[np.clip(row + dy, 0, heights.shape[0] - 1), np.clip(column + dx, 0, heights.shape[1] - 1)]
            lowest = np.minimum(lowest, around)
    seen = inside & (points[:, 2] >= lowest - tolerance)
    for edge in np.unique(owner[seen]):
        mine = seen[owner == edge]
        padded = np.concatenate([[False], mine, [False]])
        changes = np.flatnonzero(padded[1:] != padded[:-1])
        for begin, stop in zip(changes[::2], changes[1::2], strict=True):
            low, high = begin / len(mine), stop / len(mine)
            arm = (ends[edge] - starts[edge])[:2]
            pieces.append((starts[edge, :2] + low * arm, starts[edge, :2] + high * arm))
    return pieces


def _chained(pieces: Sequence[tuple[Array, Array]]) -> list[Array]:
    """Pieces joined to polylines where exactly two meet, so that dashes run through; equal pieces are drawn once."""
    keys: dict[tuple[int, int], list[int]] = defaultdict(list)
    points: dict[tuple[int, int], Array] = {}
    unique: dict[frozenset[tuple[int, int]], tuple[tuple[int, int], tuple[int, int]]] = {}
    for start, end in pieces:
        ends = _key(start), _key(end)
        points[ends[0]], points[ends[1]] = start, end
        if ends[0] != ends[1]:
            unique[frozenset(ends)] = ends
    segments = list(unique.values())
    for index, ends in enumerate(segments):
        for key in ends:
            keys[key].append(index)
    used: NDArray[np.bool_] = np.zeros(len(segments), dtype=bool)
    lines = []
    begins = [key for key, meeting in keys.items() if len(meeting) != 2] + list(keys)
    for begin in begins:
        for index in keys[begin]:
            if used[index]:
                continue
            line, here = [begin], begin
            step: int | None = index
            while step is not None:
                used[step] = True
                first, second = segments[step]
                here = second if here == first else first
                line.append(here)
                following = [one for one in keys[here] if not used[one]]
                step = following[0] if len(keys[here]) == 2 and following else None
            lines.append(np.array([points[key] for key in line]))
    return lines


def _key(point: Array) -> tuple[int, int]:
    return round(float(point[0]) * 1e4), round(float(point[1]) * 1e4)
