"""Cameras in the tree of a JSON, YAML or XML file, by the names that the formats use.

The formats differ in names only: arview, BOP, OpenCV, ROS, Kalibr, RealSense and nerfstudio are read by one table of
names. A name that is in no table but speaks of the lens or of a part or scale of the picture is an error, because the
camera would be wrong without it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

from arview.camera.entry import CameraEntry
from arview.camera.keys import (
    CONTAINERS,
    DIST,
    FISHEYE_SWITCHES,
    IGNORED,
    MATRIX,
    MODEL,
    NERF_SIGNS,
    NUMBERS,
    SIZE,
    TERMS,
    is_distortion,
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
    "XML, RealSense JSON or nerfstudio transforms.json"
)
_STEREO = re.compile(r"(M|K|cameraMatrix|camera_matrix|D|distCoeffs|dist_coeffs)_?([12])")
_ORB_SLAM = re.compile(r"(Camera\d*)\.(\w+)")
_MAX_DEPTH = 6


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
    if any(isinstance(tree, list) and not _has_map(tree) for tree in trees):
        raise InputError("the JSON is a list, expected an object with fx, fy, cx, cy")
    found: list[tuple[str, Mapping[str, Any]]] = []
    for index, tree in enumerate(trees):
        found += _cameras(tree, f"document{index + 1}" if len(trees) > 1 else "", 0)
    wanted = [one for one in found if name and name in (one[0], one[0].rsplit("/", 1)[-1])]
    entries = [_entry(node, label) for label, node in wanted or found]
    if not entries:
        raise InputError(f"no camera matrix and no fx, fy, cx, cy in the camera file; expected {FORMATS}")
    return entries


def _has_map(tree: Sequence[Any]) -> bool:
    return any(isinstance(item, dict) for item in tree)


def _cameras(tree: Any, label: str, depth: int) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """The maps that hold a camera, with their places in the tree as names."""
    if depth > _MAX_DEPTH:
        return
    children: list[tuple[str, Any]] = []
    if isinstance(tree, list):
        children = [(_name_of(item) or str(index), item) for index, item in enumerate(tree)]
        names = [name for name, _ in children]
        if len(set(names)) < len(names):
            children = [(str(index), item) for index, item in enumerate(tree)]
    elif isinstance(tree, dict):
        pair = _stereo(tree) or _orb_slam(tree)
        if pair:
            for name, node in pair.items():
                yield (f"{label}/{name}" if label else name), node
            return
        frames = tree.get("frames")
        if isinstance(frames, list) and any(isinstance(one, dict) and _is_camera(one) for one in frames):
            # Intrinsics of each frame, with those of the file where a frame has none.
            common = {key: value for key, value in tree.items() if key != "frames"}
            for index, one in enumerate(frames):
                if isinstance(one, dict):
                    yield f"{label}/frames/{index}".lstrip("/"), common | one
            return
        if _is_camera(tree):
            yield label, tree
        children = [(key, value) for key, value in tree.items() if not _is_skipped(key, value)]
        if _is_camera(tree):
            children = [(key, value) for key, value in children if plain_name(key) not in CONTAINERS]
    inside = [
        found
        for key, value in children
        if isinstance(value, dict | list)
        for found in _cameras(value, f"{label}/{key}" if label else key, depth + 1)
    ]
    if inside and isinstance(tree, dict) and not _is_camera(tree):
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


def _stereo(tree: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The two cameras of a map with ``M1``, ``D1``, ``M2`` and ``D2``, as OpenCV's stereo calibration writes it."""
    pairs = {key: match for key, value in tree.items() if (match := _STEREO.fullmatch(key)) and not _is_term(value)}
    if len({match[2] for match in pairs.values()}) < 2:
        return {}
    common = {key: value for key, value in tree.items() if key not in pairs}
    both: dict[str, dict[str, Any]] = {"1": dict(common), "2": dict(common)}
    for key, match in pairs.items():
        both[match[2]]["D" if match[1].lower().startswith("d") else "K"] = tree[key]
    return both


