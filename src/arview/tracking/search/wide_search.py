"""Wide search around a predicted pose, for a part that moved farther than the schedules of the tracker reach.

After Tian et al., "Large-displacement 3D Object Tracking with Hybrid Non-local Optimization" (ECCV 2022): rotations are
sampled widely, the other parameters are found for each, and the best poses are refined locally. Here rotations,
distances and shifts are scored by oriented edges of the picture and of the learned colours in a small crop. The best
are refined by a pattern search there, and again at twice the resolution.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.core.kernel import kernel
from arview.core.parallel import pool
from arview.detection import response_maps, score_around, search_poses, select_distinct
from arview.geometry import Array, turn_ball
from arview.refinement import BINS, ColorModel, ViewArrays

RADII_PX = (26.0, 52.0)
"""Half diameter of the part in the pictures of the two rounds."""
TURN_REACH_DEG = 42.0
"""Largest rotation tried."""
TURN_STEP_DEG = 18.0
"""Distance of the rotations tried."""
STRETCHES: tuple[float, ...] = (0.93, 1.0, 1.075)
"""Factors of the distance tried."""
SHIFT = 0.7
"""Largest shift tried, in half diameters."""
SHIFT_STEP_PX = 3
"""Distance of the shifts tried, px of the first round's picture."""
POINTS = 48
"""Points of the outline, and as many of design edges, that are scored."""
REFINED = (12, 6)
"""Poses refined by the pattern search in the two rounds."""
KEPT = 4
"""Poses returned."""
SEARCH_STEPS_DEG = (7.0, 3.0)
"""First rotations of the pattern search in the two rounds."""
SEARCH_STRETCHES = (0.04, 0.02)
"""First relative changes of the distance in the two rounds."""
SEPARATION_DEG = (10.0, 5.0, 2.5)
"""Smallest difference between the poses that go into the two pattern searches and are returned; 1° corresponds to 1 %
of the diameter."""
CROP_MARGIN = (1.1, 1.25)
"""Half size of the crops of the two rounds, in half diameters, without shifts."""


