"""Cameras of programs that mean something else by known names: rewritten in the names of `arview.camera.keys`.

DepthAI (Luxonis) lists its cameras by socket, MATLAB counts pixels from 1 and rows before columns, OpenSfM divides by
the longer side of the picture. The formats are those of their documentation.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from arview.camera.keys import plain_name
from arview.camera.tree import numbers_of
from arview.errors import InputError

_DEPTHAI_MODELS = {0: "rational", 1: "fisheye", 2: "equirectangular", 3: "radial division"}
_DEPTHAI_FISHEYE_TERMS = 4
_OPENSFM_MODELS = {"fisheye_opencv": "fisheye", "fisheye": "fisheye"}
_MATLAB_SIGNS = {"radialdistortion", "imagesize"}


def translated(tree: Any) -> Any:
    """A tree of a camera file with the cameras of these programs in plain names; all else as it is.

    Raises:
        InputError: such a camera is incomplete.
    """
    if isinstance(tree, list):
        return [translated(item) for item in tree]
    if not isinstance(tree, dict):
        return tree
    names = {plain_name(key): key for key in tree}
    if isinstance(tree.get("cameraData"), list):
        return _depthai(tree["cameraData"])
    if names.keys() >= _MATLAB_SIGNS and names.keys() & {"intrinsicmatrix", "k", "focallength"}:
        return _matlab({plain: tree[key] for plain, key in names.items()})
    if isinstance(tree.get("projection_type"), str) and {"focal", "focal_x"} & tree.keys():
        return _opensfm(tree)
    return {key: translated(value) for key, value in tree.items()}


def _depthai(cameras: list[Any]) -> dict[str, Any]:
    """Cameras by their socket, as ``[socket, camera]`` in ``cameraData``."""
    found = {}
    for pair in cameras:
        if not (isinstance(pair, list) and len(pair) == 2 and isinstance(pair[1], dict)):
            raise InputError("cameraData is no list of a socket and its camera each; export the calibration again")
        socket, camera = pair
        camera = {key: value for key, value in camera.items() if key not in ("cameraType", "extrinsics")}
        model = pair[1].get("cameraType", 0)
        camera["model"] = _DEPTHAI_MODELS.get(model, str(model))
        terms = camera.get("distortionCoeff", [])
        if camera["model"] == "fisheye" and isinstance(terms, list) and not any(terms[_DEPTHAI_FISHEYE_TERMS:]):
            camera["distortionCoeff"] = terms[:_DEPTHAI_FISHEYE_TERMS]
        found[str(socket)] = camera
    return found


def _matlab(node: Mapping[str, Any]) -> dict[str, float | list[float]]:
    """A ``cameraParameters`` or ``cameraIntrinsics`` object; its first pixel has the centre (1, 1)."""
    rows, columns = _some(node, "imagesize", (2,))
    if "focallength" in node and "principalpoint" in node:
        fx, fy = _some(node, "focallength", (2,))
        cx, cy = _some(node, "principalpoint", (2,))
        skew = _some(node, "skew", (1,))[0] if "skew" in node else 0.0
    else:
        a = _some(node, "k" if "k" in node else "intrinsicmatrix", (9,))
        # IntrinsicMatrix is the transpose of K.
        fx, fy, skew, cx, cy = (a[0], a[4], a[3], a[6], a[7]) if a[6] else (a[0], a[4], a[1], a[2], a[5])
    if abs(skew) > 1e-3 * abs(fx):
        raise InputError(f"the camera matrix has skew {skew:g}, which is not supported; calibrate again")
    radial = _some(node, "radialdistortion", (2, 3))
    tangential = _some(node, "tangentialdistortion", (2,)) if "tangentialdistortion" in node else [0.0, 0.0]
    return {
        "width": columns,
        "height": rows,
        "fx": fx,
        "fy": fy,
        "cx": cx - 1.0,
        "cy": cy - 1.0,
        "dist": [*radial[:2], *tangential, *radial[2:]],
    }


def _opensfm(node: Mapping[str, Any]) -> dict[str, Any]:
    """A camera of ``reconstruction.json`` or ``camera_models.json``: lengths over the longer side, from the middle."""
    missing = [name for name in ("width", "height") if name not in node]
    if missing:
        raise InputError(f"a camera of OpenSfM without {' and '.join(missing)}; add the size of its pictures, px")
    width, height = (_some(node, name, (1,))[0] for name in ("width", "height"))
    side = max(width, height)
    fx = _some(node, "focal" if "focal" in node else "focal_x", (1,))[0]
    fy = _some(node, "focal_y", (1,))[0] if "focal_y" in node else fx
    cx, cy = (_some(node, name, (1,))[0] if name in node else 0.0 for name in ("c_x", "c_y"))
    model = str(node["projection_type"])
    own = {"projection_type", "focal", "focal_x", "focal_y", "c_x", "c_y", "width", "height"}
    return {
        **{key: value for key, value in node.items() if key not in own},
        "model": _OPENSFM_MODELS.get(model, model),
        "width": width,
        "height": height,
        "fx": side * fx,
        "fy": side * fy,
        "cx": side * cx + 0.5 * (width - 1.0),
        "cy": side * cy + 0.5 * (height - 1.0),
    }


def _some(node: Mapping[str, Any], key: str, counts: tuple[int, ...]) -> list[float]:
    """The numbers of a key, of which there must be one of ``counts``."""
    numbers = numbers_of(node[key], key)
    if len(numbers) not in counts:
        raise InputError(f"{key} has {len(numbers)} numbers; expected {' or '.join(map(str, counts))}")
    return numbers
