"""Foreign objects: surfaces in the cloud that belong to no component of the CAD."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from arview.cad import Model
from arview.geometry import Array, apply
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.cloud.points import prepare_cloud
from arview.reconstruction import DenseCloud

FAR_MM = 4.0
"""Points nearer to the CAD, with components at their measured places, belong to it or to a weld."""
CELL_MM = 2.0
"""Points in touching cells of this size form one object."""
MIN_AREA_MM2 = 40.0
"""Smaller objects are spatter or wrong points."""
GRID_MM = 0.5
"""Cell of the grid on which the cloud is averaged."""


@dataclass(frozen=True)
class ForeignObject:
    """A surface that is not in the CAD.

    Attributes:
        center_in_model, size_mm: (3,) centre and extent of its bounding box in the model frame, mm.
        area_mm2: approximate area.
        nearest_component: name of the component nearest to its farthest point.
        distance_mm: of its farthest point from the CAD.
    """

    center_in_model: Array
    size_mm: Array
    area_mm2: float
    nearest_component: str
    distance_mm: float

    def describe(self) -> str:
        """One line for the report."""
        x, y, z = self.center_in_model
        a, b, c = self.size_mm
        return (
            f"foreign object at ({x:.1f}, {y:.1f}, {z:.1f}) mm, {a:.0f} × {b:.0f} × {c:.0f} mm, up to "
            f"{self.distance_mm:.1f} mm from {self.nearest_component}"
        )


def find_foreign(
    cloud: DenseCloud,
    model: Model,
    places: Mapping[str, Array] | None = None,
    unknown: Sequence[str] = (),
) -> list[ForeignObject]:
    """Find objects inside the model's bounding box that are far from all of its surfaces, largest first.

    Args:
        cloud: in mm, in the frame of the CAD.
        model: the nominal CAD.
        places: (4,4) ``measured_from_nominal`` by component, so that displaced components are not foreign objects.
        unknown: components that are present but could not be measured; their surroundings are ignored.

    Raises:
        InputError: the cloud has no points in the box.
    """
    from scipy.ndimage import label

    # The borders of the box are left out: what lies below and around the part appears there.
    points = prepare_cloud(cloud, model.bounds_in_model + np.array([[FAR_MM], [-FAR_MM]]), GRID_MM, 1).points
    places = places or {}
    _, faces, groups = model.mesh
    parts = [apply(places.get(c.name, np.eye(4)), c.vertices_in_model) for c in model.components]
    surface = MeshSurface(np.concatenate(parts), faces, groups)
    far = points[surface.closest(points, FAR_MM).faces < 0]
    for name in unknown:
        low, high = model.component(name).bounds_in_model
        reach = float(np.linalg.norm(high - low))
        far = far[~np.all((far > low - reach) & (far < high + reach), axis=1)]
    if len(far) == 0:
        return []
    cell_mm = max(CELL_MM, model.diameter_mm / 400.0)
    cell = np.floor((far - far.min(axis=0)) / cell_mm).astype(np.int64)
    filled = np.zeros(cell.max(axis=0) + 1, dtype=bool)
    filled[tuple(cell.T)] = True
    of_cell, count = label(filled, np.ones((3, 3, 3)))
    owner = of_cell[tuple(cell.T)]
    found = []
    for index in range(1, count + 1):
        mine = far[owner == index]
        area = len(mine) * GRID_MM**2
        if area < MIN_AREA_MM2:
            continue
        closest = surface.closest(mine)
        farthest = int(np.argmax(np.abs(closest.distances)))
        name = model.components[int(groups[closest.faces[farthest]])].name
        low, high = mine.min(axis=0), mine.max(axis=0)
        distance = float(np.abs(closest.distances[farthest]))
        found.append(ForeignObject(0.5 * (low + high), high - low, area, name, distance))
    return sorted(found, key=lambda item: -item.area_mm2)
