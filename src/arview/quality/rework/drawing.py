"""The drawing of a rework: the place of a component at true scale, and its displacement magnified beside it."""

from __future__ import annotations

import json
import re
import zlib
from dataclasses import dataclass, replace
from html import escape
from typing import Literal

import numpy as np

from arview.cad import Component, Part
from arview.core.messages import sentence, with_messages
from arview.errors import InputError
from arview.geometry import Array, apply
from arview.inspection import ComponentDeviation, Finding, Inspection, exact
from arview.quality.rework import svg
from arview.quality.rework.correction import Correction, Standing, correction_of, standing_of
from arview.quality.rework.instructions import make_instructions
from arview.quality.rework.outline import ParallelView, visible_lines
from arview.quality.rework.panel import Panel
from arview.quality.rework.types import Instruction, ReworkMove
from arview.quality.rework.words import across, seen_along, targets_of, up_of

Form = Literal["sheet", "report", "screen"]
"""A sheet says all there is to do; in a report text and legend stand beside the drawings; a screen is narrow, and has
its own language."""
WIDTH_MM = 180.0
SCREEN_WIDTH_MM = 90.0
SCREEN_TEXT = 1.5
"""Width of the drawing on a screen, where the panels are below each other, and factor of its letters."""
PLAN_WIDTH_MM = 110.0
SIDE_WIDTH_MM = 64.0
MIN_PLAN_HEIGHT_MM = 64.0
MAX_PLAN_HEIGHT_MM = 120.0
"""Width of the drawing, widths of the plan and of the side view, and limits of the height of the plan, mm on paper."""
MARGIN_MM = 14.0
"""Room around the component in the plan, mm on paper."""
HEAD_MM = 8.0
"""Room for the name; the lines of the moves come on top."""
MAX_MAGNIFICATION = 200.0
"""Largest factor by which moves are drawn longer than they are."""


@dataclass(frozen=True)
class _Subject:
    """What the panels of one drawing share."""

    part: Part
    deviation: ComponentDeviation
    standing: Standing
    correction: Correction
    instruction: Instruction | None
    view: ParallelView
    nominal: Component
    measured: Component | None

    @property
    def design_point(self) -> Array:
        return self.view.to_plane(self.standing.center_in_model)[:2]

    @property
    def measured_point(self) -> Array:
        return self.view.to_plane(self.standing.center_in_model - self.correction.shift_mm)[:2]


def drawing_svg(part: Part, inspection: Inspection, component: str, form: Form = "sheet") -> str:
    """The drawing of a component as SVG, in mm: printed at 100 % its plan has the scale that it states.

    It shows the design outline (solid), the measured one (dashed), what is beside them, and magnified the displacement
    of the point whose distance is stated, with its U and the tolerance zone. It is seen along the direction away from
    the seat, or from the side where the component has to be moved along it. On a screen what it shows is told by its
    ``metadata``: view, magnification, U, tolerance and point, as messages.

    Raises:
        InputError: the inspection or the part has no such component.
        MismatchError: the inspection is of another model.
    """
    deviation = inspection.find(component)
    if deviation is None:
        known = ", ".join(one.name for one in inspection.components)
        raise InputError(f"the inspection has no component {component!r}; it has: {known}")
    told = {one.component: one for one in make_instructions(part, inspection)}
    subject = _subject(part, deviation, told.get(component))
    low, high = _extent(subject)
    is_screen = form == "screen"
    width, plan_width = (SCREEN_WIDTH_MM, SCREEN_WIDTH_MM - 0.6) if is_screen else (WIDTH_MM, PLAN_WIDTH_MM)
    scale = min(
        1.0,
        _scale_for(plan_width, high[0] - low[0] + 2.0 * MARGIN_MM),
        _scale_for(MAX_PLAN_HEIGHT_MM, high[1] - low[1] + 2.0 * MARGIN_MM),
    )
    height = float(np.clip((high[1] - low[1] + 2.0 * MARGIN_MM) * scale, MIN_PLAN_HEIGHT_MM, MAX_PLAN_HEIGHT_MM))
    top, pieces = (0.3, []) if is_screen else _head(subject, inspection, form)
    plan = Panel(0.3, top, plan_width, height, 0.5 * (low + high), scale, SCREEN_TEXT if is_screen else 1.0)
    key = f"r{zlib.crc32(f'{part.name}/{inspection.serial}/{component}'.encode()):08x}"
    plan_bottom, drawn = _plan(subject, plan, f"{key}a", form)
    side_panel = (
        _side_panel(subject, width - SIDE_WIDTH_MM - 0.3, top, SIDE_WIDTH_MM)
        if not is_screen
        else _side_panel(subject, 0.3, plan_bottom + 2.0, plan_width)
    )
    side_bottom, side = _side(subject, side_panel, f"{key}b", form)
    pieces += drawn + side
    if is_screen:
        pieces.append(f"<metadata>{escape(_about(subject, side_panel))}</metadata>")
    total = max(plan_bottom, side_bottom)
    what = subject.instruction.what if subject.instruction is not None else "nothing is asked for"
    label = escape(f"Rework of {component}: {what}. {subject.view.words}.", quote=True)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:g}mm" height="{total:.2f}mm" '
        f'viewBox="0 0 {width:g} {total:.2f}" font-family="{svg.FONT}" role="img" aria-label="{label}">'
        f'<rect width="{width:g}" height="{total:.2f}" fill="#fff"/>{"".join(pieces)}</svg>'
    )


