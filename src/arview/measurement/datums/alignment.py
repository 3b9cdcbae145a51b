"""The measured datum frame: datums lock degrees of freedom in their order of precedence (ISO 5459).

Each datum solves its equations (`equations`) for those directions of the motion (rotation ω, translation t) that it
determines and that no earlier datum has locked: a plane locks two rotations and a translation, a hole then the two
translations across its axis, a second hole the rotation about the first. What the datums leave free follows from the
best fit of the base. All of this is linear in the offsets; the whole chain is kept as one matrix, by which the
uncertainty of every offset is propagated to the frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from arview.core.fits import intersection, orthogonal_complement
from arview.errors import InputError
from arview.geometry import Array, exp_so3, rigid
from arview.measurement.datums.datum_fit import DatumFit, check_fit_covered, fit_datum
from arview.measurement.datums.directions import (
    direction_names,
    observable_directions,
    shift_origin,
)
from arview.measurement.datums.equations import DOF_NAMES, DatumEquations, point_from_move

FORM_MM = 0.005
"""Standard uncertainty of a feature's position by its form: fine machining."""
MEASURED_DEG = 1.15
"""Directions of a datum that were measured, or follow from other axes, are right to within this angle."""


@dataclass(frozen=True)
class DatumResult:
    """How well a datum was measured and met.

    Attributes:
        label, feature: of the datum.
        locked: names of the directions that it locked.
        used: number of offsets that agree.
        of: number of offsets that should have been found.
        residual_mm: robust standard deviation of its offsets from its own best fit.
        correlation: number of neighbouring offsets whose errors are common.
        radius_mm: fitted change of the radius of a hole or pin; None for others.
        rest_mm: rms of its offsets after the alignment; larger than ``residual_mm`` if it contradicts earlier datums.
        covariance: (7,7) contribution of its noise and form to the frame's covariance.
    """

    label: str
    feature: str
    locked: str
    used: int
    of: int
    residual_mm: float
    correlation: float
    radius_mm: float | None
    rest_mm: float
    covariance: Array


