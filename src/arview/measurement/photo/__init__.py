"""Positions of components measured in the photos themselves: from their surfaces (sweep) and from their edges."""

from arview.measurement.photo.edge_offsets import EdgeOffsets, edge_offsets
from arview.measurement.photo.measure import measure_components_in_photos
from arview.measurement.photo.rival_edges import EdgePoints
from arview.measurement.photo.sweep import SweepOffsets, sweep_offsets
from arview.measurement.photo.views import PhotoViews, load_views

__all__ = [
    "EdgeOffsets",
    "EdgePoints",
    "PhotoViews",
    "SweepOffsets",
    "edge_offsets",
    "load_views",
    "measure_components_in_photos",
    "sweep_offsets",
]
