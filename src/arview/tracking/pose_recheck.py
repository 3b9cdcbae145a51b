"""A second look at a tracked pose that is not where the motion had led to expect it.

Steps and colours along a profile cannot tell one of many parallel lines from the next, nor an edge of the part from
one beside it: a part that turns fast, or is hidden in part, is tracked into a pose that they bear out and that is
wrong. What the detector asks of whole views, it can tell. Its local search costs ten times as much as a tracked frame,
so it is made only where the pose is off the prediction, in a window around the part; its verifier says whether another
pose is right, against a prior around the prediction.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.detection.search.global_search import PoseCandidate
from arview.detection.search.local_search import (
    FINE_TOLERANCE_PX,
    Hypothesis,
    LocalSearch,
    LocalSearchOptions,
)
from arview.geometry import Array
from arview.tracking.motion import squared_motion_distance

OPTIONS = LocalSearchOptions(tried=6, finalists=3, rivals=0, verified=3)
"""Fewer hypotheses than in a search over the whole picture."""
KEPT = (6, 4)
"""So many after each level of the search."""
REACH, MARGIN_PX, WINDOW_PX = 1.25, 20.0, 64
"""The window reaches so many half diameters, and so many pixels, around the part; its sides are multiples of this."""
PRIOR = 16.0
"""Log odds that a squared motion distance of 1 costs: a prior with a deviation of 8°, or 6 % of the diameter aside."""
LEAST_LEAD = 1.0
"""By so much another pose must be likelier than the tracked one."""


class LocalSearchRecheck:
    """Looks again where a tracked pose surprises.

    Args:
        local: the detector's local search of the same part and camera; left as it is.
    """

    def __init__(self, local: LocalSearch) -> None:
        self._camera = local.camera
        self._local = local.with_options(OPTIONS)

    def better(self, image: NDArray[np.uint8], cam_from_body: Array, predicted: Sequence[Array]) -> Array | None:
        """A pose that is likelier than the tracked one; None where there is none.

        Args:
            image: (H,W,3) uint8 RGB.
            cam_from_body: (4,4) tracked.
            predicted: poses (4,4) to start from, too; the prior is around the first.
        """
        poses = [cam_from_body, *predicted]
        window = self._window(poses)
        if window is None:
            return None
        left, top, camera = window
        local = self._local.with_camera(camera)
        picture = local.pyramid(np.ascontiguousarray(image[top : top + camera.height, left : left + camera.width]))
        found = local.refine_starts_through(picture, [(cam_from_body, ())], FINE_TOLERANCE_PX)
        starts = local.pattern_search(picture, [PoseCandidate(1.0, pose) for pose in poses], KEPT)
        found = local.verify(picture, [*found, *local.refine_starts(picture, starts)])
        scores = [self._score(h, predicted[0]) for h in found]
        scores[0] += LEAST_LEAD
        best = int(np.argmax(scores))
        return found[best].cam_from_body if best > 0 else None

    def _score(self, hypothesis: Hypothesis, predicted: Array) -> float:
        return hypothesis.logit - PRIOR * squared_motion_distance(
            hypothesis.cam_from_body, predicted, self._local.views.diameter_mm
        )

    def _window(self, poses: Sequence[Array]) -> tuple[int, int, Camera] | None:
        """Left and upper end of the window around a part at poses (4,4), and its camera; None beside the picture."""
        if any(pose[2, 3] <= 0 for pose in poses):
            return None
        camera = self._camera
        centers = np.array([camera.project(pose[:3, 3]) for pose in poses])
        reach = REACH * max(self._local.refiner.radius_px(pose) for pose in poses) + MARGIN_PX
        if not np.all(np.isfinite(centers)):
            return None
        size = np.array([camera.width, camera.height])
        sides = np.ceil((np.ptp(centers, axis=0) + 2.0 * reach) / WINDOW_PX) * WINDOW_PX
        sides = np.minimum(sides, size).astype(int)
        middle = 0.5 * (centers.min(axis=0) + centers.max(axis=0))
        if np.any(middle < 0) or np.any(middle >= size):
            return None
        left, top = np.clip(np.round(middle - 0.5 * sides), 0, size - sides).astype(int).tolist()
        return left, top, camera.cropped(left, top, int(sides[0]), int(sides[1]))
