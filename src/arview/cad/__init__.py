"""CAD: models of named components, part files, ranges of viewpoints, and checks of a part."""

from arview.cad.check import PartCheck, PartFinding, check_part
from arview.cad.load import load_model
from arview.cad.model import Component, Model, make_model
from arview.cad.part import ComponentSettings, Datum, Part, default_view_range
from arview.cad.part_file import PART_FILE_EXAMPLE, load_part
from arview.cad.symmetry import Symmetry
from arview.cad.view_range import ViewRange

__all__ = [
    "PART_FILE_EXAMPLE",
    "Component",
    "ComponentSettings",
    "Datum",
    "Model",
    "Part",
    "PartCheck",
    "PartFinding",
    "Symmetry",
    "ViewRange",
    "check_part",
    "default_view_range",
    "load_model",
    "load_part",
    "make_model",
]
