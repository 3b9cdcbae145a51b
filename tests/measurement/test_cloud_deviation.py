"""Components measured in simulated clouds of a small assembly, and what is said where there is nothing to measure."""

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from arview.cad.model import Component, make_model
from arview.cad.part import ComponentSettings, Part
from arview.cad.part_file import load_part
from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import apply, look_at
from arview.measurement.cloud import points as cloud_points
from arview.measurement.cloud.deviation import measure_components_in_cloud
from arview.measurement.cloud.distance_map import (
    distance_map,
    full_width_at_half_maximum,
    histogram_png,
    map_picture,
    write_distance_ply,
)
from arview.measurement.cloud.foreign_objects import find_foreign
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.cloud.points import CloudPoints, grid_average, prepare_cloud
from arview.measurement.cloud.registration import move_about
from arview.measurement.cloud.visibility import SurfaceVisibility
from arview.measurement.types import Move, NotMeasured
from arview.reconstruction.types import DenseCloud, PosedPhoto
from helpers.paths import SHARED

PLATE = SHARED / "plate"
NOISE_MM = 0.08
POST, TALL, BLOCK, NUT = "post", "tall_post", "block", "nut"


def _component(name, mesh, at):
    mesh.apply_translation(at)
    return Component(name, np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int32))


def _lug():
    """A block with a lower step at one end: no symmetry at all about Z."""
    return trimesh.util.concatenate([
        trimesh.creation.box((20.0, 16.0, 14.0)).apply_translation((0.0, 0.0, 7.0)),
        trimesh.creation.box((10.0, 9.0, 6.0)).apply_translation((15.0, 3.5, 3.0)),
    ])  # fmt: skip


@pytest.fixture(scope="module")
def model():
    base = trimesh.creation.box((160.0, 120.0, 8.0))
    nut = trimesh.creation.cylinder(12.0, 11.0, sections=6)
    return make_model("mini", (
        _component("base", base, (0, 0, -4)),
        _component(POST, trimesh.creation.cylinder(8.0, 30.0, sections=72), (-50, 30, 15)),
        _component(TALL, trimesh.creation.cylinder(6.0, 42.0, sections=72), (40, 30, 21)),
        _component(BLOCK, _lug(), (10, -30, 0)),
        _component(NUT, nut, (-45, -30, 5.5)),
    ))  # fmt: skip


@pytest.fixture(scope="module")
def part(model):
    settings = tuple(ComponentSettings(c.name, "base" if c.name == "base" else "inspect") for c in model.components)
    return Part("mini", Path("mini.toml"), Path("mini.glb"), model, settings)


@pytest.fixture(scope="module")
def photos():
    camera = Camera(1200, 900, 1400.0, 1400.0, 599.5, 449.5)
    found = []
    for k, angle in enumerate(np.arange(12) * np.pi / 6.0):
        eye = 400.0 * np.array([0.75 * np.cos(angle), 0.75 * np.sin(angle), 0.66])
        found.append(PosedPhoto(f"{k}.png", Path(), camera, look_at(eye, [0, 0, 5], [0, 0, 1])))
    return found


def make_cloud(model, photos, moves=None, without=(), seed=0, spacing_mm=0.45, extra=None, noise_mm=NOISE_MM):
    """What the photos see of the model with components moved: points with noise, normals, sigma."""
    moves = moves or {}
    rng = np.random.default_rng(seed)
    built = make_model("built", tuple(
        replace(c, vertices_in_model=apply(moves.get(c.name, np.eye(4)), c.vertices_in_model))
        for c in (*model.components, *(extra or ())) if c.name not in without
    ))  # fmt: skip
    vertices, faces, _ = built.mesh
    surface = MeshSurface(vertices, faces)
    points, of_face = surface.sample(spacing_mm, seed)
    normals = surface.face_normals[of_face]
    seen = SurfaceVisibility(built, photos).count(points, normals) >= 3
    points = points[seen] + normals[seen] * rng.normal(0.0, noise_mm, (int(seen.sum()), 1))
    count = len(points)
    return DenseCloud(
        points, normals[seen].astype(np.float32), np.zeros((count, 3), np.uint8),
        np.full(count, max(noise_mm, 0.01), np.float32), np.full(count, 3, np.uint8),
    )  # fmt: skip


