"""CSV, QIF, DFQ and GLB of an inspection, read back and compared with it."""

from __future__ import annotations

import csv
import io
import json
import os
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from lxml import etree

from arview.cad.model import Model
from arview.cli import main
from arview.errors import MismatchError
from arview.inspection import Inspection, save_inspection
from arview.inspection.export import to_csv, to_dfq, to_glb, to_qif
from arview.inspection.schema_doc import schema_markdown
from arview.inspection.summary import overall_verdict, verdict_sentence
from helpers.inspections import bench_inspection, deviation, inspection
from helpers.paths import ROOT
from helpers.photo_scene import bench

HERE = Path(__file__).parent
Q = {"q": "http://qifstandards.org/xsd/qif3"}


@pytest.fixture(scope="module")
def model() -> Model:
    return bench()


@pytest.fixture(scope="module")
def found(model: Model) -> Inspection:
    return bench_inspection(model)


def test_the_whole_in_words(model: Model, found: Inspection) -> None:
    assert overall_verdict(found).value == "fail"
    assert verdict_sentence(found) == (
        "5 components: 1 missing, 1 out of tolerance, 1 undecided, 1 not measured, 1 in tolerance, 1 foreign object"
    )
    good = inspection(model, (deviation("block_1", (0.0, 0.1, 0.0), np.zeros(3)),))
    assert overall_verdict(good).value == "pass"
    assert overall_verdict(replace(good, foreign_objects=found.foreign_objects)).value == "undecided"
    assert overall_verdict(replace(found, components=found.components[4:])).value == "not_measured"
    assert overall_verdict(replace(found, components=())).value == "not_measured"


def test_csv_holds_what_was_measured_and_nothing_for_what_was_not(found: Inspection) -> None:
    rows = list(csv.DictReader(io.StringIO(to_csv(found))))
    assert [row["component"] for row in rows] == [c.name for c in found.components]
    moved = rows[1]
    assert [float(moved[f"d{axis}_mm"]) for axis in "xyz"] == [2.4, -1.8, 0.0]
    assert float(moved["distance_mm"]) == 3.0
    assert float(moved["position_diameter_mm"]) == 6.0
    assert float(moved["measured_x_mm"]) - float(moved["nominal_x_mm"]) == pytest.approx(2.4, abs=2e-6)
    assert (rows[2]["dz_mm"], rows[2]["measured_z_mm"], rows[2]["position_diameter_mm"]) == ("", "", "")
    assert (rows[3]["finding"], rows[3]["distance_mm"], rows[3]["verdict"]) == ("missing", "", "fail")
    assert rows[4]["verdict"] == "not_measured"


def test_csv_starts_no_formula(model: Model) -> None:
    one = inspection(model, (), serial="=HYPERLINK()")
    one = replace(one, components=(deviation("block_1", (-1.0, 0, 0), np.zeros(3)),))
    row = next(csv.DictReader(io.StringIO(to_csv(one))))
    assert row["serial"] == "'=HYPERLINK()"
    assert row["dx_mm"] == "-1.000000"  # numbers are not escaped


def test_qif_has_the_structure_of_the_standard(found: Inspection) -> None:
    schema = etree.XMLSchema(etree.parse(HERE / "qif3_subset.xsd"))
    document = etree.fromstring(to_qif(found))
    assert schema.validate(document), schema.error_log
    assert int(document.get("idMax")) == max(int(one) for one in document.xpath("//@id"))
    lists = document.xpath("//*[@n]")
    assert len(lists) > 3
    for one in lists:
        assert int(one.get("n")) == len(one), one.tag
    assert to_qif(found) == to_qif(found)


@pytest.mark.parametrize("broken", ["//q:Value", "//q:TimeStamp", "//q:CharacteristicNominalId"])
def test_the_subset_notices_what_is_out_of_place(found: Inspection, broken: str) -> None:
    schema = etree.XMLSchema(etree.parse(HERE / "qif3_subset.xsd"))
    document = etree.fromstring(to_qif(found))
    one = document.xpath(broken, namespaces=Q)[0]
    parent = one.getparent()
    parent.remove(one)
    parent.insert(0, one)
    assert not schema.validate(document)


