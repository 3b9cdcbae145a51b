"""A cloud in a unit that is seldom used, and points that lie on no surface: told, and quickly."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from arview.cli import main
from arview.errors import InputError
from arview.geometry import Array, apply, exp_so3, rigid
from arview.measurement.cloud import pair_registration
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.cloud.scene_points import scene_points
from helpers.cad_files import write_bench
from helpers.plate_scene import nominal

PLACE = rigid(exp_so3(np.array([0.9, -1.4, 0.6])), [120.0, -300.0, 80.0])


def surface_points(count: int) -> Array:
    vertices, faces, _ = nominal().mesh
    points, _ = MeshSurface(vertices, faces).spread(count, 0)
    return apply(PLACE, points)


@pytest.mark.parametrize("count", [400, 1500, 20_000])
def test_a_surface_is_told_from_random_points(count: int) -> None:
    size = nominal().diameter_mm
    noisy = surface_points(count) + np.random.default_rng(1).normal(0.0, 0.2, (count, 3))
    assert len(scene_points(noisy, None, size).points) > 100
    foreign = np.random.default_rng(2).uniform(-size, size, (2 * count, 3))
    assert len(scene_points(np.vstack([noisy, foreign]), None, size).points) > 100  # strays are no reason


def test_random_points_are_refused_at_once() -> None:
    size = nominal().diameter_mm
    start = time.thread_time()
    for count in (2000, 20_000):
        with pytest.raises(InputError, match="its points lie on no surface"):
            scene_points(np.random.default_rng(0).uniform(0.0, size, (count, 3)), None, size)
    assert time.thread_time() - start < 5.0


def test_messages_name_the_file_of_the_cloud(tmp_path: Path) -> None:
    part = write_bench(tmp_path)
    cloud = tmp_path / "scan.xyz"
    np.savetxt(cloud, np.random.default_rng(0).uniform(0.0, 150.0, (2000, 3)), fmt="%.3f")
    made = CliRunner().invoke(
        main, ["measure", "--cloud", str(cloud), "--part", str(part), "--unit", "mm", "--cloud-unit", "mm"]
    )
    assert made.exit_code == 64 and f"error: {cloud}: its points lie on no surface" in made.stderr
    wrong = CliRunner().invoke(
        main, ["measure", "--cloud", str(cloud), "--part", str(part), "--unit", "mm", "--cloud-unit", "m"]
    )
    assert wrong.exit_code == 64 and f"{cloud}: in m it is" in wrong.stderr and "the unit is wrong" in wrong.stderr


@pytest.mark.slow
def test_a_cloud_in_centimetres_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"FIRST_PAIRS": 2000, "PAIRS": 3000, "ROUNDS": 2, "KEPT": 10}.items():  # for time
        monkeypatch.setattr(pair_registration, name, value)
    from arview.measurement.folder import in_model_frame, read_cloud
    from helpers.plate_scene import part as plate_part

    cloud = tmp_path / "scan.xyz"
    np.savetxt(cloud, surface_points(20_000) / 10.0, fmt="%.5f")
    part = plate_part()
    read = read_cloud(cloud, part.model)
    placed = in_model_frame(read, part)
    assert any("the cloud is in cm" in one for one in placed.scale.warnings)
    assert placed.cloud is not None
    vertices, faces, _ = part.model.mesh
    off_mm = np.abs(MeshSurface(vertices, faces).closest(placed.cloud.points[::10]).distances)
    assert np.median(off_mm) < 0.05
