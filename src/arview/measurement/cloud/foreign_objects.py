"""Foreign objects: surfaces in the cloud that belong to no component of the CAD."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from arview.cad import Model
from arview.geometry import Array, apply
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.cloud.points import CloudPoints, prepare_cloud
from arview.reconstruction import DenseCloud
from arview.rendering.mesh_edges import mesh_edges

FAR_MM = 4.0
"""Points nearer to an edge of the CAD, with components at their measured places, belong to it or to a weld."""
LOW_MM = 1.0
"""Points on the middle of a face are never told from it below this height …."""
NOISE_FACTOR = 6.0
"""… nor below the median distance of its component's points and this multiple of their scatter."""
MIN_FACING = 0.3
"""Cosine between the normals of a low object and of the face below it; both are seen from the same side."""
CELL_MM = 2.0
"""Points in touching cells of this size form one object."""
MIN_AREA_MM2 = 40.0
"""Smaller objects of the least height are spatter or wrong points …."""
HEIGHT_MM = 8.0
"""… and half the area is enough for each of these more."""
MIN_WIDTH_MM = 2.5
"""Standard deviation of an object's points across it; long and narrower ones are the blurred outline of an edge."""
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
    points = prepare_cloud(cloud, model.bounds_in_model + np.array([[LOW_MM], [-LOW_MM]]), GRID_MM, 1)
    places = places or {}
    _, faces, groups = model.mesh
    parts = [apply(places.get(c.name, np.eye(4)), c.vertices_in_model) for c in model.components]
    surface = MeshSurface(np.concatenate(parts), faces, groups)
    edges = cKDTree(_edge_points(model, places))
    far = points.points[_is_beside(points, surface, edges, model)]
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
    owner, found = of_cell[tuple(cell.T)], []
    for index in range(1, count + 1):
        mine = far[owner == index]
        area = len(mine) * GRID_MM**2
        if area < 0.25 * MIN_AREA_MM2:
            continue
        closest = surface.closest(mine)
        farthest = int(np.argmax(np.abs(closest.distances)))
        height = float(np.abs(closest.distances[farthest]))
        spread = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(mine.T)), 0.0))
        is_sliver = spread[1] < min(MIN_WIDTH_MM, spread[2] / 4.0)
        if area * (1.0 + max(0.0, height - FAR_MM) / HEIGHT_MM) < MIN_AREA_MM2 or is_sliver:
            continue
        name = model.components[int(groups[closest.faces[farthest]])].name
        low, high = mine.min(axis=0), mine.max(axis=0)
        found.append(ForeignObject(0.5 * (low + high), high - low, area, name, height))
    return sorted(found, key=lambda item: -item.area_mm2)


def _is_beside(cloud: CloudPoints, surface: MeshSurface, edges: cKDTree, model: Model) -> NDArray[np.bool_]:
    """(N,) which points are too far from the CAD to be of it.

    In the middle of a face the height that counts follows from the noise of the cloud there; near edges, where clouds
    bulge and welds lie, it is that of a weld.
    """
    points = cloud.points
    closest = surface.closest(points, 2.0 * FAR_MM)
    heights = np.where(closest.faces >= 0, closest.distances, np.inf)
    inner = model.bounds_in_model + np.array([[FAR_MM], [-FAR_MM]])
    beside = (np.abs(heights) > FAR_MM) & np.all((points > inner[0]) & (points < inner[1]), axis=1)
    is_low = (heights > LOW_MM) & (heights <= FAR_MM) & ~closest.is_edge
    is_low &= np.sum(cloud.normals * closest.normals, axis=1) > MIN_FACING
    is_low[is_low] = edges.query(points[is_low], distance_upper_bound=FAR_MM)[0] > FAR_MM
    owner = surface.groups[closest.faces]
    for index in np.unique(owner[is_low]):
        own = (owner == index) & ~closest.is_edge & (np.abs(heights) < FAR_MM)
        middle = float(np.median(heights[own]))
        scatter = 1.4826 * float(np.median(np.abs(heights[own] - middle)))
        is_low &= (owner != index) | (heights > abs(middle) + NOISE_FACTOR * scatter)
    return np.asarray(beside | is_low)


def _edge_points(model: Model, places: Mapping[str, Array]) -> Array:
    """(N,3) points along the sharp edges of all components at their places, mm."""
    edges = mesh_edges(model)
    ends = edges.vertices_in_model[edges.ends[edges.is_sharp]]
    owner = edges.component[edges.is_sharp]
    counts = np.ceil(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)).astype(np.int64) + 1
    which = np.repeat(np.arange(len(ends)), counts)
    share = (np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)) / np.maximum(counts[which] - 1, 1)
    points = ends[which, 0] + share[:, None] * (ends[which, 1] - ends[which, 0])
    for index, component in enumerate(model.components):
        if component.name in places:
            of = owner[which] == index
            points[of] = apply(places[component.name], points[of])
    return points
