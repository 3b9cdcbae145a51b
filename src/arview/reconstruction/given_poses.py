"""Camera poses made elsewhere: COLMAP models, Metashape's cameras as XML, nerfstudio's ``transforms.json``.

| source | pose in the file | camera axes | first pixel |
|---|---|---|---|
| COLMAP, text or binary | camera from world | x right, y down, z forward | centre at (0.5, 0.5) |
| Metashape XML | world (chunk) from camera | x right, y down, z forward | corner at (0, 0) |
| nerfstudio | world from camera | x right, y up, z backward | corner at (0, 0) |
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any
from xml.etree import ElementTree

import numpy as np

from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array, invert, orthonormalise, rigid
from arview.reconstruction.colmap import HALF_PX, import_pycolmap
from arview.reconstruction.types import Photo

_COLMAP_PARAMS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
_OPENGL_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
_MAX_XML_BYTES = 200_000_000


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
    if path.is_dir():
        places = [path, path / "sparse" / "0", path / "0", path / "sparse"]
        model = next((one for one in places if any((one / f"cameras.{end}").is_file() for end in ("bin", "txt"))), None)
        if model is not None:
            return _read_colmap(model)
        if (path / "transforms.json").is_file():
            return _read_transforms(path / "transforms.json")
        raise InputError(f"{path}: holds no COLMAP model (cameras.bin or cameras.txt) and no transforms.json")
    if not path.is_file():
        raise InputError(f"{path}: no such file or folder; give a COLMAP model, Metashape XML or transforms.json")
    if path.suffix.lower() == ".xml":
        return _read_metashape(path)
    if path.suffix.lower() == ".json":
        return _read_transforms(path)
    raise InputError(f"{path}: is no pose file known here; give a COLMAP folder, Metashape XML or transforms.json")


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
    except (ValueError, RuntimeError, OSError, IndexError) as error:
        raise InputError(f"{folder}: the COLMAP model cannot be read ({error})") from error
    poses = []
    for image in sorted(model.images.values(), key=lambda one: one.name):
        if image.has_pose:
            matrix = np.asarray(image.cam_from_world().matrix())
            camera = _colmap_camera(model.cameras[image.camera_id], folder)
            poses.append(GivenPose(image.name, camera, _rigid_of(matrix, folder)))
    return tuple(poses)


def _colmap_camera(camera: Any, folder: Path) -> Camera:
    names = _COLMAP_PARAMS.get(camera.model.name)
    if names is None:
        raise InputError(f"{folder}: the lens model {camera.model.name} is not supported; undistort the photos first")
    p = dict(zip(names, (float(value) for value in camera.params), strict=True))
    if any(p.get(name, 0.0) for name in ("k4", "k5", "k6")):
        raise InputError(f"{folder}: the rational lens model (k4 to k6) is not supported; undistort the photos first")
    return _camera(
        camera.width,
        camera.height,
        p.get("fx", p.get("f", 0.0)),
        fy=p.get("fy", p.get("f", 0.0)),
        cx=p["cx"] - HALF_PX,
        cy=p["cy"] - HALF_PX,
        terms=p,
        path=folder,
    )


def _read_transforms(path: Path) -> tuple[GivenPose, ...]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        frames = content["frames"]
        if content.get("camera_model", "OPENCV") not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE"):
            raise InputError(f"{path}: the lens model {content['camera_model']} is not supported")
        return tuple(_transforms_pose({**content, **frame}, path) for frame in frames)
    except InputError:
        raise
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: is not a transforms.json of nerfstudio ({type(error).__name__}: {error})") from error


def _transforms_pose(entry: dict[str, Any], path: Path) -> GivenPose:
    width, height = int(entry["w"]), int(entry["h"])
    fx = float(entry.get("fl_x") or 0.5 * width / np.tan(0.5 * float(entry["camera_angle_x"])))
    fy = float(entry.get("fl_y") or fx)
    cx, cy = float(entry.get("cx", 0.5 * width)) - HALF_PX, float(entry.get("cy", 0.5 * height)) - HALF_PX
    world_from_cam = _rigid_of(np.array(entry["transform_matrix"], dtype=np.float64), path)
    camera = _camera(width, height, fx, fy=fy, cx=cx, cy=cy, terms=entry, path=path)
    return GivenPose(str(entry["file_path"]), camera, invert(world_from_cam @ _OPENGL_AXES))


def _read_metashape(path: Path) -> tuple[GivenPose, ...]:
    try:
        data = path.read_bytes()
        if len(data) > _MAX_XML_BYTES or b"<!ENTITY" in data or b"<!DOCTYPE" in data:
            raise InputError(f"{path}: is not an XML file of cameras that Metashape exports")
        root = ElementTree.fromstring(data)
        sensors = {one.get("id"): one for one in root.iter("sensor")}
        poses = []
        for camera in root.iter("camera"):
            transform = camera.find("transform")
            if transform is None or not transform.text:
                continue  # a camera that Metashape did not align
            matrix = _rigid_of(np.array(transform.text.split(), dtype=np.float64).reshape(4, 4), path)
            sensor = sensors[camera.get("sensor_id")]
            poses.append(GivenPose(str(camera.get("label")), _metashape_camera(sensor, path), invert(matrix)))
    except InputError:
        raise
    # LookupError: the file names an encoding that does not exist.
    except (OSError, ValueError, LookupError, TypeError, ElementTree.ParseError) as error:
        raise InputError(f"{path}: is not an XML file of cameras by Metashape ({error})") from error
    if not poses:
        raise InputError(f"{path}: holds no aligned camera")
    return tuple(poses)


def _metashape_camera(sensor: ElementTree.Element, path: Path) -> Camera:
    if sensor.get("type", "frame") != "frame":
        raise InputError(f"{path}: sensor {sensor.get('label')}: only frame cameras are supported")
    found = sensor.findall("calibration")
    calibration = next((one for one in found if one.get("class") == "adjusted"), found[0] if found else None)
    if calibration is None:
        raise InputError(f"{path}: sensor {sensor.get('label')}: has no calibration")
    size = calibration.find("resolution")
    size = sensor.find("resolution") if size is None else size
    if size is None:
        raise InputError(f"{path}: sensor {sensor.get('label')}: has no resolution")
    width, height = int(size.attrib["width"]), int(size.attrib["height"])
    p = {one.tag: float(one.text) for one in calibration if one.text and one.tag != "resolution"}
    if abs(p.get("b2", 0.0)) > 0.01 or p.get("k4", 0.0):
        raise InputError(f"{path}: a sensor with skew (b2) or k4 is not supported; undistort the photos first")
    # Metashape's p1 belongs to r² + 2x², Brown's to 2xy: they are exchanged.
    terms = {**p, "p1": p.get("p2", 0.0), "p2": p.get("p1", 0.0)}
    return _camera(
        width,
        height,
        p["f"] + p.get("b1", 0.0),
        fy=p["f"],
        cx=0.5 * width + p.get("cx", 0.0) - HALF_PX,
        cy=0.5 * height + p.get("cy", 0.0) - HALF_PX,
        terms=terms,
        path=path,
    )


def _camera(
    width: int, height: int, fx: float, fy: float, cx: float, cy: float, terms: dict[str, Any], path: Path
) -> Camera:
    dist = np.array([float(terms.get(name) or 0.0) for name in ("k1", "k2", "p1", "p2", "k3")])
    if not (fx > 0 and fy > 0 and width > 0 and height > 0 and np.isfinite([fx, fy, cx, cy, *dist]).all()):
        raise InputError(f"{path}: a camera has no valid focal length, size or distortion")
    return Camera(width, height, fx, fy, cx, cy, dist)


def _rigid_of(matrix: Array, path: Path) -> Array:
    """A 4×4 pose whose rotation is made exactly orthonormal. Raises InputError where it is not a pose."""
    if matrix.shape not in ((4, 4), (3, 4)) or not np.isfinite(matrix).all():
        raise InputError(f"{path}: a pose is not a 4×4 matrix of numbers")
    s = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    if s.min() <= 0 or s.max() / s.min() > 1.01 or np.linalg.det(matrix[:3, :3]) < 0:
        raise InputError(f"{path}: the matrix of a pose is not a rotation")
    return orthonormalise(rigid(matrix[:3, :3], matrix[:3, 3]))
