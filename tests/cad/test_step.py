"""STEP: named solids of one product, names in other encodings, and files that would take minutes or gigabytes."""

from __future__ import annotations

import re
import time
from pathlib import Path

import numpy as np
import pytest

from arview.cad import load_part
from arview.cad.formats import limited_process
from arview.cad.formats.step import StepLimits, read_step
from arview.cad.load import load_cad, load_model
from arview.errors import InputError
from helpers.cad_files import QUARTER_TURN, SHIFT, StepAssembly, StepBodies, StepPart, StepWriter, scaled

RED, BLUE = (1.0, 0.0, 0.0), (0.0, 0.25, 1.0)
FIXTURE = [
    ("base plate", (200.0, 120.0, 8.0), (0.0, 0.0, 0.0), None),
    ("pin left", (10.0, 10.0, 40.0), (20.0, 20.0, 8.0), RED),
    ("stop; (block)", (30.0, 20.0, 15.0), (150.0, 50.0, 8.0), BLUE),
]


@pytest.mark.parametrize("is_linked", [False, True], ids=["own", "linked"])
def test_named_solids_of_one_product_are_components(is_linked: bool, tmp_path: Path) -> None:
    path = StepWriter().write(tmp_path / "f.step", StepBodies("fixture", FIXTURE, is_linked))
    model = load_model(path)
    assert [c.name for c in model.components] == [name for name, *_ in FIXTURE]
    for component, (_, size, low, _) in zip(model.components, FIXTURE, strict=True):
        expected = [low, np.asarray(low) + size]
        np.testing.assert_allclose(component.bounds_in_model, expected, atol=1e-4)
    np.testing.assert_allclose(model.component("pin left").color, RED, atol=1e-3)
    np.testing.assert_allclose(model.component("stop; (block)").color, BLUE, atol=1e-3)


@pytest.mark.parametrize("unit", ["mm", "inch"])
def test_named_solids_keep_the_places_of_their_product(unit: str, tmp_path: Path) -> None:
    per_mm = {"mm": 1.0, "inch": 1 / 25.4}[unit]
    bodies = [
        (name, tuple(per_mm * v for v in size), tuple(per_mm * v for v in low), c) for name, size, low, c in FIXTURE
    ]
    sub = StepAssembly("sub", [("fixture", StepBodies("fixture", bodies), scaled(SHIFT, per_mm))])
    places = [("left", sub, np.eye(4)), ("right", sub, scaled(QUARTER_TURN, per_mm))]
    path = StepWriter(unit).write(tmp_path / "a.step", StepAssembly("root", places))
    model = load_model(path)
    assert len(model.components) == 6
    names = [c.name for c in model.components]
    assert names[:2] == ["left/fixture/base plate", "left/fixture/pin left"]
    assert names[4] == "right/fixture/pin left"
    # (20, 20, 8) to (30, 30, 48), moved by (1, 2, 3), turned by a quarter about z, moved by (100, 0, 5).
    bounds = model.component("right/fixture/pin left").bounds_in_model
    np.testing.assert_allclose(bounds, [[68, 21, 16], [78, 31, 56]], atol=1e-4)


def test_products_in_other_files_are_told(tmp_path: Path) -> None:
    sub = StepAssembly("sub", [("pin", StepPart("pin"), np.eye(4))])
    places = [("plate", StepPart("plate", (50.0, 40.0, 5.0)), np.eye(4)), ("sub", sub, np.eye(4))]
    path = StepWriter().write(tmp_path / "a.step", StepAssembly("root", places))
    assert load_cad(path).notes == ()
    text = path.read_text()
    _, pin = re.finditer(r"ADVANCED_BREP_SHAPE_REPRESENTATION\('',\((#\d+),#\d+\)", text)
    path.write_text(text.replace(pin[0], f"SHAPE_REPRESENTATION('',({pin[1]})"))
    cad = load_cad(path)
    assert [c.name for c in cad.model.components] == ["plate"]
    assert len(cad.notes) == 1
    assert "1 products of the STEP file have no shape in it and are left out" in cad.notes[0]
    assert cad.notes[0].endswith(": pin")


