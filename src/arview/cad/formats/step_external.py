"""Parts of a STEP assembly that are in files of their own: found beside it, and put into its text.

Source: CAx-IF Recommended Practices for External References 2.1. A product without a shape refers to a document,
which names a file; the statements of that file take the place of the product's definition and shape.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path, PureWindowsPath

from arview.cad.formats.raw import short_list
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

SUFFIXES = (".step", ".stp", ".p21")
MAX_BYTES = 500_000_000
"""Largest size of an assembly with all its files: files that use others twice multiply."""
_MAX_DEPTH = 30
_DOCUMENT = re.compile(
    rb"#(\d+)\s*=\s*\(?\s*(?:PRODUCT_DEFINITION_WITH_ASSOCIATED_DOCUMENTS|PRODUCT_DEFINITION_FORMATION\w*|DOCUMENT_FILE|"
    rb"DOCUMENT|DOCUMENT_PRODUCT_EQUIVALENCE|APPLIED_DOCUMENT_REFERENCE|APPLIED_EXTERNAL_IDENTIFICATION_ASSIGNMENT|"
    rb"EXTERNAL_SOURCE)\b((?:[^;']++|'[^']*+')*+);"
)
"""Statements that lead from a product to the name of its file."""
_FILE_NAME = re.compile(rb"'([^'\n]*[^'\s]\.[A-Za-z][A-Za-z0-9]{1,7})'")
_DATA = re.compile(rb"\bDATA\s*(?:\([^;]*\))?;(.*)\bENDSEC\s*;", re.DOTALL)
_TOKEN = re.compile(rb"'[^']*'|/\*(?:.*?\*/|.*\Z)|#(\d+)", re.DOTALL)


def products_without_shape(data: bytes) -> dict[bytes, bytes]:
    """Definitions, and their shapes, of products in assemblies that hold no others, and whose shape holds nothing."""
    uses = [(match[5], match[6]) for match in USE.finditer(data)]
    if not uses:
        return {}
    parents = {parent for parent, _ in uses}
    placements = {m[1] for m in PLACEMENT.finditer(data)}
    products = Products(data)
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
        above = (*above, path.resolve())
        products = Products(data) if files else None
        edits: dict[tuple[int, int], bytes] = {}
        texts: list[bytes] = []
        size = len(data)
        offset = max((int(n) for n in re.findall(rb"#(\d+)\s*=", data)), default=0) if files else 0
        for definition, name in files.items():
            assert products is not None
            file = _beside(path, name)
            if file in above or len(above) > _MAX_DEPTH:
                raise InputError(f"{path}: broken STEP (it refers to {name}, which refers to it); export it again")
            root = None
            if file is not None:
                other = self.added(self.read(file), file, above)
                root = _root(other)
            shape = waiting[definition]
            if root is None or list(waiting.values()).count(shape) > 1:
                self.missing[plain_name(products.name_of(definition)).decode("utf-8", errors="replace")] = name
                continue
            size += len(other)
            if size > MAX_BYTES:
                raise InputError(f"{path}: more than {MAX_BYTES / 1e6:.0f} MB with its other files; export fewer parts")
            texts.append(_renumbered(other, offset, dict(zip(root, (definition, shape), strict=True))))
            offset += max(int(n) for n in re.findall(rb"#(\d+)\s*=", other))
            edits |= _statements_of(data, definition, shape)
        at = data.rfind(b"ENDSEC")
        return edited(data, {**edits, (at, at): b"\n".join(texts) + b"\n"}) if texts else data

    def note(self) -> list[str]:
        """What to say of the files that are missing."""
        if not self.missing:
            return []
        told = short_list([f"{file} ({name})" for name, file in self.missing.items()])
        return [
            f"left out, because their STEP files are not beside it, or hold no single product; put them there: {told}"
        ]


def _files_of(data: bytes, definitions: dict[bytes, bytes]) -> dict[bytes, str]:
    """Names of the files that definitions refer to, of those that refer to one."""
    held = {m[1]: m[2] for m in _DOCUMENT.finditer(data)}
    formations = {m[1]: m[3] for m in DEFINITION.finditer(data)}
    links: dict[bytes, list[bytes]] = {}
    for one, text in held.items():
        for other in references(text):
            links.setdefault(one, []).append(other)
            # A source may be common to all documents.
            if b"EXTERNAL_SOURCE" not in text:
                links.setdefault(other, []).append(one)
    parts = {m[6] for m in USE.finditer(data)}
    files: dict[bytes, str] = {}
    for definition in definitions:
        seen = {definition: b""}
        waiting = [definition]
        for one in waiting:
            for other in links.get(one, ()):
                if other in seen or other in parts or other not in held or other == formations.get(definition):
                    continue
                seen[other] = held[other]
                waiting.append(other)
        names = [name.decode("utf-8", errors="replace") for text in seen.values() for name in _FILE_NAME.findall(text)]
        if names:
            files[definition] = next((name for name in names if name.lower().endswith(SUFFIXES)), names[0])
    return files


def _beside(path: Path, name: str) -> Path | None:
    """A STEP file of a name beside another one or below; None without one, so that no other file is ever read."""
    folder = path.resolve().parent
    parts = PureWindowsPath(name).parts
    for wanted in (parts, parts[-1:]):
        file = folder.joinpath(*wanted).resolve()
        if not file.is_file() and file.parent.is_dir():
            file = next((one for one in file.parent.iterdir() if one.name.lower() == file.name.lower()), file).resolve()
        if file.is_relative_to(folder) and file.suffix.lower() in SUFFIXES and file.is_file():
            return file
    return None


def _root(data: bytes) -> tuple[bytes, bytes] | None:
    """The definition of the only product of a file that no other uses, and its shape; None without just one."""
    products = Products(data)
    used = {m[6] for m in USE.finditer(data)}
    roots: dict[bytes, bytes] = {}
    for match in SHAPE_OF.finditer(data):
        definition = products.definition.get(match[1], b"")
        if definition in products.formation and definition not in used:
            roots.setdefault(definition, match[2])
    return next(iter(roots.items())) if len(roots) == 1 else None


def _renumbered(data: bytes, offset: int, own: dict[bytes, bytes]) -> bytes:
    """The statements of a file with other numbers: some of their own, the others raised."""

    def new(match: re.Match[bytes]) -> bytes:
        number = match[1]
        return match[0] if number is None else b"#" + (own.get(number) or b"%d" % (int(number) + offset))

    found = _DATA.search(data)
    return _TOKEN.sub(new, found[1]) if found else b""


def _statements_of(data: bytes, definition: bytes, shape: bytes) -> dict[tuple[int, int], bytes]:
    """Edits that remove the statements of a product's definition, of its shape, and that the one has the other."""
    spans = [m.span() for m in SHAPE_OF.finditer(data) if m[2] == shape]
    for one in (definition, shape):
        found = re.search(rb"(?<!\d)#%s\s*=((?:[^;']++|'[^']*+')*+)(?=;)" % one, data)
        spans += [found.span()] if found else []
    return dict.fromkeys(spans, b"")
