"""Edges of a component close to those of a neighbour: the neighbour's do not show that it is there."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from arview.assembly.observation import ComponentObserver, Observation
from arview.cad import Model, ViewRange, make_model
from arview.evaluation.semisynthetic.solids import box
from arview.geometry import Array
from arview.guideviews import GuideViewOptions, GuideViewSet
from arview.guideviews.cache import cached_guide_views
from helpers.synthetic import CAMERA, changed, component, picture, pose_from, post, wrong

RANGE = ViewRange((420.0, 640.0), elevation_deg=(35.0, 60.0), azimuth_deg=(-40.0, 40.0), roll_deg=(-10.0, 10.0))
SHIM, POST = 2, 3


@cache
def ribbed() -> Model:
    """A plate with a rib, a shim 0.6 mm beside it, which is 0.8 px in the pictures here, and a post."""
    grey = (0.6, 0.6, 0.62)
    return make_model(
        "ribbed",
        (
            component("plate", box((0, 0, 0), (150, 100, 10)), grey),
            component("rib", box((60, 20, 10), (62, 80, 15)), grey),
            component("shim", box((62.6, 20.3, 10), (63.5, 80, 14)), grey),
            component("post", post((120, 50), 10, 10, 40), grey),
        ),
    )


@cache
def views() -> GuideViewSet:
    return cached_guide_views(ribbed(), RANGE, GuideViewOptions(renderer="zbuffer"))


def observed(model: Model, count: int = 6) -> list[Observation]:
    observer = ComponentObserver(views(), CAMERA, ribbed())
    found = []
    for k in range(count):
        pose: Array = pose_from(-35 + 70 * k / (count - 1), 42 + 3 * (k % 3), 520, ribbed())
        image = picture(pose, model, seed=k, scene=k % 9, noise=4.0)
        found.append(observer.observe(image, wrong(pose, np.random.default_rng(k), 0.3, 0.4, ribbed())))
    return found


@pytest.mark.slow
def test_edges_of_a_neighbour_do_not_show_that_a_component_is_there() -> None:
    log_odds = np.array([one.log_odds for one in observed(changed(ribbed(), shim=None))])
    assert np.all(log_odds[:, POST] < -1.0), "a component that stands apart is seen"
    assert np.all(log_odds[:, SHIM] > -0.3)


@pytest.mark.slow
def test_a_component_is_still_missed_where_no_edge_is_found_near_it_or_its_neighbour() -> None:
    found = observed(changed(ribbed(), shim=None, rib=None))
    log_odds = np.array([one.log_odds for one in found])
    is_visible = np.array([one.is_visible[SHIM] for one in found])
    assert np.count_nonzero(is_visible) >= 3
    assert log_odds[is_visible, SHIM].mean() > 1.0 and log_odds[is_visible, SHIM].min() > -0.5
