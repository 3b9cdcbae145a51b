"""Overlay: ghosts, edges, measured deviations, arrows and a status line, drawn on each frame."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.overlay.evidence import DrawnEvidence as DrawnEvidence
    from arview.overlay.evidence import evidence_of as evidence_of
    from arview.overlay.evidence import presence_of as presence_of
    from arview.overlay.labels import MEASURING as MEASURING
    from arview.overlay.labels import age_text as age_text
    from arview.overlay.labels import arrow_in_model as arrow_in_model
    from arview.overlay.labels import arrow_scale as arrow_scale
    from arview.overlay.labels import by_urgency as by_urgency
    from arview.overlay.labels import detail_text as detail_text
    from arview.overlay.labels import inspection_doubt as inspection_doubt
    from arview.overlay.labels import label_order as label_order
    from arview.overlay.labels import label_text as label_text
    from arview.overlay.labels import value_text as value_text
    from arview.overlay.legend import legend_entries as legend_entries
    from arview.overlay.legend import withheld_title as withheld_title
    from arview.overlay.mesh import anchor_in_model as anchor_in_model
    from arview.overlay.mesh import topology as topology
    from arview.overlay.options import VERDICT_RGB as VERDICT_RGB
    from arview.overlay.options import VERDICT_WORD as VERDICT_WORD
    from arview.overlay.options import EdgeMode as EdgeMode
    from arview.overlay.options import OverlayOptions as OverlayOptions
    from arview.overlay.renderer import OverlayRenderer as OverlayRenderer
    from arview.overlay.renderer import specimen_mark as specimen_mark
    from arview.overlay.renderer import specimen_rgb as specimen_rgb
    from arview.overlay.status import completeness_text as completeness_text

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "evidence": (
            "DrawnEvidence",
            "evidence_of",
            "presence_of",
        ),
        "labels": (
            "MEASURING",
            "age_text",
            "arrow_in_model",
            "arrow_scale",
            "by_urgency",
            "detail_text",
            "inspection_doubt",
            "label_order",
            "label_text",
            "value_text",
        ),
        "legend": (
            "legend_entries",
            "withheld_title",
        ),
        "mesh": (
            "anchor_in_model",
            "topology",
        ),
        "options": (
            "EdgeMode",
            "OverlayOptions",
            "VERDICT_RGB",
            "VERDICT_WORD",
        ),
        "renderer": (
            "OverlayRenderer",
            "specimen_mark",
            "specimen_rgb",
        ),
        "status": ("completeness_text",),
    },
)