class WideSearch:
    """Search for one part with one camera.

    Args:
        part: guide views of the part.
        camera: camera of the frames.
        intrinsics: (10,) of the camera, as of `intrinsics_of`.
        diameter_mm: diameter of the part.
    """

    def __init__(
        self,
        part: ViewArrays,
        camera: Camera,
        intrinsics: Array,
        diameter_mm: float,
    ) -> None:
        self._part = part
        self._camera = camera
        self._intrinsics = intrinsics
        self._diameter_mm = diameter_mm
        self._turns = turn_ball(TURN_REACH_DEG, TURN_STEP_DEG)
        self._stretches = np.array(STRETCHES)

    def find(self, image: NDArray[np.uint8], colors: ColorModel, start: Array) -> list[Array]:
        """The best poses (4,4) ``cam_from_body`` around a start, best first; none where it is outside the picture.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            colors: colours of part and background.
            start: (4,4) ``cam_from_body``.
        """
        center = self._camera.project(start[:3, 3])
        if start[2, 3] <= 0 or not np.all(np.isfinite(center)):
            return []
        radius_px = 0.5 * self._diameter_mm * self._camera.fx / start[2, 3]
        made = self._maps(image, colors, center, (CROP_MARGIN[0] + SHIFT) * radius_px, RADII_PX[0] / radius_px)
        if made is None:
            return []
        maps, intrinsics = made
        step_mm = 0.01 * self._diameter_mm
        shift_px = round(SHIFT * RADII_PX[0])

        def score(turns: Array) -> tuple[Array, Array]:
            return score_around(
                maps,
                self._part,
                start,
                intrinsics,
                step_mm,
                turns,
                self._stretches,
                shift_px,
                SHIFT_STEP_PX,
                POINTS,
                POINTS,
            )

        found = list(pool().map(score, np.array_split(self._turns, 2)))
        scores, poses = np.concatenate([f[0] for f in found]), np.concatenate([f[1] for f in found])
        poses = self._select(scores, poses, SEPARATION_DEG[0], REFINED[0])[1]
        scores, poses = self._refine(maps, poses, intrinsics, SEARCH_STEPS_DEG[0], SEARCH_STRETCHES[0])
        scores, poses = self._select(scores, poses, SEPARATION_DEG[1], REFINED[1])
        best = poses[0]
        radius_px = 0.5 * self._diameter_mm * self._camera.fx / best[2, 3]
        center = self._camera.project(best[:3, 3])
        made = self._maps(image, colors, center, CROP_MARGIN[1] * radius_px, RADII_PX[1] / radius_px)
        if made is None:
            return []
        maps, intrinsics = made
        scores, poses = self._refine(maps, poses, intrinsics, SEARCH_STEPS_DEG[1], SEARCH_STRETCHES[1])
        scores, poses = self._select(scores, poses, SEPARATION_DEG[2], KEPT)
        return list(poses)

    def _refine(
        self, maps: NDArray[np.uint8], poses: Array, intrinsics: Array, turn_deg: float, stretch: float
    ) -> tuple[Array, Array]:
        """Scores and poses (N,4,4) after a pattern search from each of some poses (N,4,4)."""
        points = POINTS

        def search(starts: Array) -> tuple[Array, Array]:
            return search_poses(
                maps,
                self._part,
                starts,
                intrinsics,
                0.01 * self._diameter_mm,
                np.deg2rad(turn_deg),
                stretch,
                2,
                1,
                2,
                1,
                points,
                points,
            )

        # Alternate poses go to the two threads, because the best ones take longer.
        results = list(pool().map(search, [np.ascontiguousarray(poses[k::2]) for k in range(2) if len(poses[k::2])]))
        return np.concatenate([r[0] for r in results]), np.concatenate([r[1] for r in results])

    def _select(self, scores: Array, poses: Array, separation_deg: float, max_count: int) -> tuple[Array, Array]:
        """The best poses, best first, none closer to a better one than a separation."""
        order = np.argsort(-scores, kind="stable")[:400]
        scores, poses = scores[order], poses[order]
        reach = np.full(len(poses), 0.01 * separation_deg * self._diameter_mm) / poses[:, 2, 3]
        chosen = select_distinct(
            np.ascontiguousarray(poses[:, :3, :3]),
            np.ascontiguousarray(poses[:, :3, 3]),
            reach,
            np.cos(np.deg2rad(separation_deg)),
            1.0 + 0.01 * separation_deg,
            max_count,
        )
        return scores[chosen], np.ascontiguousarray(poses[chosen])

    def _maps(
        self,
        image: NDArray[np.uint8],
        colors: ColorModel,
        center: Array,
        reach_px: float,
        scale: float,
    ) -> tuple[NDArray[np.uint8], Array] | None:
        """Response maps of a reduced crop around a pixel (2,), and its intrinsics; None outside the picture.

        The crop reaches ``reach_px`` of the picture to every side and is reduced by ``scale``.
        """
        size = np.array([self._camera.width, self._camera.height])
        first = np.clip(np.floor(center - reach_px), 0, size).astype(int)
        last = np.clip(np.ceil(center + reach_px) + 1, 0, size).astype(int)
        # Edges are detected at twice the resolution where the picture has it.
        pooling = 2 if scale <= 0.5 else 1
        small = np.round((last - first) * scale).astype(int)
        if small.min() < 16:
            return None
        crop = _with_odds(image[first[1] : last[1], first[0] : last[0]], colors.bin_of, colors.odds)
        interpolation = cv2.INTER_AREA if scale * pooling < 0.6 else cv2.INTER_LINEAR
        crop = np.asarray(
            cv2.resize(crop, (pooling * int(small[0]), pooling * int(small[1])), interpolation=interpolation)
        )
        stretch = small / (last - first)
        intrinsics = self._intrinsics.copy()
        intrinsics[:2] *= stretch
        intrinsics[2:4] = (intrinsics[2:4] - first + 0.5) * stretch - 0.5
        return response_maps(crop, 1, 0, pooling), intrinsics


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
