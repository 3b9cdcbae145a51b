"""Search for a part near given poses, in a small crop of the picture: a grid of poses, then a pattern search.

Rotations, distances and shifts around a pose are scored by oriented edges (and by learned colours, if there are any)
in a picture so small that the part always spans the same few pixels. The best of the grid are improved one by one. How
far and how densely is searched is up to the caller: a few degrees around a guide view, or as far as a part can turn
between two frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.core.kernel import kernel
from arview.core.parallel import pool
from arview.detection.features.response_maps import response_maps, score_around
from arview.detection.search.nms import distinct_poses
from arview.detection.search.pattern_search import search_poses
from arview.geometry import Array
from arview.refinement import BINS, ColorModel, ViewArrays, intrinsics_of

MIN_SIDE_PX = 16
"""A crop with a shorter side shows too little of the part."""
MAX_COMPARED = 400
"""Best poses of a grid that are compared with each other."""
SHARP_SCALE = 0.6
"""Pictures that are reduced by less are interpolated, not averaged."""


@dataclass(frozen=True)
class PoseGrid:
    """Poses around a given one.

    Attributes:
        turns: (R,3,3) rotations about the part's centre, in camera axes.
        stretches: (D,) factors of the distance.
        shift_px: largest shift, px of the reduced picture.
        shift_step_px: distance of the shifts.
    """

    turns: Array
    stretches: Array
    shift_px: int
    shift_step_px: int


class NearSearch:
    """Search for one part with one camera.

    Args:
        part: guide views of the part.
        camera: of the pictures.
        diameter_mm: diameter of the part.
        contour_points, design_points: numbers of points of outline and design edges that are scored.
    """

    def __init__(
        self, part: ViewArrays, camera: Camera, diameter_mm: float, *, contour_points: int, design_points: int
    ) -> None:
        self.camera, self.diameter_mm = camera, diameter_mm
        self._part, self._points = part, (contour_points, design_points)

    def radius_px(self, cam_from_body: Array) -> float:
        """Half the part's diameter in the picture at a pose (4,4)."""
        return float(0.5 * self.diameter_mm * self.camera.fx / cam_from_body[2, 3])

    def crop(
        self,
        image: NDArray[np.uint8],
        cam_from_body: Array,
        reach_px: float,
        scale: float,
        *,
        spread_px: int,
        pad_px: int = 0,
        pooling: int = 1,
        colors: ColorModel | None = None,
    ) -> SearchCrop | None:
        """A reduced crop around the centre of the part; None outside the picture and behind the camera.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            cam_from_body: (4,4) pose in the middle of the crop.
            reach_px: half size of the crop in the picture.
            scale: by which it is reduced.
            spread_px: tolerance of edge positions in the reduced picture.
            pad_px: empty border of the reduced picture.
            pooling: factor of the resolution at which edges are detected.
            colors: of part and background, whose edges count as well.
        """
        center = self.camera.project(cam_from_body[:3, 3])
        if cam_from_body[2, 3] <= 0 or not np.all(np.isfinite(center)):
            return None
        size = np.array([self.camera.width, self.camera.height])
        first = np.clip(np.floor(center - reach_px), 0, size).astype(int)
        last = np.clip(np.ceil(center + reach_px) + 1, 0, size).astype(int)
        small = np.round((last - first) * scale).astype(int)
        if small.min() < MIN_SIDE_PX:
            return None
        part = np.ascontiguousarray(image[first[1] : last[1], first[0] : last[0]])
        if colors is not None:
            part = _with_odds(part, colors.bin_of, colors.odds)
        interpolation = cv2.INTER_AREA if scale * pooling < SHARP_SCALE else cv2.INTER_LINEAR
        part = np.asarray(
            cv2.resize(part, (pooling * int(small[0]), pooling * int(small[1])), interpolation=interpolation)
        )
        camera = self.camera.cropped(*first.tolist(), *(last - first).tolist()).scaled(*small.tolist())
        intrinsics = intrinsics_of(camera)
        intrinsics[2:4] += pad_px
        return SearchCrop(self, response_maps(part, spread_px, pad_px, pooling), intrinsics)

    def select(self, scores: Array, poses: Array, separation_deg: float, count: int) -> tuple[Array, Array]:
        """The best poses, best first, none closer to a better one; 1° corresponds to 1 % of the diameter."""
        return distinct_poses(scores, poses, self.diameter_mm, separation_deg, count, MAX_COMPARED)


class SearchCrop:
    """Response maps (8,h,w) of a crop with intrinsics (10,), see `NearSearch.crop`."""

    def __init__(self, search: NearSearch, maps: NDArray[np.uint8], intrinsics: Array) -> None:
        self._search, self._maps, self._intrinsics = search, maps, intrinsics

    def grid(self, start: Array, grid: PoseGrid) -> tuple[Array, Array]:
        """Scores (N,) 0–1 and poses (N,4,4) of a grid around a pose (4,4)."""

        def score(turns: Array) -> tuple[Array, Array]:
            step_mm = 0.01 * self._search.diameter_mm
            shifts, points = (grid.shift_px, grid.shift_step_px), self._search._points
            return score_around(
                self._maps,
                self._search._part,
                start,
                self._intrinsics,
                step_mm,
                turns,
                grid.stretches,
                *shifts,
                *points,
            )

        return _concatenated(list(pool().map(score, np.array_split(grid.turns, 2))))

    def improved(self, poses: Array, turn_deg: float, stretch: float) -> tuple[Array, Array]:
        """Scores and poses (N,4,4) after a pattern search from each of some poses with these first steps."""

        def search(starts: Array) -> tuple[Array, Array]:
            step_mm, turn_rad = 0.01 * self._search.diameter_mm, np.deg2rad(turn_deg)
            steps, points = (turn_rad, stretch, 2, 1, 2, 1), self._search._points
            return search_poses(self._maps, self._search._part, starts, self._intrinsics, step_mm, *steps, *points)

        # Alternate poses go to the two threads, because the best ones take longer.
        return _concatenated(
            list(pool().map(search, [np.ascontiguousarray(poses[k::2]) for k in range(min(2, len(poses)))]))
        )


def _concatenated(found: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    scores, poses = zip(*found, strict=True)
    return np.concatenate(scores), np.concatenate(poses)


@kernel
def _with_odds(image: NDArray[np.uint8], bin_of: NDArray[np.int64], odds: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Picture (H,W,4) with the probability that a pixel shows the part, 0–255, as its fourth channel."""
    height, width = image.shape[0], image.shape[1]
    out = np.empty((height, width, 4), dtype=np.uint8)
    table = np.empty(odds.shape[0], dtype=np.uint8)
    for i in range(odds.shape[0]):
        table[i] = np.uint8(255.0 / (1.0 + np.exp(-odds[i])))
    for y in range(height):
        for x in range(width):
            r, g, b = image[y, x, 0], image[y, x, 1], image[y, x, 2]
            out[y, x, 0], out[y, x, 1], out[y, x, 2] = r, g, b
            out[y, x, 3] = table[bin_of[r] * BINS * BINS + bin_of[g] * BINS + bin_of[b]]
    return out
