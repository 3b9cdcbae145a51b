"""Statements of STEP files (ISO 10303-21) as patterns, and the products that they describe."""

from __future__ import annotations

import re

TEXT = rb"\s*('(?:[^']|'')*')\s*"
REF = rb"\s*#(\d+)\s*"
SOLID = re.compile(
    rb"#(\d+)\s*=\s*(?:MANIFOLD_SOLID_BREP|BREP_WITH_VOIDS|FACETED_BREP|(TESSELLATED_(?:SOLID|SHELL)))\s*\("
    + TEXT
    + rb","
)
SHAPE = re.compile(
    rb"#(\d+)\s*=\s*(?:[A-Z_]+_)?SHAPE_REPRESENTATION\s*\(" + TEXT + rb",\s*\(([#\d,\s]*)\)\s*," + REF + rb"\)\s*;"
)
PLACEMENT = re.compile(rb"#(\d+)\s*=\s*AXIS2_PLACEMENT_3D\s*\(")
SHAPE_OF = re.compile(rb"#\d+\s*=\s*SHAPE_DEFINITION_REPRESENTATION\s*\(" + REF + rb"," + REF + rb"\)\s*;")
SAME_SHAPE = re.compile(
    rb"=\s*SHAPE_REPRESENTATION_RELATIONSHIP\s*\(" + TEXT + rb",[^,]*," + REF + rb"," + REF + rb"\)"
)
DEFINITION_SHAPE = re.compile(rb"#(\d+)\s*=\s*PRODUCT_DEFINITION_SHAPE\s*\(" + TEXT + rb",[^,]*," + REF + rb"\)")
DEFINITION = re.compile(
    rb"#(\d+)\s*=\s*PRODUCT_DEFINITION(?:_WITH_ASSOCIATED_DOCUMENTS)?\s*\("
    + TEXT
    + rb",\s*(?:'(?:[^']|'')*'|\$)\s*,"
    + REF
    + rb","
    + REF
    + rb"[,)]"
)
FORMATION = re.compile(
    rb"#(\d+)\s*=\s*PRODUCT_DEFINITION_FORMATION(?:_WITH_SPECIFIED_SOURCE)?\s*\("
    + TEXT
    + rb",\s*(?:'(?:[^']|'')*'|\$)\s*,"
    + REF
)
PRODUCT = re.compile(rb"#(\d+)\s*=\s*PRODUCT\s*\(" + TEXT + rb"," + TEXT + rb",\s*(?:'(?:[^']|'')*'|\$)\s*,\s*\(" + REF)
USE = re.compile(
    rb"#(\d+)\s*=\s*NEXT_ASSEMBLY_USAGE_OCCURRENCE\s*\("
    + TEXT
    + rb",\s*('(?:[^']|'')*'|\$)\s*,\s*('(?:[^']|'')*'|\$)\s*,"
    + REF
    + rb","
    + REF
    + rb","
)


class Products:
    """The products of a file by the numbers of their definitions and shape representations."""

    def __init__(self, data: bytes) -> None:
        self.definition_of_shape = {m[2]: m[1] for m in SHAPE_OF.finditer(data)}
        self.linked: dict[bytes, bytes] = {}
        for match in SAME_SHAPE.finditer(data):
            self.linked[match[2]], self.linked[match[3]] = match[3], match[2]
        self.definition = {m[1]: m[3] for m in DEFINITION_SHAPE.finditer(data)}
        self.formation = {m[1]: (m[3], m[4]) for m in DEFINITION.finditer(data)}
        self.product = {m[1]: m[3] for m in FORMATION.finditer(data)}
        # A product without a name has an identifier.
        self.name = {m[1]: (m[3] if plain_name(m[3]) else m[2], m[4]) for m in PRODUCT.finditer(data)}

    def name_of(self, definition: bytes) -> bytes:
        """Name of a product in quotes; its number where it is not found."""
        formation, _ = self.formation.get(definition, (b"", b""))
        return self.name.get(self.product.get(formation, b""), (b"'#" + definition + b"'", b""))[0]

    def of_shape(self, shape: bytes) -> tuple[bytes, bytes, bytes, bytes, bytes] | None:
        """Definition, its own representation, its context, and the product's context and name; None when not found.

        They are what a new product that is placed in it needs.
        """
        if shape not in self.definition_of_shape:
            shape = self.linked.get(shape, shape)
        try:
            definition = self.definition[self.definition_of_shape[shape]]
            formation, definition_context = self.formation[definition]
            name, product_context = self.name[self.product[formation]]
        except KeyError:
            return None
        return definition, shape, definition_context, product_context, name


def plain_name(text: bytes) -> bytes:
    """A name without its quotes; empty for the placeholder NONE."""
    name = text[1:-1].strip()
    return b"" if name.upper() == b"NONE" else name


def references(text: bytes) -> list[bytes]:
    """Numbers of the statements that a statement refers to, in order."""
    return re.findall(rb"#(\d+)", re.sub(rb"'[^']*'", b"", text))


def edited(data: bytes, edits: dict[tuple[int, int], bytes]) -> bytes:
    """The text with other content from a start to an end, which must not overlap."""
    pieces, done = [], 0
    for (start, end), content in sorted(edits.items()):
        pieces += [data[done:start], content]
        done = end
    return b"".join([*pieces, data[done:]])
