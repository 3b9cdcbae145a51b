"""Changes of valid files: bytes, numbers, lines and nodes are replaced, removed, repeated or inserted."""

from __future__ import annotations

import io
import json
import re
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from hypothesis import strategies as st

SNIPPETS = (
    b"-1",
    b"1e999",
    b"99999999999",
    b"0",
    b"null",
    b"[",
    b"{",
    b"nan",
    b"\xff\xfe",
    b"<a>",
    b"//",
    b"\n",
    b"\0",
    b'"',
    b"'",
    b"=",
    b",",
    b";",
    b"- ",
    b"!!python/object:x",
    b"&a [*a]",
    b"\xe2\x80\xa8",
)
NUMBERS = (
    b"0",
    b"-0",
    b"1",
    b"-1",
    b"2",
    b"0.5",
    b"1e-30",
    b"1e30",
    b"1e308",
    b"1e999",
    b"nan",
    b"-inf",
    b"4294967295",
    b"2147483648",
    b"9223372036854775808",
    b"1e5000",
    b"007",
    b"0x10",
    b"1,5",
    b"1_000",
    b"",
    b"true",
)
VALUES: tuple[Any, ...] = (
    None,
    True,
    False,
    0,
    -1,
    1,
    0.5,
    1e308,
    float("nan"),
    float("inf"),
    2**63,
    10**400,
    "",
    "x",
    "nan",
    "0",
    "\u202e\0é",
    "a" * 5000,
    "../../etc/passwd",
    "\ud800",
    [],
    {},
    [0],
    [[1, 2], [3]],
    {"a": None},
    [None] * 50,
)
_NUMBER = re.compile(rb"(?<![\w.])[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?(?![\w.])")


@dataclass(frozen=True)
class Change:
    """One change: its kind, two places as large integers that are taken modulo what is there, and a content."""

    kind: str
    first: int
    second: int
    content: Any

    def apply(self, data: bytes) -> bytes:
        """The data with this change; unchanged where it does not apply."""
        return _KINDS[self.kind](data, self)


def _set(data: bytes, change: Change) -> bytes:
    at = change.first % max(1, len(data))
    return data[:at] + bytes([change.second % 256]) + data[at + 1 :]


def _word(data: bytes, change: Change) -> bytes:
    at = change.first % max(1, len(data)) // 4 * 4
    value = (0, 1, 0xFFFFFFFF, 0x7FFFFFFF, 0x80000000, 0x10000, 0x7FC00000, 0x7F800000)[change.second % 8]
    return data[:at] + value.to_bytes(4, "little") + data[at + 4 :]


def _delete(data: bytes, change: Change) -> bytes:
    at = change.first % max(1, len(data))
    return data[:at] + data[at + 1 + change.second % 60 :]


def _repeat(data: bytes, change: Change) -> bytes:
    at = change.first % max(1, len(data))
    return data[:at] + data[at : at + 1 + change.second % 400] + data[at:]


def _insert(data: bytes, change: Change) -> bytes:
    at = change.first % (len(data) + 1)
    return data[:at] + SNIPPETS[change.second % len(SNIPPETS)] + data[at:]


def _cut(data: bytes, change: Change) -> bytes:
    return data[: change.first % (len(data) + 1)]


def _number(data: bytes, change: Change) -> bytes:
    found = list(_NUMBER.finditer(data))
    if not found:
        return data
    one = found[change.first % len(found)]
    return data[: one.start()] + NUMBERS[change.second % len(NUMBERS)] + data[one.end() :]


def _line(data: bytes, change: Change) -> bytes:
    lines = data.splitlines(keepends=True)
    if not lines:
        return data
    at, other = change.first % len(lines), change.second % len(lines)
    kind = change.second % 3
    if kind == 0:
        del lines[at]
    elif kind == 1:
        lines.insert(other, lines[at])
    else:
        lines[at], lines[other] = lines[other], lines[at]
    return b"".join(lines)


def _node(data: bytes, change: Change) -> bytes:
    """Replace, remove or rename a node of a JSON document, or of one line of JSON lines."""
    try:
        root = json.loads(data)
    except (ValueError, RecursionError):
        return data
    places: list[tuple[Any, Any]] = []

    def visit(node: Any) -> None:
        for key in list(node) if isinstance(node, dict) else range(len(node)):
            places.append((node, key))
            if isinstance(node[key], (dict, list)):
                visit(node[key])

    if not isinstance(root, (dict, list)):
        return data
    visit(root)
    if not places:
        return data
    node, key = places[change.first % len(places)]
    kind = change.second % (len(VALUES) + 3)
    if kind < len(VALUES):
        node[key] = VALUES[kind]
    elif kind == len(VALUES):
        del node[key]
    elif isinstance(node, dict):
        node[f"{key}_" if kind % 2 else str(key).upper()] = node.pop(key)
    else:
        node.append(node[key])
    return json.dumps(root).encode("utf-8", "surrogatepass")


_KINDS: dict[str, Callable[[bytes, Change], bytes]] = {
    "set": _set,
    "word": _word,
    "delete": _delete,
    "repeat": _repeat,
    "insert": _insert,
    "cut": _cut,
    "number": _number,
    "line": _line,
    "node": _node,
}
_WEIGHTED = (
    ("node",) * 4 + ("number",) * 4 + ("line",) * 2 + ("insert", "insert", "set", "word", "delete", "repeat", "cut")
)
CHANGES = st.lists(
    st.builds(Change, st.sampled_from(_WEIGHTED), st.integers(0, 1 << 30), st.integers(0, 1 << 16), st.none()),
    min_size=1,
    max_size=5,
)


def changed(data: bytes, changes: list[Change], inside: bool) -> bytes:
    """A file with these changes; ``inside``: in a member of a ZIP archive, such as 3MF and NPZ, if it is one."""
    if inside and data.startswith(b"PK"):
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        name = sorted(members)[changes[0].second % len(members)]
        for change in changes:
            members[name] = change.apply(members[name])
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
            for one, content in members.items():
                archive.writestr(one, content)
        return out.getvalue()
    for change in changes:
        data = change.apply(data)
    return data
