"""Alternative placements: where else a component can be mounted, by what it touches and what is in the way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from arview.cad import Model, Samples, face_areas, sample_surface
from arview.geometry import Array

MAX_SAMPLES = 4000
"""Samples of a component's surface."""
SPACING_SHARE = 0.01
"""Distance between samples of a component's surface, in diameters of the part."""
TOUCH_SHARE = 0.004
"""Distance, in diameters of the part, below which surfaces touch."""
MIN_TOUCHING = 0.01
"""Share of a component's samples that must touch what it is mounted on."""
MIN_FLATNESS = 0.9
"""Length of the mean normal of the touched surface; 1 is flat. Also the cosine between the normals of two components'
bases that can be swapped."""
REACH_MM = 30.0
"""Largest distance of an alternative placement."""
REACH_SHARE = 0.15
"""Largest distance of an alternative placement in diameters of the part; the smaller of it and ``REACH_MM`` holds."""
STEPS = 4
"""Grid steps up to the largest distance of an alternative placement."""
MIN_STEPS = 0.9
"""Nearer placements, in steps, cannot be distinguished from the nominal one."""
OVERHANG_STEPS = 0.6
"""Grid steps by which a component may extend beyond its base."""
CLEAR_SHARE = 0.002
"""Distance, in diameters of the part, by which an alternative placement may overlap other components."""


class Swap(NamedTuple):
    """Two components on one base, and (3,) mm from the foot of the first to that of the second."""

    first: int
    second: int
    shift: Array


@dataclass(frozen=True)
class Placements:
    """Alternative placements of the components of a model.

    Attributes:
        shifts: of each component, (N,3) mm from its nominal to free placements on its base.
        along_base: of each component, (2,3) unit vectors along its base.
        step_mm: grid step.
        swaps: pairs of components that can be swapped.
    """

    shifts: tuple[Array, ...]
    along_base: tuple[Array, ...]
    step_mm: float
    swaps: tuple[Swap, ...]


def alternative_placements(model: Model) -> Placements:
    """Alternative placements of all components of a model; the largest component, and loose ones, have none."""
    diameter_mm = model.diameter_mm
    samples = [sample_surface(one, SPACING_SHARE * diameter_mm, MAX_SAMPLES) for one in model.components]
    areas = [float(face_areas(one.vertices_in_model, one.faces.astype(np.int64)).sum()) for one in model.components]
    step_mm = min(REACH_MM, REACH_SHARE * diameter_mm) / STEPS
    axis = step_mm * np.arange(-STEPS, STEPS + 1)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    distance = np.linalg.norm(grid, axis=1)
    grid = grid[(distance >= MIN_STEPS * step_mm) & (distance <= axis[-1])]
    shifts, along_base, feet = [], [], []
    mounted = [_base_of(index, model, samples, areas) for index in range(len(model.components))]
    corners = [one.vertices_in_model[np.unique(one.faces)] for one in model.components]
    overhang_mm, clear_mm = OVERHANG_STEPS * step_mm, CLEAR_SHARE * diameter_mm
    for index, (base, normal) in enumerate(mounted):
        frame = np.linalg.svd(normal[None])[2]
        frame[0] = normal
        boxes = np.array([(along.min(axis=0), along.max(axis=0)) for along in (one @ frame.T for one in corners)])
        free = grid[_free(index, base, boxes, grid, overhang_mm, clear_mm)] if base >= 0 else grid[:0]
        shifts.append(free @ frame[1:])
        along_base.append(frame[1:])
        # The foot is the centre of the lower face of the component's box.
        feet.append(np.array([boxes[index, 0, 0], *boxes[index, :, 1:].mean(axis=0)]) @ frame)
    swaps = [
        Swap(one, other, feet[other] - feet[one])
        for one, other in combinations(range(len(mounted)), 2)
        if mounted[one][0] == mounted[other][0] >= 0 and mounted[one][1] @ mounted[other][1] > MIN_FLATNESS
    ]
    return Placements(tuple(shifts), tuple(along_base), step_mm, tuple(swaps))


def _base_of(index: int, model: Model, samples: Sequence[Samples], areas: Sequence[float]) -> tuple[int, Array]:
    """The larger component that one touches most, -1 if none, and the normal (3,) of its surface there."""
    touch_mm, spacing_mm = TOUCH_SHARE * model.diameter_mm, 2.0 * SPACING_SHARE * model.diameter_mm
    points, found, max_touching = samples[index].points, (-1, np.array([0.0, 0.0, 1.0])), MIN_TOUCHING
    if len(points) == 0:
        return found
    low, high = points.min(axis=0) - touch_mm, points.max(axis=0) + touch_mm
    for other, base in enumerate(samples):
        other_low, other_high = model.components[other].bounds_in_model
        if areas[other] <= areas[index] or (other_low > high).any() or (other_high < low).any():
            continue
        near = base.of(((base.points >= low - spacing_mm) & (base.points <= high + spacing_mm)).all(axis=1))
        if len(near.points) == 0:
            continue
        distance, nearest = cKDTree(near.points).query(points)
        normals = near.normals[nearest]
        gaps = np.abs(np.sum((points - near.points[nearest]) * normals, axis=1))
        touches = (distance < spacing_mm) & (gaps < touch_mm)
        if np.mean(touches) > max_touching:
            mean = normals[touches].mean(axis=0)
            if np.linalg.norm(mean) > MIN_FLATNESS:
                found, max_touching = (other, mean / np.linalg.norm(mean)), float(np.mean(touches))
    return found


def _free(index: int, base: int, boxes: Array, grid: Array, over_mm: float, clear_mm: float) -> NDArray[np.bool_]:
    """(N,) which shifts (N,2) along a base leave a component on it and clear of the others.

    Args:
        index, base: the component and its base.
        boxes: (C,2,3) lowest and highest coordinates of all components: away from the base and along it.
        grid: (N,2) shifts in mm.
        over_mm, clear_mm: how far it may stick out beyond the base, and how far it may overlap others.
    """
    low, high = boxes[index, 0, 1:] + grid, boxes[index, 1, 1:] + grid
    is_free = ((low >= boxes[base, 0, 1:] - over_mm) & (high <= boxes[base, 1, 1:] + over_mm)).all(axis=1)
    is_beside = (boxes[:, 0, 0] >= boxes[index, 1, 0] - clear_mm) | (boxes[:, 1, 0] <= boxes[index, 0, 0] + clear_mm)
    is_beside[[index, base]] = True
    for other_low, other_high in boxes[~is_beside, :, 1:]:
        is_free &= ((low >= other_high - clear_mm) | (high <= other_low + clear_mm)).any(axis=1)
    return np.asarray(is_free)
