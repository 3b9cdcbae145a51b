"""Reader of glTF 2.0 (.glb, .gltf): named nodes, nested transforms, instances, colours.

Source: Khronos glTF 2.0 specification, EXT_mesh_gpu_instancing, KHR_mesh_quantization, EXT_meshopt_compression,
KHR_draco_mesh_compression, KHR_node_visibility. Written for CAD, so that every node that carries a mesh stays one
component under its own name; skins, morph targets and textures are ignored.
"""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.cad.formats import draco
from arview.cad.formats.gltf_data import GltfData
from arview.cad.formats.raw import (
    LEFT_OUT_HIDDEN,
    RawComponent,
    RawModel,
    check_instance_count,
    check_triangle_count,
    short_list,
    unit_in_mm,
)
from arview.cad.formats.text_encoding import decode_text
from arview.errors import InputError
from arview.geometry import Array

_COMPRESSED = {
    draco.EXTENSION: "Draco compression",
    "KHR_meshopt_compression": "meshopt compression",
}
_VISIBILITY = "KHR_node_visibility"
_SUPPORTED = (
    "KHR_mesh_quantization",
    "EXT_mesh_gpu_instancing",
    "EXT_meshopt_compression",
    draco.EXTENSION,
    _VISIBILITY,
)
_WITHOUT_GEOMETRY = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_", "KHR_lights_", "KHR_xmp_")
"""Beginnings of the names of extensions that concern appearance only."""
_MAX_DEPTH = 200
_TOO_MUCH = (RecursionError, MemoryError, OverflowError)

Color = tuple[float, float, float]


def read_gltf(path: Path) -> RawModel:
    """Components of a .glb or .gltf file in the file's unit.

    The unit is the metre and +Y is up, as the specification says, with one exception: trimesh writes numbers in any
    unit and axes as they are, and tags each mesh with ``extras.units``; when trimesh is the generator, the tag is used
    and +Z is up.

    Raises:
        InputError: not glTF 2.0, truncated, compressed, or inconsistent in itself.
    """
    return parse_gltf(path.read_bytes(), path)


