"""Refinement: from a rough pose to the pose, in one picture; nothing is kept between calls."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.refinement.evidence import DECISION_SCORE as DECISION_SCORE
    from arview.refinement.evidence import MIN_IN_PICTURE as MIN_IN_PICTURE
    from arview.refinement.evidence import EdgeSteps as EdgeSteps
    from arview.refinement.evidence import PoseEvidence as PoseEvidence
    from arview.refinement.gauss_newton import apply_twist as apply_twist
    from arview.refinement.gauss_newton import relative_twist as relative_twist
    from arview.refinement.kernels import STRENGTH_HALF as STRENGTH_HALF
    from arview.refinement.kernels import median_brightness_ratio as median_brightness_ratio
    from arview.refinement.kernels import nearest_view as nearest_view
    from arview.refinement.modalities.edge import CUT_OFF as CUT_OFF
    from arview.refinement.modalities.edge import HYPOTHESES as HYPOTHESES
    from arview.refinement.modalities.edge import EdgeProfiles as EdgeProfiles
    from arview.refinement.modalities.edge import measure_edges as measure_edges
    from arview.refinement.modalities.edge import smoothed as smoothed
    from arview.refinement.modalities.patch_alignment import Pyramid as Pyramid
    from arview.refinement.modalities.region import BINS as BINS
    from arview.refinement.modalities.region import ColorModel as ColorModel
    from arview.refinement.modalities.region import value_bins as value_bins
    from arview.refinement.modalities.shading import ShadingOptions as ShadingOptions
    from arview.refinement.modalities.texture import TextureMatches as TextureMatches
    from arview.refinement.modalities.texture import TextureModality as TextureModality
    from arview.refinement.projection import ProjectedLines as ProjectedLines
    from arview.refinement.projection import ViewArrays as ViewArrays
    from arview.refinement.projection import intrinsics_of as intrinsics_of
    from arview.refinement.projection import project as project
    from arview.refinement.projection import project_lines as project_lines
    from arview.refinement.refinement_pyramid import PoseScores as PoseScores
    from arview.refinement.refinement_pyramid import RefinementPyramid as RefinementPyramid
    from arview.refinement.refiner import Appearance as Appearance
    from arview.refinement.refiner import PoseRefiner as PoseRefiner
    from arview.refinement.refiner import RefinerOptions as RefinerOptions
    from arview.refinement.schedules import FAR_STAGES as FAR_STAGES
    from arview.refinement.schedules import LAST_STAGES as LAST_STAGES
    from arview.refinement.schedules import NEAR_STAGES as NEAR_STAGES
    from arview.refinement.schedules import SEARCH_STAGES as SEARCH_STAGES
    from arview.refinement.schedules import TRACK_STAGES as TRACK_STAGES
    from arview.refinement.schedules import Stage as Stage
    from arview.refinement.view_model import PartView as PartView
    from arview.refinement.working_picture import MARGIN_PX as MARGIN_PX
    from arview.refinement.working_picture import WorkingScaleOptions as WorkingScaleOptions
    from arview.refinement.working_picture import window_around as window_around

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "evidence": (
            "DECISION_SCORE",
            "EdgeSteps",
            "MIN_IN_PICTURE",
            "PoseEvidence",
        ),
        "gauss_newton": (
            "apply_twist",
            "relative_twist",
        ),
        "kernels": (
            "STRENGTH_HALF",
            "median_brightness_ratio",
            "nearest_view",
        ),
        "modalities.edge": (
            "CUT_OFF",
            "EdgeProfiles",
            "HYPOTHESES",
            "measure_edges",
            "smoothed",
        ),
        "modalities.patch_alignment": ("Pyramid",),
        "modalities.region": (
            "BINS",
            "ColorModel",
            "value_bins",
        ),
        "modalities.shading": ("ShadingOptions",),
        "modalities.texture": (
            "TextureMatches",
            "TextureModality",
        ),
        "projection": (
            "ProjectedLines",
            "ViewArrays",
            "intrinsics_of",
            "project",
            "project_lines",
        ),
        "refinement_pyramid": (
            "PoseScores",
            "RefinementPyramid",
        ),
        "refiner": (
            "Appearance",
            "PoseRefiner",
            "RefinerOptions",
        ),
        "schedules": (
            "FAR_STAGES",
            "LAST_STAGES",
            "NEAR_STAGES",
            "SEARCH_STAGES",
            "Stage",
            "TRACK_STAGES",
        ),
        "view_model": ("PartView",),
        "working_picture": (
            "MARGIN_PX",
            "WorkingScaleOptions",
            "window_around",
        ),
    },
)
