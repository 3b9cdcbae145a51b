"""The record of an inspection: verdict and measured displacement of each component relative to the CAD model."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from html import escape
from typing import Any

from arview.cad import Model
from arview.errors import InputError, MismatchError
from arview.inspection.details import (
    DatumSystem,
    Details,
    DistanceReport,
    ForeignReport,
    Repeatability,
    to_json,
)
from arview.inspection.rounding import decimals_beside_limit, exact, fixed

SCHEMA_VERSION = "1.3"
READABLE_VERSIONS = ("1.0", "1.1", "1.2", "1.3")

ZONE_SIGN = {"diameter": "⌀", "sphere": "S⌀", "width": ""}
"""What stands before the size of a zone on a drawing (ISO 1101)."""
_COLUMNS = ("distance_mm", "uncertainty_mm", "tolerance_mm", "tilt_deg", "twist_deg")
_DISTANCE_SLACK_MM = 0.006
"""Tolerated difference between distance and displacement, which may both be rounded to 0.01 mm in a file."""


class Verdict(StrEnum):
    """Result of the decision rule for a component."""

    PASS = "pass"
    FAIL = "fail"
    UNDECIDED = "undecided"
    MEASURED = "measured"
    """Measured, but without a tolerance to judge it by."""
    NOT_MEASURED = "not_measured"


class Finding(StrEnum):
    """A finding other than a displacement."""

    MISSING = "missing"


class MeasuredPresence(StrEnum):
    """Whether a component was there when it was measured."""

    PRESENT = "present"
    MISSING = "missing"
    """What it would hide was seen."""
    NOT_SEEN = "not_seen"
    """Too few photos show its place."""
    UNKNOWN = "unknown"
    """Its place was seen, but neither the component nor its absence could be verified."""


class RecordError(InputError):
    """Contradictions in a record, each as a text that starts with the name of a field."""

    def __init__(self, faults: Sequence[str]) -> None:
        super().__init__("; ".join(faults))
        self.faults = tuple(faults)


@dataclass(frozen=True)
class ComponentDeviation:
    """The measured deviation of a component. Undetermined degrees of freedom are None.

    Attributes:
        name: name of the component in the model.
        displacement_mm: measured minus design position along x, y, z of the model; None where undetermined.
        distance_mm: length of the determined part of the displacement; None when nothing is determined.
        observable: whether the degrees of freedom are determined: rotation about x, y, z, translation along x, y, z
            (the order of a twist in `arview.geometry`).
        uncertainty_mm: expanded uncertainty U (k = 2) of ``distance_mm``; None when nothing is determined.
        tolerance_mm: largest distance allowed; None without a tolerance.
        verdict: result of the decision rule.
        tilt_deg: angle between measured and design axis of the component; None where undetermined.
        twist_deg: rotation about that axis; None where undetermined.
        finding: ``missing`` if the component is absent.
        presence: whether the component was there; None in files that do not say.
        details: details of the measurement; None in files of version 1.0.

    Raises:
        RecordError: fields contradict each other; each fault starts with the name of a field.
    """

    name: str
    displacement_mm: tuple[float | None, float | None, float | None]
    distance_mm: float | None
    observable: tuple[bool, bool, bool, bool, bool, bool]
    uncertainty_mm: float | None
    tolerance_mm: float | None
    verdict: Verdict
    tilt_deg: float | None = None
    twist_deg: float | None = None
    finding: Finding | None = None
    details: Details | None = None
    presence: MeasuredPresence | None = None

    @property
    def is_present(self) -> bool | None:
        """Whether the component is there: False if missing, True if anything of it was measured, None if unknown."""
        if self.finding is Finding.MISSING:
            return False
        return True if any(self.observable) or self.distance_mm is not None else None

    def to_dict(self) -> dict[str, Any]:
        """The entry of the component as JSON values, as in ``inspection.json``."""
        entry: dict[str, Any] = {
            "name": self.name,
            "displacement_mm": list(self.displacement_mm),
            "distance_mm": self.distance_mm,
        }
        if self.tilt_deg is not None or self.twist_deg is not None:
            entry["rotation"] = {"tilt_deg": self.tilt_deg, "twist_deg": self.twist_deg}
        entry |= {
            "observable": list(self.observable),
            "uncertainty_mm": self.uncertainty_mm,
            "tolerance_mm": self.tolerance_mm,
            "verdict": self.verdict.value,
        }
        if self.finding is not None:
            entry["finding"] = self.finding.value
        if self.presence is not None:
            entry["presence"] = self.presence.value
        if self.details is not None:
            entry["details"] = to_json(self.details)
        return entry

    @property
    def _determined_displacement(self) -> tuple[str, tuple[float | None, ...]]:
        """Field and values of the displacement along the component's own axes, or else along those of the model."""
        own = None if self.details is None else self.details.own_displacement_mm
        return ("displacement_mm", self.displacement_mm) if own is None else ("details.own_displacement_mm", own)

    @property
    def _has_angle_limit(self) -> bool:
        return self.details is not None and self.details.angle_tolerance_deg is not None

    def __post_init__(self) -> None:
        if shape := list(self._shape_faults()):
            raise RecordError(shape)
        faults = [*self._number_faults(), *self._observable_faults(), *self._distance_faults(), *self._verdict_faults()]
        if faults:
            raise RecordError(faults)

    def _shape_faults(self) -> Iterator[str]:
        if not self.name:
            yield "name: is empty"
        if len(self.displacement_mm) != 3 or len(self.observable) != 6:
            yield "displacement_mm: needs 3 values, and observable 6"

    def _number_faults(self) -> Iterator[str]:
        numbers = {f"displacement_mm[{i}]": value for i, value in enumerate(self.displacement_mm)}
        for field in ("distance_mm", "uncertainty_mm", "tolerance_mm", "tilt_deg", "twist_deg"):
            numbers[field] = getattr(self, field)
        for field, value in numbers.items():
            if value is not None and not math.isfinite(value):
                yield f"{field}: is {value}, expected a finite number or null"
            if field in ("distance_mm", "uncertainty_mm", "tolerance_mm", "tilt_deg") and (value or 0.0) < 0.0:
                yield f"{field}: is {value}, must not be negative"

    def _observable_faults(self) -> Iterator[str]:
        for axis, value, is_observable in zip("xyz", self.displacement_mm, self.observable[3:], strict=True):
            index = "xyz".index(axis)
            if value is not None and not is_observable:
                yield (
                    f"displacement_mm[{index}]: is {value}, but d{axis} is undetermined by observable[{index + 3}];"
                    " undetermined values must be null"
                )
            if value is None and is_observable:
                yield (f"displacement_mm[{index}]: is null, but d{axis} is determined by observable[{index + 3}]")
        own = None if self.details is None else self.details.own_rotation_deg
        is_turned = any(self.observable[:3]) if own is None else any(value is not None for value in own)
        if not is_turned and (self.tilt_deg is not None or self.twist_deg is not None):
            yield "rotation: is a number, but no rotation is determined by observable"

    def _distance_faults(self) -> Iterator[str]:
        where, values = self._determined_displacement
        known = [value for value in values if value is not None]
        if not known:
            if self.distance_mm is not None:
                yield f"distance_mm: is {self.distance_mm}, but no displacement is determined"
            return
        length = math.hypot(*known)
        if self.distance_mm is None:
            yield f"distance_mm: is null, but {where} has the length {length:.3f} mm"
        elif abs(self.distance_mm - length) > _DISTANCE_SLACK_MM + 1e-3 * length:
            yield f"distance_mm: is {self.distance_mm}, but {where} has the length {length:.3f} mm"
        if self.uncertainty_mm is None:
            yield "uncertainty_mm: is null, but a distance is given; a measured value needs its U"

    def _verdict_faults(self) -> Iterator[str]:
        if self.finding is Finding.MISSING:
            if self.verdict is not Verdict.FAIL:
                yield f"verdict: is {self.verdict}, but the component is missing; expected fail"
            if any(self.observable) or self.distance_mm is not None:
                yield "displacement_mm: a missing component has no displacement; expected nulls"
            if self.presence not in (None, MeasuredPresence.MISSING):
                yield f"presence: is {self.presence}, but the finding is missing"
            return
        if self.presence is MeasuredPresence.MISSING:
            yield "presence: is missing, but there is no such finding"
        if self.verdict is Verdict.NOT_MEASURED:
            if any(self.observable) or self.distance_mm is not None:
                yield "verdict: is not_measured, but the component has measured values"
        elif self.verdict is Verdict.MEASURED:
            if self.distance_mm is None:
                yield "distance_mm: is null, but the verdict is measured"
            if self.tolerance_mm is not None:
                yield f"verdict: is measured, but tolerance_mm is {self.tolerance_mm}; expected pass, fail or undecided"
        elif self.verdict in (Verdict.PASS, Verdict.FAIL) and self.tolerance_mm is None and not self._has_angle_limit:
            yield f"tolerance_mm: is null, but the verdict is {self.verdict}"
        if self.verdict is Verdict.PASS:
            if self.distance_mm is None:
                yield "distance_mm: is null, but the verdict is pass"
            elif self.tolerance_mm is not None and self.distance_mm > self.tolerance_mm:
                yield (f"verdict: is pass, but distance_mm {self.distance_mm} exceeds tolerance_mm {self.tolerance_mm}")


