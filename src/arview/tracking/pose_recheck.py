"""Recheck of a tracked pose that is far from the predicted one, by the local search of the detector.

Edges and colours along profiles cannot distinguish parallel lines, nor an edge of the part from one beside it. A part
that turns fast or is partly hidden may therefore be tracked into a wrong pose that both support. The networks of the
detector compare whole views and can tell. Their local search takes ten times as long as a tracked frame, so it is run
only for poses far from the prediction, in a window around the part, with a prior around the predicted pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.detection.search.global_search import PoseCandidate
from arview.detection.search.hypothesis import Hypothesis
from arview.detection.search.local_search import LocalSearch, LocalSearchOptions
from arview.geometry import Array
from arview.tracking.motion import squared_motion_distance

WINDOW_STEP_PX = 64
"""The sides of the window are multiples of this, so that networks see few different sizes."""


@dataclass(frozen=True)
class RecheckOptions:
    """Options of the recheck.

    Attributes:
        search: options of the local search, with fewer hypotheses than for a whole picture.
        kept: hypotheses kept after each level of the search.
        reach: half size of the window, in half diameters of the part.
        margin_px: pixels added to it.
        motion_penalty: log odds that a squared motion distance of 1 costs: a Gaussian prior with a standard deviation
            of 8°, or 6 % of the diameter sideways.
        min_gain: log odds by which another pose must be likelier than the tracked one.
    """

    search: LocalSearchOptions = field(
        default_factory=lambda: LocalSearchOptions(max_coarse=6, max_fine=3, max_competitors=0, max_verified=3)
    )
    kept: tuple[int, ...] = (6, 4)
    reach: float = 1.25
    margin_px: float = 20.0
    motion_penalty: float = 16.0
    min_gain: float = 1.0


class LocalSearchRecheck:
    """Recheck by the local search of the detector, a `PoseRecheck` of the tracker.

    Args:
        local: local search of the same part and camera, which is not changed.
        options: see `RecheckOptions`.
    """

    def __init__(self, local: LocalSearch, options: RecheckOptions | None = None) -> None:
        self.options = options or RecheckOptions()
        self._camera = local.camera
        self._local = local.with_options(self.options.search)

    def better(self, image: NDArray[np.uint8], cam_from_body: Array, predicted: Sequence[Array]) -> Array | None:
        """A pose (4,4) that is likelier than the tracked one; None if there is none.

        Args:
            image: (H,W,3) uint8 RGB.
            cam_from_body: (4,4) tracked pose.
            predicted: predicted poses (4,4), from which the search starts, too. The prior is around the first.
        """
        poses = [cam_from_body, *predicted]
        window = self._window(poses)
        if window is None:
            return None
        left, top, camera = window
        local = self._local.with_camera(camera)
        picture = local.pyramid(np.ascontiguousarray(image[top : top + camera.height, left : left + camera.width]))
        found = local.evaluate(picture, [cam_from_body])
        starts = local.pattern_search(picture, [PoseCandidate(1.0, pose) for pose in poses], self.options.kept)
        found = local.verify(picture, [*found, *local.refine_starts(picture, starts)])
        scores = [self._score(h, predicted[0]) for h in found]
        scores[0] += self.options.min_gain
        best = int(np.argmax(scores))
        return found[best].cam_from_body if best > 0 else None

    def _score(self, hypothesis: Hypothesis, predicted: Array) -> float:
        """Log odds of a hypothesis, with the prior around the predicted pose (4,4)."""
        return hypothesis.logit - self.options.motion_penalty * squared_motion_distance(
            hypothesis.cam_from_body, predicted, self._local.views.diameter_mm
        )

    def _window(self, poses: Sequence[Array]) -> tuple[int, int, Camera] | None:
        """Left and upper border of a window around the part at some poses (4,4), and its camera.

        None where the part is outside the picture or behind the camera.
        """
        if any(pose[2, 3] <= 0 for pose in poses):
            return None
        camera = self._camera
        centers = np.array([camera.project(pose[:3, 3]) for pose in poses])
        o = self.options
        reach = o.reach * max(self._local.refiner.radius_px(pose) for pose in poses) + o.margin_px
        if not np.all(np.isfinite(centers)):
            return None
        size = np.array([camera.width, camera.height])
        sides = np.ceil((np.ptp(centers, axis=0) + 2.0 * reach) / WINDOW_STEP_PX) * WINDOW_STEP_PX
        sides = np.minimum(sides, size).astype(int)
        middle = 0.5 * (centers.min(axis=0) + centers.max(axis=0))
        if np.any(middle < 0) or np.any(middle >= size):
            return None
        left, top = np.clip(np.round(middle - 0.5 * sides), 0, size - sides).astype(int).tolist()
        return left, top, camera.cropped(left, top, int(sides[0]), int(sides[1]))
