"""Guide views: features of a part in views from all directions of a range."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.guideviews.cache import cached_guide_views as cached_guide_views
    from arview.guideviews.extract import ViewFeatures as ViewFeatures
    from arview.guideviews.findings import assessed_guide_views as assessed_guide_views
    from arview.guideviews.findings import azimuths_deg as azimuths_deg
    from arview.guideviews.findings import confusable_pair as confusable_pair
    from arview.guideviews.findings import elevations_deg as elevations_deg
    from arview.guideviews.findings import uniqueness_findings as uniqueness_findings
    from arview.guideviews.look_alikes import PartLikeness as PartLikeness
    from arview.guideviews.look_alikes import compare_parts as compare_parts
    from arview.guideviews.report import uniqueness_report as uniqueness_report
    from arview.guideviews.sheet import contact_sheet as contact_sheet
    from arview.guideviews.sheet import view_tile as view_tile
    from arview.guideviews.sphere import icosphere_directions as icosphere_directions
    from arview.guideviews.surface import Surface as Surface
    from arview.guideviews.surface import draw_surface as draw_surface
    from arview.guideviews.uniqueness import CONFUSABLE_LIKENESS as CONFUSABLE_LIKENESS
    from arview.guideviews.uniqueness import PLAIN_LINES as PLAIN_LINES
    from arview.guideviews.uniqueness import Uniqueness as Uniqueness
    from arview.guideviews.uniqueness import assess as assess
    from arview.guideviews.uniqueness import view_lines as view_lines
    from arview.guideviews.views import GuideView as GuideView
    from arview.guideviews.views import GuideViewOptions as GuideViewOptions
    from arview.guideviews.views import GuideViewSet as GuideViewSet
    from arview.guideviews.views import load_guide_views as load_guide_views
    from arview.guideviews.views import make_guide_views as make_guide_views

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "cache": ("cached_guide_views",),
        "extract": ("ViewFeatures",),
        "findings": (
            "assessed_guide_views",
            "azimuths_deg",
            "confusable_pair",
            "elevations_deg",
            "uniqueness_findings",
        ),
        "look_alikes": (
            "PartLikeness",
            "compare_parts",
        ),
        "report": ("uniqueness_report",),
        "sheet": (
            "contact_sheet",
            "view_tile",
        ),
        "sphere": ("icosphere_directions",),
        "surface": (
            "Surface",
            "draw_surface",
        ),
        "uniqueness": (
            "CONFUSABLE_LIKENESS",
            "PLAIN_LINES",
            "Uniqueness",
            "assess",
            "view_lines",
        ),
        "views": (
            "GuideView",
            "GuideViewOptions",
            "GuideViewSet",
            "load_guide_views",
            "make_guide_views",
        ),
    },
)
