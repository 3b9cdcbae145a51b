"""Individuals and moving-range chart (ISO 7870-2), capability (ISO 22514-2) with its confidence interval."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from arview.errors import InputError
from arview.geometry import Array

_D2, _D4 = 1.128, 3.267
"""Of moving ranges of two: mean range over standard deviation; upper limit over mean range (ISO 7870-2, table 2)."""
LEAST_CHART, LEAST_CAPABILITY, ENOUGH = 8, 10, 50
"""Values below which limits and indices are refused, and below which they are given with a warning."""
_SAME_SIDE, _TREND = 8, 6


@dataclass(frozen=True)
class ControlChart:
    """Limits of the values and of their moving ranges, and what is out of the ordinary.

    Attributes:
        values: (N,).
        center, lower, upper: of the values: mean, and ± 3 standard deviations by the mean moving range.
        ranges: (N-1,) differences of neighbours.
        range_center, range_upper: of the ranges.
        signals: index of a value → why; empty when the process is in control.
    """

    values: Array
    center: float
    lower: float
    upper: float
    ranges: Array
    range_center: float
    range_upper: float
    signals: dict[int, str]

    @property
    def is_in_control(self) -> bool:
        """No value is out of the ordinary."""
        return not self.signals


@dataclass(frozen=True)
class Capability:
    """Capability, or performance when the process is not in control (ISO 22514-2 tells them apart by that alone).

    Attributes:
        count, mean, std: of the values; ``std`` is that of the sample.
        lower, upper: limits; one of them may be None.
        cp, cp_interval: None without both limits.
        cpk, cpk_interval: to the nearer limit; intervals are two-sided, 95 %.
        is_in_control: False: the indices are Pp and Ppk.
        measurement_share: of the variance that the measurement itself causes; None when unknown.
        warnings: in words.
    """

    count: int
    mean: float
    std: float
    lower: float | None
    upper: float | None
    cp: float | None
    cp_interval: tuple[float, float] | None
    cpk: float
    cpk_interval: tuple[float, float]
    is_in_control: bool
    measurement_share: float | None
    warnings: tuple[str, ...]

    @property
    def names(self) -> tuple[str, str]:
        """What the indices are called."""
        return ("Cp", "Cpk") if self.is_in_control else ("Pp", "Ppk")


def control_chart(values: ArrayLike, is_length: bool = False) -> ControlChart:
    """Limits from the mean moving range: they do not widen when the process wanders, as its standard deviation would.

    Signals: a value beyond 3 standard deviations, 8 values in a row on one side of the mean, 6 in a row that rise or
    fall (ISO 7870-2; Nelson, J. Quality Technology 16, 1984). A range beyond its limit is none: ranges of neighbours
    share a value and are not normal, every fourth series of 40 good values has one.

    Args:
        values: (N,) in order.
        is_length: they cannot be negative, and neither is the lower limit.

    Raises:
        InputError: fewer than 8 values, or one that is not finite.
    """
    x = _checked(values, LEAST_CHART, "control limits")
    ranges = np.abs(np.diff(x))
    center, mean_range = float(x.mean()), float(ranges.mean())
    reach = 3.0 * mean_range / _D2
    signals: dict[int, str] = {}
    for index in np.flatnonzero(np.abs(x - center) > reach):
        signals[int(index)] = "beyond the control limits"
    _add_runs(signals, np.sign(x - center), _SAME_SIDE, f"{_SAME_SIDE} in a row on one side of the mean")
    # Six points in a row that rise are five steps of one sign.
    steps = np.concatenate([[0.0], np.sign(np.diff(x))])
    _add_runs(signals, steps, _TREND - 1, f"{_TREND} in a row that rise or fall")
    lower = max(0.0, center - reach) if is_length else center - reach
    return ControlChart(
        x, center, lower, center + reach, ranges, mean_range, _D4 * mean_range, dict(sorted(signals.items()))
    )


def capability(
    values: ArrayLike, lower: float | None, upper: float | None, stds: Sequence[float | None] | None = None
) -> Capability:
    """Cp and Cpk by the standard deviation of the sample, with 95 % confidence intervals.

    Interval of Cp by the chi-squared distribution of the variance (exact for normal values); of Cpk by Bissell's
    approximation (Applied Statistics 39, 1990).

    Args:
        values: (N,).
        lower, upper: limits; at least one.
        stds: standard uncertainty of each value's measurement, as far as known.

    Raises:
        InputError: no limit, fewer than 10 values, one that is not finite, or all the same.
    """
    from scipy import stats

    if lower is None and upper is None:
        raise InputError("capability: there is no tolerance; give a limit with --lower or --upper")
    if lower is not None and upper is not None and lower >= upper:
        raise InputError(f"capability: the lower limit {lower:g} is not below the upper one {upper:g}")
    x = _checked(values, LEAST_CAPABILITY, "Cp and Cpk")
    count, mean, std = len(x), float(x.mean()), float(x.std(ddof=1))
    if std < 1e-12:
        raise InputError(f"capability: all {count} values are the same")
    free = count - 1
    cp = cp_interval = None
    if lower is not None and upper is not None:
        cp = (upper - lower) / (6.0 * std)
        low, high = np.sqrt(stats.chi2.ppf([0.025, 0.975], free) / free)
        cp_interval = (float(cp * low), float(cp * high))
    sides = [(upper - mean) / (3.0 * std)] if upper is not None else []
    sides += [(mean - lower) / (3.0 * std)] if lower is not None else []
    cpk = min(sides)
    spread = float(stats.norm.ppf(0.975)) * float(np.sqrt(1.0 / (9.0 * count) + cpk**2 / (2.0 * free)))
    warnings = []
    if count < ENOUGH:
        warnings.append(f"only {count} values: the indices are rough, see their intervals ({ENOUGH} are enough)")
    chart = control_chart(x)
    if not chart.is_in_control:
        warnings.append("the process is not in control: Pp and Ppk say what was, not what will be")
    if float(stats.shapiro(x[:5000]).pvalue) < 0.01:
        warnings.append(
            "the values are not normally distributed (Shapiro–Wilk, 1 %): the indices say little of rejects"
        )
    known = [one for one in stds or () if one is not None]
    share = None
    if known:
        share = min(1.0, float(np.mean(np.square(known))) / std**2)
        if share > 0.3:
            warnings.append(f"{share:.0%} of the variance is of the measurement, not of the parts")
    return Capability(
        count, mean, std, lower, upper, cp, cp_interval, cpk, (cpk - spread, cpk + spread), chart.is_in_control, share,
        tuple(warnings),
    )  # fmt: skip


def _checked(values: ArrayLike, least: int, what: str) -> Array:
    x = np.asarray(values, dtype=np.float64).ravel()
    if not np.isfinite(x).all():
        raise InputError(f"{what}: a value is NaN or infinite")
    if len(x) < least:
        raise InputError(f"{what}: need at least {least} values, there {'is 1' if len(x) == 1 else f'are {len(x)}'}")
    return x


def _add_runs(signals: dict[int, str], signs: Array, length: int, why: str) -> None:
    """Mark the values at which a run of one sign has become long."""
    run, last = 0, 0.0
    for index, sign in enumerate(signs):
        run = run + 1 if sign == last and sign != 0.0 else int(sign != 0.0)
        last = float(sign)
        if run >= length:
            signals.setdefault(index, why)
