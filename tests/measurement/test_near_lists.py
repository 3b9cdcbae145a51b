"""The lists of near points from which places of a part in a cloud are scored."""

from __future__ import annotations

import numpy as np
import pytest

from arview.measurement.cloud.pair_registration import PairRegistrationOptions, _near_lists
from arview.measurement.cloud.scene_points import ScenePoints


def scene(count: int, weights: np.ndarray, rng: np.random.Generator) -> ScenePoints:
    points = rng.random((count, 3)) * (300.0, 200.0, 40.0) + 1000.0
    return ScenePoints(points, np.zeros_like(points), weights, points, points, 1.0, True, 0)


@pytest.mark.parametrize("block", [1, 7000, 2_000_000])
def test_all_near_points_are_listed_once_where_there_is_room(block: int) -> None:
    rng = np.random.default_rng(1)
    cloud = scene(400, np.ones(400), rng)
    lists = _near_lists(cloud, 100.0, PairRegistrationOptions(list_block=block), rng)
    apart = np.linalg.norm(cloud.points[:, None] - cloud.points[None], axis=2)
    for listed, distances in zip(lists, apart, strict=True):
        near = np.flatnonzero(distances <= 60.0)
        assert 0 < len(near) < len(listed)
        assert sorted(listed[: len(near)]) == near.tolist() and (listed[len(near) :] == -1).all()


@pytest.mark.slow
def test_rare_points_are_preferred_in_every_part_of_a_list() -> None:
    rng = np.random.default_rng(2)
    is_rare = np.arange(2000) < 1000
    cloud = scene(2000, np.where(is_rare, 1.0, 0.02), rng)
    lists = _near_lists(cloud, 1000.0, rng)
    assert (lists >= 0).all()
    # 640 of 1000 rare and 1000 common points at odds of 50 to 1: about 620 are rare.
    assert 0.95 < is_rare[lists].mean() < 0.99
    assert is_rare[lists[:, :160]].mean() == pytest.approx(is_rare[lists[:, 160:]].mean(), abs=0.01)
