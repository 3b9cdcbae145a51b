"""Edges of a component close to those of a neighbour: the neighbour's do not show that it is there."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from arview.assembly.observation import ComponentObserver, Observation, nothing_known
from arview.assembly.visible_edges import VisibleEdgeCache
from arview.cad import Model, ViewRange, make_model
from arview.geometry import Array
from arview.guideviews import GuideViewOptions, GuideViewSet
from arview.guideviews.cache import cached_guide_views
from arview_lab.semisynthetic.solids import box
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
def finned() -> Model:
    """A plate with three fins, 1 mm between them, and a post."""
    grey = (0.6, 0.6, 0.62)
    fins = [box((60 + 3.5 * k, 20, 10), (62.5 + 3.5 * k, 80, 18)) for k in range(3)]
    return make_model(
        "finned",
        (
            component("plate", box((0, 0, 0), (150, 100, 10)), grey),
            *(component(f"fin_{k}", fin, (0.35, 0.4, 0.6)) for k, fin in enumerate(fins)),
            component("post", post((120, 50), 10, 10, 40), grey),
        ),
    )


def views_of(model: Model) -> GuideViewSet:
    return cached_guide_views(model, RANGE, GuideViewOptions(renderer="zbuffer"))


def observed(model: Model, count: int = 4, of: Model | None = None, absent: tuple[str, ...] = ()) -> list[Observation]:
    """Observations of a model that should be another, of which some components are known to be absent."""
    whole = of or ribbed()
    observer = ComponentObserver(views_of(whole), CAMERA, whole)
    known = nothing_known(len(whole.components))._replace(is_absent=np.isin([c.name for c in whole.components], absent))
    found = []
    for k in range(count):
        pose: Array = pose_from(-35 + 70 * k / (count - 1), 42 + 3 * (k % 3), 520, whole)
        image = picture(pose, model, seed=k, scene=k % 9, noise=4.0)
        found.append(observer.observe(image, wrong(pose, np.random.default_rng(k), 0.3, 0.4, whole), known))
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


@pytest.mark.slow
def test_a_component_beside_one_that_is_known_to_be_absent_is_seen() -> None:
    absent, middle = ("fin_0", "fin_2"), 2
    alone = changed(finned(), fin_0=None, fin_2=None)
    unknown = np.array([one.log_odds[middle] for one in observed(alone, of=finned())])
    known = np.array([one.log_odds for one in observed(alone, of=finned(), absent=absent)])
    assert unknown.min() > -0.5, "the edges may be those of the fins beside it"
    assert known[:, middle].max() < -2.0
    assert known[:, (1, 3)].mean() > -0.5, "the edges of the middle one do not bring the others back"
    # It is missed where it is not there either.
    none = observed(changed(alone, fin_1=None), of=finned(), absent=absent)
    assert np.mean([one.log_odds[middle] for one in none]) > 1.5


def test_an_absent_component_hides_nothing() -> None:
    """A wall stands before a knob at a flat view."""
    model = make_model(
        "screened",
        (
            component("plate", box((0, 0, 0), (150, 100, 10)), (0.6, 0.6, 0.62)),
            component("wall", box((90, 10, 10), (94, 90, 60)), (0.6, 0.6, 0.62)),
            component("knob", box((70, 40, 10), (82, 60, 22)), (0.6, 0.6, 0.62)),
        ),
    )
    near = ViewRange((480.0, 520.0), elevation_deg=(18.0, 22.0), azimuth_deg=(-4.0, 4.0), roll_deg=(-2.0, 2.0))
    cache = VisibleEdgeCache(cached_guide_views(model, near, GuideViewOptions(renderer="zbuffer")), model)
    pose = pose_from(0, 20, 500, model)
    is_absent = np.array([False, True, False])
    complete, without = cache.nearest(pose), cache.nearest(pose, is_absent)
    own = [np.bincount(edges.component[edges.is_own], minlength=3) for edges in (complete, without)]
    assert own[0][2] == 0 and own[1][2] > 50
    assert own[1][1] == own[0][1] > 50
    assert (np.diff(without.component) >= 0).all()
    assert without.starts.tolist() == np.searchsorted(without.component, np.arange(4)).tolist()
    assert set(np.unique(without.sides)) <= {-1, 0, 1, 2}
    assert cache.nearest(pose, is_absent) is without and cache.nearest(pose, np.zeros(3, dtype=bool)) is complete
