"""Q-DAS ASCII transfer format (AQDEF), DFQ: description and values as K-fields in one file.

The characteristics of each component are its distance from the design position (one-sided with natural limit 0), dx,
dy, dz, the tilt, and its presence: an attribute with one error for a missing component and none for one that is there.
The characteristics of the drawing follow with both limits.
The characteristic of an undetermined value has no value, nor has the presence of a component that was not measured.
"""

from __future__ import annotations

from dataclasses import dataclass

from arview.inspection.fingerprint import fingerprint
from arview.inspection.record import CharacteristicResult, ComponentDeviation, Inspection
from arview.inspection.rounding import decimals_beside_limit, decimals_of, exact, fixed

_LIMIT, _NATURAL_LIMIT = "1", "2"
"""Values of K2120 and K2121, the kinds of the lower and upper limit."""
_VARIABLE, _ATTRIBUTE = "0", "1"
"""Values of K2004, the type of the characteristic."""
_CLASS_SIGNIFICANT = "3"
"""Value of K2005, the class of the characteristic."""


@dataclass(frozen=True)
class _Characteristic:
    number: str
    description: str
    unit: str
    decimals: int
    upper: float | None
    is_length_from_zero: bool
    value: float | None
    remark: str = ""
    is_present: bool | None = None
    is_attribute: bool = False
    lower: float | None = None


def to_dfq(inspection: Inspection, sha256: str | None = None) -> bytes:
    """The inspection as DFQ: one part, with six characteristics for each component and one value for each of them.

    The encoding is Windows-1252 if possible, else UTF-8 with a byte order mark. Times are UTC.

    Args:
        inspection: the inspection.
        sha256: fingerprint of the file it was read from; default: that of the inspection.
    """
    sha256 = sha256 or fingerprint(inspection)
    rows = [row for component in inspection.components for row in _characteristics(component)]
    rows += [_of_drawing(one) for one in inspection.characteristics]
    source = inspection.provenance
    fields: list[tuple[str, str]] = [
        ("K0100", str(len(rows))),
        ("K1001", inspection.part),
        ("K1002", inspection.part),
        ("K1202", f"{source.tool} {source.version}"),
        ("K1203", "position of components against the CAD"),
        ("K1204", inspection.created.strftime("%d.%m.%Y")),
        ("K1900", f"times in UTC; CAD sha256 {inspection.model_hash}; inspection sha256 {sha256}"),
    ]
    for index, row in enumerate(rows, 1):
        fields += _description(index, row)
    moment = inspection.created.strftime("%d.%m.%Y/%H:%M:%S")
    for index, row in enumerate(rows, 1):
        value = _value(index, row)
        if not value:
            continue
        fields += [*value, (f"K0002/{index}", "0"), (f"K0004/{index}", moment)]
        if row.remark:
            fields.append((f"K0009/{index}", row.remark))
        if inspection.serial:
            fields.append((f"K0014/{index}", inspection.serial))
    text = "".join(f"{key} {_line(value)}\r\n" for key, value in fields)
    try:
        return text.encode("cp1252")
    except UnicodeEncodeError:
        return text.encode("utf-8-sig")


def _characteristics(one: ComponentDeviation) -> list[_Characteristic]:
    u = one.uncertainty_mm
    decimals = decimals_of(u)
    remark = one.verdict.value if u is None else f"U = {fixed(u, decimals)} mm; {one.verdict.value}"
    limit = None if one.details is None else one.details.angle_tolerance_deg
    angle_u = None if one.details is None else one.details.angle_uncertainty_deg
    distance_decimals = decimals_beside_limit(one.distance_mm or 0.0, u, one.tolerance_mm)
    tilt_decimals = 3 if angle_u is None else decimals_beside_limit(one.tilt_deg or 0.0, angle_u, limit)
    return [
        _Characteristic(
            f"{one.name}.distance",
            f"{one.name} distance from design place",
            "mm",
            decimals=distance_decimals,
            upper=one.tolerance_mm,
            is_length_from_zero=True,
            value=one.distance_mm,
            remark=remark,
        ),
        *(
            _Characteristic(f"{one.name}.d{axis}", f"{one.name} d{axis}", "mm", decimals, None, False, value)
            for axis, value in zip("xyz", one.displacement_mm, strict=True)
        ),
        _Characteristic(f"{one.name}.tilt", f"{one.name} tilt", "deg", tilt_decimals, limit, True, one.tilt_deg),
        _Characteristic(
            f"{one.name}.presence",
            f"{one.name} is present",
            "",
            decimals=0,
            upper=None,
            is_length_from_zero=False,
            value=None,
            remark="missing" if one.is_present is False else "",
            is_present=one.is_present,
            is_attribute=True,
        ),
    ]


def _of_drawing(one: CharacteristicResult) -> _Characteristic:
    """A characteristic of the drawing; the size of a zone cannot be below 0."""
    decimals = decimals_of(one.uncertainty_mm)
    u = "" if one.uncertainty_mm is None else f"U = {fixed(one.uncertainty_mm, decimals)} mm; "
    lower, upper = one.range_mm
    return _Characteristic(
        one.name,
        f"{one.kind} of {', '.join(one.of)}",
        "mm",
        decimals,
        upper,
        is_length_from_zero=one.zone_mm is not None,
        value=one.value_mm,
        remark=u + one.verdict.value,
        lower=lower,
    )


def _value(index: int, row: _Characteristic) -> list[tuple[str, str]]:
    """The fields of a value: a number, or for an attribute the sample size and the number of errors in it."""
    if row.is_attribute:
        if row.is_present is None:
            return []
        return [(f"K0020/{index}", "1"), (f"K0021/{index}", "0" if row.is_present else "1")]
    return [] if row.value is None else [(f"K0001/{index}", fixed(row.value, row.decimals))]


def _description(index: int, row: _Characteristic) -> list[tuple[str, str]]:
    has_limit = row.upper is not None or row.lower is not None or row.is_attribute
    fields = [
        ("K2001", row.number),
        ("K2002", row.description),
        ("K2004", _ATTRIBUTE if row.is_attribute else _VARIABLE),
        ("K2005", _CLASS_SIGNIFICANT if has_limit else "0"),
    ]
    if not row.is_attribute:
        fields += [("K2022", str(row.decimals)), ("K2101", "0")]
        if row.is_length_from_zero:
            fields += [("K2110", "0"), ("K2120", _NATURAL_LIMIT)]
        if row.lower is not None:
            fields += [("K2110", exact(row.lower)), ("K2120", _LIMIT)]
        if row.upper is not None:
            fields += [("K2111", exact(row.upper)), ("K2121", _LIMIT)]
        fields.append(("K2142", row.unit))
    return [(f"{key}/{index}", value) for key, value in fields]


def _line(text: str) -> str:
    """A text as one line without control characters, which separate values in DFQ."""
    return " ".join("".join(c if c >= " " else " " for c in text).split())
