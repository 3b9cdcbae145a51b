"""PMI of STEP AP242: counts, links to faces and features, and part files that are proposed from it."""

from __future__ import annotations

import gzip
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from arview import cad
from arview.cad.datum_check import datum_problems
from arview.cad.formats import pmi as pmi_reader
from arview.cad.part import Characteristic, Part
from arview.cli import main
from arview.errors import InputError, MissingDependencyError
from helpers.paths import SAMPLES, SHARED

pytest.importorskip("OCP", reason="cadquery-ocp-novtk of the extra formats is not installed")

FOLDER = SHARED / "nist-pmi"
COUNTS = {
    "nist_ctc_01_asme1_ap242-e1": (21, 6, 11),
    "nist_ctc_02_asme1_ap242-e2": (15, 22, 87),
    "nist_ctc_04_asme1_ap242-e1": (13, 6, 15),
    "nist_ftc_06_asme1_ap242-e2": (47, 27, 59),
    "nist_stc_08_asme1_ap242-e3": (18, 29, 63),
}
"""Dimensions, tolerances and references to datums of the files of NIST."""
LOCATED = ("Position", "ProfileOfSurface", "ProfileOfLine")
needs_nist = pytest.mark.skipif(not FOLDER.is_dir(), reason=f"the files of NIST are not in {FOLDER}")

