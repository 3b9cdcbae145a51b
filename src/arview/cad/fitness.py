"""Cleaning of triangle meshes from files, and the properties of a mesh that matter for tracking."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.cad.model import Component
from arview.geometry import Array

Faces = NDArray[np.int64]

MERGE_FRACTION = 1e-5
"""Vertices closer than this share of the mesh's diagonal are merged: 1 µm on 100 mm, above float32's resolution."""


@dataclass(frozen=True)
class MeshFitness:
    """Properties of the mesh of a component.

    Attributes:
        triangle_count: number of triangles.
        open_edge_count: edges with a triangle on one side only; 0 for a closed surface.
        non_manifold_edge_count: edges shared by more than two triangles.
        is_consistent: neighbouring triangles have the same winding.
        volume_mm3: enclosed volume; None unless the mesh is closed and consistent.
        extents_mm: (3,) sides of a tight box around it, largest first.
    """

    triangle_count: int
    open_edge_count: int
    non_manifold_edge_count: int
    is_consistent: bool
    volume_mm3: float | None
    extents_mm: tuple[float, float, float]

    @property
    def is_watertight(self) -> bool:
        """True when every edge has exactly two triangles."""
        return self.open_edge_count == 0 and self.non_manifold_edge_count == 0

    @property
    def thickness_mm(self) -> float:
        """Smallest extent, mm: near zero for a sheet without thickness."""
        return self.extents_mm[2]


def inspect_mesh(component: Component) -> MeshFitness:
    """Open and non-manifold edges, volume and principal extents of the mesh of a component."""
    faces = component.faces.astype(np.int64)
    counts, balance, _ = _edges(faces, len(component.vertices_in_model))
    open_edges = int(np.count_nonzero(counts == 1))
    non_manifold = int(np.count_nonzero(counts > 2))
    consistent = bool(np.all(balance[counts == 2] == 0))
    closed = open_edges == 0 and non_manifold == 0 and consistent
    return MeshFitness(
        triangle_count=len(faces),
        open_edge_count=open_edges,
        non_manifold_edge_count=non_manifold,
        is_consistent=consistent,
        volume_mm3=float(signed_volumes(component.vertices_in_model, faces).sum()) if closed else None,
        extents_mm=_tight_extents(component.vertices_in_model, faces),
    )


def clean_mesh(vertices: Array, faces: Faces) -> tuple[Array, Faces]:
    """Merge coincident vertices, drop degenerate, duplicate and unused items, and wind the triangles outwards.

    Surfaces that are not closed get a consistent winding; their outside is that of most of their area in the file.

    Args:
        vertices: (V,3) in any unit.
        faces: (F,3) vertex indices.

    Returns:
        vertices and faces of the clean mesh, perhaps without faces.
    """
    vertices, faces = _merge_vertices(vertices, faces)
    faces = _drop_degenerate(vertices, faces)
    if len(faces) == 0:
        return vertices[:0], faces
    faces = _wind_outwards(vertices, faces)
    used, inverse = np.unique(faces, return_inverse=True)
    return vertices[used], inverse.reshape(-1, 3).astype(np.int64)


def wrong_winding(vertices: Array, faces: Faces, clean_vertices: Array, clean_faces: Faces) -> bool:
    """Whether triangles of a closed mesh faced inwards before it was cleaned, by the volume that they enclosed."""
    before = float(signed_volumes(vertices, faces).sum())
    after = float(signed_volumes(clean_vertices, clean_faces).sum())
    if after <= 0 or abs(before - after) <= 0.01 * after:
        return False
    counts, _, _ = _edges(clean_faces, len(clean_vertices))
    return bool(np.all(counts == 2))


def signed_volumes(vertices: Array, faces: Faces) -> Array:
    """(F,) signed volume of the tetrahedron of each triangle and the mesh's first vertex."""
    a, b, c = (vertices[faces] - vertices[faces[0, 0]]).transpose(1, 0, 2)
    return np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0


def face_areas(vertices: Array, faces: Faces) -> Array:
    """(F,) areas of triangles."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def surface_moments(vertices: Array, faces: Faces) -> tuple[Array, Array]:
    """Centroid (3,) and covariance (3,3) of a surface of uniform density, exact."""
    areas, corners = face_areas(vertices, faces), vertices[faces]
    total = areas.sum()
    centroid = (areas[:, None] * corners.mean(axis=1)).sum(axis=0) / total
    local = corners - centroid
    # Second moment of a triangle: area / 12 * (sum of corner outer products + outer product of the sum).
    outer = np.einsum("f,fci,fcj->ij", areas, local, local)
    summed = local.sum(axis=1)
    outer += np.einsum("f,fi,fj->ij", areas, summed, summed)
    return centroid, outer / (12.0 * total)


def principal_axes(vertices: Array, faces: Faces) -> Array:
    """(3,3) principal axes of the surface as rows, largest spread first."""
    _, vectors = np.linalg.eigh(surface_moments(vertices, faces)[1])
    return np.ascontiguousarray(vectors[:, ::-1].T)


def _tight_extents(vertices: Array, faces: Faces) -> tuple[float, float, float]:
    """Sides, largest first, of the smallest box along a principal axis or an axis of the model."""
    import cv2

    used = vertices[np.unique(faces)]
    used = used - used.mean(axis=0)
    best: list[float] = []
    for axis in (*principal_axes(vertices, faces), *np.eye(3)):
        # Two directions across the axis; the box around it is the smallest rectangle of the projection.
        across = np.linalg.svd(axis[None, :])[2][1:]
        (_, (width, height), _) = cv2.minAreaRect((used @ across.T).astype(np.float32))
        sides = [float(np.ptp(used @ axis)), float(width), float(height)]
        if not best or np.prod(sides) < np.prod(best) * (1.0 - 1e-6):
            best = sides
    small, middle, large = sorted(best)
    return large, middle, small


def _merge_vertices(vertices: Array, faces: Faces) -> tuple[Array, Faces]:
    """Merge clusters of vertices closer than MERGE_FRACTION of the diagonal into their first vertex."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    _, first, inverse = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    unique, faces = vertices[first], inverse.ravel()[faces]
    tolerance = MERGE_FRACTION * float(np.linalg.norm(np.ptp(unique, axis=0)))
    pairs = cKDTree(unique).query_pairs(tolerance, output_type="ndarray")
    if len(pairs) == 0:
        return unique, faces
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(unique),) * 2)
    _, labels = connected_components(graph, directed=False)
    _, representative = np.unique(labels, return_index=True)
    return unique[representative], labels[faces].astype(np.int64)


