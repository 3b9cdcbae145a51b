"""The solver and its covariance, against known moves."""

import numpy as np
import pytest
import trimesh

from arview.errors import InputError
from arview.geometry import apply
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.cloud.registration import (
    RegistrationOptions,
    degrees_of_freedom,
    move_about,
    register_from_starts,
    register_to_surface,
    twist_about,
)
from arview_lab.studies.common import post

SHIFT = np.array([0.8, -0.6, 0.0])
QUICK = RegistrationOptions(noise_points=0)


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


def test_reference_case_of_a_displaced_post():
    surface, center = post()
    points, _ = surface.spread(24_099)
    found = register_to_surface(points + SHIFT, surface, center=center, options=QUICK)
    assert found.converged
    assert found.iterations <= 5
    assert np.linalg.norm(found.twist[3:] + SHIFT) < 1e-5
    # The spin, and nothing else, is left open, and did not move.
    assert np.allclose(np.abs(found.undetermined), [[0, 0, 1, 0, 0, 0]], atol=1e-3)
    assert abs(found.twist[2]) < 1e-6


@pytest.mark.parametrize("shift", [[0.0, 0.0, 0.8], [1.0, 1.0, -0.5]])
def test_a_face_that_is_off_more_than_the_noise_of_the_others_is_no_outlier(shift):
    surface, center = post()
    rng = np.random.default_rng(0)
    points, faces = surface.spread(6000)
    points = points[surface.face_normals[faces][:, 2] > -0.5]
    points = points + shift + rng.normal(0.0, 0.03, points.shape)
    found = register_to_surface(points, surface, center=center, options=QUICK)
    assert np.abs(found.twist[3:] + shift).max() < 0.01


def test_full_move_with_noise_and_clutter(bracket):
    rng = np.random.default_rng(1)
    center = np.array([30.0, 15.0, 20.0])
    moved = move_about(center, np.array([0.03, -0.02, 0.04, 1.2, -0.7, 0.5]))
    points, _ = bracket.spread(5000)
    points = apply(moved, points) + rng.normal(0.0, 0.05, (5000, 3))
    clutter = rng.uniform([-3, -3, -3], [63, 33, 43], (1500, 3))
    found = register_to_surface(np.concatenate([points, clutter]), bracket, center=center)
    error = twist_about(center, found.surface_from_points @ moved)
    assert np.abs(error[3:]).max() < 0.01
    assert np.rad2deg(np.abs(error[:3])).max() < 0.02
    assert len(found.undetermined) == 0
    assert 0.5 < found.overlap < 0.85
    assert (np.abs(error[3:]) < 5.0 * np.sqrt(np.diag(found.covariance)[3:])).all()


def test_only_free_moves_are_made(bracket):
    center = np.array([30.0, 15.0, 20.0])
    points, _ = bracket.spread(4000)
    twist = np.array([0.0, 0.0, 0.02, 0.6, -0.4, 0.0])
    moved = move_about(center, twist)
    plane = degrees_of_freedom("tx ty rz")
    found = register_to_surface(apply(moved, points), bracket, center=center, free=plane, options=QUICK)
    assert np.allclose(found.surface_from_points @ moved, np.eye(4), atol=1e-5)
    # With the turn held, the shift is found as well as it goes, and nothing else moves at all.
    found = register_to_surface(
        apply(moved, points), bracket, center=center, free=degrees_of_freedom("tx ty"), options=QUICK
    )
    assert np.array_equal(found.surface_from_points[:3, :3], np.eye(3))
    assert found.surface_from_points[2, 3] == 0.0
    # Along one slanted direction, given as a subspace.
    slanted = np.array([[0.0, 0.0, 0.0, 0.6, 0.8, 0.0]])
    found = register_to_surface(points + slanted[0, 3:], bracket, center=center, free=slanted, options=QUICK)
    assert np.allclose(found.twist, [0, 0, 0, -0.6, -0.8, 0], atol=1e-6)
    # Turned axes.
    axes = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert np.allclose(degrees_of_freedom("tx", axes), [[0, 0, 0, 0, 1, 0]])
    with pytest.raises(InputError, match="'qx' is none of"):
        degrees_of_freedom("tx qx")


def test_a_plane_leaves_three_moves_open():
    vertices = np.array([[-50, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]], dtype=float)
    surface = MeshSurface(vertices, np.array([[0, 1, 2], [0, 2, 3]]))
    points, _ = surface.spread(2000)
    points = points * [0.8, 0.8, 1.0] + [0.0, 0.0, 0.7]
    found = register_to_surface(points, surface, center=np.zeros(3), options=QUICK)
    assert np.allclose(found.twist, [0, 0, 0, 0, 0, -0.7], atol=1e-6)
    assert found.undetermined.shape == (3, 6)
    open_moves = found.undetermined.T @ found.undetermined
    assert np.allclose(np.diag(open_moves), [0, 0, 1, 1, 1, 0], atol=1e-6)


