"""Tracking: the 6-DoF pose of a part through the frames of a monocular video."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.tracking.diagnosis import diagnose_search as diagnose_search
    from arview.tracking.estimate import Estimate as Estimate
    from arview.tracking.estimate import PosePrior as PosePrior
    from arview.tracking.guide_pose import GUIDE_PREFIX as GUIDE_PREFIX
    from arview.tracking.rig_session import RigSession as RigSession
    from arview.tracking.self_calibration.estimator import FocalEstimate as FocalEstimate
    from arview.tracking.self_calibration.profile import keep_profile as keep_profile
    from arview.tracking.session import TrackedPart as TrackedPart
    from arview.tracking.session import TrackingSession as TrackingSession
    from arview.tracking.session_options import SessionOptions as SessionOptions
    from arview.tracking.several.specimens import specimen_names as specimen_names
    from arview.tracking.specimen import SpecimenTracking as SpecimenTracking
    from arview.tracking.tracker import Tracker as Tracker
    from arview.tracking.tracker_options import PointMatches as PointMatches
    from arview.tracking.tracker_options import TrackerOptions as TrackerOptions

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "diagnosis": ("diagnose_search",),
        "estimate": (
            "Estimate",
            "PosePrior",
        ),
        "guide_pose": ("GUIDE_PREFIX",),
        "rig_session": ("RigSession",),
        "self_calibration.estimator": ("FocalEstimate",),
        "self_calibration.profile": ("keep_profile",),
        "session": (
            "TrackedPart",
            "TrackingSession",
        ),
        "session_options": ("SessionOptions",),
        "several.specimens": ("specimen_names",),
        "specimen": ("SpecimenTracking",),
        "tracker": ("Tracker",),
        "tracker_options": (
            "PointMatches",
            "TrackerOptions",
        ),
    },
)
