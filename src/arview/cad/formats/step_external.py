"""Parts of a STEP assembly that are in files of their own: found beside it, and put into its text.

Source: CAx-IF Recommended Practices for External References 2.1. A product without a shape refers to a document,
which names a file; the statements of that file take the place of the product's definition and shape.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path, PureWindowsPath

from arview.cad.formats.archive import STEP_SUFFIXES
from arview.cad.formats.step_statements import (
    DEFINITION,
    PLACEMENT,
    SHAPE,
    SHAPE_OF,
    USE,
    Products,
    edited,
    plain_name,
    references,
)
from arview.errors import InputError

SUFFIXES = (*STEP_SUFFIXES, ".stpz")
MAX_BYTES = 500_000_000
"""Largest size of an assembly with all its files: files that use others twice multiply."""
_MAX_DEPTH = 30
_DOCUMENT = re.compile(
    rb"#(\d+)\s*=\s*\(?\s*(?:PRODUCT_DEFINITION_WITH_ASSOCIATED_DOCUMENTS|PRODUCT_DEFINITION_FORMATION\w*|DOCUMENT_FILE|"
    rb"DOCUMENT|DOCUMENT_PRODUCT_EQUIVALENCE|APPLIED_DOCUMENT_REFERENCE|APPLIED_EXTERNAL_IDENTIFICATION_ASSIGNMENT|"
    rb"EXTERNAL_SOURCE)\b((?:[^;'=]++|'[^']*+')*+);"
)
"""Statements that lead from a product to the name of its file."""
_REPLACED = (
    rb"#(?:%(definition)s|%(shape)s)\s*=(?:[^;'=]++|'[^']*+')*+;|"
    rb"#\d+\s*=\s*SHAPE_DEFINITION_REPRESENTATION\s*\(\s*#\d+\s*,\s*#%(shape)s\s*\)\s*;"
)
"""A product's definition, its shape, and that the one has the other."""
_FILE_NAME = re.compile(rb"'([^'\n]*[^'\s]\.[A-Za-z][A-Za-z0-9]{1,7})'")
_DATA = re.compile(rb"\bDATA\s*[;(]")
_TOKEN = re.compile(rb"'[^']*'|/\*(?:.*?\*/|.*\Z)|#(\d+)", re.DOTALL)


def products_without_shape(data: bytes) -> dict[bytes, bytes]:
    """Definitions, and their shapes, of products in assemblies that hold no others, and whose shape holds nothing."""
    uses = [(match[5], match[6]) for match in USE.finditer(data)]
    if not uses:
        return {}
    parents = {parent for parent, _ in uses}
    placements, products = {m[1] for m in PLACEMENT.finditer(data)}, Products(data)
    items = {m[1]: set(re.findall(rb"\d+", m[3])) for m in SHAPE.finditer(data)}
    # A representation of nothing but its own frame stands for a shape in another file.
    empty = {one for one, held in items.items() if held <= placements and one not in products.linked}
    shapes = {products.definition.get(m[1]): m[2] for m in SHAPE_OF.finditer(data) if m[2] in empty}
    return {child: shapes[child] for _, child in uses if child not in parents and child in shapes}


