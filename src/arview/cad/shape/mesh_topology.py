"""Edges of a triangle mesh, and the faces that meet at each."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class EdgeFaces(NamedTuple):
    """The unique edges of a mesh, ordered by their vertices.

    Attributes:
        ends: (E,2) vertex indices, the smaller one first.
        sides: (E,2) the first two sides of faces on the edge: side k of face f, from its corner k to the next one, is
            3 f + k; the second is -1 at a border.
        faces: (E,2) the faces of these sides, -1 at a border.
        face_count: (E,) number of faces at the edge.
    """

    ends: NDArray[np.int64]
    sides: NDArray[np.int64]
    faces: NDArray[np.int64]
    face_count: NDArray[np.int64]


def edge_faces(faces: NDArray[np.integer]) -> EdgeFaces:
    """Edges of faces (F,3) whose coinciding vertices have one index."""
    corners = faces.astype(np.int64)
    ends = np.sort(np.stack([corners.ravel(), np.roll(corners, -1, axis=1).ravel()], axis=1), axis=1)
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    ends = ends[order]
    first = np.flatnonzero(np.r_[True, np.any(ends[1:] != ends[:-1], axis=1)])[: len(ends)]
    count = np.diff(np.r_[first, len(ends)])
    second = np.where(count > 1, order[np.minimum(first + 1, len(ends) - 1)], -1)
    sides = np.stack([order[first], second], axis=1)
    return EdgeFaces(ends[first], sides, sides // 3, count)
