"""A file of named arrays with a JSON header, memory-mapped when read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.core.atomic import replacing
from arview.errors import InputError, OutputError

_MAGIC = b"ARVIEW-GUIDEVIEWS\n"
_ALIGNMENT = 64


def write_arrays(path: Path, meta: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> None:
    """Write arrays and metadata to one file, atomically.

    Raises:
        OutputError: the folder cannot be written or the disk is full; nothing is left behind.
    """
    offset, layout = 0, {}
    for name, array in arrays.items():
        layout[name] = {"dtype": array.dtype.str, "shape": list(array.shape), "offset": offset}
        offset += -(-array.nbytes // _ALIGNMENT) * _ALIGNMENT
    header = json.dumps({"meta": meta, "arrays": layout}).encode()
    start = len(_MAGIC) + 8 + len(header)
    padding = -start % _ALIGNMENT
    header += b" " * padding
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as file:
            file.write(_MAGIC)
            file.write(len(header).to_bytes(8, "little"))
            file.write(header)
            for array in arrays.values():
                data = np.ascontiguousarray(array).tobytes()
                file.write(data + b"\0" * (-len(data) % _ALIGNMENT))
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error


def read_arrays(path: Path) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Metadata and memory-mapped arrays of a file made by `write_arrays`.

    Raises:
        InputError: not such a file, truncated, or missing.
    """
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            if file.read(len(_MAGIC)) != _MAGIC:
                raise InputError(f"{path}: not a guide-view set; make one with `arview guideviews PART -o {path}`")
            length = int.from_bytes(file.read(8), "little")
            if length > size:
                raise InputError(f"{path}: the guide-view set is damaged; make it again with `arview guideviews`")
            header = json.loads(file.read(length))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (ValueError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: the guide-view set is damaged; make it again with `arview guideviews`") from error
    damaged = f"{path}: the guide-view set is damaged; make it again with `arview guideviews`"
    start = len(_MAGIC) + 8 + length
    mapped = np.memmap(path, dtype=np.uint8, mode="r")
    arrays = {}
    try:
        meta, layout = dict(header["meta"]), dict(header["arrays"])
        for name, entry in layout.items():
            dtype, shape = np.dtype(entry["dtype"]), tuple(entry["shape"])
            first = start + entry["offset"]
            last = first + dtype.itemsize * int(np.prod(shape, dtype=np.int64))
            if last > size:
                raise InputError(f"{path}: the guide-view set is truncated; make it again with `arview guideviews`")
            arrays[name] = mapped[first:last].view(dtype).reshape(shape)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(damaged) from error
    return meta, arrays
