"""The point whose displacement is stated: against exact centroids, and moved from one point to another."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from arview.cad.model import Component, Model, make_model
from arview.cad.part import ComponentSettings, NamedPoint, Part, Vector
from arview.cad.part_file import load_part
from arview.cad.shape.symmetry import Symmetry
from arview.errors import InputError
from arview.geometry import Array, apply, exp_so3, rigid
from arview.measurement.measurand import measurand_of
from arview.measurement.types import Move
from arview.measurement.uncertainty.combine import combine
from helpers.cad_files import box, obj_text
from helpers.plate_scene import plate_with_holes
from helpers.synthetic import post

TILTED = exp_so3(np.deg2rad([0.0, 35.0, 0.0]))


def wedge(size: float = 30.0) -> tuple[Array, Array]:
    """A right prism over a triangle with corners (0,0), (size,0), (0,size) in x and z, 20 mm along y."""
    corners = np.array([(0, 0), (size, 0), (0, size)], dtype=float)
    vertices = np.array([(x, y, z) for y in (0.0, 20.0) for x, z in corners])
    faces = [(0, 1, 2), (3, 5, 4), (0, 3, 4), (0, 4, 1), (1, 4, 5), (1, 5, 2), (2, 5, 3), (2, 3, 0)]
    return vertices, np.array(faces)


def model() -> Model:
    """A plate with a wedge, an inclined stud, and an open sheet above it."""
    plate = _box("plate", (-100, -100, -8), (100, 100, 0))
    stud, stud_faces = post((0.0, 0.0), 6.0, 0.0, 40.0, 40)
    sheet = np.array([(0, 0, 50), (60, 0, 50), (60, 30, 50), (0, 30, 50), (0, 30, 80), (0, 0, 80)], dtype=float)
    return make_model(
        "bench",
        (
            plate,
            Component("wedge", *wedge()),
            Component("stud", apply(rigid(TILTED, [60.0, 40.0, 0.0]), stud), stud_faces.astype(np.int32)),
            Component("sheet", sheet, np.array([(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)], dtype=np.int32)),
            Component("plate_with_holes", plate_with_holes()[0] + np.array([0.0, 0.0, 200.0]), plate_with_holes()[1]),
        ),
    )


def _box(name: str, low: Vector, high: Vector) -> Component:
    vertices, faces = box(low, high)
    return Component(name, vertices, faces.astype(np.int32))


def part(name: str = "", point: NamedPoint | Vector = "mass", symmetry: Symmetry | None = None) -> Part:
    made = model()
    settings = [ComponentSettings(one.name, "base" if one.name == "plate" else "inspect") for one in made.components]
    settings = [replace(one, point=point, symmetry=symmetry) if one.name == name else one for one in settings]
    return Part("bench", Path("part.toml"), Path("bench.step"), made, tuple(settings))


def test_centroid_of_a_solid_is_that_of_its_volume() -> None:
    found = measurand_of("wedge", part())
    assert found.kind == "volume_centroid"
    assert found.point_in_model == pytest.approx([10.0, 10.0, 10.0], abs=1e-9)  # its box has its middle at (15, 10, 15)
    assert model().component("wedge").is_solid


def test_centroid_of_a_sheet_is_that_of_its_area() -> None:
    found = measurand_of("sheet", part())
    assert found.kind == "area_centroid" and not model().component("sheet").is_solid
    # 60 × 30 lying at z 50, 30 × 30 standing at x 0.
    assert found.point_in_model == pytest.approx([20.0, 15.0, (2 * 50.0 + 65.0) / 3], abs=1e-9)


def test_doubled_vertices_are_one_surface() -> None:
    vertices, faces = wedge()
    apart = Component("apart", vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3).astype(np.int32))
    assert apart.is_solid and apart.centroid_in_model == pytest.approx([10.0, 10.0, 10.0])
    open_one = Component("open", vertices, faces[:-1].astype(np.int32))
    assert not open_one.is_solid


def test_inclined_stud_has_its_point_on_its_axis() -> None:
    found = measurand_of("stud", part())
    assert found.point_in_model == pytest.approx(TILTED @ [0, 0, 20] + [60, 40, 0], abs=1e-6)
    assert found.axis_from == "symmetry" and found.axes[2] == pytest.approx(TILTED[:, 2], abs=1e-6)
    assert np.linalg.det(found.axes) == pytest.approx(1.0)
    x, y, z = TILTED[:, 2].tolist()
    declared = Symmetry((x, y, z), (60.0, 40.0, 0.0), None)
    assert measurand_of("stud", part("stud", symmetry=declared)).point_in_model == pytest.approx(found.point_in_model)


def test_named_points() -> None:
    seat = measurand_of("wedge", part("wedge", "seat"))
    assert seat.kind == "seat" and seat.point_in_model == pytest.approx([15.0, 10.0, 0.0], abs=1e-6)
    assert seat.axis_from == "seat" and seat.axes[2] == pytest.approx([0, 0, 1])
    upright = replace(model(), components=(model().components[0], Component("pin", *_post())))
    settings = (ComponentSettings("plate", "base"), ComponentSettings("pin", point="axis"))
    foot = measurand_of("pin", Part("b", Path("p"), Path("p"), upright, settings))
    assert foot.kind == "axis" and foot.point_in_model == pytest.approx([20.0, -10.0, 0.0], abs=1e-6)
    given = measurand_of("sheet", part("sheet", (1.0, 2.0, 3.0)))
    assert given.kind == "given" and given.point_in_model.tolist() == [1.0, 2.0, 3.0]
    nut = Component("nut", *_nut())
    with_nut = make_model("b", (model().components[0], nut))
    settings = (ComponentSettings("plate", "base"), ComponentSettings("nut", point="hole"))
    hole = measurand_of("nut", Part("b", Path("p"), Path("p"), with_nut, settings))
    assert hole.kind == "hole" and hole.point_in_model == pytest.approx([-40.0, 30.0, 4.0], abs=1e-6)


@pytest.mark.parametrize(
    ("name", "point", "message"),
    [
        ("sheet", "seat", "component 'sheet': point = 'seat': it touches no other component"),
        ("wedge", "axis", "'wedge': point = 'axis': it has"),
        ("wedge", "hole", "'wedge': point = 'hole': it has no round hole"),
        ("plate_with_holes", "hole", "it has more than one hole"),
    ],
)
def test_a_point_that_does_not_exist_is_named(name: str, point: NamedPoint, message: str) -> None:
    with pytest.raises(InputError, match=message):
        measurand_of(name, part(name, point))


def test_part_file_names_the_point(tmp_path: Path) -> None:
    plate, peg = box((0, 0, 0), (90, 90, 5)), box((10, 10, 5), (20, 20, 9))
    (tmp_path / "a.obj").write_text(obj_text("plate", *plate) + obj_text("peg", *peg, len(plate[0])))
    file = tmp_path / "part.toml"
    head = '[part]\ncad = "a.obj"\nunit = "mm"\n[defaults]\npoint = "seat"\n[components.plate]\nrole = "base"\n'
    file.write_text(head)
    found = load_part(file)
    assert found.component_settings("peg").point == "seat"
    assert measurand_of("peg", found).point_in_model == pytest.approx([15.0, 15.0, 5.0])
    file.write_text(head + "[components.peg]\npoint = [1, 2, 3.5]\n")
    assert load_part(file).component_settings("peg").point == (1.0, 2.0, 3.5)
    for wrong in ('"middle"', "3", "[1, 2]"):
        file.write_text(head + f"[components.peg]\npoint = {wrong}\n")
        with pytest.raises(InputError, match=r"\[components.peg\] point = "):
            load_part(file)


def test_a_move_stated_for_another_point() -> None:
    """A turn of 0.8° about a point 8 mm off shifts the other by 0.11 mm; its uncertainty follows."""
    center, point = np.array([5.0, 0.0, 0.0]), np.array([5.0, 0.0, 8.0])
    turn = np.deg2rad([0.8, 0.0, 0.0])
    covariance = np.diag([1e-4, 1e-4, 1e-4, 0.01, 0.01, 0.01]) ** 2
    move = Move(
        "a", "sweep", center, np.array([*turn, 0.3, 0.0, 0.1]), covariance, np.zeros((0, 6)), 12.0, 9, 0.01, 1.0
    )
    there = move.at(point)
    assert there.displacement_mm == pytest.approx(apply(move.measured_from_nominal, point) - point, abs=1e-12)
    assert abs(there.displacement_mm[1]) == pytest.approx(0.1117, abs=1e-3)
    assert there.measured_from_nominal == pytest.approx(move.measured_from_nominal, abs=1e-12)
    draws = np.random.default_rng(0).multivariate_normal(move.twist, covariance, 40_000)
    shifts = draws[:, 3:] + np.cross(draws[:, :3], point - center)
    assert np.cov(shifts.T) == pytest.approx(there.covariance[3:, 3:], rel=0.05, abs=2e-6)
    assert there.at(center).covariance == pytest.approx(covariance, abs=1e-15)
    together = combine([move]).at(point)
    assert together.twist == pytest.approx(there.twist) and together.center_in_model is point


def test_an_undetermined_spin_hides_a_shift_off_the_axis() -> None:
    spin = np.array([[0.0, 0.0, 1.0, 0.0, 0.0, 0.0]])
    twist = np.array([0.01, 0.0, 0.0, 0.2, 0.1, 0.0])
    covariance = np.diag([1e-4, 1e-4, 0.0, 0.01, 0.01, 0.01]) ** 2
    move = Move("a", "edges", np.zeros(3), twist, covariance, spin, 10.0, 9, 0.01, 1.0)
    on_the_axis, off = move.at(np.array([0.0, 0.0, 7.0])), move.at(np.array([7.0, 0.0, 0.0]))
    assert on_the_axis.observable.tolist() == [True, True, False, True, True, True]
    assert off.observable.tolist() == [True, True, False, True, False, True]  # the spin moves that point along y
    assert off.twist @ (off.undetermined[0] * [10, 10, 10, 1, 1, 1]) == pytest.approx(0.0, abs=1e-9)


def _post() -> tuple[Array, Array]:
    vertices, faces = post((20.0, -10.0), 5.0, 0.0, 30.0, 36)
    return vertices, faces.astype(np.int32)


def _nut() -> tuple[Array, Array]:
    """A ring of ⌀8 and ⌀20, 8 mm high, about (−40, 30)."""
    angle = np.arange(48) * 2 * np.pi / 48
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    rings = [np.column_stack([r * circle, np.full(48, z)]) for r, z in ((4, 8.0), (10, 8.0), (4, 0.0), (10, 0.0))]
    faces = []
    for i in range(48):
        j = (i + 1) % 48
        a, b, c, d = (48 * k for k in range(4))
        quads = [(a + i, b + i, b + j, a + j), (c + j, d + j, d + i, c + i)]
        quads += [(b + i, d + i, d + j, b + j), (a + j, c + j, c + i, a + i)]
        for quad in quads:
            faces += [quad[:3], (quad[0], quad[2], quad[3])]
    shift = np.array([-40.0, 30.0, 0.0])
    return np.concatenate(rings) + shift, np.array(faces, dtype=np.int32)