# A plate of 80 × 60 × 10 mm with a hole of ⌀ 12 through it, turned and moved in an assembly with a second plate.
WRITE = """
import sys
from OCP.BRepAlgoAPI import BRepAlgoAPI_Cut
from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox, BRepPrimAPI_MakeCylinder
from OCP.OCP.collections import Sequence_TDF_Label, HArray1_double
from OCP.STEPCAFControl import STEPCAFControl_Writer
from OCP.STEPControl import STEPControl_StepModelType
from OCP.Interface import Interface_Static
from OCP.TCollection import TCollection_ExtendedString, TCollection_HAsciiString
from OCP.TDataStd import TDataStd_Name
from OCP.TDocStd import TDocStd_Document
from OCP.TopAbs import TopAbs_ShapeEnum
from OCP.TopExp import TopExp_Explorer
from OCP.TopLoc import TopLoc_Location
from OCP.TopoDS import TopoDS
from OCP.BRepAdaptor import BRepAdaptor_Surface
from OCP.XCAFDimTolObjects import *
import OCP.XCAFDimTolObjects as X
from OCP.XCAFDoc import *
from OCP.gp import gp_Ax1, gp_Ax2, gp_Dir, gp_Pnt, gp_Trsf, gp_Vec

document = TDocStd_Document(TCollection_ExtendedString("XmlXCAF"))
shapes = XCAFDoc_DocumentTool.ShapeTool_s(document.Main())
tool = XCAFDoc_DocumentTool.DimTolTool_s(document.Main())
hole = BRepPrimAPI_MakeCylinder(gp_Ax2(gp_Pnt(20, 30, -5), gp_Dir(0, 0, 1)), 6, 20).Shape()
plate = BRepAlgoAPI_Cut(BRepPrimAPI_MakeBox(80, 60, 10).Shape(), hole).Shape()
part = shapes.AddShape(plate, False)
TDataStd_Name.Set_s(part, TCollection_ExtendedString("plate"))
other = shapes.AddShape(BRepPrimAPI_MakeBox(30, 30, 5).Shape(), False)
TDataStd_Name.Set_s(other, TCollection_ExtendedString("shim"))
top = shapes.NewShape()
TDataStd_Name.Set_s(top, TCollection_ExtendedString("assembly"))
move = gp_Trsf()
move.SetRotation(gp_Ax1(gp_Pnt(0, 0, 0), gp_Dir(0, 0, 1)), 1.5707963267948966)
move.SetTranslationPart(gp_Vec(100, 0, 0))
shapes.AddComponent(top, part, TopLoc_Location(move))
away = gp_Trsf()
away.SetTranslation(gp_Vec(200, 0, 0))
shapes.AddComponent(top, other, TopLoc_Location(away))
shapes.UpdateAssemblies()

faces = {}
explorer = TopExp_Explorer(plate, TopAbs_ShapeEnum.TopAbs_FACE)
while explorer.More():
    surface = BRepAdaptor_Surface(TopoDS.Face(explorer.Current()))
    if surface.GetType().name == "GeomAbs_Cylinder":
        faces["hole"] = explorer.Current()
    elif abs(surface.Plane().Axis().Direction().Z()) > 0.9:
        faces["top" if surface.Plane().Location().Z() > 5 else "bottom"] = explorer.Current()
    explorer.Next()
labels = {name: shapes.AddSubShape(part, face) for name, face in faces.items()}


def linked(*names):
    sequence = Sequence_TDF_Label()
    for name in names:
        sequence.Append(labels[name])
    return sequence


def dimension(kind, values, first, second=()):
    label = tool.AddDimension()
    tool.SetDimension(linked(*first), linked(*second), label)
    own = XCAFDimTolObjects_DimensionObject()
    own.SetType(getattr(X.XCAFDimTolObjects_DimensionType, "XCAFDimTolObjects_DimensionType_" + kind))
    own.SetValue(values[0])
    own.SetLowerTolValue(values[1])
    own.SetUpperTolValue(values[2])
    XCAFDoc_Dimension.Set_s(label).SetObject(own)


def tolerance(kind, value, name, datums, is_round=False, is_maximum=False):
    label = tool.AddGeomTolerance()
    tool.SetGeomTolerance(linked(name), label)
    own = XCAFDimTolObjects_GeomToleranceObject()
    own.SetType(getattr(X.XCAFDimTolObjects_GeomToleranceType, "XCAFDimTolObjects_GeomToleranceType_" + kind))
    own.SetValue(value)
    if is_round:
        own.SetTypeOfValue(X.XCAFDimTolObjects_GeomToleranceTypeValue.XCAFDimTolObjects_GeomToleranceTypeValue_Diameter)
    if is_maximum:
        own.SetMaterialRequirementModifier(
            X.XCAFDimTolObjects_GeomToleranceMatReqModif.XCAFDimTolObjects_GeomToleranceMatReqModif_M)
    XCAFDoc_GeomTolerance.Set_s(label).SetObject(own)
    for order, (letter, face) in enumerate(datums, start=1):
        datum = tool.AddDatum()
        tool.SetDatum(linked(face), datum)
        feature = XCAFDimTolObjects_DatumObject()
        feature.SetName(TCollection_HAsciiString(letter))
        feature.SetPosition(order)
        XCAFDoc_Datum.Set_s(datum).SetObject(feature)
        tool.SetDatumToGeomTol(datum, label)


dimension("Size_Diameter", (12.0, 0.1, 0.2), ["hole"])
dimension("Location_LinearDistance", (10.0, 0.05, 0.05), ["top"], ["bottom"])
tolerance("Flatness", 0.08, "bottom", [])
tolerance("Perpendicularity", 0.2, "hole", [("A", "bottom")], is_round=True, is_maximum=True)
tolerance("Parallelism", 0.15, "top", [("A", "bottom")])
tolerance("CircularRunout", 0.3, "hole", [("A", "bottom")])
writer = STEPCAFControl_Writer()
writer.SetDimTolMode(True)
Interface_Static.SetIVal_s("write.step.schema", 5)
writer.Transfer(document, STEPControl_StepModelType.STEPControl_AsIs)
writer.Write(sys.argv[1])
sys.stdout.flush()
import os
os._exit(0)
"""


@pytest.fixture(scope="module")
def plate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("plate") / "plate.stp"
    subprocess.run([sys.executable, "-c", WRITE, str(path)], check=True, capture_output=True, timeout=120)
    return path


@cache
def nist(name: str) -> cad.Pmi:
    return cad.read_pmi(FOLDER / f"{name}.stp.gz")


def proposed(path: Path, folder: Path) -> tuple[str, Part]:
    """The proposal for a CAD file that is copied into a folder, and the part of it."""
    shutil.copyfile(path, folder / path.name)
    text = cad.propose_part(cad.load_part(folder / path.name))
    (folder / "part.toml").write_text(text, encoding="utf-8")
    return text, cad.load_part(folder / "part.toml")


