"""Reader of glTF 2.0 (.glb, .gltf): named nodes, nested transforms, instances, colours.

Source: Khronos glTF 2.0 specification. Written for CAD, so that every node that carries a mesh stays one
component under its own name; skins, morph targets and textures are ignored.
"""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from arview.cad.raw import RawComponent, RawModel, check_triangle_count, place, unit_in_mm
from arview.errors import InputError
from arview.geometry import Array

_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_UNREADABLE = {
    "KHR_draco_mesh_compression": "Draco compression",
    "EXT_meshopt_compression": "meshopt compression",
    "KHR_meshopt_compression": "meshopt compression",
    "EXT_mesh_gpu_instancing": "GPU instancing",
}
_MAX_DEPTH = 200

Color = tuple[float, float, float]


def read_gltf(path: Path) -> RawModel:
    """Components of a .glb or .gltf file in the file's unit.

    The unit is the metre, as the specification says, with one exception: trimesh writes numbers in any unit and tags
    each mesh with ``extras.units``; the tag is used when trimesh is the generator.

    Raises:
        InputError: not glTF 2.0, truncated, compressed, or inconsistent in itself.
    """
    return parse_gltf(path.read_bytes(), path)


def parse_gltf(data: bytes, path: Path) -> RawModel:
    """As read_gltf, from bytes; ``path`` names the file in messages and locates external buffers."""
    try:
        return _Gltf(data, path).read()
    except (KeyError, IndexError, ValueError, TypeError, AttributeError, struct.error, OSError) as error:
        raise InputError(
            f"{path}: broken or truncated glTF ({type(error).__name__}: {error}); export it again"
        ) from error


def srgb_from_linear(linear: Array) -> Array:
    """Linear values as sRGB in 0-1 (IEC 61966-2-1)."""
    x = np.clip(linear, 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(x, 1 / 2.4) - 0.055)


