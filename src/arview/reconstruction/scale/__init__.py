"""Scale and rough CAD frame of a reconstruction: boards, tags, scale bars, camera rig, and the CAD itself."""

from arview.reconstruction.scale.cad import CadOptions
from arview.reconstruction.scale.find import find_scale
from arview.reconstruction.scale.similarity import Similarity
from arview.reconstruction.scale.specs import (
    Board,
    Rig,
    ScaleBar,
    ScaleSources,
    Tags,
    load_rig,
    load_scale_file,
    parse_board,
    parse_scale_bar,
    parse_tags,
)
from arview.reconstruction.scale.types import Consistency, ScaleEvidence, ScaleResult

__all__ = [
    "Board",
    "CadOptions",
    "Consistency",
    "Rig",
    "ScaleBar",
    "ScaleEvidence",
    "ScaleResult",
    "ScaleSources",
    "Similarity",
    "Tags",
    "find_scale",
    "load_rig",
    "load_scale_file",
    "parse_board",
    "parse_scale_bar",
    "parse_tags",
]