def _subject(part: Part, deviation: ComponentDeviation, told: Instruction | None) -> _Subject:
    standing = standing_of(deviation, part)
    correction = correction_of(deviation, standing)
    nominal = part.model.component(deviation.name)
    measured = None
    if deviation.distance_mm is not None:
        place = np.eye(4)
        details = deviation.details
        if details is not None and details.measured_from_nominal is not None:
            place = np.array(details.measured_from_nominal)
        else:
            place[:3, 3] = -correction.shift_mm
        measured = replace(nominal, vertices_in_model=apply(place, nominal.vertices_in_model))
    view = view_of(part, standing, correction)
    return _Subject(
        part,
        deviation,
        standing,
        correction=correction,
        instruction=told,
        view=view,
        nominal=nominal,
        measured=measured,
    )


def view_of(part: Part, standing: Standing, correction: Correction) -> ParallelView:
    """The view in which most of the move is seen: onto the seat, or along it where the move is off the seat."""
    normal, up = standing.normal_in_model, up_of(part)
    front = part.effective_view_range.direction(-90.0, 0.0)
    lateral = across(correction.shift_mm, normal)
    height = abs(float(normal @ correction.shift_mm))
    if height > float(np.linalg.norm(lateral)):
        # From the side: so that what moves across the seat is seen too, or from the front where nothing does.
        toward = np.cross(lateral, normal)
        if np.linalg.norm(lateral) < 0.2 * height:
            toward = across(front if abs(front @ normal) < 0.9 else up, normal)
        toward = toward / np.linalg.norm(toward)
        if toward @ (front + 0.1 * up) < 0.0:
            toward = -toward
        right = np.cross(normal, toward)
        where = "" if not standing.seat else "_below" if normal @ up > 0.9 else "_edge"
        words = sentence(f"rework.seen_side{where}", seat=standing.seat)
        return ParallelView(standing.center_in_model, np.stack([right, normal, toward]), words)
    rise = across(up, normal)
    upward = rise if np.linalg.norm(rise) > 0.3 else across(-front, normal)
    upward = upward / np.linalg.norm(upward)
    words = seen_along(normal, standing.seat, up)
    return ParallelView(standing.center_in_model, np.stack([np.cross(upward, normal), upward, normal]), words)


def _extent(subject: _Subject) -> tuple[Array, Array]:
    """Lower and upper corner (2,) of the component at both places in the drawing plane."""
    shown = [subject.nominal] + ([] if subject.measured is None else [subject.measured])
    flat = np.concatenate([subject.view.to_plane(one.vertices_in_model)[:, :2] for one in shown])
    return flat.min(axis=0), flat.max(axis=0)


def _scale_for(room: float, needed: float) -> float:
    """The largest of 1, 1 : 2, 1 : 5, … at which a length fits."""
    return 1.0 if needed <= room else svg.nice(room / needed)


def _scale_text(scale: float) -> str:
    if abs(scale - 1.0) < 1e-9:
        return "1 : 1"
    return f"{scale:g} : 1" if scale > 1.0 else f"1 : {1.0 / scale:g}"