def by_kind(part: Part) -> Iterator[tuple[str, Characteristic]]:
    return ((one.kind, one) for one in part.characteristics)


def test_a_part_file_from_a_plate_in_an_assembly(plate: Path, tmp_path: Path) -> None:
    text, part = proposed(plate, tmp_path)
    assert "2 dimensions (0 of them only drawn), 4 geometric tolerances, 3 references to datums" in text
    assert "CircularRunout 0.3): a part file has no such characteristic" in text
    (datum,) = part.datums
    assert (datum.label, datum.feature, datum.component) == ("A", "plane", "plate")
    # The plate's bottom faces down; it is turned by 90° about Z and moved by 100 mm along X.
    assert datum.direction_in_model == pytest.approx((0.0, 0.0, -1.0))
    hole = next(one for one in part.features if one.feature == "hole")
    assert hole.component == "plate" and hole.diameter_mm == pytest.approx(12.0)
    assert hole.point_in_model == pytest.approx((70.0, 20.0, 10.0)) and hole.direction_in_model[2] == pytest.approx(1.0)
    found = dict(by_kind(part))
    assert set(found) == {"size", "distance", "flatness", "perpendicularity", "parallelism"}
    assert found["size"].limits_mm == pytest.approx((11.9, 12.2)) and found["size"].of == (hole.label,)
    assert found["distance"].limits_mm == pytest.approx((9.95, 10.05)) and "A" in found["distance"].of
    assert found["perpendicularity"].material == "maximum" and found["perpendicularity"].datums == ("A",)
    assert found["parallelism"].tolerance_mm == pytest.approx(0.15)
    assert all(one.source.startswith("PMI of plate.stp: ") for one in part.characteristics)
    assert part.component_settings("plate").role == "base" and part.component_settings("shim").role == "inspect"
    assert datum_problems(part) + datum_problems(replace(part, datums=part.features)) == []


def test_the_signs_of_deviations_are_kept(plate: Path, tmp_path: Path) -> None:
    text = plate.read_text(encoding="utf-8")
    assert text.count("MEASURE_WITH_UNIT(-0.1,") == 1
    shifted = tmp_path / "shifted.stp"
    shifted.write_text(text.replace("MEASURE_WITH_UNIT(-0.1,", "MEASURE_WITH_UNIT(0.1,"), encoding="utf-8")
    sizes = [one.limits_mm for one in cad.read_pmi(shifted).dimensions if one.kind == "Size_Diameter"]
    assert sizes == [pytest.approx((12.1, 12.2))]
    assert pmi_reader._limits([12.0, 0.1, 0.2], [(0.1, 0.2), (-0.2, 0.4)]) is None


def test_a_step_file_without_pmi_says_so() -> None:
    result = CliRunner().invoke(main, ["check", str(SAMPLES / "bracket_plate" / "part.toml"), "--pmi"])
    assert result.exit_code == 0 and result.output.startswith("# PMI of bracket_plate.step: none;")


def test_what_cannot_be_read_is_said_in_one_line(plate: Path, tmp_path: Path) -> None:
    data = plate.read_bytes()
    broken = tmp_path / "cut.stp"
    for share in (0.3, 0.7, 0.95):
        broken.write_bytes(data[: int(share * len(data))])
        with pytest.raises(InputError, match=r"broken or truncated|cannot read") as raised:
            cad.read_pmi(broken)
        assert "\n" not in str(raised.value)
    broken.write_bytes(data[: data.index(b"DATA;")] + b"DATA;\nENDSEC;\nEND-ISO-10303-21;\n")
    with pytest.raises(InputError, match="cannot read its PMI"):
        cad.read_pmi(broken)
    with pytest.raises(InputError, match="not a STEP file"):
        cad.read_pmi(SAMPLES / "plate" / "part.toml")


def test_without_the_library_the_extra_is_named(plate: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "OCP", None)
    with pytest.raises(MissingDependencyError, match=r"PMI needs cadquery-ocp-novtk.*formats"):
        cad.read_pmi(plate)


