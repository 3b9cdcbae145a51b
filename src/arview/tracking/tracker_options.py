"""Options of the tracker."""

from __future__ import annotations

from dataclasses import dataclass, field

from arview.errors import InputError
from arview.refinement import TRACK_STAGES, RefinerOptions, ShadingOptions, Stage, WorkingScaleOptions

STAGES: tuple[Stage, ...] = TRACK_STAGES
"""Schedule of a usual frame."""
SCALE, COLOR_SCALE = WorkingScaleOptions(), WorkingScaleOptions(max_enlargement=1.0)
"""Options of the pictures in which poses are refined and judged."""


@dataclass(frozen=True)
class TrackerOptions(RefinerOptions):
    """Options of the tracker, in addition to those of the refinement.

    Attributes:
        use_texture: match the part's own texture; needs the model's surface.
        shading: as of the refinement, with fewer rounds and less weight than for a pose found by a search, because the
            errors of the brightness are common to many pixels and the tracked pose is nearly right.
    """

    use_texture: bool = True
    shading: ShadingOptions = field(default_factory=lambda: ShadingOptions(gain=0.5, rounds=2))

    def __post_init__(self) -> None:
        if not (self.use_region or self.use_edge or self.use_texture):
            raise InputError("tracker: at least one modality must be on")
