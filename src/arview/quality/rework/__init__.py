"""Rework: which way and how far a component out of tolerance is to be moved, in directions that a fitter has."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.quality.rework.drawing import drawing_svg as drawing_svg
    from arview.quality.rework.instructions import make_instructions as make_instructions
    from arview.quality.rework.types import Instruction as Instruction
    from arview.quality.rework.types import ReworkMove as ReworkMove
    from arview.quality.rework.types import ReworkTurn as ReworkTurn
    from arview.quality.rework.types import instruction_document as instruction_document

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "drawing": ("drawing_svg",),
        "instructions": ("make_instructions",),
        "types": (
            "Instruction",
            "ReworkMove",
            "ReworkTurn",
            "instruction_document",
        ),
    },
)
