"""The measured datum frame: datums lock degrees of freedom in their order of precedence, one linear solver for all.

A datum is a set of offsets, each measured along a normal ``n`` of the nominal surface or edge at a point ``p``. If the
part stands at the move (rotation vector ω, shift t) about an origin ``o``, and is larger by the factor 1 + s, then

    offset = n · (t + ω × (p − o) + s (p − o)).

Each datum solves these equations for those directions of (ω, t) that it determines and that no earlier one has locked:
a plane locks two rotations and a shift, a hole then the two shifts across its axis, a second hole the rotation about
the first (ISO 5459). What the datums leave free the best fit of the base decides. Everything is linear in the offsets;
the whole chain is kept as one matrix, with which every uncertainty of the offsets is carried to the frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.errors import InputError
from arview.geometry import Array, exp_so3, rigid
from arview.measurement.types import Move

DOF_NAMES = ("rx", "ry", "rz", "tx", "ty", "tz")
_TUKEY = 4.685
_MIN_SHARE_OF_SIZE = 0.02
"""A direction is determined by a datum when its points would move by this share of the part's size."""


@dataclass(frozen=True)
class AlignmentOptions:
    """When a datum counts as measured, and what is unknown about its form."""

    min_points: int = 12  # offsets that agree; fewer cannot tell outliers
    min_share: float = 0.3  # of what should be seen of the datum; a rim seen on one side only is no circle
    form_mm: float = 0.005  # standard uncertainty of a feature's place by its form (flatness, chamfer): fine machining
    max_std_mm: float = 0.2  # of any direction that a datum locks; worse is not measured at all


@dataclass(frozen=True)
class Equations:
    """Measured offsets of one datum feature.

    Attributes:
        label: of the datum, as ``B``.
        feature: plane, hole, pin, cylinder, edge, point or fit.
        rows: (N,7) derivative of each offset by ω, t and s about the model's origin: p × n, n, n · p.
        offsets_mm: (N,) measured minus nominal.
        variances: (N,) mm², of independent noise.
        points: (N,3) where, model frame, mm.
        of: how many should have been seen.
        by_radius: (N,) derivative of the offsets by the radius of a hole or pin, which says nothing about its place
            (worn, edge rounded); None of others.
        locks: which of rx ry rz tx ty tz it may lock.
        form_mm: standard uncertainty of its place that residuals do not show, beside that of the options.
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


@dataclass(frozen=True)
class DatumResult:
    """How a datum was met.

    Attributes:
        label, feature: of the datum.
        locked: in words, which directions it decided.
        used, of: offsets that agree, and how many should have been seen.
        residual_mm: robust standard deviation of its own offsets from its own best place.
        correlation: number of neighbouring offsets that err together.
        radius_mm: how much larger a hole or pin looks; None of others.
        rest_mm: rms of its offsets after the alignment: what it contradicts the datums before.
        covariance: (7,7) share of the frame's covariance that its offsets' noise and form make.
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
    """Where the datum frame of the built part is in the rough model frame.

    Attributes:
        origin_in_model: (3,) mm, what ``move`` is about.
        move: (7,) ω in rad, t in mm, s.
        covariance: (7,7) of ``move`` by noise and form of the datums and by the scale known before.
        scale_covariance: (7,7) the share of the scale known before.
        datums: each one's results, in order of precedence.
        gains: for each datum (7,N): derivative of ``move`` by its offsets.
        equations: what was solved.
        notes: in words, what decided what.
    """

    origin_in_model: Array
    move: Array
    covariance: Array
    scale_covariance: Array
    datums: tuple[DatumResult, ...]
    gains: tuple[Array, ...]
    equations: tuple[Equations, ...]
    notes: tuple[str, ...] = ()

    @property
    def rough_from_datum(self) -> Array:
        """(4,4) rigid: nominal places moved to where the datum frame of the built part is; scale left out."""
        rotation = exp_so3(self.move[:3])
        return rigid(rotation, self.origin_in_model + self.move[3:6] - rotation @ self.origin_in_model)

    def twist_from_move(self, point: Array) -> Array:
        """(6,7) derivative of the twist at a point (3,) of the model by ``move``."""
        arm = point - self.origin_in_model
        return np.concatenate([np.eye(3, 7), point_from_move(arm[None])[0]])


