"""CSV, QIF, DFQ and GLB of an inspection, read back and compared with it."""

from __future__ import annotations

import csv
import io
import json
import struct
from dataclasses import replace
from pathlib import Path
from runpy import run_path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from lxml import etree

from arview.cad.model import Model
from arview.cli import main
from arview.cli.exit_codes import ExitCode, exit_code_of
from arview.errors import InputError, MismatchError
from arview.inspection import Inspection, Verdict, load_inspection, save_inspection
from arview.inspection.export import to_csv, to_dfq, to_glb, to_qif
from arview.inspection.fingerprint import fingerprint, fingerprint_of_file
from arview.inspection.rounding import decimals_beside_limit, decimals_of, exact, fixed
from arview.inspection.summary import overall_verdict, verdict_sentence
from arview.quality.history import HistoryStore
from arview.report.evidence import gather
from helpers.inspections import bench_inspection, deviation, inspection, not_measured
from helpers.paths import ROOT, SHARED
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


def test_a_bare_cad_without_tolerances_is_measured(model: Model, tmp_path: Path) -> None:
    center = np.array([1.0, 2.0, 3.0])
    bare = tuple(deviation(f"block_{i}", (0.1 * i, 0.0, 0.0), center, None) for i in (1, 2, 3, 4))
    one = inspection(model, bare)
    assert overall_verdict(one).value == "measured"
    assert verdict_sentence(one) == "4 components: 4 measured without a tolerance"
    assert exit_code_of("measured") is ExitCode.DONE
    save_inspection(one, tmp_path / "inspection.json")
    assert load_inspection(tmp_path / "inspection.json", model) == one
    judged = deviation("block_1", (0.1, 0.0, 0.0), center)
    assert overall_verdict(replace(one, components=(judged, *bare[1:]))).value == "pass"
    hidden = not_measured("block_1", center)
    assert overall_verdict(replace(one, components=(hidden, *bare[1:]))).value == "undecided"
    with pytest.raises(InputError, match=r"verdict: is measured, but tolerance_mm is 0\.5"):
        replace(bare[0], tolerance_mm=0.5)


def test_a_component_judged_by_its_angle_alone_may_pass_or_fail() -> None:
    only_angle = deviation("block_1", (0.1, 0.0, 0.0), np.zeros(3), None, turn_deg=0.7, angle_tolerance_deg=1.0)
    assert replace(only_angle, verdict=Verdict.FAIL).verdict is Verdict.FAIL
    with pytest.raises(InputError, match="tolerance_mm: is null, but the verdict is fail"):
        replace(deviation("block_1", (0.1, 0.0, 0.0), np.zeros(3), None), verdict=Verdict.FAIL)


def test_csv_holds_what_was_measured_and_nothing_for_what_was_not(found: Inspection) -> None:
    rows = list(csv.DictReader(io.StringIO(to_csv(found))))
    assert [row["component"] for row in rows] == [c.name for c in found.components]
    moved = rows[1]
    assert [moved[f"d{axis}_mm"] for axis in "xyz"] == ["2.400", "-1.800", "0.000"]
    assert [float(moved[f"d{axis}_mm"]) for axis in "xyz"] == [2.4, -1.8, 0.0]
    assert float(moved["distance_mm"]) == 3.0
    assert float(moved["position_diameter_mm"]) == 6.0
    assert float(moved["measured_x_mm"]) - float(moved["nominal_x_mm"]) == pytest.approx(2.4, abs=6e-4)
    assert (rows[2]["dz_mm"], rows[2]["measured_z_mm"], rows[2]["position_diameter_mm"]) == ("", "", "")
    assert (rows[3]["finding"], rows[3]["distance_mm"], rows[3]["verdict"]) == ("missing", "", "fail")
    assert rows[4]["verdict"] == "not_measured"


def test_csv_starts_no_formula(model: Model) -> None:
    one = inspection(model, (), serial="=HYPERLINK()")
    one = replace(one, components=(deviation("block_1", (-1.0, 0, 0), np.zeros(3)),))
    row = next(csv.DictReader(io.StringIO(to_csv(one))))
    assert row["serial"] == "'=HYPERLINK()"
    assert row["dx_mm"] == "-1.000"  # numbers are not escaped


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


