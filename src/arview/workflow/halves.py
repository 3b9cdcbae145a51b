"""The step of an inspection that measures two halves of the photos apart and compares them."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

from arview import measurement, reconstruction
from arview.core.progress import Progress
from arview.errors import CannotMeasureError
from arview.inspection import Inspection, Repeatability
from arview.workflow.prepare import Prepared


def with_halves(
    inspection: Inspection,
    found: measurement.MetricReconstruction,
    folder: Path,
    prepared: Prepared,
    progress: Progress,
) -> Inspection:
    """The inspection with the comparison of two halves of its photos, or with the reason why there is none.

    Args:
        inspection: of all photos.
        found: the reconstruction that was measured.
        folder: of the reconstruction's files.
        prepared: the job.
        progress: called with (step, done, total).
    """
    began = time.process_time()
    progress("halves", 0, 2)
    if found.scale.model_from_scan is None:
        return replace(inspection, repeatability=Repeatability(reason="the part was found in the cloud alone"))
    try:
        halves = reconstruction.halves_of(
            folder / "sparse" / "model", found.sparse, reconstruction.HalvesOptions(sparse=prepared.reconstruct.sparse)
        )
    except CannotMeasureError as error:
        return replace(inspection, repeatability=Repeatability(reason=str(error)))
    compared = measurement.measure_halves(found, halves, prepared.part, prepared.measure, progress=progress)
    compared = replace(compared, cpu_s=round(time.process_time() - began, 2))
    return measurement.with_repeatability(inspection, compared, prepared.measure)
