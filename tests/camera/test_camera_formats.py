"""Cameras as the formats write them: right numbers, or one line that names what is not understood."""

import json
import math
import struct
from pathlib import Path

import numpy as np
import pytest

from arview.camera.lens import LensDistortion, LensModel
from arview.camera.read import load_camera, save_camera
from arview.errors import ArviewError, InputError, MismatchError

ROI = """\
height: 960
width: 1280
distortion_model: plumb_bob
d: [-0.11, 0.07, 0.0002, -0.0004, 0.0]
k: [1180.0, 0.0, 640.2, 0.0, 1180.0, 478.9, 0.0, 0.0, 1.0]
p: [1180.0, 0.0, 640.2, 0.0, 0.0, 1180.0, 478.9, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
binning_y: 0
roi:
  x_offset: 320
  y_offset: 240
  height: 480
  width: 640
  do_rectify: false
"""
OPENCV_FISHEYE = """\
%YAML:1.0
---
calibration_time: "Tue 03 Nov 2026 09:12:44 AM CET"
image_width: 1280
image_height: 720
board_width: 9
fix_aspect_ratio: 1.
flags: 522
fisheye_model: 1
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 620.0, 0., 639.5, 0., 620.0, 359.5, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 4
   cols: 1
   dt: d
   data: [ -0.021, 0.0061, -0.0034, 0.0007 ]
"""
PLAIN = {"width": 1280, "height": 720, "fx": 1130.0, "fy": 1130.0, "cx": 645.3, "cy": 356.8}
TWO = """\
left:
  image_width: 1280
  image_height: 720
  camera_matrix: [1130.0, 0, 645.3, 0, 1130.0, 356.8, 0, 0, 1]
  distortion_coefficients: [-0.06, 0.01, 0, 0, 0]
right:
  image_width: 1280
  image_height: 720
  camera_matrix: [990.0, 0, 610.0, 0, 990.0, 366.0, 0, 0, 1]
  distortion_coefficients: [-0.2, 0.08, 0, 0, 0]
"""
KALIBR = """\
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 0.00002]
  distortion_model: radtan
  intrinsics: [458.6, 457.3, 367.2, 248.4]
  resolution: &size [752, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [-0.01, 0.02, -0.01, 0.003]
  distortion_model: equidistant
  intrinsics: [459.6, 458.3, 368.2, 249.4]
  resolution: *size
  timeshift_cam_imu: 0.002
"""
NERF_FRAME = {"file_path": "images/1.png", "transform_matrix": np.eye(4).tolist()}
NERF = {"camera_model": "OPENCV", "fl_x": 1000.0, "fl_y": 1001.0, "cx": 640.0, "cy": 360.0, "w": 1280, "h": 720,
        "k1": 0.05, "k2": -0.02, "p1": 0.001, "p2": -0.0005, "applied_scale": 2.0, "aabb_scale": 16,
        "frames": [NERF_FRAME]}  # fmt: skip


def write(folder: Path, content: object, name: str = "camera.yaml") -> str:
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return str(path)


def test_roi_of_the_same_aspect_is_a_crop_and_no_resize(tmp_path: Path) -> None:
    path = write(tmp_path, ROI)
    camera = load_camera(path, 640, 480)
    assert (camera.fx, camera.fy) == (1180.0, 1180.0)
    assert (camera.cx, camera.cy) == pytest.approx((320.2, 238.9))
    assert camera.dist.tolist() == [-0.11, 0.07, 0.0002, -0.0004, 0.0]
    assert load_camera(path, 320, 240).fx == 590.0  # the crop, resized
    with pytest.raises(MismatchError, match="640×480 px by roi or binning, but they are 1280×960"):
        load_camera(path, 1280, 960)
    with pytest.raises(InputError, match="reaches beyond the 1280×960 picture"):
        load_camera(write(tmp_path, ROI.replace("x_offset: 320", "x_offset: 700")), 640, 480)


def test_binning_with_and_without_roi(tmp_path: Path) -> None:
    binned = ROI.replace("binning_x: 0", "binning_x: 2").replace("binning_y: 0", "binning_y: 2")
    camera = load_camera(write(tmp_path, binned), 320, 240)
    assert camera.fx == 590.0
    assert camera.cx == pytest.approx((640.2 - 320 + 0.5) / 2 - 0.5)
    whole = binned[: binned.index("roi:")]
    camera = load_camera(write(tmp_path, whole), 640, 480)
    assert (camera.fx, camera.cy) == pytest.approx((590.0, (478.9 + 0.5) / 2 - 0.5))
    with pytest.raises(MismatchError, match="binning"):
        load_camera(write(tmp_path, whole), 1280, 960)


