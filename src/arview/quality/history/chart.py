"""Control chart of a series: values and ranges, with limits, tolerance, signals and what changed."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from arview.core.figures import INK, MUTED, figure
from arview.errors import InputError
from arview.quality.history.series import ComponentSeries
from arview.quality.history.statistics import Capability, ControlChart

FORMATS = ("svg", "png", "pdf")
MANY_VALUES = 2000
"""From so many values on they are drawn as pixels also in an SVG, which would take tens of megabytes."""
_AT_END: dict[str, Any] = {"xycoords": ("axes fraction", "data")}
_BLUE, _PALE, _RED = "#2b5c8a", "#9db4cb", "#c22f2b"


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
        _values(above, series, chart)
        _ranges(below, series, chart)
        _changes(above, below, series)
        made.suptitle(_title(series, ability), x=0.01, ha="left", fontsize=11)
        out = io.BytesIO()
        metadata = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind)
        made.savefig(out, format=kind, dpi=150, metadata=metadata)
    return out.getvalue()


def _places(chart: ControlChart) -> Any:
    """Where the values of a chart are drawn: at the numbers of the parts, or in the middle of a subgroup."""
    return (np.arange(len(chart.values)) + 0.5) * chart.size + 0.5


def _values(axes: Any, series: ComponentSeries, chart: ControlChart | None) -> None:
    x = np.array([one.value for one in series.values])
    numbers = np.arange(1, len(x) + 1)
    is_many = len(x) > MANY_VALUES
    _tolerance(axes, series)
    stds = np.array([one.std or 0.0 for one in series.values])
    if stds.any() and not is_many:
        axes.errorbar(numbers, x, yerr=2.0 * stds, fmt="none", ecolor="#c3ccd6", elinewidth=1.4, zorder=1)
    if chart is None or chart.size > 1:
        axes.plot(numbers, x, "," if is_many else ".", color=_PALE, markersize=3.5, zorder=2, rasterized=is_many)
    if chart is not None:
        _line(axes, chart.center, f"mean {chart.center:.3f}")
        if chart.lower > 0.0 or not series.is_length:
            _line(axes, chart.lower, f"LCL {chart.lower:.3f}", is_dashed=True)
        _line(axes, chart.upper, f"UCL {chart.upper:.3f}", is_dashed=True)
        places, marked = _places(chart), list(chart.signals)
        if not is_many:
            axes.plot(places, chart.values, color=_PALE, linewidth=0.9, zorder=2)
        calm = np.setdiff1d(np.arange(len(places)), marked)
        dots, diamonds = (",", ".") if is_many else ("o", "D")
        axes.plot(places[calm], chart.values[calm], dots, color=_BLUE, markersize=4.5, zorder=3, rasterized=is_many)
        axes.plot(
            places[marked], chart.values[marked], diamonds, color=_RED, markersize=6, zorder=4, rasterized=is_many
        )
        # Of signals that are close together the first has its name.
        gap = len(places) / 14.0
        for index in [i for i, before in zip(marked, [-gap, *marked], strict=False) if i - before >= gap]:
            one = series.values[(index + 1) * chart.size - 1]
            at = (places[index], chart.values[index])
            _note(axes, one.serial or f"#{one.result_id}", at, _RED, xytext=(5, 6))
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
        elif np.isfinite(heights).any():
            axes.stairs(heights, places, baseline=None, color=INK, linewidth=1.1)
        if now is not None:
            text = f"tolerance {now:+.3f}" if (series.lower or 0.0) < 0.0 else f"tolerance {now:.3f}"
            _note(axes, text.replace("-", "−"), (1.0, now), INK, **_AT_END, xytext=(-2, 3), ha="right")


def _ranges(axes: Any, series: ComponentSeries, chart: ControlChart | None) -> None:
    if chart is not None:
        places = _places(chart)[-len(chart.ranges) :]
        style = {
            "color": _PALE,
            "markerfacecolor": _BLUE,
            "markeredgecolor": _BLUE,
            "markersize": 3.5,
            "linewidth": 0.9,
        }
        is_many = len(series.values) > MANY_VALUES
        axes.plot(places, chart.ranges, "," if is_many else "-o", rasterized=is_many, **style)
        _line(axes, chart.range_center, f"mean {chart.range_center:.3f}")
        _line(axes, chart.range_upper, f"UCL {chart.range_upper:.3f}", is_dashed=True)
        if chart.range_lower > 0.0:
            _line(axes, chart.range_lower, f"LCL {chart.range_lower:.3f}", is_dashed=True)
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("moving range" if chart is None or chart.size == 1 else f"range of {chart.size}")
    first, last = (one.measured.astimezone(series.zone) for one in (series.values[0], series.values[-1]))
    axes.set_xlabel(
        f"{len(series.values)} parts in the order of their measurement, {first:%Y-%m-%d} to {last:%Y-%m-%d}"
        f" ({series.zone or 'local time'}); diamond: signal"
    )


def _changes(above: Any, below: Any, series: ComponentSeries) -> None:
    """Vertical lines before the values at which limits, CAD model or station changed, with a word."""
    words: dict[int, list[str]] = {}
    for change in series.changes():
        if change.place is not None:
            words.setdefault(change.place, []).append(change.word)
    for place, names in words.items():
        for axes in (above, below):
            axes.axvline(place + 0.5, color=MUTED, linewidth=0.8, linestyle=(0, (1, 2)), zorder=0)
        at = (place + 0.5, 1.0)
        _note(above, ", ".join(names), at, MUTED, xycoords=("data", "axes fraction"), xytext=(2, 2), rotation=20)


def _line(axes: Any, y: float, text: str, is_dashed: bool = False) -> None:
    """Draw a horizontal line of the chart with its label."""
    axes.axhline(y, color=_BLUE, linewidth=0.9, linestyle=(0, (5, 3)) if is_dashed else "-")
    _note(axes, text.replace("-", "−"), (1.0, y), _BLUE, **_AT_END, xytext=(4, 0), va="center")


def _note(axes: Any, text: str, at: tuple[float, float], color: str, **options: Any) -> None:
    # A serial or station is no formula, whatever dollar signs are in it.
    text = text.replace("$", r"\$")
    axes.annotate(text, at, textcoords="offset points", fontsize=8, color=color, annotation_clip=False, **options)


def _title(series: ComponentSeries, ability: Capability | None) -> str:
    title = f"{series.part}: {series.component}, {series.quantity}".replace("$", r"\$")
    if ability is not None:
        found = ability.named
        low, high = ability.ppk[1:]
        title += f"   Ppk {ability.ppk.value:.2f} ({low:.2f} to {high:.2f})"
        title += "".join(f", {name} {found[name].value:.2f}" for name in ("Pp", "Cp", "Cpk") if name in found)
    return title
