"""Control charts, Nelson's rules and capability: examples of the NIST handbook, and values worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special, stats

from arview.errors import InputError
from arview.quality.history import capability, control_chart
from arview.quality.history.statistics import _nelson, range_factors

NIST = [49.6, 47.6, 49.9, 51.3, 47.8, 51.2, 52.6, 52.4, 53.6, 52.1]
"""NIST/SEMATECH e-Handbook 6.3.2.2: mean 50.81, mean range 1.8778, limits 45.8159 and 55.8041."""


def test_control_limits_of_the_nist_handbook() -> None:
    """All digits that 6.3.2.2 prints; the limit of the range is 3.267 times its mean."""
    chart = control_chart(NIST)
    assert f"{chart.center:.2f} {chart.range_center:.4f}" == "50.81 1.8778"
    assert f"{chart.lower:.4f} {chart.upper:.4f}" == "45.8159 55.8041"
    assert chart.range_upper == pytest.approx(3.267 * 1.8778, abs=1e-3)
    assert (chart.range_lower, chart.is_in_control, chart.size) == (0.0, True, 1)
    assert control_chart(np.abs(np.random.default_rng(0).normal(size=30)), is_length=True).lower == 0.0


def test_factors_of_ranges_are_those_of_the_nist_handbook() -> None:
    """d2, D3 and D4 of the table in 6.3.2.1 for subgroups of 2 to 10."""
    printed = {
        2: (1.128, 0.0, 3.267), 3: (1.693, 0.0, 2.574), 4: (2.059, 0.0, 2.282), 5: (2.326, 0.0, 2.114),
        6: (2.534, 0.0, 2.004), 7: (2.704, 0.076, 1.924), 8: (2.847, 0.136, 1.864), 9: (2.970, 0.184, 1.816),
        10: (3.078, 0.223, 1.777),
    }  # fmt: skip
    for size, (mean, low, high) in printed.items():
        d2, d3 = range_factors(size)
        assert d2 == pytest.approx(mean, abs=6e-4), size
        assert max(0.0, 1.0 - 3.0 * d3 / d2) == pytest.approx(low, abs=6e-4), size
        assert 1.0 + 3.0 * d3 / d2 == pytest.approx(high, abs=6e-4), size


def test_subgroups_by_hand() -> None:
    """Eight subgroups of two: means 1 and 2 by turns, ranges 2 and 4, hence R̄ 3, σ 3 / 1.128 and limits ± 3 σ / √2."""
    chart = control_chart([0.0, 2.0, 4.0, 0.0] * 4, size=2)
    assert chart.values.tolist() == [1.0, 2.0] * 4
    assert chart.ranges.tolist() == [2.0, 4.0] * 4
    assert (chart.center, chart.range_center) == (1.5, 3.0)
    assert chart.std == pytest.approx(3.0 / 1.128)
    assert (chart.lower, chart.upper) == pytest.approx((1.5 - 5.6418, 1.5 + 5.6418), abs=1e-4)
    assert chart.range_upper == pytest.approx(9.800, abs=1e-3)  # D4 = 3.2665
    assert control_chart([0.0, 2.0, 4.0, 0.0] * 4 + [9.0], size=2).values.tolist() == chart.values.tolist()
    wide = control_chart([0.0, 1.0] * 9 + [-4.0, 5.0], size=2)
    assert wide.signals[9] == "range beyond its limits"
    with pytest.raises(InputError, match="need at least 8 subgroups of 4, there are 7"):
        control_chart(np.arange(31.0), size=4)


RULES = {
    1: [0.2, -0.3, 0.4, -0.2, 3.1],
    2: [0.5, 0.2, 0.6, 0.1, 0.7, 0.3, 0.5, 0.2, 0.6],
    3: [-0.9, -0.5, -0.2, 0.1, 0.4, 0.8],
    4: [0.5, -0.5] * 7,
    5: [2.3, -0.2, 2.4],
    6: [1.2, 1.5, -0.3, 1.1, 1.4],
    7: [0.3, 0.5, -0.2, -0.4, 0.1, 0.6, -0.3, -0.1, 0.4, 0.2, -0.5, -0.2, 0.3, 0.1, -0.4],
    8: [1.3, -1.2, 1.4, -1.5, -1.1, 1.2, 1.6, -1.3],
}
"""For each of Nelson's rules values in standard deviations of which the last one breaks it, and no other rule."""


