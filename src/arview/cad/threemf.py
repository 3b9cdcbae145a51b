"""Reader of 3MF: build items and component objects as named instances, units, display colours.

Source: 3MF Core Specification 1.3, Materials extension (basematerials, colorgroup), Production extension
(``p:path``). Written because general loaders drop the names of instances.
"""

from __future__ import annotations

import posixpath
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.cad.raw import RawComponent, RawModel, place, unit_in_mm
from arview.errors import InputError
from arview.geometry import Array

_MAX_DEPTH = 100
_MAX_BYTES = 2_000_000_000

Color = tuple[float, float, float]
Key = tuple[str, str]


@dataclass
class _Object:
    """An object resource: a mesh, or references to others with transforms, or both."""

    name: str
    vertices: Array
    faces: NDArray[np.int64]
    color: Color | None
    children: list[tuple[Key, Array]] = field(default_factory=list)


def read_3mf(path: Path) -> RawModel:
    """Components of a 3MF file in the file's unit (millimetre when it declares none).

    Names are an item's ``partnumber``, else an object's ``name``, else ``partnumber``, else nothing.

    Raises:
        InputError: not a 3MF archive, truncated, or referring to objects that do not exist.
    """
    from lxml import etree

    try:
        with zipfile.ZipFile(path) as archive:
            return _Archive(archive, path).read()
    except zipfile.BadZipFile as error:
        raise InputError(f"{path}: not a 3MF file, or truncated ({error}); export it again") from error
    except (KeyError, ValueError, IndexError, TypeError, etree.LxmlError) as error:
        raise InputError(f"{path}: broken 3MF ({type(error).__name__}: {error}); export it again") from error


class _Archive:
    """Reader of one file."""

    def __init__(self, archive: zipfile.ZipFile, path: Path) -> None:
        self.archive = archive
        self.path = path
        self.objects: dict[Key, _Object] = {}
        self.model = RawModel()

    def read(self) -> RawModel:
        names = self.archive.namelist()
        if sum(info.file_size for info in self.archive.infolist()) > _MAX_BYTES:
            raise InputError(f"{self.path}: more than 2 GB unpacked; decimate the mesh")
        main = self._main_part(names)
        root = self._parse(main)
        for name in names:
            if name.lower().endswith(".model") and name != main:
                self._read_objects(self._parse(name), name)
        self._read_objects(root, main)
        unit = root.get("unit", "millimeter")
        self.model.unit_mm = unit_in_mm(unit)
        if self.model.unit_mm is None:
            self.model.notes.append(f"its unit {unit!r} is not a unit of 3MF")
        for item in root.iterfind("{*}build/{*}item"):
            key = (self._part_of(item, main), item.attrib["objectid"])
            self._instantiate(key, _transform(item), (), item.get("partnumber"))
        return self.model

    def _main_part(self, names: list[str]) -> str:
        """Name of the 3D model part: by the relationships of the package, else the only candidate."""
        if "_rels/.rels" in names:
            for relation in self._parse("_rels/.rels"):
                if str(relation.get("Type", "")).endswith("/3dmodel"):
                    target = str(relation.attrib["Target"]).lstrip("/")
                    if target in names:
                        return target
        for name in names:
            if name.lower() == "3d/3dmodel.model":
                return name
        raise InputError(f"{self.path}: a ZIP archive without a 3D model part; is it really 3MF?")

    def _parse(self, name: str) -> Any:
        from lxml import etree

        parser = etree.XMLParser(resolve_entities=False, no_network=True, huge_tree=True)
        return etree.fromstring(self.archive.read(name), parser)

    def _part_of(self, element: Any, part: str) -> str:
        """Archive member that an element's objectid refers to (Production extension's path)."""
        for key, value in element.attrib.items():
            if key.endswith("}path"):
                return posixpath.normpath(value).lstrip("/")
        return part

    def _read_objects(self, root: Any, part: str) -> None:
        colors: dict[str, list[Color]] = {}
        for resource in root.iterfind("{*}resources/*"):
            kind = str(resource.tag).rsplit("}", 1)[-1]
            if kind in ("basematerials", "colorgroup"):
                attribute = "displaycolor" if kind == "basematerials" else "color"
                colors[resource.attrib["id"]] = [_color(entry.attrib[attribute]) for entry in resource]
            elif kind == "object" and resource.get("type", "model") not in ("support", "other"):
                self.objects[part, resource.attrib["id"]] = self._object(resource, part, colors)

    def _object(self, element: Any, part: str, colors: dict[str, list[Color]]) -> _Object:
        vertices = [
            (float(v.attrib["x"]), float(v.attrib["y"]), float(v.attrib["z"]))
            for v in element.iterfind("{*}mesh/{*}vertices/{*}vertex")
        ]
        triangles = list(element.iterfind("{*}mesh/{*}triangles/{*}triangle"))
        faces = [(int(t.attrib["v1"]), int(t.attrib["v2"]), int(t.attrib["v3"])) for t in triangles]
        if faces and not 0 <= min(map(min, faces)) <= max(map(max, faces)) < len(vertices):
            raise ValueError(f"a triangle of object {element.attrib['id']} refers to a vertex that does not exist")
        # The property of most triangles; a triangle without a property has that of its object.
        uses: dict[tuple[str | None, str | None], int] = {}
        for triangle in triangles:
            use = (triangle.get("pid", element.get("pid")), triangle.get("p1", element.get("pindex")))
            uses[use] = uses.get(use, 0) + 1
        group, index = max(uses, key=lambda key: uses[key]) if uses else (None, None)
        color = colors[group][int(index or 0)] if group in colors else None
        return _Object(
            name=str(element.get("name") or element.get("partnumber") or ""),
            vertices=np.array(vertices, dtype=np.float64).reshape(-1, 3),
            faces=np.array(faces, dtype=np.int64).reshape(-1, 3),
            color=color,
            children=[
                ((self._part_of(child, part), child.attrib["objectid"]), _transform(child))
                for child in element.iterfind("{*}components/{*}component")
            ],
        )

    def _instantiate(self, key: Key, root_from_object: Array, path: tuple[str, ...], name: str | None) -> None:
        if len(path) > _MAX_DEPTH:
            raise ValueError("objects are nested in a circle")
        if key not in self.objects:
            raise ValueError(f"object {key[1]} does not exist")
        this = self.objects[key]
        here = (*path, name or this.name)
        if len(this.faces):
            placed, turned = place(root_from_object, this.vertices, this.faces)
            component = RawComponent(tuple(n for n in here if n), placed, turned, this.color)
            self.model.add(component, self.path)
        for child, object_from_child in this.children:
            self._instantiate(child, root_from_object @ object_from_child, here, None)


def _transform(element: Any) -> Array:
    """(4,4) parent_from_object of a ``transform`` attribute: 12 numbers, rows of a row-vector matrix."""
    matrix = np.eye(4)
    if text := element.get("transform"):
        numbers = np.array([float(word) for word in text.split()]).reshape(4, 3)
        matrix[:3, :3] = numbers[:3].T
        matrix[:3, 3] = numbers[3]
    return matrix


def _color(text: str) -> Color:
    """Colour of ``#RRGGBB`` or ``#RRGGBBAA`` as sRGB in 0-1."""
    red, green, blue = (int(text[i : i + 2], 16) / 255.0 for i in (1, 3, 5))
    return red, green, blue
