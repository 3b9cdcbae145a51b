"""Rework: which way and how far a component out of tolerance is to be moved, in directions that a fitter has."""

from arview.quality.rework.drawing import drawing_svg
from arview.quality.rework.instructions import instructions
from arview.quality.rework.types import Instruction, ReworkMove, ReworkTurn, instruction_document

__all__ = [
    "Instruction",
    "ReworkMove",
    "ReworkTurn",
    "drawing_svg",
    "instruction_document",
    "instructions",
]
