"""Combination, budget, propagation and intervals against simulated truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array, apply, exp_se3
from arview.measurement.datums.alignment import Alignment, align
from arview.measurement.datums.equations import (
    move_equations,
    point_from_move,
    surface_equations,
)
from arview.measurement.types import Method, Move
from arview.measurement.uncertainty.budget import (
    UncertaintyOptions,
    length_of,
    place,
)
from arview.measurement.uncertainty.combine import (
    agreements,
    combine,
    quantile_of_length,
)
from arview.measurement.uncertainty.pose_propagation import (
    PosePropagation,
    drawn_views,
    shifts_from_poses,
    visibility,
)
from arview.measurement.uncertainty.rice import rice_estimate
from arview.reconstruction.types import PosedPhoto, SparseModel
from helpers.photo_scene import CAMERA, bench, ring

RADIUS_MM = 22.0
CENTER = np.array([60.0, -40.0, 20.0])


@pytest.fixture
def bare(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing but what is measured counts: no form, no least error of the poses."""
    for name in ("FORM_MM", "MIN_POSES_MM"):
        monkeypatch.setattr(f"arview.measurement.uncertainty.budget.{name}", 1e-6)


def move(
    twist: Array, covariance: Array, method: Method = "sweep", undetermined: Array | None = None, center: Array = CENTER
) -> Move:
    free = np.zeros((0, 6)) if undetermined is None else undetermined
    return Move("post", method, center, twist, covariance, free, RADIUS_MM, 900, 0.02, 0.8)


def covariance_of(rng: np.random.Generator, shift_mm: float = 0.02) -> Array:
    """Random, not round."""
    root = rng.normal(size=(6, 6)) * np.array([shift_mm / RADIUS_MM] * 3 + [shift_mm] * 3)[:, None] / np.sqrt(6)
    return root @ root.T


def frame(rng: np.random.Generator, true: Array, scale_std: float = 0.0) -> Alignment:
    """A datum frame measured with noise on a plate of 300 mm; ``true`` (7,) about its origin."""
    origin = np.array([-130.0, -130.0, 0.0])
    points = np.column_stack([rng.uniform(-145, 145, (200, 2)), np.zeros(200)])
    parts = [("A", "plane", points, np.tile([0.0, 0.0, 1.0], (200, 1)), 0.08)]
    for label, x in (("B", -130.0), ("C", 130.0)):
        angle = np.linspace(0, 2 * np.pi, 100, endpoint=False)
        normals = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(100)])
        parts.append((label, "hole", np.array([x, -130.0, 0.0]) + 6.5 * normals, normals, 0.08))
    datums = []
    for label, feature, points, normals, sigma in parts:
        offsets = np.einsum("ni,nij,j->n", normals, point_from_move(points - origin), true)
        offsets = offsets + rng.normal(0, sigma, len(points))
        variances = np.full(len(points), sigma**2)
        datums.append(surface_equations(label, feature, points, normals, offsets, variances))
    return align(datums, origin, 212.0, scale_std=scale_std)


# --- Rice ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axes", [1, 2, 3])
@pytest.mark.parametrize("true", [0.0, 0.1, 0.3, 1.0])
def test_rice_against_simulation(axes: int, true: float) -> None:
    rng = np.random.default_rng(1)
    noise = rng.normal(0, 0.3, (200_000, axes))
    noise[:, 0] += true
    lengths = np.linalg.norm(noise, axis=1)
    found = rice_estimate(lengths[:20_000], 0.3, axes)
    # At zero the likelihood is flat: its curvature vanishes, and what is left is of fourth root of the number.
    assert found == pytest.approx(true, abs=0.05 if true < 0.3 else 0.01)


def test_rice_at_its_ends() -> None:
    assert rice_estimate(0.4, 0.3) == 0.0  # below √2 σ noise alone explains it
    assert rice_estimate(3.0, 0.03) == pytest.approx(3.0, abs=1e-3)
    for bad in ({"sigma": 0.0}, {"sigma": 1.0, "axes": 4}):
        with pytest.raises(InputError, match="rice"):
            rice_estimate(1.0, **bad)  # type: ignore[arg-type]


# --- combination -----------------------------------------------------------------------------------------


