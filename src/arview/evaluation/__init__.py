"""Evaluation: recorded scenes with reference poses, and the errors of the tracker against them."""

from arview.cad.viewpoint import viewpoint
from arview.evaluation.bop import Scene, SceneFrame, find_scenes, load_scene
from arview.evaluation.metrics import PoseError, PoseMeter
from arview.evaluation.ranges import covering_range
from arview.evaluation.report import format_result
from arview.evaluation.run import (
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
