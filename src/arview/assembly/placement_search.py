"""Search for components at alternative placements, or swapped with one another.

A misplaced component leaves little trace at its nominal placement when something hides that place, or when it moved
along the line of sight; at its actual placement it is as visible as any other. The presence network is therefore
applied to placements around components that are not verified. Its log odds at the nominal placement less those at the
best alternative are a generalised log-likelihood ratio (Neyman and Pearson, 1933), from which the cost of choosing
among many placements is subtracted (Bonferroni's correction for multiple tests).
"""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.assembly.placements import Placements, Swap
from arview.assembly.presence_net import ComponentCrop, PartImage, PresenceNet, component_crops
from arview.detection import BAND_PX
from arview.geometry import Array
from arview.guideviews import Surface

_NEIGHBOURS = np.array([(x, y) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)])
"""Steps from a placement to those around it, and to itself."""


KEPT_PER_COMPONENT = 2
"""Placements of a component that the first refinement starts from."""
REFINEMENT_STEPS: tuple[float, ...] = (0.5, 0.25)
"""Grid steps of the refinements around the best placements."""
MAX_NOMINAL = 1.5
"""Cap on the log odds against the nominal placement, which are evidence by themselves already."""
HIDDEN_NOMINAL = -0.5
"""Log odds that are assumed where the nominal placement is not visible."""
MIN_NOMINAL = -2.5
"""Components with lower log odds against their nominal placement are not searched for."""
SWAP_MARGIN = 1.0
"""Swaps are dropped if their log odds, without mirrored crops, are below the choice cost by more."""
MAX_SCORED = 10
"""Placements of a component that the network scores, those with the best edge responses."""
MAX_PLACEMENTS = 800
"""Placements tried in one picture, over all components."""
MAX_COMPONENTS = 20
"""Components searched for in one picture, those with most against their nominal placement."""
OUTLINE_PX = 1.5
"""Edges this near to a component's outline count for its edge response."""
CHOICE_COST = 2.5
"""Subtracted from the log odds for having chosen among many placements."""
SLOPE = 2.0
"""Weight of the remaining log odds."""


class Alternatives(NamedTuple):
    """The best alternative placement of each component.

    Attributes:
        log_odds: (C,) of "there" to "at the nominal placement"; -inf where nothing was searched for or visible.
        shifts: (C,3) mm from nominal, in the model frame.
    """

    log_odds: Array
    shifts: Array


class _Placement(NamedTuple):
    """A component, its shift (3,) mm from nominal, and the component that is removed to make room, -1: none."""

    component: int
    shift: Array
    removed: int = -1


class _Scored(NamedTuple):
    """A placement, and the crop of its component there."""

    placement: _Placement
    crop: ComponentCrop