@pytest.mark.skipif("ARVIEW_QIF_XSD" not in os.environ, reason="ARVIEW_QIF_XSD names no QIFDocument.xsd (QIF 3.0)")
def test_qif_is_valid_by_the_published_schema(found: Inspection) -> None:
    schema = etree.XMLSchema(etree.parse(os.environ["ARVIEW_QIF_XSD"]))
    assert schema.validate(etree.fromstring(to_qif(found))), schema.error_log


def test_qif_values_and_status(found: Inspection) -> None:
    document = etree.fromstring(to_qif(found))
    results = _qif_results(document)
    status, value = results["block_2 position"]
    assert (status, float(value.text)) == ("FAIL", 6.0)
    assert float(value.get("combinedUncertainty")) == pytest.approx(0.06)  # of a diameter: twice U / k
    place = found.components[1].details
    assert place is not None
    status, value = results["block_2 place x"]
    assert (status, float(value.text)) == ("BASIC_OR_TED", pytest.approx(place.center_mm[0] + 2.4, abs=1e-6))
    assert float(value.get("combinedUncertainty")) == pytest.approx(0.02)
    assert results["block_1 position"][0] == "PASS"
    assert results["block_2 rotation"][0] == "PASS"
    assert results["block_3 position"] == ("INDETERMINATE", None)
    assert results["block_3 place z"] == ("INDETERMINATE", None)
    assert results["block_4 position"] == ("FAIL", None)
    assert results["block_4 place x"] == ("NOT_ANALYZED", None)
    assert results["plate position"] == ("NOT_ANALYZED", None)
    assert document.findtext(".//q:ActualComponent/q:SerialNumber", namespaces=Q) == "SN-7"
    assert (
        document.findtext(".//q:MeasurementResults/q:InspectionStatus/q:InspectionStatusEnum", namespaces=Q) == "FAIL"
    )
    tolerance = document.findtext(".//q:PositionCharacteristicDefinition/q:ToleranceValue", namespaces=Q)
    assert float(tolerance) == 1.0


def _qif_results(document: Any) -> dict[str, tuple[str, Any]]:
    """By the name of the item: status and value."""
    names = {item.get("id"): item.findtext("q:Name", namespaces=Q)
             for item in document.find(".//q:CharacteristicItems", Q)}  # fmt: skip
    found = {}
    for one in document.find(".//q:CharacteristicMeasurements", Q):
        name = names[one.findtext("q:CharacteristicItemId", namespaces=Q)]
        found[name] = one.findtext("q:Status/q:CharacteristicStatusEnum", namespaces=Q), one.find("q:Value", Q)
    return found


def test_texts_that_xml_and_lines_cannot_hold(model: Model, found: Inspection) -> None:
    odd = replace(found, part="Träger <7> & \x0b\x14 ½", serial="№ 7\r\nK0001/1 9", components=found.components[:1])
    document = etree.fromstring(to_qif(odd))
    assert "Träger <7> &" in document.findtext("q:Header/q:Description", namespaces=Q)
    text = to_dfq(odd).decode("utf-8-sig")  # № is not in Windows-1252
    assert sum(line.startswith("K0001/1 ") for line in text.splitlines()) == 1  # not that inside the serial
    assert "K0014/1 № 7 K0001/1 9\r\n" in text
    assert to_dfq(replace(odd, serial="Ä 7"))[:5] == b"K0100"


def test_dfq_fields(found: Inspection) -> None:
    fields = _dfq(to_dfq(found))
    assert fields["K0100"] == "25"
    assert (fields["K1001"], fields["K1204"]) == ("bench", "01.03.2026")
    numbers = {fields[key]: key.split("/")[1] for key in fields if key.startswith("K2001/")}
    distance = numbers["block_2.distance"]
    assert fields[f"K0001/{distance}"] == "3.0000"
    assert (fields[f"K2110/{distance}"], fields[f"K2111/{distance}"]) == ("0.0000", "0.5000")
    assert (fields[f"K2120/{distance}"], fields[f"K2121/{distance}"]) == ("2", "1")  # 0 is a natural limit
    assert fields[f"K0004/{distance}"] == "01.03.2026/12:30:15"
    assert fields[f"K0014/{distance}"] == "SN-7"
    assert fields[f"K0001/{numbers['block_2.dy']}"] == "-1.8000"
    for open_one in ("block_3.dz", "block_4.distance", "plate.dx"):
        assert f"K0001/{numbers[open_one]}" not in fields
    values = [key for key in fields if key.startswith("K0001/")]
    assert len(values) == 2 * 5 + 4


