"""Reader of Wavefront OBJ that keeps the names of ``o`` and ``g`` lines (general loaders lose them)."""

from __future__ import annotations

import re
from array import array
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from arview.cad.formats.raw import RawComponent, RawModel
from arview.cad.formats.text_encoding import decode_text, text_encoding, with_decimal_points
from arview.errors import InputError
from arview.geometry import Array

MAX_CORNERS, MAX_SQUARES = 1000, 50_000_000
"""Largest number of corners of a polygon, and largest sum of their squares over a file: the time of cutting ears."""
MAX_CROSSINGS = 8
"""Number of times that no ear is found, after which a self-crossing polygon is cut as a fan."""
_CONTINUED = re.compile(r"\\(?:\r\n|\n|\r)")
_LINE_END = re.compile(r"\r\n|\n|\r")

Color = tuple[float, float, float]


def read_obj(path: Path) -> RawModel:
    """Components of an OBJ file, which has no unit. Names are in UTF-8, GB18030 or Latin-1.

    One component per ``o`` line; in a file without ``o`` lines one per ``g`` name; else the whole file.
    Polygons are cut into triangles (ears, where they are not convex). Colours are ``Kd`` of the material
    that most triangles of a component use.

    Raises:
        InputError: a line that is not OBJ, or a face that refers to a vertex that does not exist.
    """
    data, notes = with_decimal_points(path.read_bytes(), rb"v[ \t]")
    encoding = text_encoding(data)
    text = _CONTINUED.sub(" ", decode_text(data, encoding))
    lines = _LINE_END.split(text)
    by_object = any(line.startswith("o ") for line in lines)
    coordinates = array("d")
    groups: list[_Group] = [_Group("")]
    group_of_name: dict[str, _Group] = {}
    materials: dict[str, Color] = {}
    material, squares = "", 0
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            if words[0] == "v":
                coordinates.extend((float(words[1]), float(words[2]), float(words[3])))
            elif words[0] == "f":
                group, count = groups[-1], len(coordinates) // 3
                polygon = [_vertex_index(word, count) for word in words[1:]]
                if len(polygon) > MAX_CORNERS:
                    raise ValueError(f"a face of {len(polygon)} corners; export triangles")
                squares += len(polygon) ** 2 if len(polygon) > 8 else 0
                if squares > MAX_SQUARES:
                    raise ValueError("too many faces of many corners; export triangles")
                group.polygons.append(polygon)
                group.uses[material] = group.uses.get(material, 0) + max(0, len(polygon) - 2)
            elif words[0] == "o" or (words[0] == "g" and not by_object):
                name = " ".join(words[1:])
                group = _Group(name) if by_object else group_of_name.setdefault(name, _Group(name))
                # The order is that of the last use of a name.
                groups = groups if by_object or group not in groups else [g for g in groups if g is not group]
                groups.append(group)
            elif words[0] == "usemtl":
                material = " ".join(words[1:])
            elif words[0] == "mtllib":
                materials.update(_read_materials(path, " ".join(words[1:]), encoding))
        except (ValueError, IndexError) as error:
            raise InputError(f"{path}: line {number} is not valid OBJ: {line.strip()[:60]!r} ({error})") from error
    points = np.frombuffer(coordinates, dtype=np.float64).reshape(-1, 3)
    model = _model(points, groups, materials, path)
    model.notes += notes
    return model


@dataclass(eq=False)
class _Group:
    """The polygons of one name, as indices of vertices, and how many triangles use each material."""

    name: str
    polygons: list[list[int]] = field(default_factory=list)
    uses: dict[str, int] = field(default_factory=dict)


def _model(points: Array, groups: list[_Group], materials: dict[str, Color], path: Path) -> RawModel:
    model = RawModel()
    for group in groups:
        faces = [triangle for polygon in group.polygons for triangle in triangulate(points, polygon)]
        if not faces:
            continue
        color = materials.get(max(group.uses, key=lambda key: group.uses[key]))
        used, corners = np.unique(np.array(faces, dtype=np.int64), return_inverse=True)
        # The vertices are common to the file; each component takes its own.
        component = RawComponent((group.name,) if group.name else (), points[used], corners.reshape(-1, 3), color)
        model.add(component, path)
    return model


def _vertex_index(word: str, count: int) -> int:
    index = int(word.split("/")[0])
    absolute = index - 1 if index > 0 else count + index
    if index == 0 or not 0 <= absolute < count:
        raise ValueError(f"vertex {index} of {count}")
    return absolute


def _read_materials(obj_path: Path, name: str, encoding: str) -> dict[str, Color]:
    """Diffuse colours of an MTL file; none for a missing or malformed file, without which OBJ is still usable.

    Only a file beside the OBJ file is read, so that a file of unknown origin cannot bring in others of the machine.
    """
    colors: dict[str, Color] = {}
    folder = obj_path.resolve().parent
    path = (folder / name).resolve()
    if not path.is_relative_to(folder) or not path.is_file():
        return colors
    data = path.read_bytes()
    own, name = text_encoding(data), ""
    for line in _LINE_END.split(decode_text(data, own if own == "utf-8" else encoding)):
        words = line.split()
        if words[:1] == ["newmtl"]:
            name = " ".join(words[1:])
        elif words[:1] == ["Kd"] and len(words) >= 4:
            try:
                red, green, blue = (min(1.0, max(0.0, float(word))) for word in words[1:4])
            except ValueError:
                continue
            colors[name] = (red, green, blue)
    return colors


def triangulate(points: Array, polygon: list[int]) -> list[tuple[int, int, int]]:
    """Triangles of a planar polygon given by indices into ``points`` (V,3), by clipping ears.

    Source: Meisters 1975, "Polygons have ears". Falls back to a fan where no ear is left (self-crossing).
    """
    if len(polygon) <= 3:
        return [(polygon[0], polygon[1], polygon[2])] if len(polygon) == 3 else []
    corners = points[polygon]
    normal = np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0)
    drop = int(np.argmax(np.abs(normal)))
    flat = np.delete(corners, drop, axis=1)
    if (normal[drop] < 0) != (drop == 1):
        flat = flat[:, ::-1]

    corners_2d = flat.tolist()

    def turn(a: int, b: int, c: int) -> float:
        (ax, ay), (bx, by), (cx, cy) = corners_2d[a], corners_2d[b], corners_2d[c]
        return (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)

    rest = list(range(len(polygon)))
    triangles: list[tuple[int, int, int]] = []
    crossings = 0
    while len(rest) > 3:
        for i in range(len(rest)):
            a, b, c = rest[i - 1], rest[i], rest[(i + 1) % len(rest)]
            if turn(a, b, c) <= 0:
                continue
            others = (p for p in rest if p not in (a, b, c))
            if not any(turn(a, b, p) >= 0 and turn(b, c, p) >= 0 and turn(c, a, p) >= 0 for p in others):
                break
        else:
            crossings += 1
            if crossings > MAX_CROSSINGS:
                return triangles + [(polygon[rest[0]], polygon[b], polygon[c]) for b, c in pairwise(rest[1:])]
            i = 1
            a, b, c = rest[0], rest[1], rest[2]
        triangles.append((polygon[a], polygon[b], polygon[c]))
        del rest[i]
    triangles.append((polygon[rest[0]], polygon[rest[1]], polygon[rest[2]]))
    return triangles
