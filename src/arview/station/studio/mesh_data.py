"""The mesh of a part for the page: one binary with all components, in full or coarser where it has many faces."""

from __future__ import annotations

import itertools
import json

import numpy as np
from numpy.typing import NDArray

from arview.cad import Model
from arview.geometry import Array
from arview.rendering.mesh_edges import mesh_edges

COARSE_FACES = 150_000
"""Faces of the coarser mesh, at most about; a page draws as many while it is dragged."""


def mesh_bytes(model: Model, is_coarse: bool) -> bytes:
    """The mesh: uint32 length of a JSON header, the header, float32 positions, uint32 corners, float32 edge lines.

    The header holds ``vertices``, ``faces`` and ``edges`` (counts), ``ranges`` (first and number of faces of each
    component, in their order), ``edge_ranges``, and ``is_coarse``. Face k of a component, counted from its first one,
    is the face of that number of the component's own mesh unless the mesh is coarse. A coarse mesh has no edge lines,
    because finding them takes longer than all the rest. All begins at multiples of four.
    """
    points: list[NDArray[np.float32]] = []
    corners: list[NDArray[np.uint32]] = []
    ranges, first_vertex, first_face = [], 0, 0
    total = sum(len(component.faces) for component in model.components)
    is_coarse = is_coarse and total > COARSE_FACES
    for component in model.components:
        vertices, faces = component.vertices_in_model, component.faces
        if is_coarse:
            share = COARSE_FACES / total
            vertices, faces = clustered(vertices, faces, max(60, round(share * len(faces))))
        points.append(vertices.astype(np.float32))
        corners.append((faces + first_vertex).astype(np.uint32))
        ranges.append([first_face, len(faces)])
        first_vertex += len(vertices)
        first_face += len(faces)
    lines, edge_ranges = ([], [[0, 0]] * len(ranges)) if is_coarse else _crease_lines(model)
    edge_count = sum(count for _, count in edge_ranges)
    header = {
        "vertices": first_vertex,
        "faces": first_face,
        "edges": edge_count,
        "ranges": ranges,
        "edge_ranges": edge_ranges,
        "is_coarse": is_coarse,
    }
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    arrays = [np.concatenate(points), np.concatenate(corners), np.concatenate([*lines, np.zeros((0, 3), np.float32)])]
    return b"".join([np.uint32(len(text)).tobytes(), text, *(array.tobytes() for array in arrays)])


def _crease_lines(model: Model) -> tuple[list[NDArray[np.float32]], list[list[int]]]:
    """End points of the crease edges, those of a component together; first and number of lines of each component."""
    edges = mesh_edges(model)
    creases = np.flatnonzero(edges.is_crease)
    creases = creases[np.argsort(edges.component[creases], kind="stable")]
    bounds = np.searchsorted(edges.component[creases], np.arange(len(model.components) + 1))
    points = edges.vertices_in_model[edges.ends[creases]].reshape(-1, 3).astype(np.float32)
    return [points], [[int(first), int(end - first)] for first, end in itertools.pairwise(bounds)]


def clustered(vertices: Array, faces: NDArray[np.int32], wanted: int) -> tuple[Array, NDArray[np.int32]]:
    """A coarser mesh by vertex clustering (Rossignac and Borrel 1993): vertices in a cell become their mean.

    Args:
        vertices: (V,3) mm.
        faces: (F,3).
        wanted: number of faces that the result has, roughly; a mesh with fewer stays as it is.
    """
    if len(faces) <= wanted:
        return vertices, faces
    low = vertices.min(axis=0)
    extent = float(np.ptp(vertices, axis=0).max())
    cells = max(4, round(0.35 * np.sqrt(wanted)))
    cell = np.floor((vertices - low) / max(extent, 1e-12) * (cells - 1e-6)).astype(np.int64)
    key = (cell[:, 0] * cells + cell[:, 1]) * cells + cell[:, 2]
    _, owner, counts = np.unique(key, return_inverse=True, return_counts=True)
    owner = owner.ravel()
    means = np.stack([np.bincount(owner, weights=vertices[:, axis]) for axis in range(3)], axis=1) / counts[:, None]
    joined = owner[faces].astype(np.int32)
    is_face = (joined[:, 0] != joined[:, 1]) & (joined[:, 1] != joined[:, 2]) & (joined[:, 2] != joined[:, 0])
    return means, joined[is_face]
