"""Camera poses made elsewhere: COLMAP models, Metashape's cameras as XML, nerfstudio's ``transforms.json``.

| source | pose in the file | camera axes | first pixel |
|---|---|---|---|
| COLMAP, text or binary | camera from world | x right, y down, z forward | centre at (0.5, 0.5) |
| Metashape XML | world (chunk) from camera | x right, y down, z forward | corner at (0, 0) |
| nerfstudio | world from camera | x right, y up, z backward | corner at (0, 0) |
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any
from xml.etree import ElementTree

import numpy as np

from arview.camera import Camera, load_cameras, require_brown
from arview.errors import InputError
from arview.geometry import Array, invert, orthonormalise, rigid
from arview.reconstruction.colmap import import_pycolmap
from arview.reconstruction.types import Photo

_OPENGL_AXES = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class GivenPose:
    """The pose of one photo in a frame and unit of its own: ``cam_from_scan`` (4,4) rigid."""

    name: str
    camera: Camera
    cam_from_scan: Array


def read_poses(path: str | Path) -> tuple[GivenPose, ...]:
    """Poses and cameras of the photos in a file or folder.

    Args:
        path: folder of a COLMAP model (or above ``sparse/0`` or ``0``), Metashape XML, or ``transforms.json``.

    Raises:
        InputError: nothing of these is there, the file is damaged, or a lens model is not supported.
    """
    path = Path(path)
    known = "give a COLMAP model, Metashape XML or transforms.json"
    if path.is_dir():
        places = [path, path / "sparse" / "0", path / "0", path / "sparse"]
        model = next((place for place in places if any(file.is_file() for file in _camera_files(place))), None)
        if model is not None:
            return _read_colmap(model)
        if not (path / "transforms.json").is_file():
            raise InputError(f"{path}: holds no COLMAP model (cameras.bin or cameras.txt) and no transforms.json")
        path = path / "transforms.json"
    if not path.is_file():
        raise InputError(f"{path}: no such file or folder; {known}")
    read = _READERS.get(path.suffix.lower())
    if read is None:
        raise InputError(f"{path}: is no pose file known here; {known}")
    return read(path)


def photos_with_poses(
    photos: Sequence[Photo], poses: Sequence[GivenPose], source: str | Path
) -> tuple[list[tuple[Photo, Array]], list[tuple[str, str]]]:
    """Photos with the given camera and pose, and (name, reason) of the others.

    Photos are found by name, by file name, or by file name without its ending, as far as these are unique.

    Raises:
        InputError: fewer than three photos have a pose.
    """
    tables: list[dict[str, GivenPose | None]] = [{}, {}, {}]
    for one in poses:
        for table, name in zip(tables, _keys(one.name), strict=True):
            table[name] = None if name in table else one
    found: list[tuple[Photo, Array]] = []
    left_out = []
    lenses: dict[tuple[Any, ...], str] = {}
    for photo in photos:
        pose = next(
            (p for t, key in zip(tables, _keys(photo.name), strict=True) if (p := t.get(key)) is not None), None
        )
        if pose is None:
            left_out.append((photo.name, f"has no pose in {source}"))
            continue
        camera = pose.camera
        if abs(np.log(camera.width / camera.height) - np.log(photo.width / photo.height)) > 0.01:
            size = f"{camera.width}×{camera.height}"
            reason = f"is {photo.width}×{photo.height} px upright, its camera in {source} {size}; turned or cropped"
            left_out.append((photo.name, reason))
            continue
        if (camera.width, camera.height) != (photo.width, photo.height):
            camera = camera.scaled(photo.width, photo.height)
        key = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, *camera.dist.tolist())
        lens = lenses.setdefault(key, f"given camera {len(lenses) + 1}")
        # Only one focal length with k1 and k2 is refined with the poses; other lenses are kept as they are given.
        is_simple = camera.fx == camera.fy and not camera.dist[2:].any()
        given = replace(photo, camera=camera, lens=lens, is_calibrated=not is_simple)
        found.append((given, pose.cam_from_scan))
    if len(found) < 3:
        example = f" (for example {poses[0].name})" if poses else ""
        raise InputError(
            f"{source}: {len(poses)} poses{example}, but only {len(found)} of the {len(photos)} photos have one; the "
            "names must be those of the photos"
        )
    return found, left_out


def _keys(name: str) -> tuple[str, str, str]:
    path = PurePosixPath(name.replace("\\", "/"))
    return path.as_posix(), path.name.lower(), path.stem.lower()


# --- readers ---------------------------------------------------------------------------------------------


def _read_colmap(folder: Path) -> tuple[GivenPose, ...]:
    pycolmap = import_pycolmap()
    try:
        model = pycolmap.Reconstruction(str(folder))
        images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    except (ValueError, RuntimeError, OSError, IndexError) as error:
        raise InputError(f"{folder}: the COLMAP model cannot be read ({error})") from error
    cameras = load_cameras(next(path for path in _camera_files(folder) if path.is_file()))
    return tuple(
        _given(image.name, cameras[str(image.camera_id)], np.asarray(image.cam_from_world().matrix()), folder)
        for image in images
    )


def _camera_files(folder: Path) -> tuple[Path, Path]:
    return folder / "cameras.bin", folder / "cameras.txt"


def _read_transforms(path: Path) -> tuple[GivenPose, ...]:
    poses = []
    try:
        frames = json.loads(path.read_text(encoding="utf-8-sig"))["frames"]
        cameras = load_cameras(path)
        for index, frame in enumerate(frames):
            camera = cameras[f"frames/{index}"] if "" not in cameras else cameras[""]
            world_from_cam = np.array(frame["transform_matrix"], dtype=np.float64) @ _OPENGL_AXES
            poses.append(_given(str(frame["file_path"]), camera, world_from_cam, path, is_inverse=True))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: is not a transforms.json of nerfstudio ({type(error).__name__}: {error})") from error
    return tuple(poses)


def _read_metashape(path: Path) -> tuple[GivenPose, ...]:
    cameras = load_cameras(path)  # which refuses what is not of Metashape
    poses = []
    try:
        root = ElementTree.parse(path).getroot()
        calibrated = [sensor.get("id") for sensor in root.iter("sensor") if sensor.find("calibration") is not None]
        camera_of_sensor = dict(zip(calibrated, cameras.values(), strict=True))
        for camera in root.iter("camera"):
            text = camera.findtext("transform")  # none where Metashape did not align the photo
            if text:
                world_from_cam = np.array(text.split(), dtype=np.float64).reshape(4, 4)
                own = camera_of_sensor[camera.get("sensor_id")]
                poses.append(_given(str(camera.get("label")), own, world_from_cam, path, is_inverse=True))
    # LookupError: a sensor that does not exist, or an encoding.
    except (OSError, ValueError, LookupError, TypeError, ElementTree.ParseError) as error:
        raise InputError(f"{path}: is not an XML file of cameras by Metashape ({error})") from error
    if not poses:
        raise InputError(f"{path}: holds no aligned camera")
    return tuple(poses)


def _given(name: str, camera: Camera, matrix: Array, path: Path, is_inverse: bool = False) -> GivenPose:
    """The pose of a 4×4 or 3×4 matrix, or of its inverse; its rotation is made exactly orthonormal.

    Raises:
        InputError: the matrix is not a pose, or the lens has another model than Brown's.
    """
    if matrix.shape not in ((4, 4), (3, 4)) or not np.isfinite(matrix).all():
        raise InputError(f"{path}: a pose is not a 4×4 matrix of numbers")
    s = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    if s.min() <= 0 or s.max() / s.min() > 1.01 or np.linalg.det(matrix[:3, :3]) < 0:
        raise InputError(f"{path}: the matrix of a pose is not a rotation")
    pose = orthonormalise(rigid(matrix[:3, :3], matrix[:3, 3]))
    return GivenPose(name, require_brown(camera, str(path)), invert(pose) if is_inverse else pose)


_READERS: dict[str, Callable[[Path], tuple[GivenPose, ...]]] = {".xml": _read_metashape, ".json": _read_transforms}
"""Readers of files by suffix; a folder is read as a model of COLMAP."""
