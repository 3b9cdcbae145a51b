"""STEP files as text (ISO 10303-21): whether they are whole, their unit, and named solids as products of their own.

OpenCASCADE takes minutes over files whose parentheses never close, and its glTF holds one mesh for each product,
however many named solids that has. Both are dealt with before it reads the file, as are names and hidden bodies.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from arview.cad.formats.archive import unpacked
from arview.cad.formats.raw import check_instance_count, short_list, unit_in_mm
from arview.cad.formats.step_external import OtherFiles, products_without_shape
from arview.cad.formats.step_scene import drop_repeated, hide_bodies, name_uses
from arview.cad.formats.step_statements import (
    SHAPE,
    SOLID,
    USE,
    Products,
    plain_name,
)
from arview.cad.formats.text_encoding import decode_text
from arview.errors import InputError

_MAX_NESTING = 64
_CHUNK = 1 << 22
_STRINGS_AND_COMMENTS = re.compile(rb"'[^']*(?:'|\Z)|/\*(?:.*?\*/|.*\Z)", re.S)
_PREFIX_MM = {"$": 1000.0, ".MILLI.": 1.0, ".CENTI.": 10.0, ".DECI.": 100.0, ".MICRO.": 0.001, ".KILO.": 1e6}


def prepare_step(data: bytes, path: Path) -> tuple[bytes, list[str]]:
    """A STEP file that OpenCASCADE can read in bounded time, in UTF-8, with named solids as products; and remarks.

    Raises:
        InputError: not STEP, parentheses that never close, an assembly in itself, or too many components.
    """
    others = OtherFiles(lambda file: checked_text(unpacked(file), file))
    data = others.added(checked_text(data, path), path)
    _check_instances(data, path)
    notes, products = list[str](), Products(data)
    if others.missing:
        told = short_list([f"{file} ({name})" for name, file in others.missing.items()])
        why = "their STEP files are not beside it, or do not hold one product"
        notes.append(f"left out, because {why}; put them there: {told}")
    missing = [
        plain_name(products.name_of(one)).decode("utf-8", errors="replace") for one in products_without_shape(data)
    ]
    if missing := [name for name in missing if name not in others.missing]:
        notes.append(
            f"{len(missing)} products of the STEP file have no shape in it and are left out; is it in other files? "
            f"Export one file with all: {short_list(missing)}"
        )
    data, hidden = hide_bodies(drop_repeated(data))
    return split_solids(name_uses(data)), notes + hidden


def step_unit_mm(data: bytes, path: Path) -> float:
    """Length unit in mm that a STEP file declares; raises InputError when it declares none or several."""
    text = data.decode("latin-1")
    # An inch is defined in millimetres: of a conversion-based unit only the unit itself counts.
    names = re.findall(r"CONVERSION_BASED_UNIT\s*\(\s*'([^']*)'[^;]*?LENGTH_UNIT", text)
    units: set[float | None] = {unit_in_mm(name) for name in names}
    if not units:
        found = re.findall(r"LENGTH_UNIT\s*\(\s*\)[^;]*?SI_UNIT\s*\(\s*([^,\s]*)\s*,\s*\.METRE\.", text)
        units = {_PREFIX_MM.get(prefix) for prefix in found}
    if len(units) != 1 or None in units:
        raise InputError(f"{path}: its length unit is not known, so that unit cannot be overridden; leave unit out")
    return float(next(value for value in units if value is not None))


def checked_text(data: bytes, path: Path) -> bytes:
    """The content of a STEP file in UTF-8; raises InputError when it is no STEP, or not whole."""
    if b"ISO-10303-21" not in data[:4096]:
        raise InputError(f"{path}: not a STEP file (ISO-10303-21 is missing at its start)")
    _check_whole(data, path)
    return data if data.isascii() else decode_text(data).encode("utf-8")


def _check_whole(data: bytes, path: Path) -> None:
    """Raise InputError unless the parentheses of every statement close and are not nested deeply."""
    plain = np.frombuffer(_STRINGS_AND_COMMENTS.sub(b"", data), dtype=np.uint8)
    depth = 0
    for start in range(0, len(plain), _CHUNK):
        chunk = plain[start : start + _CHUNK]
        depths = depth + np.cumsum((chunk == ord("(")).astype(np.int32) - (chunk == ord(")")))
        depth = int(depths[-1])
        if depths.min() < 0 or depths.max() > _MAX_NESTING or np.any(depths[chunk == ord(";")]):
            raise InputError(f"{path}: broken or truncated STEP (its parentheses do not match); export it again")
    if depth:
        raise InputError(f"{path}: broken or truncated STEP (unexpected end of file); export it again")


def _check_instances(data: bytes, path: Path) -> None:
    """Raise InputError when an assembly holds itself, or all of them place too many components."""
    children: dict[bytes, list[bytes]] = {}
    for match in USE.finditer(data):
        children.setdefault(match[5], []).append(match[6])
    counts: dict[bytes, int] = {}
    for top in children:
        stack = [top]
        while stack:
            here = stack[-1]
            waiting = [c for c in dict.fromkeys(children.get(here, ())) if c not in counts]
            if waiting and waiting[0] in stack:
                raise InputError(f"{path}: broken STEP (an assembly holds itself); export it again")
            if waiting:
                stack.append(waiting[0])
                continue
            counts[here] = 1 + sum(counts[child] for child in children.get(here, ()))
            stack.pop()
    used = {child for several in children.values() for child in several}
    check_instance_count(sum(counts[top] for top in children if top not in used), path)


def split_solids(data: bytes) -> bytes:
    """The file with a product for each solid, where a product holds several that have different names.

    Each solid moves from the representation of its product to one of its own, which is placed at the same spot.
    """
    found = list(SOLID.finditer(data))
    solids: dict[bytes, bytes] = {match[1]: match[3] for match in found}
    meshes = {match[1] for match in found if match[2]}
    if len(solids) < 2:
        return data
    shapes = [(match, [i for i in re.findall(rb"\d+", match[3]) if i in solids]) for match in SHAPE.finditer(data)]
    shapes = [(match, items) for match, items in shapes if len({plain_name(solids[i]) for i in items}) > 1]
    if not shapes:
        return data
    products = Products(data)
    new_id = 1 + max(int(i) for i in re.findall(rb"#(\d+)\s*=", data))
    pieces: list[bytes] = []
    added: list[bytes] = []
    end = 0
    for match, items in shapes:
        owner = products.of_shape(match[1])
        if owner is None:
            continue
        definition, shape, definition_context, product_context, product_name = owner
        kept = [b"#" + i for i in re.findall(rb"\d+", match[3]) if i not in items]
        origin = b"#%d" % new_id
        added += _statements(
            new_id, [b"AXIS2_PLACEMENT_3D('',#%d,$,$)" % (new_id + 1), b"CARTESIAN_POINT('',(0.,0.,0.))"]
        )
        new_id += 2
        pieces.append(data[end : match.start()])
        pieces.append(
            b"#%s=SHAPE_REPRESENTATION(%s,(%s),#%s);" % (match[1], match[2], b",".join([*kept, origin]), match[4])
        )
        end = match.end()
        for item in items:
            name = solids[item] if plain_name(solids[item]) else product_name
            parts = _product_of_solid(
                new_id,
                name,
                b"#" + item,
                origin=origin,
                context=match[4],
                kind=b"TESSELLATED" if item in meshes else b"ADVANCED_BREP",
                parent=(definition, shape),
                contexts=(definition_context, product_context),
            )
            added += _statements(new_id, parts)
            new_id += len(parts)
    text = b"".join(pieces) + data[end:]
    at = text.rfind(b"ENDSEC")
    return text[:at] + b"\n".join(added) + b"\n" + text[at:]


def _product_of_solid(
    first: int,
    name: bytes,
    solid: bytes,
    origin: bytes,
    context: bytes,
    kind: bytes,
    parent: tuple[bytes, bytes],
    contexts: tuple[bytes, bytes],
) -> list[bytes]:
    """Statements, numbered from ``first``, of a product of one solid and of its use in a parent (definition, shape)."""
    n, (definition_context, product_context) = first, contexts
    return [
        b"%s_SHAPE_REPRESENTATION(%s,(%s,%s),#%s)" % (kind, name, origin, solid, context),
        b"PRODUCT(%s,%s,'',(#%s))" % (name, name, product_context),
        b"PRODUCT_DEFINITION_FORMATION('','',#%d)" % (n + 1),
        b"PRODUCT_DEFINITION('','',#%d,#%s)" % (n + 2, definition_context),
        b"PRODUCT_DEFINITION_SHAPE('','',#%d)" % (n + 3),
        b"SHAPE_DEFINITION_REPRESENTATION(#%d,#%d)" % (n + 4, n),
        b"NEXT_ASSEMBLY_USAGE_OCCURRENCE('%d',%s,'',#%s,#%d,$)" % (n, name, parent[0], n + 3),
        b"PRODUCT_DEFINITION_SHAPE('','',#%d)" % (n + 6),
        b"ITEM_DEFINED_TRANSFORMATION('','',%s,%s)" % (origin, origin),
        b"(REPRESENTATION_RELATIONSHIP('','',#%d,#%s)REPRESENTATION_RELATIONSHIP_WITH_TRANSFORMATION(#%d)"
        b"SHAPE_REPRESENTATION_RELATIONSHIP())" % (n, parent[1], n + 8),
        b"CONTEXT_DEPENDENT_SHAPE_REPRESENTATION(#%d,#%d)" % (n + 9, n + 7),
    ]


def _statements(first: int, contents: list[bytes]) -> list[bytes]:
    return [b"#%d=%s;" % (first + k, content) for k, content in enumerate(contents)]