def test_two_methods_together() -> None:
    rng = np.random.default_rng(2)
    ratios, totals = [], []
    for _ in range(300):
        a, b = covariance_of(rng), covariance_of(rng, 0.04)
        true = rng.normal(size=6) * 0.01
        moves = [move(rng.multivariate_normal(true, c), c, m) for c, m in ((a, "sweep"), (b, "edges"))]  # type: ignore[arg-type]
        found = combine(moves)
        total = sum(found.covariances.values()) + found.disagreement
        error = found.twist - true
        ratios.append(error @ np.linalg.solve(total, error) / 6)
        totals.append(np.trace(total[3:, 3:]) / np.trace(a[3:, 3:]))
    assert np.mean(ratios) == pytest.approx(0.85, abs=0.15)  # chance contradictions are paid for: below 1
    assert np.mean(totals) < 1.0


def test_contradiction_widens_what_both_claim() -> None:
    fine, coarse = np.diag([1e-4, 1e-4, 1e-4, 0.005, 0.005, 0.005]) ** 2, np.diag([1e-3] * 3 + [0.03] * 3) ** 2
    near = move(np.zeros(6), fine), move(np.array([0, 0, 0, 0.01, 0, 0.0]), coarse, "edges")
    assert np.allclose(combine(near).disagreement, 0.0)
    assert agreements(near)[0].ratio < 0.3
    far = move(np.zeros(6), fine), move(np.array([0, 0, 0, 0.4, 0, 0.0]), coarse, "edges")
    found = combine(far)
    assert agreements(far)[0].ratio > 4
    # The better method on paper is followed, not believed: the truth may be anywhere between the two.
    std = np.sqrt(np.diag(sum(found.covariances.values()) + found.disagreement))
    assert found.twist[3] < 0.015
    assert 0.2 < std[3] < 0.27
    assert 0.015 < std[4] < 0.06  # wrong along x may be wrong along y too
    even = move(np.zeros(6), fine), move(np.array([0, 0, 0, 0.4, 0, 0.0]), fine, "edges")
    found = combine(even)
    std = np.sqrt((sum(found.covariances.values()) + found.disagreement)[3, 3])
    assert found.twist[3] == pytest.approx(0.2) and 0.2 < std < 0.35
    assert np.allclose(found.disagreement[:3, :3], 0.0)  # the rotations do agree


def test_a_contradiction_in_a_mixed_direction_is_seen() -> None:
    """Each method leaves another mixture of shift and turn open; what both determine is no pure shift nor turn."""
    covariance = np.diag([0.01 / RADIUS_MM] * 3 + [0.01] * 3) ** 2
    unit = np.array([RADIUS_MM] * 3 + [1.0] * 3)
    open_of = {"sweep": (0.6, 0.8), "edges": (0.8, -0.6)}
    true, moves = np.zeros(6), []
    for method, (turn, shift) in open_of.items():
        free = np.zeros((3, 6))
        free[np.arange(3), np.arange(3)], free[np.arange(3), np.arange(3) + 3] = turn, shift
        project = (np.eye(6) - free.T @ free) / unit[:, None] * unit
        measured = true if method == "sweep" else np.array([0.01, 0.0, 0.0, 0.4, 0.0, 0.0])
        moves.append(move(project @ measured, project @ covariance @ project.T, method, free))  # type: ignore[arg-type]
    found = combine(moves)
    assert agreements(moves) == () or not agreements(moves)[0].is_contradiction  # nothing is determined by both
    fewer = [replace(one, undetermined=one.undetermined[:1]) for one in moves]
    fewer = [
        replace(one, twist=measured, covariance=covariance)
        for one, measured in zip(fewer, (true, np.array([0.01, 0.01, 0.0, 0.4, 0.3, 0.0])), strict=True)
    ]
    pair = agreements(fewer)[0]
    assert pair.is_contradiction and pair.mixed_ratio > 3.0 and pair.turn_deg > 0.1
    found = combine(fewer)
    assert np.sqrt(np.trace(found.disagreement[3:, 3:])) > 0.1


