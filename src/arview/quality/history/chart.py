"""Control chart of a component: individual values and moving ranges, with limits, tolerance and signals."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from arview.core.figures import INK, figure
from arview.errors import InputError
from arview.quality.history.series import ComponentSeries
from arview.quality.history.statistics import Capability, ControlChart

FORMATS = ("svg", "png", "pdf")
_BLUE, _RED = "#2b5c8a", "#c22f2b"


def draw(series: ComponentSeries, chart: ControlChart | None, ability: Capability | None, kind: str = "svg") -> bytes:
    """Draw the series as a picture in one of `FORMATS`.

    Args:
        series: the values.
        chart: control limits; None when there are too few values for them.
        ability: capability for the title; None when unknown.
        kind: format of the picture.

    Raises:
        InputError: there are no values, or the format is unknown.
    """
    if kind not in FORMATS:
        raise InputError(f"chart: {kind!r}: expected one of {', '.join(FORMATS)}")
    if not series.values:
        raise InputError(f"{series.component}: there is no determined {series.quantity} to draw")
    rows = {"nrows": 2, "sharex": True, "height_ratios": [2.2, 1.0]}
    with figure(5.6, 9.0, has_grid=False, text_as_paths=True, **rows) as (made, (above, below)):
        _individuals(above, series, chart)
        _ranges(below, series, chart)
        made.suptitle(_title(series, ability), x=0.01, ha="left", fontsize=11)
        out = io.BytesIO()
        metadata = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind)
        made.savefig(out, format=kind, dpi=150, metadata=metadata)
    return out.getvalue()


def _individuals(axes: Any, series: ComponentSeries, chart: ControlChart | None) -> None:
    x = np.array([one.value for one in series.values])
    places = np.arange(1, len(x) + 1)
    _tolerance(axes, series)
    if chart is not None:
        axes.axhline(chart.center, color=_BLUE, linewidth=0.9)
        _label(axes, chart.center, f"mean {chart.center:.3f}", _BLUE)
        limits = [(chart.upper, "UCL")] + ([(chart.lower, "LCL")] if chart.lower > 0.0 or not series.is_length else [])
        for limit, name in limits:
            axes.axhline(limit, color=_BLUE, linewidth=0.9, linestyle=(0, (5, 3)))
            _label(axes, limit, f"{name} {limit:.3f}", _BLUE)
    stds = np.array([one.std or 0.0 for one in series.values])
    if stds.any():
        axes.errorbar(places, x, yerr=2.0 * stds, fmt="none", ecolor="#c3ccd6", elinewidth=1.4, zorder=1)
    axes.plot(places, x, color="#9db4cb", linewidth=0.9, zorder=2)
    signals = set(chart.signals) if chart is not None else set()
    in_control = [i for i in range(len(x)) if i not in signals]
    axes.plot(places[in_control], x[in_control], "o", color=_BLUE, markersize=4.5, zorder=3)
    marked = sorted(signals)
    axes.plot(places[marked], x[marked], "D", color=_RED, markersize=6, zorder=4)
    for index in marked[:12]:
        axes.annotate(
            series.values[index].serial or f"#{series.values[index].result_id}",
            (places[index], x[index]),
            xytext=(5, 6),
            textcoords="offset points",
            fontsize=8,
            color=_RED,
        )
    axes.set_ylabel(f"{series.quantity}, {series.unit}")
    axes.margins(x=0.02, y=0.14)


def _tolerance(axes: Any, series: ComponentSeries) -> None:
    """Lines at the limits that held for each value; their labels give those that hold now."""
    places = np.arange(len(series.values) + 1) + 0.5
    for now, limits in (
        (series.lower, [one.lower for one in series.values]),
        (series.upper, [one.upper for one in series.values]),
    ):
        heights = np.array([np.nan if limit is None else limit for limit in limits])
        if len(set(limits)) == 1 and now is not None:
            axes.axhline(now, color=INK, linewidth=1.1)
        else:
            axes.stairs(heights, places, baseline=None, color=INK, linewidth=1.1)
        if now is not None:
            _label(axes, now, f"tolerance {now:+.3f}" if series.lower is not None else f"tolerance {now:.3f}", INK)


def _ranges(axes: Any, series: ComponentSeries, chart: ControlChart | None) -> None:
    x = np.array([one.value for one in series.values])
    places = np.arange(2, len(x) + 1)
    axes.plot(
        places,
        np.abs(np.diff(x)),
        "-o",
        color="#9db4cb",
        markerfacecolor=_BLUE,
        markeredgecolor=_BLUE,
        markersize=3.5,
        linewidth=0.9,
    )
    if chart is not None:
        axes.axhline(chart.range_center, color=_BLUE, linewidth=0.9)
        axes.axhline(chart.range_upper, color=_BLUE, linewidth=0.9, linestyle=(0, (5, 3)))
        _label(axes, chart.range_upper, f"UCL {chart.range_upper:.3f}", _BLUE)
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("moving range")
    first, last = series.values[0], series.values[-1]
    axes.set_xlabel(
        f"{len(x)} parts in the order of their measurement, {first.measured:%Y-%m-%d} to"
        f" {last.measured:%Y-%m-%d}; diamond: signal"
    )


def _label(axes: Any, y: float, text: str, color: str) -> None:
    """Label a horizontal line at its right end."""
    text = text.replace("-", "−")
    axes.annotate(
        text,
        (1.0, y),
        xycoords=("axes fraction", "data"),
        xytext=(4, 0),
        textcoords="offset points",
        va="center",
        fontsize=8,
        color=color,
        annotation_clip=False,
    )


def _title(series: ComponentSeries, ability: Capability | None) -> str:
    title = f"{series.part}: {series.component}, {series.quantity}"
    if ability is not None:
        name_cp, name_cpk = ability.names
        low, high = ability.cpk_interval
        title += f"   {name_cpk} {ability.cpk:.2f} ({low:.2f} to {high:.2f})"
        if ability.cp is not None:
            title += f", {name_cp} {ability.cp:.2f}"
    return title