def test_opencv_fisheye(tmp_path: Path) -> None:
    camera = load_camera(write(tmp_path, OPENCV_FISHEYE), 1280, 720)
    assert camera.lens == LensDistortion(LensModel.FISHEYE, (-0.021, 0.0061, -0.0034, 0.0007))
    # A point 30° off the axis: f θ (1 + k1 θ² + …), by hand.
    theta = math.radians(30)
    radius = 620 * theta * (1 - 0.021 * theta**2 + 0.0061 * theta**4 - 0.0034 * theta**6 + 0.0007 * theta**8)
    assert camera.project([math.tan(theta), 0.0, 1.0]) == pytest.approx([639.5 + radius, 359.5])
    plain = load_camera(write(tmp_path, OPENCV_FISHEYE.replace("fisheye_model: 1", "fisheye_model: 0")))
    assert plain.lens is None
    assert plain.dist.tolist() == [-0.021, 0.0061, -0.0034, 0.0007, 0.0]


@pytest.mark.parametrize(
    ("changes", "dist"),
    [
        ({"camera_model": "OPENCV", "k1": -0.06, "k2": 0.01, "p1": 0.001, "p2": 0.0}, [-0.06, 0.01, 0.001, 0, 0]),
        ({"model": "brown_conrady", "coeffs": [-0.05, 0.06, 0.0, 0.0, -0.02]}, [-0.05, 0.06, 0, 0, -0.02]),
        ({"model": "distortion.inverse_brown_conrady", "coeffs": [0.0] * 5}, [0, 0, 0, 0, 0]),
        ({"distortion": {"k1": -0.06, "k2": 0.01}}, [-0.06, 0.01, 0, 0, 0]),
        ({"dist": [[-0.06, 0.01, 0, 0, 0.2]]}, [-0.06, 0.01, 0, 0, 0.2]),
        ({"dist": [-0.06, 0.01, 0, 0, 0.2, 0, 0, 0]}, [-0.06, 0.01, 0, 0, 0.2]),
    ],
)
def test_distortion_under_other_names(tmp_path: Path, changes: dict[str, object], dist: list[float]) -> None:
    camera = load_camera(write(tmp_path, PLAIN | changes))
    assert camera.lens is None
    assert camera.dist.tolist() == dist


def test_realsense_with_intrinsics_inside(tmp_path: Path) -> None:
    inner = {"width": 1280, "height": 720, "ppx": 645.3, "ppy": 356.8, "fx": 1130.0, "fy": 1130.0,
             "model": "distortion.kannala_brandt4", "coeffs": [0.1, 0.02, 0.0, 0.0, 0.0]}  # fmt: skip
    camera = load_camera(write(tmp_path, {"serial": "12", "model": "D435i", "intrinsics": inner}))
    assert (camera.cx, camera.lens) == (645.3, LensDistortion(LensModel.FISHEYE, (0.1, 0.02)))
    both = {"color": {"intrinsics": inner}, "depth": {"intrinsics": inner | {"fx": 900.0}}, "depth_scale": 0.001}
    path = write(tmp_path, both)
    assert load_camera(f"{path}:depth").fx == 900.0
    with pytest.raises(InputError, match=r"2 different cameras \(color, depth\)"):
        load_camera(path)


def test_several_cameras_are_asked_for_by_name(tmp_path: Path) -> None:
    path = write(tmp_path, TWO)
    with pytest.raises(InputError, match=r"2 different cameras \(left, right\); name one of them, as in camera.yaml:"):
        load_camera(path, 1280, 720)
    assert load_camera(f"{path}:left", 1280, 720).fx == 1130.0
    assert load_camera(f"{path}:right", 1280, 720).dist[0] == -0.2
    with pytest.raises(InputError, match="'middle'; it holds left, right"):
        load_camera(f"{path}:middle", 1280, 720)
    with pytest.raises(InputError, match="leave the name out"):
        load_camera(write(tmp_path, PLAIN) + ":cam0")
    with pytest.raises(InputError, match="distortion_model stands beside the camera left"):
        load_camera(write(tmp_path, TWO + "distortion_model: equidistant\n") + ":left")
    with pytest.raises(InputError, match="left: crop is not understood"):
        load_camera(write(tmp_path, TWO.replace("left:\n", "left:\n  crop: [1, 2, 3, 4]\n")) + ":left")


