"""Guided capture: from where the next photo of a part should be taken, and when the camera is there and still."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.station.capture.advice import CaptureAdvice as CaptureAdvice
    from arview.station.capture.advice import CellState as CellState
    from arview.station.capture.advice import ComponentNeed as ComponentNeed
    from arview.station.capture.advice import capture_document as capture_document
    from arview.station.capture.dome import ELEVATION_DEG as ELEVATION_DEG
    from arview.station.capture.dome import asked_elevation_deg as asked_elevation_deg
    from arview.station.capture.dome import component_points as component_points
    from arview.station.capture.dome import fitting_distance_mm as fitting_distance_mm
    from arview.station.capture.guide import CaptureGuide as CaptureGuide
    from arview.station.capture.information import KnownViews as KnownViews
    from arview.station.capture.information import Views as Views
    from arview.station.capture.information import expanded_uncertainty as expanded_uncertainty
    from arview.station.capture.information import focal_px as focal_px
    from arview.station.capture.options import CaptureOptions as CaptureOptions
    from arview.station.capture.options import TriggerOptions as TriggerOptions

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "advice": (
            "CaptureAdvice",
            "CellState",
            "ComponentNeed",
            "capture_document",
        ),
        "dome": (
            "ELEVATION_DEG",
            "asked_elevation_deg",
            "component_points",
            "fitting_distance_mm",
        ),
        "guide": ("CaptureGuide",),
        "information": (
            "KnownViews",
            "Views",
            "expanded_uncertainty",
            "focal_px",
        ),
        "options": (
            "CaptureOptions",
            "TriggerOptions",
        ),
    },
)
