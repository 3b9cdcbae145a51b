"""The part as the kernels of refinement and detection see it: its guide views as flat arrays about its centre.

Design edges that lie so close together that a picture does not resolve them are marked as unresolvable here. The rims
of small holes, thin ribs, pins and knurls are many lines in the CAD and one grey patch in a picture of the whole part:
looked for one by one, they are missed or taken for each other, and a test that expects them rejects right poses.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.geometry import invert, rigid
from arview.guideviews import GuideViewSet
from arview.guideviews.mesh_edges import EDGE_CONTOUR, EDGE_SHARP
from arview.refinement.modalities.shading import LEAST_CURVED, corner_normals, curved_share

APART = 0.035
"""In diameters: edges nearer to each other are crowded. Profiles across lines reach 6 px to both sides in pictures in
which the diameter is 96 px, those of the verifier show it at 70 px: it is 3.4 and 2.5 px there."""
SAME_LINE = 0.004
"""Nearer than this are points of one and the same line."""
ALONG = 0.015
"""And what lies further along the edge is not beside it."""
PARALLEL_COS = 0.7
"""Edges that cross are no neighbours."""
END_ON = 0.02
"""Of edges seen so nearly end-on nothing is said."""


class PartView:
    """A guide-view set as the kernels need it: flat float32 arrays about the model's centre.

    ``arrays`` holds directions (N,3), contour starts (N+1), points, normals, runs, edge starts (N+1), points,
    tangents, kinds; ``surface`` is its mesh, of which enough may be curved for `shading`.
    """

    def __init__(self, views: GuideViewSet) -> None:
        self.views = views
        self.model_from_body = rigid(np.eye(3), views.center_in_model)
        self.body_from_model = invert(self.model_from_body)
        raw = views.arrays
        unit16 = np.float32(1.0 / 32767.0)
        center = views.center_in_model
        self.arrays = (
            np.ascontiguousarray(views.directions),
            np.array(raw["contour_start"]),
            (raw["contour_points"] - center).astype(np.float32),
            raw["contour_normals"] * unit16,
            np.array(raw["contour_runs_mm"]),
            np.array(raw["edge_start"]),
            (raw["edge_points"] - center).astype(np.float32),
            raw["edge_tangents"] * unit16,
            np.array(raw["edge_kinds"]),
        )
        self.surface = views.surface
        self.is_curved = curved_share(self.surface) >= LEAST_CURVED
        self.corner_normals = corner_normals(self.surface)

    @cached_property
    def distinct(self) -> tuple[NDArray[Any], ...]:
        """``arrays`` without the design edges that are crowded, see `is_crowded`; worked out when first asked for."""
        kinds = self.arrays[-1].copy()
        kinds[is_crowded(self.views)] &= np.uint8(255 - EDGE_SHARP)
        return (*self.arrays[:-1], kinds)


def is_crowded(views: GuideViewSet) -> NDArray[np.bool_]:
    """Which of the edge points (E,) of guide views are design edges with another close beside them in the view."""
    raw = views.arrays
    kinds = np.asarray(raw["edge_kinds"])
    is_design = ((kinds & EDGE_SHARP) > 0) & ((kinds & EDGE_CONTOUR) == 0)
    crowded = np.zeros(len(kinds), dtype=np.bool_)
    _mark_crowded(
        views.directions, raw["edge_start"], raw["edge_points"], raw["edge_tangents"] * np.float32(1.0 / 32767.0),
        is_design, np.float32(views.diameter_mm), crowded,
    )  # fmt: skip
    return crowded


@kernel(fastmath=True)
def _mark_crowded(directions, starts, points, tangents, is_design, diameter_mm, crowded):  # type: ignore[no-untyped-def]
    """Mark edge points, see `is_crowded`; what is in line with the view's direction is left as it is."""
    nearest, furthest = np.float32(SAME_LINE) * diameter_mm, np.float32(APART) * diameter_mm
    along = np.float32(ALONG) * diameter_mm
    for view in range(starts.shape[0] - 1):
        first, last = starts[view], starts[view + 1]
        way = directions[view]
        helper = np.zeros(3, dtype=np.float32)
        helper[np.argmin(np.abs(way))] = 1.0
        right = np.cross(way, helper)
        right /= np.sqrt((right * right).sum())
        down = np.cross(way, right)
        flat = np.empty((last - first, 4), dtype=np.float32)
        count = 0
        index = np.empty(last - first, dtype=np.int64)
        for k in range(first, last):
            if not is_design[k]:
                continue
            x, y, tx, ty = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for c in range(3):
                x += points[k, c] * right[c]
                y += points[k, c] * down[c]
                tx += tangents[k, c] * right[c]
                ty += tangents[k, c] * down[c]
            length = np.sqrt(tx * tx + ty * ty)
            if length < np.float32(END_ON):
                continue
            flat[count, 0], flat[count, 1] = x, y
            flat[count, 2], flat[count, 3] = tx / length, ty / length
            index[count] = k
            count += 1
        for i in range(count):
            for j in range(count):
                x, y = flat[j, 0] - flat[i, 0], flat[j, 1] - flat[i, 1]
                beside = abs(x * flat[i, 3] - y * flat[i, 2])
                if beside < nearest or beside > furthest:
                    continue
                if abs(x * flat[i, 2] + y * flat[i, 3]) > along:
                    continue
                if abs(flat[i, 2] * flat[j, 2] + flat[i, 3] * flat[j, 3]) > np.float32(PARALLEL_COS):
                    crowded[index[i]] = True
                    break