@needs_nist
@pytest.mark.shared
@pytest.mark.slow
@pytest.mark.parametrize("name", COUNTS)
def test_counts_and_links_of_the_files_of_nist(name: str) -> None:
    found = nist(name)
    assert found.counts == COUNTS[name]
    assert len(found.dimensions) + found.drawn_dimensions == COUNTS[name][0]
    assert len(found.tolerances) == COUNTS[name][1]
    located = [one for one in found.tolerances if one.kind in LOCATED]
    linked = [one for one in located if one.shapes and all(shape.area_mm2 > 0 for shape in one.shapes)]
    assert len(linked) >= 0.95 * len(located) > 0
    assert all(np.linalg.norm(s.direction_in_model) == pytest.approx(1.0) for one in linked for s in one.shapes
               if s.kind in ("plane", "cylinder"))  # fmt: skip


@needs_nist
@pytest.mark.shared
@pytest.mark.slow
@pytest.mark.parametrize("name", COUNTS)
def test_proposals_for_the_files_of_nist_are_accepted(name: str, tmp_path: Path) -> None:
    text, part = proposed(FOLDER / f"{name}.stp.gz", tmp_path)
    requirements = [*nist(name).dimensions, *nist(name).tolerances]
    heads = [line for line in text.splitlines() if line.startswith("# left out: ") and "curved faces" not in line]
    expressed = {one.source for one in part.characteristics}
    assert len(part.characteristics) >= 15 and len(part.settings) == 1
    assert part.settings[0].role == "base"
    # Each requirement is proposed or left out with a reason; equal names have one source.
    assert len(heads) < len(requirements) <= len(heads) + len(part.characteristics)
    for one in requirements:
        head = f"{one.name} ({one.kind} {one.value_mm or 0.0:g}"
        assert any(head in source for source in expressed) or any(head in line for line in heads), head
    assert datum_problems(part) + datum_problems(replace(part, datums=part.features)) == []


@needs_nist
@pytest.mark.shared
@pytest.mark.slow
def test_values_of_the_first_drawing_of_nist(tmp_path: Path) -> None:
    """CTC 1: datums A, B and C, four holes of ⌀ 35 in two tolerances, and the boss's profile of 0.5."""
    _, part = proposed(FOLDER / "nist_ctc_01_asme1_ap242-e1.stp.gz", tmp_path)
    assert [(one.label, one.feature, one.diameter_mm) for one in part.datums] == [
        ("A", "plane", None), ("B", "hole", 35.0), ("C", "hole", 35.0),
    ]  # fmt: skip
    sizes = {one.of[0]: one.limits_mm for one in part.characteristics if one.kind == "size"}
    assert sizes["B"] == (34.8, 35.0) and sizes["C"] == (35.0, 35.2)
    profiles = [one for one in part.characteristics if one.kind == "profile" and one.tolerance_mm == 0.5]
    assert len(profiles) == 6 and all(one.datums == ("A",) for one in profiles)
    result = CliRunner().invoke(main, ["check", str(tmp_path / "part.toml")])
    assert result.exit_code == 0 and "datum C: hole of NIST Complex Test Case 1" in result.output


@needs_nist
@pytest.mark.shared
@pytest.mark.slow
def test_a_file_whose_pmi_is_only_drawn_says_so(tmp_path: Path) -> None:
    found = nist("nist_ftc_08_asme1_ap242-e1-tg")
    assert found.drawn_count == 60 and not found.dimensions and not found.tolerances
    text, part = proposed(FOLDER / "nist_ftc_08_asme1_ap242-e1-tg.stp.gz", tmp_path)
    assert "only drawn, 60 annotations" in text and part.characteristics == ()


@needs_nist
@pytest.mark.shared
def test_a_truncated_file_of_nist_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cut.stp.gz"
    data = gzip.decompress((FOLDER / "nist_ctc_01_asme1_ap242-e1.stp.gz").read_bytes())
    path.write_bytes(gzip.compress(data[: len(data) // 2]))
    with pytest.raises(InputError, match="broken or truncated STEP"):
        cad.read_pmi(path)
