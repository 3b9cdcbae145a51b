"""Control charts with Nelson's rules (ISO 7870-2), and capability with confidence intervals (ISO 22514-2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from arview.errors import InputError
from arview.geometry import Array
from arview.quality.history.series import ComponentSeries

MIN_CHART_VALUES = 8
"""Values, or subgroups, needed for control limits."""
MIN_CAPABILITY_VALUES = 10
"""Values needed for capability indices."""
ENOUGH_VALUES = 50
"""With fewer values the indices come with a warning."""
NORMALITY_LEVEL = 0.01
"""Significance level of the Shapiro-Wilk test."""
RIVAL_AIC = 2.0
"""Distributions of lengths whose criterion of Akaike exceeds the best one's by less fit as well."""
FAR_FROM_ZERO = 10.0
"""Mean over standard deviation above which lengths are distributed as if they had no bound at zero."""
MAX_MEASUREMENT_SHARE = 0.3
"""Share of the variance due to the measurement above which there is a warning."""
_MOVING_RANGE_FREEDOM = 0.605
"""Degrees of freedom of a standard deviation from moving ranges, for each range: they overlap, which costs a third."""


@dataclass(frozen=True)
class ControlChart:
    """Control limits of the values or of the means of subgroups, and of their ranges, and the signals.

    Attributes:
        values: (N,) values, or means of subgroups.
        center, lower, upper: mean of the values, and limits at ± 3 of their standard deviations.
        ranges: (N-1,) absolute differences of consecutive values, or (N,) ranges of the subgroups.
        range_center, range_lower, range_upper: mean of the ranges and its limits.
        std: standard deviation of a single value, from the mean range: within the process, without its drift.
        freedom: degrees of freedom of ``std``.
        signals: reasons by index of the value; empty when the process is in control.
        size: values in a subgroup; 1: individual values with moving ranges.
    """

    values: Array
    center: float
    lower: float
    upper: float
    ranges: Array
    range_center: float
    range_lower: float
    range_upper: float
    std: float
    freedom: float
    signals: dict[int, str]
    size: int = 1

    @property
    def is_in_control(self) -> bool:
        """Whether there are no signals."""
        return not self.signals


