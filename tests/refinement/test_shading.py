"""Shading modality: it refines poses of smooth parts and leaves poses alone that it does not determine."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from arview.cad.model import Component, Model, make_model
from arview.geometry import Array, apply, rigid, rotation_angle_rad
from arview.guideviews.surface import Surface, draw_surface, reduced_surface, surface_about
from arview.refinement.gauss_newton import apply_twist
from arview.refinement.modalities.shading import (
    COEFFICIENTS,
    ShadingOptions,
    _harmonics,
    _inner_pixels,
    _jacobian,
    _smooth_normals,
    corner_normals,
    crop_for_shading,
    curved_share,
    refine_by_shading,
)
from arview.rendering.rasterizer import rasterise
from helpers.synthetic import CAMERA, assembly

TRUTH = rigid(Rotation.from_euler("xyz", (20, -35, 50), degrees=True).as_matrix(), np.array([15.0, -10.0, 420.0]))
WEAK = np.diag(np.r_[np.full(3, 3000.0), np.full(3, 100.0)])
"""Information of the outline of a smooth part, which changes little when the part turns: 1° and 0.1 mm."""
OPTIONS = ShadingOptions()
LIGHT, SHINE = np.array([0.4, -0.6, -0.7]), 25.0


def _of(mesh: trimesh.Trimesh) -> Model:
    return make_model("part", (Component("part", np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32)),))


@cache
def blob() -> Model:
    """A smooth part of about 130 mm without symmetries."""
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=50.0)
    x, y, z = (mesh.vertices / 50.0).T
    swell = 1.0 + 0.22 * np.sin(2.3 * x + 0.5) + 0.18 * np.cos(2.9 * y - 1.0) * z + 0.12 * np.sin(3.1 * z + x)
    mesh.vertices *= swell[:, None] * (1.25, 1.0, 0.85)
    return _of(mesh)


@cache
def ball() -> Model:
    return _of(trimesh.creation.icosphere(subdivisions=4, radius=50.0))


def surface_of(model: Model) -> Surface:
    return surface_about(*reduced_surface(model), model.center_in_model)


def corners_of(model: Model) -> NDArray[np.float32]:
    return np.asarray(corner_normals(surface_of(model)))


def picture(model: Model, pose: Array, noise: float, card: bool = False) -> NDArray[np.uint8]:
    """A slightly shiny part lit by a lamp and its surroundings, on grey; partly behind a card if wanted."""
    surface = surface_of(model)
    seen = apply(pose, surface.points.astype(np.float64))
    c = CAMERA
    _, face_ids = rasterise(seen, surface.faces, c.fx, c.fy, c.cx, c.cy, c.width, c.height)
    rows, columns = np.nonzero(face_ids >= 0)
    normals = _normals_at(np.stack([columns, rows], axis=1), face_ids[rows, columns], seen, model, pose)
    cosine = np.maximum(normals @ (LIGHT / np.linalg.norm(LIGHT)), 0.0)
    drawn = np.full(face_ids.shape, 100.0)
    drawn[rows, columns] = 45.0 + 110.0 * cosine + 20.0 * normals[:, 1] + SHINE * cosine**40
    if card:
        drawn[:, : int(np.quantile(columns, 0.2))] = 170.0
    noisy = drawn + np.random.default_rng(3).normal(0.0, noise, drawn.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


def _normals_at(pixels: NDArray[np.int64], faces: NDArray[np.int32], seen: Array, model: Model, pose: Array) -> Array:
    """Normals (N,3) towards the camera at pixels (N,2) of some faces, interpolated between the corners."""
    corners = seen[surface_of(model).faces[faces]]
    rays = CAMERA.unproject(pixels.astype(np.float64))
    shares = np.linalg.solve(corners.transpose(0, 2, 1), rays[..., None])[..., 0]
    shares /= shares.sum(axis=1, keepdims=True)
    normals = np.einsum("nk,nkj->nj", shares, corners_of(model)[faces].astype(np.float64) @ pose[:3, :3].T)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(np.where((np.sum(normals * rays, axis=1) > 0.0)[:, None], -normals, normals))


def shaded(
    model: Model, image: NDArray[np.uint8], pose: Array, information: Array = WEAK
) -> tuple[Array, Array, float]:
    crop = crop_for_shading(image, CAMERA, model.diameter_mm, pose)
    assert crop is not None
    found, more, explained = refine_by_shading(
        crop, surface_of(model), corners_of(model), model.diameter_mm, pose, information, OPTIONS.gain, OPTIONS.rounds
    )
    return found, more, float(explained)


def turned(pose: Array, angle_deg: float, count: int) -> list[Array]:
    axes = np.random.default_rng(5).normal(size=(count, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return [apply_twist(pose, np.r_[np.deg2rad(angle_deg) * axis, 0.0, 0.0, 0.0]) for axis in axes]


def errors_deg(poses: list[Array]) -> Array:
    return np.rad2deg([rotation_angle_rad(pose, TRUTH) for pose in poses])


@pytest.mark.parametrize(("noise", "card", "most_deg"), [(2.0, False, 1.0), (12.0, False, 1.8), (4.0, True, 2.5)])
def test_a_smooth_part_is_turned_to_the_true_pose(noise: float, card: bool, most_deg: float) -> None:
    image = picture(blob(), TRUTH, noise, card)
    found = [shaded(blob(), image, start) for start in turned(TRUTH, 6.0, 12)]
    errors = errors_deg([pose for pose, _, _ in found])
    assert np.median(errors) < most_deg
    assert errors.max() < 6.5
    assert min(explained for _, _, explained in found) > 0.8


def test_a_pose_with_strong_information_is_not_moved() -> None:
    image = picture(blob(), TRUTH, 4.0)
    for start in turned(TRUTH, 4.0, 4):
        pose, information, _ = shaded(blob(), image, start, 1e4 * WEAK)
        assert np.rad2deg(rotation_angle_rad(pose, start)) < 0.3
        assert np.linalg.eigvalsh(information - 1e4 * WEAK).min() > -1e-3


def test_the_turn_of_a_ball_stays_undetermined() -> None:
    start = turned(TRUTH, 6.0, 1)[0]
    pose, information, explained = shaded(ball(), picture(ball(), TRUTH, 3.0), start)
    assert explained > 0.8
    assert np.rad2deg(rotation_angle_rad(pose, start)) < 1.5
    known = np.linalg.eigvalsh((information - WEAK)[:3, :3])
    of_blob = np.linalg.eigvalsh((shaded(blob(), picture(blob(), TRUTH, 3.0), TRUTH)[1] - WEAK)[:3, :3])
    assert known.max() < 0.02 * of_blob.min()


def test_the_jacobian_is_that_of_drawn_pictures() -> None:
    surface, size, diameter_mm = surface_of(blob()), 96, blob().diameter_mm
    focal_px, middle_px = np.array([280.0, 280.0]), np.array([38.0, 54.0])
    light = np.array([80.0, 20.0, -30.0, 60.0, 8.0, -6.0, 9.0, 7.0, -5.0])

    def brightness(pose: Array) -> tuple[Array, NDArray[np.float32], NDArray[np.int32]]:
        drawn, face_ids = np.empty((4, size, size), np.float32), np.empty((size, size), np.int32)
        center_px = middle_px + focal_px * pose[:2, 3] / pose[2, 3]
        draw_surface(surface, pose, focal_px, center_px, diameter_mm, drawn, face_ids)
        _smooth_normals(drawn, face_ids, surface, corners_of(blob()), pose, focal_px, middle_px, diameter_mm)
        functions = np.zeros((size, size, COEFFICIENTS))
        for v, u in zip(*np.nonzero(face_ids >= 0), strict=True):
            _harmonics(*drawn[:3, v, u], functions[v, u])
        return functions @ light, drawn, face_ids

    _, drawn, face_ids = brightness(TRUTH)
    places = _inner_pixels(drawn, face_ids)
    motion = _jacobian(places, light, drawn, face_ids, TRUTH, focal_px, middle_px, diameter_mm)
    assert len(places) > 800
    for k in range(6):
        step = np.zeros(6)
        # About a pixel, for faces are a few pixels large.
        step[k] = 0.05 if k < 3 else 2.0
        ahead, behind = (brightness(apply_twist(TRUTH, sign * step))[0] for sign in (1.0, -1.0))
        measured = ((ahead - behind) / (2.0 * step[k]))[tuple(places.T)]
        assert np.corrcoef(measured, motion[:, k])[0, 1] > 0.97, k
        assert np.dot(measured, motion[:, k]) / np.dot(motion[:, k], motion[:, k]) == pytest.approx(1.0, abs=0.05), k


def test_only_parts_with_curved_surfaces_use_shading() -> None:
    assert curved_share(surface_of(_of(trimesh.creation.box((40.0, 30.0, 20.0))))) == 0.0
    assert curved_share(surface_of(blob())) > 0.95
    assert curved_share(surface_of(_of(trimesh.creation.cylinder(20.0, 80.0, sections=64)))) > 0.5
    assert curved_share(surface_of(assembly())) < OPTIONS.min_curved_share


def test_flat_faces_move_no_pose() -> None:
    box = _of(trimesh.creation.box((90.0, 70.0, 50.0)))
    image = picture(box, TRUTH, 3.0)
    for start in turned(TRUTH, 5.0, 3):
        assert np.rad2deg(rotation_angle_rad(shaded(box, image, start)[0], start)) < 0.5


def test_there_is_no_crop_outside_the_picture() -> None:
    image = picture(blob(), TRUTH, 2.0)
    for way in ((900.0, 0.0, 0.0), (0.0, 0.0, -800.0), (np.nan, 0.0, 0.0)):
        pose = TRUTH.copy()
        pose[:3, 3] += way
        assert crop_for_shading(image, CAMERA, blob().diameter_mm, pose) is None


def test_a_picture_without_the_part_moves_a_pose_little() -> None:
    noise = np.random.default_rng(1).integers(0, 255, (CAMERA.height, CAMERA.width), dtype=np.uint8)
    pose, _, explained = shaded(blob(), noise, TRUTH)
    assert explained < 0.2
    assert np.rad2deg(rotation_angle_rad(pose, TRUTH)) < 3.0


def test_a_pose_that_nothing_determines_stays_as_it_is() -> None:
    surface, corners = surface_of(blob()), corners_of(blob())
    flat = np.full((CAMERA.height, CAMERA.width), 90, dtype=np.uint8)
    crop = crop_for_shading(flat, CAMERA, blob().diameter_mm, TRUTH)
    assert crop is not None
    pose, information, explained = refine_by_shading(
        crop, surface, corners, blob().diameter_mm, TRUTH, np.zeros((6, 6)), OPTIONS.gain, OPTIONS.rounds
    )
    np.testing.assert_array_equal(pose, TRUTH)
    assert not information.any() and explained == -1.0
