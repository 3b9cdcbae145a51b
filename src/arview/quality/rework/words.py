"""Names of directions on a part: towards neighbours and datum features, up and down, its sides; never axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from arview.cad import Part
from arview.core.messages import Message, sentence
from arview.geometry import Array

_SIDES = (("front", -90.0), ("back", 90.0), ("left", 180.0), ("right", 0.0))
"""Sides of a part and their azimuth in its upright frame, as in the guide views of these names."""


MAX_ANGLE_DEG = 22.0
"""Largest angle between a move and the direction by which it is called."""
MIN_PAIR_DEG = 40.0
"""Smallest angle between two directions into which a move is divided, and short of opposite ones."""
MIN_REACH_MM = 5.0
"""Nearer targets give no direction."""
MIN_LATERAL_SHARE = 0.5
"""Share of the distance of a target that lies across the direction away from the seat."""
FAR_COST = 0.25
"""Cost of each doubling of the distance beyond the nearest target."""
MAX_FAR_COST = 1.0
"""Largest cost of the distance of a target."""
COMPONENT_COST = 0.1
"""Cost of a component as target, which may be displaced itself; a datum feature is the reference."""
WRONG_COST = 0.6
"""Cost of a component as target that is out of tolerance."""
AWAY_COST = 0.6
"""Cost of "away from", which is followed less surely than "towards", also the farther off."""
SIDE_COST = 1.8
"""Cost of sides of the part, where nothing better is there."""
PAIR_COST = 0.8
"""Cost of two moves instead of one."""
OBLIQUE_COST = 0.6
"""Cost of two directions that are 45° off the right angle."""
DETOUR_COST = 2.0
"""Cost of each length of the move that two steps take more than two at a right angle can."""


@dataclass(frozen=True)
class NamedDirection:
    """A direction and its name.

    Attributes:
        in_model: (3,) unit vector.
        text: ``towards hole_B``.
        cost: directions of lower cost are named first.
    """

    in_model: Array
    text: str | Message
    cost: float = 0.0


@dataclass(frozen=True)
class Target:
    """What a direction can point at.

    Attributes:
        name: as it is called on the part.
        point_in_model: (3,) mm.
        normal_in_model: (3,) of a plane, towards which the direction is its normal; None of all else.
        cost: see `NamedDirection`.
    """

    name: str
    point_in_model: Array
    normal_in_model: Array | None = None
    cost: float = 0.0


@dataclass(frozen=True)
class NamedStep:
    """A part of a vector along one named direction.

    Attributes:
        direction: with its name.
        axis_in_model: (3,) unit vector of this step.
        length: its length.
        row: (3,) by which the length follows from the vector, ``row @ vector``; for the uncertainty.
    """

    direction: NamedDirection
    axis_in_model: Array
    length: float
    row: Array


def up_of(part: Part) -> Array:
    """(3,) unit vector of the model that is up."""
    return part.effective_view_range.up_in_model


def targets_of(part: Part, absent: Sequence[str] = (), wrong: Sequence[str] = ()) -> list[Target]:
    """Components and datum features at which a direction can point.

    Args:
        part: the part.
        absent: components that are missing from the specimen, which are not named.
        wrong: components that are out of tolerance, which are named last.
    """
    features = (
        Target(
            datum.feature_name,
            np.array(datum.point_in_model),
            np.array(datum.direction_in_model) if datum.feature == "plane" else None,
        )
        for datum in part.datums
        if datum.feature != "fit"
    )
    components = (
        Target(one.name, one.bounds_in_model.mean(axis=0), None, COMPONENT_COST + WRONG_COST * (one.name in wrong))
        for one in part.model.components
        if one.name not in absent
    )
    return [*features, *components]


def lateral_directions(
    part: Part,
    targets: Sequence[Target],
    component: str,
    center: Array,
    normal: Array,
    seat: str,
) -> list[NamedDirection]:
    """Directions across a normal that have a name, seen from a point.

    Args:
        part: the part.
        targets: see `targets_of`.
        component: the component that is moved, which is no target.
        center: (3,) the point.
        normal: (3,) unit vector away from the seat.
        seat: name of what it stands on, which is no target either.
    """
    bases = {settings.name for settings in part.settings if settings.role == "base"} | {component, seat}
    aims = [
        (target, *aim)
        for target in targets
        if target.name not in bases and (aim := aim_of(target, center, normal)) is not None
    ]
    nearest = min((reach for _, _, reach in aims), default=1.0)
    found = []
    for target, direction, reach in aims:
        cost = target.cost + min(MAX_FAR_COST, FAR_COST * float(np.log2(reach / nearest)))
        found.append(NamedDirection(direction, sentence("rework.towards", target=target.name), cost))
        found.append(
            NamedDirection(-direction, sentence("rework.away_from", target=target.name), 1.5 * cost + AWAY_COST)
        )
    up = up_of(part)
    rise = across(up, normal)
    if np.linalg.norm(rise) > 0.5:
        slope = float(np.rad2deg(np.arccos(np.clip(np.linalg.norm(rise), 0.0, 1.0))))
        where = "" if slope < MAX_ANGLE_DEG else "_slope"
        rise = rise / np.linalg.norm(rise)
        found += [
            NamedDirection(rise, sentence(f"rework.up{where}")),
            NamedDirection(-rise, sentence(f"rework.down{where}")),
        ]
    for side, azimuth_deg in _SIDES:
        direction = across(part.effective_view_range.direction(azimuth_deg, 0.0), normal)
        if np.linalg.norm(direction) > 0.7:
            direction = direction / np.linalg.norm(direction)
            found.append(NamedDirection(direction, sentence(f"rework.{side}"), SIDE_COST))
    return found


def aim_of(target: Target, center: Array, normal: Array) -> tuple[Array, float] | None:
    """Unit vector (3,) across a normal from a point to a target, and its distance, mm; None without a direction."""
    arm = target.point_in_model - center
    if target.normal_in_model is not None:
        arm = target.normal_in_model * (target.normal_in_model @ arm)
    lateral = across(arm, normal)
    reach = float(np.linalg.norm(lateral))
    if reach < MIN_REACH_MM or reach < MIN_LATERAL_SHARE * float(np.linalg.norm(arm)):
        return None
    return lateral / reach, reach


def across(vector: Array, normal: Array) -> Array:
    """What of a vector (3,) is across a unit vector (3,)."""
    return vector - normal * (normal @ vector)


def in_named_steps(
    vector: Array,
    declared: Sequence[NamedDirection],
    found: Sequence[NamedDirection],
    sideways: float,
) -> list[NamedStep]:
    """A vector across the seat's normal as one or two steps along directions that have a name.

    One step is taken along the vector itself, called by a direction near it, if following the name exactly would leave
    no more than ``sideways``. Otherwise two steps add up to the vector exactly, neither of them longer than it.

    Args:
        vector: (3,), not zero.
        declared: directions of the part file, which come first.
        found: all others.
        sideways: what may remain beside the direction of a single step, in the unit of the vector.
    """
    for pool in (declared, [*declared, *found]):
        steps = _best_steps(vector, pool, sideways) if pool else []
        if steps:
            return steps
    length = float(np.linalg.norm(vector))
    axis = vector / length
    best = max([*declared, *found], key=lambda one: float(one.in_model @ axis), default=None)
    text = sentence("rework.arrow") if best is None else sentence("rework.about", direction=best.text)
    return [NamedStep(NamedDirection(axis, text), axis, length, axis)]


def _best_steps(vector: Array, pool: Sequence[NamedDirection], sideways: float) -> list[NamedStep]:
    length = float(np.linalg.norm(vector))
    axis = vector / length
    best: tuple[float, list[NamedStep]] = (np.inf, [])
    for one in pool:
        angle = np.arccos(np.clip(one.in_model @ axis, -1.0, 1.0))
        if np.rad2deg(angle) <= MAX_ANGLE_DEG and length * np.sin(angle) <= sideways:
            cost = one.cost + float(np.rad2deg(angle)) / MAX_ANGLE_DEG
            if cost < best[0]:
                best = (cost, [NamedStep(one, axis, length, axis)])
    for index, one in enumerate(pool):
        for other in pool[index + 1 :]:
            between = float(np.rad2deg(np.arccos(np.clip(one.in_model @ other.in_model, -1.0, 1.0))))
            if not MIN_PAIR_DEG <= between <= 180.0 - MIN_PAIR_DEG:
                continue
            rows = np.linalg.pinv(np.stack([one.in_model, other.in_model], axis=1))
            lengths = rows @ vector
            if lengths.min() <= 0.0 or lengths.max() > length:
                continue
            detour = max(0.0, float(lengths.sum()) / length - np.sqrt(2.0))
            cost = one.cost + other.cost + PAIR_COST + OBLIQUE_COST * abs(between - 90.0) / 45.0
            cost += DETOUR_COST * detour
            if cost < best[0]:
                steps = [
                    NamedStep(which, which.in_model, float(lengths[k]), rows[k]) for k, which in enumerate((one, other))
                ]
                best = (cost, sorted(steps, key=lambda step: -step.length))
    return best[1]


def seen_along(direction: Array, seat: str, up: Array) -> Message:
    """From where something is seen when a direction (3,) points at the eye, away from what it stands on."""
    rise = float(direction @ up)
    where = "above" if rise > 0.9 else "below" if rise < -0.9 else "seat" if seat else "end"
    return sentence(f"rework.seen_{where}", seat=seat)


def name_of(direction: Array, found: Sequence[NamedDirection]) -> str | Message:
    """Name of the direction nearest to a given one (3,), for a remark that needs no exactness."""
    best = max(found, key=lambda one: float(one.in_model @ direction) - 0.05 * one.cost, default=None)
    return sentence("rework.unnamed") if best is None else best.text
