"""Lists of measured components, their comparison with an inspection, and inspections made from them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner

from arview.acceptance.comparison import compare
from arview.acceptance.lengths import read_known, read_measured
from arview.acceptance.position_list import ListedComponent, is_position_list, read_position_list
from arview.cad.model import Component, Model, make_model
from arview.cad.part import ComponentSettings, Part
from arview.cli import main
from arview.errors import InputError
from arview.inspection import Inspection, Verdict, load_inspection, save_inspection
from arview.workflow.new_inspection import new_inspection
from helpers.cad_files import box, obj_text
from helpers.inspections import deviation, inspection, missing
from helpers.photo_scene import bench


@pytest.fixture(scope="module")
def model() -> Model:
    return bench()


@pytest.fixture(scope="module")
def found(model: Model) -> Inspection:
    """Three blocks measured by arview, one missing; standard uncertainties 0.02, 0.03 and 0.04 mm along x, y, z."""
    center = {c.name: c.bounds_in_model.mean(axis=0) for c in model.components}
    return inspection(
        model,
        (
            deviation("block_1", (0.03, -0.02, 0.01), center["block_1"]),
            deviation("block_2", (2.4, -1.8, 0.0), center["block_2"]),
            deviation("block_3", (0.1, 0.05, None), center["block_3"]),
            missing("block_4", center["block_4"]),
        ),
    )


def _list(folder: Path, found: Inspection, offsets: dict[str, tuple[float, float, float]]) -> Path:
    """A German measuring machine's list: a preamble, semicolons, decimal commas, U, Windows-1252."""
    lines = ["Prüfbericht;Teil 7", "", "Komponente;X [mm];Y [mm];Z [mm];U [mm]"]
    for name, offset in offsets.items():
        one = found.find(name)
        assert one is not None
        assert one.details is not None
        moved = [value or 0.0 for value in one.displacement_mm]
        place = np.array(one.details.center_mm) + moved - np.array(offset)
        lines.append(";".join([name, *(f"{value:.4f}".replace(".", ",") for value in place), "0,006"]))
    path = folder / "kmm.csv"
    path.write_bytes("\r\n".join(lines).encode("cp1252"))
    return path


def test_a_list_with_semicolons_and_decimal_commas_is_compared(found: Inspection, tmp_path: Path) -> None:
    path = _list(
        tmp_path, found, {"block_1": (0.02, 0.0, 0.0), "block_2": (0.0, 0.2, 0.0), "block_3": (0.01, 0.02, 9.0)}
    )
    assert is_position_list(path)
    made = compare(found, read_position_list(path), str(path))
    assert [one.name for one in made.components] == ["block_1", "block_2", "block_3"]
    first, second, third = made.components
    assert first.difference_mm == pytest.approx([0.02, 0.0, 0.0], abs=1e-4)
    assert (first.uncertainty_mm, first.list_uncertainty_mm) == pytest.approx((0.04, 0.006), abs=1e-4)
    assert (first.axis, second.axis, third.axis) == ("x", "y", "y")
    assert first.e_n == pytest.approx(0.02 / 2.0 / np.hypot(0.02, 0.003), rel=0.01)
    assert second.e_n == pytest.approx(0.2 / 2.0 / np.hypot(0.03, 0.003), rel=0.01)
    assert (first.agrees, second.agrees, third.agrees) == (True, False, True)
    assert np.isnan(third.difference_mm[2])  # the inspection does not determine it
    assert third.e_n_xyz[:2] == pytest.approx(
        [0.01 / 2.0 / np.hypot(0.02, 0.003), 0.02 / 2.0 / np.hypot(0.03, 0.003)], rel=0.01
    )
    assert np.isnan(third.e_n_xyz[2])
    assert made.left_out == {"block_4": "is not in the list"}


def test_e_n_of_one_coordinate_is_that_of_the_standard(found: Inspection) -> None:
    nowhere = np.full(3, np.nan)
    one = ListedComponent("BLOCK_1", nowhere, np.array([0.08, np.nan, np.nan]), np.full(3, 0.03))
    made = compare(found, [one], "list").components[0]
    assert made.e_n == pytest.approx(0.05 / np.hypot(0.04, 0.03), rel=1e-3)  # |difference| / sqrt(U² + U²)


