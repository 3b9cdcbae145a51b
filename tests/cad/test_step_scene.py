"""STEP: names of the places of an assembly, hidden bodies, and tessellated solids."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from arview.cad.load import load_cad
from arview.errors import InputError
from helpers.cad_files import QUARTER_TURN, SHIFT, StepAssembly, StepBodies, StepPart, StepWriter

PIN = StepPart("pin", (10.0, 10.0, 30.0), color=(0.0, 0.0, 1.0))
ROOT = StepAssembly(
    "root", [("plate", StepPart("plate", (100.0, 60.0, 8.0)), np.eye(4)), ("a", PIN, SHIFT), ("b", PIN, QUARTER_TURN)]
)
PLATE_BOUNDS = [[0.0, 0.0, 0.0], [100.0, 60.0, 8.0]]
A_BOUNDS = [[1.0, 2.0, 3.0], [11.0, 12.0, 33.0]]
B_BOUNDS = [[90.0, 0.0, 5.0], [100.0, 10.0, 35.0]]


def bounds_of(path: Path) -> dict[str, list[list[float]]]:
    return {one.name: one.bounds_in_model.round(4).tolist() for one in load_cad(path).model.components}


@pytest.mark.parametrize(
    ("use", "expected"),
    [
        ("'NAUO7',' ',' '", ["plate", "pin", "pin_2"]),
        ("'NAUO7','NAUO7',''", ["plate", "pin", "pin_2"]),
        ("'2','2',$", ["plate", "pin", "pin_2"]),
        ("'x1',$,$", ["plate", "pin", "pin_2"]),
        ("'0','Next assembly relationship',''", ["plate", "pin", "pin_2"]),
        ("'0','Next assembly relationship','PRT1'", ["plate", "PRT1", "PRT1_2"]),
        ("'PIN.1','PIN.1',''", ["plate", "PIN.1", "PIN.1_2"]),
        ("'1','left; (NAUO1)',''", ["plate", "left; (NAUO1)", "left; (NAUO1)_2"]),
    ],
)
def test_an_identifier_of_a_place_is_no_name(use: str, expected: list[str], tmp_path: Path) -> None:
    path = StepWriter().write(tmp_path / "a.step", ROOT)
    path.write_text(re.sub(r"'\d+','[ab]',''", use, path.read_text()))
    found = bounds_of(path)
    assert list(found) == expected
    assert [found[name] for name in expected] == [PLATE_BOUNDS, A_BOUNDS, B_BOUNDS]


HIDING = {
    "style": ("INVISIBILITY((#{style}))", ["plate"], "pin"),
    "layer": ("PRESENTATION_LAYER_ASSIGNMENT('aids','',(#{solid}));\n#9001=INVISIBILITY((#9000))", ["plate"], "pin"),
    "shape": ("INVISIBILITY((#{shape}))", ["plate"], "pin"),
    "mapped": ("STYLED_ITEM('',(#1),#{shape});\n#9001=INVISIBILITY((#9000))", ["plate"], "pin"),
    "place": ("INVISIBILITY((#{second},#{first}))", ["b"], "plate, a"),
    "style of a place": (
        "CONTEXT_DEPENDENT_OVER_RIDING_STYLED_ITEM('',(#1),#{solid},#{style},(#{second}));\n"
        "#9001=INVISIBILITY((#9000))",
        ["plate", "b"],
        "a",
    ),
}


@pytest.mark.parametrize(("text", "names", "told"), HIDING.values(), ids=HIDING)
def test_hidden_bodies_are_left_out_and_named(text: str, names: list[str], told: str, tmp_path: Path) -> None:
    path = StepWriter().write(tmp_path / "a.step", ROOT)
    body = path.read_text()
    solid = re.search(r"#(\d+)=MANIFOLD_SOLID_BREP\('pin'", body)
    assert solid is not None
    style = re.search(rf"#(\d+)=STYLED_ITEM\('color',\(#\d+\),#{solid[1]}\)", body)
    shape = re.search(rf"#(\d+)=ADVANCED_BREP_SHAPE_REPRESENTATION\('',\(#\d+,#{solid[1]}\)", body)
    first, second, _ = re.findall(r"#(\d+)=CONTEXT_DEPENDENT_SHAPE", body)
    assert style is not None and shape is not None
    found = {"solid": solid[1], "style": style[1], "shape": shape[1], "first": first, "second": second}
    path.write_text(body.replace("\nENDSEC;\nEND", f"\n#9000={text.format(**found)};\nENDSEC;\nEND"))
    assert bounds_of(path) == {
        name: bounds for name, bounds in {"plate": PLATE_BOUNDS, "a": A_BOUNDS, "b": B_BOUNDS}.items() if name in names
    }
    (note,) = load_cad(path).notes
    assert note.startswith("left out, because the STEP file hides them") and note.endswith(f": {told}")


def test_one_of_several_solids_is_hidden_by_its_name(tmp_path: Path) -> None:
    bodies = [(name, (10.0, 20.0, 30.0), (40.0 * k, 0.0, 0.0), (1.0, 0.0, 0.0)) for k, name in enumerate("xyz")]
    path = StepWriter().write(tmp_path / "f.step", StepBodies("fixture", bodies))
    body = path.read_text()
    (_, style, _) = re.findall(r"#(\d+)=STYLED_ITEM", body)
    path.write_text(body.replace("\nENDSEC;\nEND", f"\n#9000=INVISIBILITY((#{style}));\nENDSEC;\nEND"))
    assert list(bounds_of(path)) == ["x", "z"]
    assert load_cad(path).notes[0].endswith(": y")


def test_what_is_hidden_deep_in_an_assembly_is_kept_and_told(tmp_path: Path) -> None:
    path = StepWriter().write(tmp_path / "a.step", ROOT)
    body = path.read_text()
    first, second, _ = re.findall(r"#(\d+)=CONTEXT_DEPENDENT_SHAPE", body)
    style = f"CONTEXT_DEPENDENT_OVER_RIDING_STYLED_ITEM('',(#1),#2,#3,(#{first},#{second}))"
    added = f"#9000={style};\n#9001=INVISIBILITY((#9000));"
    path.write_text(body.replace("\nENDSEC;\nEND", f"\n{added}\nENDSEC;\nEND"))
    assert list(bounds_of(path)) == ["plate", "a", "b"]
    assert load_cad(path).notes == ("1 bodies are hidden at one place of an assembly alone, and are kept",)


def test_a_file_whose_bodies_are_all_hidden_is_refused(tmp_path: Path) -> None:
    path = StepWriter().write(tmp_path / "a.step", ROOT)
    body = path.read_text()
    places = ",".join(f"#{one}" for one in re.findall(r"#(\d+)=CONTEXT_DEPENDENT_SHAPE", body))
    path.write_text(body.replace("\nENDSEC;\nEND", f"\n#9000=INVISIBILITY(({places}));\nENDSEC;\nEND"))
    with pytest.raises(InputError, match=r"a\.step: left out, because the STEP file hides them .*: plate, a, b$"):
        load_cad(path)


def tessellated(writer: StepWriter, name: str, low_mm: float, kind: str, link: str = "$") -> int:
    """A tetrahedron with legs of 30 mm."""
    x, far = low_mm, low_mm + 30.0
    points = writer.add(f"COORDINATES_LIST('',4,(({x},0.,0.),({far},0.,0.),({x},30.,0.),({x},0.,30.)))")
    face = writer.add(f"TRIANGULATED_FACE('',#{points},4,(),$,(),((1,3,2),(1,2,4),(2,3,4),(1,4,3)))")
    return writer.add(f"{kind}('{name}',(#{face}),{link})")


@pytest.mark.parametrize("kind", ["TESSELLATED_SOLID", "TESSELLATED_SHELL"])
def test_named_tessellated_solids_are_components(kind: str, tmp_path: Path) -> None:
    writer = StepWriter()
    frame = writer.axis(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]))
    items = [frame, tessellated(writer, "left", 0.0, kind), tessellated(writer, "right", 50.0, kind)]
    shape = writer.add(f"TESSELLATED_SHAPE_REPRESENTATION('',{writer.refs(items)},#{writer.context})")
    writer.product("cover", shape)
    path = tmp_path / "t.step"
    path.write_text(
        "ISO-10303-21;\nHEADER;\nENDSEC;\nDATA;\n" + "\n".join(writer.lines) + "\nENDSEC;\nEND-ISO-10303-21;\n"
    )
    assert bounds_of(path) == {
        "left": [[0.0, 0.0, 0.0], [30.0, 30.0, 30.0]],
        "right": [[50.0, 0.0, 0.0], [80.0, 30.0, 30.0]],
    }


def test_a_tessellated_body_that_repeats_an_exact_one_is_no_second(tmp_path: Path) -> None:
    writer = StepWriter()
    writer.item(PIN)
    body = "\n".join(writer.lines)
    solid, shape = (
        re.search(rf"#(\d+)={kind}\(", body) for kind in ("MANIFOLD_SOLID_BREP", "PRODUCT_DEFINITION_SHAPE")
    )
    assert solid is not None and shape is not None
    frame = writer.axis(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]))
    mesh = tessellated(writer, "pin", 0.0, "TESSELLATED_SOLID", f"#{solid[1]}")
    items = writer.refs([frame, mesh])
    other = writer.add(f"TESSELLATED_SHAPE_REPRESENTATION('',{items},#{writer.context})")
    writer.add(f"SHAPE_DEFINITION_REPRESENTATION(#{shape[1]},#{other})")
    assert bounds_of(writer.write(tmp_path / "a.step", PIN)) == {"pin": [[0.0, 0.0, 0.0], [10.0, 10.0, 30.0]]}
