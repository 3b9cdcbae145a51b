"""Tracking: the 6-DoF pose of a part through the frames of a monocular video."""

from arview.tracking.estimate import Estimate
from arview.tracking.session import TrackingSession
from arview.tracking.session_options import SessionOptions
from arview.tracking.tracker import Tracker
from arview.tracking.tracker_options import TrackerOptions

__all__ = ["Estimate", "SessionOptions", "Tracker", "TrackerOptions", "TrackingSession"]
