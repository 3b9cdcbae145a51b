"""Reader of product and manufacturing information (PMI) in STEP AP242: dimensions, tolerances and datums of faces.

Sources: ISO 10303-242; recommended practices of the CAx Implementor Forum for PMI.
"""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any, cast

from arview.cad.formats.archive import unpacked
from arview.cad.formats.limited_process import ProcessLimits, run_limited
from arview.cad.formats.step_statements import edited, references
from arview.cad.formats.step_text import checked_text
from arview.cad.part import Vector
from arview.core.extras import require
from arview.errors import InputError

_LINK = re.compile(
    rb"#(\d+)\s*=\s*(DATUM|SHAPE_ASPECT_RELATIONSHIP|GEOMETRIC_ITEM_SPECIFIC_USAGE|ITEM_IDENTIFIED_REPRESENTATION_USAGE)"
    rb"\s*\(((?:'[^']*'|[^;'])*)\)\s*;"
)
"""Statements that say of which faces datums are."""
_DRAWN = re.compile(rb"=\s*\(?\s*(?:TESSELLATED_)?ANNOTATION(?:_CURVE|_FILL_AREA|_SYMBOL|_TEXT)?_OCCURRENCE\b")
_BOUNDS = re.compile(rb"=\s*TOLERANCE_VALUE\s*\(\s*#(\d+)\s*,\s*#(\d+)\s*\)")
_MEASURE = re.compile(rb"#(\d+)\s*=\s*\(?[^;]*?MEASURE(?:_WITH_UNIT)?\s*\(\s*([-+.\dE]+)\s*[,)]")
_READ = """
from arview.cad.formats.pmi_document import write_pmi
write_pmi(*sys.argv[1:])
"""


