"""Non-local search: finds the part again around its last poses when it moved farther than the tracker's stages reach.

After the idea of Tian et al., "Large-displacement 3D Object Tracking with Hybrid Non-local Optimization" (ECCV 2022):
rotations are sampled widely, the rest is found for each, and the best are refined locally. Own here: turns, distances
and shifts are scored by oriented edges of the picture and of the learned colours in a small crop (`matching`), and
the best are climbed (`search_poses`) there and once more at twice the resolution.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.core import parallel as threads
from arview.core.kernel import kernel
from arview.detection.features.response_maps import response_maps, score_around
from arview.detection.search.pattern_search import search_poses
from arview.detection.search.template_bank import select_distinct
from arview.geometry import Array, turn_ball
from arview.refinement.modalities.region import BINS, ColorModel


@dataclass(frozen=True)
class WideSearchOptions:
    """Options of the search.

    Attributes:
        radii_px: half the part's diameter in the pictures of the two rounds.
        turn_reach_deg, turn_step_deg: turns tried, a ball of them; stretches: factors of the distance.
        shift: of the picture, in radii; shift_step_px: in the first round's pixels.
        points: of the outline and, as many, of design edges that are looked at.
        climbed: how many of the first round's best are climbed, and of those again in the second round.
        kept: poses left.
    """

    radii_px: tuple[float, float] = (26.0, 52.0)
    turn_reach_deg: float = 42.0
    turn_step_deg: float = 18.0
    stretches: tuple[float, ...] = (0.93, 1.0, 1.075)
    shift: float = 0.7
    shift_step_px: int = 3
    points: int = 48
    climbed: tuple[int, int] = (12, 6)
    kept: int = 4


class WideSearch:
    """Search for one part with one camera.

    Args:
        part: arrays of all guide views, see `PartView.arrays`.
        camera: of the frames; ``intrinsics`` (10,) as the kernels take them.
        diameter_mm: of the part.
    """

    def __init__(
        self,
        part: tuple[NDArray[np.generic], ...],
        camera: Camera,
        intrinsics: Array,
        diameter_mm: float,
        options: WideSearchOptions | None = None,
    ) -> None:
        self.options = options or WideSearchOptions()
        self._part = part
        self._camera = camera
        self._intrinsics = intrinsics
        self._diameter_mm = diameter_mm
        self._turns = turn_ball(self.options.turn_reach_deg, self.options.turn_step_deg)
        self._stretches = np.array(self.options.stretches)

    def find(self, image: NDArray[np.uint8], colors: ColorModel, start: Array) -> list[Array]:
        """The likeliest poses (``cam_from_body``) around a start, best first; none outside the picture.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            colors: colours of part and background.
            start: (4,4) ``cam_from_body``.
        """
        o = self.options
        center = self._camera.project(start[:3, 3])
        if start[2, 3] <= 0 or not np.all(np.isfinite(center)):
            return []
        radius_px = 0.5 * self._diameter_mm * self._camera.fx / start[2, 3]
        made = self._maps(image, colors, center, (1.1 + o.shift) * radius_px, o.radii_px[0] / radius_px)
        if made is None:
            return []
        maps, intrinsics = made
        step_mm = 0.01 * self._diameter_mm
        shift_px = round(o.shift * o.radii_px[0])

        def score(turns: Array) -> tuple[Array, Array]:
            return score_around(
                maps, self._part, start, intrinsics, step_mm, turns, self._stretches, shift_px,
                o.shift_step_px, o.points, o.points,
            )  # fmt: skip

        found = list(threads.pool().map(score, np.array_split(self._turns, 2)))
        scores, poses = np.concatenate([f[0] for f in found]), np.concatenate([f[1] for f in found])
        poses = self._apart(scores, poses, 10.0, o.climbed[0])[1]
        scores, poses = self._climb(maps, poses, intrinsics, 7.0, 0.04)
        scores, poses = self._apart(scores, poses, 5.0, o.climbed[1])
        best = poses[0]
        radius_px = 0.5 * self._diameter_mm * self._camera.fx / best[2, 3]
        center = self._camera.project(best[:3, 3])
        made = self._maps(image, colors, center, 1.25 * radius_px, o.radii_px[1] / radius_px)
        if made is None:
            return []
        maps, intrinsics = made
        scores, poses = self._climb(maps, poses, intrinsics, 3.0, 0.02)
        scores, poses = self._apart(scores, poses, 2.5, o.kept)
        return list(poses)

    def _climb(
        self, maps: NDArray[np.uint8], poses: Array, intrinsics: Array, turn_deg: float, stretch: float
    ) -> tuple[Array, Array]:
        """Scores and poses (N,4,4) after a pattern search from each of some poses."""
        points = self.options.points

        def search(starts: Array) -> tuple[Array, Array]:
            return search_poses(
                maps, self._part, starts, intrinsics, 0.01 * self._diameter_mm, np.deg2rad(turn_deg), stretch,
                2, 1, 2, 1, points, points,
            )  # fmt: skip

        # Every other one: the first are not much alike in what they cost.
        results = list(
            threads.pool().map(search, [np.ascontiguousarray(poses[k::2]) for k in range(2) if len(poses[k::2])])
        )
        return np.concatenate([r[0] for r in results]), np.concatenate([r[1] for r in results])

    def _apart(self, scores: Array, poses: Array, apart_deg: float, most: int) -> tuple[Array, Array]:
        """The best poses, best first, none nearer to a better one than an angle (and as many % of the part)."""
        order = np.argsort(-scores, kind="stable")[:400]
        scores, poses = scores[order], poses[order]
        reach = np.full(len(poses), 0.01 * apart_deg * self._diameter_mm) / poses[:, 2, 3]
        chosen = select_distinct(
            np.ascontiguousarray(poses[:, :3, :3]), np.ascontiguousarray(poses[:, :3, 3]), reach,
            np.cos(np.deg2rad(apart_deg)), 1.0 + 0.01 * apart_deg, most,
        )  # fmt: skip
        return scores[chosen], np.ascontiguousarray(poses[chosen])

    def _maps(
        self,
        image: NDArray[np.uint8],
        colors: ColorModel,
        center: Array,
        reach_px: float,
        scale: float,
    ) -> tuple[NDArray[np.uint8], Array] | None:
        """Response maps of the picture around a place, made small, and their intrinsics; None outside the picture."""
        size = np.array([self._camera.width, self._camera.height])
        first = np.clip(np.floor(center - reach_px), 0, size).astype(int)
        last = np.clip(np.ceil(center + reach_px) + 1, 0, size).astype(int)
        # Edges are found at twice the resolution as long as the picture has it.
        pool = 2 if scale <= 0.5 else 1
        small = np.round((last - first) * scale).astype(int)
        if small.min() < 16:
            return None
        crop = _with_odds(image[first[1] : last[1], first[0] : last[0]], colors.bin_of, colors.odds)
        way = cv2.INTER_AREA if scale * pool < 0.6 else cv2.INTER_LINEAR
        crop = np.asarray(cv2.resize(crop, (pool * int(small[0]), pool * int(small[1])), interpolation=way))
        stretch = small / (last - first)
        intrinsics = self._intrinsics.copy()
        intrinsics[:2] *= stretch
        intrinsics[2:4] = (intrinsics[2:4] - first + 0.5) * stretch - 0.5
        return response_maps(crop, 1, 0, pool), intrinsics


@kernel
def _with_odds(image, bin_of, odds):  # type: ignore[no-untyped-def]
    """(H,W,4): a picture with the probability that a pixel is of the part, 0–255, as its fourth channel."""
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
