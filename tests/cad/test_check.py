"""check_part: symmetries found in known shapes, sizes in pixels, and meshes with something wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from arview.cad import PartFinding, ViewRange, check_part, load_part, make_model
from arview.cad.check import PartCheck, can_confuse
from arview.cad.model import Component
from arview.cad.part import ComponentSettings, Datum, Part
from arview.cad.shape.symmetry import Symmetry, find_symmetries
from arview.camera import Camera
from arview.geometry import apply, exp_so3, rigid
from helpers.cad_files import box
from helpers.paths import SHARED

DATA = SHARED
ANYWHERE = rigid(exp_so3([0.4, -0.9, 1.3]), [130.0, -40.0, 70.0])


def has_problems(check: PartCheck) -> bool:
    return any(finding.severity == "problem" for finding in check.findings)


def prism(sides: int, radius: float, height: float, twist: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A closed upright prism about +Z."""
    angle = 2 * np.pi * np.arange(sides) / sides + twist
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(sides)], axis=1)
    vertices = np.concatenate([ring, ring + np.array([0, 0, height]), [[0, 0, 0], [0, 0, height]]])
    faces = []
    for i in range(sides):
        j = (i + 1) % sides
        faces += [
            (i, j, sides + j),
            (i, sides + j, sides + i),
            (2 * sides, j, i),
            (2 * sides + 1, sides + i, sides + j),
        ]
    return vertices, np.array(faces)


def component(name: str, mesh: tuple[np.ndarray, np.ndarray], at: tuple[float, float, float] = (0, 0, 0)) -> Component:
    return Component(name, mesh[0] + np.asarray(at, dtype=np.float64), mesh[1].astype(np.int32))


def part_of(*components: Component, view_range: ViewRange | None = None, **settings: ComponentSettings) -> Part:
    return Part(
        name="p",
        path=Path("p.toml"),
        cad_path=Path("p.glb"),
        model=make_model("p", components),
        settings=tuple(settings.get(c.name, ComponentSettings(c.name, position_tolerance_mm=1.0)) for c in components),
        view_range=view_range,
    )


def texts(check, severity: str) -> str:
    return "\n".join(finding.text for finding in check.findings if finding.severity == severity)


@pytest.mark.parametrize("pose", [np.eye(4), ANYWHERE], ids=["upright", "anywhere"])
@pytest.mark.parametrize(
    "mesh,orders",
    [
        (box((0, 0, 0), (10, 20, 30)), [2, 2, 2]),
        (box((0, 0, 0), (20, 20, 30)), [4, 2]),
        (prism(3, 10, 40), [3, 2]),
        (prism(5, 10, 40), [5, 2]),
        (prism(6, 10, 8), [6, 2]),
        (prism(48, 10, 40), [None, 2]),
    ],
    ids=["block", "square", "triangle", "pentagon", "hexagon", "cylinder"],
)
def test_symmetries_of_known_shapes(mesh, orders, pose):
    vertices = apply(pose, mesh[0])
    found = [item for item in find_symmetries(vertices, mesh[1]) if item.is_exact]
    assert sorted((f.symmetry.order or 0) for f in found) == sorted(order or 0 for order in orders)
    if orders[0] != 2:
        main = found[0].symmetry
        assert main.order == orders[0]
        assert abs(np.dot(main.axis_in_model, pose[:3, 2])) > 0.9999
        center = apply(pose, mesh[0]).mean(axis=0)
        apart = np.asarray(main.through_in_model) - center
        assert np.linalg.norm(np.cross(apart, main.axis_in_model)) < 0.05


def test_a_cube_has_its_13_axes_or_what_they_follow_from():
    found = find_symmetries(*box((0, 0, 0), (10, 10, 10)))
    assert sorted(item.symmetry.order or 0 for item in found) == [2, 3, 3, 3, 3, 4, 4, 4]


def test_a_lopsided_shape_has_none_and_an_exact_search_skips_near_ones():
    wedge = box((0, 0, 0), (10, 20, 30))
    wedge[0][7] = [16, 29, 41]
    assert find_symmetries(*wedge) == ()
    vertices, faces = box((0, 0, 0), (100, 60, 20))
    nub, nub_faces = box((80, 40, 20), (90, 50, 30))
    both = np.concatenate([vertices, nub]), np.concatenate([faces, nub_faces + 8])
    assert any(not item.is_exact and item.symmetry.order == 2 for item in find_symmetries(*both))
    assert find_symmetries(*both, near_share=0.0) == ()


def test_near_symmetry_names_the_component_that_breaks_it():
    check = check_part(
        part_of(
            component("plate", box((-100, -60, 0), (100, 60, 10))),
            component("left", box((-90, -10, 10), (-70, 10, 30))),
            component("right", box((70, -10, 10), (90, 10, 30))),
            component("key", box((20, 40, 10), (32, 52, 30))),
        )
    )
    said = texts(check, "warning")
    assert "nearly the same" in said
    assert "rotated by 180° about Z (98 % of its surface); distinguished by key" in said
    assert "looks the same" not in texts(check, "problem")