def _head(subject: _Subject, inspection: Inspection, form: Form) -> tuple[float, list[str]]:
    """Where the panels begin, and what is above them: name, part and, on a sheet, moves."""
    told, name = subject.instruction, subject.deviation.name
    what = "nothing is asked for" if told is None else told.what
    lines = svg.wrapped(f"{what[:1].upper()}{what[1:]}.", WIDTH_MM, 3.2) if form == "sheet" else []
    title = f"{inspection.part} {inspection.serial}".strip()
    pieces = [
        svg.text(0.0, 4.4, name, 4.6, f'fill="{svg.INK}" font-weight="600"'),
        svg.text(WIDTH_MM, 4.4, title, 2.8, f'fill="{svg.MUTED}" text-anchor="end"'),
    ]
    pieces += [svg.text(0.0, 9.0 + 4.0 * k, line, 3.2, f'fill="{svg.INK}"') for k, line in enumerate(lines)]
    return HEAD_MM + 4.0 * len(lines), pieces


def _framed(panel: Panel, key: str, pieces: list[str]) -> list[str]:
    """Pieces that are cut at the edge of their panel, and its frame."""
    box = f'x="{panel.x:g}" y="{panel.y:g}" width="{panel.width:g}" height="{panel.height:g}"'
    return [
        f'<clipPath id="{key}"><rect {box}/></clipPath><g clip-path="url(#{key})">',
        *pieces,
        "</g>",
        f'<rect {box} fill="none" stroke="{svg.PALE}" stroke-width="0.25"/>',
    ]


def _outlines(subject: _Subject, panel: Panel, with_others: bool) -> list[str]:
    """Everything that a panel shows of the part: others thin, the design place solid, the measured one dashed."""
    view, window = subject.view, panel.window
    pieces = []
    if with_others:
        others = [one for one in subject.part.model.components if one.name != subject.nominal.name]
        drawn = visible_lines(others, others, view, window)
        pieces.append(svg.path([panel.at(one) for one in drawn], f'stroke="{svg.PALE}" stroke-width="0.18"'))
    design = visible_lines([subject.nominal], [subject.nominal], view, window)
    width = 0.5 if panel.scale >= 0.2 else 0.35
    pieces.append(svg.path([panel.at(one) for one in design], f'stroke="{svg.DESIGN}" stroke-width="{width:g}"'))
    if subject.measured is not None:
        measured = visible_lines([subject.measured], [subject.measured], view, window)
        attributes = f'stroke="{svg.MEASURED}" stroke-width="{0.8 * width:g}" stroke-dasharray="1.8 1"'
        pieces.append(svg.path([panel.at(one) for one in measured], attributes))
    return pieces


def _plan(subject: _Subject, panel: Panel, key: str, form: Form) -> tuple[float, list[str]]:
    """Where the plan ends on the sheet, and its pieces: the component among its neighbours, scale and remark."""
    pieces = _outlines(subject, panel, with_others=True)
    pieces += _names(subject, panel)
    design, measured = panel.at(subject.design_point), panel.at(subject.measured_point)
    if subject.measured is not None and subject.instruction is not None:
        if subject.instruction.moves:
            pieces.append(svg.arrow(measured, design, 0.45))
        pieces += _turn_arrow(subject, panel)
    framed = _framed(panel, key, pieces)
    words = "" if form == "screen" else f"{_scale_text(panel.scale)} at 100 % print size, {subject.view.words}"
    bottom, below = _below(panel, words)
    remark = "" if subject.instruction is None or form != "sheet" else subject.instruction.remark
    lines = svg.wrapped(remark, panel.width, 2.6) if remark else []
    notes = [svg.text(panel.x, bottom + 4.0 * (k + 1), line, 2.6, f'fill="{svg.INK}"') for k, line in enumerate(lines)]
    return bottom + 4.0 * len(lines) + 1.5, [*framed, *below, *notes]


def _below(panel: Panel, words: str) -> tuple[float, list[str]]:
    """Where a panel's scale bar and caption end, and both."""
    y = panel.y + panel.height + 5.0
    step = svg.nice(0.3 * panel.width / panel.scale)
    lines = [
        svg.text(panel.x, y + 4.4 + 3.6 * k, line, 2.6, f'fill="{svg.MUTED}"')
        for k, line in enumerate(svg.wrapped(words, panel.width, 2.6) if words else ())
    ]
    return y + 2.4 + 3.6 * len(lines), [svg.scale_bar(panel.x, y, step, panel.scale, 2.5 * panel.text), *lines]


