"""Scale and approximate CAD frame of a reconstruction, from boards, tags, layouts, bars, camera rigs and the CAD."""

from arview.reconstruction.scale.cad import CadOptions
from arview.reconstruction.scale.find import find_scale
from arview.reconstruction.scale.similarity import Similarity
from arview.reconstruction.scale.specs import Rig, ScaleBar, ScaleSources, load_rig, load_scale_file, parse_scale_bar
from arview.reconstruction.scale.types import Consistency, ScaleEvidence, ScaleResult

__all__ = [
    "CadOptions",
    "Consistency",
    "Rig",
    "ScaleBar",
    "ScaleEvidence",
    "ScaleResult",
    "ScaleSources",
    "Similarity",
    "find_scale",
    "load_rig",
    "load_scale_file",
    "parse_scale_bar",
]