@pytest.mark.parametrize("rule", RULES)
def test_a_series_that_breaks_one_rule_only(rule: int) -> None:
    z = np.array(RULES[rule])
    for sign in (1.0, -1.0):
        (signal,) = _nelson(sign * z).items()
        assert signal[0] == len(z) - 1
        assert signal[1].endswith(f"(rule {rule})")
        assert _nelson(sign * z[:-1]) == {}
        assert rule == 1 or _nelson(sign * z[1:]) == {}  # a run that is shorter by its first value


def test_signals_of_a_chart() -> None:
    calm = np.random.default_rng(7).normal(0.0, 1.0, 40)
    out = calm.copy()
    out[20] = 6.0
    assert control_chart(out).signals[20] == "beyond the control limits (rule 1)"
    shifted = np.concatenate([calm[:20], calm[20:] + 1.6])
    assert any("one side of the mean" in why for why in control_chart(shifted).signals.values())
    assert control_chart([1.0] * 20).is_in_control


def test_rate_of_false_alarms() -> None:
    """0.27 % of the values are beyond three standard deviations; limits from 100 values increase this slightly."""
    rng = np.random.default_rng(1)
    charts = [control_chart(rng.normal(size=100)).signals for _ in range(400)]
    beyond = [sum("(rule 1)" in why for why in signals.values()) for signals in charts]
    assert 0.002 < np.mean(beyond) / 100 < 0.006
    assert 0.01 < np.mean([len(signals) for signals in charts]) / 100 < 0.04  # by all eight rules


def test_capability_of_the_nist_handbook() -> None:
    """6.1.6: limits 8 and 20, mean 16, standard deviation 2: 1.0 and 0.6667 for the nearer limit."""
    x = stats.norm.ppf((np.arange(100) + 0.5) / 100)
    x = np.random.default_rng(0).permutation(16.0 + 2.0 * (x - x.mean()) / x.std(ddof=1))
    ability = capability(x, 8.0, 20.0)
    assert ability.pp is not None
    assert f"{ability.pp.value:.1f} {ability.ppk.value:.4f}" == "1.0 0.6667"
    assert f"{capability(x, None, 20.0).ppk.value:.4f} {capability(x, 8.0, None).ppk.value:.4f}" == "0.6667 1.3333"
    # The interval that 6.1.6 gives for Cpk: ± 1.96 √(1 / 9 N + Cpk² / 2 (N - 1)).
    spread = 1.959964 * np.sqrt(1.0 / 900.0 + 0.6667**2 / 198.0)
    assert ability.ppk[1:] == pytest.approx((0.6667 - spread, 0.6667 + spread), abs=1e-4)


def test_capability_by_hand() -> None:
    """Values 0 and 0.1 by turns: every moving range is 0.1, so σ within is 0.1 / 1.128; s is 0.05 √(20 / 19)."""
    ability = capability(np.array([0.0, 0.1] * 10), -0.5, 0.6)
    std, within = 0.05 * np.sqrt(20 / 19), 0.1 / 1.128
    assert ability.std == pytest.approx(std)
    assert ability.pp is not None and ability.cp is not None and ability.cpk is not None
    assert (ability.pp.value, ability.ppk.value) == pytest.approx((1.1 / (6 * std), 0.55 / (3 * std)))
    assert (ability.cp.value, ability.cpk.value) == pytest.approx((1.1 / (6 * within), 0.55 / (3 * within)))
    assert list(ability.named) == ["Cp", "Cpk", "Pp", "Ppk"]
    one_sided = capability(np.array([0.0, 0.1] * 10), None, 0.35)
    assert list(one_sided.named) == ["Cpk", "Ppk"]
    assert one_sided.ppk.value == pytest.approx(0.3 / (3 * std))
    assert any("only 20 values" in warning for warning in ability.warnings)


@pytest.mark.parametrize(("count", "size"), [(20, 1), (100, 1), (100, 5)])
def test_coverage_of_the_intervals(count: int, size: int) -> None:
    """Cp = Pp = 1.5 and Cpk = Ppk = 1.2 of a normal process: 95 % of the intervals should contain them."""
    rng = np.random.default_rng(count)
    held = np.zeros(4)
    for _ in range(600):
        named = capability(rng.normal(0.9, 1.0, count), -4.5, 4.5, size=size).named
        if len(named) == 4:
            held += [index.low <= truth <= index.high
                     for index, truth in zip(named.values(), (1.5, 1.2, 1.5, 1.2), strict=True)]  # fmt: skip
    assert (held / 600 > 0.92).all(), held / 600
    assert (held / 600 < 0.985).all(), held / 600


