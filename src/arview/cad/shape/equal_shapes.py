"""Components of equal shape, up to a translation: what holds for one need not be computed for the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from arview.cad.model import Component
from arview.cad.shape.symmetry import FoundSymmetry, find_symmetries
from arview.geometry import Array

_SAME_SHARE = 1e-4
"""Largest distance between the vertices of equal shapes, as a share of their diameter."""


MAX_FACES = 150_000
"""Triangles of all shapes that are searched, in the order of the part; it takes a second for some thousands of them."""
MAX_SHAPES = 120
"""Shapes of a part that are searched for symmetries, in the order of the part."""


class ShapeSymmetries:
    """Symmetries of components, searched once for all of equal shape, and for a limited number of shapes.

    Attributes:
        skipped: names of components whose symmetries were not searched.
    """

    def __init__(self) -> None:
        self._known: dict[tuple[int, int], list[tuple[Component, tuple[FoundSymmetry, ...]]]] = {}
        self._shapes = self._faces = 0
        self.skipped: list[str] = []

    def of(self, component: Component) -> tuple[FoundSymmetry, ...]:
        """The exact symmetries of a component alone."""
        alike = self._known.setdefault((len(component.vertices_in_model), len(component.faces)), [])
        for other, symmetries in alike:
            shift = _translation(other, component)
            if shift is not None:
                return tuple(_moved(found, shift) for found in symmetries)
        self._shapes += 1
        self._faces += len(component.faces)
        if self._shapes > MAX_SHAPES or self._faces > MAX_FACES:
            self.skipped.append(component.name)
            return ()
        found = find_symmetries(component.vertices_in_model, component.faces.astype(np.int64), near_share=0.0)
        alike.append((component, found))
        return found


def _translation(one: Component, other: Component) -> Array | None:
    """(3,) mm by which a shape is moved to another one; None where they differ. Both have as many vertices."""
    from scipy.spatial import cKDTree

    low, high = one.bounds_in_model
    other_low, other_high = other.bounds_in_model
    limit = _SAME_SHARE * float(np.linalg.norm(high - low))
    shift = 0.5 * (other_low + other_high - low - high)
    if np.abs((other_high - other_low) - (high - low)).max() > limit:
        return None
    distances, nearest = cKDTree(other.vertices_in_model).query(one.vertices_in_model + shift)
    is_same = distances.max() <= limit and len(np.unique(nearest)) == len(nearest)
    return np.asarray(shift) if is_same else None


def _moved(found: FoundSymmetry, shift: Array) -> FoundSymmetry:
    x, y, z = (np.array(found.symmetry.through_in_model) + shift).tolist()
    return replace(found, symmetry=replace(found.symmetry, through_in_model=(x, y, z)))
