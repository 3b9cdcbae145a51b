"""Measurement: datum alignment, deviation of each component with its uncertainty, verdicts."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.measurement.again import check_not_datums as check_not_datums
    from arview.measurement.again import measure_again as measure_again
    from arview.measurement.cloud.distance_map import COLOR_STOPS as COLOR_STOPS
    from arview.measurement.cloud.distance_map import DistanceMap as DistanceMap
    from arview.measurement.cloud.distance_map import distance_map as distance_map
    from arview.measurement.cloud.distance_map import map_picture as map_picture
    from arview.measurement.cloud.distance_map import read_distance_ply as read_distance_ply
    from arview.measurement.cloud.mesh_surface import MeshSurface as MeshSurface
    from arview.measurement.folder import MetricReconstruction as MetricReconstruction
    from arview.measurement.folder import in_model_frame as in_model_frame
    from arview.measurement.folder import read_cloud as read_cloud
    from arview.measurement.folder import read_folder as read_folder
    from arview.measurement.measurand import measurand_of as measurand_of
    from arview.measurement.measurand import seat_of as seat_of
    from arview.measurement.options import MeasureOptions as MeasureOptions
    from arview.measurement.photo.patches import near_others as near_others
    from arview.measurement.repeatability import measure_halves as measure_halves
    from arview.measurement.repeatability import with_repeatability as with_repeatability
    from arview.measurement.run import measure as measure
    from arview.measurement.types import Method as Method
    from arview.measurement.uncertainty.budget import UncertaintyOptions as UncertaintyOptions
    from arview.measurement.uncertainty.decision import DecisionOptions as DecisionOptions
    from arview.measurement.uncertainty.decision import decide as decide

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "again": (
            "check_not_datums",
            "measure_again",
        ),
        "cloud.distance_map": (
            "COLOR_STOPS",
            "DistanceMap",
            "distance_map",
            "map_picture",
            "read_distance_ply",
        ),
        "cloud.mesh_surface": ("MeshSurface",),
        "folder": (
            "MetricReconstruction",
            "in_model_frame",
            "read_cloud",
            "read_folder",
        ),
        "measurand": (
            "measurand_of",
            "seat_of",
        ),
        "options": ("MeasureOptions",),
        "photo.patches": ("near_others",),
        "repeatability": (
            "measure_halves",
            "with_repeatability",
        ),
        "run": ("measure",),
        "types": ("Method",),
        "uncertainty.budget": ("UncertaintyOptions",),
        "uncertainty.decision": (
            "DecisionOptions",
            "decide",
        ),
    },
)