def _orb_slam(tree: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The cameras of a map with ``Camera.fx`` or ``Camera1.fx``, as the settings of ORB-SLAM have them."""
    groups: dict[str, dict[str, Any]] = {}
    for key, value in tree.items():
        match = _ORB_SLAM.fullmatch(key)
        if match:
            name = "camera_model" if match[2] == "type" else match[2]
            groups.setdefault(match[1], {})[name] = value
    common = groups.get("Camera", {})
    found = {name: common | group for name, group in groups.items() if _is_camera(group)}
    # Size and new size: the pictures are resized before use, the camera is that of the first size.
    for node in found.values():
        for name in ("fps", "RGB", "newWidth", "newHeight", "imageScale"):
            node.pop(name, None)
        if str(node.get("camera_model")) == "Rectified":
            node["camera_model"] = "pinhole"
    return found


def _is_term(value: Any) -> bool:
    return isinstance(value, int | float | str)


def _is_skipped(key: str, value: Any) -> bool:
    """Whether a part of the tree is no part of the camera: extrinsics, uncertainties, arview's records."""
    if plain_name(key) in IGNORED:
        return True
    if not isinstance(value, dict):
        return False
    if key == "lens":  # make, model and focal length of a profile
        allowed = {"digital_zoom"}
        return not any(is_distortion(name) or is_suspicious(name, value[name]) for name in set(value) - allowed)
    return key == "calibration" and str(value.get("tool", "")).startswith("arview")


def _is_camera(tree: Mapping[str, Any]) -> bool:
    for key, value in tree.items():
        name = plain_name(key)
        if name in MATRIX or NUMBERS.get(name) in ("fx", "fy", "cx", "cy", "fov_x") or name == "intrinsics":
            is_map = isinstance(value, dict) and "data" not in value
            if not is_map or (name in CONTAINERS and isinstance(value, dict) and _is_camera(value)):
                return True
        elif name in CONTAINERS and isinstance(value, dict) and "data" not in value and _is_camera(value):
            return True
    return False


# --- One camera ----------------------------------------------------------------------------------------


def _entry(node: Mapping[str, Any], label: str) -> CameraEntry:
    try:
        return _read(_with_containers(node), label)
    except InputError as error:
        raise InputError(f"{label}: {error}" if label else str(error)) from error


def _with_containers(node: Mapping[str, Any]) -> dict[str, Any]:
    """The map with the contents of maps like ``intrinsics`` and ``distortion`` in it."""
    flat: dict[str, Any] = {}
    for key, value in node.items():
        is_container = plain_name(key) in CONTAINERS and isinstance(value, dict) and "data" not in value
        for name, inner in (_with_containers(value) if is_container else {key: value}).items():
            if name in flat and plain_name(name) == "model" and not is_of_a_camera(name, flat[name]):
                flat[name] = inner  # the other one is that of the device
                continue
            if (
                name in flat
                and plain_name(name) == "model"
                and is_container is False
                and not is_of_a_camera(name, inner)
            ):
                continue
            if name in flat and flat[name] != inner:
                raise InputError(f"{name} occurs twice with different values; keep one of them")
            flat[name] = inner
    return flat


def _read(node: Mapping[str, Any], label: str) -> CameraEntry:
    named: dict[str, float] = {}
    listed: list[tuple[str, list[float]]] = []
    matrices: list[tuple[str, list[float]]] = []
    models: list[str] = []
    numbers: dict[str, tuple[str, float]] = {}
    size: list[float] | None = None
    rest: dict[str, Any] = {}
    for key, value in node.items():
        name = plain_name(key)
        if name in MATRIX or (name == "intrinsics" and not isinstance(value, dict)):
            matrices.append((key, numbers_of(value, key)))
        elif name in TERMS:
            if not _is_projection(value):
                named[TERMS[name]] = _one(value, key)
        elif name in DIST and not (isinstance(value, dict) and "data" not in value):
            listed.append((key, [] if value is None or value == "" else numbers_of(value, key)))
        elif name in FISHEYE_SWITCHES and isinstance(value, bool | int | float):
            models += ["fisheye"] if value else []
        elif name in MODEL:
            models.append("" if value is None else str(value))
        elif name in NUMBERS:
            own = NUMBERS[name]
            if own in numbers and numbers[own][1] != _one(value, key):
                raise InputError(f"{numbers[own][0]} and {key} differ; keep one of them")
            numbers[own] = key, _one(value, key)
        elif name in SIZE:
            size = numbers_of(value, key)
            if len(size) != 2:
                raise InputError(f"{key} has {len(size)} numbers; expected width and height")
        elif name not in ("roi", "binningx", "binningy"):
            rest[key] = value
    names = {plain_name(key) for key in node}
    if NERF_SIGNS & names and {"frames", "transformmatrix"} & names:
        rest = {key: value for key, value in rest.items() if key not in ("scale", "offset")}  # of the scene
    _check_names(rest)
    for one, other in pairwise(listed):
        if one[1] != other[1]:
            raise InputError(f"{one[0]} and {other[0]} differ; keep one of them")
    # nerfstudio's pixels begin at the corner.
    half_px = COLMAP_HALF_PX if NERF_SIGNS & names else 0.0
    width, height = _image_size(numbers, size)
    dist, lens = lens_from_terms(models, listed[0][1] if listed else None, named)
    fx, fy, cx, cy = _pinhole(matrices, numbers, width, height)
    return CameraEntry(
        fx,
        fy,
        cx - half_px,
        cy=cy - half_px,
        dist=dist,
        lens=lens,
        width=width,
        height=height,
        roi=_roi(node),
        binning=_binning(node),
        label=label,
    )


def _is_projection(value: Any) -> bool:
    """Whether a value is a projection matrix, which stereo calibrations call P1 and P2."""
    return isinstance(value, dict) and value.get("rows") == 3 and value.get("cols") == 4


def _one(value: Any, key: str) -> float:
    numbers = numbers_of(value, key)
    if len(numbers) != 1:
        raise InputError(f"{key} has {len(numbers)} numbers; expected one")
    return numbers[0]


def _pinhole(
    matrices: Sequence[tuple[str, list[float]]],
    numbers: Mapping[str, tuple[str, float]],
    width: int | None,
    height: int | None,
) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy px of a matrix, of a list of four, or of single numbers."""
    found = [(key, _of_matrix(key, matrix)) for key, matrix in matrices]
    single = {name: numbers[name][1] for name in ("fx", "fy", "cx", "cy") if name in numbers}
    if "fov_x" in numbers and width is not None and height is not None and not {"fx", "fy"} & set(single):
        angle = numbers["fov_x"][1]
        if not 0.0 < angle < math.pi:
            raise InputError(f"{numbers['fov_x'][0]} is {angle:g}; expected an angle in rad between 0 and π")
        focal = 0.5 * width / math.tan(0.5 * angle)
        single = {"fx": focal, "fy": focal, "cx": 0.5 * width, "cy": 0.5 * height} | single
    if "fx" in single and "fy" not in single and NERF_SIGNS & {plain_name(key) for key, _ in numbers.values()}:
        single["fy"] = single["fx"]
    missing = [name for name in ("fx", "fy", "cx", "cy") if name not in single]
    if not missing:
        found.append(("fx, fy, cx, cy", (single["fx"], single["fy"], single["cx"], single["cy"])))
    if not found:
        known = "no camera matrix and no" if len(missing) == 4 else "no"
        raise InputError(f"{known} {', '.join(missing)} in the camera file; expected {FORMATS}")
    for key, values in found[1:]:
        if any(abs(a - b) > 1e-6 * abs(a) for a, b in zip(found[0][1], values, strict=True)):
            raise InputError(f"{found[0][0]} and {key} differ; keep one of them")
    return found[0][1]


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


def _image_size(
    numbers: Mapping[str, tuple[str, float]], size: Sequence[float] | None
) -> tuple[int | None, int | None]:
    width, height = (_pixel_count(*numbers[name]) if name in numbers else None for name in ("width", "height"))
    if size is None:
        return width, height
    listed = _pixel_count("width", size[0]), _pixel_count("height", size[1])
    if (width is not None and width != listed[0]) or (height is not None and height != listed[1]):
        raise InputError(f"two image sizes, {width}×{height} and {listed[0]}×{listed[1]} px; keep one of them")
    return listed


def _pixel_count(key: str, number: float) -> int:
    if not (math.isfinite(number) and number == int(number) and number > 0):
        raise InputError(f"{key} is {number:g}; expected a positive whole number of px")
    return int(number)


def _roi(node: Mapping[str, Any]) -> tuple[int, int, int, int] | None:
    """Left, top, width and height px of the region of interest of ROS; None where it is the whole picture."""
    roi = next((value for key, value in node.items() if plain_name(key) == "roi"), None)
    if roi is None:
        return None
    names = ("x_offset", "y_offset", "width", "height")
    if not isinstance(roi, dict) or set(roi) - {*names, "do_rectify"}:
        raise InputError(f"roi is not understood; expected {', '.join(names)} and do_rectify, as ROS writes it")
    left, top, width, height = (_one(roi.get(name, 0), f"roi.{name}") for name in names)
    if not all(value >= 0 and math.isfinite(value) and value == int(value) for value in (left, top, width, height)):
        raise InputError(f"roi {width:g}×{height:g} at ({left:g}, {top:g}): expected whole numbers of px")
    if width == height == 0:
        if left or top:
            raise InputError(f"roi at ({left:g}, {top:g}) without width and height; add them")
        return None
    return int(left), int(top), int(width), int(height)


def _binning(node: Mapping[str, Any]) -> tuple[int, int]:
    """Pixels binned across and down; ROS writes 0 for none."""
    factors = []
    for axis in ("binningx", "binningy"):
        key = next((key for key in node if plain_name(key) == axis), None)
        factor = 1.0 if key is None else _one(node[key], key)
        if not (0 <= factor <= 64 and factor == int(factor)):
            raise InputError(f"{key} is {factor:g}; expected a whole number of px")
        factors.append(max(1, int(factor)))
    return factors[0], factors[1]


def _check_names(node: Mapping[str, Any], path: str = "", depth: int = 0) -> None:
    """Raise InputError for a name that speaks of the lens or of a part or scale of the picture."""
    for key, value in node.items():
        place = f"{path}.{key}" if path else key
        if _is_skipped(key, value):
            continue
        if is_suspicious(key, value):
            raise InputError(
                f"{place} is not understood, and may change the lens or what part of the picture is seen; "
                "remove it if it does not, or give the camera of the frames as they are"
            )
        if isinstance(value, dict) and depth < _MAX_DEPTH and not _holds_camera(value):
            _check_names(value, place, depth + 1)