def by_name(results):
    return {r.component: r for r in results}


def centre(model, name):
    return model.component(name).bounds_in_model.mean(axis=0)


@pytest.fixture(scope="module")
def moved(model):
    """Moves of the built components, about their centres."""
    return {
        POST: move_about(centre(model, POST), np.array([0.01, -0.008, 0.0, 1.0, -0.6, 0.0])),
        TALL: move_about(centre(model, TALL), np.array([0.0, 0.0, 0.0, -2.5, 1.5, 0.3])),
        BLOCK: move_about(centre(model, BLOCK), np.array([0.0, 0.0, 0.05, 0.4, 0.3, 0.0])),
        NUT: move_about(centre(model, NUT), np.array([0.0, 0.0, -0.03, -0.2, 0.1, 0.2])),
    }


@pytest.fixture(scope="module")
def cloud(model, photos, moved):
    return make_cloud(model, photos, moved)


@pytest.fixture(scope="module")
def results(cloud, model, part, photos):
    return by_name(measure_components_in_cloud(cloud, model, part, photos))


@pytest.mark.slow
def test_moves_are_found(results, model, moved):
    for name, true in moved.items():
        found = results[name]
        assert isinstance(found, Move), found
        c = found.center_in_model
        shift = apply(true, c) - c
        assert np.abs(found.displacement_mm - shift).max() < 0.015, name
        deviation = np.sqrt(np.diag(found.covariance)[3:])
        assert (deviation < 0.05).all()
        assert (np.abs(found.displacement_mm - shift) < 5.0 * deviation + 0.003).all(), name
        assert found.support > 0.9
        assert found.residual_mm == pytest.approx(NOISE_MM, rel=0.25)
        # Only the axis counts for round posts.
        turned = found.measured_from_nominal[:3, :3].T @ true[:3, :3]
        axis_deg = np.rad2deg(np.arccos(min(1.0, turned[2, 2])))
        assert axis_deg < 0.15, name
        if name in (BLOCK, NUT):
            assert np.rad2deg(abs(np.arctan2(turned[1, 0], turned[0, 0]))) < 0.15, name


@pytest.mark.slow
def test_spin_of_round_posts_is_undetermined_and_nothing_else(results):
    for name in (POST, TALL):
        assert results[name].undetermined.shape == (1, 6)
        assert np.allclose(np.abs(results[name].undetermined[0]), [0, 0, 1, 0, 0, 0], atol=0.01)
        assert np.array_equal(results[name].observable, [True, True, False, True, True, True])
        assert abs(results[name].twist[2]) < 1e-4
        assert results[name].covariance[2, 2] < 1e-10
    for name in (BLOCK, NUT):
        assert len(results[name].undetermined) == 0


@pytest.mark.slow
def test_nothing_moved_and_broken_points(model, part, photos):
    sound = make_cloud(model, photos)
    rng = np.random.default_rng(5)
    broken = np.array(sound.points)
    broken[rng.permutation(len(broken))[:500]] = np.nan
    twice = DenseCloud(*(np.concatenate([a, a]) for a in (
        broken, sound.normals, sound.colors, np.where(rng.random(len(broken)) < 0.1, np.nan, sound.sigma), sound.views
    )))  # fmt: skip
    results = measure_components_in_cloud(twice, model, part, photos)
    assert len(results) == 4
    for found in results:
        assert isinstance(found, Move)
        assert np.abs(found.displacement_mm).max() < 0.015


def test_cloud_without_photos_or_normals(cloud, model, part, moved):
    bare = replace(cloud, normals=np.zeros_like(cloud.normals))
    results = measure_components_in_cloud(bare, model, part)
    assert {found.component for found in results} == set(moved)
    for found in results:
        assert isinstance(found, Move)
        c = found.center_in_model
        assert np.abs(found.displacement_mm - (apply(moved[found.component], c) - c)).max() < 0.03


