"""Guided capture: from where the next photo of a part should be taken, and when the camera is there and still."""

from arview.station.capture.advice import CaptureAdvice, CellState, ComponentNeed, capture_document
from arview.station.capture.guide import CaptureGuide
from arview.station.capture.options import CaptureOptions

__all__ = ["CaptureAdvice", "CaptureGuide", "CaptureOptions", "CellState", "ComponentNeed", "capture_document"]
