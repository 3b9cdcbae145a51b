"""The classical ICP beside the exact surface, on posts and on a scanned plate; and the studies of clouds."""

from __future__ import annotations

import numpy as np
import pytest
from measurement.test_cloud_alone import NOISE_MM, scan

from arview.errors import InputError
from arview.geometry import Array, apply
from arview.measurement.cloud.deviation import measure_components_in_cloud
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.types import Move
from arview_lab.cloud.classical_icp import ClassicalIcpOptions, classical_icp
from arview_lab.studies.cloud_registration import placed_by_icp
from arview_lab.studies.common import post, sideways
from arview_lab.studies.finding import scene_of
from arview_lab.studies.minima import posts
from arview_lab.studies.sampling import by_information
from arview_lab.studies.sampling import scan as scan_of_post
from helpers.plate_scene import as_built, nominal
from helpers.plate_scene import part as plate_part


def displaced(noise_mm: float) -> tuple[Array, Array, Array, Array, Array]:
    """Measured points of a post that stands 1 mm aside; reference points, normals and bounds; the displacement."""
    surface, _ = post()
    points, _ = surface.spread(8000, 1)
    reference, faces = surface.spread(60_000, 2)
    shift = sideways(0.7, 1.0)
    measured = points + shift + np.random.default_rng(3).normal(0.0, noise_mm, points.shape)
    bounds = np.stack([surface.triangles.min(axis=(0, 1)), surface.triangles.max(axis=(0, 1))])
    return measured, reference, surface.face_normals[faces], bounds, shift


@pytest.mark.slow
@pytest.mark.parametrize(("noise_mm", "limit_mm"), [(0.0, 0.005), (0.4, 0.06)])
def test_a_displaced_post(noise_mm: float, limit_mm: float) -> None:
    measured, reference, normals, bounds, shift = displaced(noise_mm)
    found = classical_icp(measured, reference, normals, bounds)
    center = np.array([0.0, 0.0, 20.0])
    assert np.linalg.norm(apply(found.reference_from_measured, center + shift) - center) < limit_mm
    assert found.share > 0.9
    assert found.points[0] < len(measured)  # averaged on the grid


def test_no_points_and_no_partner() -> None:
    measured, reference, normals, bounds, _ = displaced(0.0)
    with pytest.raises(InputError, match=r"0 measured and .* reference points are too few"):
        classical_icp(measured + 500.0, reference, normals, bounds)
    with pytest.raises(InputError, match=r"no point has a partner within 0\.001 mm"):
        options = ClassicalIcpOptions(reach_mm=0.001, grid_mm=0.0)
        classical_icp(measured + 3.0, reference - 2.9, normals, bounds, options)


@pytest.mark.slow
def test_components_of_a_plate_both_ways() -> None:
    """Both ways agree within their U; what they differ by is in the U of ICP."""
    cloud = scan(as_built(), np.eye(4), 120_000)
    exact = measure_components_in_cloud(cloud, nominal(), plate_part())
    icp = placed_by_icp(exact, cloud, plate_part())
    compared = 0
    for a, b in zip(exact, icp, strict=True):
        assert isinstance(a, Move) == isinstance(b, Move)
        if isinstance(a, Move) and isinstance(b, Move):
            apart = b.displacement_mm - a.displacement_mm
            assert 0.0 < np.linalg.norm(apart) < 0.2 > NOISE_MM
            assert apart @ b.covariance[3:, 3:] @ apart >= 0.99 * (apart @ apart) ** 2
            assert "placed by ICP" in b.notes[-1]
            compared += 1
    assert compared >= 3


def test_points_chosen_by_information_hold_the_height() -> None:
    """A scan from the side has few points on the top, which alone determines the height."""
    surface, _ = post()
    points, normals = scan_of_post(surface, 4000, np.random.default_rng(0))
    chosen = by_information(points, normals, 200, np.random.default_rng(1))
    assert len(np.unique(chosen)) == 200
    assert np.mean(normals[chosen][:, 2] > 0.9) > 2.5 * np.mean(normals[:, 2] > 0.9) > 0.0


def test_the_four_kinds_of_posts_are_closed() -> None:
    kinds = posts()
    assert len(kinds) == 4
    for surface in kinds.values():
        volume = float(np.sum(np.linalg.det(surface.triangles))) / 6.0
        assert 4000.0 < volume < np.pi * 64.0 * 40.0 + 1.0
        assert surface.triangles[..., 2].max() == pytest.approx(40.0)


def test_clouds_of_the_finding_study() -> None:
    """A quarter of the surface, ten times as many other points, none of them in the part's box."""
    scene = scene_of(nominal(), True, np.random.default_rng(4))
    assert scene.model_from_scan is not None
    surface = MeshSurface(*nominal().mesh[:2])
    moved = apply(scene.model_from_scan, scene.points)
    on = np.abs(surface.closest(moved).distances) < 1.0
    assert 0.08 < np.mean(on) < 0.1  # one point in eleven
    normals = scene.normals @ scene.model_from_scan[:3, :3].T
    cosine = np.sum(normals[on] * surface.closest(moved[on]).normals, axis=1)
    assert np.mean(cosine > 0.9) > 0.95
    other = scene_of(nominal(), False, np.random.default_rng(4))
    assert other.model_from_scan is None and len(other.points) < len(scene.points)
