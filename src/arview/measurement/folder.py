"""Reading what `arview reconstruct` wrote, or a cloud alone, for the measurement."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from arview import reconstruction
from arview.cad import Model, Part
from arview.camera import Camera
from arview.core.extras import require
from arview.errors import InputError
from arview.measurement.cloud.enlarged import enlargement
from arview.measurement.cloud.global_registration import find_model_in_cloud
from arview.measurement.cloud.placing import cloud_in_mm, moved_to_model, orient_normals, place_cloud, scaled
from arview.measurement.cloud.reading import (
    UNITS_MM,
    USUAL_UNITS,
    check_given_unit,
    possible_units,
    read_points,
    unit_of_option,
)
from arview.measurement.cloud.scale_check import cloud_scale
from arview.reconstruction import (
    Consistency,
    DenseCloud,
    Photo,
    ScaleEvidence,
    ScaleResult,
    SparseModel,
    base_names,
    read_model,
)

BY_SHAPE = "the part was found by the shape of the cloud alone"
"""Warning that nothing but its shape says how the part lies in the cloud."""
_NORMALS_WITHIN_MM = 3.0
"""Distance from the CAD within which the side of a cloud's normals is compared with the surface's."""
_SCALE_STD = 1e-3
"""Relative standard deviation of a scale that follows from the shape of the cloud alone; datums improve it."""


@dataclass(frozen=True)
class MetricReconstruction:
    """A reconstruction in mm in the rough frame of the CAD.

    Attributes:
        sparse: poses and points.
        scale: the scale and what it comes from.
        cloud: the dense cloud, or None.
        rescales: a cloud alone is divided by the factor by which it is larger than the CAD's base.
        cloud_factors, cloud_units: of a cloud whose unit its size leaves open, factors that are to be tried, and the
            units that they mean.
    """

    sparse: SparseModel
    scale: ScaleResult
    cloud: DenseCloud | None
    cloud_factors: tuple[float, ...] = ()
    rescales: bool = False
    cloud_units: tuple[str, ...] = ()


def read_folder(folder: str | Path, photos: str | Path | None = None, with_cloud: bool = True) -> MetricReconstruction:
    """Read the reconstruction in a folder of `arview reconstruct`.

    Args:
        folder: what it wrote.
        photos: folder of the photos, if they have been moved.
        with_cloud: read the cloud too.

    Raises:
        InputError: the folder does not exist, stages are missing, there is no scale or no CAD frame, or photos are not
            found.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give the one that `arview reconstruct` wrote")
    scale = ScaleResult.from_provenance(_read(folder / "scale.json"))
    has_cloud = with_cloud and (folder / "cloud.ply").is_file()
    if scale.scale is None and not has_cloud:
        raise InputError(f"{folder}: lengths are in an arbitrary unit; reconstruct with --part, --board or --tag")
    if scale.model_from_scan is None and not has_cloud:
        raise InputError(f"{folder}: no CAD frame, because the part was not found in the photos: {scale.why_no_frame}")
    listed = [_photo(entry, folder, photos) for entry in _read(folder / "photos.json")["photos"]]
    try:
        sparse = read_model(folder / "sparse", listed)
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(f"{folder}: the sparse model is missing or damaged ({error}); reconstruct again") from error
    if not sparse.photos:
        raise InputError(f"{folder}: the sparse model holds none of the photos; reconstruct again")
    cloud = None
    if has_cloud:
        cloud = reconstruction.read_ply(folder / "cloud.ply")
    frame = np.eye(4) if scale.model_from_scan is None else scale.model_from_scan
    sparse = sparse if scale.scale is None else sparse.transformed(scale.scale, frame)
    return MetricReconstruction(sparse, scale, cloud)


def read_cloud(
    path: str | Path, model: Model | None = None, unit: str | None = None, rescales: bool = False
) -> MetricReconstruction:
    """Read a cloud without photos, in any frame, with or without normals.

    Args:
        path: a file as `measurement.cloud.reading.read_points` reads it.
        model: the CAD, by whose size the unit is found; without it the unit is mm.
        unit: of the file, see `measurement.cloud.reading.UNITS_MM`; None: as the file declares it, or by size.
        rescales: divide the cloud by the factor by which it is larger than the CAD's base.

    Raises:
        InputError: the file cannot be read, holds no points, or has the size of the CAD in no unit.
        MissingDependencyError: Open3D is not installed.
    """
    require("finding the part in a cloud", "open3d")
    path = Path(path)
    given = None if unit is None else unit_of_option(unit)
    own = _own_ply(path)
    if own is not None:
        factor = 1.0 if given is None else UNITS_MM[given]
        return replace(_cloud_alone(scaled(own, factor), (), ()), rescales=rescales)
    raw = read_points(path)
    known = given or raw.unit
    units = [known or "mm"]
    if known is None and model is not None:
        units = possible_units(raw, model.diameter_mm, str(path))
    elif known is not None and model is not None:
        check_given_unit(raw, known, model.diameter_mm, str(path))
    warnings = [f"cloud: {note}" for note in raw.notes]
    if given is None and units[0] != "mm" and len(units) == 1:
        how = "declared by the file" if raw.unit else "by its size beside the CAD's"
        warnings.append(f"the cloud is in {units[0]} ({how})")
    cloud = cloud_in_mm(raw, units[0])
    if len(cloud.points) < len(raw):
        warnings.append(f"the {len(raw)} points of the cloud were averaged to {len(cloud.points)}")
    factors = tuple(UNITS_MM[one] / UNITS_MM[units[0]] for one in units)
    alone = _cloud_alone(cloud, tuple(warnings), factors if len(factors) > 1 else ())
    return replace(alone, rescales=rescales, cloud_units=tuple(units) if len(units) > 1 else ())