def test_what_one_method_leaves_open_the_other_fills() -> None:
    covariance = np.diag([1e-3] * 3 + [0.01] * 3) ** 2
    spin, slide = np.eye(6)[2:3], np.eye(6)[3:4]
    open_twist, open_covariance = np.array([0, 0, 0, 0, 0.2, 0.1]), covariance.copy()
    open_covariance[[2, 3]] = open_covariance[:, [2, 3]] = 0.0
    one = move(open_twist, open_covariance, "sweep", np.concatenate([spin, slide]))
    other_covariance = covariance.copy()
    other_covariance[2] = other_covariance[:, 2] = 0.0
    other = move(np.array([0, 0, 0, 0.3, 0.2, 0.1]), other_covariance, "edges", spin)
    found = combine([one, other])
    assert found.twist == pytest.approx([0, 0, 0, 0.3, 0.2, 0.1])
    assert np.abs(found.undetermined) == pytest.approx(spin, abs=1e-9)
    assert found.covariances["sweep"][3, 3] == pytest.approx(0.0, abs=1e-15)
    assert found.covariances["edges"][3, 3] == pytest.approx(1e-4)
    assert sum(found.covariances.values())[4, 4] == pytest.approx(0.5e-4)
    alone = combine([one])
    assert len(alone.undetermined) == 2
    placed = place(alone, frame(np.random.default_rng(0), np.zeros(7)))
    assert placed.observable.tolist() == [True, True, False, False, True, True]
    assert placed.distance is not None and placed.distance.value == pytest.approx(np.hypot(0.2, 0.1), abs=0.03)


# --- a component's number --------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.usefixtures("bare")
@pytest.mark.parametrize("monte_carlo", [True, False])
def test_intervals_hold_the_truth_as_often_as_they_say(monte_carlo: bool) -> None:
    """500 components displaced by 0 to 2 mm, each with its own noise, measured in a frame that is measured too."""
    rng = np.random.default_rng(3)
    options = UncertaintyOptions(monte_carlo=monte_carlo, draws=2000)
    inside, per_axis, at_zero = [], [], []
    for index in range(500 if monte_carlo else 250):
        length = [0.0, 0.0, 0.03, 0.1, 0.5, 2.0][index % 6]
        direction = rng.normal(size=3)
        true = np.concatenate([rng.normal(0, 0.003, 3), length * direction / np.linalg.norm(direction)])
        center = rng.uniform([-120, -120, 5], [120, 120, 30])
        if index % 5 == 0:
            frame_move = np.concatenate([rng.normal(0, 5e-4, 3), rng.normal(0, 0.2, 3), [0.0]])
            alignment, scale = frame(rng, frame_move, scale_std=1e-4), rng.normal(0, 1e-4)
        carried = alignment.twist_from_move(center) @ (frame_move + np.array([0] * 6 + [scale]))
        noise = [covariance_of(rng, s) for s in (0.02, 0.03)]
        moves = [
            move(rng.multivariate_normal(true + carried, c), c, m, center=center)
            for c, m in zip(noise, ("sweep", "edges"), strict=True)  # type: ignore[arg-type]
        ]
        found = place(combine(moves), alignment, options=options)
        assert found.distance is not None
        inside.append(found.distance.low <= length <= found.distance.high)
        error = found.twist - true
        per_axis.extend(np.abs(error[3:]) <= 2 * np.sqrt(np.diag(found.covariance)[3:]))
        if length == 0.0:
            at_zero.append(inside[-1])
    assert 0.92 <= np.mean(inside) <= 0.99
    assert 0.91 <= np.mean(at_zero) <= 0.99
    assert 0.93 <= np.mean(per_axis) <= 0.99


def test_the_budget_sums_and_names_the_largest() -> None:
    rng = np.random.default_rng(4)
    alignment = frame(rng, np.zeros(7), scale_std=2e-4)
    c = np.diag([1e-4] * 3 + [0.004] * 3) ** 2
    far = move(np.array([0, 0, 0, 0.8, 0.0, 0.0]), c, center=np.array([130.0, -130.0, 10.0]))
    poses = np.diag([1e-5] * 3 + [0.003] * 3) ** 2
    found = place(combine([far]), alignment, poses)
    budget = dict(found.budget())
    assert next(iter(budget)) == "scale"
    assert budget["scale"] == pytest.approx(2e-4 * 260, rel=0.05)
    assert budget["noise of sweep"] == pytest.approx(0.004, rel=0.02)
    assert budget["camera poses"] == pytest.approx(np.hypot(0.003, 0.004), rel=0.02)
    assert budget["form"] == pytest.approx(0.005, rel=0.02)
    assert {"datum A", "datum B", "datum C", "methods disagree"} <= set(budget)
    assert found.distance is not None
    whole = np.sqrt(sum(value**2 for value in budget.values()))
    assert found.distance.uncertainty == pytest.approx(2 * whole, rel=0.05)
    analytic = place(combine([far]), alignment, poses, UncertaintyOptions(monte_carlo=False))
    assert analytic.distance is not None
    assert analytic.distance.uncertainty == pytest.approx(found.distance.uncertainty, rel=0.04)
    again = place(combine([far]), alignment, poses)
    assert again.distance == found.distance  # seeded