def test_to_know_more_coordinates_hides_no_difference(model: Model) -> None:
    """The E_n of ISO 13528 by hand: 0.060 along x, U 0.04 and 0.03, with and without y and z in the list."""
    ours = inspection(model, (deviation("block_1", (0.06, 0.0, 0.0), np.zeros(3)),))
    nowhere = np.full(3, np.nan)
    for known in ([0.0, 0.0, 0.0], [0.0, np.nan, np.nan]):
        line = ListedComponent("block_1", nowhere, np.array(known), np.full(3, 0.03))
        one = compare(ours, [line], "list").components[0]
        assert one.e_n == pytest.approx(1.2, abs=1e-3)
        assert (one.axis, one.agrees) == ("x", False)
        assert (one.uncertainty_mm, one.list_uncertainty_mm) == pytest.approx((0.04, 0.03), rel=1e-3)


def test_e_n_is_calibrated(model: Model) -> None:
    """With right uncertainties E_n is at most 1 for 95.45 % of the coordinates."""
    rng = np.random.default_rng(1)
    std, u_list = np.array([0.02, 0.03, 0.04]), 0.05
    nowhere = np.full(3, np.nan)
    good = np.zeros(3)
    for _ in range(800):
        x, y, z = rng.normal(0.0, std).tolist()
        ours = inspection(model, (deviation("block_1", (x, y, z), np.zeros(3)),))
        line = ListedComponent("block_1", nowhere, rng.normal(0.0, u_list / 2.0, 3), np.full(3, u_list))
        good += compare(ours, [line], "list").components[0].e_n_xyz <= 1.0
    assert good / 800 == pytest.approx([0.9545] * 3, abs=0.025)


