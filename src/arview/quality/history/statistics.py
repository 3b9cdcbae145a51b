"""Individuals and moving-range charts (ISO 7870-2), and capability with confidence intervals (ISO 22514-2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from arview.errors import InputError
from arview.geometry import Array
from arview.quality.history.series import ComponentSeries

_D2, _D4 = 1.128, 3.267
"""Factors of moving ranges of two: mean range over standard deviation; upper limit over mean range (ISO 7870-2)."""


MIN_CHART_VALUES = 8
"""Values needed for control limits."""
MIN_CAPABILITY_VALUES = 10
"""Values needed for capability indices."""
ENOUGH_VALUES = 50
"""With fewer values the indices come with a warning."""
SAME_SIDE_RUN = 8
"""Consecutive values on one side of the mean that are a signal."""
TREND_RUN = 6
"""Consecutive rising or falling values that are a signal."""
NORMALITY_LEVEL = 0.01
"""Significance level of the Shapiro-Wilk test."""
RIVAL_AIC = 2.0
"""Distributions of lengths whose criterion of Akaike exceeds the best one's by less fit as well."""
FAR_FROM_ZERO = 10.0
"""Mean over standard deviation above which lengths are distributed as if they had no bound at zero."""
MAX_MEASUREMENT_SHARE = 0.3
"""Share of the variance due to the measurement above which there is a warning."""


@dataclass(frozen=True)
class ControlChart:
    """Control limits of the values and of their moving ranges, and the signals.

    Attributes:
        values: (N,) values.
        center, lower, upper: mean of the values, and limits at ± 3 standard deviations from the mean moving range.
        ranges: (N-1,) absolute differences of consecutive values.
        range_center, range_upper: mean and upper limit of the ranges.
        signals: reasons by index of the value; empty when the process is in control.
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
        """Whether there are no signals."""
        return not self.signals


@dataclass(frozen=True)
class Capability:
    """Capability indices, or performance indices when the process is not in control (ISO 22514-2).

    Attributes:
        count, mean, std: number, mean and sample standard deviation of the values.
        lower, upper: tolerance limits; one of them may be None.
        cp, cp_interval: Cp and its two-sided 95 % confidence interval; None without both limits.
        cpk, cpk_interval: Cpk, with the nearer limit, and its two-sided 95 % confidence interval.
        distribution: whose percentiles the indices are from.
        is_in_control: whether the process is in control; if not, the indices are Pp and Ppk.
        measurement_share: share of the variance that is due to the measurement; None when unknown.
        warnings: doubts about the indices.
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
    distribution: str = "normal"

    @property
    def names(self) -> tuple[str, str]:
        """Names of the indices."""
        return ("Cp", "Cpk") if self.is_in_control else ("Pp", "Ppk")


def control_chart(values: ArrayLike, is_length: bool = False) -> ControlChart:
    """Control limits from the mean moving range, which, unlike the standard deviation, is insensitive to drift.

    Signals are a value beyond 3 standard deviations, 8 consecutive values on one side of the mean, and 6 consecutive
    rising or falling values (ISO 7870-2; Nelson, J. Quality Technology 16, 1984). A range beyond its limit is no
    signal: consecutive ranges share a value and are not normally distributed, so such ranges are frequent by chance.

    Args:
        values: (N,) values in their order.
        is_length: whether the values, and thus the lower limit, cannot be negative.

    Raises:
        InputError: there are fewer than 8 values, or one is not finite.
    """
    x = _checked(values, MIN_CHART_VALUES, "control limits")
    ranges = np.abs(np.diff(x))
    center, mean_range = float(x.mean()), float(ranges.mean())
    reach = 3.0 * mean_range / _D2
    signals: dict[int, str] = {}
    for index in np.flatnonzero(np.abs(x - center) > reach):
        signals[int(index)] = "beyond the control limits"
    run = SAME_SIDE_RUN
    _add_runs(signals, np.sign(x - center), run, f"{run} in a row on one side of the mean")
    # Six points in a row that rise are five steps of one sign.
    steps = np.concatenate([[0.0], np.sign(np.diff(x))])
    _add_runs(signals, steps, TREND_RUN - 1, f"{TREND_RUN} in a row that rise or fall")
    lower = max(0.0, center - reach) if is_length else center - reach
    return ControlChart(
        x,
        center,
        lower,
        upper=center + reach,
        ranges=ranges,
        range_center=mean_range,
        range_upper=_D4 * mean_range,
        signals=dict(sorted(signals.items())),
    )