def test_a_second_minimum_is_told():
    """Two equal fins 3 mm apart: half a step away every start falls onto the wrong one or the right one."""
    fins = [trimesh.creation.box((0.8, 20.0, 10.0)).apply_translation((x, 0.0, 0.0)) for x in (0.0, 3.0, 6.0, 9.0)]
    mesh = trimesh.util.concatenate(fins)
    surface = MeshSurface(mesh.vertices, mesh.faces)
    one = MeshSurface(fins[1].vertices, fins[1].faces)
    points, faces = one.spread(3000)
    starts = [move_about(np.zeros(3), np.array([0, 0, 0, x, 0, 0])) for x in (0.0, -2.8, 3.1)]
    free = degrees_of_freedom("tx ty tz")
    found = register_from_starts(
        points, surface, starts, normals=one.face_normals[faces], options=QUICK, free=free, center=np.zeros(3)
    )
    assert found.runner_up is not None
    assert abs(abs(found.runner_up[0, 3] - found.surface_from_points[0, 3]) % 3.0) == pytest.approx(0.0, abs=0.02)
    assert found.runner_up_cost is not None
    assert found.runner_up_cost < 1.5
    surface, center = post()
    points, _ = surface.spread(3000)
    starts = [move_about(center, np.array([0, 0, 0, x, 0, 0])) for x in (0.0, 2.0, -2.0)]
    alone = register_from_starts(points, surface, starts, options=QUICK, center=center)
    assert alone.runner_up is None


def smooth_field(points, length_mm, rng, waves=150):
    """Vector field with covariance exp(−h/length) I, by random waves."""
    frequency = rng.normal(size=(waves, 3)) / length_mm / np.sqrt(rng.chisquare(1, size=(waves, 1)))
    phase = points @ frequency.T
    return (np.cos(phase) @ rng.normal(size=(waves, 3)) + np.sin(phase) @ rng.normal(size=(waves, 3))) / np.sqrt(waves)


@pytest.mark.slow
def test_covariance_holds_for_noise_that_neighbours_share():
    """Over 20 clouds with errors of 0.05 mm shared over 6 mm: predicted against true scatter."""
    surface, center = post()
    rng = np.random.default_rng(2)
    errors, predicted, naive = [], [], []
    for k in range(20):
        points, _ = surface.spread(2000, k)
        points = points[points[:, 2] > 0.5]
        points = points + 0.05 * smooth_field(points, 6.0, rng) + rng.normal(0.0, 0.03, points.shape)
        found = register_to_surface(points, surface, center=center)
        errors.append(found.twist)
        predicted.append(np.diag(found.covariance))
        independent = np.linalg.inv(np.delete(np.delete(found.information, 2, 0), 2, 1)) * found.sigma_mm**2
        naive.append(np.insert(np.diag(independent), 2, np.nan))  # a post can be turned about its axis
    for axes in ([3, 4], [5], [0, 1]):
        true = np.sqrt(np.mean(np.square(errors)[:, axes]))
        assert 0.6 < np.sqrt(np.median(np.array(predicted)[:, axes])) / true < 1.6
        assert np.sqrt(np.mean(np.array(naive)[:, axes])) / true < 0.3


@pytest.mark.slow
def test_covariance_of_independent_noise():
    surface, center = post()
    rng = np.random.default_rng(3)
    found = []
    for k in range(12):
        points, _ = surface.spread(3000, k)
        found.append(register_to_surface(points + rng.normal(0.0, 0.1, points.shape), surface, center=center))
    true = np.std([f.twist[3:5] for f in found])
    predicted = np.sqrt(np.median([np.diag(f.covariance)[3:5] for f in found]))
    assert 0.7 < predicted / true < 1.5


def test_what_cannot_be_registered_is_said(bracket):
    points, _ = bracket.spread(200)
    with pytest.raises(InputError, match="20 points are too few"):
        register_to_surface(points[:20], bracket)
    broken = points.copy()
    broken[3, 1] = np.nan
    with pytest.raises(InputError, match="1 of 200 points are NaN"):
        register_to_surface(broken, bracket)
    with pytest.raises(InputError, match=r"0 of 200 points are within 5\.00 mm"):
        register_to_surface(points + 500.0, bracket)
    twice = np.concatenate([points, points])
    assert np.allclose(register_to_surface(twice, bracket, options=QUICK).surface_from_points, np.eye(4), atol=1e-6)