def test_stereo_calibration_of_opencv(tmp_path: Path) -> None:
    matrix = {"rows": 3, "cols": 3, "dt": "d", "data": [600, 0, 320, 0, 600, 240, 0, 0, 1]}
    other = matrix | {"data": [700, 0, 320, 0, 700, 240, 0, 0, 1]}
    terms = {"rows": 1, "cols": 5, "dt": "d", "data": [0.1, 0, 0, 0, 0]}
    path = write(tmp_path, {"M1": matrix, "D1": terms, "M2": other, "D2": terms | {"data": [0.2, 0, 0, 0, 0]}})
    with pytest.raises(InputError, match="2 different cameras"):
        load_camera(path, 640, 480)
    second = load_camera(f"{path}:2", 640, 480)
    assert (second.fx, second.dist[0]) == (700.0, 0.2)


def test_kalibr(tmp_path: Path) -> None:
    path = write(tmp_path, KALIBR)
    first, second = (load_camera(f"{path}:{name}", 752, 480) for name in ("cam0", "cam1"))
    assert (first.fx, first.fy, first.cx, first.cy) == (458.6, 457.3, 367.2, 248.4)
    assert first.dist.tolist() == [-0.28, 0.07, 0.0002, 0.00002, 0.0]
    assert second.lens == LensDistortion(LensModel.FISHEYE, (-0.01, 0.02, -0.01, 0.003))
    with pytest.raises(InputError, match="lens model 'omni' is not supported"):
        load_camera(write(tmp_path, KALIBR.replace("camera_model: pinhole", "camera_model: omni")) + ":cam0")
    # A camera that nobody asked for may be of any kind.
    assert load_camera(write(tmp_path, KALIBR.replace("equidistant", "eucm")) + ":cam0").fx == 458.6


def test_cameras_of_a_list_go_by_the_names_that_they_have(tmp_path: Path) -> None:
    cameras = {"cameras": [PLAIN | {"name": "left"}, PLAIN | {"name": "right", "fx": 900.0}]}
    assert load_camera(write(tmp_path, cameras) + ":right").fx == 900.0
    with pytest.raises(InputError, match="cameras/left, cameras/right"):
        load_camera(write(tmp_path, cameras))


@pytest.mark.parametrize(
    ("line", "lens"),
    [
        ("OPENCV_FISHEYE 640 480 300 301 320 240 0.1 0.02 0 0", LensDistortion(LensModel.FISHEYE, (0.1, 0.02))),
        ("SIMPLE_RADIAL_FISHEYE 640 480 300 320 240 0.1", LensDistortion(LensModel.FISHEYE, (0.1,))),
        ("FOV 640 480 300 301 320 240 0.9", LensDistortion(LensModel.FOV, (0.9,))),
        ("SIMPLE_DIVISION 640 480 300 320 240 -0.1", LensDistortion(LensModel.DIVISION, (-0.1,))),
        ("FULL_OPENCV 640 480 300 301 320 240 0 0 0 0 0 2 0 0", LensDistortion(LensModel.RATIONAL, (0, 0, 0, 0, 0, 2))),
    ],
)  # fmt: skip
def test_lenses_of_colmap(tmp_path: Path, line: str, lens: LensDistortion) -> None:
    path = write(tmp_path, f"1 {line}\n2 EUCM 640 480 1 1 1 1 0 0\n", "cameras.txt")
    camera = load_camera(f"{path}:1", 640, 480)
    assert (camera.lens, camera.cx, camera.cy) == (lens, 319.5, 239.5)


def test_inverse_brown_of_realsense(tmp_path: Path) -> None:
    terms = [-0.055, 0.061, 0.001, -0.0005, -0.02]
    camera = load_camera(write(tmp_path, PLAIN | {"model": "distortion.inverse_brown_conrady", "coeffs": terms}))
    assert camera.lens == LensDistortion(LensModel.INVERSE_BROWN, tuple(terms))
    save_camera(camera, tmp_path / "again.json")
    assert load_camera(tmp_path / "again.json").lens == camera.lens


