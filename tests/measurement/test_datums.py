"""The datum frame from noisy offsets against the move that made them, and what makes a datum useless."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from arview.cad.model import Component, make_model
from arview.cad.part import Datum
from arview.errors import InputError
from arview.geometry import Array
from arview.measurement.datums.alignment import Alignment, align
from arview.measurement.datums.datum_fit import correlation_factor, robust_weights
from arview.measurement.datums.equations import DatumEquations, move_equations, point_from_move, surface_equations
from arview.measurement.datums.in_photos import measure_datums_in_photos
from arview.measurement.photo import measure_components_in_photos
from arview.measurement.photo.views import views_of
from arview.measurement.types import Move
from helpers import photo_scene
from helpers.photo_scene import CAMERA, photograph, ring
from helpers.plate_scene import HOLE_MM, plate_with_holes

HOLES = {"B": np.array([-130.0, -130.0, 0.0]), "C": np.array([130.0, -130.0, 0.0])}
TRUE = np.array([0.0004, -0.0007, 0.0006, 0.21, -0.13, 0.08, 0.0])
SIZE_MM = 212.0


def moved(points: Array, normals: Array, move: Array, origin: Array) -> Array:
    return np.einsum("ni,nij,j->n", normals, point_from_move(points - origin), move)


def plane(rng: np.random.Generator, move: Array = TRUE, sigma: float = 0.02, outliers: float = 0.2) -> DatumEquations:
    points = np.column_stack([rng.uniform(-145, 145, (600, 2)), np.zeros(600)])
    normals = np.tile([0.0, 0.0, 1.0], (600, 1))
    offsets = moved(points, normals, move, HOLES["B"]) + rng.normal(0, sigma, 600)
    spatter = rng.random(600) < outliers
    offsets[spatter] += rng.uniform(0.2, 3.0, spatter.sum())
    return surface_equations("A", "plane", points, normals, offsets, np.full(600, sigma**2))


def hole(
    label: str, rng: np.random.Generator, move: Array = TRUE, sigma: float = 0.02, radius_mm: float = 0.05,
    count: int = 180, arc: float = 2 * np.pi,
) -> DatumEquations:  # fmt: skip
    angle = np.linspace(0, arc, count, endpoint=False)
    normals = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)])
    points = HOLES[label] + 6.5 * normals
    offsets = moved(points, normals, move, HOLES["B"]) + radius_mm + rng.normal(0, sigma, count)
    offsets[: count // 12] += 0.6  # a burr
    return surface_equations(
        label, "hole", points, normals, offsets, np.full(count, sigma**2), by_radius=np.ones(count)
    )


def three(seed: int, move: Array = TRUE, **kwargs: float | bool) -> Alignment:
    rng = np.random.default_rng(seed)
    datums = [plane(rng, move), hole("B", rng, move), hole("C", rng, move)]
    return align(datums, HOLES["B"], SIZE_MM, **kwargs)  # type: ignore[arg-type]


def test_frame_from_plane_and_two_holes(monkeypatch: pytest.MonkeyPatch) -> None:
    errors, sigmas = [], []
    for seed in range(20):
        found = three(seed)
        errors.append(found.move - TRUE)
        sigmas.append(np.sqrt(np.diag(found.covariance)))
    errors, sigmas = np.array(errors), np.array(sigmas)
    assert np.abs(errors[:, 3:6]).max() < 0.012  # 20 runs; one σ is 3 µm
    assert np.sqrt((errors[:, 3:6] ** 2).mean(axis=0)).max() < 0.005
    assert np.rad2deg(np.sqrt((errors[:, :3] ** 2).mean(axis=0))).max() < 0.001
    # Form is in the covariance too, but not in this noise: the frame is at least as good as it says.
    ratio = np.sqrt((errors[:, :6] ** 2).mean(axis=0)) / sigmas[:, :6].mean(axis=0)
    assert ratio.max() < 1.2
    monkeypatch.setattr("arview.measurement.datums.alignment.FORM_MM", 0.0)
    bare = align(
        [plane(np.random.default_rng(1)), hole("B", np.random.default_rng(2)), hole("C", np.random.default_rng(3))],
        HOLES["B"], SIZE_MM,
    )  # fmt: skip
    noise = np.sqrt(np.diag(bare.covariance))[:6]
    ratio = np.sqrt((errors[:, :6] ** 2).mean(axis=0)) / noise
    assert ratio.min() > 0.5 and ratio.max() < 1.7


def test_each_datum_locks_what_is_left_to_it() -> None:
    found = three(0)
    assert [datum.locked for datum in found.datums] == ["rx ry tz", "tx ty", "rz"]
    first, second, third = found.datums
    assert 440 < first.used < 510 and first.of == 600
    assert first.residual_mm == pytest.approx(0.02, abs=0.004)
    assert second.radius_mm == pytest.approx(0.05, abs=0.01)
    assert third.covariance[2, 2] > 0 and third.covariance[3, 3] < 1e-12
    assert np.allclose(sum(d.covariance for d in found.datums) + found.scale_covariance, found.covariance)


def test_holes_find_the_scale() -> None:
    larger = TRUE + np.array([0, 0, 0, 0, 0, 0, 3e-4])
    free = three(4, larger, scale_std=1e-3, finds_scale=True)
    assert free.move[6] == pytest.approx(3e-4, abs=5e-5)
    assert np.sqrt(free.covariance[6, 6]) < 5e-5
    held = three(4, larger, scale_std=3e-7, finds_scale=True)
    assert abs(held.move[6]) < 3e-6
    kept = three(4, larger, scale_std=1e-4)
    assert kept.move[6] == 0.0
    assert kept.covariance[6, 6] == pytest.approx(1e-8)
    assert np.allclose(kept.move[:6], TRUE[:6], atol=0.012)
    assert kept.datums[2].rest_mm > 0.04  # 0.08 mm too far apart


def base_move(twist: Array) -> Move:
    covariance = np.diag([1e-5, 1e-5, 1e-5, 0.004, 0.004, 0.004]) ** 2
    return Move("plate", "sweep", np.array([0.0, 0.0, -4.0]), twist, covariance, np.zeros((0, 6)), SIZE_MM, 9, 0.02, 1)


def test_the_base_decides_what_datums_leave_free() -> None:
    rng = np.random.default_rng(5)
    center = np.array([0.0, 0.0, -4.0])
    twist = np.einsum("ij,j->i", np.concatenate([np.eye(3, 7), point_from_move((center - HOLES["B"])[None])[0]]), TRUE)
    base, _ = move_equations("plate", base_move(twist))
    found = align([plane(rng), hole("B", rng)], HOLES["B"], SIZE_MM, base)
    assert found.datums[2].locked == "rz"
    assert found.notes == ("rz by the best fit of plate",)
    assert np.abs(found.move - TRUE)[3:].max() < 0.012
    alone = align([], center, SIZE_MM, base)
    assert np.allclose(alone.move[:6], twist, atol=1e-9)
    assert np.sqrt(np.diag(alone.covariance)[3:6]) == pytest.approx(0.004)
    with pytest.raises(InputError, match="leave rz free"):
        align([plane(rng), hole("B", rng)], HOLES["B"], SIZE_MM)


def test_chosen_axes_and_points() -> None:
    rng = np.random.default_rng(6)
    base, _ = move_equations("plate", base_move(np.zeros(6)))
    tilted = replace(plane(rng), locks=("tz",))
    found = align([tilted], HOLES["B"], SIZE_MM, base)
    assert found.datums[0].locked == "tz"
    points = []
    for i, (x, y) in enumerate([(-140.0, -140.0), (140.0, -140.0), (0.0, 140.0)]):
        place = np.array([[x, y, 0.0]]) + np.column_stack([rng.normal(0, 1.0, (12, 2)), np.zeros(12)])
        normals = np.tile([0.0, 0.0, 1.0], (12, 1))
        offsets = moved(place, normals, TRUE, HOLES["B"]) + rng.normal(0, 0.005, 12)
        points.append(surface_equations(f"A{i + 1}", "point", place, normals, offsets, np.full(12, 25e-6)))
    found = align([*points, hole("B", rng), hole("C", rng)], HOLES["B"], SIZE_MM)
    assert len(found.datums) == 5
    assert np.abs(found.move - TRUE)[3:].max() < 0.015
    assert np.rad2deg(np.abs(found.move - TRUE)[:3]).max() < 0.003


def test_what_makes_a_datum_useless() -> None:
    rng = np.random.default_rng(7)
    a, b, c = plane(rng), hole("B", rng), hole("C", rng)
    few = hole("B", rng, count=8)
    with pytest.raises(InputError, match=r"datum B \(hole\): only"):
        align([a, few, c], HOLES["B"], SIZE_MM)
    with pytest.raises(InputError, match=r"datum C \(hole\): only .* of 900"):
        align([a, b, replace(c, of=900)], HOLES["B"], SIZE_MM)
    with pytest.raises(InputError, match=r"datum B \(hole\): its position is uncertain by"):
        align([a, hole("B", rng, arc=0.15), c], HOLES["B"], SIZE_MM)
    with pytest.raises(InputError, match="datum D: all that it could lock"):
        align([a, b, replace(a, label="D"), c], HOLES["B"], SIZE_MM)


def test_neighbours_that_err_together_count_once() -> None:
    rng = np.random.default_rng(8)
    points = rng.uniform(0, 100, (500, 2))
    assert correlation_factor(points, rng.normal(size=500)) < 1.5
    cell = (points // 20).astype(int) @ [1, 5]
    alike = rng.normal(size=25)[cell]
    # 20 points a cell that all err alike: the mean's variance is 20 times that of independent ones.
    assert 8 < correlation_factor(points, alike) < 40


@pytest.mark.slow
def test_hole_in_thin_sheet() -> None:
    """The far rim of a hole in a sheet of 1.6 mm is within 2 px of the near one in every photo."""
    vertices, faces = plate_with_holes()
    thin = vertices * np.array([1.0, 1.0, 0.2])
    nominal = make_model("sheet", (Component("sheet", thin, faces),))
    shift = np.array([0.3, -0.2, 0.0])
    built = make_model("sheet", (Component("sheet", thin + shift, faces),))
    poses = ring(12)
    grays = [cv2.cvtColor(photograph(built, pose, seed=3), cv2.COLOR_RGB2GRAY) for pose in poses]
    names = tuple(f"img_{index}" for index in range(12))
    views = views_of(grays, (CAMERA,) * 12, np.stack(poses), nominal, names)
    hole = Datum("B", "hole", "sheet", (-50.0, 0.0, 0.0), (0.0, 0.0, 1.0), HOLE_MM)
    found = measure_datums_in_photos((hole,), views, {})[0]
    assert found.of > 200 and len(found.offsets_mm) > 0.8 * found.of
    assert found.by_radius is not None
    design = np.column_stack([found.rows[:, 3:6], found.by_radius])
    weights, _ = robust_weights(design, found.offsets_mm, found.variances)
    root = np.sqrt(weights / found.variances)[:, None]
    solution = np.linalg.lstsq(design * root, found.offsets_mm * root[:, 0], rcond=None)[0]
    assert np.abs(solution[:2] - shift[:2]).max() < 0.06, solution  # a pixel is 0.72 mm


@pytest.mark.slow
def test_plane_of_thin_sheet_without_texture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside every edge of the plane the sheet's other one runs: the fit of the whole sheet carries the plane."""
    vertices, faces = plate_with_holes()
    thin = vertices * np.array([1.0, 1.0, 0.2])
    nominal = make_model("sheet", (Component("sheet", thin, faces),))
    shift = np.array([0.2, -0.1, 0.4])
    built = make_model("sheet", (Component("sheet", thin + shift, faces),))
    monkeypatch.setattr(photo_scene, "PAINT", lambda points: np.full(len(points), 120.0))
    poses = ring(12)
    grays = [cv2.cvtColor(photograph(built, pose, seed=3), cv2.COLOR_RGB2GRAY) for pose in poses]
    views = views_of(grays, (CAMERA,) * 12, np.stack(poses), nominal, tuple(f"img_{index}" for index in range(12)))
    whole = measure_components_in_photos(views, None, nominal)["sheet"]["edges"]
    assert isinstance(whole, Move), whole
    plane = Datum("A", "plane", "sheet", (0.0, 50.0, 0.0), (0.0, 0.0, 1.0))
    found = measure_datums_in_photos((plane,), views, {"sheet": whole})[0]
    assert found.directions is not None and found.feature == "fit"
    rows = found.rows[:, [0, 1, 5]]
    solution = np.linalg.lstsq(rows, found.offsets_mm, rcond=None)[0]
    spread = np.sqrt(np.diag(np.linalg.inv(rows.T @ (rows / found.variances[:, None]))))
    assert abs(solution[2] - shift[2]) < min(0.08, 4.0 * spread[2]), (solution, spread)  # a pixel is 0.72 mm
    assert np.abs(solution[:2]).max() * 100.0 < 0.1, solution
    assert spread[2] < 0.08
