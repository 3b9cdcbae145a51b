"""The JSON Schema of ``inspection.json`` as a page to read."""

from __future__ import annotations

import json
from importlib import resources
from typing import Any

from arview.inspection.record import SCHEMA_VERSION

_INTRODUCTION = """# inspection.json {version}

What `arview measure` writes and everything else reads: the measured deviations of one built part. This page is made
of the JSON Schema in `src/arview/inspection/schema/inspection-{version}.json` (`arview.inspection.schema_doc`); a test
keeps the two together.

Lengths are in millimetres, angles in degrees (covariances in radians), vectors along the axes of the model, in the
datum frame. A degree of freedom that was not determined is `null`, never a number. Files of version 1.0 are still
read; a file of a newer version is refused.

"""


def schema_markdown() -> str:
    """A section for each object of the schema, with a table of its fields."""
    file = resources.files("arview.inspection") / "schema" / f"inspection-{SCHEMA_VERSION}.json"
    schema = json.loads(file.read_text(encoding="utf-8"))
    sections = [_section("inspection (the file)", schema)]
    for name, definition in schema["$defs"].items():
        if definition.get("type") == "object":
            sections.append(_section(name, definition))
    return _INTRODUCTION.format(version=SCHEMA_VERSION) + "\n".join(sections)


def _section(title: str, definition: dict[str, Any]) -> str:
    lines = [f"## {title}", ""]
    if definition.get("description"):
        lines += [definition["description"], ""]
    lines += ["| field | type | | what it is |", "|---|---|---|---|"]
    required = set(definition.get("required", ()))
    nested: list[str] = []
    for name, value in definition.get("properties", {}).items():
        need = "required" if name in required else ""
        lines.append(f"| `{name}` | {_type(value)} | {need} | {_cell(value.get('description', ''))} |")
        inner = _inner_object(value)
        if inner is not None:
            nested.append(_section(f"{title.split(' ')[0]}.{name}", inner))
    return "\n".join([*lines, ""]) + ("\n" + "\n".join(nested) if nested else "")


def _inner_object(value: dict[str, Any]) -> dict[str, Any] | None:
    """An object that is described in place, or the members of a list of such."""
    value = value.get("items", value) if value.get("type") == "array" else value
    kinds = value.get("type")
    is_object = kinds == "object" or (isinstance(kinds, list) and "object" in kinds)
    return value if is_object and value.get("properties") else None


def _type(value: dict[str, Any]) -> str:
    if "$ref" in value:
        name = value["$ref"].rsplit("/", 1)[-1]
        return "number ≥ 0" if name == "length" else f"[{name}](#{name})"
    if "const" in value:
        return f"`{json.dumps(value['const'])}`"
    if "enum" in value:
        return ", ".join(f"`{json.dumps(item)}`" for item in value["enum"])
    if "anyOf" in value:
        return " or ".join(_type(item) for item in value["anyOf"])
    kinds = value.get("type", "any")
    if kinds == "array":
        low, high = value.get("minItems"), value.get("maxItems")
        count = f"{low} × " if low is not None and low == high else ""
        return f"list of {count}{_type(value.get('items', {}))}"
    text = " or ".join(kinds) if isinstance(kinds, list) else str(kinds)
    if value.get("minimum") == 0:
        text += " ≥ 0"
    return f"{text} > 0" if value.get("exclusiveMinimum") == 0 else text


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