@pytest.mark.slow
def test_solids_without_names_of_their_own_stay_one_component(tmp_path: Path) -> None:
    for name in ("", "NONE", "part"):
        bodies = [(name, size, low, color) for _, size, low, color in FIXTURE]
        model = load_model(StepWriter().write(tmp_path / "f.step", StepBodies("fixture", bodies)))
        assert [c.name for c in model.components] == ["fixture"]
    bodies = [("lid", *FIXTURE[0][1:]), ("", *FIXTURE[1][1:])]
    model = load_model(StepWriter().write(tmp_path / "f.step", StepBodies("fixture", bodies)))
    assert [c.name for c in model.components] == ["lid", "fixture"]


@pytest.mark.parametrize(
    ("encoding", "names"),
    [("utf-8", ["Träger", "底板"]), ("latin-1", ["Träger", "Tröger"]), ("gb18030", ["底板", "左销"])],
)
def test_names_in_other_encodings(encoding: str, names: list[str], tmp_path: Path) -> None:
    parts = [(name, StepPart(name, (10, 20, 30)), scaled(SHIFT, 50.0 * i)) for i, name in enumerate(names)]
    path = StepWriter().write(tmp_path / "n.step", StepAssembly("root", parts))
    path.write_bytes(path.read_text(encoding="utf-8").encode(encoding))
    cad = load_cad(path)
    assert [c.name for c in cad.model.components] == names
    assert not cad.notes


def test_a_small_part_is_accepted_with_its_unit(tmp_path: Path) -> None:
    path = StepWriter().write(tmp_path / "chip.step", StepPart("chip", (0.6, 0.3, 0.25)))
    with pytest.raises(InputError, match=r"is it really 0.6 × 0.3 × 0.25 mm\? .*--unit mm"):
        load_model(path)
    model = load_model(path, unit="mm")
    np.testing.assert_allclose(model.bounds_in_model, [[0, 0, 0], [0.6, 0.3, 0.25]], atol=1e-6)


def step_file(path: Path, body: str) -> Path:
    path.write_text(f"ISO-10303-21;\nHEADER;\nENDSEC;\nDATA;\n{body}\nENDSEC;\nEND-ISO-10303-21;\n")
    return path


def uses(pairs: list[tuple[int, int]]) -> str:
    """Statements that place products in products."""
    return "\n".join(
        f"#{1000 + n}=NEXT_ASSEMBLY_USAGE_OCCURRENCE('{n}','','',#{a},#{b},$);" for n, (a, b) in enumerate(pairs)
    )


HOSTILE = [
    ("#1=A(" * 100_000, "its parentheses do not match"),
    ("#1=A" + "(" * 70 + ")" * 70 + ";", "its parentheses do not match"),
    ("#1=A());\n" * 10, "its parentheses do not match"),
    ("#1=A('" * 50_001, "unexpected end of file|parentheses"),
    ("/*" * 500_000, "STEP"),
    (uses([(1, 2), (2, 3), (3, 1)]), "an assembly holds itself"),
    (uses([(i, i + 1) for i in range(1, 11) for _ in range(10)]), "more than 10,000 components"),
    ("#7=INVISIBILITY((#1));\n" + "#1=STYLED_ITEM('x')\n" * 50_000, "broken or truncated STEP|no triangles"),
    ("#7=INVISIBILITY((#1));\n" + "#1=STYLED_ITEM(')#1=STYLED_ITEM(')\n" * 50_000, "STEP|no triangles"),
    (f"#1=NEXT_ASSEMBLY_USAGE_OCCURRENCE('1','{' ' * 200_000}x','',#2,#3,$);", "STEP|no triangles"),
]


