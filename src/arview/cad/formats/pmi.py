"""Reader of product and manufacturing information (PMI) in STEP AP242: dimensions, tolerances and datums of faces.

Sources: ISO 10303-242; recommended practices of the CAx Implementor Forum for PMI.
"""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from arview.cad.formats.archive import unpacked
from arview.cad.formats.limited_process import ProcessLimits, run_limited
from arview.cad.formats.step_statements import references
from arview.cad.formats.step_text import checked_text
from arview.cad.part import Vector
from arview.core.extras import require
from arview.errors import InputError

LIMITS = ProcessLimits(cpu_s=15.0, memory_mb=3000.0)
_STATEMENT = re.compile(
    rb"#(\d+)\s*=\s*(DATUM|SHAPE_ASPECT_RELATIONSHIP|GEOMETRIC_ITEM_SPECIFIC_USAGE|ITEM_IDENTIFIED_REPRESENTATION_USAGE)"
    rb"\s*\(((?:'[^']*'|[^;'])*)\)\s*;"
)
_DRAWN = re.compile(rb"=\s*\(?\s*(?:TESSELLATED_)?ANNOTATION(?:_CURVE|_FILL_AREA|_SYMBOL|_TEXT)?_OCCURRENCE\b")
_BOUNDS = re.compile(rb"=\s*TOLERANCE_VALUE\s*\(\s*#(\d+)\s*,\s*#(\d+)\s*\)")
_MEASURE = re.compile(rb"#(\d+)\s*=\s*\(?[^;]*?MEASURE\s*\(\s*([-+.\dE]+)\s*\)")
_READ = """
from arview.cad.formats.pmi_document import write_pmi
write_pmi(*sys.argv[1:])
"""


@dataclass(frozen=True)
class PmiShape:
    """A face or edge at its place in the model, mm.

    Attributes:
        kind: plane, cylinder, edge (a straight one), or the name of another surface or curve.
        point_in_model: middle of a plane or edge; on the axis of a cylinder, at an end.
        direction_in_model: unit normal out of the material, or unit axis from that end into the cylinder; zero for
            other surfaces.
        diameter_mm: of a cylinder.
        length_mm: of a cylinder or edge.
        area_mm2: of a face.
        is_hole: the material is outside of the cylinder.
        corner_in_model: a corner of it; None where it has none.
    """

    kind: str
    point_in_model: Vector
    direction_in_model: Vector = (0.0, 0.0, 0.0)
    diameter_mm: float = 0.0
    length_mm: float = 0.0
    area_mm2: float = 0.0
    is_hole: bool = False
    corner_in_model: Vector | None = None


@dataclass(frozen=True)
class PmiRequirement:
    """A dimension or geometric tolerance.

    Attributes:
        name: in the file.
        kind: as OpenCASCADE calls it: Size_Diameter, Location_LinearDistance, Position, ProfileOfSurface, ….
        shapes: that it is about; of a distance those of its first end.
        others: of a distance, the shapes of its other end.
        value_mm: nominal value of a dimension, or width of the zone; None where there is none. Angles are in degrees.
        limits_mm: smallest and largest value of a dimension; None where the file has none.
        zone: None, Diameter or SphericalDiameter.
        modifiers: names of all that changes its meaning: M, L, All_Around, Free_State, theoretical, ….
        datums: letter, place in the order of precedence, and modifiers of each datum.
        place: of the part that carries it, from 0, where it stands at several places of the assembly.
    """

    name: str
    kind: str
    shapes: tuple[PmiShape, ...]
    others: tuple[PmiShape, ...] = ()
    value_mm: float | None = None
    limits_mm: tuple[float, float] | None = None
    zone: str = "None"
    modifiers: tuple[str, ...] = ()
    datums: tuple[tuple[str, int, tuple[str, ...]], ...] = ()
    place: int = 0


@dataclass(frozen=True)
class PmiTarget:
    """A datum target: its letter and number, its kind (point, line, circle, …), place and direction, mm."""

    letter: str
    number: int
    kind: str
    point_in_model: Vector
    direction_in_model: Vector


@dataclass(frozen=True)
class Pmi:
    """What a STEP file says of the accuracy of its parts.

    Attributes:
        counts: of dimensions (drawn ones, too), geometric tolerances, and references to datums in the file.
        dimensions: with a meaning, in the order of the file, once for each place of their part.
        tolerances: as ``dimensions``.
        datums: shapes of the feature of each datum by its letter, for each place of its part.
        targets: of the datums that are established from targets.
        ambiguous: letters of datums of several parts.
        drawn_count: annotations that are drawn.
    """

    counts: tuple[int, int, int]
    dimensions: tuple[PmiRequirement, ...]
    tolerances: tuple[PmiRequirement, ...]
    datums: Mapping[str, tuple[tuple[PmiShape, ...], ...]]
    targets: tuple[PmiTarget, ...]
    ambiguous: tuple[str, ...]
    drawn_count: int