def point_from_move(arms: Array) -> Array:
    """(N,3,7) derivative of the shift of points at (N,3) from the origin by a move (ω, t, s): ω × a + t + s a."""
    rows = np.zeros((len(arms), 3, 7))
    x, y, z = arms.T
    rows[:, 0, 1], rows[:, 0, 2] = z, -y
    rows[:, 1, 0], rows[:, 1, 2] = -z, x
    rows[:, 2, 0], rows[:, 2, 1] = y, -x
    rows[:, :, 3:6] = np.eye(3)
    rows[:, :, 6] = arms
    return rows


def surface_equations(
    label: str, feature: str, points: Array, normals: Array, offsets_mm: Array, variances: Array,
    of: int | None = None, by_radius: Array | None = None, locks: tuple[str, ...] = DOF_NAMES,
) -> Equations:  # fmt: skip
    """Equations of offsets (N,) along normals (N,3) at points (N,3) of the model."""
    rows = np.einsum("ni,nij->nj", normals, point_from_move(points))
    count = len(points) if of is None else of
    return Equations(label, feature, rows, offsets_mm, variances, points, count, by_radius, locks)


def move_equations(label: str, move: Move, locks: tuple[str, ...] = DOF_NAMES) -> tuple[Equations, Array]:
    """Equations of a fitted move, of its determined directions alone; also (K,6) that makes offsets of its twist."""
    values, vectors = np.linalg.eigh(_scaled(move.covariance, move.radius_mm))
    kept = values > 1e-12 * max(values[-1], 1e-300)
    unit = np.array([move.radius_mm] * 3 + [1.0] * 3)
    offsets_from_twist = vectors.T[kept] * unit
    at_center = np.concatenate([np.eye(3, 7), point_from_move(move.center_in_model[None])[0]])
    rows = offsets_from_twist @ at_center
    points = np.tile(move.center_in_model, (len(rows), 1))
    offsets = offsets_from_twist @ move.twist
    equations = Equations(label, "fit", rows, offsets, values[kept], points, len(rows), locks=locks)
    return equations, offsets_from_twist


def _scaled(covariance: Array, radius_mm: float) -> Array:
    unit = np.array([radius_mm] * 3 + [1.0] * 3)
    return covariance * np.outer(unit, unit)


def align(
    datums: Sequence[Equations], origin: Array, size_mm: float, base: Equations | None = None,
    scale_std: float = 0.0, finds_scale: bool = False, options: AlignmentOptions | None = None,
) -> Alignment:  # fmt: skip
    """The datum frame.

    Args:
        datums: in order of precedence; may be empty with a base.
        origin: (3,) what the move is about, and the point that an error of scale leaves where it is.
        size_mm: half the diagonal of the base: weighs rotations against shifts.
        base: best fit of the base, for what the datums leave free.
        scale_std: relative standard deviation of the scale known before.
        finds_scale: holes and pins after the first one, with their distances, improve the scale.
        options: thresholds.

    Raises:
        InputError: a datum is not covered, adds nothing, or all together leave a direction free; it is named.
    """
    options = options or AlignmentOptions()
    equations = [*datums, *([] if base is None else [base])]
    starts = np.cumsum([1, *(len(one.offsets_mm) for one in equations)])
    move, gain = np.zeros(7), np.zeros((7, int(starts[-1])))
    gain[6, 0] = 1.0
    variances = np.full(gain.shape[1], scale_std**2)
    free, unit = np.eye(6), np.array([1.0 / size_mm] * 3 + [1.0] * 3)
    found: list[tuple[_Fit, str]] = []
    notes: list[str] = []
    holes = 0
    for one, start in zip(equations, starts, strict=False):
        if free.shape[1] == 0:
            break
        is_base = base is not None and one is base
        fit = _fit_alone(one, is_base)
        if not is_base:
            _check_covered(one, fit, options)
        rows = one.rows - one.rows[:, 3:6] @ _about(origin)
        allowed = free if is_base else _common(free, np.eye(6)[:, [name in one.locks for name in DOF_NAMES]])
        trusted = np.ones(len(rows)) if one.feature == "fit" else fit.weights
        columns = _determined(rows[:, :6] * unit, allowed, trusted) * unit[:, None]
        if columns.shape[1] == 0:
            raise InputError(f"datum {one.label}: locks nothing that the datums before it have not locked already")
        is_round = one.feature in ("hole", "pin", "cylinder")
        with_scale = finds_scale and is_round and holes > 0
        holes += is_round
        columns = np.concatenate([columns, np.zeros((1, columns.shape[1]))])
        if with_scale:
            columns = np.concatenate([columns, np.eye(7)[:, 6:]], axis=1)
        here = slice(start, start + len(rows))
        variances[here] = fit.variances
        solver = _solver(rows @ columns, one, fit, scale_std if with_scale else None)
        change = columns @ solver  # (7,N) of the move by this datum's offsets; the last is the scale known before
        own = change[:, : len(rows)]
        before, before_gain, rest = move, gain, one.offsets_mm - rows @ move
        move = move + own @ rest
        gain = gain - (own @ rows) @ gain
        gain[:, here] += own
        if with_scale:
            move = move - change[:, -1] * before[6]
            gain = gain - np.outer(change[:, -1], before_gain[6])
            gain[:, 0] += change[:, -1]
        free = _without(free, columns[:6] / unit[:, None], unit)
        locked = _named(columns[:6] / unit[:, None])
        found.append((fit, locked))
        if is_base:
            notes.append(f"{locked} by the best fit of {one.label}")
        elif with_scale:
            notes.append(f"scale from the distance of datum {one.label}")
    if free.shape[1]:
        raise InputError(f"the datums leave {_named(free)} free and there is no base to fit; add a datum")
    return _result(origin, move, gain, variances, equations, starts, found, tuple(notes), options, size_mm)


