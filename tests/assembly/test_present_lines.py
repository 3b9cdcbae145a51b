"""Lines of absent components are replaced by those of the others, near the present direction, and come back."""

from __future__ import annotations

import copy
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from arview.assembly.observation import base_of
from arview.assembly.present_lines import PresentLines
from arview.cad.samples import sample_surface
from arview.geometry import apply
from arview.refinement.view_model import PartView
from helpers.synthetic import assembly, assembly_views, pose_from

NAMES = [component.name for component in assembly().components]
BASE = base_of(assembly())
NONE = np.zeros(len(NAMES), dtype=bool)
POSE = pose_from(10, 40, 520)


@cache
def whole() -> PartView:
    return PartView(assembly_views())


def only(*names: str) -> NDArray[np.bool_]:
    return np.array([name in names for name in NAMES])


def near_points(part: PartView, name: str) -> int:
    """Edge points, of the view nearest to the pose, on a component."""
    view = assembly_views().nearest_index(POSE)
    first, last = part.arrays.edge_starts[view : view + 2]
    points = apply(part.model_from_body, part.arrays.edge_points[first:last].astype(np.float64))
    component = next(one for one in assembly().components if one.name == name)
    samples = sample_surface(component, 1.0, 20000).points
    distance = np.linalg.norm(points[:, None] - samples[None, ::4], axis=2).min(axis=1)
    return int(np.count_nonzero(distance < 1.0))


@pytest.mark.slow
def test_lines_of_an_absent_component_are_left_out_until_it_is_seen() -> None:
    lines = PresentLines(assembly(), whole(), BASE)
    assert lines.update(NONE, NONE, POSE) is whole()
    before, kept = near_points(whole(), "post_1"), near_points(whole(), "block_1")
    assert before > 10 and kept > 10
    reduced = lines.update(only("post_1"), NONE, POSE)
    assert near_points(reduced, "post_1") < 0.1 * before and near_points(reduced, "block_1") >= 0.9 * kept
    assert near_points(whole(), "post_1") == before, "the part itself must not change"
    # Lost and found again, when nothing is known: it stays left out, until it is seen.
    assert near_points(lines.update(NONE, NONE, POSE), "post_1") < 0.1 * before
    assert lines.update(NONE, only("post_1"), POSE) is whole()
    again = lines.update(only("block_1"), NONE, POSE)
    assert near_points(again, "post_1") >= 0.9 * before and near_points(again, "block_1") < 0.1 * kept


@pytest.mark.slow
def test_a_view_keeps_its_lines_where_nearly_all_would_go() -> None:
    reduced = PresentLines(assembly(), whole(), BASE).update(~NONE, NONE, POSE)
    view = assembly_views().nearest_index(POSE)
    first, last = whole().arrays.edge_starts[view : view + 2]
    assert last > first
    assert np.array_equal(reduced.arrays.edge_points[first:last], whole().arrays.edge_points[first:last])


def test_where_all_but_the_base_are_absent_its_own_guide_views_are_used() -> None:
    base = copy.copy(whole())
    lines = PresentLines(assembly(), whole(), BASE)
    others = np.arange(len(NAMES)) != BASE
    assert lines.update(NONE, NONE, POSE, base) is whole()
    assert lines.update(others, ~others, POSE, base) is base
    assert lines.update(NONE, NONE, POSE, base) is base, "the others stay left out until they are seen"
    assert lines.update(NONE, NONE, POSE) is not base
    assert lines.update(NONE, only("post_1"), POSE, base) is not base
