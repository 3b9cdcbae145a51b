"""Edges of a triangle mesh, and samples along those that are visible in one view.

An edge is a crease when its two faces meet at more than a threshold, and a silhouette when one of them faces the
camera and the other does not (Appel 1967; Gooch et al. 1999). Hidden samples are removed by a depth test.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.cad import Model
from arview.core.kernel import kernel
from arview.geometry import Array

EDGE_CONTOUR = 1
"""Kind bit: the sample borders the background."""
EDGE_CREASE = 2
"""Kind bit: the two faces meet at an angle."""
EDGE_SILHOUETTE = 4
"""Kind bit: one face is turned away from the camera, or the edge is open."""
EDGE_SHARP = 8
"""Kind bit: a crease too sharp to be between two facets of a curved surface: an edge of the design."""
SHARP_ANGLE_DEG = 50.0
"""Dihedral angle above which a crease is sharp."""


@dataclass(frozen=True)
class MeshEdges:
    """The unique edges of a model; touching components keep edges of their own.

    Attributes:
        vertices_in_model: (V,3) mm.
        ends: (E,2) vertex indices.
        faces: (E,2) adjacent faces, the second -1 for an open edge.
        is_crease: (E,) dihedral angle above the threshold, or open, or shared by more than two faces.
        is_sharp: (E,) dihedral angle above SHARP_ANGLE_DEG, or open.
        face_normals: (F,3) unit normals.
        component: (E,) component index.
    """

    vertices_in_model: Array
    ends: NDArray[np.int32]
    faces: NDArray[np.int32]
    is_crease: NDArray[np.bool_]
    is_sharp: NDArray[np.bool_]
    face_normals: Array
    component: NDArray[np.int32]


def mesh_edges(model: Model, crease_angle_deg: float = 30.0) -> MeshEdges:
    """The edges of all components of a model, with vertices within a micrometre merged.

    In models smaller than a centimetre it is a ten-thousandth of the diameter.
    """
    vertices, faces, component_of_face = model.mesh
    # Vertices are merged inside a component only: components that touch keep their own outlines.
    owner = np.zeros(len(vertices), dtype=np.int64)
    owner[faces.ravel()] = np.repeat(component_of_face, 3)
    keys = np.concatenate(
        [np.round(vertices * max(1000.0, 1e4 / model.diameter_mm)).astype(np.int64), owner[:, None]], axis=1
    )
    _, first, welded = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    faces = first[welded.ravel()][faces].astype(np.int32)
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    keep = length > 1e-12
    faces, normals, component_of_face = (
        faces[keep],
        normals[keep] / length[keep, None],
        component_of_face[keep],
    )

    half = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    face_of_half = np.tile(np.arange(len(faces)), 3)
    half_sorted = np.sort(half, axis=1)
    order = np.lexsort((half_sorted[:, 1], half_sorted[:, 0]))
    half_sorted, face_of_half = half_sorted[order], face_of_half[order]
    start = np.flatnonzero(np.r_[True, np.any(half_sorted[1:] != half_sorted[:-1], axis=1)])
    count = np.diff(np.r_[start, len(half_sorted)])
    ends = half_sorted[start]
    face_a = face_of_half[start]
    face_b = np.where(count >= 2, face_of_half[np.minimum(start + 1, len(face_of_half) - 1)], -1)
    cosine = np.einsum("ij,ij->i", normals[face_a], normals[np.maximum(face_b, 0)])
    is_crease = (count != 2) | (cosine < np.cos(np.deg2rad(crease_angle_deg)))
    return MeshEdges(
        vertices_in_model=vertices,
        ends=np.ascontiguousarray(ends, dtype=np.int32),
        faces=np.ascontiguousarray(np.stack([face_a, face_b], axis=1), dtype=np.int32),
        is_crease=is_crease,
        is_sharp=(count != 2) | (cosine < np.cos(np.deg2rad(SHARP_ANGLE_DEG))),
        face_normals=np.ascontiguousarray(normals),
        component=component_of_face[face_a].astype(np.int32),
    )


@kernel
def facing(
    eye: NDArray[np.float64], point: NDArray[np.float64], normals: NDArray[np.float64], first: int, second: int
) -> tuple[float, float]:
    """How far the two faces at an edge are turned to the eye.

    Args:
        eye: (3,) the camera's centre.
        point: (3,) any point of the edge.
        normals: (F,3) unit normals of the faces.
        first, second: indices of the two faces; the second is -1 at an open edge.

    Returns:
        for each face the distance of the eye from its plane, positive on the side of the normal; 0 for no face.
    """
    front0 = 0.0
    front1 = 0.0
    for k in range(3):
        front0 += normals[first, k] * (eye[k] - point[k])
        if second >= 0:
            front1 += normals[second, k] * (eye[k] - point[k])
    return front0, front1


@kernel
def _to_cam(
    rotation: NDArray[np.float64], translation: NDArray[np.float64], point: NDArray[np.float64]
) -> tuple[float, float, float]:
    """Coordinates of a point (3,) in the camera frame."""
    x = rotation[0, 0] * point[0] + rotation[0, 1] * point[1] + rotation[0, 2] * point[2] + translation[0]
    y = rotation[1, 0] * point[0] + rotation[1, 1] * point[1] + rotation[1, 2] * point[2] + translation[1]
    z = rotation[2, 0] * point[0] + rotation[2, 1] * point[1] + rotation[2, 2] * point[2] + translation[2]
    return x, y, z


@kernel
def _depth_test(depth: NDArray[np.float32], column: int, row: int, z: float, tolerance: float) -> tuple[bool, bool]:
    """Compare a depth with the 3×3 pixels around a place: is any of them as deep, is any of them background?"""
    is_visible = False
    is_contour = False
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            d = depth[row + dy, column + dx]
            if d <= 0:
                is_contour = True
            elif z - d < tolerance and d - z < tolerance:
                is_visible = True
    return is_visible, is_contour


@kernel
def _sample_visible(
    vertices: NDArray[np.float64], ends: NDArray[np.int32], faces: NDArray[np.int32], is_crease: NDArray[np.bool_],
    is_sharp: NDArray[np.bool_], normals: NDArray[np.float64], component: NDArray[np.int32],
    cam_from_model: NDArray[np.float64], fx: float, fy: float, cx: float, cy: float, depth: NDArray[np.float32],
    spacing_px: float, depth_tolerance: float
) -> tuple[NDArray[Any], ...]:  # fmt: skip
    """The kernel of `sample_visible_edges`; returns the arrays of `ViewEdgeSamples` in their order."""
    height, width = depth.shape
    rotation = cam_from_model[:3, :3]
    translation = cam_from_model[:3, 3]
    eye = np.empty(3)
    for k in range(3):
        eye[k] = -(rotation[0, k] * translation[0] + rotation[1, k] * translation[1] + rotation[2, k] * translation[2])
    capacity = 4096
    points = np.empty((capacity, 3))
    pixels = np.empty((capacity, 2))
    tangents = np.empty((capacity, 3))
    lengths = np.empty(capacity)
    kinds = np.empty(capacity, dtype=np.uint8)
    owners = np.empty(capacity, dtype=np.int32)
    found = 0
    carry = 0.5
    for e in range(ends.shape[0]):
        a = vertices[ends[e, 0]]
        b = vertices[ends[e, 1]]
        f0, f1 = faces[e, 0], faces[e, 1]
        front0, front1 = facing(eye, a, normals, f0, f1)
        silhouette = f1 < 0 or (front0 > 0) != (front1 > 0)
        crease = is_crease[e] and (front0 > 0 or front1 > 0)
        if not (silhouette or crease):
            continue
        ax, ay, az = _to_cam(rotation, translation, a)
        bx, by, bz = _to_cam(rotation, translation, b)
        if min(az, bz) < min(1.0, depth_tolerance):
            continue
        du = fx * (bx / bz - ax / az)
        dv = fy * (by / bz - ay / az)
        length = np.sqrt(du * du + dv * dv)
        count_real = length / spacing_px + carry
        count = int(count_real)
        carry = count_real - count
        for i in range(count):
            t = (i + 0.5) / count
            z = az + t * (bz - az)
            u = fx * (ax + t * (bx - ax)) / z + cx
            v = fy * (ay + t * (by - ay)) / z + cy
            iu, iv = int(np.round(u)), int(np.round(v))
            if iu < 1 or iv < 1 or iu >= width - 1 or iv >= height - 1:
                continue
            is_visible, is_contour = _depth_test(depth, iu, iv, z, depth_tolerance)
            if not is_visible:
                continue
            if found == capacity:
                capacity *= 2
                points = np.concatenate((points, np.empty_like(points)))
                pixels = np.concatenate((pixels, np.empty_like(pixels)))
                tangents = np.concatenate((tangents, np.empty_like(tangents)))
                lengths = np.concatenate((lengths, np.empty_like(lengths)))
                kinds = np.concatenate((kinds, np.empty_like(kinds)))
                owners = np.concatenate((owners, np.empty_like(owners)))
            norm = 0.0
            for k in range(3):
                points[found, k] = a[k] + t * (b[k] - a[k])
                tangents[found, k] = b[k] - a[k]
                norm += tangents[found, k] ** 2
            norm = np.sqrt(norm)
            for k in range(3):
                tangents[found, k] /= norm
            pixels[found, 0] = u
            pixels[found, 1] = v
            lengths[found] = length
            kinds[found] = (
                (EDGE_CONTOUR if is_contour else 0)
                + (EDGE_CREASE if crease else 0)
                + (EDGE_SILHOUETTE if silhouette else 0)
                + (EDGE_SHARP if crease and is_sharp[e] else 0)
            )
            owners[found] = component[e]
            found += 1
    return points[:found], pixels[:found], tangents[:found], lengths[:found], kinds[:found], owners[:found]


@dataclass(frozen=True)
class ViewEdgeSamples:
    """Visible samples along the edges of a model in one view.

    Attributes:
        points_in_model: (N,3) mm, exactly on the mesh edges.
        pixels: (N,2) their projections.
        tangents_in_model: (N,3) unit vectors along the edge.
        lengths_px: (N,) length of the whole edge in the picture.
        kinds: (N,) uint8, EDGE_* bits.
        component: (N,) component index.
    """

    points_in_model: Array
    pixels: Array
    tangents_in_model: Array
    lengths_px: Array
    kinds: NDArray[np.uint8]
    component: NDArray[np.int32]


def sample_visible_edges(
    edges: MeshEdges,
    cam_from_model: Array,
    intrinsics: tuple[float, float, float, float],
    depth_mm: NDArray[np.float32],
    spacing_px: float,
) -> ViewEdgeSamples:
    """Samples along the creases and silhouettes that are not hidden in a view.

    Args:
        edges: the edges of the model.
        cam_from_model: (4,4) pose of the view.
        intrinsics: fx, fy, cx, cy in px of an ideal camera.
        depth_mm: (H,W) depth of the model in this view, 0 for background.
        spacing_px: mean distance between samples along an edge, in the picture.
    """
    fx, fy, cx, cy = intrinsics
    seen = depth_mm[depth_mm > 0]
    # Two pixels' worth of a surface seen at 45 degrees.
    tolerance = 3.0 * float(np.median(seen)) / fx if seen.size else 1.0
    return ViewEdgeSamples(
        *_sample_visible(
            edges.vertices_in_model,
            edges.ends,
            edges.faces,
            is_crease=edges.is_crease,
            is_sharp=edges.is_sharp,
            normals=edges.face_normals,
            component=edges.component,
            cam_from_model=cam_from_model,
            fx=fx,
            fy=fy,
            cx=cx,
            cy=cy,
            depth=depth_mm,
            spacing_px=spacing_px,
            depth_tolerance=tolerance,
        )
    )
