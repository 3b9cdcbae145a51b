"""A file of named arrays with a JSON header: memory-mapped when read, or packed into a quarter of the size."""

from __future__ import annotations

import json
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.core.atomic import replacing
from arview.errors import InputError, OutputError

_MAGIC = b"ARVIEW-GUIDEVIEWS\n"
_ALIGNMENT = 64
_STEPS = 65535
"""Steps into which the range of a packed float32 array is divided: 5 µm of a part 330 mm across."""
MAX_UNPACKED_BYTES = 1_000_000_000
"""Largest packed array that is read."""


def write_arrays(path: Path, meta: dict[str, Any], arrays: dict[str, NDArray[Any]], is_packed: bool = False) -> None:
    """Write arrays and metadata to one file, atomically.

    Args:
        path: of the file.
        meta: metadata that JSON can hold.
        arrays: by their names.
        is_packed: deflate the arrays, and keep float32 ones to 1/65535 of their range.

    Raises:
        OutputError: the folder cannot be written or the disk is full; nothing is left behind.
    """
    offset, blocks = 0, []
    layout: dict[str, Any] = {}
    for name, array in arrays.items():
        data, entry = _packed(array) if is_packed else (np.ascontiguousarray(array).tobytes(), {})
        layout[name] = {"dtype": array.dtype.str, "shape": list(array.shape), "offset": offset, **entry}
        blocks.append(data + b"\0" * (-len(data) % _ALIGNMENT))
        offset += len(blocks[-1])
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
            for block in blocks:
                file.write(block)
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
    # As a plain array, still mapped: slices of a memmap are slow, and views are made of many of them.
    mapped = np.memmap(path, dtype=np.uint8, mode="r").view(np.ndarray)
    arrays = {}
    try:
        meta, layout = dict(header["meta"]), dict(header["arrays"])
        for name, entry in layout.items():
            dtype, shape = np.dtype(entry["dtype"]), tuple(entry["shape"])
            first = start + entry["offset"]
            if "packed" in entry:
                if first + entry["packed"] > size:
                    raise InputError(damaged)
                arrays[name] = _unpacked(bytes(mapped[first : first + entry["packed"]]), dtype, shape, entry)
                continue
            last = first + dtype.itemsize * int(np.prod(shape, dtype=np.int64))
            if last > size:
                raise InputError(f"{path}: the guide-view set is truncated; make it again with `arview guideviews`")
            arrays[name] = mapped[first:last].view(dtype).reshape(shape)
    except (KeyError, TypeError, ValueError, zlib.error) as error:
        raise InputError(damaged) from error
    return meta, arrays


def _packed(array: NDArray[Any]) -> tuple[bytes, dict[str, Any]]:
    """The deflated bytes of an array, and what the header must say of them."""
    entry: dict[str, Any] = {}
    if array.dtype == np.float32 and array.size:
        low, high = float(array.min()), float(array.max())
        entry["range"] = [low, high]
        array = np.round((array.astype(np.float64) - low) / max(high - low, 1e-12) * _STEPS).astype(np.uint16)
    # Bytes of one significance in a row deflate better than whole numbers.
    planes = np.ascontiguousarray(array).view(np.uint8).reshape(-1, array.dtype.itemsize).T
    data = zlib.compress(np.ascontiguousarray(planes).tobytes(), 9)
    return data, {"packed": len(data), **entry}


def _unpacked(data: bytes, dtype: np.dtype[Any], shape: tuple[int, ...], entry: dict[str, Any]) -> NDArray[Any]:
    """An array from its deflated bytes.

    Raises:
        ValueError: the bytes are not those of such an array.
    """
    stored = np.dtype(np.uint16) if "range" in entry else dtype
    count = int(np.prod(shape, dtype=np.int64))
    if not 0 <= count * stored.itemsize <= MAX_UNPACKED_BYTES:
        raise ValueError("too large")
    inflate = zlib.decompressobj()
    content = inflate.decompress(data, count * stored.itemsize + 1)
    if len(content) != count * stored.itemsize:
        raise ValueError("another size")
    planes = np.frombuffer(content, np.uint8).reshape(stored.itemsize, count)
    array = np.ascontiguousarray(planes.T).reshape(-1).view(stored).reshape(shape)
    if "range" in entry:
        low, high = entry["range"]
        array = (low + array.astype(np.float64) * ((high - low) / _STEPS)).astype(np.float32)
    return array
