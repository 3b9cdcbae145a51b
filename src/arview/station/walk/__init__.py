"""Measuring while photos arrive: the folder of a job, and the process that works on it."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.station.walk.capture import capture_options as capture_options
    from arview.station.walk.capture import capture_photos as capture_photos
    from arview.station.walk.capture import open_folder as open_folder
    from arview.station.walk.capture import summary_lines as summary_lines
    from arview.station.walk.job import JobFolder as JobFolder
    from arview.station.walk.job import jobs_in as jobs_in
    from arview.station.walk.job import start_worker as start_worker
    from arview.station.walk.merged import BeforeAfter as BeforeAfter
    from arview.station.walk.merged import before_after as before_after
    from arview.station.walk.records import PhotoOrigin as PhotoOrigin
    from arview.station.walk.records import StoredPhoto as StoredPhoto
    from arview.station.walk.records import WalkState as WalkState
    from arview.station.walk.records import checked_hint as checked_hint
    from arview.station.walk.records import checked_time as checked_time

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "capture": (
            "capture_options",
            "capture_photos",
            "open_folder",
            "summary_lines",
        ),
        "job": (
            "JobFolder",
            "jobs_in",
            "start_worker",
        ),
        "merged": (
            "BeforeAfter",
            "before_after",
        ),
        "records": (
            "PhotoOrigin",
            "StoredPhoto",
            "WalkState",
            "checked_hint",
            "checked_time",
        ),
    },
)
