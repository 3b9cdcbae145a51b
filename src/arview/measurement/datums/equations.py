"""Linear equations between the measured offsets of a datum and the motion of the part.

Each offset is measured along a normal ``n`` of the nominal surface or edge at a point ``p``. If the part is moved by a
rotation vector ω and a translation t about an origin ``o``, and is larger by the factor 1 + s, then

    offset = n · (t + ω × (p − o) + s (p − o)).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from arview.errors import InputError
from arview.geometry import Array
from arview.measurement.types import Move


class DatumNotMeasuredError(InputError):
    """A datum that is in the CAD, but could not be measured; the message names it and says why."""


DOF_NAMES = ("rx", "ry", "rz", "tx", "ty", "tz")
"""Degrees of freedom of a rigid motion, in the order of a twist."""


@dataclass(frozen=True)
class DatumEquations:
    """Measured offsets of one datum feature.

    Attributes:
        label: label of the datum, e.g. ``B``.
        feature: plane, hole, pin, cylinder, edge, point or fit.
        rows: (N,7) derivative of each offset by ω, t and s about the model's origin: p × n, n, n · p.
        offsets_mm: (N,) measured minus nominal.
        variances: (N,) variances of their independent noise, mm².
        points: (N,3) where they were measured, model frame, mm.
        of: number of offsets that should have been found.
        by_radius: (N,) derivative of the offsets by the radius of a round feature, which is estimated and discarded
            because wear and rounded edges change it; None for other features.
        locks: degrees of freedom that the datum may lock.
        directions: (6,K) directions within which it may lock, about its origin and the axes of the model; None: all.
        form_mm: additional standard uncertainty of its position that the residuals do not show.
        by_form: (N,W) derivative of the offsets by errors of form, each of ``form_mm``, which move a feature that is
            seen in part. None: no such errors.
    """

    label: str
    feature: str
    rows: Array
    offsets_mm: Array
    variances: Array
    points: Array
    of: int
    by_radius: Array | None = None
    locks: tuple[str, ...] = DOF_NAMES
    form_mm: float = 0.0
    by_form: Array | None = None
    directions: Array | None = None


def point_from_move(arms: Array) -> Array:
    """(N,3,7) derivative of the displacement ω × a + t + s a by (ω, t, s), for arms a (N,3) from the origin."""
    rows = np.zeros((len(arms), 3, 7))
    x, y, z = arms.T
    rows[:, 0, 1], rows[:, 0, 2] = z, -y
    rows[:, 1, 0], rows[:, 1, 2] = -z, x
    rows[:, 2, 0], rows[:, 2, 1] = y, -x
    rows[:, :, 3:6] = np.eye(3)
    rows[:, :, 6] = arms
    return rows


def surface_equations(
    label: str,
    feature: str,
    points: Array,
    normals: Array,
    offsets_mm: Array,
    variances: Array,
    of: int | None = None,
    by_radius: Array | None = None,
    locks: tuple[str, ...] = DOF_NAMES,
) -> DatumEquations:
    """Equations of offsets (N,) along unit normals (N,3) at points (N,3) of the model; see `DatumEquations`."""
    rows = np.einsum("ni,nij->nj", normals, point_from_move(points))
    count = len(points) if of is None else of
    return DatumEquations(
        label,
        feature,
        rows,
        offsets_mm=offsets_mm,
        variances=variances,
        points=points,
        of=count,
        by_radius=by_radius,
        locks=locks,
    )


def move_equations(label: str, move: Move, locks: tuple[str, ...] = DOF_NAMES) -> tuple[DatumEquations, Array]:
    """Equations of a fitted move, restricted to its determined directions.

    Returns:
        the equations, and the (K,6) matrix that maps a twist to their offsets.
    """
    values, vectors = np.linalg.eigh(_scaled(move.covariance, move.radius_mm))
    kept = values > 1e-12 * max(values[-1], 1e-300)
    unit = np.array([move.radius_mm] * 3 + [1.0] * 3)
    offsets_from_twist = vectors.T[kept] * unit
    at_center = np.concatenate([np.eye(3, 7), point_from_move(move.center_in_model[None])[0]])
    rows = offsets_from_twist @ at_center
    points = np.tile(move.center_in_model, (len(rows), 1))
    offsets = offsets_from_twist @ move.twist
    equations = DatumEquations(label, "fit", rows, offsets, values[kept], points, len(rows), locks=locks)
    return equations, offsets_from_twist


def _scaled(covariance: Array, radius_mm: float) -> Array:
    """The covariance (6,6) with rotations in mm at ``radius_mm``."""
    unit = np.array([radius_mm] * 3 + [1.0] * 3)
    return covariance * np.outer(unit, unit)
