"""Subspaces, robust estimates and fits against constructed truth."""

from __future__ import annotations

import numpy as np
import pytest

from arview.core.fits import (
    covariance_root,
    fit_circle,
    fit_similarity,
    intersection,
    nearest_covariance,
    orthogonal_complement,
    robust_sigma,
    row_space,
    tukey_weights,
    without_span,
)
from arview.geometry import apply, exp_so3, rigid

RNG = np.random.default_rng(0)


def test_complements_of_dependent_and_of_no_directions() -> None:
    rows = RNG.normal(size=(3, 6))
    dependent = np.concatenate([rows, rows[:1] + rows[1:2]])
    assert len(row_space(dependent)) == 3
    rest = orthogonal_complement(dependent)
    assert rest.shape == (3, 6)
    assert rest @ rest.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.abs(rest @ rows.T).max() < 1e-12
    assert orthogonal_complement(np.zeros((0, 6))) == pytest.approx(np.eye(6))
    assert orthogonal_complement(np.eye(6)).shape == (0, 6)
    inner = orthogonal_complement(np.eye(6)[:1], np.eye(6)[:3])
    assert inner.T @ inner == pytest.approx(np.diag([0.0, 1, 1, 0, 0, 0]))


def test_intersections() -> None:
    tilted = np.array([[np.cos(0.02), 0.0, np.sin(0.02)]])
    flat = np.eye(3)[:2]
    assert len(intersection(tilted, flat)) == 0
    assert len(intersection(tilted, flat, 1.2)) == 1
    assert abs(intersection(np.eye(3)[1:], flat) @ [0.0, 1.0, 0.0]) == pytest.approx([1.0])
    assert intersection(np.zeros((0, 3)), flat).shape == (0, 3)


def test_values_without_the_span_of_columns() -> None:
    columns = RNG.normal(size=(20, 3))
    rest = without_span(columns, columns @ [1.0, 2.0, 3.0] + np.r_[1.0, np.zeros(19)])
    assert np.abs(columns.T @ rest).max() < 1e-12 < np.abs(rest).max()


def test_robust_scale_and_weights() -> None:
    residuals = RNG.normal(0.0, 2.0, 20_000)
    residuals[:1000] = 500.0
    assert robust_sigma(residuals) == pytest.approx(2.0, rel=0.1)
    assert tukey_weights(np.array([0.0, 4.685, -50.0])) == pytest.approx([1.0, 0.0, 0.0])


def test_covariances() -> None:
    covariance = np.diag([4.0, -1e-3, 1.0])
    assert nearest_covariance(covariance) == pytest.approx(np.diag([4.0, 0.0, 1.0]))
    root = covariance_root(covariance)
    assert root @ root.T == pytest.approx(np.diag([4.0, 0.0, 1.0]))


def test_similarity_and_circle() -> None:
    points = RNG.normal(size=(8, 3)) * [1.0, 1.0, 0.0]
    pose = rigid(exp_so3(np.array([0.3, -2.0, 0.5])), [1.0, 2.0, 3.0])
    scale, found = fit_similarity(points, apply(pose, 2.5 * points))
    assert scale == pytest.approx(2.5)
    assert found == pytest.approx(pose)
    assert fit_similarity(points, apply(pose, points), 1.0)[1] == pytest.approx(pose)
    angle = np.linspace(0.0, 2.0, 9)
    center, radius = fit_circle(np.column_stack([3.0 + 7.0 * np.cos(angle), -1.0 + 7.0 * np.sin(angle)]))
    assert center == pytest.approx([3.0, -1.0])
    assert radius == pytest.approx(7.0)
