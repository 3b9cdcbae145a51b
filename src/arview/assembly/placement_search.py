"""Components that stand elsewhere: whether one is seen at another place on what it is mounted on.

A component that was mounted at the wrong place leaves little trace where the CAD has it when something else hides that
place, or when it moved along the line of sight; where it stands now it is seen as well as any. So for each component
that is not surely right, it is asked of places around what the component network says of it there: the difference to
what is said of its own place is a log-likelihood ratio of the two hypotheses, of which the best of many places, and
what it costs to have the choice, remain (generalised likelihood ratio, Neyman & Pearson 1933; the cost is that of
Bonferroni's many tests). For two components that may have changed places, what each place says of one is held against
what it says of the other.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from arview.assembly.presence_net import (
    ComponentLook,
    ComponentNetwork,
    component_looks,
)
from arview.cad.fitness import face_areas
from arview.cad.model import Model
from arview.cad.samples import Samples, sample_surface
from arview.detection.scoring.pose_verifier import BAND_PX
from arview.geometry import Array
from arview.guideviews.surface import Surface

SAMPLES, SPACING_SHARE = 4000, 0.01
"""Samples of a component at most, and their distance in diameters of the part."""
TOUCH_SHARE, LEAST_TOUCHING, LEAST_FLAT = 0.004, 0.01, 0.9
"""A component is mounted on a larger one when such a share of it is within such a share of the diameter of the other's
surface, and that is flat there: the mean of its normals is so long."""
REACH_MM, REACH_SHARE, STEPS = 30.0, 0.15, 4
"""Places as far away are looked at, in mm and in diameters of the part, in so many steps."""
LEAST_STEPS = 0.9
"""Nearer places look as the component's own."""
OVERHANG_STEPS, CLEAR_SHARE = 0.6, 0.002
"""A component may stick out beyond what it is mounted on so many steps, and must be clear of others by such a share of
the diameter."""


Swap = tuple[int, int, Array]
"""Two components, and (3,) mm from the first one's foot to the second one's."""


@dataclass(frozen=True)
class Places:
    """Where components may stand instead.

    Attributes:
        shifts: of each component, (N,3) mm to free places along what it is mounted on.
        across: of each component, (2,3) unit vectors along that.
        step_mm: between places.
        swaps: pairs of components that are mounted on the same one.
    """

    shifts: tuple[Array, ...]
    across: tuple[Array, ...]
    step_mm: float
    swaps: tuple[Swap, ...]


def other_places(model: Model) -> Places:
    """Places where the components of a model may stand, by what they touch and what is in the way."""
    samples = [sample_surface(one, SPACING_SHARE * model.diameter_mm, SAMPLES) for one in model.components]
    areas = [float(face_areas(one.vertices_in_model, one.faces.astype(np.int64)).sum()) for one in model.components]
    step_mm = min(REACH_MM, REACH_SHARE * model.diameter_mm) / STEPS
    axis = step_mm * np.arange(-STEPS, STEPS + 1)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    far = np.linalg.norm(grid, axis=1)
    grid = grid[(far >= LEAST_STEPS * step_mm) & (far <= axis[-1])]
    shifts, across, feet = [], [], []
    mounted = [_mounted_on(index, model, samples, areas) for index in range(len(model.components))]
    corners = [one.vertices_in_model[np.unique(one.faces)] for one in model.components]
    clear_mm = CLEAR_SHARE * model.diameter_mm
    for index, (base, normal) in enumerate(mounted):
        frame = np.linalg.svd(normal[None])[2]
        frame[0] = normal
        boxes = np.array([(along.min(axis=0), along.max(axis=0)) for along in (one @ frame.T for one in corners)])
        free = grid[_free(index, base, boxes, grid, OVERHANG_STEPS * step_mm, clear_mm)] if base >= 0 else grid[:0]
        shifts.append(free @ frame[1:])
        across.append(frame[1:])
        # The middle of its box, at the bottom.
        feet.append(np.array([boxes[index, 0, 0], *boxes[index, :, 1:].mean(axis=0)]) @ frame)
    swaps = [
        (one, other, feet[other] - feet[one])
        for one, other in combinations(range(len(mounted)), 2)
        if mounted[one][0] == mounted[other][0] >= 0 and mounted[one][1] @ mounted[other][1] > LEAST_FLAT
    ]
    return Places(tuple(shifts), tuple(across), step_mm, tuple(swaps))