class CapabilityIndex(NamedTuple):
    """An index with its two-sided 95 % confidence interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Capability:
    """Capability indices, from the standard deviation within the process, and performance indices, from that of all.

    Attributes:
        count, mean, std: number, mean and sample standard deviation of the values.
        lower, upper: tolerance limits; one of them may be None.
        cp, cpk: from the mean range, hence of the process without its drift; ``cp`` is None without both limits, and
            both are None for lengths near zero.
        pp, ppk: from all values; ``pp`` is None without both limits.
        distribution: that the indices assume: normal, Box–Cox (normal after that transform), or one of lengths; they
            are from its percentiles.
        is_in_control: whether the process is in control; if not, Cp and Cpk do not predict it.
        measurement_share: share of the variance that is due to the measurement; None when unknown.
        warnings: doubts about the indices.
    """

    count: int
    mean: float
    std: float
    lower: float | None
    upper: float | None
    cp: CapabilityIndex | None
    cpk: CapabilityIndex | None
    pp: CapabilityIndex | None
    ppk: CapabilityIndex
    is_in_control: bool
    measurement_share: float | None
    warnings: tuple[str, ...]
    distribution: str = "normal"

    @property
    def named(self) -> dict[str, CapabilityIndex]:
        """The indices that there are, by their names."""
        every = {"Cp": self.cp, "Cpk": self.cpk, "Pp": self.pp, "Ppk": self.ppk}
        return {name: index for name, index in every.items() if index is not None}


@cache
def range_factors(size: int) -> tuple[float, float]:
    """Mean and standard deviation of the range of ``size`` standard normal values (d2 and d3), to 1e-5."""
    from scipy import integrate, stats

    heights = np.linspace(0.0, 12.0, 601)
    beyond = stats.studentized_range(size, np.inf).sf(heights)
    mean = float(integrate.simpson(beyond, x=heights))
    square = float(integrate.simpson(2.0 * heights * beyond, x=heights))
    return mean, float(np.sqrt(square - mean**2))


def control_chart(values: ArrayLike, is_length: bool = False, size: int = 1) -> ControlChart:
    """Control limits from the mean range, which, unlike the standard deviation, is insensitive to drift.

    Individual values with their moving ranges, or X̄ and R of consecutive subgroups; an incomplete last subgroup is
    left out. d2 has three decimals, as in the tables of ISO 7870-2. The signals are those of Nelson's eight rules (J.
    Quality Technology 16, 1984), and in subgroups also a range beyond its limits. A moving range beyond its limit is no
    signal: consecutive ones share a value and are not normally distributed, so that such ranges are frequent by chance.

    Args:
        values: (N,) values in their order.
        is_length: whether the values, and thus the lower limit, cannot be negative.
        size: values in a subgroup, 1 to 25.

    Raises:
        InputError: there are fewer than 8 values or subgroups, or one is not finite.
    """
    x = np.asarray(values, dtype=np.float64).ravel()
    points = x if size == 1 else x[: len(x) // size * size].reshape(-1, size).mean(axis=1)
    _check(points, MIN_CHART_VALUES, "control limits", "values" if size == 1 else f"subgroups of {size}")
    ranges = np.abs(np.diff(x)) if size == 1 else np.ptp(x[: len(points) * size].reshape(-1, size), axis=1)
    d2, d3 = range_factors(max(size, 2))
    center, mean_range = float(points.mean()), float(ranges.mean())
    std = mean_range / round(d2, 3)
    reach, spread = 3.0 * std / np.sqrt(size), 3.0 * d3 / d2 * mean_range
    signals = _nelson((points - center) / reach * 3.0) if reach > 1e-12 else {}
    if size > 1:
        beyond = np.flatnonzero(np.abs(ranges - mean_range) > spread)
        signals = dict.fromkeys(beyond.tolist(), "range beyond its limits") | signals
    return ControlChart(
        values=points,
        center=center,
        lower=float(max(0.0, center - reach) if is_length else center - reach),
        upper=float(center + reach),
        ranges=ranges,
        range_center=mean_range,
        range_lower=max(0.0, mean_range - spread),
        range_upper=mean_range + spread,
        std=std,
        freedom=len(ranges) * (_MOVING_RANGE_FREEDOM if size == 1 else d2**2 / (2.0 * d3**2)),
        signals=dict(sorted(signals.items())),
        size=size,
    )


def _nelson(z: Array) -> dict[int, str]:
    """The values at which one of Nelson's rules is broken, each with the first such rule.

    Args:
        z: (N,) differences from the mean in standard deviations.
    """
    steps = np.sign(np.diff(z, prepend=z[:1]))
    swings = steps * np.concatenate([[0.0], steps[:-1]]) < 0.0
    signals: dict[int, str] = {}
    # Six values that rise are five steps; fourteen values that alternate have twelve changes of direction.
    for masks, window, needed, rule in (
        ((np.abs(z) > 3.0,), 1, 1, "beyond the control limits (rule 1)"),
        ((z > 0.0, z < 0.0), 9, 9, "9 in a row on one side of the mean (rule 2)"),
        ((steps > 0.0, steps < 0.0), 5, 5, "6 in a row that rise or fall (rule 3)"),
        ((swings,), 12, 12, "14 in a row that alternate up and down (rule 4)"),
        ((z > 2.0, z < -2.0), 3, 2, "2 of 3 beyond 2 standard deviations on one side (rule 5)"),
        ((z > 1.0, z < -1.0), 5, 4, "4 of 5 beyond 1 standard deviation on one side (rule 6)"),
        ((np.abs(z) < 1.0,), 15, 15, "15 in a row within 1 standard deviation (rule 7)"),
        ((np.abs(z) > 1.0,), 8, 8, "8 in a row beyond 1 standard deviation on either side (rule 8)"),
    ):
        for mask in masks:
            counts = np.convolve(mask, np.ones(window, dtype=int))[: len(z)]
            for index in np.flatnonzero(mask & (counts >= needed)).tolist():
                signals.setdefault(index, rule)
    return signals


def capability(
    values: ArrayLike,
    lower: float | None,
    upper: float | None,
    stds: Sequence[float | None] | None = None,
    is_length: bool = False,
    size: int = 1,
) -> Capability:
    """Cp, Cpk, Pp and Ppk with 95 % confidence intervals.

    Pp and Ppk compare the limits with the mean and 3 sample standard deviations; Cp and Cpk take the standard deviation
    from the mean range of the chart. Positive values that the Shapiro–Wilk test rejects as normal (1 %) are compared by
    the percentiles that normal ones have there (ISO 22514-2), after Box and Cox's power if the test accepts that.
    Lengths are bounded by zero: near it they have Ppk alone, from the median and the 0.135 % and 99.865 % percentiles
    of the distribution of the length of a normal vector (`_length_percentiles`). The interval of Cp follows
    from the chi-squared distribution of the variance, that of Cpk from Bissell's approximation (Applied Statistics 39,
    1990).

    Args:
        values: (N,) values in their order.
        lower, upper: tolerance limits, of which at least one is needed.
        stds: standard uncertainties of the measurements, as far as they are known.
        is_length: whether the values cannot be negative.
        size: values in a subgroup of the chart.

    Raises:
        InputError: there is no limit, there are fewer than 10 values or 8 subgroups, one is not finite, or all are
            equal.
    """
    if lower is None and upper is None:
        raise InputError("capability: there is no tolerance; give a limit with --lower or --upper")
    if lower is not None and upper is not None and lower >= upper:
        raise InputError(f"capability: the lower limit {lower:g} is not less than the upper one {upper:g}")
    x = np.asarray(values, dtype=np.float64).ravel()
    _check(x, MIN_CAPABILITY_VALUES, "Cp and Cpk")
    mean, std = float(x.mean()), float(x.std(ddof=1))
    if std < 1e-12:
        raise InputError(f"capability: all {len(x)} values are equal")
    signals = control_chart(x, size=size).signals
    cp = cpk = None
    if is_length and mean < FAR_FROM_ZERO * std:
        percentiles, scores, distribution = _length_percentiles(x, upper)
        pp, ppk = _indices(np.array(percentiles), (lower, upper), len(x), len(x) - 1)
    else:
        scores, inverse, distribution = _normalised(x)
        within = control_chart(scores, size=size)
        reach = np.array([-3.0, 0.0, 3.0])
        pp, ppk = _indices(inverse(scores.mean() + reach * scores.std(ddof=1)), (lower, upper), len(x), len(x) - 1)
        if within.std > 1e-12:
            ends = inverse(scores.mean() + reach * within.std)
            cp, cpk = _indices(ends, (lower, upper), len(x), within.freedom)
    known = [value for value in stds or () if value is not None]
    share = min(1.0, float(np.mean(np.square(known))) / std**2) if known else None
    warnings = _doubts(scores, distribution, len(signals), size)
    if share is not None and share > MAX_MEASUREMENT_SHARE:
        warnings.append(f"{share:.0%} of the variance is due to the measurement, not to the parts")
    return Capability(
        count=len(x),
        mean=mean,
        std=std,
        lower=lower,
        upper=upper,
        cp=cp,
        cpk=cpk,
        pp=pp,
        ppk=ppk,
        is_in_control=not signals,
        measurement_share=share,
        warnings=tuple(warnings),
        distribution=distribution,
    )


def _doubts(scores: Array, distribution: str, signals: int, size: int) -> list[str]:
    """Doubts about indices that assume that the scores are normal and the process is in control."""
    warnings = []
    if len(scores) < ENOUGH_VALUES:
        enough = ENOUGH_VALUES
        warnings.append(f"only {len(scores)} values: the indices are rough, see their intervals ({enough} are enough)")
    if signals:
        warnings.append(
            f"the process is not in control ({signals} of {len(scores) // size} values are signals): Pp and Ppk"
            " describe the past, Cp and Cpk do not predict the future"
        )
    if not _is_normal(scores):
        warnings.append(
            f"the values do not follow the {distribution} distribution (Shapiro–Wilk, 1 %): the indices do not predict"
            " reject rates"
        )
    return warnings


def _indices(
    ends: Array, limits: tuple[float | None, float | None], count: int, freedom: float
) -> tuple[CapabilityIndex | None, CapabilityIndex]:
    """The index of the width of both limits, and that of the nearer limit.

    Args:
        ends: (3,) percentiles 0.135, 50 and 99.865 %; the last one may be NaN: a power without that end.
        limits: lower and upper.
        count: number of values.
        freedom: degrees of freedom of the standard deviation.
    """
    from scipy import stats

    (low_end, middle, high_end), (lower, upper) = np.nan_to_num(ends, nan=np.inf).tolist(), limits
    sides = [(upper - middle) / (high_end - middle)] if upper is not None else []
    sides += [(middle - lower) / (middle - low_end)] if lower is not None else []
    nearer = min(sides)
    spread = float(stats.norm.ppf(0.975) * np.sqrt(1.0 / (9.0 * count) + nearer**2 / (2.0 * freedom)))
    whole = None
    if lower is not None and upper is not None:
        width = (upper - lower) / (high_end - low_end)
        low, high = width * np.sqrt(stats.chi2.ppf([0.025, 0.975], freedom) / freedom)
        whole = CapabilityIndex(width, float(low), float(high))
    return whole, CapabilityIndex(nearer, nearer - spread, nearer + spread)


def _normalised(x: Array) -> tuple[Array, Callable[[Array], Array], str]:
    """Normal scores of the values with their inverse: the values, or Box and Cox's power of those that are not normal.

    The power is taken only if the scores are normal then.
    """
    from scipy import special, stats

    if x.min() > 0.0 and not _is_normal(x):
        made, power = stats.boxcox(x)
        if _is_normal(made):
            return made, lambda scores: special.inv_boxcox(scores, power), "Box–Cox"
    return x, np.asarray, "normal"


def _is_normal(scores: Array) -> bool:
    from scipy import stats

    return float(stats.shapiro(scores[:5000]).pvalue) >= NORMALITY_LEVEL


def capability_by_limits(
    series: ComponentSeries, size: int = 1
) -> dict[tuple[float | None, float | None], Capability | InputError]:
    """The indices of the values of each pair of limits, so that each value is judged by the limits that held for it.

    Where the indices cannot be given, the reason stands in their place.
    """
    found: dict[tuple[float | None, float | None], Capability | InputError] = {}
    for (lower, upper), values in series.by_limits().items():
        try:
            absent = sum((one.lower, one.upper) == (lower, upper) for one in series.missing)
            if absent:
                raise InputError(
                    f"capability: the component is missing on {absent} of {absent + len(values)} parts: an index of the"
                    " others would look better than the process is"
                )
            x, stds = [one.value for one in values], [one.std for one in values]
            found[lower, upper] = capability(x, lower, upper, stds, series.is_length, size)
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


def _check(x: Array, minimum: int, what: str, of: str = "values") -> None:
    if not np.isfinite(x).all():
        raise InputError(f"{what}: a value is NaN or infinite")
    if len(x) < minimum:
        raise InputError(f"{what}: need at least {minimum} {of}, there {'is 1' if len(x) == 1 else f'are {len(x)}'}")