@pytest.mark.usefixtures("bare")
def test_large_turns_of_frame_and_component() -> None:
    """Exact where the twists are large: a part 1.5° askew, a component tilted by 5°."""
    rng = np.random.default_rng(5)
    frame_move = np.array([0.01, -0.015, 0.02, 1.0, -2.0, 0.5, 0.0])
    alignment = frame(rng, frame_move)
    carried = exp_se3(np.zeros(6)) @ alignment.rough_from_datum
    true = np.array([0.06, -0.05, 0.03])
    from arview.geometry import exp_so3, log_so3

    center = apply(carried, CENTER + np.array([0.3, -0.2, 0.1])) - CENTER
    turn = log_so3(carried[:3, :3] @ exp_so3(true))
    c = np.diag([1e-5] * 3 + [1e-4] * 3) ** 2
    found = place(combine([move(np.concatenate([turn, center]), c)]), alignment)
    assert found.twist[3:] == pytest.approx([0.3, -0.2, 0.1], abs=1e-9)
    assert np.rad2deg(found.twist[:3] - true) == pytest.approx(0.0, abs=0.02)


def test_near_zero_the_bias_is_seen() -> None:
    c = np.eye(3) * 0.03**2
    zero = length_of(np.array([0.03, 0.03, 0.02]), c, None, 3)
    assert zero.corrected == 0.0 and zero.bias == pytest.approx(zero.value)
    assert zero.low == 0.0
    assert zero.uncertainty == pytest.approx(2 * 0.03)
    longest = length_of(np.array([0.0, 0.0, 0.0838]), c, None, 3)  # 95 % of Maxwell's distribution is 2.795 σ
    assert longest.uncertainty == pytest.approx(longest.value) and longest.low == 0.0
    far = length_of(np.array([1.0, 0.0, 0.0]), c, None, 3)
    assert far.k == pytest.approx(2.0, abs=0.05)
    assert far.bias == pytest.approx(0.03**2, rel=0.05)
    assert quantile_of_length(np.diag([0.09, 0.0, 0.0])) == pytest.approx(0.3 * 1.96, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("length", [0.0, 0.7, 1.5, 3.0, 8.0])
@pytest.mark.parametrize("sigmas", [(1.0, 1.0, 0.4), (1.0, 0.5, 0.3), (1.0, 0.9, 0.0)])
def test_intervals_hold_lengths_near_zero(sigmas: tuple[float, float, float], length: float) -> None:
    rng = np.random.default_rng(7)
    std, axes = np.array(sigmas), int(np.count_nonzero(sigmas))
    draws = rng.normal(size=(4000, 3)) * std
    held, wide = [], []
    for _ in range(1000):
        direction = rng.normal(size=3) * (std > 0)
        seen = length * direction / np.linalg.norm(direction) + rng.normal(size=3) * std
        found = length_of(seen, np.diag(std**2), draws, axes)
        held.append(found.low <= length <= found.high)
        wide.append(found.uncertainty)
    # Four standard deviations of a binomial distribution are 2.8 %; along the lesser axes U is of the largest.
    assert 0.922 < np.mean(held) <= 1.0
    assert np.mean(wide) < 2.3


# --- poses -----------------------------------------------------------------------------------------------


def scene() -> SparseModel:
    photos = [PosedPhoto(f"{i}", Path(f"{i}"), CAMERA, pose) for i, pose in enumerate(ring(8))]
    none = np.zeros(0)
    return SparseModel(
        tuple(photos), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), none, none.astype(np.int32),
        none.astype(np.int32), np.zeros((0, 2)), pose_covariance=np.diag(np.tile([1e-5] * 3 + [0.01] * 3, 8)) ** 2,
    )  # fmt: skip


def triangulated(start: Array, cameras: list[Camera], poses: list[Array], pixels: Array) -> Array:
    """Brute force: the point nearest to all rays, each over its distance, by iteration."""
    point = start.copy()
    for _ in range(8):
        normal, right = np.zeros((3, 3)), np.zeros(3)
        for camera, pose, pixel in zip(cameras, poses, pixels, strict=True):
            ray = pose[:3, :3].T @ camera.unproject(pixel)
            ray /= np.linalg.norm(ray)
            centre = -pose[:3, :3].T @ pose[:3, 3]
            weight = (np.eye(3) - np.outer(ray, ray)) / np.sum((point - centre) ** 2)
            normal += weight
            right += weight @ centre
        point = np.linalg.solve(normal, right)
    return point