def _mounted_on(index: int, model: Model, samples: Sequence[Samples], areas: Sequence[float]) -> tuple[int, Array]:
    """The larger component that one touches most, -1 if none, and the normal (3,) of its surface there."""
    touch_mm, spacing_mm = TOUCH_SHARE * model.diameter_mm, 2.0 * SPACING_SHARE * model.diameter_mm
    points, found, most = samples[index].points, (-1, np.array([0.0, 0.0, 1.0])), LEAST_TOUCHING
    if len(points) == 0:
        return found
    low, high = points.min(axis=0) - touch_mm, points.max(axis=0) + touch_mm
    for other, on in enumerate(samples):
        other_low, other_high = model.components[other].bounds_in_model
        if areas[other] <= areas[index] or (other_low > high).any() or (other_high < low).any():
            continue
        near = on.of(((on.points >= low - spacing_mm) & (on.points <= high + spacing_mm)).all(axis=1))
        if len(near.points) == 0:
            continue
        distance, nearest = cKDTree(near.points).query(points)
        normals = near.normals[nearest]
        gaps = np.abs(np.sum((points - near.points[nearest]) * normals, axis=1))
        touches = (distance < spacing_mm) & (gaps < touch_mm)
        if np.mean(touches) > most:
            mean = normals[touches].mean(axis=0)
            if np.linalg.norm(mean) > LEAST_FLAT:
                found, most = (other, mean / np.linalg.norm(mean)), float(np.mean(touches))
    return found


def _free(index: int, base: int, boxes: Array, grid: Array, over_mm: float, clear_mm: float) -> NDArray[np.bool_]:
    """(N,) which shifts (N,2) along a base leave a component on it and clear of the others.

    Args:
        boxes: (C,2,3) lowest and highest coordinates of all components: away from the base and along it.
        over_mm, clear_mm: how far it may stick out beyond the base, and how far others may overlap.
    """
    low, high = boxes[index, 0, 1:] + grid, boxes[index, 1, 1:] + grid
    is_free = ((low >= boxes[base, 0, 1:] - over_mm) & (high <= boxes[base, 1, 1:] + over_mm)).all(axis=1)
    is_beside = (boxes[:, 0, 0] >= boxes[index, 1, 0] - clear_mm) | (boxes[:, 1, 0] <= boxes[index, 0, 0] + clear_mm)
    is_beside[[index, base]] = True
    for other_low, other_high in boxes[~is_beside, :, 1:]:
        is_free &= ((low >= other_high - clear_mm) | (high <= other_low + clear_mm)).any(axis=1)
    return np.asarray(is_free)


AROUND = np.array([(x, y) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)])
"""Steps around a place."""
GONE_ON_WITH = 2
"""So many of a component's places are gone on with from the first step."""
CLOSER = (0.5, 0.25)
"""Around the best place it is looked again, such shares of a step away."""
MOST_AT_HOME, UNSEEN = 1.5, -0.5
"""Against a component at its own place no more is counted, for that is told of it anyway, and this of one that is not
seen there."""
SWAP_MARGIN = 1.0
"""Two components may have changed places when what speaks for it, seen in no mirror, is at most so much too little."""
MOST_TRIED = 10
"""Of the places of a component the network is shown those whose edges lie best on lines."""
MOST_PLACES, MOST_COMPONENTS = 800, 20
"""In one picture: of large assemblies only the components that are likeliest elsewhere are looked for."""
AT_HOME = -2.5
"""A component of which less is said stands where it should."""
SLOPE, CHOICE = 2.0, 2.5
"""Of what is left of the difference when the choice among many places is paid for, so much counts. Of 291 wrong
components in 255 pictures of look-alikes 162 have a difference above 3, 19 of them in the 31 pictures in which what is
seen of their own place did not give them away; of 5,063 right ones, half in pictures with noise, an occluder or of a
real plate, eight have."""


