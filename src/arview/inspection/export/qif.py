"""QIF 3.0 results (ISO 23952, DMSC): characteristics with their nominal and measured values.

The position of the centre of a component is a position characteristic with a spherical zone, whose diameter is twice
the tolerance. Its x, y, z are linear coordinate characteristics without tolerance. Its rotation is a user-defined
angular characteristic, and its presence a user-defined attribute: so a missing component fails even without a
tolerance. The characteristics are evaluated by ISO 1101:2017. Structure and order of the elements follow
QIFDocument.xsd, QIFResults.xsd, Characteristics.xsd, Units.xsd and PrimitivesPMI.xsd of QIF 3.0.0.
"""

from __future__ import annotations

import uuid
from typing import Any

from lxml import etree

from arview.inspection.fingerprint import fingerprint
from arview.inspection.record import CharacteristicResult, ComponentDeviation, Finding, Inspection, Verdict
from arview.inspection.rounding import decimals_beside_limit, decimals_of, exact, fixed
from arview.inspection.summary import overall_verdict

NAMESPACE = "http://qifstandards.org/xsd/qif3"
_OURS = uuid.UUID("6c0f8f2e-2f5c-4f0e-9a5d-1f7f0c1a5b11")
_STATUS = {
    Verdict.PASS: "PASS",
    Verdict.FAIL: "FAIL",
    Verdict.UNDECIDED: "INDETERMINATE",
    Verdict.MEASURED: "NOT_ANALYZED",
    Verdict.NOT_MEASURED: "NOT_ANALYZED",
}
_KINDS = {
    "position": "Position",
    "profile": "SurfaceProfile",
    "flatness": "Flatness",
    "perpendicularity": "Perpendicularity",
    "parallelism": "Parallelism",
    "angularity": "Angularity",
    "size": "Diameter",
    "distance": "UserDefinedLinear",
    "gap": "UserDefinedLinear",
    "flush": "UserDefinedLinear",
}
"""Elements of the characteristics of the drawing."""
_INSPECTION_STATUS = {
    Verdict.PASS: "PASS",
    Verdict.FAIL: "FAIL",
    Verdict.UNDECIDED: "UNKNOWN",
    Verdict.MEASURED: "NOT_CALCULATED",
    Verdict.NOT_MEASURED: "NOT_MEASURED",
}
_DIRECTION = ("XAXIS", "YAXIS", "ZAXIS")
_STANDARD = ("ISO", "1101", "2017", "Geometrical product specifications: geometrical tolerancing")
"""Organization, designator, year and title of the standard that defines the characteristics."""


def to_qif(inspection: Inspection, sha256: str | None = None) -> bytes:
    """The inspection as a QIF 3.0 document, UTF-8. The same inspection always yields the same document.

    Args:
        inspection: the inspection.
        sha256: fingerprint of the file it was read from; default: that of the inspection.
    """
    return _Document(inspection, sha256 or fingerprint(inspection)).encoded()


