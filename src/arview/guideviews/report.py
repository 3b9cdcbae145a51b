"""The uniqueness report of a set of guide views, as Markdown: how it was made, the verdict, and its weakest views."""

from __future__ import annotations

import numpy as np

from arview.guideviews.findings import confusable_pair, describe_view
from arview.guideviews.uniqueness import CONFUSABLE_LIKENESS, PLAIN_LINES, Uniqueness
from arview.guideviews.views import GuideViewSet

LISTED_VIEWS = 10
"""Views in the table of the weakest ones."""


def uniqueness_report(views: GuideViewSet, unique: Uniqueness) -> str:
    """The report as Markdown, with a newline at its end."""
    declared, options = views.view_range, views.options
    assessed = unique.assessed
    lines, likeness = unique.distinct_lines[assessed], unique.likeness[assessed]
    plain, alike = float(np.mean(lines < PLAIN_LINES)), float(np.mean(likeness >= CONFUSABLE_LIKENESS))
    rows = [
        ("model", f"{views.model_name}, `{views.model_hash[:12]}`, {views.diameter_mm:.0f} mm across"),
        ("components", f"{len(views.component_names)}"),
        ("distance", f"{declared.distance_mm[0]:g} to {declared.distance_mm[1]:g} mm"),
        ("elevation", f"{declared.elevation_deg[0]:g} to {declared.elevation_deg[1]:g}°"),
        ("azimuth", f"{declared.azimuth_deg[0]:g} to {declared.azimuth_deg[1]:g}°"),
        (
            "views",
            f"{len(views)}, about {spacing_deg(options.subdivisions):.0f}° apart; {len(assessed)} of them assessed",
        ),
        ("distinct lines of a view", f"median {np.median(lines):.0f}, fewest {lines.min():.0f}"),
        ("plain", f"{plain:.0%} of the views show fewer than {PLAIN_LINES:.0f} distinct lines"),
        ("confusable", f"{alike:.0%} of the views look like one from another side"),
        ("score", f"{unique.score:.2f}"),
    ]
    weakest = assessed[np.argsort(lines, kind="stable")[:LISTED_VIEWS]]
    table = [
        f"| {describe_view(views, int(index))} | {unique.distinct_lines[index]:.0f} | {_likeness(unique, int(index))} |"
        for index in weakest
    ]
    return "\n".join(
        [
            f"# Guide views of {views.model_name}",
            "",
            f"**{unique.reason[0].upper()}{unique.reason[1:]}.**",
            "",
            "| | |",
            "|---|---|",
            *[f"| {name} | {text} |" for name, text in rows],
            "",
            f"{confusable_pair(views, unique)}".capitalize() + ".",
            "",
            "Weakest views:",
            "",
            "| view | distinct lines | likeness to another side |",
            "|---|---|---|",
            *table,
            "",
        ]
    )


def spacing_deg(subdivisions: int) -> float:
    """Angle between neighbouring directions of the icosphere, deg, roughly."""
    return float(np.rad2deg(np.sqrt(4.0 * np.pi / (10 * 4**subdivisions + 2))))


def _likeness(unique: Uniqueness, index: int) -> str:
    return "-" if np.isnan(unique.likeness[index]) else f"{unique.likeness[index]:.2f}"
