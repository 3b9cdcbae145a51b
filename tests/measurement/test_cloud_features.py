"""Features and characteristics measured in a cloud without photos, against exact truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from arview.cad.model import Component, Model, make_model
from arview.cad.part import Characteristic, ComponentSettings, Datum, Part
from arview.inspection import Verdict
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.folder import MetricReconstruction, read_cloud
from arview.measurement.options import MeasureOptions
from arview.measurement.run import measure
from helpers.cad_files import box
from helpers.feature_scene import feature_scene, slot_scene
from helpers.synthetic import post


def cloud_of(built: Model, folder: Path, count: int) -> MetricReconstruction:
    """Points with 20 µm of noise on all but the underside of what was built, at its place."""
    surface = MeshSurface(*built.mesh)
    points, of_face = surface.spread(count)
    noisy = points + np.random.default_rng(0).normal(0.0, 0.02, points.shape)
    np.savetxt(folder / "cloud.xyz", noisy[surface.face_normals[of_face, 2] > -0.5], fmt="%.4f")
    cloud = read_cloud(folder / "cloud.xyz")
    return replace(cloud, scale=replace(cloud.scale, model_from_scan=np.eye(4)))


@pytest.mark.slow  # a cloud of some hundred thousand points
def test_the_profile_of_a_curved_surface_shows_size_and_dent(tmp_path: Path) -> None:
    """A boss of ⌀40 is 0.1 mm too thick all around; with a dent of 0.3 mm over a sixth of it in the second case."""
    for dent_mm, true_mm in ((0.0, 0.2), (0.3, 0.4)):
        bosses = {}
        for name, growth_mm in (("nominal", 0.0), ("built", 0.1)):
            vertices, faces = post((0.0, 0.0), 20.0, 0.0, 30.0, 180)
            angle = np.arctan2(vertices[:, 1], vertices[:, 0])
            shift = growth_mm - dent_mm * ((name == "built") & (np.abs(angle) < np.pi / 6.0))
            out = np.linalg.norm(vertices[:, :2], axis=1, keepdims=True)
            vertices[:, :2] += np.where(out > 1.0, shift[:, None] * vertices[:, :2] / np.maximum(out, 1.0), 0.0)
            base, base_faces = box((-60.0, -60.0, -8.0), (60.0, 60.0, 0.0))
            parts = (
                Component("base", base, base_faces.astype(np.int32)),
                Component("boss", vertices, faces.astype(np.int32)),
            )
            bosses[name] = make_model(name, parts)
        side = Datum("side", "surface", "boss", (0.0, 20.0, 15.0), (0.0, 0.0, 1.0))
        part = Part(
            "boss", Path("part.toml"), Path("boss.step"), bosses["nominal"],
            (ComponentSettings("base", "base"), ComponentSettings("boss", "inspect", 1.0)),
            datums=(Datum("A", "fit", "base", (0.0, 0.0, -4.0), (0.0, 0.0, 1.0)),),
            features=(side,), characteristics=(Characteristic("skin", "profile", ("side",), 0.3, datums=("A",)),),
        )  # fmt: skip
        reconstruction = cloud_of(bosses["built"], tmp_path, 300_000)
        (skin,) = measure(reconstruction, part, MeasureOptions(methods=("cloud",))).characteristics
        assert skin.value_mm is not None and skin.uncertainty_mm is not None, skin
        assert abs(skin.value_mm - true_mm) <= min(skin.uncertainty_mm, 0.05), (dent_mm, skin)
        assert skin.verdict is (Verdict.FAIL if dent_mm else Verdict.PASS), skin


@pytest.mark.slow  # a cloud of half a million points
def test_a_cloud_tells_places_sizes_gaps_and_tilts(tmp_path: Path) -> None:
    """Points with 20 µm of noise on what was built; every value is within U, and no verdict is wrong."""
    scene = feature_scene(1, columns=4, rows=2)
    cloud = cloud_of(scene.built, tmp_path, 600_000)
    found = measure(cloud, scene.part, MeasureOptions(methods=("cloud",))).characteristics
    assert len(found) == len(scene.true_mm) == 14
    for one in found:
        assert one.value_mm is not None and one.uncertainty_mm is not None, one
        error = abs(one.value_mm - scene.true_mm[one.name])
        assert error <= min(one.uncertainty_mm, 0.03), (one, error)
    assert {Verdict.PASS, Verdict.FAIL} <= {one.verdict for one in found}


@pytest.mark.slow  # a cloud of some hundred thousand points
def test_slots_and_targets_in_a_cloud(tmp_path: Path) -> None:
    """A frame of three datum targets; what is of slots is within U and 60 µm."""
    scene = slot_scene()
    found = measure(cloud_of(scene.built, tmp_path, 400_000), scene.part, MeasureOptions(methods=("cloud",)))
    assert len(found.characteristics) == len(scene.true_mm)
    for one in found.characteristics:
        assert one.value_mm is not None and one.uncertainty_mm is not None, one
        assert abs(one.value_mm - scene.true_mm[one.name]) <= min(one.uncertainty_mm, 0.06), one
