"""Reading what `arview reconstruct` wrote, or a cloud alone, for the measurement."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from arview.cad.part import Part
from arview.camera import Camera
from arview.errors import InputError
from arview.reconstruction.colmap import read_reconstruction, sparse_model_of
from arview.reconstruction.scale.types import Consistency, ScaleEvidence, ScaleResult
from arview.reconstruction.types import DenseCloud, Photo, SparseModel

_SCALE_STD = 1e-3
"""Relative standard deviation of a scale that follows from the shape of the cloud alone; datums improve it."""


@dataclass(frozen=True)
class MetricReconstruction:
    """A reconstruction in mm in the rough frame of the CAD.

    Attributes:
        sparse: poses and points.
        scale: the scale and what it comes from.
        cloud: the dense cloud, or None.
    """

    sparse: SparseModel
    scale: ScaleResult
    cloud: DenseCloud | None


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
        sparse = sparse_model_of(read_reconstruction(folder / "sparse" / "model"), listed)
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(f"{folder}: the sparse model is missing or damaged ({error}); reconstruct again") from error
    if not sparse.photos:
        raise InputError(f"{folder}: the sparse model holds none of the photos; reconstruct again")
    covariance = folder / "sparse" / "covariance.npy"
    if covariance.is_file():
        sparse = replace(sparse, pose_covariance=np.load(covariance))
    cloud = None
    if has_cloud:
        from arview.reconstruction.dense import read_ply

        cloud = read_ply(folder / "cloud.ply")
    frame = np.eye(4) if scale.model_from_scan is None else scale.model_from_scan
    sparse = sparse if scale.scale is None else sparse.transformed(scale.scale, frame)
    return MetricReconstruction(sparse, scale, cloud)


def read_cloud(path: str | Path) -> MetricReconstruction:
    """Read a cloud without photos, in mm, in any frame, from a PLY file with or without normals.

    Raises:
        InputError: the file is not PLY, or holds no points.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; give a cloud as PLY, in mm")
    none = np.zeros(0)
    empty = SparseModel(
        (), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), none, none.astype(np.int32), none.astype(np.int32),
        np.zeros((0, 2)),
    )  # fmt: skip
    scale = ScaleResult(1.0, None, None, None, (), (), "a cloud without photos", Consistency(True, ""))
    return MetricReconstruction(empty, scale, _any_ply(path))


def _any_ply(path: Path) -> DenseCloud:
    """The cloud of a PLY file that arview or another program wrote."""
    from arview.reconstruction.dense import read_ply

    try:
        return read_ply(path)
    except InputError:
        pass
    import trimesh

    try:
        with path.open("rb") as file:
            content = trimesh.exchange.ply.load_ply(file)
        points = np.asarray(content["vertices"], dtype=np.float64).reshape(-1, 3)
        rows = content.get("metadata", {}).get("_ply_raw", {}).get("vertex", {}).get("data")
        names = getattr(getattr(rows, "dtype", None), "names", None) or ()
    except Exception as error:  # a damaged file may make the reader raise anything
        raise InputError(f"{path}: is not a PLY file with points ({error})") from error
    has_normals = {"nx", "ny", "nz"} <= set(names)
    normals = np.stack([rows[name].ravel() for name in ("nx", "ny", "nz")], axis=1) if has_normals else 0.0 * points
    count = len(points)
    return DenseCloud(
        points, normals.astype(np.float32), np.zeros((count, 3), np.uint8), np.full(count, np.nan, np.float32),
        np.zeros(count, np.uint8),
    )  # fmt: skip


def in_model_frame(reconstruction: MetricReconstruction, part: Part) -> MetricReconstruction:
    """The reconstruction in the frame of the CAD, found from the cloud's shape unless its frame is known.

    Raises:
        InputError: the part is not found in the cloud, or the scale is unknown and no two datums have a distance.
    """
    from arview.measurement.cloud.global_registration import find_model_in_cloud

    scale, cloud = reconstruction.scale, reconstruction.cloud
    if scale.model_from_scan is not None or cloud is None:
        return reconstruction
    if scale.scale is None and sum(d.feature in ("hole", "pin", "cylinder") for d in part.datums) < 2:
        raise InputError(
            "cloud: lengths are in an arbitrary unit, and the part file has no two datums whose distance gives the "
            "scale; reconstruct with a board, a tag or a scale bar"
        )
    found = find_model_in_cloud(cloud, part.model, None if scale.scale is None else 1.0)
    normals = np.asarray(cloud.normals @ found.model_from_scan[:3, :3].T, dtype=np.float32)
    moved = replace(
        cloud, points=found.points_in_model(np.asarray(cloud.points, dtype=np.float64)), normals=normals,
        sigma=np.asarray(cloud.sigma * found.scale, dtype=np.float32),
    )  # fmt: skip
    evidence = scale.evidence
    std = scale.scale_std
    if scale.scale is None:
        std = _SCALE_STD
        evidence = (ScaleEvidence("cad", found.scale, std, "the cloud's shape"),)
    scale = replace(
        scale, scale=found.scale * (scale.scale or 1.0), scale_std=std, model_from_scan=found.model_from_scan,
        evidence=evidence, warnings=(*scale.warnings, "the part was found by the shape of the cloud alone"),
    )  # fmt: skip
    return MetricReconstruction(reconstruction.sparse.transformed(found.scale, found.model_from_scan), scale, moved)


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