def _result(
    origin: Array, move: Array, gain: Array, variances: Array, equations: Sequence[Equations], starts: Array,
    found: Sequence[tuple[_Fit, str]], notes: tuple[str, ...], options: AlignmentOptions, size_mm: float,
) -> Alignment:  # fmt: skip
    results, gains = [], []
    scale_covariance = variances[0] * np.outer(gain[:, 0], gain[:, 0])
    covariance = scale_covariance.copy()
    for one, start, (fit, locked) in zip(equations, starts, found, strict=False):
        part = gain[:, start : start + len(one.offsets_mm)]
        share = (part * fit.variances) @ part.T
        if one.feature != "fit":
            center = one.points.mean(axis=0)
            reach = max(1.0, float(np.sqrt(((one.points - center) ** 2).sum(axis=1).mean())))
            rows = one.rows[:, :6] - one.rows[:, 3:6] @ _about(center)[:, :6]
            common = part @ (rows / np.array([reach] * 3 + [1.0] * 3))
            share = share + (options.form_mm**2 + one.form_mm**2) * common @ common.T
        rows = one.rows - one.rows[:, 3:6] @ _about(origin)
        rest = one.offsets_mm - rows @ move
        if one.by_radius is not None and fit.radius_mm is not None:
            rest = rest - one.by_radius * fit.radius_mm
        rest_mm = float(np.sqrt(np.average(rest**2, weights=fit.weights)))
        used = int((fit.weights > 0.1 * fit.weights.max()).sum())
        results.append(
            DatumResult(
                one.label, one.feature, locked, used, one.of, fit.sigma_mm, fit.correlation, fit.radius_mm,
                rest_mm, share,
            )
        )  # fmt: skip
        gains.append(part)
        covariance = covariance + share
    used_equations = tuple(equations[: len(found)])
    return Alignment(origin, move, covariance, scale_covariance, tuple(results), tuple(gains), used_equations, notes)


# --- one datum -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Fit:
    """A datum fitted by itself: weights (N,) of its offsets, their effective variances (N,), and more."""

    weights: Array
    variances: Array
    sigma_mm: float
    correlation: float
    radius_mm: float | None
    inliers: NDArray[np.bool_]


