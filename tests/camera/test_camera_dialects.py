"""Cameras of DepthAI, MATLAB, OpenSfM and PhotonVision, and cameras that are doubted."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arview.camera import Camera
from arview.camera.lens import LensModel
from arview.camera.read import load_camera
from arview.errors import InputError

K = [[1500.0, 0.0, 960.0], [0.0, 1500.0, 540.0], [0.0, 0.0, 1.0]]


def written(folder: Path, content: Any) -> Path:
    path = folder / "camera.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def depthai(model: int, terms: list[float]) -> dict[str, Any]:
    def camera(width: int, height: int) -> dict[str, Any]:
        return {
            "cameraType": model, "distortionCoeff": terms + [0.0] * (14 - len(terms)), "width": width,
            "height": height, "intrinsicMatrix": K, "lensPosition": 130, "specHfovDeg": 68.8,
            "extrinsics": {"rotationMatrix": [[1, 0, 0]], "toCameraSocket": 1},
        }  # fmt: skip

    return {
        "boardName": "X", "cameraData": [[0, camera(1920, 1080)], [2, camera(1920, 1200)]],
        "stereoRectificationData": {"leftCameraSocket": 1, "rectifiedRotationLeft": [[1.0]]},
    }  # fmt: skip


def test_depthai_asks_for_the_socket(tmp_path: Path) -> None:
    path = written(tmp_path, depthai(0, [0.32, -0.06, 0.0, 0.0, -0.002, 0.65]))
    with pytest.raises(InputError, match=r"2 different cameras \(0, 2\)"):
        load_camera(path)
    camera = load_camera(f"{path}:2")
    assert (camera.width, camera.height, camera.fx, camera.cx) == (1920, 1200, 1500.0, 960.0)
    assert camera.lens is not None and camera.lens.model is LensModel.RATIONAL
    assert camera.lens.terms[:6] == (0.32, -0.06, 0.0, 0.0, -0.002, 0.65)
    fisheye = load_camera(f"{written(tmp_path, depthai(1, [0.1, -0.02, 0.003, 0.0004]))}:0")
    assert fisheye.lens is not None and fisheye.lens.model is LensModel.FISHEYE
    with pytest.raises(InputError, match="equirectangular"):
        load_camera(f"{written(tmp_path, depthai(2, []))}:0")


@pytest.mark.parametrize(
    "own",
    [
        {"IntrinsicMatrix": [[1130, 0, 0], [0, 1131, 0], [646.3, 357.8, 1]]},
        {"K": [[1130, 0, 646.3], [0, 1131, 357.8], [0, 0, 1]]},
        {"FocalLength": [1130, 1131], "PrincipalPoint": [646.3, 357.8], "Skew": 0},
    ],
)
def test_matlab_counts_from_one_and_rows_first(tmp_path: Path, own: dict[str, Any]) -> None:
    content = {
        "ImageSize": [720, 1280],
        "RadialDistortion": [-0.06, 0.01, 0.002],
        "TangentialDistortion": [3e-4, -2e-4],
    }
    camera = load_camera(written(tmp_path, content | own))
    assert (camera.width, camera.height, camera.fx, camera.fy) == (1280, 720, 1130.0, 1131.0)
    assert (camera.cx, camera.cy) == (pytest.approx(645.3), pytest.approx(356.8))
    np.testing.assert_allclose(camera.dist, [-0.06, 0.01, 3e-4, -2e-4, 0.002])
    with pytest.raises(InputError, match="skew 12"):
        load_camera(written(tmp_path, content | {"IntrinsicMatrix": [[1130, 0, 0], [12, 1130, 0], [646.3, 357.8, 1]]}))


def test_opensfm_divides_by_the_longer_side(tmp_path: Path) -> None:
    one = {"projection_type": "perspective", "width": 1280, "height": 720, "focal": 0.8828125, "k1": -0.06, "k2": 0.01}
    camera = load_camera(written(tmp_path, {"v2 phone 0.88": one}))
    assert (camera.fx, camera.cx, camera.cy, camera.dist[0]) == (1130.0, 639.5, 359.5, -0.06)
    brown = {"projection_type": "brown", "width": 1280, "height": 720, "focal_x": 0.88, "focal_y": 0.89, "c_x": 0.01,
             "c_y": -0.005, "k1": -0.06, "k2": 0.01, "k3": 0.001, "p1": 2e-4, "p2": -1e-4}  # fmt: skip
    camera = load_camera(written(tmp_path, [{"cameras": {"a": brown}, "shots": {"1.jpg": {"rotation": [0.1, 0, 0]}}}]))
    assert (camera.fx, camera.fy) == (pytest.approx(1126.4), pytest.approx(1139.2))
    assert (camera.cx, camera.cy) == (pytest.approx(652.3), pytest.approx(353.1))
    np.testing.assert_allclose(camera.dist, [-0.06, 0.01, 2e-4, -1e-4, 0.001])
    with pytest.raises(InputError, match="spherical"):
        load_camera(written(tmp_path, {"a": one | {"projection_type": "spherical"}}))
    with pytest.raises(InputError, match="without height"):
        load_camera(written(tmp_path, {"a": {k: v for k, v in one.items() if k != "height"}}))


def test_photonvision_with_eight_terms(tmp_path: Path) -> None:
    terms = [-0.04, -0.036, -0.0016, -0.0006, 0.14, -0.094, 0.057, 0.115]
    content = {
        "resolution": {"width": 1280.0, "height": 720.0},
        "cameraIntrinsics": {"rows": 3, "cols": 3, "type": 6, "data": [1130, 0, 645.3, 0, 1130, 356.8, 0, 0, 1]},
        "distCoeffs": {"rows": 1, "cols": 8, "type": 6, "data": terms}, "calobjectWarp": [6e-4, 5e-5],
    }  # fmt: skip
    camera = load_camera(written(tmp_path, content))
    assert (camera.width, camera.fx, camera.cx) == (1280, 1130.0, 645.3)
    assert camera.lens is not None and camera.lens.terms[:8] == tuple(terms)


def test_a_matrix_of_another_resolution_is_doubted() -> None:
    doubt = Camera(1280, 800, 540.92, 477.43, 318.44, 184.38).doubt
    assert "27 % of the picture off its middle" in doubt and "fx and fy differ by 13 %" in doubt and "1280×800" in doubt
    assert Camera(1280, 800, 1100.0, 1102.0, 655.0, 380.0).doubt == ""
