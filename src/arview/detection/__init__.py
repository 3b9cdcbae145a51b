"""Detection of a part in a single image, without an earlier pose."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.detection.detector import Detection as Detection
    from arview.detection.detector import Detector as Detector
    from arview.detection.detector import DetectorOptions as DetectorOptions
    from arview.detection.detector import RejectedHypothesis as RejectedHypothesis
    from arview.detection.detector import local_search_for as local_search_for
    from arview.detection.detector import options_for as options_for
    from arview.detection.features.edge_net import EdgeNet as EdgeNet
    from arview.detection.features.image_pyramid import ImagePyramid as ImagePyramid
    from arview.detection.scene_change import SceneChange as SceneChange
    from arview.detection.scoring.crops import BAND_PX as BAND_PX
    from arview.detection.scoring.crops import DRAWN_CHANNELS as DRAWN_CHANNELS
    from arview.detection.scoring.crops import append_edge_responses as append_edge_responses
    from arview.detection.scoring.crops import append_gradients as append_gradients
    from arview.detection.scoring.crops import crop_edge_responses as crop_edge_responses
    from arview.detection.scoring.crops import normalise_colours as normalise_colours
    from arview.detection.scoring.score_net import NetworkInput as NetworkInput
    from arview.detection.scoring.score_net import ScoreNet as ScoreNet
    from arview.detection.scoring.score_net import size_and_contrast as size_and_contrast
    from arview.detection.search.global_search import PoseCandidate as PoseCandidate
    from arview.detection.search.hypothesis import Hypothesis as Hypothesis
    from arview.detection.search.local_search import DISTINCT_DEG as DISTINCT_DEG
    from arview.detection.search.local_search import FINE_SCHEDULES as FINE_SCHEDULES
    from arview.detection.search.local_search import FINE_TOLERANCE_PX as FINE_TOLERANCE_PX
    from arview.detection.search.local_search import LocalSearch as LocalSearch
    from arview.detection.search.local_search import LocalSearchOptions as LocalSearchOptions
    from arview.detection.search.near_search import NearSearch as NearSearch
    from arview.detection.search.near_search import PoseGrid as PoseGrid

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "detector": (
            "Detection",
            "Detector",
            "DetectorOptions",
            "RejectedHypothesis",
            "local_search_for",
            "options_for",
        ),
        "features.edge_net": ("EdgeNet",),
        "features.image_pyramid": ("ImagePyramid",),
        "scene_change": ("SceneChange",),
        "scoring.crops": (
            "BAND_PX",
            "DRAWN_CHANNELS",
            "append_edge_responses",
            "append_gradients",
            "crop_edge_responses",
            "normalise_colours",
        ),
        "scoring.score_net": (
            "NetworkInput",
            "ScoreNet",
            "size_and_contrast",
        ),
        "search.global_search": ("PoseCandidate",),
        "search.hypothesis": ("Hypothesis",),
        "search.local_search": (
            "DISTINCT_DEG",
            "FINE_SCHEDULES",
            "FINE_TOLERANCE_PX",
            "LocalSearch",
            "LocalSearchOptions",
        ),
        "search.near_search": (
            "NearSearch",
            "PoseGrid",
        ),
    },
)
