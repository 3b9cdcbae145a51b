"""Resolvable design edges: those of large holes and wide ribs are, those of small holes and thin ribs are not."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from arview.cad import Component, Model, ViewRange, make_model
from arview.geometry import Array
from arview.guideviews import GuideViewOptions, GuideViewSet, make_guide_views
from arview.refinement.view_model import MIN_SEPARATION, PartView, find_unresolvable
from arview.rendering.mesh_edges import EDGE_CONTOUR, EDGE_SHARP
from arview_lab.semisynthetic.solids import Mesh, box, circle, prism, rectangle

SMALL, LARGE = ((-35.0, -15.0), (-35.0, 15.0), (-25.0, 0.0)), (20.0, 0.0)
SMALL_MM, LARGE_MM = 1.5, 14.0
"""Radii of holes so shallow that no lower rim is seen beside its upper one; the diameter of the plate is 126 mm."""


@cache
def perforated() -> GuideViewSet:
    holes = (*(circle(center, SMALL_MM, 16) for center in SMALL), circle(LARGE, LARGE_MM))
    low, high = (-55.0, -30.0), (55.0, 30.0)
    return views_of(box((*low, -8.0), (*high, 0.0)), prism(rectangle(low, high), holes, 0.0, 1.0))


def views_of(*meshes: Mesh) -> GuideViewSet:
    return make_guide_views(
        model_of(*meshes), ViewRange((300.0, 600.0), (20.0, 90.0)), GuideViewOptions(subdivisions=3)
    )


def model_of(*meshes: Mesh) -> Model:
    return make_model(
        "plate",
        tuple(Component(f"body_{k}", v, f.astype(np.int32), (0.5, 0.5, 0.5)) for k, (v, f) in enumerate(meshes)),
    )


def design_points(views: GuideViewSet) -> tuple[Array, NDArray[np.bool_]]:
    """Design edge points (N,3) of the views from straight above, and which of them are unresolvable."""
    raw = views.arrays
    kinds = np.asarray(raw["edge_kinds"])
    of_view = np.repeat(np.arange(len(views.directions)), np.diff(raw["edge_start"]))
    is_design = ((kinds & EDGE_SHARP) > 0) & ((kinds & EDGE_CONTOUR) == 0)
    chosen = is_design & (views.directions[of_view, 2] > 0.95)
    return np.asarray(raw["edge_points"], dtype=np.float64)[chosen], find_unresolvable(views)[chosen]


@pytest.mark.slow
def test_rims_of_small_holes_are_unresolvable_and_those_of_large_ones_are_not() -> None:
    points, unresolvable = design_points(perforated())
    on_small = np.any([np.linalg.norm(points[:, :2] - center, axis=1) < 1.2 * SMALL_MM for center in SMALL], axis=0)
    on_large = (np.linalg.norm(points[:, :2] - LARGE, axis=1) < 1.1 * LARGE_MM) & (points[:, 2] > 0.9)
    assert on_small.sum() > 40 and on_large.sum() > 40
    assert unresolvable[on_small].mean() > 0.7  # few points are on each
    assert unresolvable[on_large].mean() < 0.25


@pytest.mark.slow
@pytest.mark.parametrize(("apart", "expected"), [(0.5 * MIN_SEPARATION, True), (3.0 * MIN_SEPARATION, False)])
def test_edges_of_a_thin_rib_are_unresolvable(apart: float, expected: bool) -> None:
    half_mm = 0.5 * apart * 126.0
    # So low that its foot is not seen beside it.
    views = views_of(box((-55.0, -30.0, 0.0), (55.0, 30.0, 8.0)), box((-40.0, -half_mm, 8.0), (40.0, half_mm, 9.0)))
    points, unresolvable = design_points(views)
    along = (np.abs(points[:, 2] - 9.0) < 0.1) & (np.abs(points[:, 0]) < 38.0)
    assert along.sum() > 50
    assert (unresolvable[along].mean() > 0.95) if expected else (unresolvable[along].mean() < 0.3)


@pytest.mark.slow
def test_a_part_has_all_its_edges_and_the_resolvable_ones() -> None:
    views = perforated()
    part = PartView(views)
    all_kinds, resolvable_kinds, unresolvable = part.arrays[-1], part.resolvable[-1], find_unresolvable(views)
    assert np.array_equal(all_kinds, views.arrays["edge_kinds"])
    assert unresolvable.any()
    assert np.array_equal(all_kinds != resolvable_kinds, unresolvable)
    assert not np.any(resolvable_kinds[unresolvable] & EDGE_SHARP)
    assert np.array_equal(all_kinds & EDGE_CONTOUR, resolvable_kinds & EDGE_CONTOUR)
