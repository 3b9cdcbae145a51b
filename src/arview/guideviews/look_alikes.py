"""Two parts beside each other: would pictures of the one be taken for the other?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from arview.cad import Part, PartFinding
from arview.guideviews.findings import assessed_guide_views, describe_view
from arview.guideviews.uniqueness import CONFUSABLE_LIKENESS, MAX_WEAK_SHARE, likeness_between
from arview.guideviews.views import GuideViewSet


@dataclass(frozen=True)
class PartLikeness:
    """How much a part looks like another one.

    Attributes:
        other: name of the other part.
        share: of the part's views that look like some view of the other, at any roll and size.
        is_confusable: more than `MAX_WEAK_SHARE` of the views do.
        text: one sentence.
    """

    other: str
    share: float
    is_confusable: bool
    text: str

    def finding(self) -> PartFinding:
        """The comparison for `PartCheck.with_findings`."""
        return PartFinding("problem" if self.is_confusable else "note", self.text)


def compare_parts(part: Part, others: list[Part], views: GuideViewSet | None = None) -> list[PartLikeness]:
    """Compare the guide views of a part with those of other parts, each over its own range of viewpoints.

    Args:
        part: the part.
        others: parts it might be taken for.
        views: assessed guide views of the part; None: they are rendered now.

    Raises:
        InputError: a range puts the camera inside a part.
    """
    views = views or assessed_guide_views(part.model, part.effective_view_range)
    return [_compared(views, other) for other in others]


def _compared(views: GuideViewSet, other: Part) -> PartLikeness:
    other_views = assessed_guide_views(other.model, other.effective_view_range)
    likeness, partner = likeness_between(views, other_views)
    share = float(np.mean(likeness >= CONFUSABLE_LIKENESS))
    index = int(np.argmax(likeness))
    most = (
        f"most alike: {describe_view(views, index)} and its {describe_view(other_views, int(partner[index]))}, "
        f"likeness {likeness[index]:.2f}; from {CONFUSABLE_LIKENESS:.2f} on views are confusable"
    )
    sizes = f"{views.diameter_mm:.0f} and {other_views.diameter_mm:.0f} mm across"
    is_confusable = share > MAX_WEAK_SHARE
    if is_confusable:
        text = (
            f"confusable with {other.name}: {share:.0%} of the views look like one of its views ({sizes}; {most}); add "
            "the component that tells them apart, narrow the range of viewpoints, or see that only one can be there"
        )
    else:
        text = f"told apart from {other.name}: {share:.0%} of the views look like one of its views ({sizes}; {most})"
    return PartLikeness(other.name, share, is_confusable, text)
