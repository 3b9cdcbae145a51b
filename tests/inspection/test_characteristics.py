"""Characteristics of the drawing in the record, the summary, CSV, QIF, DFQ and the report."""

from __future__ import annotations

import csv
import io
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from lxml import etree

from arview.errors import InputError
from arview.inspection import CharacteristicResult, Inspection, Verdict, save_inspection, to_csv, to_dfq, to_qif
from arview.inspection.summary import overall_verdict, verdict_sentence
from arview.report import make_report
from helpers.inspections import deviation
from helpers.inspections import inspection as inspection_of
from helpers.paths import SHARED
from helpers.photo_scene import bench

Q = {"q": "http://qifstandards.org/xsd/qif3"}
ZONED = CharacteristicResult(
    "bore <1>", "position", ("bore_1",), Verdict.PASS, value_mm=0.4213, uncertainty_mm=0.031, zone_mm=0.6,
    zone="diameter", bonus_mm=0.1, datums=("A", "B(M)"), point_mm=(1.0, 2.0, 3.0), source="drawing 4711",
)  # fmt: skip
SIZED = CharacteristicResult(
    "width", "size", ("bore_1",), Verdict.FAIL, value_mm=12.2104, uncertainty_mm=0.02, limits_mm=(11.9, 12.1),
    nominal_mm=12.0,
)  # fmt: skip
ONE_SIDED = CharacteristicResult(
    "gap", "gap", ("left", "right"), Verdict.UNDECIDED, value_mm=0.305, uncertainty_mm=0.01, limits_mm=(0.3, None),
    notes=("left as a whole was measured: its shape is taken to be that of the CAD",),
)  # fmt: skip
UNSEEN = CharacteristicResult(
    "tilt", "perpendicularity", ("bore_1",), Verdict.NOT_MEASURED, zone_mm=0.1, zone="diameter", datums=("A",),
    reason="bore_1: what was seen of it does not determine its tilt",
)  # fmt: skip
OTHERS = tuple(
    CharacteristicResult(kind, kind, ("top",), Verdict.PASS, value_mm=0.05, uncertainty_mm=0.01, zone_mm=0.2)
    for kind in ("profile", "flatness", "parallelism", "angularity")
)


@pytest.fixture(scope="module")
def found() -> Inspection:
    one = inspection_of(bench(), (deviation("block_1", (0.1, 0.0, 0.0), np.zeros(3)),))
    return replace(one, characteristics=(ZONED, SIZED, ONE_SIDED, UNSEEN, *OTHERS))


def test_values_have_the_decimals_that_their_uncertainty_allows() -> None:
    assert (ZONED.value_text, ZONED.allowed_text) == ("⌀0.421", "⌀0.6")
    assert (SIZED.value_text, SIZED.allowed_text) == ("12.210", "11.9 to 12.1")
    assert (ONE_SIDED.value_text, ONE_SIDED.allowed_text) == ("0.305", "≥ 0.3")
    assert (UNSEEN.value_text, UNSEEN.allowed_text) == ("not measured", "⌀0.1")
    assert ZONED.excess_mm == pytest.approx(-0.1787) and SIZED.excess_mm == pytest.approx(0.1104)


def test_they_decide_about_the_part(found: Inspection) -> None:
    assert overall_verdict(found) is Verdict.FAIL
    assert overall_verdict(replace(found, characteristics=(ZONED, UNSEEN))) is Verdict.UNDECIDED
    assert overall_verdict(replace(found, characteristics=(ZONED,))) is Verdict.PASS
    assert verdict_sentence(found) == (
        "1 component: 1 in tolerance; 8 characteristics: 1 out of tolerance, 1 undecided, 1 not measured,"
        " 5 in tolerance"
    )


def test_csv_has_a_line_for_each(found: Inspection) -> None:
    rows = list(csv.DictReader(io.StringIO(to_csv(found, of="characteristics"))))
    assert [row["characteristic"] for row in rows[:4]] == ["bore <1>", "width", "gap", "tilt"]
    assert (rows[0]["value_mm"], rows[0]["U_mm"], rows[0]["zone"], rows[0]["zone_mm"], rows[0]["datums"]) == (
        "0.421", "0.031", "diameter", "0.6", "A B(M)",
    )  # fmt: skip
    assert (rows[1]["min_mm"], rows[1]["max_mm"], rows[1]["nominal_mm"], rows[1]["zone"]) == ("11.9", "12.1", "12", "")
    assert (rows[3]["value_mm"], rows[3]["verdict"]) == ("", "not_measured") and "tilt" in rows[3]["reason"]
    assert "characteristic" not in to_csv(found).splitlines()[0]