def _drop_degenerate(vertices: Array, faces: Faces) -> Faces:
    """The faces with an area, each triple of vertices once."""
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    if len(faces) == 0:
        return faces
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    faces = faces[face_areas(vertices, faces) > 1e-9 * longest**2]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return faces[np.sort(first)]


def _edges(faces: Faces, vertex_count: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Undirected edges: triangles at each (E,), forward minus backward uses (E,), edges of faces (F,3)."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    keys = np.minimum(start, end) * np.int64(vertex_count) + np.maximum(start, end)
    _, inverse, counts = np.unique(keys, return_inverse=True, return_counts=True)
    balance = np.bincount(inverse.ravel(), weights=np.where(start < end, 1.0, -1.0)).astype(np.int64)
    return counts, balance, inverse.reshape(-1, 3)


def face_bodies(faces: Faces, vertex_count: int) -> NDArray[np.int64]:
    """(F,) number of the edge-connected body of each triangle."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges = _edges(faces, vertex_count)[2].ravel()
    owners = np.repeat(np.arange(len(faces)), 3)
    order = np.argsort(edges, kind="stable")
    same = edges[order][1:] == edges[order][:-1]
    rows, columns = owners[order][1:][same], owners[order][:-1][same]
    graph = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(len(faces),) * 2)
    return connected_components(graph, directed=False)[1].astype(np.int64)


def _wind_outwards(vertices: Array, faces: Faces) -> Faces:
    """Make the winding consistent; closed bodies face outwards, the walls of a cavity into the cavity."""
    counts, balance, _ = _edges(faces, len(vertices))
    if np.any(balance[counts == 2] != 0):
        faces = _wind_alike(vertices, faces)
    bodies = face_bodies(faces, len(vertices))
    counts, balance, edges_of_face = _edges(faces, len(vertices))
    is_open = ((counts != 2) | (balance != 0))[edges_of_face].any(axis=1)
    closed = np.bincount(bodies, weights=is_open) == 0
    volumes = np.bincount(bodies, weights=signed_volumes(vertices, faces))
    low, high = np.full((len(closed), 3), np.inf), np.full((len(closed), 3), -np.inf)
    np.minimum.at(low, bodies, vertices[faces].min(axis=1))
    np.maximum.at(high, bodies, vertices[faces].max(axis=1))
    outer, flip = closed & (volumes > 0), closed & (volumes < 0)
    for body in np.flatnonzero(flip):
        # A body that faces inwards is a cavity when it lies inside one that faces outwards.
        flip[body] = not np.any(outer & (low < low[body]).all(axis=1) & (high > high[body]).all(axis=1))
    return np.where(flip[bodies][:, None], faces[:, ::-1], faces)


def _wind_alike(vertices: Array, faces: Faces) -> Faces:
    """Give neighbours over manifold edges the same winding; each patch keeps that of most of its area."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import breadth_first_order, connected_components

    count = len(faces)
    forward = faces.ravel() < np.roll(faces, -1, axis=1).ravel()
    counts, _, edges_of_face = _edges(faces, len(vertices))
    edges = edges_of_face.ravel()
    slots = np.flatnonzero(counts[edges] == 2)
    pairs = slots[np.argsort(edges[slots], kind="stable")].reshape(-1, 2)
    one, other = pairs.T // 3
    is_opposed = forward[pairs[:, 0]] == forward[pairs[:, 1]]
    links = coo_matrix((np.ones(len(one)), (one, other)), shape=(count, count))
    _, patches = connected_components(links, directed=False)
    # One search over all patches, from a root that is linked to the first face of each.
    _, first = np.unique(patches, return_index=True)
    rows, columns = np.concatenate([one, np.full(len(first), count)]), np.concatenate([other, first])
    tree = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(count + 1, count + 1)).tocsr()
    sequence, parents = breadth_first_order(tree, count, directed=False)
    keys = np.minimum(one, other) * np.int64(count + 1) + np.maximum(one, other)
    order = np.argsort(keys)
    wanted = np.minimum(parents[:count], np.arange(count)) * np.int64(count + 1)
    wanted += np.maximum(parents[:count], np.arange(count))
    found = np.minimum(np.searchsorted(keys[order], wanted), len(keys) - 1)
    flips = (is_opposed[order][found] & (keys[order][found] == wanted)).tolist()
    turned, parent_of = [False] * (count + 1), parents.tolist()
    for face in sequence[1:].tolist():
        turned[face] = turned[parent_of[face]] ^ flips[face]
    is_turned = np.array(turned[:count])
    kept_area = np.bincount(patches, weights=np.where(is_turned, -1.0, 1.0) * face_areas(vertices, faces))
    is_turned ^= (kept_area < 0)[patches]
    return np.where(is_turned[:, None], faces[:, ::-1], faces)