def _dfq(data: bytes) -> dict[str, str]:
    lines = data.decode("cp1252").split("\r\n")
    assert lines.pop() == ""
    pairs = [line.split(" ", 1) for line in lines]
    assert len({key for key, _ in pairs}) == len(pairs)
    return dict(pairs)


def test_glb_places_components_and_arrows(model: Model, found: Inspection) -> None:
    tree, binary = _glb(to_glb(found, model, arrow_scale=10.0))
    nodes = {node["name"]: node for node in tree["nodes"]}
    assert {name for name in nodes if name.startswith("design/")} == {f"design/{c.name}" for c in model.components}
    assert sorted(name for name in nodes if name.startswith("measured/")) == [f"measured/block_{i}" for i in (1, 2, 3)]
    assert [name for name in nodes if name.startswith("arrows/")] == ["arrows/block_2", "arrows/block_3"]
    upright = np.array(nodes["model"]["matrix"]).reshape(4, 4).T
    place = np.array(nodes["measured/block_2"]["matrix"]).reshape(4, 4).T
    center = model.component("block_2").bounds_in_model.mean(axis=0)
    moved = (upright @ place @ [*(center / 1000.0), 1.0])[:3]
    truth = center + np.array([2.4, -1.8, 0.0])
    assert moved == pytest.approx([truth[0] / 1000, truth[2] / 1000, -truth[1] / 1000], abs=1e-9)
    arrow = _positions(tree, binary, nodes["arrows/block_2"]["mesh"])
    tip = center + 10.0 * np.array([2.4, -1.8, 0.0])
    assert np.linalg.norm(1000.0 * arrow - tip, axis=1).min() < 1e-3
    assert nodes["measured/block_2"]["extras"] == {
        "verdict": "fail", "displacement_mm": [2.4, -1.8, 0.0], "distance_mm": 3.0, "uncertainty_mm": 0.06,
        "tolerance_mm": 0.5,
    }  # fmt: skip
    assert nodes["measured/block_3"]["extras"]["displacement_mm"] == [0.1, 0.05, None]
    box = _positions(tree, binary, nodes["design/plate"]["mesh"])
    assert np.ptp(box, axis=0) == pytest.approx([0.2, 0.2, 0.008], abs=1e-6)


def _glb(data: bytes) -> tuple[dict[str, Any], bytes]:
    magic, version, length = struct.unpack("<4sII", data[:12])
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size = struct.unpack("<I", data[12:16])[0]
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def _positions(tree: dict[str, Any], binary: bytes, mesh: int) -> Any:
    accessor = tree["accessors"][tree["meshes"][mesh]["primitives"][0]["attributes"]["POSITION"]]
    view = tree["bufferViews"][accessor["bufferView"]]
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    return np.frombuffer(binary, "<f4", 3 * accessor["count"], start).reshape(-1, 3)


def test_glb_refuses_another_model(found: Inspection) -> None:
    with pytest.raises(MismatchError, match="another model"):
        to_glb(found, bench(seed=3))


def test_the_schema_page_is_that_of_the_schema() -> None:
    assert (ROOT / "src" / "arview" / "inspection" / "schema" / "inspection-json.md").read_text(
        encoding="utf-8"
    ) == schema_markdown()


def test_the_command(tmp_path: Path, found: Inspection) -> None:
    source = tmp_path / "inspection.json"
    save_inspection(found, source)
    done = CliRunner().invoke(main, ["export", str(source), "--to", "csv,qif,dfq"])
    assert done.exit_code == 0, done.output
    assert done.output.splitlines() == [f"wrote {tmp_path / 'inspection'}.{kind}" for kind in ("csv", "qif", "dfq")]
    assert (tmp_path / "inspection.qif").read_bytes() == to_qif(found)
    assert (tmp_path / "inspection.csv").read_bytes() == to_csv(found).encode()
    for arguments, message in (
        (["--to", "glb"], "--part"),
        (["--to", "xls"], "expected some of csv,qif,dfq,glb,html,pdf"),
        (["--to", "csv,qif", "-o", str(tmp_path / "one.csv")], "2 formats need a folder"),
        (["--to", "csv", "-o", str(source)], "would overwrite an input"),
    ):
        refused = CliRunner().invoke(main, ["export", str(source), *arguments])
        assert refused.exit_code == 64
        assert message in refused.output
        assert "Traceback" not in refused.output