def test_colmap_binary(tmp_path: Path) -> None:
    one = struct.pack("<iiQQ8d", 1, 4, 1280, 720, 900, 901, 640, 360, 0.1, 0.01, 1e-3, 0)
    wide = struct.pack("<iiQQ12d", 7, 10, 640, 480, 300, 301, 320, 240, 0.01, 0, 1e-3, 0, 0, 0, 2e-3, 0)
    path = tmp_path / "cameras.bin"
    path.write_bytes(struct.pack("<Q", 1) + one)
    camera = load_camera(path)
    assert (camera.width, camera.fx, camera.cx) == (1280, 900.0, 639.5)
    np.testing.assert_allclose(camera.dist, [0.1, 0.01, 1e-3, 0, 0])
    path.write_bytes(struct.pack("<Q", 2) + one + wide)
    with pytest.raises(ArviewError, match=r"holds 2 different cameras \(1, 7\); name one of them"):
        load_camera(path)
    other = load_camera(f"{path}:7")
    assert other.lens == LensDistortion(LensModel.THIN_PRISM_FISHEYE, (0.01, 0, 1e-3, 0, 0, 0, 2e-3, 0))
    for data in (
        path.read_bytes()[:-3],
        struct.pack("<Q", 2**60) + one,
        struct.pack("<Q", 1) + wide[:4] + b"\x63" + wide[5:],
    ):
        path.write_bytes(data)
        with pytest.raises(ArviewError, match="is not a text file"):
            load_camera(path)


def test_rational_polynomial_of_ros(tmp_path: Path) -> None:
    terms = [0.51, -2.73, 0.0007, -0.0002, 1.55, 0.39, -2.55, 1.47]
    text = ROI[: ROI.index("roi:")].replace("plumb_bob", "rational_polynomial")
    camera = load_camera(write(tmp_path, text.replace("[-0.11, 0.07, 0.0002, -0.0004, 0.0]", str(terms))))
    assert camera.lens == LensDistortion(LensModel.RATIONAL, tuple(terms))


def test_nerfstudio_counts_pixels_from_the_corner(tmp_path: Path) -> None:
    camera = load_camera(write(tmp_path, NERF, "transforms.json"))
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (1000.0, 1001.0, 639.5, 359.5)
    assert camera.dist.tolist() == [0.05, -0.02, 0.001, -0.0005, 0.0]
    fisheye = NERF | {"camera_model": "OPENCV_FISHEYE", "p1": 0.0, "p2": 0.0, "k3": 0.01, "k4": 0.002}
    assert load_camera(write(tmp_path, fisheye)).lens == LensDistortion(LensModel.FISHEYE, (0.05, -0.02, 0.01, 0.002))
    each = NERF | {"scale": 0.5, "frames": [NERF_FRAME | {"fl_x": 1000.0}]}
    of_frame = load_camera(write(tmp_path, each))
    assert (of_frame.fx, of_frame.dist[0]) == (1000.0, 0.05)
    zoomed = NERF | {"frames": [NERF_FRAME | {"fl_x": 1000.0}, NERF_FRAME | {"fl_x": 1100.0}]}
    assert load_camera(write(tmp_path, zoomed) + ":frames/1").fx == 1100.0
    angle = {"camera_angle_x": math.radians(60), "w": 800, "h": 800, "frames": []}
    assert load_camera(write(tmp_path, angle)).fx == pytest.approx(400 / math.tan(math.radians(30)))


def test_opencv_xml_fisheye_and_document_types(tmp_path: Path) -> None:
    xml = (
        "<?xml version='1.0'?>\n<opencv_storage><image_width>640</image_width><image_height>480</image_height>"
        "<fisheye_model>1</fisheye_model><camera_matrix type_id='opencv-matrix'><rows>3</rows><cols>3</cols><dt>d</dt>"
        "<data>300. 0. 319.5 0. 300. 239.5 0. 0. 1.</data></camera_matrix>"
        "<distortion_coefficients type_id='opencv-matrix'><rows>4</rows><cols>1</cols><dt>d</dt>"
        "<data>1.e-02 0. 0. 0.</data></distortion_coefficients></opencv_storage>"
    )
    assert load_camera(write(tmp_path, xml)).lens == LensDistortion(LensModel.FISHEYE, (0.01,))
    with pytest.raises(InputError, match="document type"):
        load_camera(write(tmp_path, "<!DOCTYPE a [<!ENTITY b 'c'>]><a>&b;</a>"))


