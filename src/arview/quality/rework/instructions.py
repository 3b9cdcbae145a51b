"""Instructions for the rework of the components that are out of tolerance."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np

from arview.cad import Part, ReworkSettings
from arview.core.messages import CATALOGUE, Message, sentence
from arview.geometry import Array
from arview.inspection import ComponentDeviation, Finding, Inspection, Verdict, decimals_of, fixed
from arview.quality.rework.correction import Correction, Standing, correction_of, standing_of
from arview.quality.rework.kinds import ANY_FIXING, FIXING, INSTALL_STEPS, LAST_STEP, STEPS
from arview.quality.rework.types import Instruction, ReworkMove, ReworkTurn
from arview.quality.rework.words import (
    NamedDirection,
    NamedStep,
    Target,
    across,
    aim_of,
    in_named_steps,
    lateral_directions,
    name_of,
    seen_along,
    targets_of,
    up_of,
)

MAX_DECIMALS = 2
"""A fitter reads hundredths of a millimetre and of a degree."""


SIDEWAYS_SHARE = 0.25
"""Share of the tolerance that may remain beside a move that is called by a near direction."""
MIN_SHARE = 0.1
"""Share of the tolerance; shorter moves are not asked for either."""
END_SHARE = 0.5
"""Share of the tolerance; a turn that moves the ends by more is asked for without an angle limit."""
MIN_TURN_DEG = 0.02
"""Smaller turns are not asked for."""


def make_instructions(part: Part, inspection: Inspection) -> tuple[Instruction, ...]:
    """The rework of each component that is out of tolerance or missing, in the order of the inspection.

    Foreign objects and components whose verdict is undecided are no rework.

    Raises:
        MismatchError: the inspection is of another model.
    """
    inspection.check_model(part.model)
    failing = [one for one in inspection.components if one.verdict is Verdict.FAIL]
    absent = [one.name for one in failing if one.finding is Finding.MISSING]
    wrong = [one.name for one in failing]
    targets = targets_of(part, absent, wrong)
    return tuple(_instruction(one, part, targets) for one in failing)


@dataclass(frozen=True)
class _Names:
    """Directions that a component has: those of the part file and all others, across the normal of its seat."""

    declared: list[NamedDirection]
    found: list[NamedDirection]
    away: str | Message
    against: str | Message

    @property
    def all(self) -> list[NamedDirection]:
        return [*self.declared, *self.found]


def _instruction(one: ComponentDeviation, part: Part, targets: Sequence[Target]) -> Instruction:
    settings = part.component_settings(one.name).rework
    standing = standing_of(one, part)
    place = _place(standing, targets)
    if one.finding is Finding.MISSING:
        install = (*INSTALL_STEPS, FIXING.get(settings.name, ANY_FIXING), LAST_STEP)
        steps = _filled(install, one.name, "", place)
        return Instruction(
            one.name,
            "install",
            sentence("rework.install"),
            text=settings.text,
            steps=steps,
            place=place,
            pictures=settings.pictures,
        )
    correction = correction_of(one, standing)
    names = names_for(standing, part, targets, settings)
    moves = _moves(one, standing, correction, names, part)
    turn = _turn(one, standing, correction, names, part)
    texts = [move.text for move in moves] + ([] if turn is None else [turn.text])
    what = _joined("rework.then", texts) if texts else sentence("rework.bring")
    if settings.name == "shim":
        texts = [*_shims(standing, moves, turn, names, correction), *texts]
    usual = settings.steps or STEPS.get(settings.name, STEPS["adjust"])
    steps = _filled((*usual, LAST_STEP), one.name, _joined("rework.then", texts) if texts else what, place)
    if settings.name == "replace":
        what = sentence("rework.replace", what=what)
    return Instruction(
        component=one.name,
        how=settings.name,
        what=what,
        moves=() if settings.name == "replace" else moves,
        turn=None if settings.name == "replace" else turn,
        text=settings.text,
        steps=steps,
        remark=_remark(one, standing, correction, names, moves, turn),
        place=place if settings.name == "replace" else "",
        pictures=settings.pictures,
    )


def _joined(key: str, texts: Iterable[str]) -> str:
    """Several texts as one, each with the next by a sentence with the values ``first`` and ``second``."""
    return reduce(lambda first, second: sentence(key, first=first, second=second), texts)


def _filled(steps: Sequence[str], component: str, move: str, place: str) -> tuple[str, ...]:
    """Steps with their values, keys of sentences or of the part file; moves begin with a capital, all have a stop."""
    values = {"component": component, "move": move, "place": place}
    own = values | {"move": f"{move[:1].upper()}{move[1:]}"}
    told = [
        sentence(step, **values)
        if step in CATALOGUE
        else re.sub(r"\{(component|move|place)\}", lambda found: own[found[1]], step).strip()
        for step in steps
    ]
    return tuple(
        Message(f"{text[:1].upper()}{text[1:]}", text.key, text.values)
        if isinstance(text, Message)
        else text
        if text[-1:] in ".!?"
        else f"{text}."
        for text in told
    )


def names_for(standing: Standing, part: Part, targets: Sequence[Target], settings: ReworkSettings) -> _Names:
    """Directions by which the moves of a component can be called."""
    normal = standing.normal_in_model
    found = lateral_directions(part, targets, standing.component, standing.center_in_model, normal, standing.seat)
    known = {target.name: target for target in targets_of(part)}
    declared: list[NamedDirection] = []
    away, against = _seat_words(standing, part)
    for axis in settings.axes:
        if axis.direction_in_model is not None:
            direction = np.array(axis.direction_in_model)
            words: tuple[str, str] = axis.name, sentence("rework.opposite", name=axis.name)
            if abs(direction @ normal) > 0.9:
                away, against = words if direction @ normal > 0 else words[::-1]
                continue
        else:
            target = known.get(axis.target)
            aim = None if target is None else aim_of(target, standing.center_in_model, normal)
            if aim is None:
                continue  # it is straight above or below, so that moves across the seat cannot be called by it
            direction = aim[0] if axis.verb == "towards" else -aim[0]
            words = sentence("rework.towards", target=axis.target), sentence("rework.away_from", target=axis.target)
            words = words if axis.verb == "towards" else words[::-1]
            words = (axis.name or words[0], words[1])
        lateral = across(direction, normal)
        if np.linalg.norm(lateral) > 0.3:
            lateral = lateral / np.linalg.norm(lateral)
            declared += [NamedDirection(lateral, words[0]), NamedDirection(-lateral, words[1])]
    return _Names(declared, found, away, against)


def _seat_words(standing: Standing, part: Part) -> tuple[str, str]:
    """Names of the directions away from the seat and against it."""
    rise = float(standing.normal_in_model @ up_of(part))
    if not standing.seat:
        return sentence("rework.up"), sentence("rework.down")
    away, against = ("up", "down") if rise > 0.9 else ("down", "up") if rise < -0.9 else ("out", "in")
    return sentence(f"rework.{away}_from", seat=standing.seat), sentence(f"rework.{against}_to", seat=standing.seat)


def _moves(
    one: ComponentDeviation, standing: Standing, correction: Correction, names: _Names, part: Part
) -> tuple[ReworkMove, ...]:
    """The moves that are larger than their U and matter; all of them if the distance fails though none is."""
    if one.tolerance_mm is None:
        return ()
    shift, normal = correction.shift_mm, standing.normal_in_model
    steps = []
    lateral = across(shift, normal)
    if np.linalg.norm(lateral) > 1e-9:
        axis = lateral / np.linalg.norm(lateral)
        sideways = max(SIDEWAYS_SHARE * one.tolerance_mm, correction.shift_uncertainty_mm(axis))
        steps = in_named_steps(lateral, names.declared, names.found, sideways)
    height = float(normal @ shift)
    if abs(height) > 1e-9:
        text = names.away if height > 0 else names.against
        direction = NamedDirection(normal * np.sign(height), text)
        steps.append(NamedStep(direction, direction.in_model, abs(height), direction.in_model))
    sized = [(step, correction.shift_uncertainty_mm(step.row)) for step in steps]
    asked = [(step, u) for step, u in sized if step.length > max(u, MIN_SHARE * one.tolerance_mm)]
    fails = one.distance_mm is not None and one.distance_mm > one.tolerance_mm
    if not asked and fails:
        asked = sized
    return tuple(_move(step, u) for step, u in asked)


def _move(step: NamedStep, uncertainty_mm: float) -> ReworkMove:
    return ReworkMove(
        text=sentence("rework.move", amount=amount(step.length, uncertainty_mm), direction=step.direction.text),
        axis_in_model=_three(step.axis_in_model),
        distance_mm=step.length,
        uncertainty_mm=uncertainty_mm,
    )


def _turn(
    one: ComponentDeviation, standing: Standing, correction: Correction, names: _Names, part: Part
) -> ReworkTurn | None:
    """The turn back to the design attitude, if it is larger than its U and matters."""
    rotation, own = correction.rotation_rad, standing.axis_in_model
    angle = float(np.linalg.norm(rotation))
    if angle <= np.deg2rad(MIN_TURN_DEG):
        return None
    limit = None if one.details is None else one.details.angle_tolerance_deg
    ends_mm = angle * standing.radius_mm
    if limit is None and (one.tolerance_mm is None or ends_mm <= END_SHARE * one.tolerance_mm):
        return None
    texts: list[str] = []
    kept = np.zeros(3)
    tilt = across(rotation, own)
    size = float(np.linalg.norm(tilt))
    if size > 1e-9:
        u = correction.turn_uncertainty_rad(tilt / size)
        if size > max(u, np.deg2rad(MIN_TURN_DEG)):
            texts.append(_tilt_text(tilt, u, standing, names))
            kept = kept + tilt
    twist = float(rotation @ own)
    u = correction.turn_uncertainty_rad(own)
    if abs(twist) > max(u, np.deg2rad(MIN_TURN_DEG)):
        sense = "counter_clockwise" if twist > 0 else "clockwise"
        texts.append(
            sentence(
                f"rework.{sense}",
                angle=_degrees(abs(twist), u),
                seen=seen_along(standing.axis_in_model, standing.seat, up_of(part)),
            )
        )
        kept = kept + own * twist
    if not texts:
        return None
    angle = float(np.linalg.norm(kept))
    axis = kept / angle
    u = correction.turn_uncertainty_rad(axis)
    return ReworkTurn(_joined("rework.and", texts), _three(axis), float(np.rad2deg(angle)), float(np.rad2deg(u)))


def _tilt_text(tilt: Array, u: float, standing: Standing, names: _Names) -> str:
    """The tilt by the directions in which the free end goes."""
    size = float(np.linalg.norm(tilt))
    lean = np.cross(tilt, standing.axis_in_model)
    steps = in_named_steps(lean, names.declared, names.found, max(u, 0.25 * size))
    named = [(step.length, step.direction.text) for step in steps if step.length > u] or [
        (size, steps[0].direction.text)
    ]
    parts = [sentence("rework.degrees", angle=_degrees(length, u), direction=text) for length, text in named]
    return sentence("rework.tilt", parts=_joined("rework.and", parts))


def _shims(
    standing: Standing, moves: Sequence[ReworkMove], turn: ReworkTurn | None, names: _Names, correction: Correction
) -> list[str]:
    """Thickness of the shims that the move away from the seat, and the tilt, ask for."""
    texts: list[str] = []
    component, seat = standing.component, standing.seat
    under = (
        sentence("rework.between", component=component, seat=seat)
        if seat
        else sentence("rework.under", component=component)
    )
    for move in moves:
        rise = float(np.array(move.axis_in_model) @ standing.normal_in_model)
        if abs(rise) > 0.99:
            way = "rework.shims_in" if rise > 0.0 else "rework.shims_out"
            texts.append(sentence(way, amount=amount(move.distance_mm, move.uncertainty_mm), under=under))
    if turn is not None:
        tilt = across(np.array(turn.axis_in_model) * np.deg2rad(turn.angle_deg), standing.axis_in_model)
        size = float(np.linalg.norm(tilt))
        if size > correction.turn_uncertainty_rad(tilt / size if size else tilt):
            lean = np.cross(tilt, standing.axis_in_model) / size
            side = name_of(-lean, names.all)
            texts.append(sentence("rework.shims_side", side=side, slope=f"{1000.0 * np.tan(size):.1f}"))
    return texts


def _remark(
    one: ComponentDeviation,
    standing: Standing,
    correction: Correction,
    names: _Names,
    moves: Sequence[ReworkMove],
    turn: ReworkTurn | None,
) -> str:
    """What is not known, and what the distances refer to."""
    sentences: list[str] = []
    normal = standing.normal_in_model
    for direction in correction.free_shifts:
        is_height = abs(direction @ normal) > 0.9
        lateral = across(direction, normal)
        name = names.away if is_height else name_of(lateral / np.linalg.norm(lateral), names.all)
        sentences.append(sentence("rework.free_shift", direction=name))
    own = standing.axis_in_model
    for axis in correction.free_turns:
        is_twist = abs(axis @ own) > 0.9
        if is_twist and standing.is_round:
            continue  # turning it changes nothing
        sentences.append(sentence("rework.free_twist" if is_twist else "rework.free_tilt"))
    if not moves and one.tolerance_mm is not None and one.distance_mm is not None:
        sentences.append(sentence("rework.no_move"))
    if moves and turn is not None:
        sentences.append(sentence("rework.of_point", point=standing.point))
    told = dict.fromkeys(sentences)
    return _joined("rework.both", told) if told else ""


def _place(standing: Standing, targets: Sequence[Target]) -> str:
    """Where a component belongs: on what, and how far from two things beside it in different directions."""
    aims = sorted(
        (aim[1] * (1.0 + target.cost), target.name, *aim)
        for target in targets
        if target.normal_in_model is None
        and target.name not in (standing.component, standing.seat)
        and (aim := aim_of(target, standing.center_in_model, standing.normal_in_model)) is not None
    )
    chosen = aims[:1]
    for one in aims[1:]:
        if abs(float(one[2] @ chosen[0][2])) < 0.87:
            chosen.append(one)
            break
    parts = [sentence("rework.beside", reach=f"{reach:.0f}", name=name) for _, name, _, reach in chosen]
    told = [
        *([sentence("rework.on", seat=standing.seat)] if standing.seat else []),
        *([_joined("rework.and", parts)] if parts else []),
    ]
    return _joined("rework.place", told) if told else sentence("rework.as_drawn")


def amount(value: float, uncertainty: float) -> str:
    """A length or angle with its U, both with the decimals that U allows."""
    digits = min(decimals_of(uncertainty), MAX_DECIMALS)
    text = fixed(value, digits)
    return f"{text} ± {fixed(uncertainty, digits)}" if uncertainty > 0.0 else text


def _degrees(value_rad: float, uncertainty_rad: float) -> str:
    value, u = float(np.rad2deg(value_rad)), float(np.rad2deg(uncertainty_rad))
    return amount(value, u)


def _three(vector: Array) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])