@dataclass(frozen=True)
class CharacteristicResult:
    """A requirement of the drawing, measured and judged.

    Attributes:
        name: as the part file has it.
        kind: position, profile, flatness, …, see `arview.cad.Characteristic`.
        of: names of its features or components.
        verdict: result of the decision rule; what could not be measured has no value and does not pass.
        value_mm: diameter or width of the smallest zone that holds them, or size, distance, gap or flush; None if it
            was not measured.
        uncertainty_mm: expanded uncertainty U (k = 2) of ``value_mm``, with that of the bonus.
        zone_mm: diameter or width that was allowed, bonus included; None for kinds with limits.
        zone: shape of the zone: diameter (of a cylinder), sphere, or width (between two planes).
        bonus_mm: share of ``zone_mm`` by which the feature is off maximum material.
        limits_mm: smallest and largest value allowed; None: not limited.
        nominal_mm: value of the design, of kinds with limits.
        datums: labels of its datums, ``B(M)`` at maximum material.
        components: names of the components that carry it.
        point_mm: (3,) where it is shown on the part, in the model.
        reason: why it was not measured; empty if it was.
        notes: what the value leaves out.
        source: where the requirement comes from.
    """

    name: str
    kind: str
    of: tuple[str, ...]
    verdict: Verdict
    value_mm: float | None = None
    uncertainty_mm: float | None = None
    zone_mm: float | None = None
    zone: str = "width"
    bonus_mm: float = 0.0
    limits_mm: tuple[float | None, ...] = (None, None)
    nominal_mm: float | None = None
    datums: tuple[str, ...] = ()
    components: tuple[str, ...] = ()
    point_mm: tuple[float, ...] = ()
    reason: str = ""
    notes: tuple[str, ...] = ()
    source: str = ""

    @property
    def range_mm(self) -> tuple[float | None, float | None]:
        """Smallest and largest value allowed; None: not limited."""
        low, high = self.limits_mm
        return (low, high) if self.zone_mm is None else (None, self.zone_mm)

    @property
    def excess_mm(self) -> float:
        """By how much the value is beyond its zone or limits, negative within; infinite if it was not measured."""
        low, high = self.range_mm
        value = math.inf if self.value_mm is None else self.value_mm
        return max(-math.inf if low is None else low - value, -math.inf if high is None else value - high)

    @property
    def value_text(self) -> str:
        """The value with its unit and the decimals that U allows, and enough to be on the right side of its limit."""
        if self.value_mm is None:
            return "not measured"
        limits = [limit for limit in self.range_mm if limit is not None]
        near = min(limits, key=lambda limit: abs(limit - (self.value_mm or 0.0)), default=None)
        decimals = decimals_beside_limit(self.value_mm, self.uncertainty_mm, near)
        return f"{ZONE_SIGN[self.zone] if self.zone_mm is not None else ''}{fixed(self.value_mm, decimals)}"

    @property
    def allowed_text(self) -> str:
        """The zone or the limits: ``⌀0.5``, ``11.9 to 12.1``, ``≥ 11.9``."""
        low, high = self.range_mm
        if self.zone_mm is not None:
            return f"{ZONE_SIGN[self.zone]}{exact(self.zone_mm)}"
        if low is not None and high is not None:
            return f"{exact(low)} to {exact(high)}"
        return f"≥ {exact(low)}" if low is not None else f"≤ {exact(high or 0.0)}"


