"""PartView: the guide views of a part as flat arrays about its centre, for the kernels of refinement and detection.

Design edges too close together to be resolved in a picture are marked here. The rims of small holes, thin ribs, pins
and knurls are many lines in the CAD but one grey patch in a picture of the whole part. Expected one by one they are
missed or confused with each other, and a test that expects them rejects right poses.
"""

from __future__ import annotations

from functools import cached_property
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.geometry import invert, rigid
from arview.guideviews import GuideViewSet
from arview.refinement.modalities.shading import corner_normals, curved_share
from arview.refinement.projection import ViewArrays
from arview.rendering import EDGE_CONTOUR, EDGE_ROUGH, EDGE_SHARP

MIN_SEPARATION = 0.035
"""Edges closer to each other than this, in diameters of the part, are unresolvable: 3.4 px where the diameter is 96 px,
as in the profiles of the ranker, and 2.5 px where it is 70 px, as in the crops of the verifier."""
SAME_LINE = 0.004
"""Points closer than this across an edge, in diameters, lie on the same line."""
MAX_ALONG = 0.015
"""Points farther away than this along an edge, in diameters, are not beside it."""
PARALLEL_COS = 0.7
"""Edges whose directions have a smaller cosine cross and are no neighbours."""
END_ON = 0.02
"""Edges whose projected tangent is shorter than this are seen end-on and left out."""
MIN_CURVED_SHARE = 0.2
"""Share of curved surface that shading needs, because any light can explain the brightness of flat faces."""
MIN_DESIGN_SHARE = 0.3
"""Share of design edges among the edges of outline and design below which a part is smooth."""
UNIT_16 = np.float32(1.0 / 32767.0)
"""Scale of the unit vectors that guide views store as 16-bit integers."""


class PartView:
    """A part in the form of the kernels.

    Args:
        views: guide views of the part.

    Attributes:
        arrays: the guide views, see `ViewArrays`.
        model_from_body, body_from_model: (4,4) translations between the frames of model and body.
        surface: reduced mesh of the part.
        is_smooth: whether the part has few design edges, so that its outline is mostly the limb of a curved surface.
        is_curved: whether enough of the surface is curved for the shading modality.
        corner_normals: (F,3,3) smooth normals of the surface.
    """

    def __init__(self, views: GuideViewSet) -> None:
        self.views = views
        self.model_from_body = rigid(np.eye(3), views.center_in_model)
        self.body_from_model = invert(self.model_from_body)
        raw = views.arrays
        center = views.center_in_model
        self.arrays = ViewArrays(
            directions=np.ascontiguousarray(views.directions),
            contour_starts=np.array(raw["contour_start"]),
            contour_points=(raw["contour_points"] - center).astype(np.float32),
            contour_normals=raw["contour_normals"] * UNIT_16,
            contour_runs_mm=np.array(raw["contour_runs_mm"]),
            edge_starts=np.array(raw["edge_start"]),
            edge_points=(raw["edge_points"] - center).astype(np.float32),
            edge_tangents=raw["edge_tangents"] * UNIT_16,
            edge_kinds=_without_rough(np.asarray(raw["edge_kinds"])),
        )
        drawn = self.arrays.edge_kinds & (EDGE_CONTOUR | EDGE_SHARP)
        self.is_smooth = np.count_nonzero(drawn & EDGE_SHARP) < MIN_DESIGN_SHARE * np.count_nonzero(drawn)
        self.surface = views.surface
        self.is_curved = curved_share(self.surface) >= MIN_CURVED_SHARE
        self.corner_normals = corner_normals(self.surface)

    @classmethod
    def of(cls, views: GuideViewSet) -> PartView:
        """The part of guide views, made once for all that use these views."""
        # A part keeps its views, so that no other ones get their id while it is here.
        part = _shared.get(id(views))
        if part is None:
            part = _shared[id(views)] = cls(views)
        return part

    @cached_property
    def resolvable(self) -> ViewArrays:
        """``arrays`` in which unresolvable design edges are not marked as design edges."""
        kinds = np.array(self.views.arrays["edge_kinds"])
        kinds[find_unresolvable(self.views)] &= np.uint8(255 - EDGE_SHARP)
        return self.arrays._replace(edge_kinds=kinds)


_shared: WeakValueDictionary[int, PartView] = WeakValueDictionary()


def _without_rough(kinds: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """EDGE_* bits (E,) in which creases of a rough surface are not marked as design edges."""
    return np.where(kinds & EDGE_ROUGH, kinds & np.uint8(255 - EDGE_SHARP), kinds).astype(np.uint8)


def find_unresolvable(views: GuideViewSet) -> NDArray[np.bool_]:
    """Which of the edge points (E,) of guide views lie on a design edge with another one close beside it in the view.

    Outline edges are never among them.
    """
    raw = views.arrays
    kinds = np.asarray(raw["edge_kinds"])
    is_design = ((kinds & EDGE_SHARP) > 0) & ((kinds & EDGE_CONTOUR) == 0)
    unresolvable = np.zeros(len(kinds), dtype=np.bool_)
    _mark_unresolvable(
        views.directions,
        raw["edge_start"],
        raw["edge_points"],
        raw["edge_tangents"] * UNIT_16,
        is_design,
        np.float32(views.diameter_mm),
        unresolvable,
    )
    return unresolvable


@kernel(fastmath=True)
def _mark_unresolvable(
    directions: NDArray[np.float64],
    starts: NDArray[np.int64],
    points: NDArray[np.float32],
    tangents: NDArray[np.float32],
    is_design: NDArray[np.bool_],
    diameter_mm: float | np.float32,
    unresolvable: NDArray[np.bool_],
) -> None:
    """Mark edge points, see `find_unresolvable`. Edges are compared in the image plane of each view."""
    nearest, furthest = np.float32(SAME_LINE) * diameter_mm, np.float32(MIN_SEPARATION) * diameter_mm
    along = np.float32(MAX_ALONG) * diameter_mm
    for view in range(starts.shape[0] - 1):
        first, last = starts[view], starts[view + 1]
        way = directions[view]
        helper = np.zeros(3, dtype=np.float32)
        helper[np.argmin(np.abs(way))] = 1.0
        right = np.cross(way, helper)
        right /= np.sqrt((right * right).sum())
        down = np.cross(way, right)
        flat = np.empty((4, last - first), dtype=np.float32)
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
            flat[0, count], flat[1, count] = x, y
            flat[2, count], flat[3, count] = tx / length, ty / length
            index[count] = k
            count += 1
        for i in range(count):
            px, py, tx, ty = flat[0, i], flat[1, i], flat[2, i], flat[3, i]
            neighbours = 0
            # Without branches, so that the compiler compares eight at once.
            for j in range(count):
                x, y = flat[0, j] - px, flat[1, j] - py
                beside = abs(x * ty - y * tx)
                is_beside = (beside >= nearest) & (beside <= furthest)
                is_along = abs(x * tx + y * ty) <= along
                is_parallel = abs(tx * flat[2, j] + ty * flat[3, j]) > np.float32(PARALLEL_COS)
                neighbours += int(is_beside & is_along & is_parallel)
            unresolvable[index[i]] = neighbours > 0
