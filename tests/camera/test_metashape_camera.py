"""Cameras of Metashape's XML: the frame camera in pixels as its manual defines it, or one line of what is not read."""

from pathlib import Path

import numpy as np
import pytest

from arview.camera.read import load_camera
from arview.errors import InputError
from arview.geometry import Array

NUMBERS = {"f": 2139.25, "cx": -18.02, "cy": 2.5, "b1": 1.5, "k1": 0.074, "k2": -0.579, "k3": 0.597, "p1": -4e-4,
           "p2": 1.02e-3}  # fmt: skip
SENSOR = """<sensor id="{id}" label="{label}" type="{kind}"><resolution width="1920" height="1280"/>
<calibration type="{kind}" class="initial"><resolution width="1920" height="1280"/><f>1000</f></calibration>
<calibration type="{kind}" class="adjusted"><resolution width="1920" height="1280"/>{numbers}</calibration></sensor>"""


def numbers_xml(**changed: float) -> str:
    return "".join(f"<{key}>{value!r}</{key}>" for key, value in (NUMBERS | changed).items())


def document(path: Path, *sensors: str) -> Path:
    head = '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0"><chunk label="Chunk 1"><sensors>'
    path.write_text(f"{head}{''.join(sensors)}</sensors><cameras/></chunk></document>")
    return path


def sensor(label: str = "X-T3", kind: str = "frame", id: int = 0, **changed: float) -> str:
    return SENSOR.format(label=label, kind=kind, id=id, numbers=numbers_xml(**changed))


def projected(points: Array, p: dict[str, float]) -> Array:
    """Pixels of points (N,2) at depth 1 by the manual's formulas; the first pixel's centre is at (0.5, 0.5)."""
    x, y = points.T
    r2 = x * x + y * y
    radial = 1.0 + p["k1"] * r2 + p["k2"] * r2**2 + p["k3"] * r2**3
    xd = x * radial + p["p1"] * (r2 + 2 * x * x) + 2 * p["p2"] * x * y
    yd = y * radial + p["p2"] * (r2 + 2 * y * y) + 2 * p["p1"] * x * y
    return np.stack([960.0 + p["cx"] + xd * (p["f"] + p["b1"]), 640.0 + p["cy"] + yd * p["f"]], axis=1)


def test_a_frame_camera_projects_as_the_manual_says(tmp_path: Path) -> None:
    camera = load_camera(document(tmp_path / "cameras.xml", sensor()))
    points = np.random.default_rng(0).uniform([-0.4, -0.28], [0.4, 0.28], (50, 2))
    pixels = camera.project(np.column_stack([points, np.ones(50)]))
    np.testing.assert_allclose(pixels, projected(points, NUMBERS) - 0.5, atol=1e-6)
    assert (camera.width, camera.height) == (1920, 1280)


def test_a_calibration_alone_is_read(tmp_path: Path) -> None:
    path = tmp_path / "calibration.xml"
    size = "<projection>frame</projection><width>1920</width><height>1280</height>"
    path.write_text(f'<?xml version="1.0"?>\n<calibration>{size}{numbers_xml()}<date>2026</date></calibration>')
    camera = load_camera(path, 960, 640)
    assert camera.fx == pytest.approx(0.5 * 2140.75) and float(camera.dist[2]) == 1.02e-3


def test_of_two_sensors_one_is_asked_for(tmp_path: Path) -> None:
    path = document(tmp_path / "cameras.xml", sensor("a"), sensor("b", id=1, f=1500.0))
    with pytest.raises(InputError, match=r"2 different cameras \(a, b\); name one of them"):
        load_camera(path)
    assert load_camera(f"{path}:b").fy == 1500.0


@pytest.mark.parametrize(
    ("sensors", "message"),
    [
        ([sensor(kind="fisheye")], "a fisheye camera of Metashape is not read; export the photos undistorted"),
        ([sensor(b2=-4.25)], r"b2 \(skew\) of Metashape's lens model are not read; fix them at 0"),
        ([sensor(k4=0.1)], "k4 of Metashape's lens model"),
        ([sensor(f=0.0)], "its calibration has no f"),
        ([sensor(f=float("nan"))], "f is 'nan'; expected a number"),
        ([], "no sensor in it has a calibration"),
        (["<sensor>"], "is not valid XML"),
    ],
)
def test_what_is_not_read_is_said_in_one_line(sensors: list[str], message: str, tmp_path: Path) -> None:
    path = document(tmp_path / "cameras.xml", *sensors)
    with pytest.raises(InputError, match=message) as caught:
        load_camera(path)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)
