"""Wide search around a predicted pose, for a part that moved farther than the schedules of the tracker reach.

After Tian et al., "Large-displacement 3D Object Tracking with Hybrid Non-local Optimization" (ECCV 2022): rotations are
sampled widely, the other parameters are found for each, and the best poses are refined locally. Here rotations,
distances and shifts are scored by oriented edges of the picture and of the learned colours in a small crop. The best
are refined by a pattern search there, and again at twice the resolution.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.detection import NearSearch, PoseGrid
from arview.geometry import Array, turn_ball
from arview.refinement import ColorModel, ViewArrays

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


GRID = PoseGrid(
    turns=turn_ball(TURN_REACH_DEG, TURN_STEP_DEG),
    stretches=np.array(STRETCHES),
    shift_px=round(SHIFT * RADII_PX[0]),
    shift_step_px=SHIFT_STEP_PX,
)
"""Poses tried in the first round."""


class WideSearch:
    """Search for one part with one camera.

    Args:
        part: guide views of the part.
        camera: camera of the frames.
        diameter_mm: diameter of the part.
    """

    def __init__(self, part: ViewArrays, camera: Camera, diameter_mm: float) -> None:
        self._search = NearSearch(part, camera, diameter_mm, contour_points=POINTS, design_points=POINTS)

    def find(self, image: NDArray[np.uint8], colors: ColorModel, start: Array) -> list[Array]:
        """The best poses (4,4) ``cam_from_body`` around a start, best first; none where it is outside the picture.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            colors: colours of part and background.
            start: (4,4) ``cam_from_body``.
        """
        poses = start[None]
        for number, (radius_px, margin) in enumerate(zip(RADII_PX, CROP_MARGIN, strict=True)):
            own_px = self._search.radius_px(poses[0])
            scale = radius_px / own_px
            # Edges are detected at twice the resolution where the picture has it.
            pooling = 2 if scale <= 0.5 else 1
            reach_px = (margin + (SHIFT if number == 0 else 0.0)) * own_px
            crop = self._search.crop(image, poses[0], reach_px, scale, spread_px=1, pooling=pooling, colors=colors)
            if crop is None:
                return []
            if number == 0:
                poses = self._search.select(*crop.grid(start, GRID), SEPARATION_DEG[0], REFINED[0])[1]
            found = crop.improved(poses, SEARCH_STEPS_DEG[number], SEARCH_STRETCHES[number])
            poses = self._search.select(*found, SEPARATION_DEG[number + 1], (REFINED[1], KEPT)[number])[1]
        return list(poses)