@dataclass(frozen=True)
class Alignment:
    """The datum frame of the built part, relative to the rough model frame.

    Attributes:
        origin_in_model: (3,) point about which ``move`` rotates, mm.
        move: (7,) rotation vector (rad), translation (mm) and relative change of scale.
        covariance: (7,7) of ``move``, from noise and form of the datums and from the prior scale.
        scale_covariance: (7,7) contribution of the prior scale.
        datums: results in order of precedence.
        gains: for each datum the (7,N) derivative of ``move`` by its offsets.
        equations: the equations that were solved.
        locks: for each of them the (6,K) motions about the origin that it locked.
        notes: messages about what determined what.
    """

    origin_in_model: Array
    move: Array
    covariance: Array
    scale_covariance: Array
    datums: tuple[DatumResult, ...]
    gains: tuple[Array, ...]
    equations: tuple[DatumEquations, ...]
    locks: tuple[Array, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def rough_from_datum(self) -> Array:
        """(4,4) rigid transform from the datum frame to the rough model frame, without the change of scale."""
        rotation = exp_so3(self.move[:3])
        return rigid(rotation, self.origin_in_model + self.move[3:6] - rotation @ self.origin_in_model)

    def twist_from_move(self, point: Array) -> Array:
        """(6,7) derivative of the twist at a point (3,) of the model by ``move``."""
        arm = point - self.origin_in_model
        return np.concatenate([np.eye(3, 7), point_from_move(arm[None])[0]])


def align(
    datums: Sequence[DatumEquations],
    origin: Array,
    size_mm: float,
    base: DatumEquations | None = None,
    scale_std: float = 0.0,
    finds_scale: bool = False,
) -> Alignment:
    """Solve for the datum frame.

    Args:
        datums: equations in order of precedence; may be empty if there is a base.
        origin: (3,) point about which the move rotates; an error of scale does not move it.
        size_mm: half the diagonal of the base; converts rotations to mm.
        base: best fit of the base, for the directions that the datums leave free.
        scale_std: relative standard deviation of the prior scale.
        finds_scale: whether the distances between holes and pins improve the scale.

    Raises:
        InputError: a datum is not covered or locks nothing new, or a direction remains free; the message names it.
    """
    equations = [*datums, *([] if base is None else [base])]
    starts = np.cumsum([1, *(len(one.offsets_mm) for one in equations)])
    move, gain = np.zeros(7), np.zeros((7, int(starts[-1])))
    gain[6, 0] = 1.0
    variances = np.full(gain.shape[1], scale_std**2)
    free, unit = np.eye(6), np.array([1.0 / size_mm] * 3 + [1.0] * 3)
    found: list[tuple[DatumFit, Array]] = []
    notes: list[str] = []
    holes = 0
    for one, start in zip(equations, starts, strict=False):
        if free.shape[1] == 0:
            break
        is_base = base is not None and one is base
        fit = fit_datum(one, is_base)
        if not is_base:
            check_fit_covered(one, fit)
        rows = one.rows - one.rows[:, 3:6] @ shift_origin(origin)
        allowed = free if is_base else intersection(free.T, np.eye(6)[[name in one.locks for name in DOF_NAMES]]).T
        trusted = np.ones(len(rows)) if one.feature == "fit" else fit.weights
        if one.directions is not None:
            allowed = intersection(allowed.T, one.directions.T, MEASURED_DEG).T
        columns = observable_directions(rows[:, :6] * unit, allowed, trusted) * unit[:, None]
        if columns.shape[1] == 0:
            raise InputError(f"datum {one.label}: all that it could lock is already locked by the datums before it")
        is_round = one.feature in ("hole", "pin", "cylinder")
        with_scale = finds_scale and is_round and holes > 0
        holes += is_round
        columns = np.concatenate([columns, np.zeros((1, columns.shape[1]))])
        if with_scale:
            columns = np.concatenate([columns, np.eye(7)[:, 6:]], axis=1)
        here = slice(start, start + len(rows))
        variances[here] = fit.variances
        solver = _solver(rows @ columns, one, fit, scale_std if with_scale else None)
        change = columns @ solver  # (7,N) of the move by this datum's offsets; the last column is of the prior scale
        own = change[:, : len(rows)]
        before, before_gain, rest = move, gain, one.offsets_mm - rows @ move
        move, gain = move + own @ rest, gain - (own @ rows) @ gain
        gain[:, here] += own
        if with_scale:
            move = move - change[:, -1] * before[6]
            gain = gain - np.outer(change[:, -1], before_gain[6])
            gain[:, 0] += change[:, -1]
        free = orthogonal_complement((columns[:6] / unit[:, None]).T, free.T).T
        found.append((fit, columns[:6]))
        if is_base:
            notes.append(f"{direction_names(columns[:6] / unit[:, None])} by the best fit of {one.label}")
        elif with_scale:
            notes.append(f"scale from the distance of datum {one.label}")
    if free.shape[1]:
        raise InputError(f"the datums leave {direction_names(free)} free, and there is no base to fit; add a datum")
    return _result(origin, move, gain, variances, equations, starts, found, notes=tuple(notes), size_mm=size_mm)


def _result(
    origin: Array,
    move: Array,
    gain: Array,
    variances: Array,
    equations: Sequence[DatumEquations],
    starts: Array,
    found: Sequence[tuple[DatumFit, Array]],
    notes: tuple[str, ...],
    size_mm: float,
) -> Alignment:
    """The alignment with its covariance, and the result of each datum."""
    results, gains = [], []
    unit = np.array([size_mm] * 3 + [1.0] * 3)[:, None]
    scale_covariance = variances[0] * np.outer(gain[:, 0], gain[:, 0])
    covariance = scale_covariance.copy()
    for one, start, (fit, columns) in zip(equations, starts, found, strict=False):
        part = gain[:, start : start + len(one.offsets_mm)]
        share = contribution(part, one, fit)
        rows = one.rows - one.rows[:, 3:6] @ shift_origin(origin)
        rest = one.offsets_mm - rows @ move
        if one.by_radius is not None and fit.radius_mm is not None:
            rest = rest - one.by_radius * fit.radius_mm
        rest_mm = float(np.sqrt(np.average(rest**2, weights=fit.weights)))
        used = int((fit.weights > 0.1 * fit.weights.max()).sum())
        results.append(
            DatumResult(
                one.label,
                one.feature,
                direction_names(columns * unit),
                used,
                one.of,
                fit.sigma_mm,
                fit.correlation,
                radius_mm=fit.radius_mm,
                rest_mm=rest_mm,
                covariance=share,
            )
        )
        gains.append(part)
        covariance = covariance + share
    used_equations = tuple(equations[: len(found)])
    return Alignment(
        origin, move, covariance, scale_covariance, tuple(results), tuple(gains), used_equations,
        locks=tuple(columns for _, columns in found), notes=notes,
    )  # fmt: skip


def contribution(part: Array, one: DatumEquations, fit: DatumFit) -> Array:
    """(R,R) covariance by noise and form of a datum's offsets, of what has the derivative ``part`` (R,N) by them."""
    share = (part * fit.variances) @ part.T
    if one.feature == "fit":
        return np.asarray(share)
    center = one.points.mean(axis=0)
    reach = max(1.0, float(np.sqrt(((one.points - center) ** 2).sum(axis=1).mean())))
    rows = one.rows[:, :6] - one.rows[:, 3:6] @ shift_origin(center)[:, :6]
    common = part @ (rows / np.array([reach] * 3 + [1.0] * 3))
    share = share + (FORM_MM**2 + one.form_mm**2) * common @ common.T
    if one.by_form is not None:
        bent = part @ one.by_form
        share = share + one.form_mm**2 * bent @ bent.T
    return np.asarray(share)


def _solver(design: Array, one: DatumEquations, fit: DatumFit, scale_std: float | None) -> Array:
    """(K,N) matrix that maps offsets to the least-squares directions; (K,N+1) with the prior scale as last value."""
    columns, weights = design.shape[1], fit.weights / fit.weights.max()
    if one.by_radius is not None:
        design = np.concatenate([design, one.by_radius[:, None]], axis=1)
    if scale_std is not None:
        known = np.zeros(design.shape[1])
        known[columns - 1] = 1.0
        design = np.concatenate([design, known[None]])
        variance = float(np.average(fit.variances, weights=weights))
        weights = np.append(weights, variance / max(scale_std, 1e-9) ** 2)
    normal = (design * weights[:, None]).T @ design
    return (np.linalg.pinv(normal, rcond=1e-12, hermitian=True) @ (design * weights[:, None]).T)[:columns]
