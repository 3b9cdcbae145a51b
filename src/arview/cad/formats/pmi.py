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
_ONLY_DRAWN = ("CommonLabel", "DimensionPresentation")
_READ = """
from arview.cad.formats.pmi_document import write_pmi
write_pmi(*sys.argv[1:])
"""


@dataclass(frozen=True)
class PmiShape:
    """A face or edge at its place in the model, mm.

    Attributes:
        kind: plane, cylinder, edge (a straight one), or the name of another surface or curve.
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
        datums: letter, number in the order of precedence, and modifiers of each datum, in that order.
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
class Pmi:
    """What a STEP file says of the accuracy of its parts.

    Attributes:
        counts: of dimensions (drawn ones, too), geometric tolerances, and references to datums in the file.
        dimensions: with a meaning, in the order of the file, once for each place of their part.
        tolerances: as ``dimensions``.
        datums: shapes of the feature of each datum by its letter, for each place of its part.
        targets: datum targets by letter and number, as in B2: kind (point, line, circle, …), middle, direction across
            the surface (of a line along it), and size as their length.
        drawn_count: annotations that are drawn.
    """

    counts: tuple[int, int, int]
    dimensions: tuple[PmiRequirement, ...]
    tolerances: tuple[PmiRequirement, ...]
    datums: Mapping[str, tuple[tuple[PmiShape, ...], ...]]
    targets: Mapping[str, PmiShape]
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
    size_mb = len(data) / 1e6
    with tempfile.TemporaryDirectory(prefix="arview-pmi-") as name:
        source, items, target = (Path(name) / file for file in ("source.step", "items.json", "pmi.json"))
        source.write_bytes(data)
        items.write_text(json.dumps(_faces_of_datums(data)), encoding="utf-8")
        code, _ = run_limited(_READ, [str(source), str(items), str(target)], Path(name), size_mb, LIMITS)
        if code or not target.is_file():
            raise InputError(f"{path}: OpenCASCADE cannot read its PMI (code {code}); is it whole? Export it again")
        content = json.loads(target.read_text(encoding="utf-8"))
    measures = {match[1]: float(match[2]) for match in _MEASURE.finditer(data)}
    bounds = [(measures.get(match[1], 0.0), measures.get(match[2], 0.0)) for match in _BOUNDS.finditer(data)]
    return Pmi(
        counts=tuple(content["counts"]),
        dimensions=tuple(_requirement(one, bounds) for one in content["dimensions"] if one["kind"] not in _ONLY_DRAWN),
        tolerances=tuple(_requirement(one, bounds) for one in content["tolerances"]),
        datums={letter: tuple(map(_shapes, places)) for letter, places in content["datums"].items()},
        targets={name: _shapes([one])[0] for name, one in sorted(content["targets"].items())},
        drawn_count=len(_DRAWN.findall(data)),
    )


def _faces_of_datums(data: bytes) -> dict[str, list[str]]:
    """Numbers of the faces of each datum by its letter: of the datum, its feature, and the parts of that feature."""
    used: dict[bytes, list[bytes]] = {}
    related: list[tuple[bytes, bytes]] = []
    datums: list[tuple[bytes, str]] = []
    for number, kind, content in _STATEMENT.findall(data):
        first, *rest = references(content) or [b""]
        if kind == b"DATUM":
            datums.append((number, content.rpartition(b"'")[0].rpartition(b"'")[2].decode("utf-8", errors="replace")))
        elif kind == b"SHAPE_ASPECT_RELATIONSHIP":
            related += [(first, part) for part in rest[:1]]
        else:
            used.setdefault(first, []).extend(rest[1:])
    found: dict[str, list[str]] = {}
    for datum, letter in datums:
        features = {whole for whole, part in related if part == datum}
        aspects = [datum, *features, *(part for whole, part in related if whole in features)]
        found.setdefault(letter, []).extend(
            face.decode() for one in dict.fromkeys(aspects) for face in used.get(one, ())
        )
    return {letter: list(dict.fromkeys(faces)) for letter, faces in found.items()}


def _requirement(content: Mapping[str, Any], bounds: Sequence[tuple[float, float]]) -> PmiRequirement:
    value, *rest = [round(number, 6) for number in content["values"]] or [None]
    return PmiRequirement(
        content["name"],
        content["kind"],
        _shapes(content["shapes"]),
        _shapes(content["others"]),
        value_mm=value,
        limits_mm=(value, rest[0]) if len(rest) == 1 else _limits(value, *rest, bounds) if rest else None,
        zone=content.get("zone", "None"),
        modifiers=tuple(content["modifiers"]),
        datums=tuple((letter, order, tuple(words)) for letter, order, words in content.get("datums", ())),
        place=content["place"],
    )


def _limits(value: float, low: float, high: float, bounds: Sequence[tuple[float, float]]) -> tuple[float, float] | None:
    """Limits of a dimension from the magnitudes of its bounds, which are all that OpenCASCADE keeps of them.

    Their signs are those of the bounds of the file with the same ratio; None where these differ.
    """
    signs = {
        (one < 0, other < 0)
        for one, other in bounds
        if one and other and abs(abs(one) * high - abs(other) * low) <= 1e-5 * abs(other) * low
    }
    is_below, is_above_below = signs.pop() if signs else (True, False)
    limits = (round(value + (-low if is_below else low), 6), round(value + (-high if is_above_below else high), 6))
    return None if signs else limits


def _shapes(contents: Sequence[Mapping[str, Any]]) -> tuple[PmiShape, ...]:
    return tuple(
        PmiShape(**{key: tuple(value) if isinstance(value, list) else value for key, value in content.items()})
        for content in contents
    )
