"""What a report is made of: the inspection, and whatever of the measurement is still there; what is not, and why."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from arview.cad.part import Part
from arview.errors import ArviewError, InputError
from arview.geometry import apply, invert
from arview.inspection import Inspection, load_inspection
from arview.measurement.cloud.distance_map import (
    DistanceMap,
    distance_map,
    read_distance_ply,
)
from arview.reconstruction.types import DenseCloud, SparseModel


@dataclass(frozen=True)
class Evidence:
    """All in the datum frame, which is the frame ``model`` of the inspection, mm.

    Attributes:
        inspection: what was measured.
        source: its file.
        sha256: of that file, hexadecimal.
        part: the CAD; None when it was not given.
        sparse: photos with their poses, and points; None without the folder of the reconstruction.
        cloud: dense cloud in the colours of the photos, or None.
        distances: of the cloud to the CAD, or None.
        absent: why something is None, in a sentence, by the name of the field.
    """

    inspection: Inspection
    source: Path
    sha256: str
    part: Part | None = None
    sparse: SparseModel | None = None
    cloud: DenseCloud | None = None
    distances: DistanceMap | None = None
    absent: dict[str, str] = field(default_factory=dict)


def gather(
    source: str | Path, part: Part | None = None, folder: str | Path | None = None, photos: str | Path | None = None
) -> Evidence:
    """Everything that belongs to the inspection in a file, as far as it is there.

    Args:
        source: ``inspection.json``.
        part: what was measured against; without it there is no CAD in the report.
        folder: of `arview reconstruct`; default: the folder of the inspection, if it is one.
        photos: where the photos are, when not where they were.

    Raises:
        InputError: the inspection cannot be read, or ``folder`` was given and is no reconstruction.
        MismatchError: the part is not the one that was inspected.
    """
    source = Path(source)
    inspection = load_inspection(source, None if part is None else part.model)
    sha256 = hashlib.sha256(source.read_bytes()).hexdigest()
    absent: dict[str, str] = {}
    if part is None:
        absent["part"] = "The CAD was not given (--part), so that nothing is drawn of it."
    sparse, cloud = _reconstruction(inspection, source, part, folder, photos, absent)
    distances = _distances(inspection, source, part, cloud, absent)
    if cloud is None and distances is None:
        absent.setdefault("cloud", "There is no cloud with this inspection.")
    return Evidence(inspection, source, sha256, part, sparse, cloud, distances, absent)


def _reconstruction(
    inspection: Inspection, source: Path, part: Part | None, folder: str | Path | None, photos: str | Path | None,
    absent: dict[str, str],
) -> tuple[SparseModel | None, DenseCloud | None]:  # fmt: skip
    """Photos and cloud of the reconstruction, moved to the datum frame."""
    from arview.measurement.folder import in_model_frame, read_folder

    if folder is None and not (source.parent / "reconstruction.json").is_file():
        absent["sparse"] = "The folder of the reconstruction is not at hand (--folder), so that there are no photos."
        return None, None
    if inspection.datum_system is None:
        absent["sparse"] = "The inspection does not say where its frame is in the photos (file of version 1.0)."
        return None, None
    place = source.parent if folder is None else Path(folder)
    try:
        found = read_folder(place, photos)
        if part is not None:
            found = in_model_frame(found, part)
        elif found.scale.model_from_scan is None:
            raise InputError("the part was found by the shape of its cloud, which needs the CAD (--part)")
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
    inspection: Inspection, source: Path, part: Part | None, cloud: DenseCloud | None, absent: dict[str, str]
) -> DistanceMap | None:
    """Those that were written beside the inspection, else those of the cloud to the CAD."""
    report = inspection.distance_map
    if report is None:
        absent["distances"] = (
            "There is no distance map in this inspection: there was no cloud, or nothing of it was near."
        )
        return None
    written = next((source.parent / name for name in report.files if name.endswith(".ply")), None)
    if written is not None and written.is_file():
        return read_distance_ply(written, report.reach_mm, report.statistics)
    if cloud is not None and part is not None:
        return distance_map(cloud, part.model, reach_mm=report.reach_mm)
    absent["distances"] = (
        "The distances themselves are not at hand (`arview measure` writes them beside the inspection, unless"
        " --no-maps was given): only their statistics are shown."
    )
    return None
