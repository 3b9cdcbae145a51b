"""What follows a decision: it is shown in the report of the job, and copied to the store of results."""

from __future__ import annotations

import logging
import os
import threading

from arview.errors import ArviewError
from arview.quality import history
from arview.station import walk

logger = logging.getLogger("arview.station.live")

_WRITING = threading.Lock()
"""One report is changed at a time."""


def tell_report_and_history(job: walk.JobFolder) -> None:
    """Put the decisions of a job into its report, and add them to the store of ``ARVIEW_STORE`` if there is one.

    The log of decisions holds them already: what goes wrong here is told, and mended by the next decision.
    """
    inspection = (job.parent or job).path / "inspection.json"
    with _WRITING:
        try:
            from arview.report import update_reports

            update_reports(job.path)
            if store := os.environ.get("ARVIEW_STORE"):
                with history.HistoryStore(store) as opened:
                    opened.add(inspection)
        except ArviewError as error:
            logger.warning("%s: %s", job.id, error)
        except Exception:
            logger.exception("the decisions of %s could not be put into its report", job.id)
