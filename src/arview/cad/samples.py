"""Even samples of the surface of a component."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.cad.fitness import face_areas
from arview.cad.model import Component
from arview.geometry import Array


@dataclass(frozen=True)
class Samples:
    """Points (N,3) of a surface in the model frame, with unit normals (N,3)."""

    points: Array
    normals: Array

    def of(self, which: NDArray[np.bool_]) -> Samples:
        """The samples of a mask (N,)."""
        return Samples(self.points[which], self.normals[which])


def sample_surface(component: Component, spacing_mm: float, max_count: int, seed: int = 0) -> Samples:
    """Samples of a surface.

    Args:
        component: the surface.
        spacing_mm: mean distance between neighbours, larger where ``max_count`` requires it.
        max_count: largest number of samples.
        seed: of the random numbers.
    """
    corners = component.vertices_in_model[component.faces]
    areas = face_areas(component.vertices_in_model, component.faces.astype(np.int64))
    spacing_mm = max(spacing_mm, float(np.sqrt(areas.sum() / max_count)))
    count = int(np.ceil(6.0 * areas.sum() / spacing_mm**2))
    rng = np.random.default_rng(seed)
    edges = np.cumsum(areas) / max(float(areas.sum()), 1e-300)
    owners = np.minimum(np.searchsorted(edges, (np.arange(count) + rng.random(count)) / count), len(areas) - 1)
    u, v = np.sqrt(rng.random(count)), rng.random(count)
    points = np.einsum("nc,ncx->nx", np.stack([1 - u, u * (1 - v), u * v], axis=1), corners[owners])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[owners]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    # One sample in each cell of position and of normal is even enough.
    cells = np.concatenate([np.floor(points / spacing_mm), np.round(1.2 * normals)], axis=1).astype(np.int64)
    first = np.sort(np.unique(cells, axis=0, return_index=True)[1])
    if len(first) > max_count:
        first = np.sort(rng.permutation(first)[:max_count])
    return Samples(points[first], normals[first])
