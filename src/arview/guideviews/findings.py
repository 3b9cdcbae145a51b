"""Findings of guide views on a part, as text: is it distinctive, and which of its views look alike?"""

from __future__ import annotations

import numpy as np

from arview.cad import Model, PartFinding, ViewRange
from arview.geometry import Array
from arview.guideviews.sphere import ASSESSED_SUBDIVISIONS, MIN_ASSESSED_VIEWS, directions_in_range
from arview.guideviews.uniqueness import CONFUSABLE_LIKENESS, Uniqueness, assess
from arview.guideviews.views import GuideViewOptions, GuideViewSet, make_guide_views


def azimuths_deg(views: GuideViewSet) -> Array:
    """(N,) azimuths of the views, deg, from +X towards +Y, -180 to 180."""
    return np.rad2deg(np.arctan2(views.directions[:, 1], views.directions[:, 0]))


def elevations_deg(views: GuideViewSet) -> Array:
    """(N,) elevations of the views, deg, from the XY plane towards +Z."""
    return np.rad2deg(np.arcsin(np.clip(views.directions[:, 2], -1.0, 1.0)))


def describe_view(views: GuideViewSet, index: int) -> str:
    """Azimuth and elevation of a view, as text."""
    return f"azimuth {azimuths_deg(views)[index]:.0f}°, elevation {elevations_deg(views)[index]:.0f}°"


def confusable_pair(views: GuideViewSet, unique: Uniqueness) -> str:
    """The two views that are most alike, as text; empty where no two views are far enough apart."""
    if np.all(np.isnan(unique.likeness)):
        return ""
    index = int(np.nanargmax(unique.likeness))
    other = int(unique.confused_with[index])
    return (
        f"most alike: {describe_view(views, index)} and {describe_view(views, other)} "
        f"(likeness {unique.likeness[index]:.2f}; from {CONFUSABLE_LIKENESS:.2f} on they are confusable)"
    )


def assessed_guide_views(model: Model, view_range: ViewRange) -> GuideViewSet:
    """The guide views by which a part is assessed, rendered now: the fewest that give the shares of the whole set."""
    subdivisions = ASSESSED_SUBDIVISIONS
    if len(directions_in_range(view_range, subdivisions, 0.0)) < MIN_ASSESSED_VIEWS:
        subdivisions += 1
    return make_guide_views(
        model, view_range, GuideViewOptions(subdivisions=subdivisions, margin_deg=0.0, renderer="zbuffer")
    )


def uniqueness_findings(model: Model, view_range: ViewRange) -> list[PartFinding]:
    """Findings of a coarse set of guide views, rendered now, for `PartCheck.with_findings`."""
    views = assessed_guide_views(model, view_range)
    unique = assess(views)
    alike = confusable_pair(views, unique)
    text = f"guide views {unique.reason} (score {unique.score:.2f}{f'; {alike}' if alike else ''})"
    return [PartFinding("note" if unique.is_sufficient else "problem", text)]