def capability(
    values: ArrayLike,
    lower: float | None,
    upper: float | None,
    stds: Sequence[float | None] | None = None,
    is_length: bool = False,
) -> Capability:
    """Cp and Cpk by percentiles (ISO 22514-2), with 95 % confidence intervals.

    The limits are compared with the median and with the percentiles 0.135 % and 99.865 %, which for normal values are 3
    sample standard deviations from the mean. Lengths are bounded by zero: theirs are of the distribution of the length
    of a normal vector (`_length_percentiles`). The interval of Cp follows from the chi-squared distribution of the
    variance (exact for normal values), that of Cpk from Bissell's approximation (Applied Statistics 39, 1990).

    Args:
        values: (N,) values.
        lower, upper: tolerance limits, of which at least one is needed.
        stds: standard uncertainties of the measurements, as far as they are known.
        is_length: whether the values cannot be negative.

    Raises:
        InputError: there is no limit, there are fewer than 10 values, one is not finite, or all are equal.
    """
    from scipy import stats

    if lower is None and upper is None:
        raise InputError("capability: there is no tolerance; give a limit with --lower or --upper")
    if lower is not None and upper is not None and lower >= upper:
        raise InputError(f"capability: the lower limit {lower:g} is not less than the upper one {upper:g}")
    x = _checked(values, MIN_CAPABILITY_VALUES, "Cp and Cpk")
    count, mean, std = len(x), float(x.mean()), float(x.std(ddof=1))
    if std < 1e-12:
        raise InputError(f"capability: all {count} values are equal")
    free = count - 1
    (low_end, middle, high_end), scores, distribution = (mean - 3.0 * std, mean, mean + 3.0 * std), x, "normal"
    if is_length and mean < FAR_FROM_ZERO * std:
        (low_end, middle, high_end), scores, distribution = _length_percentiles(x, upper)
    cp = cp_interval = None
    if lower is not None and upper is not None:
        cp = (upper - lower) / (high_end - low_end)
        low, high = np.sqrt(stats.chi2.ppf([0.025, 0.975], free) / free)
        cp_interval = (float(cp * low), float(cp * high))
    sides = [(upper - middle) / (high_end - middle)] if upper is not None else []
    sides += [(middle - lower) / (middle - low_end)] if lower is not None else []
    cpk = min(sides)
    spread = float(stats.norm.ppf(0.975)) * float(np.sqrt(1.0 / (9.0 * count) + cpk**2 / (2.0 * free)))
    warnings = []
    if count < ENOUGH_VALUES:
        enough = ENOUGH_VALUES
        warnings.append(f"only {count} values: the indices are rough, see their intervals ({enough} are enough)")
    chart = control_chart(x)
    if not chart.is_in_control:
        warnings.append("the process is not in control: Pp and Ppk describe the past, not the future")
    if float(stats.shapiro(scores[:5000]).pvalue) < NORMALITY_LEVEL:
        warnings.append(
            f"the values do not follow the {distribution} distribution (Shapiro–Wilk, 1 %): the indices do not predict"
            " reject rates"
        )
    known = [one for one in stds or () if one is not None]
    share = None
    if known:
        share = min(1.0, float(np.mean(np.square(known))) / std**2)
        if share > MAX_MEASUREMENT_SHARE:
            warnings.append(f"{share:.0%} of the variance is due to the measurement, not to the parts")
    return Capability(
        count,
        mean,
        std,
        lower=lower,
        upper=upper,
        cp=cp,
        cp_interval=cp_interval,
        cpk=cpk,
        cpk_interval=(cpk - spread, cpk + spread),
        is_in_control=chart.is_in_control,
        measurement_share=share,
        warnings=tuple(warnings),
        distribution=distribution,
    )


