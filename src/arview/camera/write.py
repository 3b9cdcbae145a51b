"""Writing camera files in every format that `arview.camera.read` reads."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from arview.camera.lens import LensDistortion, LensModel
from arview.camera.model import COLMAP_HALF_PX, Camera
from arview.camera.undistort import require_brown
from arview.core.atomic import write_file
from arview.errors import InputError


def write_camera(
    camera: Camera, path: str | Path, kind: str | None = None, extra: dict[str, Any] | None = None
) -> None:
    """Write a camera file, which appears complete or not at all.

    Args:
        camera: the camera.
        path: of the file.
        kind: one of FORMATS; None chooses by the suffix: ``.json`` arview, ``.txt`` COLMAP, ``.xml`` and ``.yaml``
            OpenCV.
        extra: objects to store beside the intrinsics; only arview's own format stores them.

    Raises:
        InputError: an unknown format or suffix, or a lens model that the format does not hold.
        OutputError: the file cannot be written.
    """
    path = Path(path)
    kind = kind or format_and_path(str(path))[0]
    if kind not in FORMATS:
        raise InputError(f"camera format {kind!r}: expected one of {', '.join(FORMATS)}")
    if camera.lens is not None and not _holds(kind, camera.lens):
        camera = require_brown(camera, f"camera format {kind}")
    text = _arview(camera, extra) if kind == "arview" else FORMATS[kind](camera)
    write_file(path, text.encode())


_FORMAT_OF_SUFFIX = {".json": "arview", ".txt": "colmap", ".xml": "opencv-xml", ".yaml": "opencv", ".yml": "opencv"}
_LENSES: dict[str, tuple[LensModel, ...]] = {
    "bop": (),
    "opencv": (LensModel.RATIONAL, LensModel.FISHEYE),
    "opencv-xml": (LensModel.RATIONAL, LensModel.FISHEYE),
    "opencv-json": (LensModel.RATIONAL, LensModel.FISHEYE),
    "ros": (LensModel.RATIONAL, LensModel.FISHEYE),
    "colmap": tuple(model for model in LensModel if model is not LensModel.INVERSE_BROWN),
}
"""Lens models besides Brown's that a format holds; the others hold all."""
_ROS_NAMES = {LensModel.RATIONAL: "rational_polynomial", LensModel.FISHEYE: "equidistant"}
_COLMAP_NAMES = {
    LensModel.RATIONAL: "FULL_OPENCV",
    LensModel.FISHEYE: "OPENCV_FISHEYE",
    LensModel.FOV: "FOV",
    LensModel.DIVISION: "DIVISION",
    LensModel.THIN_PRISM_FISHEYE: "THIN_PRISM_FISHEYE",
}


def _holds(kind: str, lens: LensDistortion) -> bool:
    has_prism = lens.model is LensModel.RATIONAL and any(lens.terms[8:])
    return lens.model in _LENSES.get(kind, tuple(LensModel)) and not (kind == "colmap" and has_prism)


def format_and_path(text: str) -> tuple[str, str]:
    """Format and file of ``FORMAT:FILE``, or of a file name, whose suffix chooses the format.

    Raises:
        InputError: the suffix has none.
    """
    kind, colon, path = text.partition(":")
    if colon and kind in FORMATS:
        return kind, path
    found = _FORMAT_OF_SUFFIX.get(Path(text).suffix.lower())
    if found is None:
        raise InputError(f"{text}: expected .json, .yaml, .xml or .txt, or FORMAT:FILE with {', '.join(FORMATS)}")
    return found, text


def holds_distortion(kind: str) -> bool:
    """Whether a format stores the distortion; that of BOP is for undistorted pictures."""
    return kind != "bop"


def camera_record(camera: Camera) -> dict[str, Any]:
    """A camera in arview's own JSON."""
    lens = camera.lens
    return {
        "width": camera.width,
        "height": camera.height,
        "fx": float(camera.fx),
        "fy": float(camera.fy),
        "cx": float(camera.cx),
        "cy": float(camera.cy),
        **({} if lens is None else {"lens_model": str(lens.model)}),
        "dist": [float(value) for value in (camera.dist if lens is None else lens.terms)],
    }


def _arview(camera: Camera, extra: dict[str, Any] | None = None) -> str:
    record = camera_record(camera) | (extra or {})
    return json.dumps(record, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _bop(camera: Camera) -> str:
    record = {key: value for key, value in camera_record(camera).items() if key != "dist"} | {"depth_scale": 1.0}
    return json.dumps(record, indent=2, sort_keys=True) + "\n"


def _opencv(suffix: str) -> Callable[[Camera], str]:
    def text(camera: Camera) -> str:
        import cv2

        file = cv2.FileStorage(suffix, cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)
        file.write("image_width", camera.width)
        file.write("image_height", camera.height)
        file.write("camera_matrix", camera.matrix)
        if camera.lens is not None:
            file.write("distortion_model", _ROS_NAMES[camera.lens.model])
        file.write("distortion_coefficients", np.array([_opencv_terms(camera)]))
        return str(file.releaseAndGetString())

    return text


def _opencv_terms(camera: Camera) -> list[float]:
    """Distortion terms in OpenCV's order, with as many as the lens model has there."""
    if camera.lens is None:
        return [float(value) for value in camera.dist]
    terms = list(camera.lens.terms)
    return terms[:8] if camera.lens.model is LensModel.RATIONAL and not any(terms[8:]) else terms


def _ros(camera: Camera) -> str:
    """``camera_info`` YAML as camera_calibration_parsers reads it."""
    projection = np.hstack([camera.matrix, np.zeros((3, 1))])
    terms = _opencv_terms(camera)

    def matrix(name: str, values: Any, rows: int, columns: int) -> str:
        numbers = ", ".join(repr(float(value)) for value in np.asarray(values).ravel())
        return f"{name}:\n  rows: {rows}\n  cols: {columns}\n  data: [{numbers}]\n"

    return (
        f"image_width: {camera.width}\nimage_height: {camera.height}\ncamera_name: camera\n"
        + matrix("camera_matrix", camera.matrix, 3, 3)
        + f"distortion_model: {'plumb_bob' if camera.lens is None else _ROS_NAMES[camera.lens.model]}\n"
        + matrix("distortion_coefficients", terms, 1, len(terms))
        + matrix("rectification_matrix", np.eye(3), 3, 3)
        + matrix("projection_matrix", projection, 3, 4)
    )


def _colmap(camera: Camera) -> str:
    k1, k2, p1, p2, k3 = (float(value) for value in camera.dist)
    model = "PINHOLE"
    terms: list[float] = []
    if camera.lens is not None:
        model, terms = _COLMAP_NAMES[camera.lens.model], list(camera.lens.terms[:8])
    elif camera.is_distorted:
        model, terms = ("FULL_OPENCV", [k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]) if k3 else ("OPENCV", [k1, k2, p1, p2])
    numbers = [camera.fx, camera.fy, camera.cx + COLMAP_HALF_PX, camera.cy + COLMAP_HALF_PX, *terms]
    line = " ".join(repr(float(value)) for value in numbers)
    return f"# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n1 {model} {camera.width} {camera.height} {line}\n"


FORMATS: dict[str, Callable[[Camera], str]] = {
    "arview": _arview,
    "bop": _bop,
    "opencv": _opencv(".yaml"),
    "opencv-xml": _opencv(".xml"),
    "opencv-json": _opencv(".json"),
    "ros": _ros,
    "colmap": _colmap,
}
"""The function that writes a camera as text, by the name of the format."""