def _turn_arrow(subject: _Subject, panel: Panel) -> list[str]:
    """The sense of a turn about the direction of the view."""
    turn = None if subject.instruction is None else subject.instruction.turn
    if turn is None:
        return []
    share = float(np.array(turn.axis_in_model) @ subject.view.axes[2])
    if abs(share) < 0.7:
        return []
    low, high = _extent(subject)
    radius = float(np.clip(0.5 * panel.scale * float((high - low).max()) + 4.0, 8.0, 0.42 * panel.height))
    center = panel.at(subject.design_point)
    label = f"{turn.angle_deg:.2f}°"
    return [
        svg.arc_arrow(center, radius, is_clockwise=share < 0.0),
        svg.haloed(
            center[0], center[1] - radius + 3.6, label, 2.8 * panel.text, f'fill="{svg.INK}" text-anchor="middle"'
        ),
    ]


def _names(subject: _Subject, panel: Panel) -> list[str]:
    """Names of neighbours in the window, and arrows at its edge to those that the instruction names."""
    told = subject.instruction
    sentence = "" if told is None else f"{told.what} {told.place} "
    low, high = (panel.at(corner) for corner in _extent(subject))
    center = panel.at(subject.design_point)
    pieces = []
    for target in targets_of(subject.part):
        if target.name in (subject.nominal.name, subject.standing.seat) or target.normal_in_model is not None:
            continue
        is_told = re.search(rf"(?<!\w){re.escape(target.name)}(?!\w)", sentence) is not None
        place = panel.at(subject.view.to_plane(target.point_in_model))
        if panel.holds(place, 2.0):
            if low[0] < place[0] < high[0] and high[1] < place[1] < low[1] and not is_told:
                continue
            weight = ' font-weight="600"' if is_told else ""
            attributes = f'fill="{svg.INK if is_told else svg.MUTED}" text-anchor="middle"{weight}'
            half = 0.3 * 2.6 * panel.text * len(target.name)
            x = float(np.clip(place[0], panel.x + half, panel.x + panel.width - half))
            pieces.append(svg.haloed(x, place[1] + 0.9, target.name, 2.6 * panel.text, attributes))
        elif is_told:
            pieces += _pointer(panel, center, place, target.name)
    return pieces


def _pointer(panel: Panel, center: Array, place: Array, name: str) -> list[str]:
    """The name of something outside at the edge of a panel, with a small sign of where it lies; none straight behind.

    The sign is open and pale: the only arrows of a drawing are those of the moves.
    """
    arm = place - center
    if float(np.hypot(*arm)) < 1.0:
        return []
    middle = np.array([panel.x + 0.5 * panel.width, panel.y + 0.5 * panel.height])
    half = 0.5 * np.array([panel.width, panel.height]) - 2.0
    edge = np.where(arm > 0.0, middle + half, middle - half) - center
    reach = min(float(edge[axis] / arm[axis]) for axis in range(2) if abs(arm[axis]) > 1e-9)
    tip = center + reach * arm
    along = arm / np.hypot(*arm)
    tail = tip - 3.0 * along
    aside = np.array([-along[1], along[0]])
    chevron = np.stack([tail + 1.3 * aside, tip, tail - 1.3 * aside])
    anchor = (
        "end" if tip[0] > middle[0] + 0.5 * half[0] else "start" if tip[0] < middle[0] - 0.5 * half[0] else "middle"
    )
    x = float(np.clip(tail[0], panel.x + 2.0, panel.x + panel.width - 2.0))
    drop = (3.4 if tip[1] < middle[1] else -1.6) * panel.text
    y = float(np.clip(tail[1] + drop, panel.y + 4.0, panel.y + panel.height - 2.0))
    return [
        svg.path([chevron], f'stroke="{svg.MUTED}" stroke-width="0.5"'),
        svg.haloed(x, y, name, 2.6 * panel.text, f'fill="{svg.MUTED}" font-weight="600" text-anchor="{anchor}"'),
    ]


