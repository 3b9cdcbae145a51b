"""Reconstruction: photos → camera poses → metric scale → dense cloud."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.reconstruction.added import AddedOptions as AddedOptions
    from arview.reconstruction.added import EarlierPhotos as EarlierPhotos
    from arview.reconstruction.adjustment.covariance import points_table as points_table
    from arview.reconstruction.adjustment.covariance import read_model as read_model
    from arview.reconstruction.adjustment.covariance import reprojection_residuals as reprojection_residuals
    from arview.reconstruction.colmap import import_pycolmap as import_pycolmap
    from arview.reconstruction.coverage import DIRECTION_DEG as DIRECTION_DEG
    from arview.reconstruction.coverage import DIRECTIONS_WANTED as DIRECTIONS_WANTED
    from arview.reconstruction.coverage import PHOTOS_WANTED as PHOTOS_WANTED
    from arview.reconstruction.coverage import ComponentCoverage as ComponentCoverage
    from arview.reconstruction.coverage import components_seen as components_seen
    from arview.reconstruction.coverage import count_separated as count_separated
    from arview.reconstruction.coverage import spread_deg as spread_deg
    from arview.reconstruction.dense.files import read_ply as read_ply
    from arview.reconstruction.dense.options import DenseOptions as DenseOptions
    from arview.reconstruction.given_poses import read_poses as read_poses
    from arview.reconstruction.gpu.device import torch_device as torch_device
    from arview.reconstruction.halves import HalvesOptions as HalvesOptions
    from arview.reconstruction.halves import halves_of as halves_of
    from arview.reconstruction.intake.checks import blur_and_texture as blur_and_texture
    from arview.reconstruction.intake.kept import keeping_photos as keeping_photos
    from arview.reconstruction.intake.kept import kept as kept
    from arview.reconstruction.intake.lenses import Lens as Lens
    from arview.reconstruction.intake.lenses import lenses_of as lenses_of
    from arview.reconstruction.intake.photos import read_and_check as read_and_check
    from arview.reconstruction.intake.reading import photo_paths as photo_paths
    from arview.reconstruction.intake.reading import read_photo as read_photo
    from arview.reconstruction.intake.video import VideoIntakeOptions as VideoIntakeOptions
    from arview.reconstruction.memory import SparseMemory as SparseMemory
    from arview.reconstruction.pairs import KnownPairs as KnownPairs
    from arview.reconstruction.pairs import read_pairs as read_pairs
    from arview.reconstruction.part_masks import AUTO as AUTO
    from arview.reconstruction.part_masks import PartMasks as PartMasks
    from arview.reconstruction.run import Reconstruction as Reconstruction
    from arview.reconstruction.run import ReconstructOptions as ReconstructOptions
    from arview.reconstruction.run import camera_summary as camera_summary
    from arview.reconstruction.run import intake_summary as intake_summary
    from arview.reconstruction.run import reconstruct as reconstruct
    from arview.reconstruction.run import write_sparse as write_sparse
    from arview.reconstruction.scale.cad import DETECT_WIDTH_PX as DETECT_WIDTH_PX
    from arview.reconstruction.scale.cad import SPANS as SPANS
    from arview.reconstruction.scale.cad import SUBDIVISIONS as SUBDIVISIONS
    from arview.reconstruction.scale.cad import CadOptions as CadOptions
    from arview.reconstruction.scale.cad import base_names as base_names
    from arview.reconstruction.scale.cad import search_ranges as search_ranges
    from arview.reconstruction.scale.cad import shrunk as shrunk
    from arview.reconstruction.scale.find import find_scale as find_scale
    from arview.reconstruction.scale.rig import RigPlacement as RigPlacement
    from arview.reconstruction.scale.rig import cameras_from_part as cameras_from_part
    from arview.reconstruction.scale.rig import place_on_rig as place_on_rig
    from arview.reconstruction.scale.similarity import Similarity as Similarity
    from arview.reconstruction.scale.specs import ScaleSources as ScaleSources
    from arview.reconstruction.scale.specs import load_rig as load_rig
    from arview.reconstruction.scale.specs import load_scale_file as load_scale_file
    from arview.reconstruction.scale.specs import parse_scale_bar as parse_scale_bar
    from arview.reconstruction.scale.targets import PRINT_STD as PRINT_STD
    from arview.reconstruction.scale.types import Consistency as Consistency
    from arview.reconstruction.scale.types import ScaleEvidence as ScaleEvidence
    from arview.reconstruction.scale.types import ScaleResult as ScaleResult
    from arview.reconstruction.sparse import SparseOptions as SparseOptions
    from arview.reconstruction.sparse import match_by_appearance as match_by_appearance
    from arview.reconstruction.sparse import moving_features as moving_features
    from arview.reconstruction.still import MAX_SHIFT_PX as MAX_SHIFT_PX
    from arview.reconstruction.types import DenseCloud as DenseCloud
    from arview.reconstruction.types import Photo as Photo
    from arview.reconstruction.types import PosedPhoto as PosedPhoto
    from arview.reconstruction.types import SparseModel as SparseModel

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "added": (
            "AddedOptions",
            "EarlierPhotos",
        ),
        "colmap": ("import_pycolmap",),
        "adjustment.covariance": ("points_table", "read_model", "reprojection_residuals"),
        "coverage": (
            "ComponentCoverage",
            "DIRECTIONS_WANTED",
            "DIRECTION_DEG",
            "PHOTOS_WANTED",
            "components_seen",
            "count_separated",
            "spread_deg",
        ),
        "dense.files": ("read_ply",),
        "dense.options": ("DenseOptions",),
        "given_poses": ("read_poses",),
        "gpu.device": ("torch_device",),
        "halves": (
            "HalvesOptions",
            "halves_of",
        ),
        "intake.checks": ("blur_and_texture",),
        "intake.kept": (
            "keeping_photos",
            "kept",
        ),
        "intake.lenses": (
            "Lens",
            "lenses_of",
        ),
        "intake.photos": ("read_and_check",),
        "intake.reading": (
            "photo_paths",
            "read_photo",
        ),
        "intake.video": ("VideoIntakeOptions",),
        "memory": ("SparseMemory",),
        "pairs": (
            "KnownPairs",
            "read_pairs",
        ),
        "part_masks": (
            "AUTO",
            "PartMasks",
        ),
        "run": (
            "ReconstructOptions",
            "Reconstruction",
            "camera_summary",
            "intake_summary",
            "reconstruct",
            "write_sparse",
        ),
        "scale.cad": (
            "CadOptions",
            "DETECT_WIDTH_PX",
            "SPANS",
            "SUBDIVISIONS",
            "base_names",
            "search_ranges",
            "shrunk",
        ),
        "scale.find": ("find_scale",),
        "scale.rig": (
            "RigPlacement",
            "cameras_from_part",
            "place_on_rig",
        ),
        "scale.similarity": ("Similarity",),
        "scale.specs": (
            "ScaleSources",
            "load_rig",
            "load_scale_file",
            "parse_scale_bar",
        ),
        "scale.targets": ("PRINT_STD",),
        "scale.types": (
            "Consistency",
            "ScaleEvidence",
            "ScaleResult",
        ),
        "sparse": (
            "SparseOptions",
            "match_by_appearance",
            "moving_features",
        ),
        "still": ("MAX_SHIFT_PX",),
        "types": (
            "DenseCloud",
            "Photo",
            "PosedPhoto",
            "SparseModel",
        ),
    },
)
