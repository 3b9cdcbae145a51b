"""Guide views: what the part looks like from everywhere it may be seen from."""

from arview.guideviews.extract import ViewFeatures
from arview.guideviews.views import (
    GuideView,
    GuideViewOptions,
    GuideViewSet,
    load_guide_views,
    make_guide_views,
)

__all__ = [
    "GuideView",
    "GuideViewOptions",
    "GuideViewSet",
    "ViewFeatures",
    "load_guide_views",
    "make_guide_views",
]