def capability_by_limits(series: ComponentSeries) -> dict[tuple[float | None, float | None], Capability | InputError]:
    """Cp and Cpk of the values of each pair of limits, so that each value is judged by the limits that held for it.

    Where the indices cannot be given, the reason stands in their place.
    """
    found: dict[tuple[float | None, float | None], Capability | InputError] = {}
    for (lower, upper), values in series.by_limits().items():
        try:
            stds = [one.std for one in values]
            absent = sum((one.lower, one.upper) == (lower, upper) for one in series.missing)
            if absent:
                raise InputError(
                    f"capability: the component is missing on {absent} of {absent + len(values)} parts: an index of the"
                    " others would look better than the process is"
                )
            found[lower, upper] = capability([one.value for one in values], lower, upper, stds, series.is_length)
        except InputError as error:
            found[lower, upper] = error
    return found


def _length_percentiles(x: Array, upper: float | None) -> tuple[tuple[float, float, float], Array, str]:
    """Percentiles 0.135, 50 and 99.865 % of lengths, their normal scores, and the name of the distribution.

    The length of a vector of 1, 2 or 3 normal components of equal variance follows a noncentral chi distribution: about
    zero the half-normal, Rayleigh and Maxwell distributions, about a common offset the folded normal and Rice's. A few
    dozen values rarely tell these apart, so that of all that fit nearly as well as the best (Akaike 1974) the one with
    the least favourable index counts.
    """
    from scipy import optimize, stats

    squares = np.maximum(x, 1e-6 * x.mean()) ** 2

    def misfit(freedom: int, offset: float) -> float:
        """Negative log-likelihood; the scale follows from the mean square."""
        scale = squares.mean() / (freedom + offset)
        return -float(
            np.sum(np.log(2.0 * np.sqrt(squares) / scale) + stats.ncx2.logpdf(squares / scale, freedom, offset))
        )

    fits = []
    for freedom, central, shifted in (
        (1, "half-normal", "folded normal"),
        (2, "Rayleigh", "Rice"),
        (3, "Maxwell", "noncentral Maxwell"),
    ):
        fits.append((2.0 + 2.0 * misfit(freedom, 0.0), freedom, 0.0, central))
        best = optimize.minimize_scalar(
            lambda t, f=freedom: misfit(f, float(np.exp(t))), bounds=(-4.0, 7.0), method="bounded"
        )
        fits.append((4.0 + 2.0 * float(best.fun), freedom, float(np.exp(best.x)), shifted))
    least = min(fit[0] for fit in fits)
    found = []
    for criterion, freedom, offset, name in fits:
        if not criterion <= least + RIVAL_AIC:
            continue
        scale = squares.mean() / (freedom + offset)
        low, middle, high = np.sqrt(scale * stats.ncx2.ppf([0.00135, 0.5, 0.99865], freedom, offset)).tolist()
        index = np.inf if upper is None else (upper - middle) / (high - middle)
        shares = np.clip(stats.ncx2.cdf(squares / scale, freedom, offset), 1e-12, 1.0 - 1e-12)
        found.append((index, criterion, (low, middle, high), stats.norm.ppf(shares), name))
    _, _, percentiles, scores, name = min(found, key=lambda one: one[:2])
    return percentiles, scores, name


def _checked(values: ArrayLike, minimum: int, what: str) -> Array:
    x = np.asarray(values, dtype=np.float64).ravel()
    if not np.isfinite(x).all():
        raise InputError(f"{what}: a value is NaN or infinite")
    if len(x) < minimum:
        raise InputError(f"{what}: need at least {minimum} values, there {'is 1' if len(x) == 1 else f'are {len(x)}'}")
    return x


def _add_runs(signals: dict[int, str], signs: Array, length: int, reason: str) -> None:
    """Add the values at which a run of one sign has reached a length."""
    count, last = 0, 0.0
    for index, sign in enumerate(signs):
        count = count + 1 if sign == last and sign != 0.0 else int(sign != 0.0)
        last = float(sign)
        if count >= length:
            signals.setdefault(index, reason)