@dataclass(frozen=True)
class PmiShape:
    """A face or edge at its place in the model, mm.

    Attributes:
        kind: plane, cylinder, line edge, vertex, or the name of another surface or curve.
        point_in_model: middle of a face or edge; of a cylinder on its axis; the place of a vertex.
        direction_in_model: unit normal out of the material, or unit axis; zero for other surfaces.
        diameter_mm: of a cylinder.
        length_mm: of a cylinder along its axis.
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
        value_mm: nominal value of a dimension (of limits the lower), or width of the zone; None where there is none.
            Angles are in degrees.
        limits_mm: smallest and largest value of a dimension; None where the file has none.
        zone: None, Diameter or SphericalDiameter.
        modifiers: names of all that changes its meaning: M, L, All_Around, Free_State, theoretical, ….
        datums: name (see `Pmi`), number in the order of precedence, and modifiers of each datum, in that order.
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


@dataclass(frozen=True)
class Pmi:
    """What a STEP file says of the accuracy of its parts.

    What a part requires that stands at several places of an assembly is there once for each place.

    Attributes:
        counts: of dimensions (drawn ones, too), geometric tolerances, and references to datums in the file.
        drawn_dimensions: how many of the dimensions are only drawn; they are left out of ``dimensions``.
        dimensions: in the order of the file.
        tolerances: in the order of the file.
        datums: shapes of the feature of each datum by its name: its letter, and at the further places of its part
            A_2, A_3, ….
        targets: datum targets by letter and number, as in B2: kind (point, line, circle, …), middle, direction across
            the surface (of a line along it), and size as their length.
        drawn_count: annotations that are drawn.
    """

    counts: tuple[int, int, int]
    drawn_dimensions: int
    dimensions: tuple[PmiRequirement, ...]
    tolerances: tuple[PmiRequirement, ...]
    datums: Mapping[str, tuple[PmiShape, ...]]
    targets: Mapping[str, PmiShape]
    drawn_count: int


def read_pmi(path: Path) -> Pmi:
    """The PMI of a STEP file, which may be packed by gzip or zip; coordinates are in the root frame, mm.

    Raises:
        InputError: no STEP, a broken or truncated file, or one that takes too much time or memory.
        MissingDependencyError: without OCP.
    """
    require(f"{path}: PMI", "OCP")
    data = checked_text(unpacked(path), path)
    with tempfile.TemporaryDirectory(prefix="arview-pmi-") as name:
        source, target = Path(name) / "source.step", Path(name) / "pmi.json"
        source.write_bytes(_with_faces_of_datums(data))
        code, _ = run_limited(
            _READ, [str(source), str(target)], Path(name), len(data) / 1e6, ProcessLimits(15.0, memory_mb=3000.0)
        )
        if code or not target.is_file():
            raise InputError(f"{path}: OpenCASCADE cannot read its PMI (code {code}); is it whole? Export it again")
        content = json.loads(target.read_text(encoding="utf-8"))
    measures = {match[1]: float(match[2]) for match in _MEASURE.finditer(data)}
    bounds = [(measures.get(match[1], 0.0), measures.get(match[2], 0.0)) for match in _BOUNDS.finditer(data)]
    return Pmi(
        tuple(content["counts"]),
        content["drawn_dimensions"],
        tuple(_requirement(one, bounds) for one in content["dimensions"]),
        tuple(_requirement(one, bounds) for one in content["tolerances"]),
        datums={name: _shapes(shapes) for name, shapes in content["datums"].items()},
        targets={name: _shapes([one])[0] for name, one in sorted(content["targets"].items())},
        drawn_count=len(_DRAWN.findall(data)),
    )


def _with_faces_of_datums(data: bytes) -> bytes:
    """The file with a statement for each face of a datum, in the form in which alone OpenCASCADE links them.

    Writers link faces to the datum itself, or as a set to the feature that is related to it.
    """
    rows = [(number, kind, references(content)) for number, kind, content in _LINK.findall(data)]
    datums = {number for number, kind, _ in rows if kind == b"DATUM"}
    contents = [
        b"('','',#%s,#%s,#%s);" % (feature, representation, face)
        for _, kind, (aspect, representation, *faces) in (
            row for row in rows if row[1].endswith(b"USAGE") and row[2][1:]
        )
        for feature, datum in (items for _, other, items in rows if other.endswith(b"RELATIONSHIP") and len(items) == 2)
        if datum in datums and (aspect == datum or (aspect == feature and kind.startswith(b"ITEM")))
        for face in faces
    ]
    numbers = count(1 + max(map(int, re.findall(rb"#(\d+)\s*=", data)), default=0))
    added = [b"#%d=GEOMETRIC_ITEM_SPECIFIC_USAGE%s\n" % (next(numbers), content) for content in contents]
    return edited(data, {(data.rfind(b"ENDSEC"),) * 2: b"".join(added)})


def _requirement(content: Mapping[str, Any], bounds: Sequence[tuple[float, float]]) -> PmiRequirement:
    values = [round(number, 6) for number in content["values"]]
    return PmiRequirement(
        content["name"],
        content["kind"],
        _shapes(content["shapes"]),
        _shapes(content["others"]),
        value_mm=values[0] if values else None,
        limits_mm=_limits(values, bounds),
        zone=content.get("zone", "None"),
        modifiers=tuple(content["modifiers"]),
        datums=tuple((name, order, tuple(words)) for name, order, words in content["datums"]),
    )


def _limits(values: Sequence[float], bounds: Sequence[tuple[float, float]]) -> tuple[float, float] | None:
    """Limits of a dimension: its two values, or its value and the bounds of its deviation.

    OpenCASCADE keeps the magnitudes of bounds alone; their signs are those of the bounds of the file with the same
    ratio. None where these differ, and of a dimension without limits.
    """
    value, low, high = values if len(values) == 3 else (0.0, 0.0, 0.0)
    signs = {
        (one < 0, other < 0)
        for one, other in bounds
        if one and other and abs(abs(one) * high - abs(other) * low) <= 1e-5 * abs(other) * low
    }
    is_below, is_all_below = next(iter(signs), (True, False))
    if len(values) < 3 or len(signs) > 1:
        return (values[0], values[1]) if len(values) == 2 else None
    return round(value + (-low if is_below else low), 6), round(value + (-high if is_all_below else high), 6)


def _shapes(contents: Sequence[Mapping[str, Any]]) -> tuple[PmiShape, ...]:
    return tuple(
        PmiShape(
            **cast(dict[str, Any], {key: tuple(one) if isinstance(one, list) else one for key, one in own.items()})
        )
        for own in contents
    )
