"""Edges of a triangle mesh, and samples along those that are visible in one view.

An edge is a crease when its two faces meet at more than a threshold, and a silhouette when one of them faces the
camera and the other does not (Appel 1967; Gooch et al. 1999). Hidden samples are removed by a depth test.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.cad import EdgeFaces, Model, edge_faces
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
EDGE_ROUGH = 16
"""Kind bit: a sharp crease amid others, as in scans and sculpted surfaces: no edge of the design."""
SHARP_ANGLE_DEG = 50.0
"""Dihedral angle above which a crease is sharp."""
ROUGH_SHARE = 0.15
"""A crease is rough if a surface beside it turns by more than this share of its angle at the flattest edge there."""
INITIAL_SAMPLES = 4096
"""Samples for which memory is reserved at first; it doubles when it is full."""


class MeshEdges(NamedTuple):
    """The unique edges of a model; touching components keep edges of their own. Kernels take it as it is.

    Attributes:
        vertices_in_model: (V,3) mm.
        ends: (E,2) vertex indices.
        faces: (E,2) adjacent faces, the second -1 for an open edge.
        is_crease: (E,) dihedral angle above the threshold, or open, or shared by more than two faces.
        is_sharp: (E,) dihedral angle above SHARP_ANGLE_DEG, or open.
        is_rough: (E,) see EDGE_ROUGH.
        face_normals: (F,3) unit normals.
        component: (E,) component index.
    """

    vertices_in_model: Array
    ends: NDArray[np.int32]
    faces: NDArray[np.int32]
    is_crease: NDArray[np.bool_]
    is_sharp: NDArray[np.bool_]
    is_rough: NDArray[np.bool_]
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

    edges = edge_faces(faces)
    cosine = np.einsum("ij,ij->i", normals[edges.faces[:, 0]], normals[edges.faces[:, 1]])
    is_border = edges.face_count != 2
    return MeshEdges(
        vertices_in_model=vertices,
        ends=np.ascontiguousarray(edges.ends, dtype=np.int32),
        faces=np.ascontiguousarray(edges.faces, dtype=np.int32),
        is_crease=is_border | (cosine < np.cos(np.deg2rad(crease_angle_deg))),
        is_sharp=is_border | (cosine < np.cos(np.deg2rad(SHARP_ANGLE_DEG))),
        is_rough=~is_border & _are_rough(edges, np.arccos(np.clip(cosine, -1.0, 1.0)), len(faces)),
        face_normals=np.ascontiguousarray(normals),
        component=component_of_face[edges.faces[:, 0]].astype(np.int32),
    )


def _are_rough(edges: EdgeFaces, angles_rad: Array, face_count: int) -> NDArray[np.bool_]:
    """Whether a face at an edge (E,) with a dihedral angle turns much at both of its other edges, too."""
    angles = np.zeros(3 * face_count)
    for sides in edges.sides.T:
        angles[sides[sides >= 0]] = angles_rad[sides >= 0]
    of_face = angles.reshape(-1, 3)
    beside = np.minimum(np.roll(of_face, 1, axis=1), np.roll(of_face, 2, axis=1)).ravel()
    return np.asarray(np.max(beside[edges.sides], axis=1) > ROUGH_SHARE * angles_rad)


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


class EdgeSamples(NamedTuple):
    """Samples along edges inside of a picture, whether hidden or not.

    Attributes:
        points_in_model: (N,3) mm, exactly on the mesh edges.
        tangents_in_model: (N,3) unit vectors along the edge.
        pixels: (N,2) their projections.
        along_px: (N,2) from start to end of the whole edge in the picture.
        depths_mm: (N,) in the camera frame.
        edges: (N,) index of the edge.
        kinds: (N,) uint8, EDGE_CREASE and EDGE_SILHOUETTE.
    """

    points_in_model: NDArray[np.float64]
    tangents_in_model: NDArray[np.float64]
    pixels: NDArray[np.float64]
    along_px: NDArray[np.float64]
    depths_mm: NDArray[np.float64]
    edges: NDArray[np.int32]
    kinds: NDArray[np.uint8]


@kernel
def _longer(array: NDArray[Any]) -> NDArray[Any]:
    """A copy of twice the length."""
    return np.concatenate((array, np.empty_like(array)))


@kernel
def sample_edges(
    edges: MeshEdges,
    is_crease: NDArray[np.bool_],
    cam_from_model: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    width: int,
    height: int,
    spacing_px: float,
    min_depth_mm: float,
    min_foreshortening: float,
) -> EdgeSamples:
    """Samples along the silhouettes, and the creases with a face turned to the camera, of a mesh.

    Args:
        edges: of the mesh.
        is_crease: (E,) edges that are sampled although they are no silhouettes.
        cam_from_model: (4,4) pose.
        intrinsics: (4,) fx, fy, cx, cy in px of an ideal camera.
        width, height: of the picture, px; samples on its outermost pixels are left out.
        spacing_px: mean distance between samples along an edge, in the picture.
        min_depth_mm: edges that begin or end nearer to the camera's plane are left out.
        min_foreshortening: edges whose image is shorter than this share of their length seen frontally are left out.
    """
    fx, fy, cx, cy = intrinsics
    rotation, translation = cam_from_model[:3, :3], cam_from_model[:3, 3]
    eye = np.empty(3)
    for k in range(3):
        eye[k] = -(rotation[0, k] * translation[0] + rotation[1, k] * translation[1] + rotation[2, k] * translation[2])
    capacity = INITIAL_SAMPLES
    points, tangents = np.empty((capacity, 3)), np.empty((capacity, 3))
    pixels, along = np.empty((capacity, 2)), np.empty((capacity, 2))
    depths, owners = np.empty(capacity), np.empty(capacity, dtype=np.int32)
    kinds = np.empty(capacity, dtype=np.uint8)
    found = 0
    carry = 0.5
    for e in range(edges.ends.shape[0]):
        a, b = edges.vertices_in_model[edges.ends[e, 0]], edges.vertices_in_model[edges.ends[e, 1]]
        front0, front1 = facing(eye, a, edges.face_normals, edges.faces[e, 0], edges.faces[e, 1])
        silhouette = edges.faces[e, 1] < 0 or (front0 > 0) != (front1 > 0)
        crease = is_crease[e] and (front0 > 0 or front1 > 0)
        if not (silhouette or crease):
            continue
        ax, ay, az = _to_cam(rotation, translation, a)
        bx, by, bz = _to_cam(rotation, translation, b)
        if min(az, bz) < min_depth_mm:
            continue
        du = fx * (bx / bz - ax / az)
        dv = fy * (by / bz - ay / az)
        length = np.sqrt(du * du + dv * dv)
        size = np.sqrt((b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2 + (b[2] - a[2]) ** 2)
        if length < min_foreshortening * fx * size / az:
            continue
        # The remainder is carried to the next edge, so that short edges get their share of samples.
        wanted = length / spacing_px + carry
        count = int(wanted)
        carry = wanted - count
        for i in range(count):
            t = (i + 0.5) / count
            z = az + t * (bz - az)
            u = fx * (ax + t * (bx - ax)) / z + cx
            v = fy * (ay + t * (by - ay)) / z + cy
            iu, iv = int(np.round(u)), int(np.round(v))
            if iu < 1 or iv < 1 or iu >= width - 1 or iv >= height - 1:
                continue
            if found == capacity:
                capacity *= 2
                points, tangents, pixels, along = _longer(points), _longer(tangents), _longer(pixels), _longer(along)
                depths, owners, kinds = _longer(depths), _longer(owners), _longer(kinds)
            for k in range(3):
                points[found, k] = a[k] + t * (b[k] - a[k])
                tangents[found, k] = (b[k] - a[k]) / size
            pixels[found, 0], pixels[found, 1] = u, v
            along[found, 0], along[found, 1] = du, dv
            depths[found], owners[found] = z, e
            kinds[found] = (EDGE_CREASE if crease else 0) + (EDGE_SILHOUETTE if silhouette else 0)
            found += 1
    return EdgeSamples(
        points[:found], tangents[:found], pixels[:found], along[:found], depths[:found], owners[:found], kinds[:found]
    )


@kernel
def _depth_tests(
    samples: EdgeSamples, depth_mm: NDArray[np.float32], tolerance_mm: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Compare samples with the 3×3 pixels around each: is any of them as deep (N,), is any of them background (N,)?"""
    is_visible = np.zeros(len(samples.depths_mm), dtype=np.bool_)
    is_contour = np.zeros(len(samples.depths_mm), dtype=np.bool_)
    for i in range(len(samples.depths_mm)):
        column, row = int(np.round(samples.pixels[i, 0])), int(np.round(samples.pixels[i, 1]))
        for y in range(row - 1, row + 2):
            for x in range(column - 1, column + 2):
                if depth_mm[y, x] <= 0:
                    is_contour[i] = True
                elif abs(samples.depths_mm[i] - depth_mm[y, x]) < tolerance_mm:
                    is_visible[i] = True
    return is_visible, is_contour


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
    seen = depth_mm[depth_mm > 0]
    # Two pixels' worth of a surface seen at 45 degrees.
    tolerance_mm = 3.0 * float(np.median(seen)) / intrinsics[0] if seen.size else 1.0
    height, width = depth_mm.shape
    samples = sample_edges(
        edges,
        edges.is_crease,
        cam_from_model,
        intrinsics=np.array(intrinsics, dtype=np.float64),
        width=width,
        height=height,
        spacing_px=spacing_px,
        min_depth_mm=min(1.0, tolerance_mm),
        min_foreshortening=0.0,
    )
    is_visible, is_contour = _depth_tests(samples, depth_mm, tolerance_mm)
    shown = EdgeSamples._make(values[is_visible] for values in samples)
    is_sharp = (shown.kinds & EDGE_CREASE > 0) & edges.is_sharp[shown.edges]
    return ViewEdgeSamples(
        shown.points_in_model,
        shown.pixels,
        shown.tangents_in_model,
        lengths_px=np.hypot(shown.along_px[:, 0], shown.along_px[:, 1]),
        kinds=shown.kinds
        | np.uint8(EDGE_CONTOUR) * is_contour[is_visible]
        | np.uint8(EDGE_SHARP) * is_sharp
        | np.uint8(EDGE_ROUGH) * (is_sharp & edges.is_rough[shown.edges]),
        component=edges.component[shown.edges],
    )