@dataclass
class OtherFiles:
    """Puts the files of parts into the text of an assembly.

    Attributes:
        read: the text of a STEP file, checked and in UTF-8.
        missing: names of products whose file is not there, and the file.
    """

    read: Callable[[Path], bytes]
    missing: dict[str, str] = field(default_factory=dict)

    def added(self, data: bytes, path: Path, above: tuple[Path, ...] = ()) -> bytes:
        """The text of a file with that of the files that it refers to, and of those that they refer to.

        Raises:
            InputError: one of them is broken, refers to itself, or all are too large.
        """
        waiting = products_without_shape(data)
        files = _files_of(data, waiting) if waiting else {}
        if not files:
            return data
        above = (*above, path.resolve())
        products, texts, offset = Products(data), list[bytes](), _largest(data)
        edits: dict[tuple[int, int], bytes] = {}
        for definition, name in files.items():
            file, shape = _beside(path, name), waiting[definition]
            if file in above or len(above) > _MAX_DEPTH:
                raise InputError(f"{path}: broken STEP (it refers to {name}, which refers to it); export it again")
            other = self.added(self.read(file), file, above) if file else b""
            root = _root(other)
            if root is None or list(waiting.values()).count(shape) > 1:
                self.missing[plain_name(products.name_of(definition)).decode("utf-8", errors="replace")] = name
                continue
            texts.append(_renumbered(other, offset, dict(zip(root, (definition, shape), strict=True))))
            if len(data) + sum(map(len, texts)) > MAX_BYTES:
                raise InputError(f"{path}: more than {MAX_BYTES / 1e6:.0f} MB with its other files; export fewer parts")
            offset += _largest(other)
            replaced = re.finditer(_REPLACED % {b"definition": definition, b"shape": shape}, data)
            edits |= {match.span(): b"" for match in replaced}
        at = data.rfind(b"ENDSEC")
        return edited(data, {**edits, (at, at): b"\n".join([*texts, b""])})


def _files_of(data: bytes, definitions: dict[bytes, bytes]) -> dict[bytes, str]:
    """Names of the files that definitions refer to, of those that refer to one."""
    held = {m[1]: m[2] for m in _DOCUMENT.finditer(data)}
    formations = {m[1]: m[3] for m in DEFINITION.finditer(data)}
    links: dict[bytes, list[bytes]] = {}
    for one, other in ((one, other) for one, text in held.items() for other in references(text)):
        links.setdefault(one, []).append(other)
        links.setdefault(other, []).append(one)
    # Neither another part nor a source, which may be common to all documents, leads on.
    parts = {m[6] for m in USE.finditer(data)}
    files: dict[bytes, str] = {}
    for definition in definitions:
        found = [definition]
        for one in found:
            known = {*found, *parts, formations.get(definition)}
            is_end = one in held and not references(held[one])
            found += [] if is_end else [k for k in dict.fromkeys(links.get(one, ())) if k in held and k not in known]
        names = [name.decode("utf-8", errors="replace") for one in found[1:] for name in _FILE_NAME.findall(held[one])]
        if names:
            files[definition] = next((name for name in names if name.lower().endswith(SUFFIXES)), names[0])
    return files


def _beside(path: Path, name: str) -> Path | None:
    """A STEP file of a name beside another one or below; None without one, so that no other file is ever read."""
    folder, parts = path.resolve().parent, PureWindowsPath(name).parts
    for wanted in (parts, parts[-1:]):
        file = folder.joinpath(*wanted).resolve()
        if not file.is_file() and file.parent.is_dir():
            file = next((one for one in file.parent.iterdir() if one.name.lower() == file.name.lower()), file).resolve()
        if file.is_relative_to(folder) and file.suffix.lower() in SUFFIXES and file.is_file():
            return file
    return None


def _root(data: bytes) -> tuple[bytes, bytes] | None:
    """The definition of the only product of a file that no other uses, and its shape; None without just one."""
    products, used = Products(data), {m[6] for m in USE.finditer(data)}
    roots: dict[bytes, bytes] = {}
    for match in SHAPE_OF.finditer(data):
        definition = products.definition.get(match[1], b"")
        if definition in products.formation and definition not in used:
            roots.setdefault(definition, match[2])
    return next(iter(roots.items())) if len(roots) == 1 else None


def _renumbered(data: bytes, offset: int, own: dict[bytes, bytes]) -> bytes:
    """The statements of a file with other numbers: some of their own, the others raised."""

    def new(match: re.Match[bytes]) -> bytes:
        return b"#" + (own.get(match[1]) or b"%d" % (int(match[1]) + offset)) if match[1] else match[0]

    start = _DATA.search(data)
    return _TOKEN.sub(new, data[data.find(b";", start.start()) + 1 : data.rfind(b"ENDSEC")] if start else b"")


def _largest(data: bytes) -> int:
    """The largest number of a statement."""
    return max((int(number) for number in re.findall(rb"#(\d+)\s*=", data)), default=0)