def test_what_cannot_be_compared_is_named(model: Model, found: Inspection) -> None:
    nowhere = np.full(3, np.nan)
    zero = np.zeros(3)
    with pytest.raises(InputError, match=r"no component can be compared \(block_4: is missing by the inspection"):
        compare(found, [ListedComponent("block_4", nowhere, zero, None)], "list")
    with pytest.raises(InputError, match="nut: the inspection has no such"):
        compare(found, [ListedComponent("nut", nowhere, zero, None)], "list")
    old = replace(found, components=tuple(replace(one, details=None) for one in found.components))
    with pytest.raises(InputError, match="give --part, or list dx, dy, dz"):
        compare(old, [ListedComponent("block_1", zero, nowhere, None)], "list")
    center = model.component("block_1").bounds_in_model.mean(axis=0)
    line = ListedComponent("block_1", center + np.array([0.03, -0.02, 0.0]), nowhere, None)
    by_cad = compare(old, [line], "list", model).components[0]
    assert by_cad.difference_mm == pytest.approx([0.0, 0.0, 0.01])
    without = compare(found, [ListedComponent("block_1", nowhere, zero, None)], "list").components[0]
    assert without.list_uncertainty_mm is None
    assert without.e_n is not None


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("from,to,mm\na,b,3\n", "no line names the columns name with x, y, z"),
        ("name;x;y;z\nblock_1;1,5;2;abc\n", "line 2: z = 'abc': expected a number"),
        ("name;x;y;z\nblock_1;1;2;1_0\n", "line 2: z = '1_0': expected a number"),
        ("name;x;y;z\nblock_1;1;2;1e300\n", "line 2: z = '1e300': expected a number"),
        ("name;x;y;z\nblock_1;1;2;1.2.3\n", "line 2: z = '1.2.3': expected a number"),
        ("name;x;y;z\nblock_1;1,5;2.5;3\n", "line 2 has a decimal comma (1,5), line 2 a point (2.5)"),
        ("name;x;y;z\nblock_1;1;2;3\nblock_1;1;2;3\n", "line 3: 'block_1' is listed twice"),
        ("name;x [in];y [in];z [in]\nblock_1;1;2;3\n", "is in in; expected mm"),
        ("name,dx,dy,dz,U\nblock_1,1,2,3,-1\n", "U = -1: expected a number that is not negative"),
        ("name,dx,dy,dz,dx\nblock_1,1,2,3,4\n", "the column 'dx' is there twice"),
        ("name,dx,dy,dz\n", "lists no component"),
        ("name,dx,dy,dz,U\na,0,012,-0,008,0,003,0,004\n", "line 2 has 9 fields, the header 5 columns; separate"),
        ("name,dx,dy,dz,U,a,b,c,d\na,0,012,-0,008,0,003,0,004\n", "line 2: dy = '012' begins with 0"),
        ("name;dx;dy;dz\na;1;2;3;4\n", "line 2 has 5 fields, the header 4 columns"),
        (";;\n" * 80, "no line names the columns"),
    ],
)
def test_lists_that_cannot_be_read(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "list.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_position_list(path)
    assert says in str(caught.value)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_names_of_columns(tmp_path: Path) -> None:
    path = tmp_path / "list.txt"
    path.write_text("Feature\tDev X (mm)\tDev Y (mm)\tDev Z (mm)\tU95\nblock_1\t0.1\t-0.2\t\t0.02\n", encoding="utf-16")
    (one,) = read_position_list(path)
    assert one.displacement[:2] == pytest.approx([0.1, -0.2])
    assert np.isnan(one.displacement[2])
    assert np.isnan(one.place).all()
    assert one.uncertainty == pytest.approx([0.02] * 3)


@pytest.mark.parametrize(
    ("columns", "u"),
    [
        ("U", 0.002),
        ("u", 0.004),
        ("u [mm]", 0.004),
        ("u_c (mm)", 0.004),
        ("Std", 0.004),
        ("standard uncertainty", 0.004),
        ("Standardunsicherheit", 0.004),
        ("Messunsicherheit [mm]", 0.002),
        ("U (k=2) [mm]", 0.002),
        ("U (k=3)", 0.004 / 3.0),
        ("U_mm", 0.002),
        ("u_mm", 0.004),
    ],
)
def test_a_small_u_is_the_standard_uncertainty(columns: str, u: float, tmp_path: Path) -> None:
    path = tmp_path / "list.csv"
    path.write_text(f"name,dx,dy,dz,{columns}\na,0.01,0,0,0.002\n\nb,0.01,0,0,0.002,,\n", encoding="utf-8")
    assert [one.uncertainty for one in read_position_list(path)] == [pytest.approx([u] * 3)] * 2
    path.write_text("name,dx,ux,dy,u y,dz,UZ\na,0.01,0.002,0,0.002,0,0.002\n", encoding="utf-8")
    assert read_position_list(path)[0].uncertainty == pytest.approx([0.004, 0.004, 0.002])


@pytest.mark.parametrize(("column", "u"), [("U_mm", 0.02), ("U", 0.02), ("u_mm", 0.04), ("u", 0.04)])
def test_lengths_and_points_know_a_small_u(column: str, u: float, tmp_path: Path) -> None:
    points, lengths = tmp_path / "points.csv", tmp_path / "lengths.csv"
    points.write_text(f"name,x,y,z,{column}\nA,0,0,0,0.02\nB,100,0,0,0.02\n")
    lengths.write_text(f"from,to,mm,{column}\nA,B,100,0.02\n")
    measured = read_measured(points)
    assert measured.marks["A"].covariance == pytest.approx(np.eye(3) * (u / 2.0) ** 2)
    assert read_known(lengths, measured)[0].uncertainty_mm == pytest.approx(u)


def test_lengths_with_semicolons_and_decimal_commas(found: Inspection, tmp_path: Path) -> None:
    source = tmp_path / "inspection.json"
    save_inspection(found, source)
    known = tmp_path / "lengths.csv"
    known.write_text("from;to;mm;U_mm\nblock_1;block_2;100,25;0,004\n", encoding="utf-8")
    (length,) = read_known(known, read_measured(source))
    assert (length.mm, length.uncertainty_mm) == (100.25, 0.004)


def test_the_command_compares(found: Inspection, tmp_path: Path) -> None:
    source = tmp_path / "inspection.json"
    save_inspection(found, source)
    path = _list(tmp_path, found, {"block_1": (0.02, 0.0, 0.0), "block_2": (0.0, 0.2, 0.0)})
    done = CliRunner().invoke(main, ["compare", str(path), str(tmp_path), "-o", str(tmp_path / "e.json")])
    assert done.exit_code == 1, done.output
    assert "E_n ≤ 1 for 1 of 2 compared components; 2 were" in done.output
    assert next(line for line in done.output.splitlines() if line.startswith("block_2")).endswith("differs")
    record = json.loads((tmp_path / "e.json").read_text(encoding="utf-8"))
    assert [one["name"] for one in record["components"]] == ["block_1", "block_2"]
    refused = CliRunner().invoke(main, ["verify", str(source), str(path), "--mpe", "0.1"])
    assert refused.exit_code == 64
    assert "lists places of components, not lengths; use arview compare" in refused.output
    # What was not compared is not agreed on.
    path.write_bytes(b"\r\n".join(line for line in path.read_bytes().splitlines() if b"block_2" not in line))
    part = CliRunner().invoke(main, ["compare", str(path), str(tmp_path)])
    assert part.exit_code == 2 and "1 of 1 compared components; 3 were not compared" in part.output


def test_positions_and_deviations_that_contradict_each_other_are_refused(found: Inspection, tmp_path: Path) -> None:
    save_inspection(found, tmp_path / "inspection.json")
    one = found.components[0]
    assert one.details is not None
    nominal, moved = np.array(one.details.center_mm), np.array(one.displacement_mm)
    cases = ((nominal + moved, 2), (nominal, 2), (nominal + moved + [0.0, 0.3, 0.0], 64))  # measured, nominal, neither
    for place, code in cases:
        row = ",".join(f"{value:.4f}" for value in (*place, *moved))
        (tmp_path / "l.csv").write_text(f"name,x,y,z,dx,dy,dz,U\n{one.name},{row},0.1\n", encoding="utf-8")
        done = CliRunner().invoke(main, ["compare", str(tmp_path / "l.csv"), str(tmp_path)])
        assert done.exit_code == code, done.output
    assert "contradict each other by 0.300 mm" in done.output


# ---- an inspection made by hand


def _part(model: Model) -> Part:
    settings = tuple(
        ComponentSettings(c.name, "base" if c.name in ("bench", "plate") else "inspect", 0.5) for c in model.components
    )
    return Part("bench", Path("part.toml"), Path("bench.glb"), model, settings)


def test_a_new_inspection_is_valid(model: Model, tmp_path: Path) -> None:
    made = new_inspection(_part(model))
    assert {one.verdict for one in made.components} == {Verdict.NOT_MEASURED}
    assert [one.name for one in made.components] == [f"block_{i}" for i in (1, 2, 3, 4)]
    assert {one.tolerance_mm for one in made.components} == {0.5}
    save_inspection(made, tmp_path / "inspection.json")
    assert load_inspection(tmp_path / "inspection.json", model) == made


def test_the_command_makes_one(tmp_path: Path) -> None:
    cad = tmp_path / "block.obj"
    cad.write_text(obj_text("block", *box((0, 0, 0), (10, 20, 30))), encoding="utf-8")
    target = tmp_path / "inspection.json"
    arguments = ["inspection", "new", str(cad), "--unit", "mm", "--serial", "42", "-o", str(target)]
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 0, done.output
    assert "1 component: 1 not measured" in done.output
    assert load_inspection(target).serial == "42"
    again = CliRunner().invoke(main, arguments)
    assert again.exit_code == 64
    assert "exists; name another file with -o" in again.output
    assert CliRunner().invoke(main, [*arguments, "--force"]).exit_code == 0


def test_a_new_inspection_has_the_values_of_a_list(model: Model, tmp_path: Path) -> None:
    path = tmp_path / "cmm.csv"
    path.write_text("name;dx;dy;dz;U\nblock_1;0,3;0,0;0,0;0,02\nblock_2;0,6;0;0;0,02\nblock_3;0,1;0;;0,02\n")
    made = new_inspection(_part(model), read_position_list(path), "S-7", "cmm.csv")
    verdicts = [one.verdict.value for one in made.components]
    assert verdicts == ["pass", "fail", "undecided", "not_measured"]
    assert made.serial == "S-7"
    assert made.components[0].displacement_mm == (0.3, 0.0, 0.0)
    assert made.components[0].uncertainty_mm == pytest.approx(0.02)
    assert made.components[2].displacement_mm == (0.1, 0.0, None)
    with pytest.raises(InputError, match="no inspected component 'nut'"):
        new_inspection(_part(model), [ListedComponent("nut", np.zeros(3), np.zeros(3), None)], None, "cmm.csv")
    with pytest.raises(InputError, match="block_1: has no U"):
        new_inspection(_part(model), [ListedComponent("block_1", np.zeros(3), np.zeros(3), None)], None, "cmm.csv")


def test_the_command_compare(found: Inspection, tmp_path: Path) -> None:
    """The list comes first; the inspection is the one beside it unless it is named."""
    path = _list(tmp_path, found, {"block_1": (0.02, 0.0, 0.0), "block_2": (0.0, 0.01, 0.0)})
    alone = CliRunner().invoke(main, ["compare", str(path)])
    assert alone.exit_code == 64 and "holds no inspection.json" in alone.output
    save_inspection(found, tmp_path / "inspection.json")
    result = CliRunner().invoke(main, ["compare", str(path), "-o", str(tmp_path / "out.json")])
    assert result.exit_code == 2, result.output
    assert "E_n ≤ 1 for 2 of 2 compared components; 2 were not compared" in result.output
    record = json.loads((tmp_path / "out.json").read_text(encoding="utf-8"))
    assert [one["name"] for one in record["components"]] == ["block_1", "block_2"]
    _list(tmp_path, found, {"block_1": (0.5, 0.0, 0.0)})
    apart = CliRunner().invoke(main, ["compare", str(path), str(tmp_path)])
    assert apart.exit_code == 1 and "differs" in apart.output
    absent = CliRunner().invoke(main, ["compare", str(tmp_path / "none.csv"), str(tmp_path)])
    assert absent.exit_code == 64 and "no such file" in absent.output


def _boxes(name: str, *boxes: tuple[tuple[float, float, float], tuple[float, float, float]]) -> Component:
    """A component of boxes by their sizes and middles, mm."""
    meshes = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for size, at in boxes]
    mesh = trimesh.util.concatenate(meshes)
    return Component(name, np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int32))


