"""The guide views of a part without the lines of components that are absent.

The outline and the edges of absent components are not in the picture; a tracker that expects them loses its evidence,
and in the end the part. Their points are therefore replaced by points of the other components in the same view, so
that the arrays keep their sizes. Only views near the present direction are changed, when they are first needed. Lines
that absent components would hide are not among them; where all but the base are absent, its own guide views have them.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from arview.cad import Model, sample_surface
from arview.geometry import Array, invert
from arview.refinement import PartView

SPACING_SHARE = 0.01
"""Distance of samples of an absent component's surface, in diameters of the part."""
NEAR_SHARE = 0.008
"""Points nearer to such a sample, in diameters of the part, are the component's."""
MAX_SAMPLES = 4000
"""Largest number of samples of a component."""
MIN_LEFT = 0.15
"""Share of a view's points that must be left; of other views none is replaced."""
REACH_DEG = 9.0
"""Angle between the present direction and those of views that are changed."""


class PresentLines:
    """Keeps the lines of a part up to date with what is known to be absent.

    Args:
        model: of the part.
        part: its guide views; they are not changed.
        base: index of the component that carries the others.
    """

    def __init__(self, model: Model, part: PartView, base: int) -> None:
        self._model, self._whole = model, part
        self._reduced: PartView | None = None
        self._is_absent = np.zeros(len(model.components), dtype=bool)
        self._is_base = np.arange(len(model.components)) == base
        self._tree: cKDTree | None = None
        self._changed: set[int] = set()

    def update(
        self,
        is_missing: NDArray[np.bool_],
        is_present: NDArray[np.bool_],
        cam_from_model: Array,
        base_part: PartView | None = None,
    ) -> PartView:
        """The guide views to be used at a pose.

        A component that was missing stays left out until it is seen, whatever becomes of the track in between.

        Args:
            is_missing, is_present: (C,) components that are known not to be there, and to be there.
            cam_from_model: (4,4) mm.
            base_part: guide views of the base in the frame of the part's; None: there are none.
        """
        is_absent = (self._is_absent | is_missing) & ~is_present
        if not np.array_equal(is_absent, self._is_absent):
            self._is_absent = is_absent
            self._restore()
        if self._tree is None:
            return self._whole
        if base_part is not None and np.array_equal(is_absent, ~self._is_base):
            return base_part
        if self._reduced is None:
            self._reduced = copy.copy(self._whole)
            copies = {name: array.copy() for name, array in self._whole.arrays._asdict().items()}
            self._reduced.arrays = self._whole.arrays._replace(**copies)
        center = self._whole.model_from_body[:3, 3]
        direction = invert(cam_from_model)[:3, 3] - center
        cosines = self._whole.arrays.directions @ (direction / np.linalg.norm(direction))
        near = np.flatnonzero(cosines > np.cos(np.deg2rad(REACH_DEG))).tolist()
        self._change([view for view in near if view not in self._changed])
        return self._reduced

    def _restore(self) -> None:
        """Take all points back, and sample the surfaces of the components that are now absent."""
        if self._reduced is not None:
            whole, reduced = self._whole.arrays, self._reduced.arrays
            for view in self._changed:
                for starts, names in _LINES:
                    first, last = getattr(whole, starts)[view : view + 2]
                    for name in names:
                        getattr(reduced, name)[first:last] = getattr(whole, name)[first:last]
        self._changed.clear()
        self._tree = None
        if self._is_absent.any():
            model = self._model
            spacing_mm = SPACING_SHARE * model.diameter_mm
            samples = [
                sample_surface(model.components[c], spacing_mm, MAX_SAMPLES).points
                for c in np.flatnonzero(self._is_absent)
            ]
            self._tree = cKDTree(np.concatenate(samples) - self._whole.model_from_body[:3, 3])

    def _change(self, views: Sequence[int]) -> None:
        """Replace the points of absent components in some views."""
        assert self._tree is not None and self._reduced is not None
        whole, reduced = self._whole.arrays, self._reduced.arrays
        near_mm = NEAR_SHARE * self._model.diameter_mm
        for view in views:
            self._changed.add(view)
            for starts, names in _LINES:
                first, last = (int(place) for place in getattr(whole, starts)[view : view + 2])
                points = getattr(whole, names[0])[first:last]
                if last == first:
                    continue
                distance = self._tree.query(points, distance_upper_bound=near_mm)[0]
                left = np.flatnonzero(np.isinf(distance))
                if len(left) == len(points) or len(left) < MIN_LEFT * len(points):
                    continue
                chosen = first + left[np.arange(len(points)) * len(left) // len(points)]
                for name in names:
                    getattr(reduced, name)[first:last] = getattr(whole, name)[chosen]


_LINES = (
    ("contour_starts", ("contour_points", "contour_normals", "contour_runs_mm")),
    ("edge_starts", ("edge_points", "edge_tangents", "edge_kinds")),
)
"""Arrays of a `ViewArrays` by point, the points first, and where those of each view start."""