@pytest.mark.slow
def test_missing_fallen_and_swapped(model, part, photos):
    lying = move_about(centre(model, TALL), np.array([np.pi / 2, 0, 0, 0, 0, -15.0]))
    swap_tall = move_about(centre(model, NUT), np.array([0, 0, 0, *(centre(model, POST) - centre(model, NUT))]))
    swap_tall[2, 3] = 0.0
    swap_post = move_about(centre(model, POST), np.array([0, 0, 0, *(centre(model, NUT) - centre(model, POST))]))
    swap_post[2, 3] = 0.0
    found = by_name(measure_components_in_cloud(
        make_cloud(model, photos, {TALL: lying, NUT: swap_tall, POST: swap_post}, without=(BLOCK,)), model, part, photos
    ))  # fmt: skip
    assert isinstance(found[BLOCK], NotMeasured)
    assert found[BLOCK].is_missing
    assert "missing: no surface where it should be" in found[BLOCK].reason
    assert isinstance(found[TALL], NotMeasured)
    assert "fallen over" in found[TALL].reason
    for name, other in ((NUT, POST), (POST, NUT)):
        assert isinstance(found[name], NotMeasured), name
        assert not found[name].is_missing, found[name].reason
        assert f"shape of {other}: swapped?" in found[name].reason


def test_what_the_cloud_does_not_cover_is_not_missing(cloud, model, part, photos):
    away = np.linalg.norm(cloud.points[:, :2] - centre(model, TALL)[:2], axis=1) > 16.0
    half = DenseCloud(*(a[away] for a in (cloud.points, cloud.normals, cloud.colors, cloud.sigma, cloud.views)))
    found = by_name(measure_components_in_cloud(half, model, part, photos))[TALL]
    assert isinstance(found, NotMeasured)
    assert not found.is_missing
    assert "not covered by the cloud" in found.reason


def test_clouds_that_do_not_belong(cloud, model, part, photos):
    def only(points):
        count = len(points)
        return DenseCloud(
            points, cloud.normals[:count], cloud.colors[:count], cloud.sigma[:count], cloud.views[:count]
        )  # fmt: skip

    with pytest.raises(InputError, match="cloud: is empty"):
        measure_components_in_cloud(only(np.zeros((0, 3))), model, part, photos)
    with pytest.raises(InputError, match="20 of 20 points lie at the part"):
        measure_components_in_cloud(only(cloud.points[:20]), model, part, photos)
    with pytest.raises(InputError, match="left-handed"):
        measure_components_in_cloud(only(cloud.points * [-1.0, 1.0, 1.0]), model, part, photos)
    with pytest.raises(InputError, match="is it in mm and in the frame"):
        measure_components_in_cloud(only(cloud.points + 1000.0), model, part, photos)
    rng = np.random.default_rng(6)
    box = model.bounds_in_model
    with pytest.raises(InputError, match="it is of another part"):
        measure_components_in_cloud(only(rng.uniform(box[0], box[1], (20_000, 3))), model, part, photos)


@pytest.mark.slow
def test_foreign_object_is_found_and_only_that(cloud, results, model, photos, moved):
    places = {name: move.measured_from_nominal for name, move in results.items()}
    assert find_foreign(cloud, model, places) == []
    thing = _component("thing", trimesh.creation.box((14.0, 9.0, 7.0)), (60, -35, 9.5))
    found = find_foreign(make_cloud(model, photos, moved, extra=(thing,)), model, places)
    assert len(found) == 1
    assert np.abs(found[0].center_in_model - [60, -35, 10]).max() < 3.0
    assert found[0].nearest_component == "base"
    assert "foreign object at" in found[0].describe()