class _Gltf:
    """Reader of one file."""

    def __init__(self, data: bytes, path: Path) -> None:
        self.path = path
        self.binary = b""
        text = data
        if data[:4] == b"glTF":
            version, length = struct.unpack_from("<II", data, 4)
            if version != 2:
                raise InputError(f"{path}: glTF version {version}; only 2 is supported")
            if length > len(data):
                raise InputError(f"{path}: truncated: {len(data)} of {length} bytes are there; copy or export it again")
            text, offset = b"", 12
            while offset + 8 <= length:
                size, kind = struct.unpack_from("<II", data, offset)
                chunk = data[offset + 8 : offset + 8 + size]
                if kind == 0x4E4F534A:
                    text = chunk
                elif kind == 0x004E4942:
                    self.binary = chunk
                offset += 8 + size
        elif path.suffix.lower() == ".glb":
            raise InputError(f"{path}: not a GLB file (its first bytes are {data[:4]!r}, expected b'glTF')")
        self.tree: dict[str, Any] = json.loads(text)
        if not str(self.tree["asset"]["version"]).startswith("2."):
            raise InputError(f"{path}: glTF version {self.tree['asset']['version']}; only 2 is supported")
        for name in self.tree.get("extensionsRequired", []):
            if name in _UNREADABLE:
                raise InputError(f"{path}: uses {_UNREADABLE[name]}, which is not read; export without it")
        self.buffers: dict[int, bytes] = {}
        self.model = RawModel(unit_mm=1000.0)

    def read(self) -> RawModel:
        nodes = self.tree.get("nodes", [])
        scenes = self.tree.get("scenes", [])
        if scenes:
            roots = scenes[self.tree.get("scene", 0)].get("nodes", [])
        else:
            children = {child for node in nodes for child in node.get("children", [])}
            roots = [index for index in range(len(nodes)) if index not in children]
        for root in roots:
            self._visit(root, np.eye(4), ())
        self._read_unit_tags()
        return self.model

    def _visit(self, index: int, root_from_parent: Array, path: tuple[str, ...]) -> None:
        if len(path) > _MAX_DEPTH:
            raise ValueError("nodes are nested in a circle")
        node = self.tree["nodes"][index]
        name = str(node.get("name") or "")
        if not name and "mesh" in node:
            name = str(self.tree["meshes"][node["mesh"]].get("name") or "")
        here = (*path, name)
        root_from_node = root_from_parent @ _node_matrix(node)
        if "mesh" in node:
            self._add_mesh(node["mesh"], root_from_node, here)
        for child in node.get("children", []):
            self._visit(child, root_from_node, here)

    def _add_mesh(self, index: int, root_from_node: Array, path: tuple[str, ...]) -> None:
        vertices: list[Array] = []
        faces: list[NDArray[np.int64]] = []
        area_of_color: dict[Color, float] = {}
        offset = 0
        for primitive in self.tree["meshes"][index]["primitives"]:
            mode = primitive.get("mode", 4)
            if mode not in (4, 5, 6):
                continue
            points = self._accessor(primitive["attributes"]["POSITION"]).astype(np.float64)
            corners = (
                self._accessor(primitive["indices"]).astype(np.int64).ravel()
                if "indices" in primitive
                else np.arange(len(points), dtype=np.int64)
            )
            triangles = _triangles(corners, mode)
            if len(triangles) and triangles.max() >= len(points):
                raise ValueError(f"a triangle of {'/'.join(path)!r} refers to a vertex that does not exist")
            check_triangle_count(self.model.triangle_count + len(triangles), self.path)
            color = self._color(primitive)
            if color is not None:
                a, b, c = points[triangles].transpose(1, 0, 2)
                area = float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
                area_of_color[color] = area_of_color.get(color, 0.0) + area
            vertices.append(points)
            faces.append(triangles + offset)
            offset += len(points)
        if faces:
            placed, turned = place(root_from_node, np.concatenate(vertices), np.concatenate(faces))
            color = max(area_of_color, key=lambda key: area_of_color[key]) if area_of_color else None
            self.model.add(RawComponent(tuple(n for n in path if n), placed, turned, color), self.path)

    def _color(self, primitive: dict[str, Any]) -> Color | None:
        """Base colour of a primitive's material, times its mean vertex colour, as sRGB."""
        linear = np.ones(3)
        known = False
        if "material" in primitive:
            pbr = self.tree["materials"][primitive["material"]].get("pbrMetallicRoughness", {})
            known = "baseColorFactor" in pbr or "baseColorTexture" not in pbr
            linear = np.array(pbr.get("baseColorFactor", [1.0, 1.0, 1.0, 1.0])[:3], dtype=np.float64)
        if "COLOR_0" in primitive["attributes"]:
            linear = linear * self._accessor(primitive["attributes"]["COLOR_0"])[:, :3].mean(axis=0)
            known = True
        if not known:
            return None
        red, green, blue = srgb_from_linear(linear)
        return float(red), float(green), float(blue)

    def _buffer(self, index: int) -> bytes:
        if index not in self.buffers:
            uri = self.tree["buffers"][index].get("uri")
            if uri is None:
                self.buffers[index] = self.binary
            elif uri.startswith("data:"):
                self.buffers[index] = base64.b64decode(uri.split(",", 1)[1])
            else:
                other = self.path.parent / unquote(uri)
                if not other.is_file():
                    raise InputError(f"{self.path}: its buffer file {other} is missing")
                self.buffers[index] = other.read_bytes()
        return self.buffers[index]

    def _view(self, view_index: int, offset: int, count: int, dtype: str, width: int) -> NDArray[Any]:
        view = self.tree["bufferViews"][view_index]
        data = self._buffer(view["buffer"])
        start = view.get("byteOffset", 0) + offset
        item = np.dtype(dtype).itemsize
        stride = view.get("byteStride") or item * width
        needed = start + stride * (count - 1) + item * width if count else start
        if needed > len(data):
            raise InputError(f"{self.path}: truncated: a mesh ends at byte {needed} of {len(data)}")
        return np.ndarray((count, width), dtype=dtype, buffer=data, offset=start, strides=(stride, item))

    def _accessor(self, index: int) -> NDArray[Any]:
        """(count, width) values of an accessor, integers scaled to floats where marked ``normalized``."""
        accessor = self.tree["accessors"][index]
        dtype, width = _DTYPES[accessor["componentType"]], _WIDTHS[accessor["type"]]
        count = accessor["count"]
        if "bufferView" in accessor:
            view, offset = accessor["bufferView"], accessor.get("byteOffset", 0)
            values = np.array(self._view(view, offset, count, dtype, width))
        else:
            values = np.zeros((count, width), dtype=dtype)
        if "sparse" in accessor:
            sparse = accessor["sparse"]
            where, what = sparse["indices"], sparse["values"]
            rows = self._view(
                where["bufferView"],
                where.get("byteOffset", 0),
                sparse["count"],
                _DTYPES[where["componentType"]],
                1,
            )
            values[rows.ravel()] = self._view(
                what["bufferView"], what.get("byteOffset", 0), sparse["count"], dtype, width
            )
        if accessor.get("normalized") and values.dtype.kind in "iu":
            return np.maximum(values / float(np.iinfo(values.dtype).max), -1.0)
        return values

    def _read_unit_tags(self) -> None:
        if "trimesh" not in str(self.tree["asset"].get("generator", "")):
            return
        meshes = self.tree.get("meshes", [])
        tags = {str((mesh.get("extras") or {}).get("units", "m")) for mesh in meshes}
        if tags <= {"m", "meters", "meter"}:
            return
        units = {unit_in_mm(tag) for tag in tags}
        if len(units) == 1 and None not in units:
            self.model.unit_mm = units.pop()
            self.model.notes.append(f"trimesh tagged its numbers as {tags.pop()!r}: used instead of glTF's metres")
        else:
            self.model.unit_mm = None
            self.model.notes.append(f"its meshes are tagged with the units {', '.join(sorted(tags))}")


def _node_matrix(node: dict[str, Any]) -> Array:
    """(4,4) parent_from_node of a node's matrix or translation, rotation (x y z w) and scale."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    if "rotation" in node:
        quaternion = np.array(node["rotation"], dtype=np.float64)
        x, y, z, w = quaternion / np.linalg.norm(quaternion)
        matrix[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    matrix[:3, :3] = matrix[:3, :3] * np.array(node.get("scale", [1.0, 1.0, 1.0]), dtype=np.float64)
    matrix[:3, 3] = node.get("translation", [0.0, 0.0, 0.0])
    return matrix


def _triangles(corners: NDArray[np.int64], mode: int) -> NDArray[np.int64]:
    """(F,3) triangles of an index list: 4 separate, 5 strip, 6 fan."""
    if mode == 4:
        return corners[: len(corners) // 3 * 3].reshape(-1, 3)
    if len(corners) < 3:
        return np.zeros((0, 3), dtype=np.int64)
    if mode == 6:
        return np.stack([np.full(len(corners) - 2, corners[0]), corners[1:-1], corners[2:]], axis=1)
    triangles = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
    triangles[1::2] = triangles[1::2][:, [1, 0, 2]]
    return triangles