def test_own_format_keeps_the_lens(tmp_path: Path) -> None:
    camera = load_camera(write(tmp_path, OPENCV_FISHEYE))
    save_camera(camera, tmp_path / "own.json")
    again = load_camera(tmp_path / "own.json")
    assert (again.lens, again.fx, again.cx) == (camera.lens, camera.fx, camera.cx)


BAD = {
    "crop": (PLAIN | {"crop": [10, 20, 640, 480]}, "crop is not understood"),
    "crop inside": (PLAIN | {"sensor": {"offset_x": 320}}, "sensor.offset_x is not understood"),
    "camel case": (PLAIN | {"BinningHorizontal": 2}, "BinningHorizontal is not understood"),
    "scale": (PLAIN | {"scale": 0.5}, "scale is not understood"),
    "turn": (PLAIN | {"rotation": 90}, "rotation is not understood"),
    "other distortion": (PLAIN | {"radial_distortion": [0.1, 0.2]}, "radial_distortion is not understood"),
    "toolbox": (PLAIN | {"kc": [0.1, 0, 0, 0, 0]}, "kc is not understood"),
    "long key": (PLAIN | {"dist" + 900 * "9": 1}, "999…"),
    "two lines": ("height: 7\n  8\nfx: 1\n", "height is '7 8'; expected numbers"),
    "k7": (PLAIN | {"k7": 0.1}, "k7 is not understood"),
    "roi as a list": (PLAIN | {"roi": [0, 0, 10, 10]}, "roi is not understood"),
    "unknown model": (PLAIN | {"camera_model": "mei"}, "lens model 'mei' is not supported"),
    "models": (PLAIN | {"camera_model": "fisheye", "model": "plumb_bob", "D": [0.1, 0, 0, 0]}, "contradict"),
    "none with terms": (PLAIN | {"model": "none", "coeffs": [0.1, 0, 0, 0, 0]}, "terms that are not zero"),
    "omni": (PLAIN | {"camera_model": "omni", "coeffs": [0.1, 0, 0, 0]}, "lens model 'omni' is not supported"),
    "k3 k4": (PLAIN | {"k1": 0.1, "k2": 0.1, "k3": 0.1, "k4": 0.1}, "fisheye or Brown"),
    "fisheye p1": (PLAIN | {"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "p1": 0.1}, "p1 is 0.1, which is not a term"),
    "fisheye bare": (PLAIN | {"camera_model": "fisheye"}, "no distortion terms"),
    "tilted": (PLAIN | {"dist": [0.1] * 14}, "tilted sensor is not supported"),
    "three terms": (PLAIN | {"dist": [0.1, 0.2, 0.3]}, "3 distortion terms"),
    "two matrices": (PLAIN | {"K": [900, 0, 645.3, 0, 900, 356.8, 0, 0, 1]}, "fx and K differ"),
    "two lists": (PLAIN | {"D": [0.1, 0, 0, 0], "dist": [0.2, 0, 0, 0]}, "D and dist differ"),
    "list and names": (PLAIN | {"D": [0.1, 0, 0, 0], "k1": 0.2, "p1": 0.0}, "two sets of distortion terms"),
    "two sizes": (PLAIN | {"resolution": [640, 480]}, "width and resolution differ"),
    "two values": ('{"fx": 1, "fx": 2}', "holds fx twice"),
    "two values in yaml": ("fx: 1\nfx: 2\n", "holds fx twice"),
    "matrix size": ("K: {rows: 3, cols: 3, data: [1, 2]}\n", "K has 2 numbers, not 3 × 3"),
    "broken yaml": ("K: [1, 2\nfx: 3\n", r"not valid YAML \(line"),
    "yaml object": ("K: !!python/object:os.system [ls]\n", "not valid YAML"),
    "alias bomb": ("a: &a [1,1,1,1,1,1,1,1,1,1]\n" + "".join(
        f"{chr(98 + i)}: &{chr(98 + i)} [" + ",".join([f"*{chr(97 + i)}"] * 10) + "]\n" for i in range(8)), "aliases"),
    "endless": ("a: &a [*a]\n", "aliases|not valid YAML"),
    "deep": ("[" * 20000, "nested too deeply|not valid JSON"),
    "agisoft": ("<calibration><projection>frame</projection><w>9</w><f>5</f></calibration>", "no width, height"),
    "other json": ({"a": ["b"]}, "no camera matrix.*Kalibr camchain, COLMAP"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_what_is_not_understood_is_named(tmp_path: Path, case: str) -> None:
    content, message = BAD[case]
    path = write(tmp_path, content)
    with pytest.raises(ArviewError, match=message) as caught:
        load_camera(path, 1280, 720)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_names_that_change_nothing_are_accepted(tmp_path: Path) -> None:
    extra = {"scale": 1.0, "crop": None, "binning_x": 1, "depth_scale": 0.1, "skew": 0.0, "rotation": 0,
             "rectification_matrix": [1, 0, 0, 0, 1, 0, 0, 0, 1], "camera_name": "front", "samples": 31,
             "lens": {"make": "Apple", "focal_length_mm": 4.2, "digital_zoom": 2.0},
             "calibration": {"tool": "arview 1", "uncertainty": {"fx": 1, "fy": 1, "cx": 1, "cy": 1}}}  # fmt: skip
    assert load_camera(write(tmp_path, PLAIN | extra)).fx == 1130.0


ORB_SLAM = """\
%YAML:1.0
Camera.type: "KannalaBrandt8"
Camera1.fx: 620.0
Camera1.fy: 621.0
Camera1.cx: 639.5
Camera1.cy: 359.5
Camera1.k1: -0.02
Camera1.k2: 0.006
Camera1.k3: -0.003
Camera1.k4: 0.0007
Camera.width: 1280
Camera.height: 720
Camera.fps: 30.0
ORBextractor.scaleFactor: 1.2
"""
OST = """\
# oST version 5.0 parameters

[image]

width
1280

height
720

[narrow_stereo]

camera matrix
1130.0 0.0 645.3
0.0 1131.0 356.8
0.0 0.0 1.0

distortion
-0.06 0.01 0.001 -0.002 0.0

rectification
1.0 0.0 0.0
0.0 1.0 0.0
0.0 0.0 1.0

projection
1100.0 0.0 640.0 0.0
0.0 1100.0 360.0 0.0
0.0 0.0 1.0 0.0
"""
ZED = "[{0}]\nfx=700.1\nfy=700.2\ncx=640.2\ncy=360.5\nk1=-0.17\nk2=0.02\np1=0\np2=0\nk3=0\n"


def test_a_matrix_written_column_by_column(tmp_path: Path) -> None:
    path = tmp_path / "open3d.json"
    matrix = [1130.0, 0, 0, 0, 1131.0, 0, 645.3, 356.8, 1]
    path.write_text(json.dumps({"width": 1280, "height": 720, "intrinsic_matrix": matrix}))
    camera = load_camera(path)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (1130.0, 1131.0, 645.3, 356.8)
    path.write_text(json.dumps({"width": 1280, "height": 720, "K": [1130.0, 0, 5.0, 0, 1131.0, 0, 645.3, 356.8, 1]}))
    with pytest.raises(InputError, match="row-major"):
        load_camera(path)


def test_settings_of_orb_slam(tmp_path: Path) -> None:
    path = tmp_path / "orb.yaml"
    path.write_text(ORB_SLAM)
    camera = load_camera(path)
    assert (camera.width, camera.height, camera.fx, camera.fy) == (1280, 720, 620.0, 621.0)
    assert camera.lens == LensDistortion(LensModel.FISHEYE, (-0.02, 0.006, -0.003, 0.0007))


def test_ini_files_of_ros_and_zed(tmp_path: Path) -> None:
    path = tmp_path / "ost.txt"
    path.write_text(OST)
    camera = load_camera(path)
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cy) == (1280, 720, 1130.0, 1131.0, 356.8)
    assert camera.dist.tolist() == [-0.06, 0.01, 0.001, -0.002, 0.0]
    path = tmp_path / "SN1234.conf"
    path.write_text(ZED.format("LEFT_CAM_HD") + ZED.format("RIGHT_CAM_HD").replace("700.1", "701.1"))
    with pytest.raises(InputError, match="2 different cameras"):
        load_camera(path, 1280, 720)
    camera = load_camera(f"{path}:RIGHT_CAM_HD", 1280, 720)
    assert (camera.fx, camera.cx, float(camera.dist[0])) == (701.1, 640.2, -0.17)
    path.write_text("[cam]\nfx=\nwhat\nfy=1\n")
    with pytest.raises(InputError):
        load_camera(path, 1280, 720)