def test_grid_average_keeps_both_sides_of_a_sheet():
    rng = np.random.default_rng(7)
    flat = rng.uniform(-10, 10, (40_000, 2))
    up = np.arange(40_000) % 2 == 0
    points = np.column_stack([flat, np.where(up, 0.05, -0.05) + rng.normal(0, 0.02, 40_000)])
    normals = np.column_stack([np.zeros((40_000, 2)), np.where(up, 1.0, -1.0)])
    averaged = grid_average(CloudPoints(points, normals, np.full(40_000, 0.02)), 1.0)
    assert 800 <= len(averaged) < 1100  # the grid cuts the noise of a side at z = 0 here and there
    assert abs(np.average(averaged.points[averaged.normals[:, 2] > 0.5, 2]) - 0.05) < 0.03
    assert np.allclose(averaged.sigma, 0.02)


def test_distance_map(cloud, model, moved, tmp_path):
    there = distance_map(cloud, model, moved, reach_mm=2.0)
    rows = {row.name: row for row in there.statistics}
    assert rows["all"].sigma_mm == pytest.approx(NOISE_MM, rel=0.05)
    assert rows["base"].fwhm_mm == pytest.approx(2.3548 * NOISE_MM, rel=0.06)
    assert abs(rows[BLOCK].mean_mm) < 0.01
    nominal = distance_map(cloud, model, reach_mm=2.0)
    assert {row.name: row for row in nominal.statistics}[POST].sigma_mm > 0.4
    write_distance_ply(there, tmp_path / "d.ply")
    back = trimesh.load(tmp_path / "d.ply")
    assert np.allclose(back.vertices, there.points_in_model, atol=1e-4)
    picture = cv2.imdecode(np.frombuffer(histogram_png(there, model, POST), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (600, 960, 3)
    assert (picture < 128).any()
    seen = map_picture(nominal, limit_mm=1.0)
    hsv = cv2.cvtColor(seen, cv2.COLOR_RGB2HSV)
    assert np.mean(hsv[..., 1] > 20) > 0.05
    with pytest.raises(InputError, match="none of"):
        distance_map(replace(cloud, points=cloud.points + 1000.0), model)


def test_full_width_at_half_maximum_of_known_distributions():
    rng = np.random.default_rng(8)
    narrow = rng.normal(0.3, 0.1, 50_000)
    assert full_width_at_half_maximum(narrow, 3.0) == pytest.approx(0.2355, rel=0.04)
    tails = np.concatenate([narrow, rng.uniform(-2, 2, 10_000)])
    assert full_width_at_half_maximum(tails, 3.0) == pytest.approx(0.2355, rel=0.08)


@pytest.mark.slow
@pytest.mark.shared
def test_plate_as_built_with_weld_beads():
    """Points of the surface that was really rendered, weld beads included: only post_1 was displaced."""
    part = load_part(PLATE / "plate.glb")
    settings = tuple(replace(s, role="base" if s.name == "base_plate" else "inspect") for s in part.settings)
    truth = json.loads((PLATE / "truth.json").read_text())
    k = np.array(truth["K"])
    camera = Camera(1600, 1200, k[0, 0], k[1, 1], k[0, 2], k[1, 2], np.array([*truth["dist_k1_k2"], 0, 0, 0]))
    photos = [PosedPhoto(n, PLATE / n, camera, np.array(pose)) for n, pose in truth["cam_from_model_mm"].items()]
    mesh = trimesh.load(PLATE / "as_built.ply")
    built = make_model("built", (Component("built", np.array(mesh.vertices), np.array(mesh.faces, np.int32)),))
    cloud = make_cloud(built, photos, spacing_mm=0.7, noise_mm=0.1)
    found = measure_components_in_cloud(cloud, part.model, replace(part, settings=settings), photos)
    assert len(found) == 16
    for move in found:
        assert isinstance(move, Move), move
        true = np.array(truth["truth"][move.component]["displacement_mm"])
        assert np.abs(move.displacement_mm - true).max() < 0.025, move.component
    assert find_foreign(cloud, part.model, {move.component: move.measured_from_nominal for move in found}) == []


@pytest.mark.slow
def test_a_cloud_too_large_for_one_piece_gives_the_same(cloud, model, monkeypatch):
    box = model.bounds_in_model
    whole = prepare_cloud(cloud, box, 0.5, 60)
    monkeypatch.setattr(cloud_points, "_CHUNK", 20_000)
    pieces = prepare_cloud(cloud, box, 0.5, 60)
    assert len(pieces) == pytest.approx(len(whole), rel=0.1)
    vertices, faces, _ = model.mesh
    surface = MeshSurface(vertices, faces)
    spread = [np.nanmedian(np.abs(surface.closest(p.points, 0.5).distances)) for p in (whole, pieces)]
    assert spread[1] == pytest.approx(spread[0], rel=0.2)


def at_scale(model, part, cloud, photos, by):
    """All of it, enlarged by a factor."""
    larger = make_model(
        "larger", tuple(replace(c, vertices_in_model=by * c.vertices_in_model) for c in model.components)
    )
    moved = [replace(p, cam_from_scan=p.cam_from_scan * np.array([[1.0, 1.0, 1.0, by]] * 4)) for p in photos]
    moved = [replace(p, cam_from_scan=np.vstack([p.cam_from_scan[:3], [0, 0, 0, 1.0]])) for p in moved]
    scaled = replace(cloud, points=cloud.points * by, sigma=(cloud.sigma * by).astype(np.float32))
    return scaled, larger, replace(part, model=larger), moved


@pytest.mark.slow
@pytest.mark.parametrize("with_photos", [False, True])
def test_a_small_part_is_measured_as_one_of_usual_size(model, part, photos, with_photos):
    moves = {
        POST: move_about(centre(model, POST), np.array([0, 0, 0, 1.0, 0, 0])),
        BLOCK: move_about(centre(model, BLOCK), np.array([0, 0, np.deg2rad(1.5), 0, 0.6, 0])),
    }
    cloud = make_cloud(model, photos, moves, without=(NUT,), noise_mm=0.02)
    by = 0.08  # 16 mm across
    scaled, small, its_part, its_photos = at_scale(model, part, cloud, photos, by)
    usual = by_name(measure_components_in_cloud(cloud, model, part, photos if with_photos else ()))
    found = by_name(measure_components_in_cloud(scaled, small, its_part, its_photos if with_photos else ()))
    assert found[NUT].is_missing and usual[NUT].is_missing
    for name, truth in ((POST, [1.0, 0, 0]), (BLOCK, [0, 0.6, 0]), (TALL, [0, 0, 0])):
        move = found[name]
        assert isinstance(move, Move), move
        np.testing.assert_allclose(move.displacement_mm, by * np.array(truth), atol=0.03 * by)
        np.testing.assert_allclose(move.center_in_model, by * centre(model, name), atol=1e-9)
        assert move.radius_mm == pytest.approx(by * usual[name].radius_mm)
        assert 0.2 * by * 0.02 < move.residual_mm < 1.5 * by * 0.02
        own, other = (np.sqrt(np.trace(one.covariance[3:, 3:])) for one in (move, usual[name]))
        assert 0.3 * by * other < own < 0.002
    assert np.rad2deg(found[BLOCK].twist[2]) == pytest.approx(1.5, abs=0.1)


@pytest.mark.slow
def test_points_that_are_far_apart(model, part, photos):
    moves = {POST: move_about(centre(model, POST), np.array([0, 0, 0, 0.6, 0, 0]))}
    cloud = make_cloud(model, photos, moves, spacing_mm=0.9, noise_mm=0.01)
    coarse, large, its_part, _ = at_scale(model, part, cloud, photos, 4.0)  # 3.6 mm apart on a part of 800 mm
    found = by_name(measure_components_in_cloud(coarse, large, its_part))
    for name, truth in ((POST, [2.4, 0, 0]), (BLOCK, [0, 0, 0]), (NUT, [0, 0, 0])):
        assert isinstance(found[name], Move), found[name]
        np.testing.assert_allclose(found[name].displacement_mm, truth, atol=0.1)
    sparse = make_cloud(model, photos, moves, spacing_mm=7.0, noise_mm=0.01)
    found = by_name(measure_components_in_cloud(sparse, model, part))
    assert isinstance(found[NUT], NotMeasured)
    assert re.search(r"the points are too far apart for it, [5-9](\.\d)? mm: \d+ of them", found[NUT].reason)