def _whole_inspections(model: Model, found: Inspection) -> dict[str, Inspection]:
    """Inspections of every verdict, of no tolerance, of a file of version 1.0, and of no component."""
    center = np.array([61.999999, 0.1 + 0.2, -1e-9])
    good = deviation("block_1", (0.03, -0.02, 0.01), center, turn_deg=0.7, angle_tolerance_deg=1.0)
    old = tuple(replace(one, details=None) for one in found.components)
    return {
        "fail, missing, undecided, not measured": found,
        "pass": replace(found, components=(good,), foreign_objects=()),
        "undecided": replace(found, components=(found.components[2],), serial=""),
        "missing": replace(found, components=(replace(found.components[3], tolerance_mm=None),)),
        "not measured": replace(found, components=(found.components[4],)),
        "no tolerance": replace(found, components=(deviation("block_1", (0.1, 0.0, 0.0), center, None),)),
        "version 1.0": replace(found, components=old, datum_system=None),
        "no component": replace(found, components=()),
    }


@pytest.mark.shared
@pytest.mark.slow
def test_qif_is_valid_by_the_published_schema(model: Model, found: Inspection) -> None:
    file = SHARED / "qif3" / "QIFApplications" / "QIFDocument.xsd"
    if not file.is_file():
        pytest.skip(f"{file} is not here")
    schema = etree.XMLSchema(etree.parse(file))
    for name, one in _whole_inspections(model, found).items():
        document = etree.fromstring(to_qif(one))
        assert schema.validate(document), f"{name}: {schema.error_log}"
    # The schema notices a reference that leads nowhere.
    document = etree.fromstring(to_qif(found))
    document.find(".//q:CharacteristicItemId", Q).text = "99999"
    assert not schema.validate(document)


def test_a_missing_component_fails_in_qif_and_dfq_even_without_a_tolerance(model: Model, found: Inspection) -> None:
    gone = _whole_inspections(model, found)["missing"]
    document = etree.fromstring(to_qif(gone))
    results = _qif_results(document)
    status, value = results["block_4 presence"]
    assert (status, value.text) == ("FAIL", "missing")
    assert document.findtext(".//q:FailValues/q:StringValue", namespaces=Q) == "missing"
    fields = _dfq(to_dfq(gone))
    number = next(key for key, text in fields.items() if text == "block_4.presence").split("/")[1]
    assert (fields[f"K2004/{number}"], fields[f"K2005/{number}"]) == ("1", "3")
    assert (fields[f"K0020/{number}"], fields[f"K0021/{number}"]) == ("1", "1")
    assert fields[f"K0014/{number}"] == "SN-7"
    assert fields[f"K0009/{number}"] == "missing"
    whole = _dfq(to_dfq(found))
    errors = {whole[f"K2001/{key.split('/')[1]}"]: text for key, text in whole.items() if key.startswith("K0021/")}
    assert errors == {f"block_{i}.presence": "1" if i == 4 else "0" for i in (1, 2, 3, 4)}  # the plate is unknown


def test_numbers_are_rounded_to_what_u_allows(model: Model, tmp_path: Path) -> None:
    center = np.array([61.999999, 0.1 + 0.2, -1e-9])
    rough = inspection(model, (deviation("block_1", (0.1234567, -0.0000001, 0.0), center, 0.3, 0.04567),))
    row = next(csv.DictReader(io.StringIO(to_csv(rough))))
    assert [row[f"nominal_{axis}_mm"] for axis in "xyz"] == ["62", "0.3", "0"]
    assert [row[f"measured_{axis}_mm"] for axis in "xyz"] == ["62.123", "0.300", "0.000"]
    assert [row[f"d{axis}_mm"] for axis in "xyz"] == ["0.123", "0.000", "0.000"]
    assert (row["distance_mm"], row["U_mm"], row["tolerance_mm"]) == ("0.123", "0.046", "0.3")
    fields = _dfq(to_dfq(rough))
    assert (fields["K0001/1"], fields["K2111/1"], fields["K2022/1"]) == ("0.123", "0.3", "3")
    assert fields["K0009/1"] == "U = 0.046 mm; pass"
    document = etree.fromstring(to_qif(rough))
    assert document.findtext(".//q:TargetValue", namespaces=Q) == "62"
    results = _qif_results(document)
    assert (results["block_1 place x"][1].text, results["block_1 position"][1].text) == ("62.123", "0.247")
    assert not {word for word in to_qif(rough).decode().split(">") if "999999" in word}
    save_inspection(rough, tmp_path / "inspection.json")
    assert "0.1234567" in (tmp_path / "inspection.json").read_text(encoding="utf-8")
    assert "61.999999" in (tmp_path / "inspection.json").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("uncertainty", "decimals"),
    [(0.04567, 3), (0.0994, 3), (0.0996, 2), (0.2, 2), (1.0, 1), (12.0, 0), (340.0, 0), (1e-9, 6), (None, 4), (0.0, 4)],
)
def test_decimals_of_an_uncertainty(uncertainty: float | None, decimals: int) -> None:
    assert decimals_of(uncertainty) == decimals


