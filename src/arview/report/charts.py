"""Charts of reports as SVG, drawn by matplotlib, so that they scale and their text can be searched."""

from __future__ import annotations

import io
import re
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview import measurement
from arview.core.figures import INK, MUTED, figure
from arview.geometry import Array
from arview.inspection import ComponentDeviation, DatumReport, Verdict

VERDICT_HEX = {
    Verdict.PASS: "#12805c",
    Verdict.FAIL: "#c22f2b",
    Verdict.UNDECIDED: "#a96a00",
    Verdict.MEASURED: "#2b5c8a",
    Verdict.NOT_MEASURED: "#5b6675",
}
"""Colours of the verdicts, dark enough for text on white (contrast above 4.5 : 1)."""
_MARKER = {
    Verdict.PASS: "o",
    Verdict.FAIL: "X",
    Verdict.UNDECIDED: "D",
    Verdict.MEASURED: "s",
    Verdict.NOT_MEASURED: "_",
}
_SERIES = ("#2b5c8a", "#e0912f", "#7aa6c2", "#7a5195", "#5a8f5a", "#b0413e", "#9c8a5a", "#8796a5", "#3d8b8b", "#c58fb4")


def svg(made: Any, label: str) -> str:
    """The figure as an SVG element for a page, with a label for assistive technology."""
    out = io.StringIO()
    made.savefig(out, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = out.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = _without_styles(text)
    # Clip paths and markers are referenced by id, which must be unique among the charts of a page.
    salt = f"c{zlib.crc32(label.encode()):08x}"
    text = re.sub(r'\bid="([^"]+)"', rf'id="{salt}-\1"', text)
    text = re.sub(r'(url\(#|href="#)', rf"\1{salt}-", text)
    return text.replace("<svg ", f'<svg role="img" aria-label="{_escaped(label)}" ', 1)


def _without_styles(text: str) -> str:
    """An SVG of Matplotlib with presentation attributes instead of styles, which the policy of the page forbids."""
    text = re.sub(r"<style[^>]*>.*?</style>", "", text, flags=re.DOTALL)
    text = text.replace("<svg ", '<svg stroke-linejoin="round" stroke-linecap="butt" ', 1)
    return re.sub(r'\bstyle="([^"]*)"', lambda found: _attributes(found.group(1)), text)


def _attributes(style: str) -> str:
    """Presentation attributes that say the same as a style."""
    pairs = [declaration.partition(":")[::2] for declaration in style.split(";") if declaration.strip()]
    values = {name.strip(): value.strip() for name, value in pairs}
    if found := re.match(r"(.*?)([\d.]+px) (.+)", values.pop("font", "")):  # the shorthand is no attribute
        weight, values["font-size"], values["font-family"] = found.groups()
        values |= {"font-weight": weight.strip()} if weight.strip().isdigit() else {}
    return " ".join(f'{name}="{value}"' for name, value in values.items())


def tolerance_chart(components: Sequence[ComponentDeviation]) -> str:
    """Distance of each component as a share of its tolerance, with its 95 % interval."""
    rows = [c for c in components if c.distance_mm is not None and c.tolerance_mm is not None]
    if not rows:
        return ""
    highest = max(_interval(row)[1] / row.tolerance_mm for row in rows if row.tolerance_mm)
    limit = float(np.clip(1.08 * highest, 1.25, 2.5))
    with figure(0.75 + 0.235 * len(rows)) as (made, axes):
        axes.axvspan(0.0, 1.0, color="#e7f3ee", linewidth=0)
        axes.axvline(1.0, color=INK, linewidth=1.0)
        axes.text(1.0, -0.75, " tolerance", fontsize=8.5, va="center")
        for place, row in enumerate(rows):
            assert row.distance_mm is not None and row.tolerance_mm is not None
            low, high = _interval(row)
            share = row.distance_mm / row.tolerance_mm
            color = VERDICT_HEX[row.verdict]
            axes.plot(
                np.clip([low / row.tolerance_mm, high / row.tolerance_mm], 0, limit),
                [place] * 2,
                color=color,
                linewidth=2.4,
                solid_capstyle="butt",
                alpha=0.55,
            )
            if share <= limit:
                axes.plot(
                    [share],
                    [place],
                    _MARKER[row.verdict],
                    color=color,
                    markersize=6.5,
                    markeredgewidth=0.6,
                    markeredgecolor="white",
                    clip_on=False,
                )
            else:
                axes.plot([limit], [place], ">", color=color, markersize=7, clip_on=False)
                axes.text(
                    0.97 * limit, place, f"{100.0 * share:.0f} %", ha="right", va="center", color=color, fontsize=8.5
                )
        axes.set_yticks(range(len(rows)), [row.name for row in rows])
        axes.tick_params(axis="y", length=0, labelcolor=INK)
        axes.set_ylim(len(rows) - 0.4, -0.6)
        axes.set_xlim(0.0, limit)
        axes.xaxis.set_major_formatter(lambda value, _: f"{100.0 * value:.3g} %")
        axes.set_xlabel("distance from the design position as a share of the tolerance, with its 95 % interval")
        axes.grid(axis="y", visible=False)
        return svg(made, "Share of the tolerance that each component uses")


def histogram_chart(distances: measurement.DistanceMap) -> str:
    """Histogram of the signed distances of the cloud to the CAD model."""
    values = distances.distances
    whole = distances.statistics[0]
    span = min(distances.reach_mm, max(10.0 * whole.fwhm_mm, 0.1))
    edges = np.linspace(whole.median_mm - span, whole.median_mm + span, 101)
    count, _ = np.histogram(values, edges)
    outside = 1.0 - count.sum() / max(1, len(values))
    with figure(2.9) as (made, axes):
        axes.bar(0.5 * (edges[1:] + edges[:-1]), count / max(1, len(values)), width=np.diff(edges), color=_SERIES[0])
        axes.axvline(0.0, color=INK, linewidth=0.9)
        axes.yaxis.set_major_formatter(lambda value, _: f"{100.0 * value:.3g} %")
        axes.set_xlim(edges[0], edges[-1])
        axes.set_xlabel(
            f"signed distance to the CAD, mm, outside positive; {100.0 * outside:.0f} % are outside this range"
        )
        axes.set_ylabel("share of the points")
        axes.grid(axis="x", visible=False)
        return svg(made, "Histogram of the signed distances")


def budget_chart(components: Sequence[ComponentDeviation]) -> str:
    """Uncertainty budget of each component: shares of its variance."""
    rows = [c for c in components if c.details is not None and c.details.budget]
    if not rows:
        return ""
    variances: dict[str, Array] = {}
    for place, row in enumerate(rows):
        assert row.details is not None
        for line in row.details.budget:
            variances.setdefault(line.name, np.zeros(len(rows)))[place] = line.std_mm**2
    total = np.maximum(sum(variances.values(), np.zeros(len(rows))), 1e-30)
    names = sorted(variances, key=lambda name: -float(variances[name].sum()))
    shown = [name for name in names if float(np.max(variances[name] / total)) >= 0.02][: len(_SERIES) - 1]
    rest = total - sum((variances[name] for name in shown), np.zeros(len(rows)))
    if float(np.max(rest / total)) > 1e-3:
        variances["other"] = rest
        shown.append("other")
    with figure(1.15 + 0.25 * len(rows)) as (made, axes):
        left = np.zeros(len(rows))
        for index, name in enumerate(shown):
            share = variances[name] / total
            axes.barh(
                range(len(rows)),
                share,
                left=left,
                height=0.72,
                label=name,
                color=_SERIES[index],
                edgecolor="white",
                linewidth=0.5,
            )
            left += share
        for place, row in enumerate(rows):
            axes.text(1.015, place, f"{row.uncertainty_mm:.3f}", va="center", fontsize=8.5)
        axes.text(1.015, -0.85, "U, mm", va="center", fontsize=8.5, color=MUTED)
        axes.set_yticks(range(len(rows)), [row.name for row in rows])
        axes.tick_params(axis="y", length=0, labelcolor=INK)
        axes.set_ylim(len(rows) - 0.4, -0.6)
        axes.set_xlim(0.0, 1.0)
        axes.xaxis.set_major_formatter(lambda value, _: f"{100.0 * value:.3g} %")
        axes.set_xlabel("share of the variance of the distance")
        axes.grid(axis="y", visible=False)
        made.legend(loc="outside upper center", ncols=3, handlelength=1.4, columnspacing=1.4)
        return svg(made, "Uncertainty budget of each component")


def coverage_chart(directions: Array, sizes: NDArray[np.int64] | None = None) -> str:
    """Viewing directions of the photos: azimuth around the circle, elevation towards its centre.

    Args:
        directions: (M,3) from the part to the cameras, model frame.
        sizes: (M,) number of components visible in each photo.
    """
    unit = directions / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
    azimuth = np.arctan2(unit[:, 1], unit[:, 0])
    elevation = np.degrees(np.arcsin(np.clip(unit[:, 2], -1.0, 1.0)))
    lowest = min(0.0, 30.0 * np.floor(float(elevation.min()) / 30.0))
    with figure(3.5, 4.2, subplot_kw={"projection": "polar"}) as (made, axes):
        axes.scatter(azimuth, 90.0 - elevation, s=34, color=_SERIES[0], edgecolor="white", linewidth=0.6, zorder=3)
        if sizes is not None:
            for a, e, count in zip(azimuth, elevation, sizes, strict=True):
                axes.annotate(
                    str(int(count)),
                    (a, 90.0 - e),
                    xytext=(0, 6),
                    textcoords="offset points",
                    fontsize=7,
                    color=MUTED,
                    ha="center",
                )
        rings = np.arange(0.0, 90.0 - lowest + 1, 30.0)[1:]
        axes.set_rlim(0.0, 90.0 - lowest)
        axes.set_rgrids(rings, [f"{90.0 - ring:.0f}°" for ring in rings], angle=22.5, fontsize=7.5, color=MUTED)
        axes.set_thetagrids(range(0, 360, 45), ["+x", "", "+y", "", "−x", "", "−y", ""])
        axes.spines["polar"].set_color("#9aa5b1")
        return svg(made, "Viewing directions of the photos")


def reprojection_chart(lengths_px: Array, photos: NDArray[np.int32], names: Sequence[str]) -> str:
    """Reprojection errors: histogram of all, and median and 95 % quantile of each photo."""
    with figure(3.0, ncols=2, gridspec_kw={"width_ratios": [1, 1.25]}) as (made, (left, right)):
        limit = float(np.percentile(lengths_px, 99.0)) if len(lengths_px) else 1.0
        edges = np.linspace(0.0, limit, 41)
        count, _ = np.histogram(lengths_px, edges)
        left.bar(
            0.5 * (edges[1:] + edges[:-1]), count / max(1, len(lengths_px)), width=np.diff(edges), color=_SERIES[0]
        )
        left.set_xlabel("reprojection error, px")
        left.set_ylabel("share of the observations")
        left.yaxis.set_major_formatter(lambda value, _: f"{100.0 * value:.3g} %")
        left.grid(axis="x", visible=False)
        medians, ninety = np.zeros(len(names)), np.zeros(len(names))
        for index in range(len(names)):
            mine = lengths_px[photos == index]
            if len(mine):
                medians[index], ninety[index] = np.percentile(mine, [50.0, 95.0])
        places = np.arange(len(names))
        right.bar(places, ninety, width=0.8, color="#c9d8e6", label="95 %")
        right.bar(places, medians, width=0.8, color=_SERIES[0], label="median")
        right.set_xlabel("photo, in the order of the list")
        right.set_ylabel("px")
        right.grid(axis="x", visible=False)
        right.legend(loc="upper right", ncols=2)
        right.set_ylim(0.0, 1.25 * float(ninety.max(initial=0.1)))
        return svg(made, "Reprojection errors, all and by photo")


def datum_chart(datums: Sequence[DatumReport]) -> str:
    """Residuals of each datum about its own best fit and in the datum frame."""
    with figure(0.95 + 0.42 * len(datums)) as (made, axes):
        places = np.arange(len(datums))
        axes.barh(
            places - 0.18,
            [d.residual_mm for d in datums],
            height=0.34,
            color=_SERIES[0],
            label="scatter about its own best fit",
        )
        axes.barh(
            places + 0.18, [d.rest_mm for d in datums], height=0.34, color="#c9d8e6", label="rms in the datum frame"
        )
        axes.set_yticks(places, [f"{d.label}  {d.feature}" for d in datums])
        axes.tick_params(axis="y", length=0, labelcolor=INK)
        axes.set_ylim(len(datums) - 0.4, -0.6)
        axes.set_xlabel("mm")
        axes.grid(axis="y", visible=False)
        made.legend(loc="outside upper center", ncols=2, handlelength=1.4)
        return svg(made, "Residuals of the datums")


def _interval(row: ComponentDeviation) -> tuple[float, float]:
    """The stated 95 % interval of the distance, or the distance ± U."""
    if row.details is not None and row.details.interval_mm is not None:
        return row.details.interval_mm
    distance, uncertainty = row.distance_mm or 0.0, row.uncertainty_mm or 0.0
    return max(0.0, distance - uncertainty), distance + uncertainty


def _escaped(text: str) -> str:
    return text.replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;")