def _is_whole(subject: _Subject) -> bool:
    """Whether the second panel shows the whole part, because there is no displacement."""
    return subject.deviation.finding is Finding.MISSING or subject.measured is None


def _side_panel(subject: _Subject, x: float, y: float, width: float) -> Panel:
    """The second panel: the displacement magnified, or the whole part for a missing component."""
    panel = (_whole_part if _is_whole(subject) else _magnified)(subject, x, y, width)
    return panel if width == SIDE_WIDTH_MM else replace(panel, text=SCREEN_TEXT)


def _about(subject: _Subject, panel: Panel) -> str:
    """What a drawing on a screen shows, as JSON."""
    one = subject.deviation
    is_whole = _is_whole(subject)
    told = {
        "text": subject.view.words,
        "magnification": None if is_whole else panel.scale,
        "u": f"{one.uncertainty_mm:.2g}" if one.uncertainty_mm and not is_whole else "",
        "tolerance": exact(one.tolerance_mm) if one.tolerance_mm is not None and not is_whole else "",
        "place": "" if is_whole else subject.standing.point,
    }
    return json.dumps(with_messages(told), ensure_ascii=False)


def _side(subject: _Subject, panel: Panel, key: str, form: Form) -> tuple[float, list[str]]:
    """Where the second panel ends, and its pieces; with the legend."""
    x = panel.x
    if _is_whole(subject):
        pieces = _framed(panel, key, _outlines(subject, panel, with_others=True))
        words = "the whole part; it belongs at the thick outline"
    else:
        pieces = _framed(panel, key, _displacement(subject, panel))
        words = f"magnified {panel.scale:g} times"
        hidden = [move.text.removeprefix("move ") for move in _moves_along_view(subject, panel)]
        if hidden:
            words = f"{words}; not seen: {', '.join(hidden)}"
    bottom, below = _below(panel, "" if form == "screen" else words)
    pieces += below
    rows = _legend(subject) if form == "sheet" else []
    for k, (sample, label) in enumerate(rows):
        row = bottom + 4.4 + 4.2 * k
        pieces.append(f'<g transform="translate({x:g} {row:.2f})">{sample}</g>')
        pieces.append(svg.text(x + 10.0, row, label, 2.6, f'fill="{svg.INK}"'))
    return bottom + 4.4 + 4.2 * len(rows), pieces


def _moves_along_view(subject: _Subject, panel: Panel) -> list[ReworkMove]:
    """Moves that are too short to be seen in a panel, because they are along the view or small."""
    moves = () if subject.instruction is None else subject.instruction.moves
    return [move for move in moves if _drawn_length(subject, panel, move) < 0.8]


def _drawn_length(subject: _Subject, panel: Panel, move: ReworkMove) -> float:
    step = subject.view.axes[:2] @ np.array(move.axis_in_model) * move.distance_mm * panel.scale
    return float(np.hypot(*step))


def _whole_part(subject: _Subject, x: float, y: float, width: float) -> Panel:
    corners = np.array(np.meshgrid(*subject.part.model.bounds_in_model.T)).reshape(3, -1).T
    flat = subject.view.to_plane(corners)[:, :2]
    size = flat.max(axis=0) - flat.min(axis=0)
    scale = float(min((width - 4.0) / size[0], (width - 4.0) / size[1]))
    return Panel(x, y, width, width, 0.5 * (flat.min(axis=0) + flat.max(axis=0)), scale)


def _magnified(subject: _Subject, x: float, y: float, width: float) -> Panel:
    one = subject.deviation
    away = float(np.hypot(*(subject.measured_point - subject.design_point)))
    reach = 1.15 * max(one.tolerance_mm or 0.0, away + (one.uncertainty_mm or 0.0), 1e-3)
    scale = min(MAX_MAGNIFICATION, svg.nice(0.5 * width / reach, (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)))
    return Panel(x, y, width, width, subject.design_point, scale)


