"""Random solids: of every kind, of a part's size, closed bodies, and the same from the same seed."""

from __future__ import annotations

import numpy as np
import pytest

from arview.evaluation.semisynthetic.random_solids import random_solid

SEEDS = range(30)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_solid_is_made_of_closed_bodies_of_a_parts_size(seed: int) -> None:
    solid = random_solid(seed)
    assert 60.0 < solid.diameter_mm < 350.0
    for component in solid.components:
        corners = component.vertices_in_model[component.faces]
        assert np.isfinite(corners).all()
        a, b, c = (corners[:, k] for k in range(3))
        crosses = np.cross(b - a, c - a)
        # Of a closed body outward areas cancel, and the signed volume is positive.
        assert np.linalg.norm(crosses.sum(axis=0)) < 1e-6 * np.linalg.norm(crosses, axis=1).sum()
        assert np.einsum("ij,ij->i", a, crosses).sum() / 6.0 > 0.0


def test_the_same_seed_gives_the_same_solid_and_another_another() -> None:
    one, again, other = random_solid(3), random_solid(3), random_solid(10)
    assert all(
        np.array_equal(a.vertices_in_model, b.vertices_in_model)
        for a, b in zip(one.components, again.components, strict=True)
    )
    assert one.diameter_mm != other.diameter_mm
