"""The text of a camera file as trees of maps, lists, numbers and words, whether it is JSON, YAML, XML or INI.

OpenCV's FileStorage is read in all three forms: its YAML has a header line and matrices with a tag of their own, its
XML has lists as elements named ``_``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from typing import Any
from xml.etree import ElementTree

import yaml

try:
    from yaml import CSafeLoader as SafeLoader
except ImportError:  # PyYAML without libyaml: the same, ten times slower
    from yaml import SafeLoader

from arview.errors import InputError

MAX_BYTES = 32_000_000
"""Largest camera file; BOP and nerfstudio keep an entry for each frame in it."""
MAX_YAML_BYTES = 4_000_000
"""Largest YAML file: its reader takes a second for each megabyte."""
_INI_SECTION = re.compile(r"^\[[A-Za-z_]\w*\][ \t]*$", re.MULTILINE)
_MAX_NODES = 1_000_000
"""Most values in a YAML file, whose aliases can make few bytes many values."""


class _Loader(SafeLoader):
    """YAML's safe reader, with OpenCV's tags and without a second value for a key."""


def _once(pairs: Iterable[tuple[Any, Any]]) -> dict[str, Any]:
    """A map of keys that each occur once."""
    content: dict[str, Any] = {}
    for key, value in pairs:
        if str(key) in content:
            raise InputError(f"holds {str(key)[:40]} twice; keep one of them")
        content[str(key)] = value
    return content


def _map(loader: Any, node: Any, deep: bool = True) -> dict[str, Any]:
    build = loader.construct_object
    return _once((build(key, deep=True), build(value, deep=True)) for key, value in node.value)


def _text(loader: Any, node: Any) -> str:
    return str(node.value)


_Loader.add_constructor("tag:yaml.org,2002:map", _map)
for _tag in ("opencv-matrix", "opencv-nd-matrix"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_tag}", _map)
# Dates and numbers with colons ("12:30") stay words.
_Loader.add_constructor("tag:yaml.org,2002:timestamp", _text)


def parse_trees(text: str) -> list[Any]:
    """The trees of a file's text: one, or one for each document of a YAML file.

    Raises:
        InputError: the text is not what its first character says it is.
    """
    try:
        if _INI_SECTION.search(text) and not text.startswith("{"):
            return [_from_ini(text)]
        if text.startswith(("{", "[")):
            return [_from_json(text)]
        if text.startswith("<"):
            return [_from_element(parse_xml(text))]
        return _from_yaml(text)
    except RecursionError as error:
        raise InputError("is nested too deeply for a camera file; export it again") from error


def numbers_of(value: Any, key: str) -> list[float]:
    """The numbers of a value: a number, a list, a list of rows, or a matrix with ``data``.

    Raises:
        InputError: it holds something else, or a matrix has other rows and columns than numbers.
    """
    if isinstance(value, dict) and "data" in value:
        numbers = numbers_of(value["data"], key)
        rows, columns = value.get("rows"), value.get("cols")
        if isinstance(rows, int) and isinstance(columns, int) and rows * columns != len(numbers):
            raise InputError(f"{key} has {len(numbers)} numbers, not {rows} × {columns}; export it again")
        return numbers
    if isinstance(value, bool) or value is None or isinstance(value, dict):
        raise InputError(f"{key} is {json.dumps(value, default=str)[:60]}; expected numbers")
    if isinstance(value, list):
        return [number for item in value for number in numbers_of(item, key)]
    try:
        return [float(re.sub(r"\.(?=(?:nan|inf)$)", "", str(value).strip(), flags=re.IGNORECASE))]
    except (ValueError, OverflowError) as error:
        raise InputError(f"{key} is '{str(value)[:60]}'; expected numbers") from error


def _from_json(text: str) -> Any:
    try:
        return json.loads(text, object_pairs_hook=_once)
    except ValueError as error:  # also a number of thousands of digits
        raise InputError(f"is not valid JSON ({str(error)[:100]}); correct or export it again") from error


def _from_yaml(text: str) -> list[Any]:
    if len(text) > MAX_YAML_BYTES:
        raise InputError(f"is {len(text) / 1e6:.0f} MB of YAML; a camera file has at most {MAX_YAML_BYTES / 1e6:.0f}")
    # OpenCV writes "%YAML:1.0", which is no directive of YAML.
    body = re.sub(r"\A%YAML\S*[^\n]*\n", "", text)
    try:
        documents = [tree for tree in yaml.load_all(body, Loader=_Loader) if tree is not None]
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f"line {mark.line + 1 + text.startswith('%YAML')}: " if mark is not None else ""
        problem = " ".join(str(getattr(error, "problem", None) or "").split())[:100]
        raise InputError(f"is not valid YAML ({place}{problem}); correct or export it again") from error
    except ValueError as error:
        raise InputError(f"is not valid YAML ({str(error)[:60]}); correct or export it again") from error
    _count_nodes(documents)
    return documents


def _count_nodes(tree: Any) -> None:
    """Raise InputError when aliases make a tree endless or far too large."""
    waiting, count = [tree], 0
    while waiting:
        node = waiting.pop()
        count += 1
        if count > _MAX_NODES:
            raise InputError("refers to itself or repeats parts by aliases too often; export it without aliases")
        if isinstance(node, dict):
            waiting.extend(node.values())
        elif isinstance(node, list):
            waiting.extend(node)


def _from_ini(text: str) -> Any:
    """Sections of ``name = value`` (ZED), or of a name and the lines of its numbers below it (ROS's ``ost.txt``)."""
    sections: dict[str, Any] = {}
    section: dict[str, Any] = {}
    name = ""
    for line in (raw.strip() for raw in text.splitlines()):
        if not line or line.startswith(("#", ";")):
            name = name if line else ""
            continue
        if line.startswith("[") and line.endswith("]"):
            section = sections.setdefault(line[1:-1], {})
            name = ""
        elif "=" in line:
            key, _, value = line.partition("=")
            section[key.strip()] = _value(value)
        elif name:
            values = _value(line)
            section[name] = (section[name] or []) + (values if isinstance(values, list) else [values])
        else:
            name = line
            section[name] = None
    image = sections.pop("image", {})  # of ost.txt, width and height of the other section
    size = {key: value[0] for key, value in image.items() if isinstance(value, list) and len(value) == 1}
    return {key: size | value for key, value in sections.items()}


def parse_xml(text: str) -> ElementTree.Element:
    """The root of an XML text.

    Raises:
        InputError: it is broken, or defines entities, which can make few bytes many.
    """
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(
            "the XML defines entities or a document type, which a camera file never needs; export it again"
        )
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(f"is not valid XML ({error}); export it again") from error


def _from_element(element: ElementTree.Element) -> Any:
    children = list(element)
    if not children:
        return _value(element.text or "")
    if all(child.tag == "_" for child in children):
        return [_from_element(child) for child in children]
    return _once((child.tag, _from_element(child)) for child in children)


def _value(text: str) -> Any:
    """A number, a list of numbers, or a word."""
    words = text.split()
    try:
        numbers: list[float] = [number for word in words for number in numbers_of(word, "")]
    except InputError:
        return text.strip().strip('"')
    whole = [int(number) if number.is_integer() else number for number in numbers]
    return whole[0] if len(whole) == 1 else whole
