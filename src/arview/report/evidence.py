"""The data of a report: the inspection and what is available of the measurement, with reasons for what is absent."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from arview import measurement, reconstruction
from arview.cad import Part
from arview.errors import ArviewError, InputError
from arview.geometry import apply, invert
from arview.inspection import Inspection, fingerprint_of_file, load_inspection


@dataclass(frozen=True)
class ReportEvidence:
    """The data of a report, in the datum frame, mm.

    Attributes:
        inspection: the inspection.
        source: its file.
        sha256: fingerprint of the inspection, as in the results store and the exports.
        part: the part with its CAD model; None when not given.
        sparse: photos with their poses, and points; None without the folder of the reconstruction.
        cloud: dense cloud in the colours of the photos, or None.
        distances: distances of the cloud to the CAD model, or None.
        absent: sentences that explain why fields are None, by the name of the field.
    """

    inspection: Inspection
    source: Path
    sha256: str
    part: Part | None = None
    sparse: reconstruction.SparseModel | None = None
    cloud: reconstruction.DenseCloud | None = None
    distances: measurement.DistanceMap | None = None
    absent: dict[str, str] = field(default_factory=dict)


def gather(
    source: str | Path, part: Part | None = None, folder: str | Path | None = None, photos: str | Path | None = None
) -> ReportEvidence:
    """Collect the available data of an inspection.

    Args:
        source: ``inspection.json``.
        part: the part that was inspected; without it the report has no CAD model.
        folder: folder of a reconstruction; default: the folder of the inspection, if it contains one.
        photos: folder of the photos if they were moved.

    Raises:
        InputError: the inspection cannot be read, or ``folder`` was given and is not a reconstruction.
        MismatchError: the part is not the one that was inspected.
    """
    source = Path(source)
    inspection = load_inspection(source, None if part is None else part.model)
    sha256 = fingerprint_of_file(source)
    absent: dict[str, str] = {}
    if part is None:
        absent["part"] = "The CAD model was not given (--part), so it is not drawn."
    sparse, cloud = _reconstruction(inspection, source, part, folder, photos, absent)
    distances = _distances(inspection, source, part, cloud, absent)
    if cloud is None and distances is None:
        absent.setdefault("cloud", "This inspection has no cloud.")
    return ReportEvidence(
        inspection, source, sha256, part=part, sparse=sparse, cloud=cloud, distances=distances, absent=absent
    )


def _reconstruction(
    inspection: Inspection,
    source: Path,
    part: Part | None,
    folder: str | Path | None,
    photos: str | Path | None,
    absent: dict[str, str],
) -> tuple[reconstruction.SparseModel | None, reconstruction.DenseCloud | None]:
    """Photos and cloud of the reconstruction, transformed to the datum frame."""
    if folder is None and not (source.parent / "reconstruction.json").is_file():
        absent["sparse"] = "The folder of the reconstruction is not available (--folder), so there are no photos."
        return None, None
    if inspection.datum_system is None:
        absent["sparse"] = "The inspection does not contain the pose of its frame in the photos (file of version 1.0)."
        return None, None
    location = source.parent if folder is None else Path(folder)
    try:
        found = measurement.read_folder(location, photos)
        if part is not None:
            found = measurement.in_model_frame(found, part)
        elif found.scale.model_from_scan is None:
            raise InputError("the part was located by the shape of its cloud, which needs the CAD model (--part)")
    except ArviewError as error:
        if folder is not None:
            raise
        absent["sparse"] = f"The photos could not be used: {error}."
        return None, None
    datum_from_rough = invert(np.array(inspection.datum_system.rough_from_datum))
    sparse = found.sparse.transformed(1.0, datum_from_rough)
    cloud = found.cloud
    if cloud is None:
        absent["cloud"] = "The reconstruction has no dense cloud."
        return sparse, None
    points = apply(datum_from_rough, np.asarray(cloud.points, dtype=np.float64))
    return sparse, replace(cloud, points=points, normals=cloud.normals @ datum_from_rough[:3, :3].T.astype(np.float32))


def _distances(
    inspection: Inspection,
    source: Path,
    part: Part | None,
    cloud: reconstruction.DenseCloud | None,
    absent: dict[str, str],
) -> measurement.DistanceMap | None:
    """The distances that were written beside the inspection, or those computed from cloud and CAD model."""
    report = inspection.distance_map
    if report is None:
        absent["distances"] = (
            "This inspection has no distance map: there was no cloud, or no part of it was near the CAD model."
        )
        return None
    written = next((source.parent / name for name in report.files if name.endswith(".ply")), None)
    if written is not None and written.is_file():
        return measurement.read_distance_ply(written, report.reach_mm, report.statistics)
    if cloud is not None and part is not None:
        return measurement.distance_map(cloud, part.model, reach_mm=report.reach_mm)
    absent["distances"] = (
        "The distances are not available (`arview measure` writes them beside the inspection unless --no-maps is"
        " given): only their statistics are shown."
    )
    return None
