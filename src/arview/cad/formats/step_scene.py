"""What a STEP file says of its bodies besides their shape: names of their places, and which are hidden."""

from __future__ import annotations

import re

from arview.cad.formats.raw import LEFT_OUT_HIDDEN, short_list
from arview.cad.formats.step_statements import (
    REF,
    SHAPE,
    SOLID,
    TEXT,
    USE,
    Products,
    edited,
    plain_name,
    references,
)

HIDDEN = "hidden place of an assembly"
"""Name of a place that is to be left out with all that is there: without its statement, its product would be a root."""
_NO_NAME = re.compile(
    rb"\$|'\s*+(?:NAUO[\s_-]*\d+|NONE|=>\[[\d:]+\]|next.assembly.(?:relationship|usage.occurrence))?\s*+'",
    re.IGNORECASE,
)
"""Names of places that writers put where there is none: blanks, numbers of statements, and fixed words."""
_SHOWN = re.compile(
    rb"#(\d+)\s*=\s*\(?\s*(INVISIBILITY|[A-Z_]*STYLED_ITEM|PRESENTATION_LAYER_ASSIGNMENT|"
    rb"(?:[A-Z_]+_)?REPRESENTATION)\b((?:[^;'=]++|'[^']*+')*+);"
)
"""Statements that hide, and those that tell which bodies they mean."""
_BODY = re.compile(
    rb"#(\d+)\s*=\s*(?:MANIFOLD_SOLID_BREP|BREP_WITH_VOIDS|FACETED_BREP|MAPPED_ITEM|TESSELLATED_(?:SOLID|SHELL)|"
    rb"(?:SHELL|FACE)_BASED_SURFACE_MODEL|(?:COMPLEX_)?TRIANGULATED_SURFACE_SET)\s*\(" + TEXT
)
"""What is a component when it is shown; hidden sketches and frames are none."""
_REPEATED = re.compile(
    rb"#(\d+)\s*=\s*TESSELLATED_(?:SOLID|SHELL)\s*\(" + TEXT + rb",\s*\([#\d,\s]*\)\s*," + REF + rb"\)"
)
_PLACED = re.compile(rb"#(\d+)\s*=\s*CONTEXT_DEPENDENT_SHAPE_REPRESENTATION\s*\(\s*#\d+\s*,\s*#(\d+)\s*\)\s*;")


def name_uses(data: bytes) -> bytes:
    """The file with the name of the product for each place whose own name is missing, or an identifier.

    OpenCASCADE takes the description of a place for its name, where it has one.
    """
    uses = [m for m in USE.finditer(data) if _NO_NAME.fullmatch(m[4])]
    uses = [m for m in uses if _NO_NAME.fullmatch(m[3]) or (m[3] == m[2] and m[3][1:-1].isdigit())]
    if not uses:
        return data
    products = Products(data)
    return edited(data, {(m.start(3), m.end(4)): b"%s,''" % products.name_of(m[6]) for m in uses})


def drop_repeated(data: bytes) -> bytes:
    """The file without tessellated bodies that repeat an exact one, to which they refer."""
    exact = {m[1] for m in SOLID.finditer(data) if not m[2]}
    repeated = {m[1] for m in _REPEATED.finditer(data) if m[3] in exact}
    if not repeated:
        return data
    shapes = {m.span(3): re.findall(rb"\d+", m[3]) for m in SHAPE.finditer(data)}
    kept = {span: [b"#" + item for item in items if item not in repeated] for span, items in shapes.items()}
    return edited(data, {span: b",".join(items) for span, items in kept.items()})


def hide_bodies(data: bytes) -> tuple[bytes, list[str]]:
    """The file without the bodies, products and places that are hidden in it, and remarks on them.

    What is hidden at one of the places of an assembly alone is kept, because its text is common to all of them.
    """
    if b"INVISIBILITY" not in data:
        return data, []
    shown = {m[1]: (m[2], references(m[3])) for m in _SHOWN.finditer(data)}
    placed = {m[1]: m[2] for m in _PLACED.finditer(data)}
    waiting, deep = [one for kind, held in shown.values() if kind == b"INVISIBILITY" for one in held], 0
    hidden = set[bytes]()
    while waiting:
        one = waiting.pop()
        kind, held = (b"", []) if one in hidden else shown.get(one, (b"", []))
        hidden.add(one)
        if kind.endswith(b"STYLED_ITEM"):
            places = [other for other in held if other in placed]
            deep += len(places) > 1
            # An overriding style refers to the one that it overrides, which holds elsewhere.
            items = [other for other in held if b"STYLED_ITEM" not in shown.get(other, (b"",))[0]]
            hidden.update(places if len(places) == 1 else items if not places else ())
        elif kind:
            waiting += held
    products, edits, names = Products(data), dict[tuple[int, int], bytes](), list[bytes]()
    bodies = {m[1]: m[2] for m in _BODY.finditer(data)}
    for match in SHAPE.finditer(data):
        items = re.findall(rb"\d+", match[3])
        left_out = [i for i in items if i in bodies and (i in hidden or match[1] in hidden)]
        if left_out:
            edits[match.span(3)] = b",".join(b"#" + i for i in items if i not in left_out)
            owner = products.of_shape(match[1])
            names += [plain_name(bodies[i]) or plain_name(owner[-1] if owner else b"'unnamed'") for i in left_out]
    uses = {products.definition.get(shape) for one, shape in placed.items() if one in hidden}
    for use in (m for m in USE.finditer(data) if m[1] in uses):
        names.append(plain_name(use[3]) or plain_name(products.name_of(use[6])))
        edits[use.start(3), use.end(4)] = b"'%s',''" % HIDDEN.encode()
    told = short_list([name.decode("utf-8", errors="replace") for name in dict.fromkeys(names)])
    notes = [f"{LEFT_OUT_HIDDEN % 'STEP'}: {told}"] if names else []
    if deep:
        notes.append(f"{deep} bodies are hidden at one place of an assembly alone, and are kept")
    return edited(data, edits), notes