class _Place(NamedTuple):
    """A component, how far it is shifted (3,) mm, and the component that is left out to make room, -1: none."""

    component: int
    shift: Array
    left_out: int = -1


class _View(NamedTuple):
    """A picture around the part, see `component_looks`."""

    window: NDArray[np.uint8]
    answers: NDArray[np.uint8]
    intrinsics: Array
    cam_from_body: Array


class ElsewhereSearch:
    """Looks for components at other places.

    Args:
        places: of the model.
        surface: of the part, about its centre.
        diameter_mm: of the part.
        network: what says whether a component stands at a place.
    """

    def __init__(self, places: Places, surface: Surface, diameter_mm: float, network: ComponentNetwork) -> None:
        self._places, self._diameter_mm, self._network = places, diameter_mm, network
        self._surface, self._starts = _by_component(surface, len(places.shifts))

    def against(
        self,
        window: NDArray[np.uint8],
        answers: NDArray[np.uint8],
        intrinsics: Array,
        cam_from_body: Array,
        at_home: Array,
        is_open: NDArray[np.bool_],
    ) -> Array:
        """What speaks for components' standing elsewhere.

        Args:
            window, answers, intrinsics, cam_from_body: see `component_looks`.
            at_home: (C,) log-likelihood ratios of "not here" to "here" at the components' own places, NaN where these
                are not seen.
            is_open: (C,) which components are looked for.

        Returns:
            (C,) log-likelihood ratios of "elsewhere" to "where expected"; -inf where nothing was looked for or seen.
        """
        view = _View(window, answers, intrinsics, cam_from_body)
        home = np.where(np.isnan(at_home), UNSEEN, np.minimum(at_home, MOST_AT_HOME))
        looked_for = self._worth_it(np.flatnonzero(is_open & (home > AT_HOME)), home)
        places = [_Place(index, shift) for index in looked_for for shift in self._places.shifts[index]]
        found = self._likeliest(places, view, GONE_ON_WITH)
        for share in CLOSER:
            places = [
                _Place(place.component, place.shift + share * self._places.step_mm * step @ across)
                for place in found
                for across in [self._places.across[place.component]]
                for step in AROUND
            ]
            found = self._likeliest(places, view)
        elsewhere = np.full(len(home), -np.inf)
        components = [place.component for place in found]
        elsewhere[components] = home[components] - self._ratios(found, view)
        swaps = [swap for swap in self._places.swaps if swap[0] in looked_for and swap[1] in looked_for]
        likely = self._changed(swaps, home, view, in_mirrors=False) > CHOICE - SWAP_MARGIN
        swaps = [swap for swap, is_likely in zip(swaps, likely, strict=True) if is_likely]
        for (one, two, _), changed in zip(swaps, self._changed(swaps, home, view), strict=True):
            elsewhere[[one, two]] = np.maximum(elsewhere[[one, two]], changed)
        return np.asarray(SLOPE * (elsewhere - CHOICE))

    def _changed(self, swaps: list[Swap], home: Array, view: _View, in_mirrors: bool = True) -> Array:
        """What speaks for components having changed places (N,): of each pair what it is at the two places."""
        places = [place for one, two, way in swaps for place in (_Place(one, way, two), _Place(two, -way, one))]
        there, here = self._ratios(places, view, in_mirrors).reshape(-1, 2).T
        pairs = np.array([swap[:2] for swap in swaps], dtype=np.intp).reshape(-1, 2)
        changed = np.nan_to_num(home[pairs[:, 1]] - there) + np.nan_to_num(home[pairs[:, 0]] - here)
        return np.where(np.isnan(there) & np.isnan(here), -np.inf, changed)

    def _worth_it(self, indices: NDArray[np.intp], home: Array) -> list[int]:
        """Of some components those that are least likely at home, as many as may be looked for in one picture."""
        in_order = indices[np.argsort(-home[indices], kind="stable")]
        in_order = in_order[:MOST_COMPONENTS]
        places = np.cumsum([len(self._places.shifts[index]) for index in in_order])
        return sorted(in_order[: max(1, int(np.searchsorted(places, MOST_PLACES, side="right")))].tolist())

    def _likeliest(self, places: list[_Place], view: _View, kept: int = 1) -> list[_Place]:
        """Of the places of each component those that look most like it; none where it is seen at none."""
        seen = [(place, look) for place in places if (look := self._look(place, view)) is not None]
        on_lines = np.array([_on_lines(look) for _, look in seen])
        seen = _first_of_each([seen[k] for k in np.argsort(-on_lines, kind="stable")], MOST_TRIED)
        ratios = self._network.ratios([look for _, look in seen], in_mirrors=False)
        return [place for place, _ in _first_of_each([seen[k] for k in np.argsort(ratios)], kept)]

    def _ratios(self, places: list[_Place], view: _View, in_mirrors: bool = True) -> Array:
        """What the network says (N,) of components at places; NaN where they are not seen."""
        ratios = np.full(len(places), np.nan)
        looks = [self._look(place, view) for place in places]
        ratios[[look is not None for look in looks]] = self._network.ratios(
            [look for look in looks if look is not None], in_mirrors
        )
        return ratios

    def _look(self, place: _Place, view: _View) -> ComponentLook | None:
        """A look at a component at a place; None where it is not seen."""
        moved = self._moved(place)
        looks = component_looks(*view[:3], moved, self._diameter_mm, view.cam_from_body, [place.component])
        return looks[0] if looks else None

    def _moved(self, place: _Place) -> Surface:
        """The surface with a component at a place."""
        points = self._surface.points.copy()
        points[self._starts[place.component] : self._starts[place.component + 1]] += place.shift.astype(np.float32)
        moved = self._surface._replace(points=points)
        if place.left_out < 0:
            return moved
        is_left = moved.component != place.left_out
        return moved._replace(
            faces=moved.faces[is_left], normals=moved.normals[is_left], component=moved.component[is_left]
        )


def _first_of_each(seen: list[tuple[_Place, ComponentLook]], most: int) -> list[tuple[_Place, ComponentLook]]:
    """The first few looks at each component, in order."""
    counts: Counter[int] = Counter()
    first = []
    for place, look in seen:
        if counts[place.component] < most:
            counts[place.component] += 1
            first.append((place, look))
    return first


def _on_lines(look: ComponentLook) -> float:
    """How much of what a component's edges would show there the line network sees, 0–255."""
    edges = np.where(look.drawn[0] < 1.5 / BAND_PX, look.drawn[1], 0.0)
    return float(np.sum(edges * look.lines[0]) / max(float(np.sum(edges)), 1.0))


def _by_component(surface: Surface, count: int) -> tuple[Surface, list[int]]:
    """A surface of which no two components share points, in order of these, and where each one's points start."""
    parts, starts = [], [0]
    for index in range(count):
        own = surface.component == index
        used, places = np.unique(surface.faces[own], return_inverse=True)
        faces: NDArray[np.int32] = np.array(places.reshape(-1, 3) + starts[-1], dtype=np.int32)
        parts.append(Surface(surface.points[used], faces, surface.normals[own], surface.component[own]))
        starts.append(starts[-1] + len(used))
    return Surface(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True))), starts
