"""Some components measured again, in photos that were added to those of the first measurement."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from arview.cad import Part
from arview.core.progress import Progress
from arview.errors import InputError
from arview.inspection import ComponentDeviation, Inspection
from arview.measurement.folder import MetricReconstruction
from arview.measurement.measurand import measurand_of
from arview.measurement.options import MeasureOptions
from arview.measurement.photo import load_views
from arview.measurement.records import (
    component_record,
    datum_doubts,
    datum_record,
    failed_datum_text,
    in_partial_frame,
    provenance_of,
)
from arview.measurement.run import align_to_datums, measure_all
from arview.measurement.seen_from import seen_from, with_seen_from
from arview.measurement.uncertainty.pose_propagation import PosePropagation
from arview.reconstruction import SparseModel, base_names


def measure_again(
    reconstruction: MetricReconstruction,
    part: Part,
    components: Sequence[str],
    added: Sequence[str],
    options: MeasureOptions | None = None,
    *,
    progress: Progress | None = None,
) -> Inspection:
    """Measure components where the added photos show them, in the datum frame that the earlier photos show.

    The covariance of all poses together is propagated, so that U includes how well the added photos are placed among
    the earlier ones.

    Args:
        reconstruction: all photos, in mm in the rough frame of the CAD.
        part: CAD, roles, tolerances, datums.
        components: names of those that are measured again.
        added: names of the added photos.
        options: see `MeasureOptions`; a cloud is not used.
        progress: called with (what, done, total).

    Raises:
        InputError: a component carries a datum or is the base, or a datum is not covered by the earlier photos.
    """
    began = time.process_time()
    options, tell = options or MeasureOptions(), progress or (lambda what, done, total: None)
    options = replace(options, methods=tuple(one for one in options.methods if one != "cloud"), maps_folder=None)
    base = base_names(part)
    check_not_datums(part, components)
    sparse = reconstruction.sparse
    is_added = np.array([photo.name in added for photo in sparse.photos], dtype=np.bool_)
    earlier, later = (_some(sparse, chosen) for chosen in (~is_added, is_added))
    with threadpool_limits(1, "blas"):
        views = load_views(earlier, part.model)
        first = replace(reconstruction, sparse=earlier)
        datums = measure_all(first, views, part, base, options, tell, {})
        tell("datums", 0, 1)
        alignment, failed = align_to_datums(first, views, part, base, datums)
        results = measure_all(
            replace(reconstruction, sparse=later), load_views(later, part.model), part, components, options, tell, {}
        )
        poses = None
        if sparse.pose_covariance is not None:
            poses = PosePropagation(
                sparse,
                part.model,
                alignment,
                base,
                used=lambda name: is_added if name in components else ~is_added,
            )
        seen = seen_from(later, part.model)
        records: list[ComponentDeviation] = []
        for name in components:
            measurand = measurand_of(name, part)
            record = component_record(name, results[name], measurand, alignment, poses, part, options)
            records.append(with_seen_from(in_partial_frame(record, failed), seen))
            tell("uncertainty", len(records), len(components))
    unknown = ["the covariance of the camera poses is unknown: U does not include it"] if poses is None else []
    provenance = provenance_of(replace(reconstruction, sparse=later, cloud=None), options, time.process_time() - began)
    return Inspection(
        part=part.name,
        serial=part.serial or "",
        model_hash=part.model.source_hash,
        created=datetime.now(UTC),
        components=tuple(records),
        provenance=provenance,
        datum_system=datum_record(alignment, part, base, first, failed),
        warnings=(*(failed_datum_text(one) for one in failed), *datum_doubts(alignment), *unknown),
    )


def check_not_datums(part: Part, components: Sequence[str]) -> None:
    """Raise InputError if a component carries a datum or is the base: all positions are stated relative to these."""
    carriers = {*base_names(part), *(datum.component for datum in part.datums)}
    wrong = [name for name in components if name in carriers]
    if wrong:
        raise InputError(
            f"{', '.join(wrong)}: carries the datums, so that all components are to be measured anew when it has moved"
        )


def _some(sparse: SparseModel, chosen: NDArray[np.bool_]) -> SparseModel:
    """Some of the photos, for measuring: without covariance, and without the points that nothing asks for there."""
    photos = tuple(photo for photo, is_chosen in zip(sparse.photos, chosen, strict=True) if is_chosen)
    none = np.zeros(0, dtype=np.int32)
    return replace(
        sparse,
        photos=photos,
        pose_covariance=None,
        observed_point=none,
        observed_photo=none,
        observed_px=np.zeros((0, 2)),
    )
