"""Buffers and accessors of a glTF file: every size is checked before memory is reserved for it."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from arview.cad.formats.draco import EXTENSION, DracoMesh, decode_draco
from arview.cad.formats.meshopt import decode_meshopt
from arview.cad.formats.raw import MAX_TRIANGLES
from arview.errors import InputError

_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_DRACO_ATTRIBUTES = ("POSITION", "COLOR_0")
_MAX_SPARSE_COUNT = 1_000_000
"""Largest number of elements of an accessor that starts as zeros: they take memory without any bytes in the file."""


class GltfData:
    """Reader of the binary data of one file.

    External buffers are read only from the folder of the file and the folders in it, so that a file of unknown origin
    cannot bring in other files of the machine.
    """

    def __init__(self, tree: dict[str, Any], binary: bytes, path: Path) -> None:
        self.tree = tree
        self.binary = binary
        self.path = path
        self.buffers: dict[int, bytes] = {}
        self.decoded: dict[int, bytes] = {}
        self.draco: dict[int, DracoMesh] | None = None

    def accessor(self, index: int) -> NDArray[Any]:
        """(count, width) values of an accessor, integers scaled to floats where marked ``normalized``."""
        accessor = self.tree["accessors"][_natural(index, "accessor")]
        dtype, width = _DTYPES[accessor["componentType"]], _WIDTHS[accessor["type"]]
        count = _natural(accessor["count"], "accessor count")
        if count > 3 * MAX_TRIANGLES:
            raise InputError(f"{self.path}: an accessor has {count:,} elements; decimate the mesh")
        sparse = accessor.get("sparse")
        if "bufferView" in accessor:
            values = np.array(self._view(accessor["bufferView"], accessor.get("byteOffset", 0), count, dtype, width))
        elif sparse is None or count > _MAX_SPARSE_COUNT:
            raise InputError(f"{self.path}: an accessor of {count:,} elements has no data; export it again")
        else:
            values = np.zeros((count, width), dtype=dtype)
        if sparse is not None:
            self._replace(values, sparse, dtype, width)
        return _scaled(values, accessor)

    def values(self, primitive: dict[str, Any], name: str, decoded: DracoMesh | None) -> NDArray[Any]:
        """(count, width) values of an attribute of a primitive, those of its Draco data where it has some."""
        index = primitive["attributes"][name]
        if decoded is None or name not in decoded.attributes:
            return self.accessor(index)
        return _scaled(decoded.attributes[name], self.tree["accessors"][_natural(index, "accessor")])

    def draco_mesh(self, primitive: dict[str, Any]) -> DracoMesh | None:
        """The decoded mesh of a primitive; None without Draco data, or where it has the same uncompressed.

        All meshes of the file are decoded at the first call.
        """
        compressed = self._draco_of(primitive)
        if compressed is None:
            return None
        if self.draco is None:
            wanted: dict[int, tuple[bytes, dict[str, int]]] = {}
            for mesh in self.tree.get("meshes", []):
                for one in mesh.get("primitives", []):
                    found = self._draco_of(one)
                    if found is not None:
                        view = _natural(found["bufferView"], "bufferView")
                        numbers = {k: _natural(v, k) for k, v in found["attributes"].items() if k in _DRACO_ATTRIBUTES}
                        wanted[view] = self._bytes_of(view), wanted.get(view, (b"", {}))[1] | numbers
            self.draco = dict(zip(wanted, decode_draco(list(wanted.values()), self.path), strict=True))
        return self.draco[compressed["bufferView"]]

    def _draco_of(self, primitive: dict[str, Any]) -> dict[str, Any] | None:
        """The Draco extension of a primitive whose positions are in no buffer of their own."""
        found = primitive.get("extensions", {}).get(EXTENSION)
        if found is None:
            return None
        position = self.tree["accessors"][_natural(primitive["attributes"]["POSITION"], "accessor")]
        return None if "bufferView" in position else dict(found)

    def _bytes_of(self, view_index: int) -> bytes:
        """The bytes of a buffer view; raises InputError where it would reach beyond the data."""
        view = self.tree["bufferViews"][view_index]
        start, length = _natural(view.get("byteOffset", 0), "byteOffset"), _natural(view["byteLength"], "byteLength")
        data = self._buffer(_natural(view["buffer"], "buffer"))
        if start + length > len(data):
            raise InputError(f"{self.path}: truncated: a mesh ends at byte {start + length} of {len(data)}")
        return data[start : start + length]

    def _replace(self, values: NDArray[Any], sparse: dict[str, Any], dtype: str, width: int) -> None:
        """Overwrite the elements that a sparse accessor lists."""
        count = _natural(sparse["count"], "sparse count")
        where, what = sparse["indices"], sparse["values"]
        rows = self._view(where["bufferView"], where.get("byteOffset", 0), count, _DTYPES[where["componentType"]], 1)
        rows = rows.ravel().astype(np.int64)
        if len(rows) and not 0 <= rows.min() <= rows.max() < len(values):
            raise ValueError(f"a sparse accessor replaces element {rows.max()} of {len(values)}")
        values[rows] = self._view(what["bufferView"], what.get("byteOffset", 0), count, dtype, width)

    def _view(self, view_index: int, offset: int, count: int, dtype: str, width: int) -> NDArray[Any]:
        """(count, width) view of a buffer; raises InputError where it would reach beyond the data."""
        view = self.tree["bufferViews"][_natural(view_index, "bufferView")]
        compressed = view.get("extensions", {}).get("EXT_meshopt_compression")
        item = np.dtype(dtype).itemsize
        if compressed is not None:
            data, start, view = self._decoded(view_index, compressed), 0, compressed
        else:
            data = self._buffer(_natural(view["buffer"], "buffer"))
            start = _natural(view.get("byteOffset", 0), "byteOffset")
        start += _natural(offset, "byteOffset")
        stride = _natural(view.get("byteStride") or item * width, "byteStride")
        if stride < item * width:
            raise ValueError(f"a byteStride of {stride} for elements of {item * width} bytes")
        needed = start + stride * (count - 1) + item * width if count else start
        if needed > len(data):
            raise InputError(f"{self.path}: truncated: a mesh ends at byte {needed} of {len(data)}")
        return np.ndarray((count, width), dtype=dtype, buffer=data, offset=start, strides=(stride, item))

    def _decoded(self, view_index: int, compressed: dict[str, Any]) -> bytes:
        """The bytes of a buffer view of EXT_meshopt_compression, decoded once."""
        if view_index not in self.decoded:
            numbers = {key: _natural(compressed[key], key) for key in ("buffer", "byteLength", "byteStride", "count")}
            start = _natural(compressed.get("byteOffset", 0), "byteOffset")
            data = self._buffer(numbers["buffer"])[start : start + numbers["byteLength"]]
            filter_name = str(compressed.get("filter", "NONE"))
            self.decoded[view_index] = decode_meshopt(
                data, numbers["count"], numbers["byteStride"], str(compressed["mode"]), filter_name
            )
        return self.decoded[view_index]

    def _buffer(self, index: int) -> bytes:
        if index not in self.buffers:
            uri = self.tree["buffers"][index].get("uri")
            if uri is None:
                self.buffers[index] = self.binary
            elif uri.startswith("data:"):
                self.buffers[index] = base64.b64decode(uri.split(",", 1)[1])
            else:
                length = _natural(self.tree["buffers"][index]["byteLength"], "byteLength")
                self.buffers[index] = self._external(unquote(uri), length)
        return self.buffers[index]

    def _external(self, name: str, length: int) -> bytes:
        """The first bytes of a file beside the glTF file."""
        folder = self.path.resolve().parent
        other = (folder / name).resolve()
        if "://" in name or not other.is_relative_to(folder):
            raise InputError(
                f"{self.path}: its buffer {name!r} is not a file beside it; put the file there, or use .glb"
            )
        if not other.is_file():
            raise InputError(f"{self.path}: its buffer file {self.path.parent / name} is missing")
        with other.open("rb") as file:
            return file.read(length)


def _scaled(values: NDArray[Any], accessor: dict[str, Any]) -> NDArray[Any]:
    """Values of an accessor, integers scaled to floats where it is marked ``normalized``."""
    if accessor.get("normalized") and values.dtype.kind in "iu":
        return np.maximum(values / float(np.iinfo(values.dtype).max), -1.0)
    return values


def _natural(value: object, what: str) -> int:
    """A whole number from 0 on; raises ValueError for anything else."""
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise ValueError(f"{what} is {value!r}")
    return value