def parse_gltf(data: bytes, path: Path) -> RawModel:
    """As read_gltf, from bytes; ``path`` names the file in messages and locates external buffers."""
    try:
        return _Gltf(data, path).read()
    except (KeyError, IndexError, ValueError, TypeError, AttributeError, struct.error, OSError, *_TOO_MUCH) as error:
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
        self.tree: dict[str, Any] = json.loads(decode_text(text))
        if not str(self.tree["asset"]["version"]).startswith("2."):
            raise InputError(f"{path}: glTF version {self.tree['asset']['version']}; only 2 is supported")
        _check_extensions(self.tree, path)
        self.data = GltfData(self.tree, self.binary, path)
        self.model = RawModel(unit_mm=1000.0)
        self.meshes: dict[int, RawComponent | None] = {}
        self.visit_count = 0
        self.hidden: list[str] = []

    def read(self) -> RawModel:
        nodes, scenes = self.tree.get("nodes", []), self.tree.get("scenes", [])
        if scenes:
            roots = scenes[self.tree.get("scene", 0)].get("nodes", [])
        else:
            children = {child for node in nodes for child in node.get("children", [])}
            roots = [index for index in range(len(nodes)) if index not in children]
        for root in roots:
            self._visit(root, np.eye(4), ())
        self._read_conventions()
        if self.hidden:
            self.model.notes.append(f"{LEFT_OUT_HIDDEN % 'glTF'}: {short_list(self.hidden)}")
        return self.model

    def _visit(self, index: int, root_from_parent: Array, path: tuple[str, ...]) -> None:
        if len(path) > _MAX_DEPTH:
            raise ValueError("nodes are nested in a circle")
        self.visit_count += 1
        check_instance_count(self.visit_count, self.path)
        node = self.tree["nodes"][index]
        name = str(node.get("name") or "")
        if not name and "mesh" in node:
            name = str(self.tree["meshes"][node["mesh"]].get("name") or "")
        here = (*path, name)
        if _is_hidden(node):
            self.hidden.append(next((text for text in reversed(here) if text), "unnamed"))
            return
        root_from_node = root_from_parent @ _node_matrix(node)
        if "mesh" in node:
            self._add_instances(node, root_from_node, here)
        for child in node.get("children", []):
            self._visit(child, root_from_node, here)

    def _add_instances(self, node: dict[str, Any], root_from_node: Array, path: tuple[str, ...]) -> None:
        """Add the mesh of a node once, or once for each instance of EXT_mesh_gpu_instancing, numbered from 1."""
        instancing = node.get("extensions", {}).get("EXT_mesh_gpu_instancing")
        mesh = self._mesh(node["mesh"], path)
        if mesh is None:
            return
        if instancing is None:
            self._add(mesh, root_from_node, path)
            return
        transforms = self._instance_matrices(instancing["attributes"])
        self.visit_count += len(transforms)
        check_instance_count(self.visit_count, self.path)
        for number, node_from_instance in enumerate(transforms, start=1):
            name = f"{path[-1] or 'instance'}_{number}"
            self._add(mesh, root_from_node @ node_from_instance, (*path[:-1], name))

    def _instance_matrices(self, attributes: dict[str, int]) -> list[Array]:
        """(4,4) node_from_instance of the instances of a node; unknown attributes are custom data."""
        keys = {"TRANSLATION": "translation", "ROTATION": "rotation", "SCALE": "scale"}
        columns = {keys[name]: self.data.accessor(index) for name, index in attributes.items() if name in keys}
        counts = {len(values) for values in columns.values()}
        if len(counts) != 1:
            raise ValueError(f"the attributes of GPU instances have {sorted(counts) or 'no'} counts")
        check_instance_count(counts.pop(), self.path)
        rows = zip(*columns.values(), strict=True)
        return [_node_matrix(dict(zip(columns, (value.astype(float) for value in row), strict=True))) for row in rows]

    def _add(self, mesh: RawComponent, root_from_mesh: Array, path: tuple[str, ...]) -> None:
        self.model.add(replace(mesh, path=tuple(name for name in path if name)), self.path, root_from_mesh)

    def _mesh(self, index: int, path: tuple[str, ...]) -> RawComponent | None:
        """The triangles of a mesh in its own frame, read once however often it is used; None when it has none."""
        if index not in self.meshes:
            self.meshes[index] = self._read_mesh(index, path)
        return self.meshes[index]

    def _read_mesh(self, index: int, path: tuple[str, ...]) -> RawComponent | None:
        vertices: list[Array] = []
        faces: list[NDArray[np.int64]] = []
        area_of_color: dict[Color, float] = {}
        offset = triangle_count = 0
        for primitive in self.tree["meshes"][index]["primitives"]:
            mode = primitive.get("mode", 4)
            if mode not in (4, 5, 6):
                continue
            decoded = self.data.draco_mesh(primitive)
            points = self.data.values(primitive, "POSITION", decoded).astype(np.float64)
            if points.shape[1] != 3:
                raise ValueError(f"the positions of {'/'.join(path)!r} have {points.shape[1]} coordinates")
            triangles = _triangles(self._corners(primitive, len(points)), mode) if decoded is None else decoded.faces
            if len(triangles) and not 0 <= triangles.min() <= triangles.max() < len(points):
                raise ValueError(f"a triangle of {'/'.join(path)!r} refers to a vertex that does not exist")
            triangle_count += len(triangles)
            check_triangle_count(triangle_count, self.path)
            color = self._color(primitive, decoded)
            if color is not None:
                a, b, c = points[triangles].transpose(1, 0, 2)
                area = float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
                area_of_color[color] = area_of_color.get(color, 0.0) + area
            vertices.append(points)
            faces.append(triangles + offset)
            offset += len(points)
        if not faces:
            return None
        color = max(area_of_color, key=lambda key: area_of_color[key]) if area_of_color else None
        # Only vertices in use are kept: every instance takes a copy of them.
        used, corners = np.unique(np.concatenate(faces), return_inverse=True)
        points = np.concatenate(vertices)
        if len(used) < len(points) and not np.isfinite(points).all():
            raise ValueError(f"vertices of {'/'.join(path)!r} are NaN or infinite")
        return RawComponent((), points[used], corners.reshape(-1, 3), color)

    def _corners(self, primitive: dict[str, Any], count: int) -> NDArray[np.int64]:
        """Vertex indices of a primitive; all vertices in order where it has none."""
        if "indices" not in primitive:
            return np.arange(count, dtype=np.int64)
        return self.data.accessor(primitive["indices"]).astype(np.int64).ravel()

    def _color(self, primitive: dict[str, Any], decoded: draco.DracoMesh | None) -> Color | None:
        """Base colour of a primitive's material, times its mean vertex colour, as sRGB."""
        linear, known = np.ones(3), False
        if "material" in primitive:
            pbr = self.tree["materials"][primitive["material"]].get("pbrMetallicRoughness", {})
            known = "baseColorFactor" in pbr or "baseColorTexture" not in pbr
            linear = np.array(pbr.get("baseColorFactor", [1.0, 1.0, 1.0, 1.0])[:3], dtype=np.float64)
        if "COLOR_0" in primitive["attributes"]:
            linear = linear * self.data.values(primitive, "COLOR_0", decoded)[:, :3].mean(axis=0)
            known = True
        if not known:
            return None
        red, green, blue = srgb_from_linear(linear)
        return float(red), float(green), float(blue)

    def _read_conventions(self) -> None:
        if "trimesh" not in str(self.tree["asset"].get("generator", "")):
            self.model.up = "y"
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


def _check_extensions(tree: dict[str, Any], path: Path) -> None:
    """Raise InputError when a file requires extensions that are not read."""
    required = [str(name) for name in tree.get("extensionsRequired", [])]
    missing = [n for n in required if n not in _SUPPORTED and not n.startswith(_WITHOUT_GEOMETRY)]
    if missing:
        told = ", ".join(f"{_COMPRESSED[name]} ({name})" if name in _COMPRESSED else name for name in missing)
        raise InputError(f"{path}: requires {told}, which is not read; export it without")


def _is_hidden(node: dict[str, Any]) -> bool:
    """Whether a node is hidden with all below it, by the extension or by the custom data of exporters."""
    told = {**node["extras"]} if isinstance(node.get("extras"), dict) else {}
    own = node.get("extensions", {}).get(_VISIBILITY, {})
    return own.get("visible") is False or told.get("visible") is False or told.get("hidden") is True


def _node_matrix(node: dict[str, Any]) -> Array:
    """(4,4) parent_from_node of a node's matrix or translation, rotation (x y z w) and scale."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    if "rotation" in node:
        from scipy.spatial.transform import Rotation  # takes a quarter of a second to import

        matrix[:3, :3] = Rotation.from_quat(node["rotation"]).as_matrix()
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
