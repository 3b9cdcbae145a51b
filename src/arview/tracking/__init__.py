"""Detection and 6-DoF tracking of a part in monocular video."""

from arview.tracking.detector import Detection, Detector, DetectorOptions
from arview.tracking.session import SessionOptions, TrackingSession
from arview.tracking.tracker import Estimate, Tracker, TrackerOptions

__all__ = [
    "Detection",
    "Detector",
    "DetectorOptions",
    "Estimate",
    "SessionOptions",
    "Tracker",
    "TrackerOptions",
    "TrackingSession",
]
