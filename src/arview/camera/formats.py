"""Cameras in the tree of a JSON, YAML, XML or INI file, by the names that the formats use.

The formats differ in names only: arview, BOP, OpenCV, ROS, Kalibr, RealSense, ORB-SLAM, ZED and nerfstudio are read by
one table of names, `arview.camera.keys`. A name that is not in it but speaks of the lens or of a part or scale of the
picture is an error, because the camera would be wrong without it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from arview.camera.dialects import translated
from arview.camera.entry import CameraEntry
from arview.camera.keys import (
    CONTAINERS,
    NERF_SIGNS,
    ROLES,
    TERMS,
    is_ignored,
    is_of_a_camera,
    is_suspicious,
    plain_name,
)
from arview.camera.model import COLMAP_HALF_PX
from arview.camera.terms import lens_from_terms
from arview.camera.tree import numbers_of
from arview.errors import InputError

FORMATS = (
    "arview or BOP JSON, OpenCV YAML/XML/JSON, ROS camera_info, Kalibr camchain, COLMAP cameras.txt or .bin, Metashape "
    "XML, RealSense JSON, nerfstudio transforms.json, DepthAI, MATLAB, OpenSfM or PhotonVision JSON"
)
_PINHOLE = ("fx", "fy", "cx", "cy")
_STEREO = re.compile(r"(?P<field>M|K|cameraMatrix|camera_matrix|D|distCoeffs|dist_coeffs)_?(?P<camera>[12])")
_ORB_SLAM = re.compile(r"(?P<camera>Camera\d*)\.(?P<field>\w+)")
_ORB_SLAM_RESIZED = {"fps", "RGB", "newWidth", "newHeight", "imageScale"}
"""Pictures are resized before ORB-SLAM uses them; the camera is that of the first size."""
_MAX_DEPTH, _MAX_BINNING = 6, 64

Node = Mapping[str, Any]


def entries_from_trees(trees: Sequence[Any], name: str = "") -> list[CameraEntry]:
    """The cameras of the documents of a file.

    Args:
        trees: of the documents.
        name: of the camera that is wanted; where there is one of this name, the others are not read.

    Raises:
        InputError: no camera, or one that is not understood.
    """
    if not trees or not all(isinstance(tree, dict | list) for tree in trees):
        raise InputError(f"is not a camera file; expected {FORMATS}")
    trees = [translated(tree) for tree in trees]
    labels = [f"document{index + 1}" if len(trees) > 1 else "" for index in range(len(trees))]
    found = [camera for tree, label in zip(trees, labels, strict=True) for camera in _cameras(tree, label, 0)]
    if not found:
        raise InputError(f"no camera matrix and no fx, fy, cx, cy in the camera file; expected {FORMATS}")
    wanted = [camera for camera in found if name and name in (camera[0], camera[0].rsplit("/", 1)[-1])]
    return [_entry(node, label) for label, node in wanted or found]


def _cameras(tree: Any, label: str, depth: int) -> Iterator[tuple[str, Node]]:
    """The maps that hold a camera, with their places in the tree as names."""
    is_map, is_camera = isinstance(tree, dict), False
    if depth > _MAX_DEPTH:
        return
    if is_map:
        parts = _named_by_keys(tree) or _frames(tree)
        is_camera = not parts and _is_camera(tree)
        yield from ((f"{label}/{name}".lstrip("/"), node) for name, node in parts.items())
        if is_camera:
            yield label, tree
        kept = {} if parts else {key: value for key, value in tree.items() if not is_ignored(key, value)}
        children = [(k, value) for k, value in kept.items() if not (is_camera and plain_name(k) in CONTAINERS)]
    else:
        children = [(_name_of(item) or str(index), item) for index, item in enumerate(tree)]
        if len({name for name, _ in children}) < len(children):
            children = [(str(index), item) for index, item in enumerate(tree)]
    inside = [
        found
        for key, value in children
        if isinstance(value, dict | list)
        for found in _cameras(value, f"{label}/{key}".lstrip("/"), depth + 1)
    ]
    if inside and is_map and not is_camera:
        # A word beside the cameras, for example a crop of all of them, counts for each.
        beside = {key: value for key, value in tree.items() if not _holds_camera(value)}
        for key, value in beside.items():
            if is_of_a_camera(key, value):
                raise InputError(f"{key} stands beside the camera {inside[0][0]}, not in it; move it there")
        _check_names(beside, depth=_MAX_DEPTH)
    yield from inside


def _name_of(item: Any) -> str:
    """The name that a camera of a list says it has, or empty."""
    names = [item.get(key) for key in ("name", "camera_name", "id", "camera_id")] if isinstance(item, dict) else []
    return next((str(name) for name in names if isinstance(name, str | int) and str(name)), "")


def _holds_camera(value: Any) -> bool:
    return isinstance(value, dict | list) and next(_cameras(value, "", 1), None) is not None


def _named_by_keys(tree: Node) -> dict[str, Node]:
    """The cameras of keys such as ``M1`` and ``D1`` (OpenCV's stereo calibration) or ``Camera1.fx`` (ORB-SLAM)."""
    groups: dict[str, dict[str, Any]] = {}
    common: dict[str, Any] = {}
    is_orb_slam = any(_ORB_SLAM.fullmatch(key) for key in tree)
    for key, value in tree.items():
        match = (_ORB_SLAM if is_orb_slam else _STEREO).fullmatch(key)
        if match is None or (not is_orb_slam and isinstance(value, int | float | str)):
            common[key] = value
        elif match["field"] not in _ORB_SLAM_RESIZED:
            names = {"type": "camera_model", "M": "K"}
            groups.setdefault(match["camera"], {})[names.get(match["field"], match["field"])] = value
    if is_orb_slam:  # its other keys are of the program
        common = groups.get("Camera", {})
    found: dict[str, Node] = {name: common | group for name, group in groups.items() if _is_camera(group)}
    return found if is_orb_slam or len(found) > 1 else {}


def _frames(tree: Node) -> dict[str, Node]:
    """The cameras of nerfstudio's frames that have intrinsics of their own, with those of the file for the others."""
    frames = tree.get("frames")
    frames = [frame for frame in frames if isinstance(frame, dict)] if isinstance(frames, list) else []
    if not any(map(_is_camera, frames)):
        return {}
    common = {key: value for key, value in tree.items() if key != "frames"}
    return {f"frames/{index}": common | frame for index, frame in enumerate(frames)}


def _items(node: Node) -> Iterator[tuple[str, Any]]:
    """Keys and values of a map, with those of maps like ``intrinsics`` and ``distortion`` in it."""
    for key, value in node.items():
        if _is_map(value) and plain_name(key) in CONTAINERS:
            yield from _items(value)
        else:
            yield key, value


def _is_map(value: Any) -> bool:
    return isinstance(value, dict) and "data" not in value  # a matrix is none


def _is_camera(tree: Node) -> bool:
    roles = {ROLES.get(plain_name(key)) for key, value in _items(tree) if not _is_map(value)}
    return bool(roles & {"matrix", "fov_x", *_PINHOLE})


# --- One camera ----------------------------------------------------------------------------------------


def _entry(node: Node, label: str) -> CameraEntry:
    try:
        return _read(node, label)
    except InputError as error:
        raise InputError(f"{label}: {error}" if label else str(error)) from error


def _read(node: Node, label: str) -> CameraEntry:
    numbers: dict[str, tuple[str, Any]] = {}
    models: list[tuple[str, str]] = []
    rest: dict[str, Any] = {}

    def put(role: str, key: str, value: Any) -> None:
        known, before = numbers.setdefault(role, (key, value))
        is_same = before is value or before == value
        if not is_same and not (isinstance(value, float) and math.isclose(before, value, rel_tol=1e-6)):
            raise InputError(f"{known} and {key} differ; keep one of them")

    for key, value in _items(node):
        role = ROLES.get(plain_name(key))
        if role is None or (_is_map(value) and role != "roi") or (role == "fisheye" and isinstance(value, str)):
            rest[key] = value
        elif role == "roi":
            put(role, key, _roi(value))
        elif role == "matrix":
            for part, number in zip(_PINHOLE, _of_matrix(key, numbers_of(value, key)), strict=True):
                put(part, key, number)
        elif role == "size":
            for part, number in zip(("width", "height"), _several(value, key, 2), strict=True):
                put(part, key, number)
        elif role == "terms":
            put(role, key, [] if value is None or value == "" else numbers_of(value, key))
        elif role == "model":
            models.append((plain_name(key), "" if value is None else str(value)))
        elif role == "fisheye":
            models += [(role, role)] if value else []
        elif not _is_projection(value):
            put(role, key, _several(value, key, 1)[0])
    names = {plain_name(key) for key, _ in _items(node)}
    is_nerf = bool(NERF_SIGNS & names)
    if is_nerf and {"frames", "transformmatrix"} & names:
        rest = {key: value for key, value in rest.items() if key not in ("scale", "offset")}  # of the scene
    _check_names(rest)
    found = {role: value for role, (_, value) in numbers.items()}
    width, height = (_whole(*numbers[role], low=1) if role in numbers else None for role in ("width", "height"))
    listed = found.pop("terms", None)
    terms = {role: value for role, value in found.items() if role in TERMS}
    dist, lens = lens_from_terms(_lens_models(models), listed, terms)
    if is_nerf:
        found = _nerf_defaults(found, width, height) | found
    missing = [role for role in _PINHOLE if role not in found]
    if missing:
        known = "no camera matrix and no" if len(missing) == 4 else "no"
        raise InputError(f"{known} {', '.join(missing)} in the camera file; expected {FORMATS}")
    half_px = COLMAP_HALF_PX if is_nerf else 0.0  # nerfstudio's pixels begin at the corner
    fx, fy, cx, cy = (found[role] for role in _PINHOLE)
    binning = [_whole(*numbers.get(role, (role, 1.0)), low=0, high=_MAX_BINNING) for role in ("binning_x", "binning_y")]
    return CameraEntry(
        fx,
        fy,
        cx - half_px,
        cy=cy - half_px,
        dist=dist,
        lens=lens,
        width=width,
        height=height,
        roi=found.get("roi"),
        binning=(max(1, binning[0]), max(1, binning[1])),  # ROS writes 0 for none
        label=label,
    )


def _lens_models(models: Sequence[tuple[str, str]]) -> list[str]:
    """Names of lens models. Of several values of ``model``, those that are no lens are names of the device."""
    plain = [model for name, model in models if name == "model"]
    lenses = [model for model in plain if is_of_a_camera("model", model)]
    device = set(plain) - set(lenses or plain[-1:]) if len(plain) > 1 else set()
    return [model for name, model in models if name != "model" or model not in device]


def _is_projection(value: Any) -> bool:
    """Whether a value is a projection matrix, which stereo calibrations call P1 and P2."""
    return isinstance(value, dict) and value.get("rows") == 3 and value.get("cols") == 4


def _several(value: Any, key: str, count: int) -> list[float]:
    numbers = numbers_of(value, key)
    if len(numbers) != count:
        raise InputError(f"{key} has {len(numbers)} numbers; expected {('one', 'width and height')[count - 1]}")
    return numbers


def _nerf_defaults(found: Mapping[str, float], width: int | None, height: int | None) -> dict[str, float]:
    """What nerfstudio leaves out: the centre of the picture, the second focal length, or both beside an angle."""
    angle, focal = found.get("fov_x"), found.get("fx")
    if angle is not None and not 0.0 < angle < math.pi:
        raise InputError(f"camera_angle_x is {angle:g}; expected an angle in rad between 0 and π")
    if angle is not None and width is not None and not {"fx", "fy"} & set(found):
        focal = 0.5 * width / math.tan(0.5 * angle)
    centre = {} if width is None or height is None else {"cx": 0.5 * width, "cy": 0.5 * height}
    return centre if focal is None else centre | {"fx": focal, "fy": focal}


def _of_matrix(key: str, matrix: list[float]) -> tuple[float, float, float, float]:
    if len(matrix) == 4 and plain_name(key) == "intrinsics":
        return matrix[0], matrix[1], matrix[2], matrix[3]
    if len(matrix) != 9:
        raise InputError(f"{key} has {len(matrix)} numbers; expected a matrix of 3 × 3")
    if not any((matrix[1], matrix[2], matrix[5])) and matrix[6] > 0 and matrix[7] > 0 and matrix[8] == 1:
        # Column by column, as Open3D, Record3D, ARKit and MATLAB write it.
        matrix = [matrix[i] for i in (0, 3, 6, 1, 4, 7, 2, 5, 8)]
    if matrix[3] != 0 or matrix[6:] != [0, 0, 1]:
        raise InputError(f"the camera matrix {matrix} is not fx 0 cx / 0 fy cy / 0 0 1 in row-major order; correct it")
    if abs(matrix[1]) > 1e-3 * abs(matrix[0]):
        raise InputError(f"the camera matrix has skew {matrix[1]:g}, which is not supported; calibrate again")
    return matrix[0], matrix[4], matrix[2], matrix[5]


def _whole(key: str, number: float, low: int, high: float = math.inf) -> int:
    if not (math.isfinite(number) and number == int(number) and low <= number <= high):
        raise InputError(f"{key} is {number:g}; expected a {'positive ' if low else ''}whole number of px")
    return int(number)


def _roi(value: Any) -> tuple[int, int, int, int] | None:
    """Left, top, width and height px of the region of interest of ROS; None where it is the whole picture."""
    names = ("x_offset", "y_offset", "width", "height")
    if value is None:
        return None
    if not isinstance(value, dict) or set(value) - {*names, "do_rectify"}:
        raise InputError(f"roi is not understood; expected {', '.join(names)} and do_rectify, as ROS writes it")
    left, top, width, height = (_whole(f"roi.{n}", _several(value.get(n, 0), f"roi.{n}", 1)[0], low=0) for n in names)
    if width == height == 0 and (left or top):
        raise InputError(f"roi at ({left}, {top}) without width and height; add them")
    return (left, top, width, height) if width or height else None


def _check_names(node: Node, path: str = "", depth: int = 0) -> None:
    """Raise InputError for a name that speaks of the lens or of a part or scale of the picture."""
    for key, value in node.items():
        place = f"{path}.{key}" if path else key
        if is_ignored(key, value):
            continue
        if is_suspicious(key, value):
            raise InputError(
                f"{place} is not understood, and may change the lens or what part of the picture is seen; "
                "remove it if it does not, or give the camera of the frames as they are"
            )
        if isinstance(value, dict) and depth < _MAX_DEPTH and not _holds_camera(value):
            _check_names(value, place, depth + 1)