def test_an_exact_symmetry_is_a_problem_until_declared_or_out_of_view():
    block = component("block", box((0, 0, 0), (100, 60, 30)))
    free = check_part(part_of(block))
    assert "looks the same when rotated by 180° about" in texts(free, "problem")
    assert has_problems(free)
    narrow = ViewRange((300, 600), elevation_deg=(20, 70), azimuth_deg=(-60, 60), roll_deg=(-20, 20))
    seen = check_part(part_of(block, view_range=narrow))
    assert not has_problems(seen)
    assert "that the view range excludes" in texts(seen, "note")
    declared = tuple(Symmetry(axis, (50, 30, 15), 2) for axis in [(1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0)])
    told = check_part(replace(part_of(block), symmetries=declared))
    assert not has_problems(told)
    assert "symmetric as declared: 180° about X, 180° about Y, 180° about Z" in texts(told, "note")
    wrong = check_part(replace(part_of(block), symmetries=(Symmetry((0, 0, 1.0), (50, 30, 15), 3),)))
    assert "declared symmetry of the part, 120° about Z, is not in its geometry" in texts(wrong, "warning")


@pytest.mark.parametrize(
    "order,view_range,expected",
    [
        (2, ViewRange((1, 2)), True),
        (2, ViewRange((1, 2), azimuth_deg=(-80, 80), elevation_deg=(0, 60)), False),
        (4, ViewRange((1, 2), azimuth_deg=(-80, 80), elevation_deg=(0, 60)), True),
        # From straight above, half a turn about Z is half a turn of the picture.
        (2, ViewRange((1, 2), elevation_deg=(85, 90)), True),
        (2, ViewRange((1, 2), elevation_deg=(0, 60), azimuth_deg=(-180, 180), roll_deg=(-20, 20)), True),
        (None, ViewRange((1, 2), azimuth_deg=(-1, 1), elevation_deg=(0, 1)), True),
    ],
)
def test_can_confuse(order, view_range, expected):
    assert can_confuse(Symmetry((0, 0, 1.0), (0, 0, 0), order), view_range) is expected


def test_a_turn_about_x_upside_down_needs_free_roll():
    flip = Symmetry((1.0, 0, 0), (0, 0, 0), 2)
    # Seen along X, half a turn about X is half a turn of the picture.
    ahead = {"azimuth_deg": (-10.0, 10.0), "elevation_deg": (-10.0, 10.0)}
    assert can_confuse(flip, ViewRange((1, 2), **ahead))
    assert not can_confuse(flip, ViewRange((1, 2), **ahead, roll_deg=(-30, 30)))


@pytest.mark.slow
def test_bodies_of_revolution_and_declared_component_symmetries():
    post = component("post", prism(48, 8, 40))
    plate = component("plate", box((-50, -30, -10), (70, 30, 0)))
    spin = Symmetry((0, 0, 1.0), (0, 0, 0), None)
    assert "cannot be measured: post (Z)" in texts(check_part(part_of(plate, post)), "note")
    declared = ComponentSettings("post", position_tolerance_mm=1.0, symmetry=spin)
    assert "post (Z)" not in texts(check_part(part_of(plate, post, post=declared)), "note")
    wrong = ComponentSettings("plate", symmetry=spin)
    assert "plate: the declared symmetry, any angle about Z" in texts(
        check_part(part_of(plate, post, plate=wrong)), "warning"
    )


def test_sizes_in_pixels():
    camera = Camera(1280, 720, 1000.0, 1000.0, 639.5, 359.5)
    check = check_part(
        part_of(
            component("plate", box((0, 0, 0), (200, 120, 10))),
            component("pin", box((10, 10, 10), (13, 13, 60))),
            component("dot", box((50, 60, 10), (51, 61, 11))),
            view_range=ViewRange((200, 1000)),
        ),
        camera,
    )
    pin = check.components[1]
    assert pin.pixels_across == pytest.approx((3.0, 15.0), rel=1e-3)
    assert "pin is small: 3.0 px across at 1000 mm; large enough up to 250 mm" in texts(check, "warning")
    assert "dot is too small to be seen: 5.0 px across even at 200 mm" in texts(check, "problem")
    assert not check.is_camera_guessed


def test_distances_that_cannot_work():
    plate = component("plate", box((0, 0, 0), (200, 120, 10)))
    assert "lies inside the part" in texts(check_part(part_of(plate, view_range=ViewRange((50, 900)))), "problem")
    far = check_part(part_of(plate, view_range=ViewRange((5000, 9000))))
    assert "the whole part is 40 px across; come nearer" in texts(far, "problem")
    default = check_part(part_of(plate))
    assert default.view_range.distance_mm[1] > 1000 and "come nearer" not in texts(default, "problem")
    close = check_part(part_of(plate, view_range=ViewRange((120, 500))))
    assert "pictures wide" in texts(close, "warning")


