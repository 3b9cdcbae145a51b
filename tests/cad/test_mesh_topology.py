"""Edges of small meshes and the faces at them."""

from __future__ import annotations

import numpy as np

from arview.cad.shape.mesh_topology import edge_faces


def test_a_tetrahedron_has_two_faces_at_each_edge() -> None:
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    edges = edge_faces(faces)
    assert edges.ends.tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]
    assert (edges.face_count == 2).all()
    for ends, sides, owners in zip(edges.ends, edges.sides, edges.faces, strict=True):
        for side, face in zip(sides, owners, strict=True):
            assert sorted([faces[face][side % 3], faces[face][(side + 1) % 3]]) == ends.tolist()
    starts = faces.ravel()[edges.sides]
    assert (starts[:, 0] != starts[:, 1]).all()  # wound consistently


def test_borders_and_edges_of_three_faces() -> None:
    edges = edge_faces(np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]]))
    assert edges.face_count.tolist() == [3, 1, 1, 1, 1, 1, 1]
    assert edges.faces[0].tolist() == [0, 1]
    assert (edges.faces[1:, 1] == -1).all()
    assert len(edge_faces(np.zeros((0, 3), dtype=np.int32)).ends) == 0
