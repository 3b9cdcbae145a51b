"""Reader of 3MF: build items and component objects as named instances, units, display colours.

Source: 3MF Core Specification 1.3, Materials extension (basematerials, colorgroup), Production extension
(``p:path``). What is there only for printing, as supports and the modifiers of slicers, is left out and told.
PrusaSlicer keeps all volumes of an object in one mesh, and what they are in ``Metadata/Slic3r_PE_model.config``; Bambu
Studio and OrcaSlicer tell it of components in ``Metadata/model_settings.config``. Written because general loaders drop
the names of instances. The XML is read as a stream, so that memory grows with the triangles alone.
"""

from __future__ import annotations

import posixpath
import zipfile
from array import array
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from xml.parsers import expat

import numpy as np

from arview.cad.formats.raw import (
    MAX_TRIANGLES,
    RawComponent,
    RawModel,
    check_instance_count,
    check_triangle_count,
    short_list,
    unit_in_mm,
)
from arview.cad.formats.text_encoding import COMMAS
from arview.errors import InputError
from arview.geometry import Array

_BODIES = ("model", "surface")
"""Types of objects that are bodies; the others are support, solidsupport and other."""
_CONFIGS = ("metadata/slic3r_pe_model.config", "metadata/slic3r_model.config", "metadata/model_settings.config")
_CUTTERS = ("negativevolume", "negativepart")
_MAX_DEPTH = 100
_MAX_BYTES = 2_000_000_000
_MAX_RATIO, _RATIO_FROM_BYTES = 100, 20_000_000
"""Largest ratio of compression, where more bytes than some are unpacked: XML of meshes reaches 20."""

Color = tuple[float, float, float]
Key = tuple[str, str]
Attributes = dict[str, str]


@dataclass
class _Object:
    """An object resource: a mesh, or references to others with transforms, or both."""

    name: str
    mesh: RawComponent
    children: list[tuple[Key, Array]]
    kind: str


