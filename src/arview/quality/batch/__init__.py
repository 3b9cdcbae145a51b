"""Batches of inspections, on one machine or a Dask cluster."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.quality.batch.jobs_file import load_jobs as load_jobs
    from arview.quality.batch.run import BatchOptions as BatchOptions
    from arview.quality.batch.run import JobResult as JobResult
    from arview.quality.batch.run import run_batch as run_batch
    from arview.quality.batch.storage import read as read

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "jobs_file": ("load_jobs",),
        "run": (
            "BatchOptions",
            "JobResult",
            "run_batch",
        ),
        "storage": ("read",),
    },
)
