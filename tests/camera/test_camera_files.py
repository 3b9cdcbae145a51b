"""Camera files: every format gives the same numbers, and every bad file one clear line."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from arview.camera import Camera
from arview.camera.exif import read_exif
from arview.camera.read import guess_camera, load_camera, save_camera
from arview.errors import ArviewError, InputError, MismatchError, OutputError
from helpers.paths import SHARED

CAMERA = Camera(640, 480, 600.5, 601.25, 320.75, 239.5, np.array([-0.21, 0.07, 0.001, -0.002, 0.03]))
DATA = SHARED

ROS = """\
image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [600.5, 0.000000, 320.75,
         0., 601.25, 239.5, 0., 0., 1.]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.21, 0.07, 0.001, -2.0e-3, 0.03]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
"""
ROS_TOPIC = """\
header:
  stamp:
    sec: 12
  frame_id: cam
height: 480
width: 640
distortion_model: plumb_bob
d:
- -0.21
- 0.07
- 0.001
- -0.002
- 0.03
k:
- 600.5
- 0.0
- 320.75
- 0.0
- 601.25
- 239.5
- 0.0
- 0.0
- 1.0
r: [1, 0, 0, 0, 1, 0, 0, 0, 1]
"""


def write(folder: Path, text: str, name: str = "camera.txt") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def own_json(**changes: object) -> str:
    record = {"width": 640, "height": 480, "fx": 600.5, "fy": 601.25, "cx": 320.75, "cy": 239.5}
    record |= {"dist": [-0.21, 0.07, 0.001, -0.002, 0.03]} | changes
    return json.dumps({key: value for key, value in record.items() if value is not None})


def assert_same(camera: Camera, expected: Camera = CAMERA) -> None:
    assert (camera.width, camera.height) == (expected.width, expected.height)
    np.testing.assert_allclose(camera.matrix, expected.matrix, rtol=0, atol=1e-9)
    np.testing.assert_allclose(camera.dist, expected.dist, rtol=0, atol=1e-12)


def test_own_json_round_trip(tmp_path: Path) -> None:
    save_camera(CAMERA, tmp_path / "c.json")
    assert_same(load_camera(str(tmp_path / "c.json")))
    assert set(json.loads((tmp_path / "c.json").read_text())) == {
        "width",
        "height",
        "fx",
        "fy",
        "cx",
        "cy",
        "dist",
    }
    with pytest.raises(OutputError, match="cannot write"):
        save_camera(CAMERA, tmp_path / "missing" / "c.json")


@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json"])
def test_opencv_file_storage(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"calibration{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Sat Nov 21 2026")
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", CAMERA.matrix)
    storage.write("distortion_coefficients", CAMERA.dist.reshape(5, 1))
    storage.write("avg_reprojection_error", 0.25)
    storage.release()
    assert_same(load_camera(str(path)))
    # The content decides, not the name.
    renamed = path.rename(tmp_path / "camera.dat")
    assert_same(load_camera(str(renamed), 640, 480))


@pytest.mark.parametrize("text", [ROS, ROS_TOPIC], ids=["calibrator", "topic echo"])
def test_ros_camera_info(tmp_path: Path, text: str) -> None:
    assert_same(load_camera(str(write(tmp_path, text))))


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("SIMPLE_PINHOLE 640 480 600 320 240", Camera(640, 480, 600, 600, 319.5, 239.5)),
        ("PINHOLE 640 480 600 610 320 240", Camera(640, 480, 600, 610, 319.5, 239.5)),
        (
            "SIMPLE_RADIAL 640 480 600 320 240 -0.1",
            Camera(640, 480, 600, 600, 319.5, 239.5, np.array([-0.1, 0, 0, 0, 0])),
        ),
        (
            "RADIAL 640 480 600 320 240 -0.1 0.02",
            Camera(640, 480, 600, 600, 319.5, 239.5, np.array([-0.1, 0.02, 0, 0, 0])),
        ),
        (
            "OPENCV 640 480 600.5 601.25 321.25 240 -0.21 0.07 0.001 -0.002",
            Camera(640, 480, 600.5, 601.25, 320.75, 239.5, np.array([-0.21, 0.07, 0.001, -0.002, 0])),
        ),
        ("FULL_OPENCV 640 480 600.5 601.25 321.25 240 -0.21 0.07 0.001 -0.002 0.03 0 0 0", CAMERA),
    ],
)
def test_colmap(tmp_path: Path, line: str, expected: Camera) -> None:
    header = "# Camera list with one line per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    assert_same(load_camera(str(write(tmp_path, f"{header}1 {line}\n"))), expected)


def test_colmap_with_several_cameras(tmp_path: Path) -> None:
    line = "PINHOLE 640 480 600 610 320 240"
    assert load_camera(str(write(tmp_path, f"1 {line}\n2 {line}\n"))).fy == 610
    with pytest.raises(InputError, match=r"2 different cameras \(1, 7\); name one of them, as in camera.txt:7"):
        load_camera(str(write(tmp_path, f"1 {line}\n7 PINHOLE 640 480 601 610 320 240\n")))


def test_bop_files(tmp_path: Path) -> None:
    text = own_json(dist=None, width=None, height=None, depth_scale=0.1)
    camera = load_camera(str(write(tmp_path, text)), 640, 480)
    assert (camera.width, camera.height, camera.fx, camera.is_distorted) == (640, 480, 600.5, False)
    with pytest.raises(InputError, match="no image size"):
        load_camera(str(write(tmp_path, text)))
    with pytest.raises(MismatchError, match="far from the centre of the 1920×1080 frames"):
        load_camera(str(write(tmp_path, text)), 1920, 1080)
    frames = {str(i): {"cam_K": CAMERA.matrix.ravel().tolist(), "depth_scale": 1.0} for i in range(3)}
    assert load_camera(str(write(tmp_path, json.dumps(frames))), 640, 480).cy == 239.5
    frames["2"]["cam_K"] = [700, 0, 320, 0, 700, 240, 0, 0, 1]
    with pytest.raises(InputError, match="3 different cameras"):
        load_camera(str(write(tmp_path, json.dumps(frames))), 640, 480)


@pytest.mark.shared
def test_bop_camera_of_the_shared_data() -> None:
    path = DATA / "sequences" / "castle" / "camera.json"
    assert load_camera(str(path), 640, 480).fx > 300


def test_scaling_to_the_frames(tmp_path: Path) -> None:
    path = str(write(tmp_path, own_json()))
    camera = load_camera(path, 320, 240)
    assert_same(camera, CAMERA.scaled(320, 240))
    assert camera.cx == pytest.approx((320.75 + 0.5) / 2 - 0.5)
    assert load_camera(path, 854, 640).width == 854  # 853.33 px rounded up by the scaler
    with pytest.raises(MismatchError, match=r"640×480 px, the frames are 480×640 px.*turn the frames"):
        load_camera(path, 480, 640)
    with pytest.raises(MismatchError, match=r"640×480 px, the frames are 1280×720 px.*aspect ratio"):
        load_camera(path, 1280, 720)


def test_camera_turns_with_the_frames(tmp_path: Path) -> None:
    path = str(write(tmp_path, own_json()))
    assert_same(load_camera(path, 480, 640, quarter_turns_clockwise=1), CAMERA.rotated(1))
    assert_same(load_camera(path, 240, 320, quarter_turns_clockwise=3), CAMERA.scaled(320, 240).rotated(3))
    assert_same(load_camera(path, 640, 480, quarter_turns_clockwise=2), CAMERA.rotated(2))
    # A file calibrated on the turned frames is used as it is.
    assert_same(load_camera(path, 640, 480, quarter_turns_clockwise=1))


def test_field_of_view_and_guess() -> None:
    camera = load_camera("fov:60", 1080, 1920)
    assert camera.fx == pytest.approx(960 / math.tan(math.radians(30)))
    assert (camera.cx, camera.cy) == (539.5, 959.5)
    assert guess_camera(480, 640).fx == guess_camera(480, 640).fy == 768.0
    for spec in ("fov:abc", "fov:0", "fov:nan", "fov:180"):
        with pytest.raises(InputError, match="expected fov:DEG"):
            load_camera(spec, 640, 480)
    with pytest.raises(InputError, match="size of the frames is needed"):
        load_camera("fov:60")


def write_photo(path: Path, **tags: float | str) -> Path:
    from PIL import Image

    image = Image.new("RGB", (400, 300))
    exif = image.getexif()
    details = exif.get_ifd(0x8769)
    for name, value in tags.items():
        if name == "focal_35mm":
            details[0xA405] = value
        elif name == "focal":
            details[0x920A] = value
        else:
            exif[{"model": 0x0110, "orientation": 0x0112}[name]] = value
    image.save(path, exif=exif)
    return path


def test_exif(tmp_path: Path) -> None:
    write_photo(tmp_path / "a.jpg", focal_35mm=26, focal=5.7, orientation=6)
    camera = load_camera("exif", 300, 400, source=tmp_path)
    assert camera.fx == pytest.approx(26 * 500 / math.hypot(36, 24))
    assert read_exif(tmp_path / "a.jpg").quarter_turns_clockwise == 1
    photo = write_photo(tmp_path / "b.jpg", focal=50.0, model="Canon EOS 5D Mark IV")
    assert load_camera("exif", 4000, 3000, source=photo).fx == pytest.approx(50 / 36 * 4000)
    assert load_camera("exif", source=tmp_path / "b*.jpg").width == 400
    with pytest.raises(InputError, match="sensor of 'Nobody 1' is not known"):
        load_camera("exif", 400, 300, source=write_photo(tmp_path / "c.jpg", focal=8.0, model="Nobody 1"))
    with pytest.raises(InputError, match="no focal length in its EXIF"):
        load_camera("exif", 400, 300, source=write_photo(tmp_path / "d.jpg"))
    for source in (None, tmp_path / "clip.mp4", tmp_path / "none" / "*.jpg"):
        with pytest.raises(InputError, match=r"exif|photo"):
            load_camera("exif", 400, 300, source=source)


BAD_FILES = {
    "nan": (own_json(fx=math.nan), "NaN"),
    "zero focal": (own_json(fy=0), "focal length fx=600.5 fy=0.0 px is not positive"),
    "focal in mm": (own_json(fx=4.2, fy=4.2), "is it in mm"),
    "principal point": (own_json(cx=5000), r"principal point \(5000, 239.5\) is far outside the 640×480"),
    "missing keys": (own_json(fx=None, cy=None), "no fx, cy in the camera file"),
    "no keys": ('{"hello": 1}', "no camera matrix and no fx, fy, cx, cy"),
    "text value": (own_json(fx="wide"), "fx is 'wide'; expected numbers"),
    "null value": ('{"fx": null, "fy": 1, "cx": 1, "cy": 1}', "fx is null"),
    "size zero": (own_json(width=0), "width is 0; expected a positive"),
    "broken json": ('{"fx": 600.5,', "not valid JSON"),
    "json list": ("[1, 2, 3]", "no camera matrix and no fx, fy, cx, cy"),
    "prose": ("these are not the intrinsics\n", "not a camera file"),
    "empty": ("\n", "is empty"),
    "broken xml": ("<?xml version='1.0'?><opencv_storage>", "not valid XML"),
    "yaml without matrix": ("%YAML:1.0\n---\nimage_width: 640\n", "no camera matrix"),
    "yaml nan": (ROS.replace("601.25", ".nan"), "NaN"),
    "fisheye": (ROS.replace("plumb_bob", "mei"), "lens model 'mei' is not supported"),
    "eight terms": (
        ROS.replace("0.03]", "0.03, 1, 2, 3]").replace("cols: 5", "cols: 8"),
        "8 distortion terms, but plumb_bob",
    ),
    "row and column order": (own_json(K=[600, 0, 5, 0, 600, 0, 320, 240, 1]), "row-major"),
    "skew": (own_json(K=[600, 9, 320, 0, 600, 240, 0, 0, 1]), "skew 9"),
    "colmap fisheye": ("1 EUCM 640 480 1 1 1 1 0 0\n", "EUCM is not supported"),
    "colmap short": ("1 PINHOLE 640 480 600 600\n", "PINHOLE needs 4 parameters, the file gives 2"),
    "colmap prose": ("1 PINHOLE 640 480 600 600 a b\n", "not ID MODEL WIDTH HEIGHT"),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_files_give_one_clear_line(tmp_path: Path, case: str) -> None:
    text, message = BAD_FILES[case]
    path = write(tmp_path, text)
    with pytest.raises(ArviewError, match=message) as caught:
        load_camera(str(path), 640, 480)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_bad_paths(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="camera file not found; give a camera file, fov:DEG"):
        load_camera(str(tmp_path / "nowhere.json"))
    with pytest.raises(InputError, match="is a folder"):
        load_camera(str(tmp_path))
    binary = tmp_path / "cameras.bin"
    binary.write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match="not a text file"):
        load_camera(str(binary))
