"""Guide views: features of a part in views from all directions of a range."""

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