class PlacementSearch:
    """Searches for the components of one part at alternative placements.

    Args:
        placements: of the model.
        surface: of the part, about its centre.
        diameter_mm: of the part.
        network: predicts whether a component is at a placement.
    """

    def __init__(
        self,
        placements: Placements,
        surface: Surface,
        diameter_mm: float,
        network: PresenceNet,
    ) -> None:
        self._placements, self._diameter_mm, self._network = placements, diameter_mm, network
        self._surface, self._starts = _by_component(surface, len(placements.shifts))

    def search(self, picture: PartImage, nominal: Array, is_searched: NDArray[np.bool_]) -> Alternatives:
        """The best alternative placements.

        Args:
            picture: around the part.
            nominal: (C,) the network's log odds against the nominal placements, NaN where these are not visible.
            is_searched: (C,) components that are searched for.
        """
        nominal = np.where(np.isnan(nominal), HIDDEN_NOMINAL, np.minimum(nominal, MAX_NOMINAL))
        searched = self._affordable(np.flatnonzero(is_searched & (nominal > MIN_NOMINAL)), nominal)
        placements = [_Placement(index, shift) for index in searched for shift in self._placements.shifts[index]]
        found = self._best(placements, picture, KEPT_PER_COMPONENT)
        for step in REFINEMENT_STEPS:
            placements = [
                _Placement(one.component, one.shift + step * self._placements.step_mm * neighbour @ along_base)
                for one in found
                for along_base in [self._placements.along_base[one.component]]
                for neighbour in _NEIGHBOURS
            ]
            found = self._best(placements, picture)
        alternative = np.full(len(nominal), -np.inf)
        components = [one.component for one in found]
        alternative[components] = nominal[components] - self._network_log_odds(found, picture)
        shifts = np.zeros((len(nominal), 3))
        for one in found:
            shifts[one.component] = one.shift
        swaps = [swap for swap in self._placements.swaps if swap.first in searched and swap.second in searched]
        swap_log_odds = self._swap_log_odds(swaps, nominal, picture, is_mirrored=False)
        is_likely = swap_log_odds > CHOICE_COST - SWAP_MARGIN
        swaps = [swap for swap, likely in zip(swaps, is_likely, strict=True) if likely]
        for swap, log_odds in zip(swaps, self._swap_log_odds(swaps, nominal, picture), strict=True):
            for component, shift in ((swap.first, swap.shift), (swap.second, -swap.shift)):
                if log_odds > alternative[component]:
                    alternative[component], shifts[component] = log_odds, shift
        return Alternatives(np.asarray(SLOPE * (alternative - CHOICE_COST)), shifts)

    def _swap_log_odds(self, swaps: list[Swap], nominal: Array, picture: PartImage, is_mirrored: bool = True) -> Array:
        """Log odds (N,) that pairs of components are swapped: of each one in the other's place."""
        placements = [
            placement
            for one, other, shift in swaps
            for placement in (_Placement(one, shift, other), _Placement(other, -shift, one))
        ]
        there, here = self._network_log_odds(placements, picture, is_mirrored).reshape(-1, 2).T
        pairs = np.array([swap[:2] for swap in swaps], dtype=np.intp).reshape(-1, 2)
        swapped = np.nan_to_num(nominal[pairs[:, 1]] - there) + np.nan_to_num(nominal[pairs[:, 0]] - here)
        return np.where(np.isnan(there) & np.isnan(here), -np.inf, swapped)

    def _affordable(self, indices: NDArray[np.intp], nominal: Array) -> list[int]:
        """Those of some components with most against their nominal placement, as many as the budget allows."""
        in_order = indices[np.argsort(-nominal[indices], kind="stable")]
        in_order = in_order[:MAX_COMPONENTS]
        counts = np.cumsum([len(self._placements.shifts[index]) for index in in_order])
        affordable = int(np.searchsorted(counts, MAX_PLACEMENTS, side="right"))
        return sorted(in_order[: max(1, affordable)].tolist())

    def _best(self, placements: list[_Placement], picture: PartImage, kept: int = 1) -> list[_Placement]:
        """The placements of each component with the lowest log odds against them; none where it is visible at none."""
        scored = [_Scored(one, crop) for one in placements if (crop := self._crop(one, picture)) is not None]
        responses = np.array([self._edge_response(crop) for _, crop in scored])
        in_order = [scored[k] for k in np.argsort(-responses, kind="stable")]
        scored = _first_of_each(in_order, MAX_SCORED)
        log_odds = self._network.log_odds([crop for _, crop in scored], is_mirrored=False)
        return [one for one, _ in _first_of_each([scored[k] for k in np.argsort(log_odds)], kept)]

    def _network_log_odds(self, placements: list[_Placement], picture: PartImage, is_mirrored: bool = True) -> Array:
        """The network's log odds (N,) against components at placements; NaN where they are not visible."""
        log_odds = np.full(len(placements), np.nan)
        crops = [self._crop(one, picture) for one in placements]
        visible = [crop for crop in crops if crop is not None]
        log_odds[[crop is not None for crop in crops]] = self._network.log_odds(visible, is_mirrored)
        return log_odds

    def _crop(self, placement: _Placement, picture: PartImage) -> ComponentCrop | None:
        """Crop of a component at a placement; None where too little of it is visible."""
        crops = component_crops(picture, self._placed(placement), self._diameter_mm, [placement.component])
        return crops[0] if crops else None

    def _placed(self, placement: _Placement) -> Surface:
        """The surface with a component at a placement."""
        points = self._surface.points.copy()
        first, last = self._starts[placement.component], self._starts[placement.component + 1]
        points[first:last] += placement.shift.astype(np.float32)
        placed = self._surface._replace(points=points)
        if placement.removed < 0:
            return placed
        is_left = placed.component != placement.removed
        return placed._replace(
            faces=placed.faces[is_left], normals=placed.normals[is_left], component=placed.component[is_left]
        )

    def _edge_response(self, crop: ComponentCrop) -> float:
        """Mean response, 0–255, of the edge network along a component's drawn edges."""
        edges = np.where(crop.drawn[0] < OUTLINE_PX / BAND_PX, crop.drawn[1], 0.0)
        return float(np.sum(edges * crop.edge_responses[0]) / max(float(np.sum(edges)), 1.0))


def _first_of_each(scored: list[_Scored], count: int) -> list[_Scored]:
    """The first few crops of each component, in order."""
    counts: Counter[int] = Counter()
    first = []
    for one in scored:
        if counts[one.placement.component] < count:
            counts[one.placement.component] += 1
            first.append(one)
    return first


def _by_component(surface: Surface, count: int) -> tuple[Surface, list[int]]:
    """A surface of which no two components share points, sorted by component, and the first point of each."""
    parts, starts = [], [0]
    for index in range(count):
        own = surface.component == index
        used, places = np.unique(surface.faces[own], return_inverse=True)
        faces: NDArray[np.int32] = np.array(places.reshape(-1, 3) + starts[-1], dtype=np.int32)
        parts.append(Surface(surface.points[used], faces, surface.normals[own], surface.component[own]))
        starts.append(starts[-1] + len(used))
    return Surface(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True))), starts
