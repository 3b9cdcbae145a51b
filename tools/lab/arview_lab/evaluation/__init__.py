"""Evaluation: recorded scenes with reference poses, and the errors of the tracker against them."""

from arview.cad.viewpoint import viewpoint
from arview_lab.evaluation.bop import Scene, SceneFrame, find_scenes, load_scene
from arview_lab.evaluation.metrics import PoseError, PoseMeter
from arview_lab.evaluation.ranges import covering_range
from arview_lab.evaluation.report import format_result
from arview_lab.evaluation.run import (
    FrameResult,
    SceneResult,
    Spread,
    Summary,
    evaluate_scene,
    scene_guide_views,
    summarise,
)

__all__ = [
    "FrameResult",
    "PoseError",
    "PoseMeter",
    "Scene",
    "SceneFrame",
    "SceneResult",
    "Spread",
    "Summary",
    "covering_range",
    "evaluate_scene",
    "find_scenes",
    "format_result",
    "load_scene",
    "scene_guide_views",
    "summarise",
    "viewpoint",
]