def read_3mf(path: Path) -> RawModel:
    """Components of a 3MF file in the file's unit (millimetre when it declares none).

    Names are an item's ``partnumber``, else an object's ``name``, else ``partnumber``, else nothing.

    Raises:
        InputError: not a 3MF archive, truncated, referring to objects that do not exist, or unpacking to much more
            than a mesh of its size.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return _Archive(archive, path).read()
    except zipfile.BadZipFile as error:
        raise InputError(f"{path}: not a 3MF file, or truncated ({error}); export it again") from error
    except (KeyError, ValueError, IndexError, TypeError, OverflowError, MemoryError) as error:
        raise InputError(f"{path}: broken 3MF ({type(error).__name__}: {error}); export it again") from error
    except (expat.ExpatError, RuntimeError, NotImplementedError, EOFError) as error:
        raise InputError(f"{path}: broken 3MF ({error}); export it again") from error


class _Archive:
    """Reader of one file."""

    def __init__(self, archive: zipfile.ZipFile, path: Path) -> None:
        self.archive = archive
        self.path = path
        self.objects: dict[Key, _Object] = {}
        self.counts: dict[Key, int] = {}
        self.model = RawModel()
        self.volumes: dict[str, list[Attributes]] = {}
        self.left_out: dict[str, None] = {}
        self.uncut: dict[str, None] = {}

    def read(self) -> RawModel:
        members = [
            info for info in self.archive.infolist() if info.filename.lower().endswith((".model", ".rels", ".config"))
        ]
        unpacked, packed = (sum(getattr(info, name) for info in members) for name in ("file_size", "compress_size"))
        if unpacked > _MAX_BYTES:
            raise InputError(f"{self.path}: more than 2 GB unpacked; decimate the mesh")
        if unpacked > max(_RATIO_FROM_BYTES, _MAX_RATIO * packed):
            raise InputError(
                f"{self.path}: {packed / 1e6:.1f} MB that unpack to {unpacked / 1e6:.0f} MB are no mesh; "
                "export it again"
            )
        names = self.archive.namelist()
        main = self._main_part(names)
        for name in names:
            if name.lower().endswith(".model") and name != main:
                self._read_part(name)
        for name in names:
            if name.lower() in _CONFIGS:
                self._read_config(name)
        part = self._read_part(main)
        self.model.unit_mm = unit_in_mm(part.unit)
        if self.model.unit_mm is None:
            self.model.notes.append(f"its unit {part.unit!r} is not a unit of 3MF")
        total = 0
        for key, _, _ in part.items:
            total += self._count(key, ())
            check_instance_count(total, self.path)
        for key, root_from_object, part_number in part.items:
            self._instantiate(key, root_from_object, (), part_number)
        for told, text in (
            (self.left_out, "left out, because they are no bodies but supports, modifiers or the like"),
            (self.uncut, "the slicer cuts these out, which is not done here; export the body that is cut"),
        ):
            if told:
                self.model.notes.append(f"{text}: {short_list(list(told))}")
        return self.model

    def number(self, text: str) -> float:
        """A number, which some programs write with a decimal comma; none is a comma before thousands and a point."""
        if "," in text and COMMAS not in self.model.notes:
            self.model.notes.append(COMMAS)
        return float(text.replace(",", "."))

    def _main_part(self, names: list[str]) -> str:
        """Name of the 3D model part: by the relationships of the package, else the only candidate."""
        if "_rels/.rels" in names:
            targets: list[str] = []

            def start(tag: str, attributes: Attributes) -> None:
                if tag == "Relationship" and attributes.get("Type", "").endswith("/3dmodel"):
                    targets.append(attributes["Target"].lstrip("/"))

            self._parse("_rels/.rels", start, lambda tag: None)
            for target in targets:
                if target in names:
                    return target
        for name in names:
            if name.lower() == "3d/3dmodel.model":
                return name
        raise InputError(f"{self.path}: a ZIP archive without a 3D model part; is it really 3MF?")

    def _read_part(self, name: str) -> _ModelPart:
        part = _ModelPart(self, name)
        self._parse(name, part.start, part.end)
        return part

    def _read_config(self, name: str) -> None:
        """Keep what a slicer says of each object and then of its volumes: attributes and metadata."""
        held: list[Attributes] = []

        def start(tag: str, attributes: Attributes) -> None:
            nonlocal held
            if tag == "object":
                held = self.volumes[attributes["id"]] = []
            if tag in ("object", "volume", "part"):
                held.append(attributes)
            elif tag == "metadata" and held and "key" in attributes:
                held[-1].setdefault(attributes["key"], attributes.get("value", ""))

        self._parse(name, start, lambda tag: None)

    def _parse(self, name: str, start: Callable[[str, Attributes], None], end: Callable[[str], None]) -> None:
        """Report the elements of an archive member by their names without namespaces."""
        parser = expat.ParserCreate(namespace_separator="}")

        def refuse(*_: object) -> None:
            raise ValueError("a document type declaration, which 3MF does not allow")

        parser.StartDoctypeDeclHandler = refuse
        parser.StartElementHandler = lambda tag, attributes: start(tag.rpartition("}")[2], attributes)
        parser.EndElementHandler = lambda tag: end(tag.rpartition("}")[2])
        with self.archive.open(name) as file:
            parser.ParseFile(file)

    def _count(self, key: Key, above: tuple[Key, ...]) -> int:
        """Number of objects that an object places, itself included."""
        if key in above or len(above) > _MAX_DEPTH:
            raise ValueError("objects are nested in a circle")
        if key not in self.objects:
            raise ValueError(f"object {key[1]} does not exist")
        if key not in self.counts:
            self.counts[key] = 1 + sum(self._count(child, (*above, key)) for child, _ in self.objects[key].children)
        return self.counts[key]

    def _instantiate(self, key: Key, root_from_object: Array, path: tuple[str, ...], name: str | None) -> None:
        this = self.objects[key]
        settings, *volumes = self.volumes.get(key[1], [{}])
        own_name = name or this.name or settings.get("name", "")
        if this.kind not in _BODIES:
            self.left_out[f"{own_name or key[1]} ({this.kind})"] = None
            return
        here = (*path, own_name)
        is_body, others = np.ones(len(this.mesh.faces), dtype=bool), set[str]()
        for volume, kind in ((volume, _kind_of(volume)) for volume in volumes if _kind_of(volume)):
            (self.uncut if kind in _CUTTERS else self.left_out)[f"{volume.get('name') or 'unnamed'} ({kind})"] = None
            others.add(volume.get("id", ""))
            is_body[max(int(volume.get("firstid", 0)), 0) : max(int(volume.get("lastid", -1)) + 1, 0)] = False
        if is_body.any():
            mesh = replace(this.mesh, path=tuple(n for n in here if n), faces=this.mesh.faces[is_body])
            self.model.add(mesh, self.path, root_from_object)
        names = {volume.get("id"): volume.get("name") for volume in volumes}
        for child, object_from_child in this.children:
            if child[1] not in others:
                self._instantiate(child, root_from_object @ object_from_child, here, names.get(child[1]))


class _ModelPart:
    """Handler of the elements of one model part: its unit, colours, objects and build items."""

    def __init__(self, archive: _Archive, name: str) -> None:
        self.archive = archive
        self.name = name
        self.unit = "millimeter"
        self.items: list[tuple[Key, Array, str | None]] = []
        self.colors: dict[str | None, list[Color]] = {}
        self.group: list[Color] = []
        self.attributes: Attributes | None = None
        self._clear()

    def _clear(self) -> None:
        self.points = array("d")
        self.corners = array("q")
        self.uses: dict[tuple[str | None, str | None], int] = {}
        self.children: list[tuple[Key, Array]] = []

    def start(self, tag: str, attributes: Attributes) -> None:
        if tag == "vertex" and self.attributes is not None:
            self.points.extend(map(self.archive.number, (attributes["x"], attributes["y"], attributes["z"])))
            if len(self.points) > 9 * MAX_TRIANGLES:
                check_triangle_count(MAX_TRIANGLES + 1, self.archive.path)
        elif tag == "triangle" and self.attributes is not None:
            self.corners.extend((int(attributes["v1"]), int(attributes["v2"]), int(attributes["v3"])))
            if len(self.corners) > 3 * MAX_TRIANGLES:
                check_triangle_count(len(self.corners) // 3, self.archive.path)
            # The property of most triangles; a triangle without a property has that of its object.
            own = self.attributes
            use = (attributes.get("pid", own.get("pid")), attributes.get("p1", own.get("pindex")))
            self.uses[use] = self.uses.get(use, 0) + 1
        elif tag == "component" and self.attributes is not None:
            self.children.append((self._key(attributes), self._transform(attributes)))
        elif tag == "object":
            self._clear()
            self.attributes = attributes
        elif tag in ("basematerials", "colorgroup"):
            self.group = self.colors[attributes["id"]] = []
        elif tag == "base":
            self.group.append(_color(attributes.get("displaycolor", "#999999")))
        elif tag == "color":
            self.group.append(_color(attributes["color"]))
        elif tag == "item":
            self.items.append((self._key(attributes), self._transform(attributes), attributes.get("partnumber")))
        elif tag == "model":
            self.unit = attributes.get("unit", "millimeter")

    def end(self, tag: str) -> None:
        if tag != "object" or self.attributes is None:
            return
        attributes, self.attributes = self.attributes, None
        vertices = np.array(self.points, dtype=np.float64).reshape(-1, 3)
        faces = np.array(self.corners, dtype=np.int64).reshape(-1, 3)
        group, index = max(self.uses, key=lambda key: self.uses[key]) if self.uses else (None, None)
        color = self.colors[group][int(index or 0)] if group in self.colors else None
        self.archive.objects[self.name, attributes["id"]] = _Object(
            name=attributes.get("name") or attributes.get("partnumber") or "",
            mesh=RawComponent((), vertices, faces, color),
            children=self.children,
            kind=attributes.get("type", "model"),
        )
        self._clear()

    def _transform(self, attributes: Attributes) -> Array:
        """(4,4) parent_from_object of a ``transform`` attribute: 12 numbers, rows of a row-vector matrix."""
        matrix = np.eye(4)
        if text := attributes.get("transform"):
            numbers = np.array([self.archive.number(word) for word in text.split()]).reshape(4, 3)
            matrix[:3, :3] = numbers[:3].T
            matrix[:3, 3] = numbers[3]
        return matrix

    def _key(self, attributes: Attributes) -> Key:
        """Archive member and identifier that an ``objectid`` refers to (Production extension's path)."""
        part = self.name
        for key, value in attributes.items():
            if key.endswith("}path"):
                part = posixpath.normpath(value).lstrip("/")
        return part, attributes["objectid"]


def _kind_of(volume: Attributes) -> str:
    """What a volume is for a slicer; empty for a body."""
    kind = volume.get("volume_type") or volume.get("subtype") or ("modifier" if volume.get("modifier") == "1" else "")
    plain = kind.replace("_", "").strip().lower()
    return "" if plain in ("modelpart", "normalpart") else plain


def _color(text: str) -> Color:
    """Colour of ``#RRGGBB`` or ``#RRGGBBAA`` as sRGB in 0-1."""
    red, green, blue = (int(text[i : i + 2], 16) / 255.0 for i in (1, 3, 5))
    return red, green, blue
