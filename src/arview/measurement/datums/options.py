"""Options of measuring datum features."""

from __future__ import annotations

from dataclasses import dataclass, field

from arview.measurement.datums.equations import AlignmentOptions
from arview.measurement.photo.options import EdgeOptions, SweepOptions


@dataclass(frozen=True)
class DatumOptions:
    """Options of measuring datum features."""

    samples: int = 500  # on a plane; errors of denser samples are correlated
    clear_mm: float = 8.0  # distance to other components: weld beads and spatter lie within a leg's length of the joint
    min_clear_mm: float = 2.0  # the same where a plane has no room for more
    point_radius_mm: float = 4.0  # of the disc around a datum point that is measured; a few patches
    reach_mm: float = 1.0  # largest distance of a feature from its rough place
    rim_points: int = 120  # around a hole; about one px apart on small ones
    fine_reach_px: float = 3.0  # search range around the place that the first search of a rim found
    rim_px: float = 0.04  # expected standard uncertainty of a rim's position by rust, chalk and burrs beside it
    edge_px: float = 0.07  # standard uncertainty common to straight edges of a datum, by rust, chalk and burrs
    plane_form_mm: float = 0.02  # standard uncertainty of a plane beside all other edges of its component, by form
    rival_px: float = 3.0  # rim points with the opposite rim this near in a photo are not used there
    sweep: SweepOptions = field(default_factory=SweepOptions)
    alignment: AlignmentOptions = field(default_factory=AlignmentOptions)
    edges: EdgeOptions = field(default_factory=EdgeOptions)
