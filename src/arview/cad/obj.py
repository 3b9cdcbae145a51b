"""Reader of Wavefront OBJ that keeps the names of ``o`` and ``g`` lines (general loaders lose them)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from arview.cad.raw import RawComponent, RawModel
from arview.errors import InputError
from arview.geometry import Array

Color = tuple[float, float, float]


def read_obj(path: Path) -> RawModel:
    """Components of an OBJ file, which has no unit.

    One component per ``o`` line; in a file without ``o`` lines one per ``g`` name; else the whole file.
    Polygons are cut into triangles (ears, where they are not convex). Colours are ``Kd`` of the material
    that most triangles of a component use.

    Raises:
        InputError: a line that is not OBJ, or a face that refers to a vertex that does not exist.
    """
    text = path.read_bytes().decode("utf-8", errors="replace").replace("\\\r\n", " ").replace("\\\n", " ")
    lines = text.splitlines()
    by_object = any(line.startswith("o ") for line in lines)
    vertices: list[list[float]] = []
    groups: list[tuple[str, list[list[int]], dict[str, int]]] = [("", [], {})]
    materials: dict[str, Color] = {}
    material = ""
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            if words[0] == "v":
                vertices.append([float(words[1]), float(words[2]), float(words[3])])
            elif words[0] == "f":
                polygon = [_vertex_index(word, len(vertices)) for word in words[1:]]
                groups[-1][1].append(polygon)
                groups[-1][2][material] = groups[-1][2].get(material, 0) + max(0, len(polygon) - 2)
            elif words[0] == "o" or (words[0] == "g" and not by_object):
                name = " ".join(words[1:])
                known = [] if by_object else [group for group in groups if group[0] == name]
                if known:
                    groups.remove(known[0])
                groups.append(known[0] if known else (name, [], {}))
            elif words[0] == "usemtl":
                material = " ".join(words[1:])
            elif words[0] == "mtllib":
                materials.update(_read_materials(path.parent / " ".join(words[1:])))
        except (ValueError, IndexError) as error:
            raise InputError(f"{path}: line {number} is not valid OBJ: {line.strip()[:60]!r} ({error})") from error
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    model = RawModel()
    for name, polygons, uses in groups:
        faces = [triangle for polygon in polygons for triangle in triangulate(points, polygon)]
        if faces:
            color = materials.get(max(uses, key=lambda key: uses[key]))
            component = RawComponent((name,) if name else (), points, np.array(faces, dtype=np.int64), color)
            model.add(component, path)
    return model


def _vertex_index(word: str, count: int) -> int:
    index = int(word.split("/")[0])
    absolute = index - 1 if index > 0 else count + index
    if index == 0 or not 0 <= absolute < count:
        raise ValueError(f"vertex {index} of {count}")
    return absolute


def _read_materials(path: Path) -> dict[str, Color]:
    """Diffuse colours of an MTL file; none for a missing or malformed file, without which OBJ is still usable."""
    colors: dict[str, Color] = {}
    if not path.is_file():
        return colors
    name = ""
    for line in path.read_text(errors="replace").splitlines():
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

    def turn(a: int, b: int, c: int) -> float:
        (ax, ay), (bx, by), (cx, cy) = flat[a], flat[b], flat[c]
        return float((bx - ax) * (cy - ay) - (by - ay) * (cx - ax))

    rest = list(range(len(polygon)))
    triangles = []
    while len(rest) > 3:
        for i in range(len(rest)):
            a, b, c = rest[i - 1], rest[i], rest[(i + 1) % len(rest)]
            others = [p for p in rest if p not in (a, b, c)]
            inside = any(turn(a, b, p) >= 0 and turn(b, c, p) >= 0 and turn(c, a, p) >= 0 for p in others)
            if turn(a, b, c) > 0 and not inside:
                break
        else:
            i = 1
            a, b, c = rest[0], rest[1], rest[2]
        triangles.append((polygon[a], polygon[b], polygon[c]))
        del rest[i]
    triangles.append((polygon[rest[0]], polygon[rest[1]], polygon[rest[2]]))
    return triangles
