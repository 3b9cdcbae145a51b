"""The whole workflow: from photos and a video of one part to verdict, report and film; and many parts at once."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.workflow.job import InspectJob as InspectJob
    from arview.workflow.lock import exclusive_access as exclusive_access
    from arview.workflow.prepare import Prepared as Prepared
    from arview.workflow.prepare import job_key as job_key
    from arview.workflow.progress import ProgressEstimate as ProgressEstimate
    from arview.workflow.progress import ProgressEstimator as ProgressEstimator
    from arview.workflow.progress import time_text as time_text
    from arview.workflow.run import Outcome as Outcome
    from arview.workflow.run import inspect_part as inspect_part
    from arview.workflow.run import inspect_prepared as inspect_prepared
    from arview.workflow.run import measured_in_photos as measured_in_photos
    from arview.workflow.silhouettes import CadSilhouettes as CadSilhouettes
    from arview.workflow.specimens import Specimen as Specimen
    from arview.workflow.specimens import load_specimens as load_specimens
    from arview.workflow.specimens import make_overlay as make_overlay

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "job": ("InspectJob",),
        "lock": ("exclusive_access",),
        "prepare": (
            "Prepared",
            "job_key",
        ),
        "progress": (
            "ProgressEstimate",
            "ProgressEstimator",
            "time_text",
        ),
        "run": (
            "Outcome",
            "inspect_part",
            "inspect_prepared",
            "measured_in_photos",
        ),
        "silhouettes": ("CadSilhouettes",),
        "specimens": (
            "Specimen",
            "load_specimens",
            "make_overlay",
        ),
    },
)
