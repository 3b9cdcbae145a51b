"""CAD: models of named components, part files, ranges of viewpoints, and checks of a part."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.cad.check import GUESSED_CAMERA as GUESSED_CAMERA
    from arview.cad.check import PartCheck as PartCheck
    from arview.cad.check import PartFinding as PartFinding
    from arview.cad.check import check_part as check_part
    from arview.cad.datum_check import find_rims as find_rims
    from arview.cad.fitness import face_areas as face_areas
    from arview.cad.formats.pmi import Pmi as Pmi
    from arview.cad.formats.pmi import read_pmi as read_pmi
    from arview.cad.load import LoadedCad as LoadedCad
    from arview.cad.load import load_cad as load_cad
    from arview.cad.load import load_model as load_model
    from arview.cad.model import Component as Component
    from arview.cad.model import Model as Model
    from arview.cad.model import make_model as make_model
    from arview.cad.part import Characteristic as Characteristic
    from arview.cad.part import ComponentSettings as ComponentSettings
    from arview.cad.part import Datum as Datum
    from arview.cad.part import DatumFeature as DatumFeature
    from arview.cad.part import Guide as Guide
    from arview.cad.part import Part as Part
    from arview.cad.part import ReworkSettings as ReworkSettings
    from arview.cad.part import default_view_range as default_view_range
    from arview.cad.part_file import PART_FILE_EXAMPLE as PART_FILE_EXAMPLE
    from arview.cad.part_file import find_part_file as find_part_file
    from arview.cad.part_file import load_part as load_part
    from arview.cad.part_file import part_from_text as part_from_text
    from arview.cad.picking import PickedFeature as PickedFeature
    from arview.cad.picking import pick_features as pick_features
    from arview.cad.picking import smooth_faces as smooth_faces
    from arview.cad.pmi_proposal import propose_part as propose_part
    from arview.cad.samples import Samples as Samples
    from arview.cad.samples import sample_surface as sample_surface
    from arview.cad.shape.mesh_topology import EdgeFaces as EdgeFaces
    from arview.cad.shape.mesh_topology import edge_faces as edge_faces
    from arview.cad.shape.revolution import find_round_axis as find_round_axis
    from arview.cad.shape.symmetry import FoundSymmetry as FoundSymmetry
    from arview.cad.shape.symmetry import Symmetry as Symmetry
    from arview.cad.shape.symmetry import find_symmetries as find_symmetries
    from arview.cad.toml_table import TomlTable as TomlTable
    from arview.cad.view_range import ViewRange as ViewRange
    from arview.cad.viewpoint import Viewpoint as Viewpoint
    from arview.cad.viewpoint import pose_at as pose_at

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "check": (
            "GUESSED_CAMERA",
            "PartCheck",
            "PartFinding",
            "check_part",
        ),
        "datum_check": ("find_rims",),
        "fitness": ("face_areas",),
        "load": (
            "LoadedCad",
            "load_cad",
            "load_model",
        ),
        "shape.revolution": ("find_round_axis",),
        "shape.mesh_topology": ("EdgeFaces", "edge_faces"),
        "model": (
            "Component",
            "Model",
            "make_model",
        ),
        "part": (
            "Characteristic",
            "ComponentSettings",
            "Datum",
            "DatumFeature",
            "Guide",
            "Part",
            "ReworkSettings",
            "default_view_range",
        ),
        "part_file": (
            "PART_FILE_EXAMPLE",
            "find_part_file",
            "load_part",
            "part_from_text",
        ),
        "pmi_proposal": ("propose_part",),
        "formats.pmi": ("Pmi", "read_pmi"),
        "picking": (
            "PickedFeature",
            "pick_features",
            "smooth_faces",
        ),
        "samples": (
            "Samples",
            "sample_surface",
        ),
        "shape.symmetry": (
            "FoundSymmetry",
            "Symmetry",
            "find_symmetries",
        ),
        "toml_table": ("TomlTable",),
        "view_range": ("ViewRange",),
        "viewpoint": (
            "Viewpoint",
            "pose_at",
        ),
    },
)