class _Document:
    """Builds the document; elements are numbered in the order of their creation."""

    def __init__(self, inspection: Inspection, sha256: str) -> None:
        self.inspection = inspection
        self.sha256 = sha256
        self._last_id = 0
        self.definitions: list[Any] = []
        self.nominals: list[Any] = []
        self.items: list[Any] = []
        self.measurements: list[Any] = []
        self._positions: dict[float, str] = {}
        self._coordinates = ""
        self._angles: dict[float | None, str] = {}
        self._presence = ""
        self._standard_id = self._next_id()
        self.actual_id = self._next_id()
        for component in inspection.components:
            self._add(component)
        for one in inspection.characteristics:
            self._add_of_drawing(one)

    def encoded(self) -> bytes:
        """The complete document as UTF-8."""
        results_id = self._next_id()
        root = etree.Element(_name("QIFDocument"), nsmap={None: NAMESPACE})
        root.set("versionQIF", "3.0.0")
        _add(root, "QPId", self._uuid("document"))
        header = _add(root, "Header")
        _add(header, "Description", self._description())
        _add(header, "Scope", "Results")
        self._standard(root)
        units = _add(_add(root, "FileUnits"), "PrimaryUnits")
        _unit(units, "AngularUnit", "radian", "degree", "0.017453292519943")
        _unit(units, "LinearUnit", "meter", "mm", "0.001")
        if self.items:
            characteristics = _add(root, "Characteristics")
            _add(characteristics, "FormalStandardId", self._standard_id)
            for name, members in (
                ("CharacteristicDefinitions", self.definitions),
                ("CharacteristicNominals", self.nominals),
                ("CharacteristicItems", self.items),
            ):
                _list(characteristics, name, members)
        self._results(_add(root, "Results"), results_id)
        root.set("idMax", str(self._last_id))
        return bytes(etree.tostring(root, xml_declaration=True, encoding="UTF-8", pretty_print=True))

    def _standard(self, root: Any) -> None:
        """Add the definition of the standard that the characteristics refer to."""
        organization, designator, year, title = _STANDARD
        standard = etree.Element(_name("Standard"), id=self._standard_id)
        _add(_add(standard, "Organization"), "StandardsOrganizationEnum", organization)
        _add(standard, "Designator", designator)
        _add(standard, "Year", year)
        _add(standard, "Title", title)
        _list(root, "StandardsDefinitions", [standard])

    def _results(self, results: Any, results_id: str) -> None:
        overall = _INSPECTION_STATUS[overall_verdict(self.inspection)]
        measured = etree.Element(_name("MeasurementResults"), id=results_id)
        _list(results, "MeasurementResultsSet", [measured])
        _add(measured, "ThisResultsInstanceQPId", self._uuid("results"))
        if self.measurements:
            _list(_add(measured, "MeasuredCharacteristics"), "CharacteristicMeasurements", self.measurements)
        _add(_add(measured, "InspectionStatus"), "InspectionStatusEnum", overall)
        reference = etree.Element(_name("Id"))
        reference.text = self.actual_id
        _list(measured, "ActualComponentIds", [reference])
        actual = etree.Element(_name("ActualComponent"), id=self.actual_id)
        if self.inspection.serial:
            _add(actual, "SerialNumber", self.inspection.serial)
        _add(_add(actual, "Status"), "InspectionStatusEnum", overall)
        sets = etree.Element(_name("ActualComponentSet"), n="1")
        sets.append(actual)
        _list(results, "ActualComponentSets", [sets])

    def _add(self, one: ComponentDeviation) -> None:
        k = 2.0 if one.details is None or one.details.k is None else one.details.k
        std = None if one.uncertainty_mm is None else one.uncertainty_mm / k
        if one.tolerance_mm is not None:
            item = self._item("Position", one.name, f"{one.name} position", self._position(one.tolerance_mm), [])
            value = None if one.distance_mm is None else 2.0 * one.distance_mm
            decimals = 0
            if None in one.displacement_mm:
                value = None  # a displacement along the undetermined axis would enlarge it
            if value is not None:
                diameter_u = None if one.uncertainty_mm is None else 2.0 * one.uncertainty_mm
                decimals = decimals_beside_limit(value, diameter_u, 2.0 * one.tolerance_mm)
            text = None if value is None else fixed(value, decimals)
            self._measurement("Position", item, _STATUS[one.verdict], text, None if std is None else 2.0 * std)
        self._add_coordinates(one)
        self._add_angle(one)
        self._add_presence(one)

    def _add_of_drawing(self, one: CharacteristicResult) -> None:
        """A characteristic of the drawing, with a definition of its own."""
        kind = _KINDS[one.kind]
        number, definition = self._definition(kind)
        if one.zone_mm is None:
            limits, tags = one.limits_mm[::-1], ("MaxValue", "MinValue")
            tolerance = _add(definition, "Tolerance")
            for tag, limit in zip(tags, limits, strict=True):
                if limit is not None:
                    _add(tolerance, tag, exact(limit))
            _add(tolerance, "DefinedAsLimit", "true")
            if kind == "UserDefinedLinear":
                _add(definition, "WhatToMeasure", f"{one.kind} of {' and '.join(one.of)}")
        else:
            _add(definition, "ToleranceValue", exact(one.zone_mm - one.bonus_mm))
            if kind not in ("Flatness", "SurfaceProfile"):
                _add(definition, "MaterialCondition", "MAXIMUM" if one.bonus_mm else "NONE")
                planes = "NonDiametricalZone" if kind == "Position" else "PlanarZone"
                shapes = {"sphere": "SphericalZone", "diameter": "DiametricalZone", "width": planes}
                _add(_add(definition, "ZoneShape"), shapes[one.zone])
        target = [("TargetValue", exact(one.nominal_mm))] if one.nominal_mm is not None else []
        item = self._item(kind, ", ".join(one.of), one.name, number, target)
        std = None if one.uncertainty_mm is None else one.uncertainty_mm / 2.0
        text = None if one.value_mm is None else one.value_text.lstrip("S⌀")
        self._measurement(kind, item, _STATUS[one.verdict], text, std)

    def _add_coordinates(self, one: ComponentDeviation) -> None:
        if not self._coordinates:
            self._coordinates, definition = self._definition("LinearCoordinate")
            _add(definition, "NonTolerance", "MEASURED")
        center = None if one.details is None else one.details.center_mm
        covariance = None if one.details is None else one.details.covariance
        decimals = decimals_of(one.uncertainty_mm)
        for axis, moved in enumerate(one.displacement_mm):
            nominal = 0.0 if center is None else center[axis]
            what = "deviation" if center is None else "place"
            more = [("TargetValue", exact(nominal)), ("Direction", _DIRECTION[axis])]
            item = self._item("LinearCoordinate", one.name, f"{one.name} {what} {'xyz'[axis]}", self._coordinates, more)
            status = _status_without_value(one) if moved is None else "BASIC_OR_TED"
            std = None if covariance is None else max(covariance[3 + axis][3 + axis], 0.0) ** 0.5
            text = None if moved is None else fixed(nominal + moved, decimals)
            self._measurement("LinearCoordinate", item, status, text, std)

    def _add_angle(self, one: ComponentDeviation) -> None:
        details = one.details
        if details is None or (details.angle_deg is None and details.angle_tolerance_deg is None):
            return
        limit = details.angle_tolerance_deg
        if limit not in self._angles:
            self._angles[limit], definition = self._definition("UserDefinedAngular")
            if limit is None:
                _add(definition, "NonTolerance", "MEASURED")
            else:
                tolerance = _add(definition, "Tolerance")
                _add(tolerance, "MaxValue", exact(limit))
                _add(tolerance, "DefinedAsLimit", "true")
            _add(definition, "WhatToMeasure", "angle of the determined rotation from the design orientation")
        item = self._item("UserDefinedAngular", one.name, f"{one.name} rotation", self._angles[limit], [])
        angle, uncertainty = details.angle_deg, details.angle_uncertainty_deg
        std = None if uncertainty is None else uncertainty / 2.0
        text = None if angle is None else fixed(angle, decimals_beside_limit(angle, uncertainty, limit))
        self._measurement("UserDefinedAngular", item, _angle_status(one), text, std)

    def _add_presence(self, one: ComponentDeviation) -> None:
        """Presence as an attribute: fails for a missing component, passes for one that was measured."""
        if not self._presence:
            self._presence, definition = self._definition("UserDefinedAttribute")
            _add(definition, "WhatToMeasure", "presence of the component")
        item = self._item("UserDefinedAttribute", one.name, f"{one.name} presence", self._presence, [])
        for tag, word in (("PassValues", "present"), ("FailValues", "missing")):
            value = etree.Element(_name("StringValue"))
            value.text = word
            _list(self.nominals[-1], tag, [value])
        is_present = one.is_present
        status = "NOT_ANALYZED" if is_present is None else "PASS" if is_present else "FAIL"
        text = None if is_present is None else "present" if is_present else "missing"
        self._measurement("UserDefinedAttribute", item, status, text, None)

    def _position(self, tolerance_mm: float) -> str:
        """Id of the definition of a position characteristic with this tolerance, which is added if needed."""
        if tolerance_mm not in self._positions:
            self._positions[tolerance_mm], definition = self._definition("Position")
            _add(definition, "ToleranceValue", exact(2.0 * tolerance_mm))
            _add(definition, "MaterialCondition", "NONE")
            _add(_add(definition, "ZoneShape"), "SphericalZone")
        return self._positions[tolerance_mm]

    def _definition(self, kind: str) -> tuple[str, Any]:
        number = self._next_id()
        definition = etree.Element(_name(f"{kind}CharacteristicDefinition"), id=number)
        self.definitions.append(definition)
        return number, definition

    def _item(self, kind: str, component: str, name: str, definition: str, more: list[tuple[str, str]]) -> str:
        """Add a nominal value of a definition and its item; returns the id of the item."""
        nominal = etree.Element(_name(f"{kind}CharacteristicNominal"), id=self._next_id())
        _add(nominal, "CharacteristicDefinitionId", definition)
        for tag, text in more:
            _add(nominal, tag, text)
        self.nominals.append(nominal)
        item = etree.Element(_name(f"{kind}CharacteristicItem"), id=self._next_id())
        _add(item, "Description", f"component {component}")
        _add(item, "Name", name)
        _add(item, "CharacteristicNominalId", str(nominal.get("id")))
        self.items.append(item)
        return str(item.get("id"))

    def _measurement(self, kind: str, item: str, status: str, value: str | None, std: float | None) -> None:
        one = etree.Element(_name(f"{kind}CharacteristicMeasurement"), id=self._next_id())
        _add(_add(one, "Status"), "CharacteristicStatusEnum", status)
        _add(one, "CharacteristicItemId", item)
        _add(one, "TimeStamp", self.inspection.created.strftime("%Y-%m-%dT%H:%M:%SZ"))
        _add(one, "ActualComponentId", self.actual_id)
        if kind == "LinearCoordinate":
            _add(_add(one, "TypeOfCoordinates"), "CoordinateEnum", "CARTESIAN_3D")
        if value is not None:
            element = _add(one, "Value", value)
            if std is not None:
                element.set("combinedUncertainty", fixed(std, decimals_of(std)))
                element.set("meanError", "0")
        self.measurements.append(one)

    def _description(self) -> str:
        source = self.inspection.provenance
        return _printable(
            f"part {self.inspection.part}, serial {self.inspection.serial or 'none'}, measured"
            f" {self.inspection.created:%Y-%m-%dT%H:%M:%SZ} by {source.tool} {source.version} ({source.method})"
            f" against CAD sha256 {self.inspection.model_hash}; inspection sha256 {self.sha256}"
        )

    def _uuid(self, what: str) -> str:
        one = self.inspection
        return str(uuid.uuid5(_OURS, f"{what}|{one.part}|{one.serial}|{one.model_hash}|{one.created.isoformat()}"))

    def _next_id(self) -> str:
        self._last_id += 1
        return str(self._last_id)


