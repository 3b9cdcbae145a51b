"""Signatures of kernels as plain values, and the file that says with which types each kernel is called.

The file is made from a run of the commands or tests that records what they call:

    ARVIEW_RECORD_KERNELS=out/kernels make test
    python -m arview.core.kernel_signatures out/kernels
"""

from __future__ import annotations

import importlib
import json
import sys
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


def merge_records(folder: Path) -> dict[str, list[Any]]:
    """The signatures of arview's kernels in all files that `kernel.record_signatures` wrote, each once and in order."""
    merged: dict[str, list[Any]] = {}
    for path in sorted(folder.glob("*.json")):
        for name, signatures in json.loads(path.read_text(encoding="utf-8")).items():
            if name.startswith("arview."):
                known = merged.setdefault(name, [])
                known += [signature for signature in signatures if signature not in known]
    return {name: sorted(merged[name], key=json.dumps) for name in sorted(merged)}


def _main() -> None:
    if len(sys.argv) != 2 or not Path(sys.argv[1]).is_dir():
        raise SystemExit("usage: python -m arview.core.kernel_signatures FOLDER; see the docstring of the module")
    merged = merge_records(Path(sys.argv[1]))
    kernels = (
        f'"{name}": [\n' + ",\n".join(f" {json.dumps(signature)}" for signature in signatures) + "\n]"
        for name, signatures in merged.items()
    )
    SIGNATURES_FILE.write_text("{\n" + ",\n".join(kernels) + "\n}\n", encoding="utf-8")
    print(f"{SIGNATURES_FILE}: {len(merged)} kernels, {sum(map(len, merged.values()))} signatures")


if __name__ == "__main__":
    _main()
