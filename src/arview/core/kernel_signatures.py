"""Signatures of kernels as plain values, and the file that says with which types each kernel is called."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from typing import Any

import numba

nb_types: Any = numba.core.types
SIGNATURES_FILE = Path(__file__).with_name("kernel_signatures.json")


def recorded_signatures() -> dict[str, list[Any]]:
    """By kernel, ``module:name``, the signatures with which arview's commands and tests call it."""
    content: dict[str, list[Any]] = json.loads(SIGNATURES_FILE.read_text(encoding="utf-8"))
    return content


def encode_signature(signature: tuple[Any, ...]) -> list[Any]:
    """A numba signature as plain values for JSON.

    Raises:
        TypeError: it holds a type that has no plain form.
    """
    return [encode_type(part) for part in signature]


def encode_type(part: Any) -> Any:
    """A numba type as plain values for JSON; raises TypeError for a type that has no plain form."""
    if isinstance(part, nb_types.Array):
        return {"array": str(part.dtype), "ndim": part.ndim, "layout": part.layout, "writable": part.mutable}
    if isinstance(part, nb_types.BaseNamedTuple):
        return {"named": f"{part.instance_class.__module__}:{part.instance_class.__qualname__}", "of": _items(part)}
    if isinstance(part, nb_types.BaseTuple):
        return {"tuple": _items(part)}
    if isinstance(part, nb_types.Omitted):
        return {"omitted": part.value}
    is_plain = isinstance(part, (nb_types.Number, nb_types.Boolean, nb_types.NoneType, nb_types.UnicodeType))
    if is_plain and not isinstance(part, nb_types.Literal):
        return str(part)
    raise TypeError(f"{part}: no plain form")


def _items(part: Any) -> list[Any]:
    return [encode_type(item) for item in part]


def decode_type(part: Any) -> Any:
    """The numba type of what `encode_type` returns."""
    if isinstance(part, str):
        return nb_types.none if part == "none" else getattr(nb_types, {"bool": "boolean"}.get(part, part))
    if "array" in part:
        return nb_types.Array(decode_type(part["array"]), part["ndim"], part["layout"], readonly=not part["writable"])
    if "named" in part:
        module, name = part["named"].split(":")
        cls = getattr(importlib.import_module(module), name)
        items = [decode_type(item) for item in part["of"]]
        if items and all(item == items[0] for item in items):
            return nb_types.NamedUniTuple(items[0], len(items), cls)
        return nb_types.NamedTuple(items, cls)
    if "tuple" in part:
        return nb_types.BaseTuple.from_types([decode_type(item) for item in part["tuple"]])
    return nb_types.Omitted(part["omitted"])