def _fit_alone(one: Equations, is_exact: bool) -> _Fit:
    """Robust fit of everything that the offsets determine: their noise, and which are outliers."""
    count = len(one.offsets_mm)
    if is_exact or one.feature == "fit" or count < 7:
        sigma = float(np.sqrt(one.variances.mean())) if count else 0.0
        return _Fit(1.0 / one.variances, one.variances, sigma, 1.0, None, np.ones(count, dtype=bool))
    center = one.points.mean(axis=0)
    local = one.rows[:, :6] - one.rows[:, 3:6] @ _about(center)[:, :6]
    if one.feature in ("hole", "pin"):  # a small circle's tilt is no more than texture
        local = one.rows[:, 3:6]
    if one.by_radius is not None:
        local = np.concatenate([local, one.by_radius[:, None]], axis=1)
    share, residuals = robust_weights(local, one.offsets_mm, one.variances)
    inliers = share > 0.1
    noise = residuals / np.sqrt(one.variances)
    rank = np.linalg.matrix_rank(local.T @ local, tol=1e-9 * float(np.square(local).sum()), hermitian=True)
    freedom = max(1.0, share.sum() - rank)
    # The residuals say how large the noise is; what the method says only how it differs from offset to offset.
    factor = float((share * noise**2).sum() / freedom) if freedom > 20 else max(1.0, float(np.mean(noise**2)))
    correlation = max(
        correlation_factor(one.points[inliers], noise[inliers]),
        block_factor(one.points[inliers], noise[inliers], rank),
    )
    weights = share / one.variances
    radius = None
    if one.by_radius is not None:
        weighted = local * weights[:, None]
        normal = np.linalg.pinv(weighted.T @ local, rcond=1e-12, hermitian=True)
        radius = float((normal @ (weighted.T @ one.offsets_mm))[-1])
    sigma = float(1.4826 * np.median(np.abs(residuals[inliers]))) if inliers.any() else float("inf")
    return _Fit(weights, one.variances * factor * correlation, sigma, correlation, radius, inliers)


def robust_weights(design: Array, values: Array, variances: Array) -> tuple[Array, Array]:
    """Tukey weights (N,) in 0–1 and residuals (N,) of values against a linear model (N,K), by reweighting.

    The scale is the median residual's; the first steps use Cauchy weights, which do not depend on a good start.
    """
    root = 1.0 / np.sqrt(variances)
    share = np.ones(len(values))
    residuals = values
    unit = np.maximum(np.sqrt(np.mean(design**2, axis=0)), 1e-12)
    design = design / unit
    for step in range(40):
        weighted = design * (share * root**2)[:, None]
        normal = np.linalg.pinv(weighted.T @ design, rcond=1e-9, hermitian=True)
        residuals = values - design @ (normal @ (weighted.T @ values))
        noise = residuals * root
        scale = max(1.4826 * float(np.median(np.abs(noise))), 1e-9)
        if step < 10:
            share = 1.0 / (1.0 + (noise / (2.385 * scale)) ** 2)
            continue
        new = np.clip(1.0 - (noise / (_TUKEY * scale)) ** 2, 0.0, None) ** 2
        if np.abs(new - share).max() < 1e-4:
            break
        share = new
    return share, residuals


