"""Q-DAS ASCII transfer format (AQDEF), DFQ: description and values as K-fields in one file.

The characteristics of each component are its distance from the design position (one-sided with natural limit 0), dx,
dy, dz and the tilt. The characteristic of an undetermined value has no value.
"""

from __future__ import annotations

from dataclasses import dataclass

from arview.inspection.record import ComponentDeviation, Inspection

_LIMIT, _NATURAL_LIMIT = "1", "2"
"""Values of K2120 and K2121, the kinds of the lower and upper limit."""
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


def to_dfq(inspection: Inspection) -> bytes:
    """The inspection as DFQ: one part, with five characteristics for each component and one value for each of them.

    The encoding is Windows-1252 if possible, else UTF-8 with a byte order mark. Times are UTC.
    """
    rows = [row for component in inspection.components for row in _characteristics(component)]
    source = inspection.provenance
    fields: list[tuple[str, str]] = [
        ("K0100", str(len(rows))),
        ("K1001", inspection.part),
        ("K1002", inspection.part),
        ("K1202", f"{source.tool} {source.version}"),
        ("K1203", "position of components against the CAD"),
        ("K1204", inspection.created.strftime("%d.%m.%Y")),
        ("K1900", f"times in UTC; CAD sha256 {inspection.model_hash}"),
    ]
    for index, row in enumerate(rows, 1):
        fields += _description(index, row)
    moment = inspection.created.strftime("%d.%m.%Y/%H:%M:%S")
    for index, row in enumerate(rows, 1):
        if row.value is None:
            continue
        fields += [(f"K0001/{index}", f"{row.value:.{row.decimals}f}"), (f"K0002/{index}", "0"),
                   (f"K0004/{index}", moment)]  # fmt: skip
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
    uncertainty = "" if one.uncertainty_mm is None else f"U = {one.uncertainty_mm:.4f} mm; {one.verdict.value}"
    rows = [
        _Characteristic(
            f"{one.name}.distance", f"{one.name} distance from design place", "mm", 4, one.tolerance_mm, True,
            one.distance_mm, uncertainty,
        )
    ]  # fmt: skip
    for axis, value in zip("xyz", one.displacement_mm, strict=True):
        rows.append(_Characteristic(f"{one.name}.d{axis}", f"{one.name} d{axis}", "mm", 4, None, False, value))
    limit = None if one.details is None else one.details.angle_tolerance_deg
    rows.append(_Characteristic(f"{one.name}.tilt", f"{one.name} tilt", "deg", 3, limit, True, one.tilt_deg))
    return rows


def _description(index: int, row: _Characteristic) -> list[tuple[str, str]]:
    fields = [
        ("K2001", row.number),
        ("K2002", row.description),
        ("K2004", "0"),  # variable
        ("K2005", _CLASS_SIGNIFICANT if row.upper is not None else "0"),
        ("K2022", str(row.decimals)),
        ("K2101", f"{0.0:.{row.decimals}f}"),
    ]
    if row.is_length_from_zero:
        fields += [("K2110", f"{0.0:.{row.decimals}f}"), ("K2120", _NATURAL_LIMIT)]
    if row.upper is not None:
        fields += [("K2111", f"{row.upper:.{row.decimals}f}"), ("K2121", _LIMIT)]
    fields.append(("K2142", row.unit))
    return [(f"{key}/{index}", value) for key, value in fields]


def _line(text: str) -> str:
    """A text as one line without control characters, which separate values in DFQ."""
    return " ".join("".join(c if c >= " " else " " for c in text).split())
