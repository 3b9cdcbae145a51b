"""Whole check of a set of guide views that was read from a file, before anything is indexed by what it holds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

_ROWS: dict[str, tuple[str, tuple[int, ...]]] = {
    "contour_points": ("f", (3,)),
    "contour_normals": ("i", (3,)),
    "contour_runs_mm": ("f", (2,)),
    "contour_component": ("i", ()),
    "edge_points": ("f", (3,)),
    "edge_tangents": ("i", (3,)),
    "edge_kinds": ("u", ()),
    "edge_component": ("i", ()),
    "surface_points": ("f", (3,)),
    "surface_faces": ("i", (3,)),
    "surface_component": ("i", ()),
}
"""Kind of the numbers and shape of a row of each array."""
_ROTATION_TOLERANCE = 1e-6


def check_poses(poses: NDArray[Any], directions: NDArray[Any]) -> None:
    """Check that poses (N,4,4) are rigid and directions (N,3) unit vectors, at least one of each.

    Raises:
        ValueError: they are not.
    """
    count = len(poses) if poses.ndim else 0
    _demand(count > 0 and poses.shape == (count, 4, 4) and poses.dtype == np.float64, "poses")
    _demand(directions.shape == (count, 3) and directions.dtype == np.float64, "directions")
    _demand(bool(np.isfinite(poses).all() and np.isfinite(directions).all()), "poses")
    turns = poses[:, :3, :3]
    products = turns @ turns.transpose(0, 2, 1)
    _demand(np.allclose(products, np.eye(3), atol=_ROTATION_TOLERANCE), "poses")
    _demand(bool((np.linalg.det(turns) > 0.0).all() and (poses[:, 3] == (0.0, 0.0, 0.0, 1.0)).all()), "poses")
    _demand(np.allclose(np.linalg.norm(directions, axis=1), 1.0, atol=_ROTATION_TOLERANCE), "directions")


def check_arrays(arrays: Mapping[str, NDArray[Any]], view_count: int, component_count: int) -> None:
    """Check kinds, shapes, numbers and indices of the packed features and the surface of a set.

    Raises:
        ValueError: an array has another kind or shape, a point is not finite, or an index leaves its range.
        KeyError: an array is missing.
    """
    for name, (kind, row) in _ROWS.items():
        array = arrays[name]
        _demand(array.dtype.kind == kind and array.ndim == 1 + len(row) and array.shape[1:] == row, name)
        if kind == "f":
            _demand(bool(np.isfinite(array).all()), name)
    for group in ("contour", "edge"):
        starts, rows = arrays[f"{group}_start"], len(arrays[f"{group}_points"])
        _demand(starts.dtype.kind == "i" and starts.shape == (view_count + 1,), f"{group}_start")
        _demand(bool(starts[0] == 0 and starts[-1] == rows and (np.diff(starts) >= 0).all()), f"{group}_start")
        names = [name for name in _ROWS if name.startswith(f"{group}_")]
        _demand(all(len(arrays[name]) == rows for name in names), group)
    for group in ("contour", "edge", "surface"):
        _demand(_within(arrays[f"{group}_component"], component_count), f"{group}_component")
    faces = arrays["surface_faces"]
    _demand(_within(faces, len(arrays["surface_points"])), "surface_faces")
    _demand(len(faces) == len(arrays["surface_component"]), "surface_component")


def _within(indices: NDArray[Any], count: int) -> bool:
    """Whether all indices are from 0 to ``count - 1``."""
    return indices.size == 0 or bool(indices.min() >= 0 and indices.max() < count)


def _demand(holds: bool, name: str) -> None:
    if not holds:
        raise ValueError(name)
