"""Decoder of EXT_meshopt_compression: vertices, triangles and index sequences of glTF, and the filters of vertices.

Source: Khronos extension EXT_meshopt_compression (bitstreams of version 0 for attributes, 0 and 1 for indices).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.geometry import Array

Bytes = NDArray[np.uint8]

_BLOCK_BYTES, _BLOCK_ELEMENTS, _GROUP = 8192, 256, 16
_MAX_RATIO = 65
"""Decoded bytes for each encoded byte: 16 equal bytes take two bits, and triangles of 12 bytes one byte."""


def decode_meshopt(data: bytes, count: int, stride: int, mode: str, filter_name: str) -> bytes:
    """The bytes of a compressed buffer view.

    Args:
        data: encoded bytes.
        count: number of elements.
        stride: bytes of an element.
        mode: ATTRIBUTES, TRIANGLES or INDICES.
        filter_name: NONE, QUATERNION or EXPONENTIAL.

    Raises:
        ValueError: data that is not as the extension says, or truncated.
        IndexError: truncated data.
    """
    if count * stride > _MAX_RATIO * len(data) + _BLOCK_BYTES:
        raise ValueError(f"meshopt: {len(data)} bytes cannot hold {count} elements")
    if mode == "ATTRIBUTES":
        return _filtered(_attributes(np.frombuffer(data, dtype=np.uint8), count, stride), filter_name)
    if filter_name != "NONE" or stride not in (2, 4):
        raise ValueError(f"meshopt: {mode} of {stride} bytes with filter {filter_name}")
    if mode not in ("TRIANGLES", "INDICES"):
        raise ValueError(f"meshopt: mode {mode!r}")
    indices = _triangles(data, count) if mode == "TRIANGLES" else _sequence(data, count)
    return np.array(indices, dtype=np.int64).astype(np.uint16 if stride == 2 else np.uint32).tobytes()


def _attributes(data: Bytes, count: int, stride: int) -> Bytes:
    """(count, stride) bytes of vertices: each byte is coded as a difference to that of the element before."""
    if stride % 4 or not 4 <= stride <= 256 or len(data) < 1 + stride:
        raise ValueError(f"meshopt: elements of {stride} bytes in {len(data)} bytes")
    if data[0] != 0xA0:
        raise ValueError(f"meshopt: attributes of version {data[0]:#x}, expected 0xa0")
    end, last = len(data) - max(stride, 32), data[len(data) - stride :]
    block = min((_BLOCK_BYTES // stride) & ~15, _BLOCK_ELEMENTS)
    result, at = np.empty((count, stride), dtype=np.uint8), 1
    for start in range(0, count, block):
        size = min(block, count - start)
        for k in range(stride):
            deltas, at = _byte_deltas(data, at, end, size)
            # Differences alternate in sign (zigzag), and wrap around.
            signed = (deltas >> 1) ^ (0 - (deltas & 1)).astype(np.uint8)
            result[start : start + size, k] = last[k] + np.cumsum(signed, dtype=np.uint8)
        last = result[start + size - 1]
    if at != end:
        raise ValueError("meshopt: attributes end at another place than their data")
    return result


def _byte_deltas(data: Bytes, at: int, end: int, size: int) -> tuple[Bytes, int]:
    """Coded differences (size,) of one byte of a block, and the place after them."""
    groups = (size + _GROUP - 1) // _GROUP
    codes = data[at : at + (groups + 3) // 4]
    at += len(codes)
    deltas = np.zeros(groups * _GROUP, dtype=np.uint8)
    for group in range(groups):
        code = (int(codes[group // 4]) >> (2 * (group % 4))) & 3
        if code == 0:
            continue
        here, bits = slice(group * _GROUP, (group + 1) * _GROUP), 1 << code
        packed = data[at : at + 2 * bits]
        at += 2 * bits
        if at > end:
            raise ValueError("meshopt: truncated attributes")
        if code == 3:
            deltas[here] = packed
            continue
        shifts = np.arange(8 - bits, -1, -bits)
        values = ((packed[:, None] >> shifts) & ((1 << bits) - 1)).astype(np.uint8).ravel()
        explicit = np.flatnonzero(values == (1 << bits) - 1)
        if at + len(explicit) > end:
            raise ValueError("meshopt: truncated attributes")
        values[explicit] = data[at : at + len(explicit)]
        at += len(explicit)
        deltas[here] = values
    return deltas[:size], at


class _VarInts:
    """Reader of integers of seven bits a byte, which are differences to the value before."""

    def __init__(self, data: bytes, at: int, end: int) -> None:
        self.data, self.at, self.end = data, at, end

    def next(self) -> int:
        value = shift = 0
        while True:
            if self.at >= self.end or shift > 28:
                raise ValueError("meshopt: truncated indices")
            byte = self.data[self.at]
            self.at += 1
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return value

    def difference(self) -> int:
        value = self.next()
        return (value >> 1) ^ -(value & 1)


class _TriangleState:
    """The recent edges and vertices, by which triangles refer to their neighbours."""

    def __init__(self) -> None:
        self.edges = [(0, 0)] * 16
        self.vertices = [0] * 16
        self.edge_at = self.vertex_at = self.following = 0

    def edge(self, back: int) -> tuple[int, int]:
        return self.edges[(self.edge_at - 1 - back) & 15]

    def vertex(self, code: int) -> int:
        """The next new vertex for code 0, else one of the recent ones."""
        if code == 0:
            self.following += 1
            return self.following - 1
        return self.vertices[(self.vertex_at - code) & 15]

    def push(self, vertex: int) -> None:
        self.vertices[self.vertex_at] = vertex
        self.vertex_at = (self.vertex_at + 1) & 15

    def push_edge(self, a: int, b: int) -> None:
        self.edges[self.edge_at] = (a, b)
        self.edge_at = (self.edge_at + 1) & 15


def _triangles(data: bytes, count: int) -> list[int]:
    """Vertex indices (count,) of triangles, each coded by an edge of a recent one and a further vertex."""
    if count % 3 or len(data) < 1 + count // 3 + 16 or data[0] not in (0xE0, 0xE1):
        raise ValueError(f"meshopt: {count} indices of triangles in {len(data)} bytes")
    relative_from = 13 if data[0] == 0xE1 else 15
    state = _TriangleState()
    numbers = _VarInts(data, 1 + count // 3, len(data) - 16)
    table, last = data[len(data) - 16 :], 0
    result: list[int] = []
    for code in data[1 : 1 + count // 3]:
        if code < 0xF0:
            a, b = state.edge(code >> 4)
            kind = code & 15
            if kind < relative_from:
                c = state.vertex(kind + 1) if kind else state.vertex(0)
            else:
                c = last = last + (numbers.difference() if kind == 15 else kind - (kind ^ 3))
            if kind == 0 or kind >= relative_from:
                state.push(c)
        else:
            a, b, c, last = _free_triangle(code, table, state, numbers, last)
            state.push_edge(b, a)
        result += (a, b, c)
        state.push_edge(c, b)
        state.push_edge(a, c)
    if numbers.at != numbers.end:
        raise ValueError("meshopt: triangles end at another place than their data")
    return result


def _free_triangle(
    code: int, table: bytes, state: _TriangleState, numbers: _VarInts, last: int
) -> tuple[int, int, int, int]:
    """Corners of a triangle without a recent edge, and the last index that was stated."""
    if code < 0xFE:
        first, other = 0, table[code & 15]
    else:
        first, other = (0 if code == 0xFE else 15), numbers.data[numbers.at]
        numbers.at += 1
        if other == 0:
            state.following = 0
    kinds = (first, other >> 4, other & 15)
    is_explicit = [code >= 0xFE and kind == 15 for kind in kinds]
    corners = [0 if explicit else state.vertex(kind) for kind, explicit in zip(kinds, is_explicit, strict=True)]
    for k in range(3):
        if is_explicit[k]:
            corners[k] = last = last + numbers.difference()
    for kind, explicit, corner in zip(kinds, is_explicit, corners, strict=True):
        if kind == 0 or explicit:
            state.push(corner)
    return corners[0], corners[1], corners[2], last


def _sequence(data: bytes, count: int) -> list[int]:
    """Indices (count,) in any order: differences to one of two values before."""
    if len(data) < 1 + count + 4 or data[0] not in (0xD0, 0xD1):
        raise ValueError(f"meshopt: {count} indices in {len(data)} bytes")
    numbers, before = _VarInts(data, 1, len(data) - 4), [0, 0]
    result = []
    for _ in range(count):
        value = numbers.next()
        which, value = value & 1, value >> 1
        before[which] += (value >> 1) ^ -(value & 1)
        result.append(before[which])
    return result


def _filtered(values: Bytes, filter_name: str) -> bytes:
    """Decoded elements (count, stride) after their filter."""
    if filter_name == "NONE":
        return values.tobytes()
    if filter_name == "EXPONENTIAL":
        words = np.ascontiguousarray(values).view("<i4")
        return np.ldexp(((words << 8) >> 8).astype(np.float32), words >> 24).astype("<f4").tobytes()
    if filter_name == "QUATERNION" and values.shape[1] == 8:
        return _quaternions(np.ascontiguousarray(values).view("<i2")).astype("<i2").tobytes()
    raise ValueError(f"meshopt: filter {filter_name!r} of elements of {values.shape[1]} bytes")


def _quaternions(stored: NDArray[Any]) -> Array:
    """Rotations (N,4), scaled by 32767, of their three smallest parts and the place of the largest."""
    largest = stored[:, 3] & 3
    parts = stored[:, :3] / np.sqrt(2.0) / (stored[:, 3:] | 3)
    rest = np.sqrt(np.maximum(0.0, 1.0 - (parts**2).sum(axis=1)))
    result, rows = np.empty((len(stored), 4)), np.arange(len(stored))
    for k, part in enumerate((rest, *parts.T)):
        result[rows, (largest + k) & 3] = part
    return np.round(result * 32767.0)