def _own_ply(path: Path) -> DenseCloud | None:
    """The cloud of a PLY file that arview wrote, which is in mm, else None."""
    try:
        with path.open("rb") as file:
            is_own = b"property float sigma_mm" in file.read(1024)
        return reconstruction.read_ply(path) if is_own else None
    except (OSError, InputError):
        return None


def _cloud_alone(cloud: DenseCloud, warnings: tuple[str, ...], factors: tuple[float, ...]) -> MetricReconstruction:
    """A reconstruction without photos."""
    scale = ScaleResult(
        1.0,
        None,
        None,
        covariance=None,
        evidence=(),
        warnings=warnings,
        why_no_frame="a cloud without photos",
        consistency=Consistency(True, ""),
    )
    return MetricReconstruction(SparseModel.without_points(), scale, cloud, factors)


def in_model_frame(reconstruction: MetricReconstruction, part: Part) -> MetricReconstruction:
    """The reconstruction in the frame of the CAD, found from the cloud's shape unless its frame is known.

    Raises:
        InputError: the part is not found in the cloud, or the scale is unknown and no two datums have a distance.
    """
    scale, cloud = reconstruction.scale, reconstruction.cloud
    if scale.model_from_scan is not None or cloud is None:
        return reconstruction
    if scale.scale is None and sum(d.feature in ("hole", "pin", "cylinder") for d in part.datums) < 2:
        raise InputError(
            "cloud: lengths are in an arbitrary unit, and the part file has no two datums whose distance gives the "
            "scale; reconstruct with a board, a tag or a scale bar"
        )
    warnings = [*scale.warnings, BY_SHAPE]
    if scale.scale is None:
        found = find_model_in_cloud(cloud, part.model, None)
    else:
        units = reconstruction.cloud_units
        takes_first = bool(units) and units[0] not in USUAL_UNITS  # its size is clear, and another's is not
        found, factor = place_cloud(cloud, part.model, reconstruction.cloud_factors or (1.0,), takes_first)
        cloud = scaled(cloud, factor)
        if units:
            unit = units[reconstruction.cloud_factors.index(factor)]
            warnings.append(f"the cloud is in {unit}: in this unit the part was found in it")
    moved, turned = orient_normals(
        moved_to_model(cloud, found), part.model, _NORMALS_WITHIN_MM / enlargement(part.model)
    )
    if turned:
        warnings.append(turned)
    evidence, std = scale.evidence, scale.scale_std
    if scale.scale is not None and not reconstruction.sparse.photos:
        moved, std, note = _checked_scale(moved, part, reconstruction.rescales)
        warnings += [note] if note else []
    if scale.scale is None:
        std = _SCALE_STD
        evidence = (ScaleEvidence("cad", found.scale, std, "the cloud's shape"),)
    scale = replace(
        scale,
        scale=found.scale * (scale.scale or 1.0),
        scale_std=std,
        model_from_scan=found.model_from_scan,
        evidence=evidence,
        warnings=tuple(warnings),
    )
    return MetricReconstruction(reconstruction.sparse.transformed(found.scale, found.model_from_scan), scale, moved)


def _checked_scale(cloud: DenseCloud, part: Part, rescales: bool) -> tuple[DenseCloud, float | None, str]:
    """The cloud, rescaled if asked for; the relative standard uncertainty of its scale; and what was found, in words.

    A scale that contradicts the base's size has the whole difference as its uncertainty: it is not known whether the
    scanner is wrong or the part.
    """
    base = tuple(base_names(part))
    found = cloud_scale(cloud, part.model, base)
    if found is None or not (found.is_contradiction or rescales):
        return cloud, None, ""
    excess = found.factor - 1.0
    size = f"the cloud is {abs(100 * excess):.3f} % too {'large' if excess > 0 else 'small'} beside {', '.join(base)}"
    if rescales:
        center = part.model.bounds_in_model.mean(axis=0)
        points = center + (cloud.points - center) / found.factor
        return replace(cloud, points=points), found.std, f"{size}: it was divided by {found.factor:.5f}"
    return (
        cloud,
        float(np.hypot(excess, found.std)),
        (
            f"{size} (factor {found.factor:.5f}): the scale contradicts the CAD, and U includes this; if the scanner is"
            " wrong and not the part, measure with --rescale"
        ),
    )


def _read(path: Path) -> Any:
    """The content of a JSON file."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(
            f"{path}: is missing ({error.strerror or error}); `arview reconstruct --part` writes it"
        ) from error
    except ValueError as error:
        raise InputError(f"{path}: is damaged ({error}); reconstruct again") from error


def _photo(entry: dict[str, Any], folder: Path, photos: str | Path | None) -> Photo:
    """A photo of ``photos.json`` where it is now; its camera is a placeholder until the sparse model is read."""
    name, width, height = entry["name"], int(entry["width"]), int(entry["height"])
    places = [Path(photos) / name] if photos is not None else [Path(entry.get("path", "")), folder / "frames" / name]
    path = next((place for place in places if place.is_file()), None)
    if path is None:
        hint = "it is not in this folder" if photos is not None else "give the folder of the photos with --photos"
        raise InputError(f"{places[0] if photos is not None else name}: photo not found; {hint}")
    camera = Camera(width, height, float(width), float(width), 0.5 * width, 0.5 * height)
    return Photo(name, path, width, height, entry["lens"], camera)
