"""Recheck of a tracked pose whose motion is unusual, by the local search of the detector.

Edges and colours along profiles cannot distinguish parallel lines, nor an edge of the part from one beside it. A part
that turns fast or is partly hidden may therefore be tracked into a wrong pose that both support. The networks of the
detector compare whole views and can tell. Their local search takes ten times as long as a tracked frame, so it is run
only for poses whose motion is unusual in the stream, see `motion`, in a window around the part that is reduced to the
size the networks need, with a prior around the predicted pose. It ends early when it leads back to the tracked pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.detection import (
    DISTINCT_DEG,
    FINE_SCHEDULES,
    FINE_TOLERANCE_PX,
    Hypothesis,
    ImagePyramid,
    LocalSearch,
    LocalSearchOptions,
    PoseCandidate,
)
from arview.geometry import Array, are_near
from arview.refinement import SEARCH_STAGES, Stage, smoothed
from arview.tracking.motion import squared_motion_distance

WINDOW_STEP_PX = 32
"""The sides of the window are multiples of this, so that networks see few different sizes."""


SEARCH = LocalSearchOptions(levels=LocalSearchOptions().levels[:1], max_verified=3, use_shading=False)
"""Options of the local search, with one level of the pattern search and fewer hypotheses than for a whole picture."""
KEPT: tuple[int, ...] = (4,)
"""Hypotheses kept after each level of the search."""
RADIUS_PX = 90.0
"""Half diameter of the part to which the window is reduced."""
REACH = 1.25
"""Half size of the window, in half diameters of the part."""
MARGIN_PX = 12.0
"""Pixels added to the window, after the reduction."""
MIN_IN_PICTURE = 0.4
"""Share of the outline inside the window below which hypotheses are dropped."""
SAME_DEG = 2.0
"""Hypotheses closer to the tracked pose are the tracked pose; hundredths of it are diameters."""
MOTION_PENALTY = 16.0
"""Log odds that a squared motion distance of 1 costs: a Gaussian prior with a standard deviation of 8°, or 6 % of the
diameter sideways."""
MIN_GAIN = 1.0
"""Log odds by which another pose must be likelier than the tracked one."""
FINAL_STAGES: tuple[Stage, ...] = SEARCH_STAGES[-2:]
"""Schedule at full resolution of a pose found in a reduced window."""


class _Window(NamedTuple):
    """The picture around a part.

    Attributes:
        image: (H,W,3) uint8 RGB at full resolution.
        camera: of the image.
        reduced, reduced_camera: the same at the size of the search.
    """

    image: NDArray[np.uint8]
    camera: Camera
    reduced: NDArray[np.uint8]
    reduced_camera: Camera


class LocalSearchRecheck:
    """Recheck by the local search of the detector, a `PoseRecheck` of the tracker.

    Args:
        local: local search of the same part and camera, which is not changed.
    """

    def __init__(self, local: LocalSearch) -> None:
        self._camera = local.camera
        self._local = local.with_options(SEARCH)

    def better(self, image: NDArray[np.uint8], cam_from_body: Array, predicted: Sequence[Array]) -> Array | None:
        """A pose (4,4) that is likelier than the tracked one; None if there is none.

        Args:
            image: (H,W,3) uint8 RGB.
            cam_from_body: (4,4) tracked pose.
            predicted: predicted poses (4,4), from which the search starts, too. The prior is around the first.
        """
        poses = [cam_from_body, *predicted]
        window = self._window(image, poses)
        if window is None:
            return None
        local = self._local.with_camera(window.reduced_camera)
        picture = local.pyramid(window.reduced)
        found = self._hypotheses(local, picture, poses)
        if len(found) == 1:
            return None
        scores = [self._score(h, predicted[0]) for h in local.verify(picture, found)]
        scores[0] += MIN_GAIN
        best = int(np.argmax(scores))
        return self._refined(window, found[best].cam_from_body) if best > 0 else None

    def _hypotheses(self, local: LocalSearch, picture: ImagePyramid, poses: Sequence[Array]) -> list[Hypothesis]:
        """The tracked pose, which is the first of some poses (4,4), and what a search from all of them leads to."""
        tracked = poses[0]
        starts = local.pattern_search(picture, [PoseCandidate(1.0, pose) for pose in poses], KEPT)
        scheduled = [(start.cam_from_body, stages) for start in starts for stages in FINE_SCHEDULES]
        first, *others = local.refine_through(picture, [(tracked, ()), *scheduled], FINE_TOLERANCE_PX)
        shown = [h for h in others if h.evidence.points_in_picture >= MIN_IN_PICTURE]
        apart = local.deduplicate(shown, DISTINCT_DEG, SEARCH.max_verified)
        same_mm = 0.01 * SAME_DEG * self._local.views.diameter_mm
        return [first, *(h for h in apart if not are_near(h.cam_from_body, tracked, same_mm, SAME_DEG))]

    def _score(self, hypothesis: Hypothesis, predicted: Array) -> float:
        """Log odds of a hypothesis, with the prior around the predicted pose (4,4)."""
        return hypothesis.logit - MOTION_PENALTY * squared_motion_distance(
            hypothesis.cam_from_body, predicted, self._local.views.diameter_mm
        )

    def _refined(self, window: _Window, cam_from_body: Array) -> Array:
        """A pose (4,4) after refinement at full resolution."""
        if window.reduced is window.image:
            return cam_from_body
        gray = smoothed(cv2.cvtColor(window.image, cv2.COLOR_RGB2GRAY))
        refiner = self._local.refiner.with_camera(window.camera)
        return refiner.refine_fresh(window.image, gray, cam_from_body, FINAL_STAGES)

    def _window(self, image: NDArray[np.uint8], poses: Sequence[Array]) -> _Window | None:
        """The window of a picture (H,W,3) around the part at some poses (4,4).

        None where the part is outside the picture or behind the camera.
        """
        if any(pose[2, 3] <= 0 for pose in poses):
            return None
        camera = self._camera
        centers = np.array([camera.project(pose[:3, 3]) for pose in poses])
        if not np.all(np.isfinite(centers)):
            return None
        radius_px = max(self._local.refiner.radius_px(pose) for pose in poses)
        scale = min(1.0, RADIUS_PX / radius_px)
        size = np.array([camera.width, camera.height])
        middle = 0.5 * (centers.min(axis=0) + centers.max(axis=0))
        if np.any(middle < 0) or np.any(middle >= size):
            return None
        wanted = scale * (np.ptp(centers, axis=0) + 2.0 * REACH * radius_px) + 2.0 * MARGIN_PX
        steps = np.ceil(wanted / WINDOW_STEP_PX) * WINDOW_STEP_PX
        sides = np.minimum(np.round(steps / scale), size).astype(int)
        reduced = np.where(sides < size, steps, np.round(scale * sides)).astype(int)
        left, top = np.clip(np.round(middle - 0.5 * sides), 0, size - sides).astype(int).tolist()
        width, height = sides.tolist()
        cropped = camera.cropped(left, top, width, height)
        part = np.ascontiguousarray(image[top : top + height, left : left + width])
        if scale == 1.0:
            return _Window(part, cropped, part, cropped)
        small = np.asarray(cv2.resize(part, (int(reduced[0]), int(reduced[1])), interpolation=cv2.INTER_AREA))
        return _Window(part, cropped, small, cropped.scaled(int(reduced[0]), int(reduced[1])))