def test_box_cox() -> None:
    """Log-normal, μ = 1, σ = 0.5: median e, 99.865 % below e^2.5 = 12.182, Ppk (20 - e) / (12.182 - e) = 1.826."""
    x = np.random.default_rng(4).lognormal(1.0, 0.5, 400)
    ability = capability(x, None, 20.0)
    assert ability.distribution == "Box–Cox"
    assert ability.ppk.low < 1.826 < ability.ppk.high
    made, power = stats.boxcox(x)
    middle, end = special.inv_boxcox(made.mean() + np.array([0.0, 3.0]) * made.std(ddof=1), power)
    assert ability.ppk.value == pytest.approx((20.0 - middle) / (end - middle))
    assert (20.0 - x.mean()) / (3.0 * x.std(ddof=1)) > 1.4 * ability.ppk.value  # what a normal distribution would claim
    assert ability.cpk is not None
    outlier = capability([*np.random.default_rng(0).normal(0.1, 0.03, 60), 0.55], -0.5, 0.5)
    assert outlier.distribution == "normal" and outlier.ppk.value < 2.1
    assert any("do not follow the normal" in warning for warning in outlier.warnings)
    two_heaps = np.concatenate([np.full(50, 1.0), np.full(50, 2.0)]) + 0.001 * np.random.default_rng(0).normal(size=100)
    kept = capability(two_heaps, 0.0, 3.0)
    assert kept.distribution == "normal"
    assert any("do not follow the normal" in warning for warning in kept.warnings)


@pytest.mark.parametrize(("freedom", "offset"), [(1, 0.0), (2, 0.0), (3, 0.0), (1, 0.25), (2, 0.25)])
def test_the_index_of_lengths_is_by_their_percentiles(freedom: int, offset: float) -> None:
    """Lengths of normal vectors of 0.12 mm, or 0.06 mm about an offset: ISO 22514-2 with true percentiles."""
    rng = np.random.default_rng(freedom)
    std = 0.06 if offset else 0.12
    _, middle, high = std * np.sqrt(stats.ncx2.ppf([0.00135, 0.5, 0.99865], freedom, (offset / std) ** 2))
    index = (0.5 - middle) / (high - middle)
    found, normal, held = [], [], 0
    for _ in range(30):
        values = np.linalg.norm(rng.normal(0.0, std, (100, freedom)) + [offset, 0.0, 0.0][:freedom], axis=1)
        ability = capability(values, None, 0.5, is_length=True)
        assert ability.distribution != "normal"
        assert list(ability.named) == ["Ppk"]
        held += ability.ppk.low < index < ability.ppk.high
        found.append(ability.ppk.value)
        normal.append((0.5 - values.mean()) / (3.0 * values.std(ddof=1)))
    assert np.median(found) == pytest.approx(index, rel=0.08)
    assert held >= 24
    if not offset:
        assert np.median(normal) > 1.15 * index  # what a normal distribution would claim


def test_lengths_far_from_zero_and_zeros() -> None:
    values = np.random.default_rng(0).normal(2.0, 0.05, 60)
    assert capability(values, None, 2.5, is_length=True).ppk == capability(values, None, 2.5).ppk
    nought = capability([0.0] * 5 + [0.1, 0.2, 0.15, 0.12, 0.3], None, 0.5, is_length=True)
    assert np.isfinite(nought.ppk).all()


def test_errors_and_warnings() -> None:
    for values, lower, upper, message in (
        (NIST[:9], 0.0, 60.0, "need at least 10 values, there are 9"),
        (NIST, None, None, "there is no tolerance"),
        ([1.0] * 20, 0.0, 2.0, "are equal"),
        ([*NIST, float("nan")], 0.0, 60.0, "NaN"),
        (NIST, 60.0, 40.0, "is not less than"),
    ):
        with pytest.raises(InputError, match=message):
            capability(values, lower, upper)
    with pytest.raises(InputError, match="need at least 8 values"):
        control_chart(NIST[:7])
    wander = np.cumsum(np.random.default_rng(0).normal(size=60))
    ability = capability(wander, -50.0, 50.0)
    assert not ability.is_in_control
    assert any("the process is not in control" in warning for warning in ability.warnings)
    assert ability.cpk is not None and ability.cpk.value > 1.5 * ability.ppk.value  # without and with the drift
    rough = capability(np.random.default_rng(2).normal(0, 0.05, 60), -1.0, 1.0, [0.04] * 60)
    assert rough.measurement_share == pytest.approx(0.64, abs=0.25)
    assert any("due to the measurement" in warning for warning in rough.warnings)
