"""The closest points of a surface, against trimesh's and against shapes whose distances are known."""

import numpy as np
import pytest
import trimesh

from arview.errors import InputError
from arview.measurement.cloud.mesh_surface import MeshSurface


@pytest.fixture(scope="module")
def lumpy():
    """A closed body of 20,480 triangles with hollows."""
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=30.0)
    wave = 1.0 + 0.2 * np.sin(0.2 * mesh.vertices[:, 0]) * np.cos(0.15 * mesh.vertices[:, 1])
    return MeshSurface(mesh.vertices * wave[:, None], mesh.faces)


def test_closest_is_that_of_trying_every_triangle(lumpy):
    rng = np.random.default_rng(0)
    points = rng.uniform(-50, 50, (40, 3))
    found = lumpy.closest(points)
    for point, distance, closest in zip(points, found.distances, found.points, strict=True):
        every = trimesh.triangles.closest_point(lumpy.triangles, np.repeat(point[None], len(lumpy.faces), axis=0))
        best = np.linalg.norm(every - point, axis=1).min()
        assert abs(distance) == pytest.approx(best, abs=1e-9)
        assert np.linalg.norm(closest - point) == pytest.approx(best, abs=1e-9)


def test_hints_and_reach_change_nothing_but_what_is_too_far(lumpy):
    rng = np.random.default_rng(1)
    points = rng.uniform(-60, 60, (20_000, 3))
    free = lumpy.closest(points)
    hinted = lumpy.closest(points, hint=rng.integers(0, len(lumpy.faces), len(points)))
    assert np.array_equal(np.abs(free.distances), np.abs(hinted.distances))
    near = lumpy.closest(points, reach=2.0)
    inside = np.abs(free.distances) < 2.0
    assert np.array_equal(near.faces >= 0, inside)
    assert np.array_equal(near.distances[inside], free.distances[inside])
    assert inside.any() and not inside.all()
    assert np.isnan(near.distances[~inside]).all()


def test_sign_near_edges_and_corners_of_a_box():
    box = trimesh.creation.box((20.0, 30.0, 40.0))
    surface = MeshSurface(box.vertices, box.faces)
    points = np.random.default_rng(2).uniform(-25, 25, (5000, 3))
    inside = (np.abs(points) < [10.0, 15.0, 20.0]).all(axis=1)
    found = surface.closest(points)
    assert np.array_equal(found.distances < 0, inside)
    outside = np.linalg.norm(np.maximum(np.abs(points) - [10.0, 15.0, 20.0], 0.0), axis=1)
    assert np.allclose(found.distances[~inside], outside[~inside], atol=1e-12)
    # Foot on a face: no edge. Two or more coordinates beyond: an edge or a corner.
    beyond = (np.abs(points) > [10.0, 15.0, 20.0]).sum(axis=1)
    assert not found.is_edge[beyond == 1].any()
    assert found.is_edge[beyond >= 2].all()


def test_normals_of_a_coarse_cylinder_are_those_of_the_round_one():
    mesh = trimesh.creation.cylinder(8.0, 40.0, sections=36)
    surface = MeshSurface(mesh.vertices, mesh.faces)
    angle = np.random.default_rng(3).uniform(0, 2 * np.pi, 500)
    radial = np.stack([np.cos(angle), np.sin(angle), np.zeros(500)], axis=1)
    found = surface.closest(8.1 * radial + [0.0, 0.0, 5.0])
    assert np.rad2deg(np.arccos((found.normals * radial).sum(axis=1))).max() < 0.1
    assert not found.is_edge.any()
    assert surface.closest(np.array([[8.5, 0.0, 20.5]])).is_edge[0]


def test_faces_without_area_and_doubled_vertices_are_no_matter():
    box = trimesh.creation.box((10.0, 10.0, 10.0))
    soup = box.triangles.reshape(-1, 3)
    faces = np.concatenate([np.arange(len(soup)).reshape(-1, 3), [[0, 0, 1], [2, 2, 2]]])
    surface = MeshSurface(soup, faces)
    points = np.random.default_rng(4).uniform(-8, 8, (500, 3))
    assert np.allclose(
        surface.closest(points).distances, MeshSurface(box.vertices, box.faces).closest(points).distances
    )
    with pytest.raises(InputError, match="no triangle has an area"):
        MeshSurface(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    with pytest.raises(InputError, match="NaN"):
        MeshSurface(np.full((3, 3), np.nan), np.array([[0, 1, 2]]))


def test_samples_lie_on_the_surface_evenly(lumpy):
    points, faces = lumpy.sample(1.0)
    assert len(points) == pytest.approx(lumpy.areas.sum(), rel=0.01)
    assert np.abs(lumpy.closest(points).distances).max() < 1e-9
    half = lumpy.triangles.mean(axis=1)[:, 2] > 0
    assert np.mean(half[faces]) == pytest.approx(lumpy.areas[half].sum() / lumpy.areas.sum(), abs=0.01)