def read_pmi(path: str | Path) -> Pmi:
    """The PMI of a STEP file, which may be packed by gzip or zip; coordinates are in the root frame, mm.

    Raises:
        InputError: no STEP, a broken or truncated file, or one that takes too much time or memory.
        MissingDependencyError: without OCP.
    """
    path = Path(path)
    require(f"{path}: PMI", "OCP")
    try:
        data = checked_text(unpacked(path), path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    numbers, ambiguous = _faces_of_datums(data)
    size_mb = len(data) / 1e6
    with tempfile.TemporaryDirectory(prefix="arview-pmi-") as name:
        folder = Path(name)
        source, items, target = folder / "source.step", folder / "items.json", folder / "pmi.json"
        source.write_bytes(data)
        items.write_text(json.dumps(numbers), encoding="utf-8")
        code, _ = run_limited(_READ, [str(source), str(items), str(target)], folder, size_mb, LIMITS)
        if code or not target.is_file():
            raise InputError(f"{path}: OpenCASCADE cannot read its PMI (code {code}); is it whole? Export it again")
        content = json.loads(target.read_text(encoding="utf-8"))
    bounds = _bounds_of_file(data)
    return Pmi(
        counts=tuple(content["counts"]),
        dimensions=tuple(
            _requirement(one, bounds)
            for one in content["dimensions"]
            if one["kind"] not in ("CommonLabel", "DimensionPresentation")
        ),
        tolerances=tuple(_requirement(one, bounds) for one in content["tolerances"]),
        datums={
            letter: tuple(tuple(map(_shape, shapes)) for shapes in places)
            for letter, places in content["datums"].items()
        },
        targets=tuple(
            PmiTarget(one["letter"], one["number"], one["kind"], _rounded(one["point"]), _rounded(one["direction"], 9))
            for one in content["targets"]
        ),
        ambiguous=ambiguous,
        drawn_count=len(_DRAWN.findall(data)),
    )


def _faces_of_datums(data: bytes) -> tuple[dict[str, list[str]], tuple[str, ...]]:
    """Numbers of the faces of each datum by its letter, and letters that several parts use.

    The faces are used by the datum, by the feature that is related to it, or by the parts of that feature.
    """
    used: dict[bytes, list[bytes]] = {}
    related: list[tuple[bytes, bytes]] = []
    datums: list[tuple[bytes, bytes, str]] = []
    for number, kind, content in _STATEMENT.findall(data):
        first, *rest = references(content) or [b""]
        if kind == b"DATUM":
            datums.append((number, first, content.rpartition(b"'")[0].rpartition(b"'")[2].decode("utf-8", "replace")))
        elif kind == b"SHAPE_ASPECT_RELATIONSHIP":
            related += [(first, part) for part in rest[:1]]
        else:
            used.setdefault(first, []).extend(rest[1:])
    parts: dict[bytes, list[bytes]] = {}
    for whole, part in related:
        parts.setdefault(whole, []).append(part)
    found: dict[str, list[str]] = {}
    owners: dict[str, set[bytes]] = {}
    for datum, owner, letter in datums:
        features = [whole for whole, part in related if part == datum]
        aspects = [datum, *features, *(part for whole in features for part in parts[whole])]
        faces = [face.decode() for aspect in dict.fromkeys(aspects) for face in used.get(aspect, ())]
        found[letter] = list(dict.fromkeys([*found.get(letter, ()), *faces]))
        owners.setdefault(letter, set()).add(owner)
    return found, tuple(letter for letter, parts_of in owners.items() if len(parts_of) > 1)


def _bounds_of_file(data: bytes) -> list[tuple[float, float]]:
    """Lower and upper bounds of the tolerances of dimensions, in the unit of the file."""
    measures = {match[1]: float(match[2]) for match in _MEASURE.finditer(data)}
    return [(measures.get(match[1], 0.0), measures.get(match[2], 0.0)) for match in _BOUNDS.finditer(data)]


def _requirement(content: Mapping[str, Any], bounds: Sequence[tuple[float, float]]) -> PmiRequirement:
    values, limits = content["values"], None
    value = values[0] if values else None
    if content.get("is_range"):
        limits = (values[0], values[1])
        value = 0.5 * sum(limits)
    elif content.get("is_plus_minus") and len(values) == 3:
        limits = _limits(*values, bounds)
    return PmiRequirement(
        name=content["name"],
        kind=content["kind"],
        shapes=tuple(map(_shape, content["shapes"])),
        others=tuple(map(_shape, content["others"])),
        value_mm=None if value is None else round(value, 6),
        limits_mm=limits,
        zone=content.get("zone", "None"),
        modifiers=(*content["modifiers"], *(["class of tolerance"] if content.get("is_class") else [])),
        datums=tuple((letter, order, tuple(words)) for letter, order, words in content.get("datums", ())),
        place=content["place"],
    )


def _limits(value: float, low: float, high: float, bounds: Sequence[tuple[float, float]]) -> tuple[float, float] | None:
    """Limits of a dimension from the magnitudes of its bounds, which are all that OpenCASCADE keeps of them.

    Their signs are those of the bounds of the file with the same ratio; None where these differ.
    """
    signs = {
        (-1.0 if one < 0 else 1.0, -1.0 if other < 0 else 1.0)
        for one, other in bounds
        if one and other and abs(abs(one) * high - abs(other) * low) <= 1e-6 * max(abs(one) * high, abs(other) * low)
    }
    if len(signs) > 1:
        return None
    below, above = signs.pop() if signs else (-1.0, 1.0)
    return round(value + below * low, 6), round(value + above * high, 6)


def _shape(content: Mapping[str, Any]) -> PmiShape:
    corner = content["corner"]
    return PmiShape(
        content["kind"],
        _rounded(content["point"]),
        _rounded(content.get("direction", (0.0, 0.0, 0.0)), 9),
        diameter_mm=round(content.get("diameter", 0.0), 6),
        length_mm=round(content.get("length", 0.0), 6),
        area_mm2=content.get("area", 0.0),
        is_hole=content.get("is_hole", False),
        corner_in_model=None if corner is None else _rounded(corner),
    )


def _rounded(values: Sequence[float], digits: int = 6) -> Vector:
    x, y, z = (round(value, digits) + 0.0 for value in values)
    return x, y, z
