"""Random solids: closed bodies of every kind, of a part's size, and the same from the same seed."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from scipy.spatial import cKDTree

from arview.cad import Model
from arview_lab.semisynthetic.random_solids import random_near_symmetric, random_solid

SEEDS = (*range(14), 23)
"""Of the last one all tries to make it nearly symmetric fail."""


@cache
def near_symmetric(seed: int) -> Model | None:
    """The solid of a seed; None where all tries fail, which takes seconds."""
    try:
        return random_near_symmetric(seed)
    except ValueError:
        return None


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("made", [random_solid, near_symmetric])
def test_a_solid_consists_of_closed_bodies_of_a_parts_size(made: Callable[[int], Model | None], seed: int) -> None:
    solid = made(seed)
    if solid is None:
        assert made is near_symmetric and seed == 23
        return
    assert 60.0 < solid.diameter_mm < 350.0
    for component in solid.components:
        corners = component.vertices_in_model[component.faces]
        assert np.isfinite(corners).all()
        a, b, c = (corners[:, k] for k in range(3))
        crosses = np.cross(b - a, c - a)
        # Of a closed body outward areas cancel, and the signed volume is positive.
        assert np.linalg.norm(crosses.sum(axis=0)) < 1e-6 * np.linalg.norm(crosses, axis=1).sum()
        assert np.einsum("ij,ij->i", a, crosses).sum() / 6.0 > 0.0


def test_solids_depend_only_on_their_seed() -> None:
    one, again, other = random_solid(3), random_solid(3), random_solid(10)
    assert all(
        np.array_equal(a.vertices_in_model, b.vertices_in_model)
        for a, b in zip(one.components, again.components, strict=True)
    )
    assert one.diameter_mm != other.diameter_mm


@pytest.mark.slow
def test_a_near_symmetric_solid_is_symmetric_but_for_a_few_features() -> None:
    seen = 0
    for seed in SEEDS:
        solid = near_symmetric(seed)
        if solid is None:
            continue
        points = np.concatenate([c.vertices_in_model for c in solid.components])
        away_mm = []
        for angle in np.deg2rad([72.0, 90.0, 120.0, 180.0, 45.0, 60.0]):
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            away_mm.append(cKDTree(points).query(np.column_stack([points[:, :2] @ turn.T, points[:, 2]]))[0])
        most_deep = 0.05 * np.ptp(points[:, 0])
        shares = np.array([[np.mean(one < limit) for limit in (most_deep, 0.01)] for one in away_mm])
        assert shares[:, 0].max() > 0.6 and shares[:, 1].max() < 1.0, (seed, shares)
        seen += 1
    assert seen == len(SEEDS) - 1
