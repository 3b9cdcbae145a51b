"""Files of the dense reconstruction: depth and normal maps in COLMAP's format, and the cloud as PLY."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.core.atomic import replacing
from arview.errors import InputError, OutputError
from arview.reconstruction.dense.depth import DepthMap
from arview.reconstruction.types import DenseCloud

_FIELDS = {
    **dict.fromkeys(("x", "y", "z"), ("<f8", "double")),
    **dict.fromkeys(("nx", "ny", "nz"), ("<f4", "float")),
    **dict.fromkeys(("red", "green", "blue"), ("u1", "uchar")),
    "sigma_mm": ("<f4", "float"),
    "views": ("u1", "uchar"),
}
_VERTEX = np.dtype([(name, kind) for name, (kind, _) in _FIELDS.items()])
_PROPERTIES = [f"property {kind} {name}" for name, (_, kind) in _FIELDS.items()]


def write_map(path: Path, image: NDArray[np.float32]) -> None:
    """Write a (H,W) or (H,W,C) float32 array in COLMAP's format: ``width&height&channels&``, then channel by channel.

    Raises:
        OutputError: the folder cannot be created or written to.
    """
    channels = image.reshape(*image.shape[:2], -1)
    header = f"{channels.shape[1]}&{channels.shape[0]}&{channels.shape[2]}&".encode()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as file:
            file.write(header + np.ascontiguousarray(channels.transpose(2, 0, 1), dtype="<f4").tobytes())
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error


def write_maps(folder: Path, name: str, m: DepthMap) -> None:
    """Write depth (0: none) and normals in the camera frame, towards the camera, below ``folder/stereo``.

    Raises:
        OutputError: the folder cannot be written to.
    """
    camera, w = m.camera, m.planes[..., 0]
    is_known = (w > 0) & (m.scores > 0)
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    a, b = m.planes[..., 1] * camera.fx, m.planes[..., 2] * camera.fy
    normals = -np.stack([a, b, w - a * (u - camera.cx) / camera.fx - b * (v - camera.cy) / camera.fy], axis=-1)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    normals = np.where(is_known[..., None], normals / np.where(length > 0, length, 1.0), 0.0)
    depth = np.where(is_known, 1.0 / np.where(w > 0, w, 1.0), 0.0)
    write_map(folder / "stereo" / "depth_maps" / f"{name}.geometric.bin", depth.astype(np.float32))
    write_map(folder / "stereo" / "normal_maps" / f"{name}.geometric.bin", normals.astype(np.float32))


def write_ply(cloud: DenseCloud, path: str | Path) -> None:
    """Write the cloud as binary PLY: x y z nx ny nz red green blue sigma_mm views. Raises OutputError."""
    path = Path(path)
    rows = np.zeros(len(cloud.points), dtype=_VERTEX)
    for columns, names in ((cloud.points, "x y z"), (cloud.normals, "nx ny nz"), (cloud.colors, "red green blue")):
        for k, name in enumerate(names.split()):
            rows[name] = columns[:, k]
    rows["sigma_mm"], rows["views"] = cloud.sigma, cloud.views
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += _PROPERTIES
    try:
        with replacing(path) as file:
            file.write("\n".join([*lines, "end_header", ""]).encode() + rows.tobytes())
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error


def read_ply(path: str | Path) -> DenseCloud:
    """Read the cloud of a PLY file written by `write_ply`.

    Raises:
        InputError: the file cannot be read, is truncated or has other properties.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    header, found, body = data.partition(b"end_header\n")
    lines = header.decode("ascii", "replace").split("\n")
    properties = [line for line in lines if line.startswith("property ")]
    if not found or lines[0] != "ply" or properties != _PROPERTIES:
        raise InputError(f"{path}: is not a cloud written by arview")
    count = next((int(line.split()[2]) for line in lines if line.startswith("element vertex ")), -1)
    if len(body) != count * _VERTEX.itemsize:
        raise InputError(f"{path}: is truncated; reconstruct again")
    rows = np.frombuffer(body, dtype=_VERTEX)

    def columns(names: str) -> NDArray[Any]:
        return np.stack([rows[name] for name in names.split()], axis=-1)

    return DenseCloud(
        columns("x y z"),
        columns("nx ny nz"),
        columns("red green blue"),
        rows["sigma_mm"].astype(np.float32),
        rows["views"].astype(np.uint8),
    )