def test_sheets_open_and_non_manifold_meshes():
    vertices, faces = box((0, 0, 0), (100, 60, 20))
    sheet = Component("sheet", np.array([[0, 0, 0], [90, 0, 0], [0, 70, 0.0]]), np.array([[0, 1, 2]], dtype=np.int32))
    open_box = component("tray", (vertices, faces[2:]))
    fin = np.concatenate([faces, [[0, 1, 8]]])
    finned = component("finned", (np.concatenate([vertices, [[-40.0, 0, 10]]]), fin))
    check = check_part(part_of(sheet, open_box, finned))
    said = texts(check, "warning")
    assert "sheet is a sheet without thickness (0 mm)" in said
    assert "2 components are not closed, 2 to 4 open edges each, which will appear as contours: tray, finned" in said
    assert "finned has 1 edge shared by more than two triangles" in said
    assert check.components[1].fitness.volume_mm3 is None


def test_the_report_is_text(tmp_path):
    settings = ComponentSettings("post", role="inspect", position_tolerance_mm=0.5, angle_tolerance_deg=2.0)
    part = part_of(component("base", box((0, 0, -10), (120, 80, 0))), component("post", prism(6, 8, 40)), post=settings)
    text = check_part(replace(part, serial="S-9", notes=("renamed something",))).format()
    assert f"model_hash {part.model.source_hash}" in text  # whole, to be copied into an inspection.json
    assert "p  serial S-9" in text
    assert "128 × 86.93 × 50 mm, 2 components, 36 triangles" in text
    assert "0.5 mm 2°" in text
    assert "60° about Z" in text
    assert "camera (guessed): 1280×720, focal length 1536 px" in text
    assert "view range (default): 150 to 4163 mm, every direction, any roll" in text
    assert "note: renamed something" in text
    check = check_part(part).with_findings([PartFinding("problem", "views 3 and 7 look alike")])
    assert has_problems(check)
    assert check.findings[0].text == "views 3 and 7 look alike"


@pytest.mark.slow
@pytest.mark.shared
def test_real_parts():
    cube = check_part(load_part(DATA / "sequences" / "cube" / "models" / "assembly.glb"))
    assert "looks the same" in texts(cube, "problem")
    plate = check_part(load_part(DATA / "plate" / "plate.glb"))
    assert "looks the same" not in texts(plate, "problem")
    assert "nearly the same" in texts(plate, "warning")
    posts = next(f.text for f in plate.findings if "bodies of revolution" in f.text)
    assert all(f"post_{i} (Z)" in posts for i in (1, 2, 3, 4))
    assert "link_1" not in posts


@pytest.mark.parametrize("bases", [0, 1, 2])
def test_a_part_has_one_base(bases: int) -> None:
    roles = ["base"] * bases + ["inspect"] * (3 - bases)
    parts = [
        component("plate", box((0, 0, 0), (200, 120, 8))),
        component("left", box((20, 20, 8), (60, 40, 40))),
        component("right", box((120, 30, 8), (180, 80, 30))),
    ]
    settings = {
        c.name: ComponentSettings(c.name, role=role, position_tolerance_mm=1.0)
        for c, role in zip(parts, roles, strict=True)
    }
    part = part_of(*parts, **settings)
    said = texts(check_part(part), "warning")
    assert ("no component has the role base" in said) == (bases == 0)
    assert ("2 components have the role base: plate, left; deviations" in said) == (bases == 2)
    if bases == 0:
        assert "in the frame of the largest, plate" in said
        bare = check_part(replace(part, cad_path=part.path))
        assert "no component has the role base" in texts(bare, "note")
    datum = Datum("A", "plane", "right", (150.0, 50.0, 30.0), (0.0, 0.0, 1.0))
    said = texts(check_part(replace(part, datums=(datum,))), "warning")
    assert ("datum A is on right, which is not the base" in said) == (bases > 0)


def test_equal_remarks_are_one_line() -> None:
    plate = component("plate", box((0, 0, 0), (200, 120, 8)))
    pins = [component(f"pin_{i}", box((0, 0, 0), (2, 2, 6)), (10.0 + 9 * i, 20.0, 8.0)) for i in range(20)]
    view_range = ViewRange((300.0, 900.0), elevation_deg=(20.0, 90.0))
    check = check_part(part_of(plate, *pins, view_range=view_range))
    said = [finding.text for finding in check.findings if "pin_" in finding.text and "small" in finding.text]
    assert len(said) == 1
    # 2 mm at 1536 px of focal length: 3.4 px at 900 mm, 10.2 px at 300 mm.
    assert said[0].startswith(
        "20 components are too small to be seen, 10.2 to 10.2 px across even at 300 mm: pin_0, pin_1"
    )
    assert said[0].endswith("pin_5 and 14 more")