@pytest.mark.parametrize(("body", "expected"), HOSTILE, ids=[str(i) for i in range(len(HOSTILE))])
def test_hostile_text_is_refused_at_once(body: str, expected: str, tmp_path: Path) -> None:
    path = step_file(tmp_path / "h.step", body)
    start = time.perf_counter()
    with pytest.raises(InputError, match=expected) as caught:
        load_model(path)
    assert time.perf_counter() - start < 10.0
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_a_model_for_finite_elements_is_named(tmp_path: Path) -> None:
    path = step_file(tmp_path / "a.stp", "#1=PRODUCT('a','a','',(#2));")
    schema = "FILE_SCHEMA(('AP209_MULTIDISCIPLINARY_ANALYSIS_AND_DESIGN_MIM_LF { 1 0 10303 409 3 1 4 }'));"
    path.write_text(path.read_text().replace("HEADER;\n", f"HEADER;\n{schema}\n"))
    with pytest.raises(InputError, match=r"a\.stp: AP209, a model for finite elements, holds no shape; export AP214"):
        load_model(path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("limits", "constants", "expected"),
    [
        (StepLimits(memory_mb=150.0), {}, "more than 0.2 GB of memory"),
        (StepLimits(), {"OUTPUT_MB": 0.0001}, "broken or truncated STEP"),
    ],
    ids=["memory", "output"],
)
def test_limits_of_the_reading_process(
    limits: StepLimits, constants: dict[str, float], expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = StepWriter().write(tmp_path / "f.step", StepBodies("fixture", FIXTURE))
    assert len(read_step(path, 0.1, 10.0, False).components) == 3
    for name, value in constants.items():
        monkeypatch.setattr(limited_process, name, value)
    with pytest.raises(InputError, match=expected) as caught:
        read_step(path, 0.1, 10.0, False, limits)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("code", "expected"), [(-24, "did not read it in 5 s of computing"), (-1000, "did nothing for")]
)
def test_a_reader_that_was_ended_says_which_limit_it_was(
    code: int, expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = StepWriter().write(tmp_path / "f.step", StepBodies("fixture", FIXTURE))
    monkeypatch.setattr("arview.cad.formats.step.run_limited", lambda *arguments: (code, ""))
    with pytest.raises(InputError, match=expected):
        read_step(path, 0.1, 10.0, False, StepLimits(max_cpu_s=5.0))


def test_a_placeholder_of_the_writer_is_no_name(tmp_path: Path) -> None:
    for name in ("Open CASCADE STEP translator 7.8 1", "NONE"):
        path = StepWriter().write(tmp_path / "chip.step", StepPart(name, (20, 10, 5)))
        assert [one.name for one in load_model(path).components] == ["chip"]
    unnamed = StepPart("Open CASCADE STEP translator 8.0 7.1", (20, 10, 5))
    parts = [(unnamed.name, unnamed, np.eye(4)), ("post", StepPart("post", (5, 5, 40)), np.eye(4))]
    path = StepWriter().write(tmp_path / "a.step", StepAssembly("root", parts))
    assert [one.name for one in load_model(path).components] == ["root", "post"]


def test_a_tolerance_that_is_too_fine_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = StepWriter().write(tmp_path / "chip.step", StepPart("chip", (20, 10, 5)))
    with pytest.raises(InputError, match=r"^tol_linear_mm = 1e-09 makes too many triangles; give at least 0\.0001 mm"):
        load_model(path, tol_linear_mm=1e-9)
    (tmp_path / "part.toml").write_text('[part]\ncad = "chip.step"\ntol_angular_deg = 1e-6\n')
    with pytest.raises(InputError, match=r"part\.toml: \[part\] tol_angular_deg = 1e-06 makes too many"):
        load_part(tmp_path / "part.toml")
    monkeypatch.setattr(limited_process, "OUTPUT_MB", 0.0001)
    with pytest.raises(InputError, match=r"could not triangulate it with tol_linear_mm = 0\.001"):
        read_step(path, 0.001, 10.0, False)
