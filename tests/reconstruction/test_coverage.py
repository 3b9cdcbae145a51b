from __future__ import annotations

import json

import numpy as np
import pytest

from arview.cad.load import load_model
from arview.cad.model import Model, make_model
from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array, look_at
from arview.reconstruction.coverage import coverage
from helpers.cad_files import box
from helpers.paths import SHARED
from helpers.synthetic import component

CAMERA = Camera(1600, 1200, 1900.0, 1900.0, 799.5, 599.5)
PLATE = SHARED / "plate"


def part() -> Model:
    """A plate with a wall on its −x side, a box behind the wall (at −x) and a stud on its underside."""
    return make_model(
        "part",
        (
            component("plate", box((-100, -100, -8), (100, 100, 0)), (0.5, 0.5, 0.5)),
            component("wall", box((-40, -100, 0), (-34, 100, 60)), (0.5, 0.5, 0.5)),
            component("box", box((-60, -12, 0), (-45, 12, 12)), (0.5, 0.5, 0.5)),
            component("stud", box((20, 20, -30), (40, 40, -8)), (0.5, 0.5, 0.5)),
        ),
    )


def views(azimuths_deg: list[float], elevation_deg: float = 40.0) -> list[tuple[Camera, Array]]:
    """Cameras 500 mm from the part's middle."""
    result = []
    for azimuth in np.radians(azimuths_deg):
        z = np.sin(np.radians(elevation_deg))
        flat = np.cos(np.radians(elevation_deg))
        eye = 500 * np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), z])
        result.append((CAMERA, look_at(eye, (0, 0, 0), (0, 0, 1))))
    return result


def test_photos_and_directions_are_counted() -> None:
    found = coverage(part(), views([0, 30, 60, 90, 120, 150, 180, 210, 240, 270, 300, 330]))
    by_name = {entry.name: entry for entry in found.components}
    assert by_name["plate"].photos == tuple(range(12))
    assert by_name["plate"].directions == 12
    assert by_name["plate"].gap_deg == pytest.approx(30, abs=0.5)
    assert by_name["plate"].spread_deg == pytest.approx(100, abs=1.0)  # 40° up on both sides
    # The wall hides the box from +x: the photos at 0° and ±30° do not see it, those from behind do.
    assert not {0, 1, 11} & set(by_name["box"].photos)
    assert {4, 5, 6, 7, 8} <= set(by_name["box"].photos)
    assert by_name["stud"].photos == ()
    (advice,) = found.advice
    assert advice.startswith("stud is seen in no photo; take 4 more of it") and "+z" not in advice


def test_advice_names_a_side_from_which_the_component_can_be_seen() -> None:
    model = part().only(["plate", "wall", "box"])
    names = [f"img_{k}.jpg" for k in range(8)]
    found = coverage(model, views([-90, -60, -30, 0, 30, 60, 90, 180]), names=names)
    (advice,) = [line for line in found.advice if line.startswith("box")]
    side = advice.split("side ")[1]
    assert "+x" not in side and "−z" not in side  # the widest gap between its views is at +x, behind the wall
    assert "img_7.jpg overlaps too little" in found.advice[0]


def test_an_enclosed_component_is_said_to_be_hidden() -> None:
    inside = component("core", box((-5, -5, -6), (5, 5, -2)), (0.5, 0.5, 0.5))
    found = coverage(make_model("closed", (*part().components[:1], inside)), views(list(range(0, 360, 30))))
    assert found.advice == (
        "core is seen in no photo; other components hide it from every side, so it cannot be measured in photos",
    )


def test_one_side_and_gap() -> None:
    assert "from one side (within 20°)" in coverage(part(), views([0, 5, 10, 15, 20], 5.0)).advice[0]
    advice = coverage(part(), views([-60, -30, 0, 30, 60])).advice
    assert any("240° around the side −x of the model" in line for line in advice)


@pytest.mark.parametrize("middle_deg", [0.0, 90.0, 200.0])
def test_photos_from_one_side_are_told_to_go_to_the_other(middle_deg: float) -> None:
    """Photos at three heights within 110° of azimuth: what lacks is the other side at their height, not from below."""
    shots = [
        shot
        for k, elevation in enumerate((30.0, 45.0, 62.0))
        for shot in views([middle_deg - 50.0 + 5.0 * k + 20.0 * j for j in range(6)], elevation)
    ]
    (line,) = [line for line in coverage(part(), shots).advice if line.startswith("no photo within")]
    gap_deg, side = float(line.split("within ")[1].split("°")[0]), line.split("side ")[1].split(" of")[0]
    assert 235.0 <= gap_deg <= 260.0
    other = np.deg2rad(middle_deg + 5.0 + 180.0)  # their middle is 5° farther
    assert side == " ".join(
        f"{'+' if value > 0 else '−'}{name}"
        for name, value in zip("xy", (np.cos(other), np.sin(other)), strict=True)
        if abs(value) > 0.38
    )


def test_small_in_the_picture_or_outside_is_not_seen() -> None:
    away = look_at((0, -500, 300), (0, -2000, 300), (0, 0, 1))
    names = [component.name for component in part().components]
    assert [(c.name, c.photos) for c in coverage(part(), [(CAMERA, away)]).components] == [(n, ()) for n in names]
    far = look_at((0, -60000, 30000), (0, 0, 0), (0, 0, 1))
    assert [(c.name, c.photos) for c in coverage(part(), [(CAMERA, far)]).components] == [(n, ()) for n in names]
    with pytest.raises(InputError, match="no camera poses"):
        coverage(part(), [])


@pytest.mark.shared
def test_the_plate_is_well_covered() -> None:
    truth = json.loads((PLATE / "truth.json").read_text())
    k = np.array(truth["K"])
    camera = Camera(1600, 1200, k[0, 0], k[1, 1], k[0, 2], k[1, 2])
    poses = truth["cam_from_model_mm"]
    poses = list(poses.values()) if isinstance(poses, dict) else poses
    found = coverage(load_model(PLATE / "plate.glb"), [(camera, np.array(pose)) for pose in poses])
    assert found.advice == ()
    assert min(len(entry.photos) for entry in found.components) >= 4
