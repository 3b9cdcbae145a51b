"""What a fitter is told about one component."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class ReworkMove:
    """One move along a direction named on the part.

    Attributes:
        text: for the fitter: ``move 2.83 ± 0.06 mm towards post_1``.
        axis_in_model: (3,) unit vector of the move, in the axes of the model.
        distance_mm: how far.
        uncertainty_mm: its U (k as in the inspection).
    """

    text: str
    axis_in_model: tuple[float, float, float]
    distance_mm: float
    uncertainty_mm: float


@dataclass(frozen=True)
class ReworkTurn:
    """A turn about the point whose displacement is stated.

    Attributes:
        text: for the fitter; of its tilt and of the turn about its own axis, as far as each is asked for.
        axis_in_model: (3,) unit vector; the turn is counter-clockwise for someone towards whom it points.
        angle_deg: how far.
        uncertainty_deg: its U.
    """

    text: str
    axis_in_model: tuple[float, float, float]
    angle_deg: float
    uncertainty_deg: float


@dataclass(frozen=True)
class Instruction:
    """The rework of one component.

    Attributes:
        component: its name.
        how: kind of rework, of the part file, or ``install`` where the component is missing.
        what: moves and turn in one line.
        moves: one after the other; along directions that are oblique to each other their order does not matter.
        turn: None where none is asked for.
        text: of the part file.
        steps: to be ticked off.
        remark: what is not known or not asked for.
        place: where it belongs, by what is beside it; of components to be installed or replaced.
        pictures: of the part file, relative to it.
    """

    component: str
    how: str
    what: str
    moves: tuple[ReworkMove, ...] = ()
    turn: ReworkTurn | None = None
    text: str = ""
    steps: tuple[str, ...] = ()
    remark: str = ""
    place: str = ""
    pictures: tuple[str, ...] = ()


def instruction_document(one: Instruction) -> dict[str, Any]:
    """The instruction as JSON."""
    turn = one.turn
    return {
        "component": one.component,
        "how": one.how,
        "what": one.what,
        "moves": [
            {
                "text": move.text,
                "axis_in_model": list(move.axis_in_model),
                "distance_mm": move.distance_mm,
                "U_mm": move.uncertainty_mm,
            }
            for move in one.moves
        ],
        "turn": None
        if turn is None
        else {
            "text": turn.text,
            "axis_in_model": list(turn.axis_in_model),
            "angle_deg": turn.angle_deg,
            "U_deg": turn.uncertainty_deg,
        },
        "text": one.text,
        "steps": list(one.steps),
        "remark": one.remark,
        "place": one.place,
        "pictures": list(one.pictures),
    }