def correlation_factor(points: Array, residuals: Array, most: int = 600) -> float:
    """How many times larger the variance of a mean of residuals (N,) is because neighbours err together; at least 1.

    1 + the sum of their correlation over all others, from the products of pairs binned by distance, up to the first
    distance at which they are no longer alike.
    """
    count = len(points)
    if count < 20:
        return 1.0
    step = max(1, count // most)
    points, residuals = points[::step], residuals[::step] - residuals.mean()
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    product = np.outer(residuals, residuals) / float(np.mean(residuals**2))
    pairs = np.triu_indices(len(points), 1)
    distance, product = distance[pairs], product[pairs]
    edges = np.linspace(0.0, 0.5 * float(distance.max()) + 1e-9, 13)
    bins = np.digitize(distance, edges) - 1
    factor = 1.0
    for index in range(len(edges) - 1):
        of_bin = product[bins == index]
        if len(of_bin) < 10:
            continue
        correlation = float(of_bin.mean())
        if correlation <= 2.0 / np.sqrt(len(of_bin)):
            break
        factor += correlation * 2.0 * len(of_bin) / len(points) * step
    return factor


def check_covered(one: Equations, options: AlignmentOptions) -> None:
    """Raises InputError, naming the datum, when too little of it was measured to lock anything."""
    _check_covered(one, _fit_alone(one, is_exact=False), options)


def block_factor(points: Array, residuals: Array, rank: int, blocks: int = 12) -> float:
    """The same from the means of residuals (N,) in blocks of neighbours, less what a fit of ``rank`` has taken up.

    It sees errors that are alike over a large part of a feature, which the fit has mostly made its own. Blocks are of
    equal numbers: around a rim by angle, on a face in strips of strips.
    """
    count = len(points)
    if count < 8 * blocks or rank >= blocks - 2:
        return 1.0
    from_middle = points - points.mean(axis=0)
    _, vectors = np.linalg.eigh(from_middle.T @ from_middle)
    x, y = from_middle @ vectors[:, 2], from_middle @ vectors[:, 1]
    if np.std(np.hypot(x, y)) < 0.1 * np.mean(np.hypot(x, y)):
        order = np.argsort(np.arctan2(y, x))
    else:
        strip = np.digitize(x, np.quantile(x, [0.25, 0.5, 0.75]))
        order = np.lexsort((y, strip))
    parts = np.array_split(residuals[order], blocks)
    means = np.array([part.mean() for part in parts])
    between = float(np.sum(means**2)) / (blocks - rank)
    return max(1.0, between * count / blocks / float(np.mean(residuals**2)))


def _check_covered(one: Equations, fit: _Fit, options: AlignmentOptions) -> None:
    used, name = int(fit.inliers.sum()), f"datum {one.label} ({one.feature})"
    if one.feature == "fit":
        return
    least = {"point": 1, "edge": 4}.get(one.feature, options.min_points)
    if used < max(least, round(options.min_share * one.of)):
        raise InputError(
            f"{name}: only {used} of {one.of} points on it could be measured; photograph it from more sides, in better"
            " light, or name another feature in the part file"
        )
    if one.feature in ("hole", "pin") and one.by_radius is not None:  # where its middle is; an arc does not tell it
        local, watched = np.concatenate([one.rows[:, 3:6], one.by_radius[:, None]], axis=1), np.eye(3, 4)
    else:
        local = one.rows[:, :6] - one.rows[:, 3:6] @ _about(one.points.mean(axis=0))[:, :6]
        watched = local[fit.inliers]
        if one.by_radius is not None:
            local = np.concatenate([local, one.by_radius[:, None]], axis=1)
            watched = np.concatenate([watched, np.zeros((len(watched), 1))], axis=1)
    information = (local / fit.variances[:, None] * fit.inliers[:, None]).T @ local
    values, vectors = np.linalg.eigh(information)
    kept = values > 1e-9 * values[-1]
    worst = float(np.sqrt((((watched @ vectors[:, kept]) ** 2) / values[kept]).sum(axis=1).max()))
    if worst > options.max_std_mm:
        raise InputError(
            f"{name}: its place is known to {worst:.2f} mm only; photograph it from more sides, or in better light"
        )


def _solver(design: Array, one: Equations, fit: _Fit, scale_std: float | None) -> Array:
    """(K, N or N+1) that makes of offsets (and of the scale known before) the least-squares directions."""
    columns = design.shape[1]
    weights = fit.weights / fit.weights.max()
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


# --- directions ------------------------------------------------------------------------------------------


def _about(origin: Array) -> Array:
    """(3,7) for rows about the model's origin: subtract n · (o × ω … ) to have them about another."""
    x, y, z = origin
    shift = np.zeros((3, 7))
    shift[:, :3] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    shift[:, 6] = origin
    return shift


def _determined(rows: Array, allowed: Array, weights: Array) -> Array:
    """(6,K) orthonormal directions within ``allowed`` (6,F) that the scaled rows (N,6) determine."""
    if allowed.shape[1] == 0:
        return allowed
    share = weights / weights.sum()
    projected = (rows * np.sqrt(share)[:, None]) @ allowed
    _, values, right = np.linalg.svd(projected, full_matrices=False)
    size = np.sqrt((share[:, None] * rows**2).sum())
    return allowed @ right[values > _MIN_SHARE_OF_SIZE * size].T


def _common(a: Array, b: Array) -> Array:
    """Orthonormal basis of what two subspaces (6,K), (6,L) share."""
    left, values, _ = np.linalg.svd(a.T @ b, full_matrices=False)
    return a @ left[:, values > 1.0 - 1e-9]


def _without(free: Array, columns: Array, unit: Array) -> Array:
    """What of the orthonormal ``free`` (6,F) the scaled directions (6,K) do not hold."""
    columns = columns[:, np.abs(columns).max(axis=0) > 0]
    left, values, _ = np.linalg.svd(free - columns @ (columns.T @ free))
    return left[:, : free.shape[1]][:, values[: free.shape[1]] > 0.5]


def _named(directions: Array) -> str:
    """``rx ry tz`` or, of oblique directions, their number."""
    directions = directions[:, np.abs(directions).max(axis=0) > 0]
    share = (directions**2).sum(axis=1)
    if np.allclose(share.round(2) % 1.0, 0.0, atol=0.02):
        return " ".join(name for name, one in zip(DOF_NAMES, share, strict=True) if one > 0.5)
    return f"{directions.shape[1]} oblique directions"