def _displacement(subject: _Subject, panel: Panel) -> list[str]:
    """Tolerance zone, design point, measured point with its U, and the moves from one to the other."""
    one, told = subject.deviation, subject.instruction
    pieces = _outlines(subject, panel, with_others=False)
    design, measured = panel.at(subject.design_point), panel.at(subject.measured_point)
    if one.tolerance_mm is not None:
        pieces.append(
            f'<circle cx="{design[0]:.3f}" cy="{design[1]:.3f}" r="{one.tolerance_mm * panel.scale:.3f}" '
            f'fill="{svg.ZONE}" fill-opacity="0.1" stroke="{svg.ZONE}" stroke-width="0.4" '
            'stroke-dasharray="3 1 0.6 1"/>'
        )
    pieces.append(svg.plus(design, 2.4, svg.DESIGN))
    if one.uncertainty_mm:
        pieces.append(
            f'<circle cx="{measured[0]:.3f}" cy="{measured[1]:.3f}" r="{one.uncertainty_mm * panel.scale:.3f}" '
            f'fill="none" stroke="{svg.MEASURED}" stroke-width="0.25" stroke-dasharray="0.5 0.7"/>'
        )
    pieces.append(svg.cross(measured, 1.5, svg.MEASURED))
    hidden = _moves_along_view(subject, panel)
    here, corners, labels = measured, [measured, design], []
    for move in () if told is None else told.moves:
        step = subject.view.axes[:2] @ np.array(move.axis_in_model) * move.distance_mm * panel.scale
        there = here + step * (1.0, -1.0)
        if move in hidden:
            continue
        pieces.append(svg.arrow(here, there))
        labels.append((here, there, move.text))
        corners.append(there)
        here = there
    middle = np.mean(corners, axis=0)
    return pieces + [_move_label(panel, *label, middle) for label in labels]


def _move_label(panel: Panel, start: Array, end: Array, text: str, middle: Array) -> str:
    """Length of a move beside its arrow, on the side away from the middle of all arrows."""
    arm = end - start
    across_arm = np.array([-arm[1], arm[0]]) / float(np.hypot(*arm))
    outward = float(across_arm @ (0.5 * (start + end) - middle))
    if outward < -1e-6 or (abs(outward) <= 1e-6 and across_arm[1] > 0.0):
        across_arm = -across_arm
    place = 0.5 * (start + end) + 2.0 * across_arm
    anchor = "start" if across_arm[0] > 0.3 else "end" if across_arm[0] < -0.3 else "middle"
    amount = text.split(" mm", 1)[0].removeprefix("move ").split(" ± ")[0]
    x = float(np.clip(place[0], panel.x + 2.0, panel.x + panel.width - 2.0))
    y = float(np.clip(place[1] + 0.8, panel.y + 4.0, panel.y + panel.height - 2.0))
    return svg.haloed(
        x, y, f"{amount} mm", 3.0 * panel.text, f'fill="{svg.INK}" font-weight="600" text-anchor="{anchor}"'
    )


def _legend(subject: _Subject) -> list[tuple[str, str]]:
    """Samples of lines and their meanings."""
    one = subject.deviation
    line = [np.array([[0.0, -0.9], [8.0, -0.9]])]
    rows = [(svg.path(line, f'stroke="{svg.DESIGN}" stroke-width="0.5"'), "design place")]
    if subject.measured is None:
        return rows
    dashed = f'stroke="{svg.MEASURED}" stroke-width="0.4" stroke-dasharray="1.8 1"'
    rows.append((svg.path(line, dashed), "as measured"))
    point = subject.standing.point
    mark = svg.plus(np.array([2.0, -0.9]), 1.4, svg.DESIGN) + svg.cross(np.array([6.0, -0.9]), 1.0, svg.MEASURED)
    rows += [(mark if k == 0 else "", text) for k, text in enumerate(svg.wrapped(point, 50.0, 2.6))]
    if one.uncertainty_mm:
        dots = f'<circle cx="4" cy="-0.9" r="1.4" fill="none" stroke="{svg.MEASURED}" stroke-width="0.25" '
        rows.append((f'{dots}stroke-dasharray="0.5 0.7"/>', f"U = {one.uncertainty_mm:.2g} mm"))
    if one.tolerance_mm is not None:
        zone = f'<circle cx="4" cy="-0.9" r="1.7" fill="{svg.ZONE}" fill-opacity="0.1" stroke="{svg.ZONE}" '
        words = f"tolerance zone, radius {exact(one.tolerance_mm)} mm"
        rows.append((f'{zone}stroke-width="0.4" stroke-dasharray="3 1 0.6 1"/>', words))
    return rows
