"""Look-alikes: assemblies with one fault against their CAD, and the share of a picture in which it shows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np

from arview.cad.model import Component, Model, make_model
from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array
from arview.rendering.renderers import ZBufferRenderer

Fault = Literal["missing", "moved", "swapped"]

MOVED_MM = 20.0
"""Distance by which a component is displaced."""
MIN_RATIO, MAX_RATIO = 1.15, 3.0
"""Size ratios of components that are swapped: different, but similar enough to be confused."""
_TOUCH_MM = 0.5
"""Boxes may overlap by this much."""
_DIRECTIONS = 16
"""Directions in which a displacement is tried."""
_DIFFERENT_DEPTH_MM = 1.0
"""Depths that differ by more are different."""


@dataclass(frozen=True)
class LookAlike:
    """An assembly with a fault.

    Attributes:
        name: of the variant, for file names: ``missing_post_1``, ``swapped_nut_1_rail_1``.
        fault: a component missing, displaced along its base, or two components swapped.
        components: names of the faulty components.
        model: of the faulty assembly.
    """

    name: str
    fault: Fault
    components: tuple[str, ...]
    model: Model


def look_alikes(model: Model, moved_mm: float = MOVED_MM) -> tuple[LookAlike, ...]:
    """Look-alikes of an assembly: each component but the base missing, each displaced, and pairs swapped.

    The base is the component with the largest box. Components are displaced along its two longer sides, in a direction
    that keeps them on the base and clear of the others, if there is one. Pairs of the most similar sizes are swapped
    where both fit, each component once.

    Raises:
        InputError: a model of one component.
    """
    if len(model.components) < 2:
        raise InputError(f"model {model.name!r} has one component; look-alikes need an assembly")
    base = max(model.components, key=lambda c: float(np.prod(np.ptp(c.bounds_in_model, axis=0) + 1e-3)))
    upright = int(np.argmin(np.ptp(base.bounds_in_model, axis=0)))
    others = [component for component in model.components if component is not base]
    found = [
        LookAlike(f"missing_{part.name}", "missing", (part.name,), _with(model, {part.name: None})) for part in others
    ]
    for part in others:
        shift = _free_shift(part, base, others, upright, moved_mm)
        if shift is not None:
            changed = _with(model, {part.name: _shifted(part, shift)})
            found.append(LookAlike(f"moved_{part.name}", "moved", (part.name,), changed))
    swapped: set[str] = set()
    for one, other in sorted(combinations(others, 2), key=lambda pair: _size_ratio(*pair)):
        if {one.name, other.name} & swapped or not MIN_RATIO <= _size_ratio(one, other) <= MAX_RATIO:
            continue
        foot = _foot(other, upright) - _foot(one, upright)
        there, here = _shifted(one, foot), _shifted(other, -foot)
        rest = [part for part in others if part is not one and part is not other]
        if _is_clear(there, [*rest, here]) and _is_clear(here, rest):
            swapped |= {one.name, other.name}
            changed = _with(model, {one.name: there, other.name: here})
            found.append(LookAlike(f"swapped_{one.name}_{other.name}", "swapped", (one.name, other.name), changed))
    return tuple(found)


def with_absent(model: Model, count: int, rng: np.random.Generator) -> LookAlike:
    """An assembly of which some components, chosen at random, are absent; never its base, which has the largest box.

    Raises:
        InputError: there are fewer components beside the base.
    """
    base = max(model.components, key=lambda c: float(np.prod(np.ptp(c.bounds_in_model, axis=0) + 1e-3)))
    others = [component.name for component in model.components if component is not base]
    if not 1 <= count <= len(others):
        raise InputError(f"model {model.name!r} has {len(others)} components beside its base; {count} cannot be absent")
    names = tuple(sorted(others[k] for k in rng.permutation(len(others))[:count]))
    return LookAlike(f"absent_{count}", "missing", names, _with(model, dict.fromkeys(names)))


def different_share(model: Model, other: Model, camera: Camera, cam_from_model: Array) -> float:
    """Share of the pixels of two models at a pose (4,4) that differ, in depth by over 1 mm or in outline."""
    one, two = (ZBufferRenderer(m, camera).render(cam_from_model).depth_mm for m in (model, other))
    seen = int(np.count_nonzero((one > 0) | (two > 0)))
    differs = int(np.count_nonzero(np.abs(one - two) > _DIFFERENT_DEPTH_MM))
    return differs / seen if seen else 0.0


def _with(model: Model, changes: dict[str, Component | None]) -> Model:
    changed = [changes.get(component.name, component) for component in model.components]
    return make_model(model.name, tuple(component for component in changed if component is not None))


def _shifted(component: Component, shift: Array) -> Component:
    return replace(component, vertices_in_model=component.vertices_in_model + shift)


def _foot(component: Component, upright: int) -> Array:
    """Its foot (3,): the centre of the lower face of its box."""
    foot = component.bounds_in_model.mean(axis=0)
    foot[upright] = component.bounds_in_model[0, upright]
    return np.asarray(foot)


def _free_shift(
    part: Component, base: Component, others: list[Component], upright: int, moved_mm: float
) -> Array | None:
    """Displacement (3,) along the base that keeps a component on it and clear of the others; None if there is none."""
    plane = [axis for axis in range(3) if axis != upright]
    for angle in np.linspace(0.0, 2.0 * np.pi, _DIRECTIONS, endpoint=False):
        shift = np.zeros(3)
        shift[plane] = moved_mm * np.array([np.cos(angle), np.sin(angle)])
        there = _shifted(part, shift)
        low, high = there.bounds_in_model[:, plane]
        is_on_base = np.all(low >= base.bounds_in_model[0, plane]) and np.all(high <= base.bounds_in_model[1, plane])
        if is_on_base and _is_clear(there, [other for other in others if other is not part]):
            return shift
    return None


def _is_clear(part: Component, others: list[Component]) -> bool:
    """True when a component's box touches none of the others' boxes."""
    low, high = part.bounds_in_model
    boxes = [other.bounds_in_model for other in others]
    return all(np.any(low >= box[1] - _TOUCH_MM) or np.any(high <= box[0] + _TOUCH_MM) for box in boxes)


def _size_ratio(one: Component, other: Component) -> float:
    """Ratio of the sides of two boxes in which they differ most."""
    a, b = np.ptp(one.bounds_in_model, axis=0), np.ptp(other.bounds_in_model, axis=0)
    return float(np.max(np.maximum(a, b) / np.maximum(np.minimum(a, b), 1e-3)))
