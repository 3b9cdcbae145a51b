"""Options of the tracker."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from arview.errors import InputError
from arview.geometry import Array
from arview.refinement import TRACK_STAGES, RefinerOptions, ShadingOptions, Stage, TextureMatches, WorkingScaleOptions

STAGES: tuple[Stage, ...] = TRACK_STAGES
"""Schedule of a usual frame."""
SCALE, COLOR_SCALE = WorkingScaleOptions(), WorkingScaleOptions(max_enlargement=1.0)
"""Options of the pictures in which poses are refined and judged."""


class PointMatches(NamedTuple):
    """Points of a part that were found in a picture.

    Attributes:
        points_in_model: (N,3) mm.
        pixels: (N,2) where each was found, with the distortion of the camera.
        weights: (N,) 0–1; a point of weight 1 counts as one found to about a pixel.
    """

    points_in_model: Array
    pixels: Array
    weights: Array

    def joined(self, matches: TextureMatches | None, center_in_model: Array) -> TextureMatches:
        """These points after those found by the texture, about the centre (3,) of the part."""
        points = self.points_in_model - center_in_model
        if matches is None:
            return TextureMatches(points, self.pixels, self.weights, len(points))
        return TextureMatches(
            np.concatenate([matches.points_in_body, points]),
            np.concatenate([matches.pixels, self.pixels]),
            np.concatenate([matches.weights, self.weights]),
            matches.tried + len(points),
        )


class Matcher(Protocol):
    """Finds points of the part in a picture: a modality beside colours, edges and texture."""

    def match(self, image: NDArray[np.uint8], cam_from_model: Array, /) -> PointMatches:
        """Points of the part in a picture (H,W,3) uint8 RGB of the session's camera, near a predicted pose (4,4)."""
        ...


@dataclass(frozen=True)
class TrackerOptions(RefinerOptions):
    """Options of the tracker, in addition to those of the refinement.

    Attributes:
        use_texture: match the part's own texture; needs the model's surface.
        matcher: finds more points of the part.
        shading: as of the refinement, with fewer rounds and less weight than for a pose found by a search, because the
            errors of the brightness are common to many pixels and the tracked pose is nearly right.
    """

    use_texture: bool = True
    matcher: Matcher | None = None
    shading: ShadingOptions = field(default_factory=lambda: ShadingOptions(gain=0.5, rounds=1))

    def __post_init__(self) -> None:
        if not (self.use_region or self.use_edge or self.use_texture):
            raise InputError("tracker: at least one modality must be on")
