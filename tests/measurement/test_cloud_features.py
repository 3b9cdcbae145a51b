"""Features and characteristics measured in a cloud without photos, against exact truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from arview.inspection import Verdict
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.folder import read_cloud
from arview.measurement.options import MeasureOptions
from arview.measurement.run import measure
from helpers.feature_scene import feature_scene


@pytest.mark.slow  # a cloud of half a million points
def test_a_cloud_tells_places_sizes_gaps_and_tilts(tmp_path: Path) -> None:
    """Points with 20 µm of noise on what was built; every value is within U, and no verdict is wrong."""
    scene = feature_scene(1, columns=4, rows=2)
    vertices, faces, owners = scene.built.mesh
    surface = MeshSurface(vertices, faces, owners)
    points, of_face = surface.spread(600_000)
    seen = surface.face_normals[of_face, 2] > -0.5
    noisy = points + np.random.default_rng(0).normal(0.0, 0.02, points.shape)
    np.savetxt(tmp_path / "cloud.xyz", noisy[seen], fmt="%.4f")
    cloud = read_cloud(tmp_path / "cloud.xyz")
    cloud = replace(cloud, scale=replace(cloud.scale, model_from_scan=np.eye(4)))
    found = measure(cloud, scene.part, MeasureOptions(methods=("cloud",))).characteristics
    assert len(found) == len(scene.true_mm) == 14
    for one in found:
        assert one.value_mm is not None and one.uncertainty_mm is not None, one
        error = abs(one.value_mm - scene.true_mm[one.name])
        assert error <= min(one.uncertainty_mm, 0.03), (one, error)
    assert {Verdict.PASS, Verdict.FAIL} <= {one.verdict for one in found}
