"""Topology of a component's mesh: faces that share an edge, and whether the mesh encloses a volume."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.cad import Component, edge_faces
from arview.geometry import Array

_WELD_MM = 1e-4
"""Vertices closer than this are merged, because exporters repeat vertices at creases and seams."""


@dataclass(frozen=True)
class Topology:
    """A component's mesh with repeated vertices merged.

    Attributes:
        vertices: (V,3) mm.
        faces: (F,3) faces with an area, wound as in the file.
        normals: (F,3) unit normals, outward if the mesh is closed, else as wound.
        ends: (E,2) vertices of each edge.
        edge_faces: (E,2) the two faces at an edge; the second is -1 at a border or where more than two meet.
        is_closed: all edges have two faces, wound consistently.
        is_inside_out: closed, with all faces wound clockwise seen from outside.
    """

    vertices: Array
    faces: NDArray[np.int64]
    normals: Array
    ends: NDArray[np.int64]
    edge_faces: NDArray[np.int64]
    is_closed: bool
    is_inside_out: bool


def topology(component: Component) -> Topology:
    """Merge a component's vertices and find its edges."""
    keys = np.round(component.vertices_in_model / _WELD_MM).astype(np.int64)
    _, first, welded = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    vertices = component.vertices_in_model[first]
    faces = welded.reshape(-1)[component.faces]
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    solid = area > 1e-9
    faces, corners, cross = faces[solid], corners[solid], cross[solid]
    normals = cross / area[solid][:, None]

    edges = edge_faces(faces)
    starts = faces.ravel()[edges.sides]
    is_closed = len(faces) > 0 and bool(np.all((edges.face_count == 2) & (starts[:, 0] != starts[:, 1])))
    is_inside_out = is_closed and float(np.sum(corners[:, 0] * cross)) < 0.0
    joined = edges.faces.copy()
    joined[edges.face_count != 2, 1] = -1
    return Topology(
        vertices, faces, -normals if is_inside_out else normals, edges.ends, joined, is_closed, is_inside_out
    )


def anchor_in_model(component: Component, shape: Topology) -> Array:
    """Point (3,) of a component to which its label points; it projects onto the component from all directions.

    The centroid of the surface if it lies inside the solid (winding number by solid angles: van Oosterom and Strackee,
    IEEE TBME 1983), else the surface point nearest to it.
    """
    corners = component.vertices_in_model[component.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    center = area @ corners.mean(axis=1) / max(float(area.sum()), 1e-12)
    if shape.is_closed:
        a, b, c = (corners - center).transpose(1, 0, 2)
        la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
        volume = np.sum(a * np.cross(b, c), axis=1)
        below = la * lb * lc + np.sum(a * b, axis=1) * lc
        below = below + np.sum(b * c, axis=1) * la + np.sum(c * a, axis=1) * lb
        if abs(np.arctan2(volume, below).sum()) > np.pi:
            return np.asarray(center)
    for _ in range(2):
        middles = 0.5 * (corners + np.roll(corners, -1, axis=1))
        thirds = (np.stack([corners[:, k], middles[:, k], middles[:, k - 1]], axis=1) for k in range(3))
        corners = np.concatenate([middles, *thirds])
    centroids = corners.mean(axis=1)
    return np.asarray(centroids[np.argmin(np.linalg.norm(centroids - center, axis=1))])
