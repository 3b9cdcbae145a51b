"""What `arview reconstruct` left in its folder, as the measurement needs it."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from arview.camera import Camera
from arview.errors import InputError
from arview.reconstruction.colmap import read_reconstruction, sparse_model_of
from arview.reconstruction.scale.types import ScaleResult
from arview.reconstruction.types import DenseCloud, Photo, SparseModel


@dataclass(frozen=True)
class MetricReconstruction:
    """A reconstruction in mm in the rough frame of the CAD: poses and points, their scale, the cloud when there."""

    sparse: SparseModel
    scale: ScaleResult
    cloud: DenseCloud | None


def read_folder(folder: str | Path, photos: str | Path | None = None, with_cloud: bool = True) -> MetricReconstruction:
    """The reconstruction in a folder of `arview reconstruct`.

    Args:
        folder: what it wrote.
        photos: folder of the photos, when they are no longer where they were.
        with_cloud: read the cloud too.

    Raises:
        InputError: no such folder, stages that are missing, no scale or no CAD frame, photos that are not found.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give the one that `arview reconstruct` wrote")
    scale = ScaleResult.from_provenance(_read(folder / "scale.json"))
    if scale.scale is None:
        raise InputError(f"{folder}: lengths are in an arbitrary unit; reconstruct with --part, --board or --tag")
    if scale.model_from_scan is None:
        raise InputError(f"{folder}: the part was not found in the photos, there is no CAD frame: {scale.why_no_frame}")
    listed = [_photo(entry, folder, photos) for entry in _read(folder / "photos.json")["photos"]]
    try:
        sparse = sparse_model_of(read_reconstruction(folder / "sparse" / "model"), listed)
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(f"{folder}: the sparse model is missing or damaged ({error}); reconstruct again") from error
    if not sparse.photos:
        raise InputError(f"{folder}: the sparse model holds none of the photos; reconstruct again")
    covariance = folder / "sparse" / "covariance.npy"
    if covariance.is_file():
        sparse = replace(sparse, pose_covariance=np.load(covariance))
    cloud = None
    if with_cloud and (folder / "cloud.ply").is_file():
        from arview.reconstruction.dense import read_ply

        cloud = read_ply(folder / "cloud.ply")
    return MetricReconstruction(sparse.transformed(scale.scale, scale.model_from_scan), scale, cloud)


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(
            f"{path}: is missing ({error.strerror or error}); `arview reconstruct --part` writes it"
        ) from error
    except ValueError as error:
        raise InputError(f"{path}: is damaged ({error}); reconstruct again") from error


def _photo(entry: dict[str, Any], folder: Path, photos: str | Path | None) -> Photo:
    """A photo of photos.json, where it lies now; its camera is a placeholder for that of the sparse model."""
    name, width, height = entry["name"], int(entry["width"]), int(entry["height"])
    places = [Path(photos) / name] if photos is not None else [Path(entry.get("path", "")), folder / "frames" / name]
    path = next((place for place in places if place.is_file()), None)
    if path is None:
        hint = "it is not there" if photos is not None else "say with --photos where the photos are"
        raise InputError(f"{places[0] if photos is not None else name}: photo not found; {hint}")
    camera = Camera(width, height, float(width), float(width), 0.5 * width, 0.5 * height)
    return Photo(name, path, width, height, entry["lens"], camera)
