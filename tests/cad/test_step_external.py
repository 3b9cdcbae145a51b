"""STEP assemblies whose parts are in files beside them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from arview.cad.formats import step_external
from arview.cad.load import load_cad
from arview.errors import InputError
from helpers.cad_files import QUARTER_TURN, SHIFT, StepAssembly, StepPart, StepWriter

FORMS = {
    "associated": "#9{n}=DOCUMENT_FILE('{file}','','',#1,'',$);",
    "reference": (
        "#9{n}=DOCUMENT_FILE('17','','',#1,'',$);\n#9{n}1=APPLIED_DOCUMENT_REFERENCE(#9{n},'',(#{definition}));\n"
        "#9{n}2=APPLIED_EXTERNAL_IDENTIFICATION_ASSIGNMENT('{file}',#1,#9000,(#9{n}));"
    ),
    # All documents have one source.
    "common source": (
        "#9{n}=DOCUMENT_FILE('{file}','',$,#1,'',$);\n#9{n}1=APPLIED_DOCUMENT_REFERENCE(#9{n},'',(#{definition}));\n"
        "#9{n}2=APPLIED_EXTERNAL_IDENTIFICATION_ASSIGNMENT('7',#1,#9001,(#9{n}));"
    ),
    "source": (
        "#9{n}=DOCUMENT_FILE('17','','',#1,'',$);\n#9{n}1=APPLIED_DOCUMENT_REFERENCE(#9{n},'',(#{definition}));\n"
        "#9{n}2=APPLIED_EXTERNAL_IDENTIFICATION_ASSIGNMENT('17',#1,#9{n}3,(#9{n}));\n"
        "#9{n}3=EXTERNAL_SOURCE(IDENTIFIER('{file}'));"
    ),
}
PLATE, PIN = StepPart("plate", (50.0, 40.0, 5.0)), StepPart("pin", (10.0, 10.0, 30.0))


def write_assembly(path: Path, parts: list[tuple[str, StepPart, np.ndarray]], form: str, files: dict[str, str]) -> Path:
    """An assembly in which some parts have no shape but a file."""
    text = StepWriter().write(path, StepAssembly(path.stem, parts)).read_text()  # type: ignore[arg-type]
    added = ["#9000=EXTERNAL_SOURCE(IDENTIFIER(''));", "#9001=EXTERNAL_SOURCE('cad');"]
    for number, (name, file) in enumerate(files.items(), start=100):
        solid = re.search(rf"#(\d+)=MANIFOLD_SOLID_BREP\('{name}'", text)
        assert solid is not None
        shape = re.search(rf"ADVANCED_BREP_SHAPE_REPRESENTATION\('',\((#\d+),#{solid[1]}\)", text)
        product = re.search(
            rf"PRODUCT\('{name}'.*?#(\d+)=PRODUCT_DEFINITION\('design','',(#\d+,#\d+)\)", text, re.DOTALL
        )
        assert shape is not None and product is not None
        text = text.replace(shape[0], f"SHAPE_REPRESENTATION('',({shape[1]})")
        if form == "associated":
            old = f"PRODUCT_DEFINITION('design','',{product[2]})"
            new = f"PRODUCT_DEFINITION_WITH_ASSOCIATED_DOCUMENTS('design','',{product[2]},(#9{number}))"
            text = text.replace(old, new)
        added.append(FORMS[form].format(n=number, file=file, definition=product[1]))
    path.write_text(text.replace("\nENDSEC;\nEND", "\n" + "\n".join(added) + "\nENDSEC;\nEND"))
    return path


def bounds_of(path: Path) -> dict[str, list[list[float]]]:
    return {one.name: one.bounds_in_model.round(3).tolist() for one in load_cad(path).model.components}


@pytest.mark.parametrize("form", FORMS)
def test_parts_are_read_from_the_files_beside_the_assembly(form: str, tmp_path: Path) -> None:
    parts = [("plate.1", PLATE, np.eye(4)), ("pin.1", PIN, SHIFT), ("pin.2", PIN, QUARTER_TURN)]
    files = {"plate": "Plate.stp", "pin": "C:\\cad\\pin.STEP"}
    path = write_assembly(tmp_path / "fixture.stp", parts, form, files)
    StepWriter().write(tmp_path / "plate.stp", PLATE)
    # In another unit, and with a comment that holds a quotation mark.
    pin = StepWriter("inch").write(tmp_path / "pin.step", StepPart("pin", (10 / 25.4, 10 / 25.4, 30 / 25.4)))
    pin.write_text(pin.read_text().replace("DATA;\n", "DATA;\n/* the maker's #1 */\n"))
    assert bounds_of(path) == {
        "plate.1": [[0.0, 0.0, 0.0], [50.0, 40.0, 5.0]],
        "pin.1": [[1.0, 2.0, 3.0], [11.0, 12.0, 33.0]],
        "pin.2": [[90.0, 0.0, 5.0], [100.0, 10.0, 35.0]],
    }
    assert load_cad(path).notes == ()


def test_files_of_files_are_read_and_missing_ones_are_named(tmp_path: Path) -> None:
    inner = [("post", PIN, SHIFT), ("foot", StepPart("foot", (5.0, 5.0, 5.0)), np.eye(4))]
    write_assembly(tmp_path / "sub.stp", inner, "associated", {"pin": "pin.stp", "foot": "gone.stp"})
    StepWriter().write(tmp_path / "pin.stp", PIN)
    outer = [("plate", PLATE, np.eye(4)), ("frame", StepPart("sub", (1.0, 1.0, 1.0)), SHIFT)]
    path = write_assembly(tmp_path / "top.stp", outer, "reference", {"sub": "sub.stp"})
    assert bounds_of(path) == {
        "plate": [[0.0, 0.0, 0.0], [50.0, 40.0, 5.0]],
        "post": [[2.0, 4.0, 6.0], [12.0, 14.0, 36.0]],
    }
    cad = load_cad(path)
    assert cad.paths[1] == ("top", "frame", "post")
    (note,) = cad.notes
    assert note.startswith("left out, because their STEP files are not beside it") and note.endswith(
        ": gone.stp (foot)"
    )


@pytest.mark.parametrize("file", ["gone.stp", "../outside.stp", "plate.CATPart", "several.stp"])
def test_a_file_that_is_not_there_is_named(file: str, tmp_path: Path) -> None:
    folder = tmp_path / "inner"
    folder.mkdir()
    StepWriter().write(tmp_path / "outside.stp", PIN)
    (folder / "plate.CATPart").write_bytes(b"V5_CFV2")
    writer = StepWriter()
    writer.item(PIN)
    writer.write(folder / "several.stp", PLATE)
    path = write_assembly(folder / "a.stp", [("plate", PLATE, np.eye(4))], "associated", {"plate": file})
    with pytest.raises(InputError, match=re.escape(f": {file} (plate)")) as caught:
        load_cad(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_files_in_a_circle_or_too_many_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_assembly(tmp_path / "a.stp", [("plate", PLATE, np.eye(4))], "source", {"plate": "b.stp"})
    write_assembly(tmp_path / "b.stp", [("pin", PIN, np.eye(4))], "source", {"pin": "a.stp"})
    with pytest.raises(InputError, match=r"b\.stp: broken STEP \(it refers to a\.stp, which refers to it\)"):
        load_cad(path)
    StepWriter().write(tmp_path / "b.stp", PIN)
    assert list(bounds_of(path)) == ["plate"]
    monkeypatch.setattr(step_external, "MAX_BYTES", 10_000)
    with pytest.raises(InputError, match=r"a\.stp: more than 0 MB with its other files; export fewer parts"):
        load_cad(path)