BRACKET = make_model(
    "bracket",
    (
        _boxes("plate", ((100.0, 60.0, 5.0), (0.0, 0.0, -2.5))),
        _boxes("bracket", ((40.0, 20.0, 4.0), (0.0, 0.0, 2.0)), ((4.0, 20.0, 36.0), (-18.0, 0.0, 22.0))),
    ),
)
"""A plate, and an L whose centre of mass is more than 5 mm from the middle of its bounding box."""


@pytest.mark.parametrize("point", ["part", "mass", "box"])
def test_positions_are_of_one_stated_point(point: str, tmp_path: Path) -> None:
    """The same displacement is found whichever point a machine states, if the list says which one it is."""
    bracket = BRACKET.component("bracket")
    middle, mass = bracket.bounds_in_model.mean(axis=0), bracket.centroid_in_model
    assert np.linalg.norm(middle - mass) > 5.0
    moved = np.array([0.3, -0.2, 0.1])
    x, y, z = (middle if point == "box" else mass) + moved
    path = tmp_path / "cmm.csv"
    path.write_text(f"name,measurand,x,y,z,U\nbracket,{point},{x:.4f},{y:.4f},{z:.4f},0.01\n")
    settings = (ComponentSettings("plate", "base"), ComponentSettings("bracket", "inspect", 0.5))
    part = Part("bracket", Path("part.toml"), Path("bracket.glb"), BRACKET, settings)
    listed = read_position_list(path)
    (made,) = [one for one in new_inspection(part, listed, None, "cmm.csv").components if one.name == "bracket"]
    assert np.allclose([value or 0.0 for value in made.displacement_mm], moved, atol=1e-3)
    assert made.details is not None
    assert made.details.measurand == ("box_center" if point == "box" else "volume_centroid")
    ours = inspection(BRACKET, (deviation("bracket", tuple(moved), mass),))
    ours = replace(
        ours,
        components=tuple(replace(c, details=replace(c.details, measurand="volume_centroid")) for c in ours.components),
    )
    (compared,) = compare(ours, listed, "cmm.csv", BRACKET).components
    assert compared.distance_mm < 1e-3
    if point == "box":
        with pytest.raises(InputError, match="nominal position of the listed point; give --part"):
            compare(ours, listed, "cmm.csv")


def test_a_point_that_is_not_known_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cmm.csv"
    path.write_text("name,measurand,x,y,z,U\nbracket,corner,1,2,3,0.01\n")
    with pytest.raises(InputError, match="line 2: 'corner' is no point; expected part, mass, box"):
        read_position_list(path)
