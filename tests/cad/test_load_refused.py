"""load_model: files that must be refused, each with one clear line and nothing printed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from arview.cad.load import load_model
from arview.errors import ArviewError, InputError
from helpers.cad_files import box, glb_with_boxes, nested_3mf, nested_glb, nested_step, write_3mf


def truncated_glb(folder: Path) -> Path:
    path = nested_glb(folder)
    path.write_bytes(path.read_bytes()[:-40])
    return path


def short_buffer_glb(folder: Path) -> Path:
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3"},
        {"bufferView": 1, "componentType": 5123, "count": 360, "type": "SCALAR"},
    ]
    return glb_with_boxes(folder / "short.glb", [{"mesh": 0}], [0], accessors=accessors)


def nan_glb(folder: Path) -> Path:
    path = nested_glb(folder)
    data = bytearray(path.read_bytes())
    start = data.rindex(b"BIN\0") + 4
    data[start : start + 4] = np.float32(np.nan).tobytes()
    path.write_bytes(bytes(data))
    return path


def text_file(name: str, text: str = "this is not a CAD file\n"):
    def make(folder: Path) -> Path:
        (folder / name).write_text(text)
        return folder / name

    return make


def truncated_step(folder: Path) -> Path:
    path = nested_step(folder, "mm")
    path.write_text(path.read_text()[:3000])
    return path


def truncated_stl(folder: Path) -> Path:
    import trimesh

    data = trimesh.Trimesh(*box((0, 0, 0), (10, 10, 10)), process=False).export(file_type="stl")
    (folder / "t.stl").write_bytes(data[:400])
    return folder / "t.stl"


def truncated_ply(folder: Path) -> Path:
    import trimesh

    data = trimesh.Trimesh(*box((0, 0, 0), (10, 10, 10)), process=False).export(file_type="ply")
    (folder / "t.ply").write_bytes(data[:-30])
    return folder / "t.ply"


def point_ply(folder: Path) -> Path:
    import trimesh

    trimesh.PointCloud(np.eye(3)).export(folder / "points.ply")
    return folder / "points.ply"


def nan_ply(folder: Path) -> Path:
    text = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    text += "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 nan 0\n0 1 0\n3 0 1 2\n"
    (folder / "nan.ply").write_text(text)
    return folder / "nan.ply"


def loose_ply(folder: Path) -> Path:
    path = nan_ply(folder)
    path.write_text(path.read_text().replace("nan", "1").replace("3 0 1 2", "3 0 1 7"))
    return path


def truncated_3mf(folder: Path) -> Path:
    path = nested_3mf(folder)
    path.write_bytes(path.read_bytes()[:300])
    return path


def circular_glb(folder: Path) -> Path:
    return glb_with_boxes(folder / "ring.glb", [{"name": "a", "children": [0], "mesh": 0}], [0])


def huge_stl(folder: Path) -> Path:
    path = folder / "huge.stl"
    with path.open("wb") as file:
        file.write(b"\0" * 80 + (6_000_000).to_bytes(4, "little"))
        file.truncate(84 + 50 * 6_000_000)
    return path


def empty_file(folder: Path) -> Path:
    (folder / "empty.step").touch()
    return folder / "empty.step"


REFUSED = [
    (lambda folder: folder / "missing.glb", "no such file"),
    (lambda folder: folder, "is not a file"),
    (text_file("drawing.dwg"), r"type \.dwg is not read; give one of \.step"),
    (empty_file, "empty"),
    (truncated_glb, "truncated"),
    (short_buffer_glb, "truncated"),
    (nan_glb, r"1 of 8 vertices of 'frame/lug' are NaN"),
    (circular_glb, "nested in a circle"),
    (text_file("t.glb"), "not a GLB file"),
    (text_file("t.gltf"), "broken or truncated glTF"),
    (text_file("t.gltf", '{"asset": {"version": "1.0"}}'), r"glTF version 1\.0"),
    (text_file("t.gltf", '{"asset": {"version": "2.0"}}'), "no triangles"),
    (
        text_file("d.gltf", '{"asset": {"version": "2.0"}, "extensionsRequired": ["EXT_structural_metadata"]}'),
        "requires EXT_structural_metadata, which is not read",
    ),
    (text_file("t.step"), "not a STEP file"),
    (truncated_step, r"broken or truncated STEP \(.*unexpected end of file"),
    (
        text_file("t.step", "ISO-10303-21;\nHEADER;\nENDSEC;\nDATA;\nENDSEC;\nEND-ISO-10303-21;\n"),
        "STEP|triangles",
    ),
    (text_file("t.obj", "v 0 0 0\nv 1 0\n"), "line 2 is not valid OBJ"),
    (text_file("t.obj", "v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 4\n"), "vertex 4 of 3"),
    (text_file("t.obj", "v 0 0 0\nv 1 0 0\n"), "no triangles"),
    (text_file("t.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"), "degenerate"),
    (text_file("t.obj", "v 0 0 0\nv 1 0 nan\nv 2 0 0\nf 1 2 3\n"), "NaN"),
    (text_file("t.stl"), "STL|no triangles"),
    (text_file("n.stl", "solid x\nfacet normal a b c\nouter loop\nvertex 0 0 0\nvertex 1 z 0\n"), "STL|no triangles"),
    (text_file("o.obj", "v 0 0 0\nv 1e300 0 0\nv 0 1e300 1e308\nf 1 2 3\n"), "NaN|is it really|degenerate"),
    (truncated_stl, "broken or truncated STL \\(400 of 684 bytes"),
    (
        text_file(
            "h.stl",
            "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\n"
            "endfacet\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\n",
        ),
        r"truncated STL \(its last solid or facet",
    ),
    (
        text_file(
            "q.stl",
            "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n"
            "vertex 1 1 0\nendloop\nendfacet\nendsolid a\n",
        ),
        "a facet has 4 corners",
    ),
    (huge_stl, "more than 5,000,000 triangles; decimate"),
    (text_file("t.ply"), "broken or truncated PLY"),
    (truncated_ply, "broken or truncated PLY"),
    (point_ply, "no triangles"),
    (nan_ply, "NaN"),
    (loose_ply, "a triangle of 'nan' refers to a vertex that does not exist"),
    (text_file("t.3mf"), "not a 3MF file"),
    (truncated_3mf, "not a 3MF file, or truncated"),
    (lambda f: write_3mf(f / "a.3mf", "", '<item objectid="4"/>'), "object 4 does not exist"),
    (lambda f: write_3mf(f / "a.3mf", "<object", ""), "broken 3MF"),
    (lambda f: write_3mf(f / "a.3mf", "", ""), "no triangles"),
]


@pytest.mark.parametrize("make,expected", REFUSED, ids=[str(i) for i in range(len(REFUSED))])
def test_bad_files_get_one_clear_line_and_nothing_is_printed(make, expected, tmp_path, capfd):
    path = make(tmp_path)
    with pytest.raises(ArviewError, match=expected) as caught:
        load_model(path, unit="mm")
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)
    said = capfd.readouterr()
    assert said.out == "" and said.err == ""


def test_too_many_triangles_in_instances(tmp_path, monkeypatch):
    monkeypatch.setattr("arview.cad.formats.raw.MAX_TRIANGLES", 30)
    nodes: list[dict[str, object]] = [{"mesh": 0, "translation": [i, 0, 0]} for i in range(3)]
    with pytest.raises(InputError, match="more than 30 triangles"):
        load_model(glb_with_boxes(tmp_path / "g.glb", nodes, [0, 1, 2]))