def test_poses_move_points_as_triangulation_says() -> None:
    sparse = scene()
    rng = np.random.default_rng(6)
    points = rng.uniform([-90, -90, 0], [90, 90, 40], (5, 3))
    sees = np.ones((5, 8), dtype=bool)
    sees[1, :3] = False
    gain = shifts_from_poses(points, sparse.photos, sees)
    twists = rng.normal(size=48) * np.tile([2e-5] * 3 + [0.01] * 3, 8)
    for i, point in enumerate(points):
        kept = [v for v in range(8) if sees[i, v]]
        pixels = np.array([CAMERA.project(apply(sparse.photos[v].cam_from_scan, point)) for v in kept])
        poses = [exp_se3(twists[6 * v : 6 * v + 6]) @ sparse.photos[v].cam_from_scan for v in kept]
        moved = triangulated(point, [CAMERA] * len(kept), poses, pixels) - point
        assert np.linalg.norm(moved) > 2e-3
        assert gain[i] @ twists == pytest.approx(moved, abs=1e-3 * np.linalg.norm(moved) + 1e-5)


def test_photos_see_the_side_that_faces_them() -> None:
    model, sparse = bench(1), scene()
    block = model.component("block_1")
    low, high = block.bounds_in_model
    middle = 0.5 * (low + high)
    top = np.array([[middle[0], middle[1], high[2]]])
    drawn = drawn_views(sparse, model)
    assert visibility(top, np.array([[0.0, 0.0, 1.0]]), sparse, drawn).all()
    assert not visibility(top - [0, 0, high[2]], np.array([[0.0, 0.0, -1.0]]), sparse, drawn).any()
    side = np.array([[high[0], middle[1], middle[2]]])
    seen = visibility(side, np.array([[1.0, 0.0, 0.0]]), sparse, drawn)[0]
    ahead = np.array([p.centre_in_scan[0] > 150 for p in sparse.photos])
    assert 0 < ahead.sum() < len(ahead)
    assert seen.sum() >= 2 and not seen[~ahead].any()


def plate_move() -> Move:
    """A perfect fit of the plate, as datum frame."""
    covariance = np.diag([1e-9] * 3 + [1e-6] * 3) ** 2
    return Move("plate", "sweep", np.array([0.0, 0.0, -4.0]), np.zeros(6), covariance, np.zeros((0, 6)), 141.5, 9, 0, 1)


def test_what_moves_component_and_datum_alike_is_nothing() -> None:
    model, sparse = bench(1), scene()
    base, _ = move_equations("plate", plate_move())
    alignment = align([], np.array([0.0, 0.0, -4.0]), 141.5, base)
    block = model.component("block_2")
    center = block.bounds_in_model.mean(axis=0)
    loose = PosePropagation(sparse, model, alignment, ["plate"]).covariance_of(block, center)
    shared = np.concatenate([p.cam_from_scan[:3, :3] @ np.diag([1.0, 2.0, 3.0]) for p in sparse.photos])
    twists = np.zeros((48, 3))
    twists[np.arange(48) % 6 >= 3] = shared  # all cameras shifted alike in the scan frame
    together = replace(sparse, pose_covariance=twists @ twists.T)
    shifted = PosePropagation(together, model, alignment, ["plate"]).covariance_of(block, center)
    assert np.diag(shifted)[3:].max() < 1e-8  # of shifts of 1 to 3 mm
    assert 0.002 < np.sqrt(np.diag(loose)[3:]).max() < 0.05
    # Bringing all cameras nearer only changes the scale, which has its own contribution.
    nearer = np.concatenate([np.r_[np.zeros(3), p.cam_from_scan[:3, 3] * 1e-3] for p in sparse.photos])[:, None]
    scaled = replace(sparse, pose_covariance=nearer @ nearer.T)
    shrunk = PosePropagation(scaled, model, alignment, ["plate"]).covariance_of(block, center)
    assert np.diag(shrunk)[3:].max() < 1e-8  # the block is 70 mm off the middle: (0.07 mm)² else
    with pytest.raises(InputError, match="no covariance"):
        PosePropagation(replace(sparse, pose_covariance=None), model, alignment, ["plate"])
