"""Clouds as they come: beside other things, in part, with any normals, too large."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from measurement.test_cloud_alone import PLACE, off_mm, scan, search_coarsely

from arview.geometry import Array, apply, invert, rigid
from arview.measurement.cloud.pair_registration import find_by_pairs
from arview.measurement.cloud.placing import dense_cloud, orient_normals
from arview.measurement.cloud.scale_check import cloud_scale
from helpers.plate_scene import as_built, nominal

RNG = np.random.default_rng(5)


def table() -> Array:
    """Points of a table on which the plate lies, and strays."""
    plane = np.column_stack([RNG.uniform(-350.0, 350.0, (60_000, 2)), RNG.normal(-8.05, 0.03, 60_000)])
    plane = plane[(np.abs(plane[:, :2]) > 100.0).any(axis=1)]
    return apply(PLACE, np.concatenate([plane, RNG.uniform(-500.0, 500.0, (300, 3))]))


@pytest.mark.slow
def test_on_a_table_without_normals(monkeypatch: pytest.MonkeyPatch) -> None:
    search_coarsely(monkeypatch)
    points = np.concatenate([scan(as_built(), count=40_000).points, table()])
    assert off_mm(find_by_pairs(points, None, nominal()).model_from_scan) < 0.3


@pytest.mark.slow
def test_a_half_with_normals_inward(monkeypatch: pytest.MonkeyPatch) -> None:
    search_coarsely(monkeypatch)
    cloud = scan(as_built(), count=40_000)
    seen = apply(invert(PLACE), cloud.points)[:, 0] > 0.0
    found = find_by_pairs(cloud.points[seen], -cloud.normals[seen].astype(np.float64), nominal())
    assert off_mm(found.model_from_scan) < 0.3
    assert 0.3 < found.share < 0.7


def test_normals_are_turned_outward() -> None:
    cloud = scan(as_built(), np.eye(4), 20_000)
    same, said = orient_normals(cloud, nominal(), 3.0)
    assert said == "" and same is cloud
    flipped, said = orient_normals(replace(cloud, normals=-cloud.normals), nominal(), 3.0)
    assert said == "the normals of the cloud point inward and were turned"
    assert (flipped.normals == cloud.normals).all()
    signs = RNG.choice([-1.0, 1.0], (len(cloud.points), 1)).astype(np.float32)
    mixed, said = orient_normals(replace(cloud, normals=cloud.normals * signs), nominal(), 3.0)
    assert "of the normals of the cloud point outward" in said
    assert (
        np.mean(np.sum(mixed.normals * cloud.normals, axis=1) < 0) < 0.04
    )  # where displaced blocks stand in the plate


@pytest.mark.parametrize("factor", [1.0, 1.003, 0.998])
def test_the_scale_of_the_base(factor: float) -> None:
    cloud = scan(as_built(), rigid(np.eye(3), [0.2, -0.3, 0.1]), 60_000)
    found = cloud_scale(dense_cloud(cloud.points * factor, cloud.normals), nominal(), ("plate",))
    assert found is not None
    assert abs(found.factor - factor) < 2e-4
    assert found.is_contradiction == (factor != 1.0)
    few = dense_cloud(cloud.points[:100], None)
    assert cloud_scale(few, nominal(), ("plate",)) is None
