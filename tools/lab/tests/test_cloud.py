"""ICP between clouds and the shape fits, against known moves."""

import numpy as np
import pytest

from arview.errors import InputError
from arview.geometry import apply, invert
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.cloud.registration import move_about, twist_about
from arview_lab.cloud.icp import IcpOptions, IcpTarget, register_clouds
from arview_lab.cloud.shape_fits import fit_circle, fit_cylinder, fit_plane


@pytest.fixture(scope="module")
def bracket():
    """An angle of two plates, 60 × 40 × 30 mm: every move is determined."""
    profile = np.array([[0, 0], [60, 0], [60, 6], [8, 6], [8, 30], [0, 30]], dtype=float)
    return MeshSurface(*_prism(profile, 40.0))


def _prism(profile, height):
    n = len(profile)
    vertices = np.concatenate([np.column_stack([profile, np.full(n, z)]) for z in (0.0, height)])
    cap = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    i = np.arange(n)
    j = (i + 1) % n
    sides = np.concatenate([np.stack([i, j, j + n], axis=1), np.stack([i, j + n, i + n], axis=1)])
    return vertices, np.concatenate([cap[:, ::-1], cap + n, sides])


@pytest.mark.parametrize(("method", "limit_um"), [("point", 40.0), ("plane", 2.0), ("generalized", 1.0)])
def test_icp_between_clouds(bracket, method, limit_um):
    points, _ = bracket.spread(6000, 1)
    target, target_faces = bracket.spread(20_000, 2)
    center = np.array([30.0, 15.0, 20.0])
    moved = move_about(center, np.array([0.01, 0.0, -0.01, 0.4, -0.3, 0.2]))
    cloud = IcpTarget(target, bracket.face_normals[target_faces])
    found = register_clouds(apply(moved, points), cloud, options=IcpOptions(method=method))
    assert found.converged
    assert 1e3 * np.linalg.norm(twist_about(center, found.target_from_source @ moved)[3:]) < limit_um
    estimated = IcpTarget(target)
    assert np.median(np.abs(np.sum(estimated.normals * cloud.normals, axis=1))) > 0.9999
    with pytest.raises(InputError, match="have a partner"):
        register_clouds(points + 1000.0, cloud)


def test_shape_fits_against_known_shapes_with_outliers():
    rng = np.random.default_rng(4)
    turn = move_about(np.zeros(3), np.array([0.3, -0.2, 0.5, 4.0, 5.0, 6.0]))
    angle, height = rng.uniform(0, 2 * np.pi, 4000), rng.uniform(-20, 20, 4000)
    wall = np.column_stack([8.0 * np.cos(angle), 8.0 * np.sin(angle), height]) + rng.normal(0, 0.05, (4000, 3))
    wall[:200] += rng.uniform(-3, 3, (200, 3))
    cylinder = fit_cylinder(apply(turn, wall))
    assert abs(abs(cylinder.direction @ turn[:3, 2]) - 1.0) < 1e-7
    away = cylinder.point - turn[:3, 3]
    assert np.linalg.norm(away - cylinder.direction * (away @ cylinder.direction)) < 0.005
    assert cylinder.radius_mm == pytest.approx(8.0, abs=0.005)
    assert cylinder.rms_mm == pytest.approx(0.05, rel=0.15)
    known = fit_cylinder(apply(turn, wall), turn[:3, 2] + [0.05, 0.0, 0.0], radius_mm=8.0)
    assert known.radius_mm == 8.0
    assert np.linalg.norm(apply(invert(turn), known.point)[:2]) < 0.005
    flat = np.column_stack([rng.uniform(-30, 30, (3000, 2)), rng.normal(0, 0.05, 3000)])
    flat[:300, 2] += rng.uniform(0, 4, 300)
    plane = fit_plane(apply(turn, flat))
    assert np.rad2deg(np.arccos(abs(plane.normal @ turn[:3, 2]))) < 0.02
    assert abs((plane.point - turn[:3, 3]) @ turn[:3, 2]) < 0.005
    ring = np.column_stack([6.5 * np.cos(angle), 6.5 * np.sin(angle), np.zeros(4000)]) + rng.normal(0, 0.03, (4000, 3))
    circle = fit_circle(apply(turn, ring[angle < 4.0]))
    assert np.linalg.norm(circle.center - turn[:3, 3]) < 0.01
    assert circle.radius_mm == pytest.approx(6.5, abs=0.005)
    with pytest.raises(InputError, match="at least 5 points"):
        fit_cylinder(wall[:4])