def test_csv_for_spreadsheets_with_decimal_commas(found: Inspection) -> None:
    rows = list(csv.DictReader(io.StringIO(to_csv(found, of="characteristics", decimal=",")), delimiter=";"))
    assert (rows[0]["value_mm"], rows[0]["zone_mm"], rows[0]["datums"]) == ("0,421", "0,6", "A B(M)")
    whole = list(csv.DictReader(io.StringIO(to_csv(found, decimal=",")), delimiter=";"))
    assert whole[0]["distance_mm"].startswith("0,1") and "." not in whole[0]["distance_mm"]


def test_dfq_has_both_limits(found: Inspection) -> None:
    fields = dict(line.split(" ", 1) for line in to_dfq(found).decode("cp1252", "replace").splitlines() if " " in line)
    index = next(key.split("/")[1] for key, value in fields.items() if key.startswith("K2001/") and value == "width")
    assert (fields[f"K2110/{index}"], fields[f"K2111/{index}"], fields[f"K0001/{index}"][:5]) == (
        "11.9",
        "12.1",
        "12.21",
    )
    assert fields[f"K2120/{index}"] == fields[f"K2121/{index}"] == "1"
    index = next(key.split("/")[1] for key, value in fields.items() if key.startswith("K2001/") and value == "tilt")
    assert f"K0001/{index}" not in fields and fields[f"K2111/{index}"] == "0.1"


def test_qif_names_each_by_its_kind(found: Inspection) -> None:
    document = etree.fromstring(to_qif(found))
    position = document.xpath("//q:PositionCharacteristicDefinition[q:ZoneShape/q:DiametricalZone]", namespaces=Q)[0]
    assert [child.text for child in position[:2]] == ["0.5", "MAXIMUM"]
    diameter = document.xpath("//q:DiameterCharacteristicDefinition/q:Tolerance", namespaces=Q)[0]
    assert [child.text for child in diameter] == ["12.1", "11.9", "true"]
    values = document.xpath("//q:DiameterCharacteristicMeasurement/q:Value/text()", namespaces=Q)
    assert values == ["12.210"]
    assert len(document.xpath("//q:PerpendicularityCharacteristicMeasurement[not(q:Value)]", namespaces=Q)) == 1


@pytest.mark.shared
def test_qif_is_valid_by_the_published_schema(found: Inspection) -> None:
    schema = etree.XMLSchema(etree.parse(SHARED / "qif3" / "QIFApplications" / "QIFDocument.xsd"))
    document = etree.fromstring(to_qif(found))
    assert schema.validate(document), schema.error_log


def test_the_report_has_what_matters_most_first(found: Inspection, tmp_path: Path) -> None:
    save_inspection(found, tmp_path / "inspection.json")
    make_report(tmp_path / "inspection.json", tmp_path / "report.html", None, None)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    table = page[page.index('<section id="characteristics">') :]
    names = re.findall(r'<th scope="row">([^<]*)</th>', table)
    assert names[:3] == ["width", "tilt", "gap"] and "bore &lt;1&gt;" in names[3:]
    assert "⌀0.421" in table and "A | B(M)" in table and "drawing 4711" in table
    summary = page[page.index('<section id="summary">') : page.index('<section id="components">')]
    assert "12.210 mm, allowed 11.9 to 12.1 mm" in summary


def test_a_first_article_form_has_a_line_for_each(found: Inspection, tmp_path: Path) -> None:
    """In the order of the part file; a template of one's own is used in the same way, and a wrong one is refused."""
    save_inspection(replace(found, drawing="4711-02 rev. C"), tmp_path / "inspection.json")
    page = tmp_path / "form.html"
    make_report(tmp_path / "inspection.json", page, None, None, template="first-article")
    text = page.read_text(encoding="utf-8")
    assert re.findall(r"<tr><td>(\d)</td>", text) == [str(number) for number in range(1, 9)]
    assert "4711-02 rev. C" in text and "bore &lt;1&gt;: ⌀0.6 | A | B(M)" in text
    own = tmp_path / "own.html"
    own.write_text("{{ drawing }}: {{ numbered|length }}")
    make_report(tmp_path / "inspection.json", page, None, None, template=own)
    assert page.read_text() == "4711-02 rev. C: 8"
    own.write_text("{{ nothing() }}")
    with pytest.raises(InputError, match=r"own\.html: cannot be used as a template: 'nothing' is undefined"):
        make_report(tmp_path / "inspection.json", page, None, None, template=own)
    own.write_text("{% if %}")
    with pytest.raises(InputError, match=r"own\.html: cannot be used as a template"):
        make_report(tmp_path / "inspection.json", page, None, None, template=own)