@dataclass(frozen=True)
class Provenance:
    """The origin of the numbers.

    Attributes:
        tool, version: program that measured.
        method: measurement method.
        note: text that is shown with the overlay, e.g. "example, written by hand".
        photos_hash: SHA-256 (hexadecimal) of the photos; empty without photos.
        photos: number of photos.
        software: names and versions of the libraries.
        options: options of the measurement, by name.
        cpu_s: processor time.
    """

    tool: str
    version: str
    method: str
    note: str = ""
    photos_hash: str = ""
    photos: int = 0
    software: tuple[tuple[str, str], ...] = ()
    options: tuple[tuple[str, str], ...] = ()
    cpu_s: float | None = None


@dataclass(frozen=True)
class Inspection:
    """Measured deviations of one built part.

    Attributes:
        part: name of the part.
        serial: serial number of the part; may be empty.
        model_hash: ``Model.source_hash`` of the CAD model.
        created: time of the measurement, UTC.
        components: an entry for each inspected component; components of the model may be omitted.
        provenance: origin of the numbers.
        datum_system: the frame of the deviations; None in files of version 1.0.
        warnings: doubts about the inspection as a whole.
        foreign_objects: objects that are not in the CAD model, the largest first.
        distance_map: distances of the cloud to the CAD model, if there is a cloud.
        repeatability: comparison of two halves of the photos; None if it was not made.
        characteristics: requirements of the drawing, in the order of the part file.
        drawing: number and revision of the drawing; may be empty.

    Raises:
        InputError: a component appears twice, or ``created`` has no time zone.
    """

    part: str
    serial: str
    model_hash: str
    created: datetime
    components: tuple[ComponentDeviation, ...]
    provenance: Provenance
    datum_system: DatumSystem | None = None
    warnings: tuple[str, ...] = ()
    foreign_objects: tuple[ForeignReport, ...] = ()
    distance_map: DistanceReport | None = None
    repeatability: Repeatability | None = None
    characteristics: tuple[CharacteristicResult, ...] = ()
    drawing: str = ""

    def __post_init__(self) -> None:
        if self.created.utcoffset() != timedelta(0):
            raise InputError(f"created: {self.created.isoformat()} is not a UTC time")
        names: set[str] = set()
        for index, component in enumerate(self.components):
            if component.name in names:
                raise InputError(f"components[{index}].name: {component.name!r} appears twice")
            names.add(component.name)

    def __repr__(self) -> str:
        counts = Counter(component.verdict.value.replace("_", " ") for component in self.components)
        found = ", ".join(f"{count} {verdict}" for verdict, count in counts.most_common())
        return f"<Inspection {f'{self.part} {self.serial}'.rstrip()}: {found}>"

    def to_dict(self) -> dict[str, Any]:
        """The inspection as JSON values, as in ``inspection.json``."""
        source = self.provenance
        software, options = dict(source.software), dict(source.options)
        more: dict[str, Any] = {
            "photos_hash": source.photos_hash,
            "photos": source.photos,
            "software": software,
            "options": options,
            "cpu_s": source.cpu_s,
        }
        document: dict[str, Any] = {
            "schema_version": SCHEMA_VERSION,
            "part": self.part,
            "serial": self.serial,
            "model_hash": self.model_hash,
            "created": self.created.replace(tzinfo=None).isoformat() + "Z",
            "components": [component.to_dict() for component in self.components],
            "provenance": {
                "tool": source.tool,
                "version": source.version,
                "method": source.method,
                "note": source.note,
                **{key: value for key, value in more.items() if value},
            },
        }
        if self.drawing:
            document["drawing"] = self.drawing
        if self.characteristics:
            document["characteristics"] = to_json(self.characteristics)
        if self.datum_system is not None:
            document["datum_system"] = to_json(self.datum_system)
        if self.warnings:
            document["warnings"] = list(self.warnings)
        if self.foreign_objects:
            document["foreign_objects"] = to_json(self.foreign_objects)
        if self.distance_map is not None:
            document["distance_map"] = to_json(self.distance_map)
        if self.repeatability is not None:
            document["repeatability"] = to_json(self.repeatability)
        return document

    def to_table(self) -> list[dict[str, object]]:
        """A row for each component, as a data frame takes them; what was not determined is None."""
        return [
            {
                "component": one.name,
                **dict(zip(("dx_mm", "dy_mm", "dz_mm"), one.displacement_mm, strict=True)),
                **{name: getattr(one, name) for name in _COLUMNS},
                "verdict": one.verdict.value,
            }
            for one in self.components
        ]

    def _repr_html_(self) -> str:
        """The table, as notebooks show it."""
        rows = self.to_table()
        lines = [list(rows[0]) if rows else [], *([_cell(value) for value in row.values()] for row in rows)]
        table = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in line)}</tr>" for line in lines)
        return f"<p>{escape(f'{self.part} {self.serial}'.rstrip())}</p><table>{table}</table>"

    def find(self, name: str) -> ComponentDeviation | None:
        """The entry of the component with this name, or None if it was not inspected."""
        return next((component for component in self.components if component.name == name), None)

    def age_s(self, now: datetime | None = None) -> float:
        """Seconds from the measurement to ``now`` (default: the present time); negative if it is in the future."""
        return ((now or datetime.now(UTC)) - self.created).total_seconds()

    def check_model(self, model: Model) -> None:
        """Check that this is an inspection of ``model``.

        Raises:
            MismatchError: the inspection belongs to another geometry, or a component does not exist in the model.
        """
        faults = model_faults(self.model_hash, [component.name for component in self.components], model)
        if faults:
            raise MismatchError(f"the inspection of {self.part!r} {'; it '.join(faults)}")


def _cell(value: object) -> str:
    """A value of the table as HTML, numbers to a micrometre."""
    return "" if value is None else f"{value:.3f}" if isinstance(value, float) else escape(str(value))


def model_faults(model_hash: object, names: Sequence[str], model: Model) -> list[str]:
    """Why an inspection with this hash and these components is not of the model, as predicates of "the inspection"."""
    known = {component.name for component in model.components}
    unknown, faults = sorted(set(names) - known), []
    if unknown:
        faults.append(f"names {', '.join(map(repr, unknown))}, which model {model.name!r} does not have")
    if model_hash != model.source_hash:
        theirs = f"{model_hash[:12]}…" if isinstance(model_hash, str) and len(model_hash) > 12 else repr(model_hash)
        faults.append(
            f"was made against another model: model_hash {theirs}, model {model.name!r} has {model.source_hash}"
            " (other CAD file, revision, unit or tessellation)"
        )
    return faults