def _status_without_value(one: ComponentDeviation) -> str:
    """Status of a characteristic without a value."""
    if one.finding is Finding.MISSING or one.verdict is Verdict.NOT_MEASURED:
        return "NOT_ANALYZED"
    return "INDETERMINATE"


def _angle_status(one: ComponentDeviation) -> str:
    """Status of the rotation by the same decision rule as the position, with the full U as guard band."""
    assert one.details is not None
    limit, angle, uncertainty = (
        one.details.angle_tolerance_deg,
        one.details.angle_deg,
        one.details.angle_uncertainty_deg,
    )
    if angle is None:
        return _status_without_value(one)
    if limit is None:
        return "BASIC_OR_TED"
    if angle + (uncertainty or 0.0) <= limit:
        return "PASS"
    return "FAIL" if angle - (uncertainty or 0.0) > limit else "INDETERMINATE"


def _name(tag: str) -> str:
    return f"{{{NAMESPACE}}}{tag}"


def _add(parent: Any, tag: str, text: str | None = None) -> Any:
    child = etree.SubElement(parent, _name(tag))
    if text is not None:
        child.text = _printable(text)
    return child


def _list(parent: Any, tag: str, members: list[Any]) -> None:
    """Add a list element with its number of members, unless it is empty."""
    if members:
        holder = _add(parent, tag)
        holder.set("n", str(len(members)))
        holder.extend(members)


def _unit(parent: Any, tag: str, si_name: str, name: str, factor: str) -> None:
    unit = _add(parent, tag)
    _add(unit, "SIUnitName", si_name)
    _add(unit, "UnitName", name)
    _add(_add(unit, "UnitConversion"), "Factor", factor)


def _printable(text: str) -> str:
    """A text without the control characters that XML does not allow."""
    return "".join(c if c >= " " and c not in "\ufffe\uffff" else " " for c in text)
