"""The tables [[characteristics]] of a part file: what the drawing requires of features and components."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import cast, get_args

from arview.cad.part import Characteristic, CharacteristicKind, Datum, DatumFeature, MaterialCondition, ZoneShape
from arview.cad.toml_table import TomlTable
from arview.errors import InputError

KINDS = get_args(CharacteristicKind)
WITH_LIMITS = ("size", "distance", "gap", "flush")
OF_TWO = ("distance", "gap", "flush")
FLAT_KINDS = ("profile", "flatness", "gap", "flush")
"""Kinds that are about flat faces only, but for the profile of a surface."""
ROUND: tuple[DatumFeature, ...] = ("hole", "pin", "cylinder")
SIZED: tuple[DatumFeature, ...] = (*ROUND, "slot")
MAXIMUM_MARK = "(M)"


def read_characteristics(
    tables: Sequence[TomlTable], components: Sequence[str], datums: Sequence[Datum], features: Sequence[Datum]
) -> tuple[Characteristic, ...]:
    """The characteristics of a part file.

    Args:
        tables: one for each.
        components: names in the CAD.
        datums: of the part file.
        features: of the part file; datums and components are features, too.

    Raises:
        InputError: a wrong value, a name that is neither a feature nor a component, a datum that there is not, a
            requirement that its features cannot have, or a name that appears twice.
    """
    targets: dict[str, DatumFeature] = dict.fromkeys(components, "fit")
    targets |= {one.label: one.feature for one in (*datums, *features)}
    found: list[Characteristic] = []
    for table in tables:
        one = _read(table, targets, {datum.label: datum for datum in datums})
        if one.name in (other.name for other in found):
            table.fail("name", one.name, "a name that no other characteristic has")
        found.append(one)
    _check_sizes(tables, found)
    return tuple(found)


def _read(table: TomlTable, targets: Mapping[str, DatumFeature], datums: Mapping[str, Datum]) -> Characteristic:
    kind = cast(CharacteristicKind, table.choice("kind", KINDS, required=True))
    of = (table.text("of"),) if isinstance(table.take("of"), str) else table.texts("of")
    for name in of:
        if name not in targets:
            table.fail("of", name, f"features or components, of {', '.join(targets)}")
    features = {targets[name] for name in of}
    if (kind in OF_TWO and len(of) != 2) or (kind not in (*OF_TWO, "position") and len(of) != 1):
        table.fail("of", list(of), "two names" if kind in OF_TWO else "one name; only a position may be of a pattern")
    if "surface" in features and kind != "profile":
        table.fail("kind", kind, '"profile", all that can be required of a surface')
    if kind in FLAT_KINDS and not features <= {"plane", "surface"}:
        table.fail("of", list(of), f'flat faces: {kind} is of features whose feature is "plane"')
    if kind == "size" and not features <= set(SIZED):
        table.fail("of", list(of), "a hole, pin, cylinder or slot")
    of_component: ZoneShape = "sphere" if kind == "position" else "diameter"
    default: ZoneShape = "diameter" if features <= set(ROUND) else of_component if features <= {"fit"} else "width"
    zone = cast(ZoneShape, table.choice("zone", get_args(ZoneShape), default)) if kind == "position" else default
    labels = table.texts("datums", tuple(datums)) if kind not in ("flatness", *WITH_LIMITS) else ()
    at_maximum = tuple(label.removesuffix(MAXIMUM_MARK) for label in labels if label.endswith(MAXIMUM_MARK))
    labels = tuple(label.removesuffix(MAXIMUM_MARK) for label in labels)
    for label in labels:
        if label not in datums or (label in at_maximum and datums[label].feature not in ROUND):
            table.fail(
                "datums", label, f"datums of the part, of {', '.join(datums)}; only round ones with {MAXIMUM_MARK}"
            )
    material: MaterialCondition = ""
    if kind not in (*WITH_LIMITS, *FLAT_KINDS):
        flags = table.flag("at_maximum_material"), table.flag("at_least_material")
        if all(flags):
            table.fail("at_least_material", True, "maximum or least material, not both")
        material = "maximum" if flags[0] else "least" if flags[1] else ""
    tolerance_mm = table.positive("tolerance_mm", required=True) if kind not in WITH_LIMITS else None
    low, high = (table.number("min_mm"), table.number("max_mm")) if kind in WITH_LIMITS else (None, None)
    if kind in WITH_LIMITS and (
        (low is None and high is None) or (low is not None and high is not None and low >= high)
    ):
        table.fail("min_mm", low, "min_mm below max_mm, or one of both")
    direction = table.direction("direction") if table.known("direction") else None
    is_flat_zone = kind == "profile" or (kind == "position" and zone == "width")
    offset_mm = (table.number("offset_mm") if is_flat_zone else None) or 0.0
    if set(of) & set(labels):
        table.fail("of", list(of), "no feature that is one of its own datums")
    if tolerance_mm and zone == "width" and direction is None and not features <= {"plane", "point", "surface"}:
        table.fail("direction", None, "a direction across the zone, because the feature has no normal")
    name = table.line("name", f"{kind} of {' and '.join(of)}")
    source = table.line("source", "")
    table.finish()
    return Characteristic(
        name,
        kind,
        of,
        tolerance_mm=tolerance_mm,
        limits_mm=(low, high),
        zone=zone,
        direction_in_model=direction,
        datums=labels,
        offset_mm=offset_mm,
        material=material,
        datums_at_maximum=at_maximum,
        source=source,
    )


def _check_sizes(tables: Sequence[TomlTable], found: Sequence[Characteristic]) -> None:
    """Raise InputError where maximum material has a meaning only with the limits of a size that are not there."""
    sized = {one.of[0] for one in found if one.kind == "size"}
    for table, one in zip(tables, found, strict=True):
        needed = {*(one.of if one.material else ()), *one.datums_at_maximum} - sized
        if needed:
            raise InputError(
                f"{table.path}: [characteristics] {one.name!r}: {one.material or 'maximum'} material needs"
                f' the limits of the size of {", ".join(sorted(needed))}; add a characteristic of the kind "size"'
            )
