"""Guide views of parts from 0.3 mm to 30 m are those of the same part at another scale."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from arview.cad.model import make_model
from arview.cad.view_range import ViewRange
from arview.guideviews import GuideViewOptions, GuideViewSet, make_guide_views
from helpers.synthetic import assembly

RANGE = ViewRange((430.0, 620.0), elevation_deg=(40.0, 45.0), azimuth_deg=(38.0, 42.0), roll_deg=(-10.0, 10.0))


def views_at(diameter_mm: float) -> GuideViewSet:
    factor = diameter_mm / assembly().diameter_mm
    parts = [replace(one, vertices_in_model=one.vertices_in_model * factor) for one in assembly().components]
    near, far = RANGE.distance_mm
    near_and_far = replace(RANGE, distance_mm=(near * factor, far * factor))
    return make_guide_views(make_model("scaled", tuple(parts)), near_and_far, GuideViewOptions(renderer="zbuffer"))


@pytest.mark.slow
@pytest.mark.parametrize("diameter_mm", [0.3, 30_000.0])
def test_guide_views_do_not_depend_on_the_size_of_the_part(diameter_mm: float) -> None:
    usual, other = views_at(210.0), views_at(diameter_mm)
    assert len(other) == len(usual) > 10
    scale = diameter_mm / 210.0
    for index in (0, len(usual) - 1):
        a, b = usual.view(index).features, other.view(index).features
        assert len(b.contour_points) == len(a.contour_points) > 100
        assert len(b.edge_points) == len(a.edge_points) > 100
        # Which samples of an edge are taken may differ by rounding; where the edges are does not.
        gaps = np.linalg.norm(b.edge_points[:, None] / scale - a.edge_points[None], axis=-1).min(axis=1)
        assert np.median(gaps) < 0.5
        assert np.mean(gaps < 3.0) > 0.95
