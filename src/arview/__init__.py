"""arview: AR inspection of assemblies from CAD.

Guide views rendered from a CAD model drive the detection and 6-DoF tracking of a part in monocular video; the overlay
draws the CAD ghost of every component with its measured deviation, which is reconstructed from photos.

The names below are the public interface. They are loaded when first used, so that ``import arview`` is quick. Their
arguments follow one order: first what is worked on (a path, guide views or a model), then the camera, then the model
where guide views came first, then the options; all others are keywords. Paths are ``str`` or ``Path``.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from arview.errors import ArviewError
from arview.version import __version__

if TYPE_CHECKING:
    from arview.annotation import annotate
    from arview.cad import Model, Part, check_part, load_model, load_part
    from arview.camera import Camera
    from arview.camera.read import load_camera
    from arview.detection import Detection, Detector
    from arview.guideviews import GuideViewSet, load_guide_views, make_guide_views
    from arview.inspection import Inspection, load_inspection, save_inspection
    from arview.measurement.run import measure
    from arview.overlay import OverlayRenderer
    from arview.pose import Pose
    from arview.reconstruction.run import reconstruct
    from arview.report import make_report
    from arview.tracking import PointMatches, PosePrior, RigSession, SessionOptions, Tracker, TrackingSession
    from arview.video import VideoSink, open_source
    from arview.workflow.job import InspectJob
    from arview.workflow.run import inspect_part

__all__ = [
    "ArviewError",
    "Camera",
    "Detection",
    "Detector",
    "GuideViewSet",
    "InspectJob",
    "Inspection",
    "Model",
    "OverlayRenderer",
    "Part",
    "PointMatches",
    "Pose",
    "PosePrior",
    "RigSession",
    "SessionOptions",
    "Tracker",
    "TrackingSession",
    "VideoSink",
    "__version__",
    "annotate",
    "check_part",
    "inspect_part",
    "load_camera",
    "load_guide_views",
    "load_inspection",
    "load_model",
    "load_part",
    "make_guide_views",
    "make_report",
    "measure",
    "open_source",
    "reconstruct",
    "save_inspection",
]

_MODULES = {
    "arview.annotation": ("annotate",),
    "arview.cad": ("Model", "Part", "check_part", "load_model", "load_part"),
    "arview.camera": ("Camera",),
    "arview.camera.read": ("load_camera",),
    "arview.detection": ("Detection", "Detector"),
    "arview.guideviews": ("GuideViewSet", "load_guide_views", "make_guide_views"),
    "arview.inspection": ("Inspection", "load_inspection", "save_inspection"),
    "arview.measurement.run": ("measure",),
    "arview.overlay": ("OverlayRenderer",),
    "arview.pose": ("Pose",),
    "arview.reconstruction.run": ("reconstruct",),
    "arview.report": ("make_report",),
    "arview.tracking": ("PointMatches", "PosePrior", "RigSession", "SessionOptions", "Tracker", "TrackingSession"),
    "arview.video": ("VideoSink", "open_source"),
    "arview.workflow.job": ("InspectJob",),
    "arview.workflow.run": ("inspect_part",),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Load a public name when it is first used (PEP 562)."""
    module = _MODULE_OF.get(name)
    if module is None:
        raise AttributeError(f"module 'arview' has no attribute {name!r}")
    value = getattr(import_module(module), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