def test_rounding_moves_no_value_over_its_limit() -> None:
    assert decimals_beside_limit(0.5004, 0.2, 0.5) == 4
    assert decimals_beside_limit(0.4996, 0.2, 0.5) == 2  # 0.50 is within 0.5
    assert decimals_beside_limit(0.7, 0.2, 0.5) == 2
    assert [fixed(-0.0004, 3), fixed(-0.0006, 3)] == ["0.000", "-0.001"]
    numbers = {61.9999999: "62", 0.05: "0.05", 100.0: "100", 0.00002: "0.00002", -0.0: "0"}
    assert {value: exact(value) for value in numbers} == numbers


def test_one_fingerprint_everywhere(model: Model, found: Inspection, tmp_path: Path) -> None:
    source = tmp_path / "inspection.json"
    save_inspection(found, source)
    by_hand = json.loads(source.read_text(encoding="utf-8"))
    by_hand["components"][0]["tolerance_mm"] = 1  # an integer, in another order and layout
    other = tmp_path / "by_hand.json"
    other.write_text(json.dumps(by_hand, sort_keys=True), encoding="utf-8")
    for file in (source, other):
        with HistoryStore(tmp_path / "results.sqlite") as store:
            sha256 = store.add(file).content_hash
        done = CliRunner().invoke(main, ["export", str(file), "--to", "csv,qif,dfq"])
        assert done.exit_code == 0, done.output
        assert gather(file).sha256 == fingerprint_of_file(file) == sha256
        for kind in ("csv", "qif", "dfq"):
            assert sha256.encode() in file.with_suffix(f".{kind}").read_bytes(), kind
    assert fingerprint(found) == fingerprint_of_file(source)
    tree, _ = _glb(to_glb(found, model))
    assert tree["scenes"][0]["extras"]["inspection_sha256"] == fingerprint(found)


def test_qif_values_and_status(found: Inspection) -> None:
    document = etree.fromstring(to_qif(found))
    results = _qif_results(document)
    status, value = results["block_2 position"]
    assert (status, float(value.text)) == ("FAIL", 6.0)
    assert float(value.get("combinedUncertainty")) == pytest.approx(0.06)  # of a diameter: twice U / k
    place = found.components[1].details
    assert place is not None
    status, value = results["block_2 place x"]
    assert (status, float(value.text)) == ("BASIC_OR_TED", pytest.approx(place.center_mm[0] + 2.4, abs=6e-4))
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
    assert fields["K0100"] == "30"
    assert (fields["K1001"], fields["K1204"]) == ("bench", "01.03.2026")
    numbers = {fields[key]: key.split("/")[1] for key in fields if key.startswith("K2001/")}
    distance = numbers["block_2.distance"]
    assert fields[f"K0001/{distance}"] == "3.000"
    assert (fields[f"K2110/{distance}"], fields[f"K2111/{distance}"]) == ("0", "0.5")
    assert (fields[f"K2120/{distance}"], fields[f"K2121/{distance}"]) == ("2", "1")  # 0 is a natural limit
    assert fields[f"K0004/{distance}"] == "01.03.2026/12:30:15"
    assert fields[f"K0014/{distance}"] == "SN-7"
    assert fields[f"K0001/{numbers['block_2.dy']}"] == "-1.800"
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
    ) == run_path(str(ROOT / "tools" / "docs" / "schema_page.py"))["schema_markdown"]()


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
        (["--to", "xls"], "expected some of csv,characteristics,qif,dfq,glb,html,pdf"),
        (["--to", "csv,qif", "-o", str(tmp_path / "one.csv")], "2 formats need a folder"),
        (["--to", "csv", "-o", str(source)], "would overwrite an input"),
    ):
        refused = CliRunner().invoke(main, ["export", str(source), *arguments])
        assert refused.exit_code == 64
        assert message in refused.output
        assert "Traceback" not in refused.output
