"""glTF as other programs write it: GPU instances, quantised and sparse data, and files that reach too far."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arview.cad.fitness import inspect_mesh
from arview.cad.formats.draco import decode_draco
from arview.cad.formats.limited_process import ProcessLimits
from arview.cad.formats.meshopt import _filtered
from arview.cad.load import load_cad, load_model
from arview.errors import InputError
from helpers.cad_files import box, glb_with_boxes, write_glb

POSTS_M = np.array([[-0.08, -0.04, 0.024], [0.08, -0.04, 0.024], [-0.08, 0.04, 0.024], [0.05, 0.03, 0.024]])
SIZE_MM = np.array([10.0, 20.0, 30.0])


def packed(arrays: list[np.ndarray], types: list[str]) -> tuple[list[dict[str, Any]], list[dict[str, Any]], bytes]:
    """Accessors, buffer views and the binary chunk of arrays, each padded to four bytes."""
    codes = {"<i1": 5120, "<u1": 5121, "<i2": 5122, "<u2": 5123, "<u4": 5125, "<f4": 5126}
    accessors, views, binary = [], [], b""
    for array, kind in zip(arrays, types, strict=True):
        code = next(code for name, code in codes.items() if np.dtype(name) == array.dtype)
        accessors.append({"bufferView": len(views), "componentType": code, "count": len(array), "type": kind})
        data = array.tobytes()
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(data)})
        binary += data + b"\0" * (-len(data) % 4)
    return accessors, views, binary


def instanced_glb(path: Path, extra: list[np.ndarray], attributes: dict[str, int], normalized: int = 0) -> Path:
    """A plate and a post that GPU instancing places, under a node moved by 0.1 m along x."""
    vertices, faces = box((0, 0, 0), (0.01, 0.02, 0.03))
    arrays = [vertices.astype("<f4"), faces.astype("<u2").reshape(-1, 1), *extra]
    accessors, views, binary = packed(arrays, ["VEC3", "SCALAR", *(f"VEC{a.shape[1]}" for a in extra)])
    if normalized:
        accessors[normalized]["normalized"] = True
    content: dict[str, object] = {
        "nodes": [
            {"name": "frame", "translation": [0.1, 0.0, 0.0], "children": [1, 2]},
            {"name": "plate", "mesh": 0},
            {"name": "post", "mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {"attributes": attributes}}},
        ],
        "scenes": [{"nodes": [0]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": accessors,
        "bufferViews": views,
        "extensionsUsed": ["EXT_mesh_gpu_instancing"],
        "extensionsRequired": ["EXT_mesh_gpu_instancing"],
    }
    return write_glb(path, content, binary)


def test_gpu_instances_are_components_of_their_own(tmp_path: Path) -> None:
    model = load_model(instanced_glb(tmp_path / "i.glb", [POSTS_M.astype("<f4")], {"TRANSLATION": 2}))
    assert [c.name for c in model.components] == ["plate", "post_1", "post_2", "post_3", "post_4"]
    for number, place_m in enumerate(POSTS_M, start=1):
        low = model.component(f"post_{number}").bounds_in_model[0]
        np.testing.assert_allclose(low, 100.0 * np.eye(3)[0] + 1000.0 * place_m, atol=1e-4)


def test_gpu_instances_are_turned_and_scaled_by_quantised_attributes(tmp_path: Path) -> None:
    # A quarter turn about z as normalised 16-bit integers, and a mirrored instance of twice the size.
    turns = np.round(32767 * np.array([[0, 0, np.sqrt(0.5), np.sqrt(0.5)], [0, 0, 0, 1]])).astype("<i2")
    scales = np.array([[1, 1, 1], [-2, 2, 2]], dtype="<f4")
    path = instanced_glb(tmp_path / "i.glb", [turns, scales], {"ROTATION": 2, "SCALE": 3, "_ID": 0}, normalized=2)
    model = load_model(path)
    np.testing.assert_allclose(model.component("post_1").bounds_in_model, [[80, 0, 0], [100, 10, 30]], atol=2e-3)
    np.testing.assert_allclose(model.component("post_2").bounds_in_model, [[80, 0, 0], [100, 40, 60]], atol=1e-3)
    a, b, c = (model.component("post_2").vertices_in_model[model.component("post_2").faces]).transpose(1, 0, 2)
    assert np.einsum("ij,ij->i", a - [90, 20, 30], np.cross(b - a, c - a)).min() > 0


def test_gpu_instances_of_unequal_counts_are_refused(tmp_path: Path) -> None:
    extra = [POSTS_M.astype("<f4"), np.ones((3, 3), dtype="<f4")]
    with pytest.raises(InputError, match=r"broken.*GPU instances have \[3, 4\] counts"):
        load_model(instanced_glb(tmp_path / "i.glb", extra, {"TRANSLATION": 2, "SCALE": 3}))


@pytest.mark.parametrize("normalized", [False, True])
def test_quantised_positions(normalized: bool, tmp_path: Path) -> None:
    vertices, faces = box((0, 0, 0), (1, 1, 1))
    stored = np.zeros((8, 4), dtype="<i2")
    stored[:, :3] = vertices * 32767
    accessors, views, binary = packed([stored, faces.astype("<u1").reshape(-1, 1)], ["VEC3", "SCALAR"])
    accessors[0]["normalized"] = normalized
    views[0]["byteStride"] = 8
    scale = (SIZE_MM / 1000.0 / (1 if normalized else 32767)).tolist()
    tree = {
        "nodes": [{"name": "lug", "mesh": 0, "scale": scale}],
        "scenes": [{"nodes": [0]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": accessors,
        "bufferViews": views,
        "extensionsRequired": ["KHR_mesh_quantization", "KHR_materials_unlit"],
    }
    model = load_model(write_glb(tmp_path / "q.glb", tree, binary))
    np.testing.assert_allclose(model.bounds_in_model, [[0, 0, 0], SIZE_MM], atol=1e-4)


@pytest.mark.parametrize("from_zeros", [False, True])
def test_sparse_positions(from_zeros: bool, tmp_path: Path) -> None:
    vertices, faces = box((0, 0, 0), (0.01, 0.02, 0.03))
    rows = np.flatnonzero(vertices.any(axis=1) if from_zeros else vertices[:, 2] > 0)
    base = np.where(vertices[:, 2:] > 0, 0.0, vertices) if not from_zeros else vertices * 0
    arrays = [base.astype("<f4"), faces.astype("<u2").reshape(-1, 1), rows.astype("<u2").reshape(-1, 1)]
    arrays.append(vertices[rows].astype("<f4"))
    accessors, views, binary = packed(arrays, ["VEC3", "SCALAR", "SCALAR", "VEC3"])
    if from_zeros:
        del accessors[0]["bufferView"]
    indices = {"bufferView": 2, "componentType": 5123}
    accessors[0]["sparse"] = {"count": len(rows), "indices": indices, "values": {"bufferView": 3}}
    tree = {
        "nodes": [{"name": "lug", "mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": accessors,
        "bufferViews": views,
    }
    model = load_model(write_glb(tmp_path / "s.glb", tree, binary))
    np.testing.assert_allclose(model.bounds_in_model, [[0, 0, 0], SIZE_MM], atol=1e-4)


# The unit box of `box`, as meshoptimizer 0.22 encodes it: vertices of four 16-bit integers (corners at 32767) and
# triangles in both versions and as a sequence.
CODED_VERTICES = bytes.fromhex(
    "a001004000000100c00000fe0104840000010ccc0000fefdfe0119990000013fff0000fefdfefdfefdfe" + "00" * 34
)
CODED_TRIANGLES = "fe00ff0f0716a102071391050f06ff02040203007687566778a9866589689801690000"
CODED_SEQUENCE = "d10004080a0c020808040a0c0612100412140e0404101214021608101618060a100816180e00000000"


def meshopt_glb(path: Path, vertices: bytes, coded: bytes, mode: str) -> Path:
    """A GLB of one box of 10 × 20 × 30 mm whose vertices and indices are compressed."""
    binary = vertices + b"\0" * (-len(vertices) % 4) + coded
    streams = [
        {"byteOffset": 0, "byteLength": len(vertices), "byteStride": 8, "count": 8, "mode": "ATTRIBUTES"},
        {"byteOffset": len(binary) - len(coded), "byteLength": len(coded), "byteStride": 4, "count": 36, "mode": mode},
    ]
    tree: dict[str, object] = {
        "nodes": [{"name": "lug", "mesh": 0, "scale": (SIZE_MM / 1000.0 / 32767).tolist()}],
        "scenes": [{"nodes": [0]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5122, "count": 8, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": 36, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 1, "byteLength": length, "extensions": {"EXT_meshopt_compression": {"buffer": 0, **stream}}}
            for length, stream in zip((64, 144), streams, strict=True)
        ],
        "buffers": [{"byteLength": len(binary)}, {"byteLength": 208, "extensions": {"EXT_meshopt_compression": {}}}],
        "extensionsRequired": ["EXT_meshopt_compression", "KHR_mesh_quantization"],
    }
    return write_glb(path, tree, binary)


@pytest.mark.parametrize(
    ("coded", "mode"),
    [("e0" + CODED_TRIANGLES, "TRIANGLES"), ("e1" + CODED_TRIANGLES, "TRIANGLES"), (CODED_SEQUENCE, "INDICES")],
)
def test_meshopt_compression(coded: str, mode: str, tmp_path: Path) -> None:
    model = load_model(meshopt_glb(tmp_path / "m.glb", CODED_VERTICES, bytes.fromhex(coded), mode))
    assert len(model.components[0].faces) == 12
    np.testing.assert_allclose(model.bounds_in_model, [[0, 0, 0], SIZE_MM], atol=1e-4)
    vertices, faces = box((0, 0, 0), (1, 1, 1))
    expected = {frozenset(map(tuple, vertices[face])) for face in faces}
    shape = np.round(model.components[0].vertices_in_model / SIZE_MM)
    assert {frozenset(map(tuple, shape[face])) for face in model.components[0].faces} == expected


def test_damaged_meshopt_data_is_refused_or_read(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    refused = 0
    for _ in range(150):
        vertices, coded = bytearray(CODED_VERTICES), bytearray(bytes.fromhex("e1" + CODED_TRIANGLES))
        for data in (vertices, coded):
            data[int(rng.integers(len(data)))] = int(rng.integers(256))
        if rng.random() < 0.3:
            del coded[int(rng.integers(len(coded))) :]
        try:
            load_model(meshopt_glb(tmp_path / "m.glb", bytes(vertices), bytes(coded), "TRIANGLES"))
        except InputError as error:
            assert "\n" not in str(error)
            refused += 1
    assert refused > 50


@pytest.mark.parametrize(
    ("stored", "filter_name", "expected"),
    [
        (np.array([[3 | (-1 << 24), -5 & 0xFFFFFF | (2 << 24)]], dtype=np.int64), "EXPONENTIAL", [[1.5, -20.0]]),
        (np.array([[1023, 0, 0, 1020 | 1], [0, 0, 0, 1020 | 3]], dtype="<i2"), "QUATERNION", None),
    ],
)
def test_meshopt_filters(stored: np.ndarray, filter_name: str, expected: list[list[float]] | None) -> None:
    if expected is not None:
        rows = stored.astype("<i4").view(np.uint8)
        np.testing.assert_allclose(np.frombuffer(_filtered(rows, filter_name), "<f4"), np.ravel(expected))
        return
    rotations = np.frombuffer(_filtered(stored.view(np.uint8), filter_name), "<i2").reshape(-1, 4)
    # The largest part is the second of the first rotation and the last of the second.
    half = round(32767 * np.sqrt(0.5))
    np.testing.assert_allclose(rotations, [[0, half, half, 0], [0, 0, 0, 32767]], atol=1)


def gltf(folder: Path, **changes: Any) -> Path:
    """A triangle in a .gltf file, some of whose entries are changed."""
    tree: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "buffers": [{"uri": "points.bin", "byteLength": 36}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
    }
    folder.mkdir(exist_ok=True)
    (folder / "points.bin").write_bytes(np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], dtype="<f4").tobytes())
    (folder / "t.gltf").write_text(json.dumps({**tree, **changes}))
    return folder / "t.gltf"


def accessor(**changes: Any) -> list[dict[str, Any]]:
    return [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", **changes}]


def test_a_buffer_beside_the_file_is_read(tmp_path: Path) -> None:
    assert len(load_model(gltf(tmp_path / "part")).components) == 1
    (tmp_path / "part" / "data").mkdir()
    (tmp_path / "part" / "points.bin").rename(tmp_path / "part" / "data" / "p 1.bin")
    path = tmp_path / "part" / "t.gltf"
    path.write_text(path.read_text().replace("points.bin", "data/p%201.bin"))
    assert len(load_model(path).components) == 1


@pytest.mark.parametrize("uri", ["../secret.bin", "%2e%2e/secret.bin", "{absolute}", "file://{absolute}", "link.bin"])
def test_a_buffer_elsewhere_is_never_read(uri: str, tmp_path: Path) -> None:
    secret = tmp_path / "secret.bin"
    secret.write_bytes(np.eye(3, dtype="<f4").tobytes())
    path = gltf(tmp_path / "part", buffers=[{"uri": uri.format(absolute=secret), "byteLength": 36}])
    (tmp_path / "part" / "link.bin").symlink_to(secret)
    with pytest.raises(InputError, match="is not a file beside it"):
        load_model(path)


DRACO = {
    "attributes": {"POSITION": 0},
    "extensions": {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}},
}


def meshopt(**entries: object) -> list[dict[str, Any]]:
    return [{"buffer": 0, "byteLength": 36, "extensions": {"EXT_meshopt_compression": {"buffer": 0, **entries}}}]


REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"accessors": accessor(count=40_000_000)}, "40,000,000 elements"),
    ({"accessors": accessor(count=12_000_000)}, "truncated: a mesh ends at byte 144000000 of 36"),
    ({"accessors": [{"componentType": 5126, "count": 14_000_000, "type": "VEC3"}]}, "14,000,000 elements has no data"),
    ({"accessors": accessor(count=-3)}, "accessor count is -3"),
    ({"accessors": accessor(byteOffset=-12)}, "byteOffset is -12"),
    ({"accessors": accessor(count=2**70)}, "elements"),
    ({"bufferViews": [{"buffer": 0, "byteLength": 36, "byteStride": 2}]}, "byteStride of 2"),
    ({"buffers": [{"uri": "missing.bin", "byteLength": 36}]}, r"missing\.bin is missing"),
    ({"buffers": [{"uri": "points.bin", "byteLength": 30}]}, "truncated: a mesh ends at byte 36 of 30"),
    ({"nodes": [{"mesh": 0, "children": [0]}]}, "nested in a circle"),
    ({"nodes": [{"children": [i + 1] * 10} for i in range(9)] + [{"mesh": 0}]}, "more than 10,000 components"),
    (
        {"extensionsRequired": ["KHR_meshopt_compression", "X_y"]},
        r"requires meshopt compression \(KHR.*, X_y, which is",
    ),
    ({"meshes": [{"primitives": [DRACO]}], "accessors": [{**accessor()[0], "bufferView": 9}]}, "broken"),
    (
        {"meshes": [{"primitives": [DRACO]}], "accessors": [{"componentType": 5126, "count": 3, "type": "VEC3"}]},
        r"broken or truncated Draco data \(0 FileTypeException",
    ),
    (
        {"bufferViews": meshopt(byteLength=36, byteStride=12, count=3, mode="ATTRIBUTES")},
        "meshopt: attributes of version",
    ),
    ({"bufferViews": meshopt(byteLength=36, byteStride=12, count=10**9, mode="ATTRIBUTES")}, "36 bytes cannot hold"),
    ({"bufferViews": meshopt(byteLength=36, byteStride=4, count=30, mode="TRIANGLES")}, "meshopt: 30 indices"),
    ({"bufferViews": meshopt(byteLength=0, byteStride=4, count=1, mode="INDICES")}, "meshopt: 1 indices"),
]


@pytest.mark.parametrize(("changes", "expected"), REFUSED, ids=[str(i) for i in range(len(REFUSED))])
def test_hostile_files_are_refused_at_once(changes: dict[str, Any], expected: str, tmp_path: Path) -> None:
    path = gltf(tmp_path, **changes)
    start = time.process_time()
    with pytest.raises(InputError, match=expected) as caught:
        load_model(path)
    assert time.process_time() - start < 10.0  # a library may be imported in it; a billion elements take minutes
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def draco_glb(path: Path, *, count: int = 1, cut: int | None = None, position: int = 0) -> Path:
    """A GLB of boxes of 10 × 20 × 30 mm whose meshes hold nothing but Draco data, with green vertices."""
    import DracoPy

    vertices, faces = box((0, 0, 0), (0.01, 0.02, 0.03))
    colors = np.tile(np.array([[0, 255, 0]], dtype=np.uint8), (8, 1))
    coded = DracoPy.encode(vertices, faces=faces, quantization_bits=16, colors=colors)
    ids = {one["attribute_type"]: one["unique_id"] for one in DracoPy.decode(coded).attributes}
    coded = coded if cut is None else coded[:cut]
    binary = coded + b"\0" * (-len(coded) % 4)
    numbers = {"POSITION": ids[0] + position, "COLOR_0": ids[2]}
    primitive = {
        "attributes": {"POSITION": 0, "COLOR_0": 2},
        "indices": 1,
        "extensions": {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": numbers}},
    }
    tree: dict[str, object] = {
        "nodes": [{"name": f"lug_{k}", "mesh": k, "translation": [0.1 * k, 0, 0]} for k in range(count)],
        "scenes": [{"nodes": list(range(count))}],
        "meshes": [{"primitives": [primitive]} for _ in range(count)],
        "accessors": [
            {"componentType": 5126, "count": 8, "type": "VEC3"},
            {"componentType": 5125, "count": 36, "type": "SCALAR"},
            {"componentType": 5121, "count": 8, "type": "VEC3", "normalized": True},
        ],
        "bufferViews": [{"buffer": 0, "byteLength": len(coded)}],
        "buffers": [{"byteLength": len(binary)}],
        "extensionsRequired": ["KHR_draco_mesh_compression"],
    }
    return write_glb(path, tree, binary)


@pytest.mark.slow
def test_draco_compression(tmp_path: Path) -> None:
    model = load_model(draco_glb(tmp_path / "d.glb", count=3))
    assert [component.name for component in model.components] == ["lug_0", "lug_1", "lug_2"]
    for k, component in enumerate(model.components):
        assert len(component.faces) == 12
        np.testing.assert_allclose(component.bounds_in_model - [100.0 * k, 0, 0], [[0, 0, 0], SIZE_MM], atol=2e-3)
        assert component.color == pytest.approx((0.0, 1.0, 0.0))
        assert inspect_mesh(component).volume_mm3 == pytest.approx(6000.0, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("changes", [{"cut": 40}, {"cut": 90}, {"position": 7}])
def test_damaged_draco_data_is_refused(changes: dict[str, int], tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"d\.glb: .*(Draco|no data)"):
        load_model(draco_glb(tmp_path / "d.glb", **changes))


@pytest.mark.slow
def test_mutated_draco_data_is_read_or_refused(tmp_path: Path) -> None:
    import DracoPy

    vertices, faces = box((0, 0, 0), (1.0, 2.0, 3.0))
    coded = bytearray(DracoPy.encode(vertices, faces=faces))
    rng = np.random.default_rng(3)
    refused = 0
    for _ in range(12):
        other = coded.copy()
        for place in rng.integers(11, len(other), 3):
            other[place] = rng.integers(0, 256)
        try:
            decode_draco([(bytes(other), {"POSITION": 0})], tmp_path / "d.glb")
        except InputError as error:
            assert "Draco" in str(error) or "triangles" in str(error)
            refused += 1
    assert refused


@pytest.mark.slow
@pytest.mark.parametrize(("limits", "expected"), [(ProcessLimits(memory_mb=150.0), "broken or truncated Draco data")])
def test_limits_of_draco(limits: ProcessLimits, expected: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=expected):
        decode_draco([(b"DRACO", {"POSITION": 0})], tmp_path / "d.glb", limits)


def test_deeply_nested_json_is_refused(tmp_path: Path) -> None:
    (tmp_path / "deep.gltf").write_text("[" * 200_000)
    with pytest.raises(InputError, match="broken or truncated glTF"):
        load_model(tmp_path / "deep.gltf")


def test_many_components_of_one_name_are_told_in_one_line(tmp_path: Path) -> None:
    nodes: list[dict[str, object]] = [{"name": "bolt", "mesh": 0, "translation": [i, 0, 0]} for i in range(30)]
    cad = load_cad(glb_with_boxes(tmp_path / "g.glb", nodes, list(range(30))))
    assert len({c.name for c in cad.model.components}) == 30
    assert len(cad.notes) == 1
    assert "29 more components are named 'bolt': called bolt_2, bolt_3, bolt_4, bolt_5 and 25 more" in cad.notes[0]


@pytest.mark.parametrize(
    "hiding",
    [
        {"extensions": {"KHR_node_visibility": {"visible": False}}},
        {"extras": {"visible": False}},
        {"extras": {"hidden": True}},
    ],
)
def test_hidden_nodes_are_left_out_with_all_below_and_told(hiding: dict[str, Any], tmp_path: Path) -> None:
    nodes: list[dict[str, Any]] = [
        {"name": "plate", "mesh": 0, "extensions": {"KHR_node_visibility": {"visible": True}}, "extras": {"hidden": 0}},
        {"name": "jig", "children": [2], **hiding},
        {"name": "clamp", "mesh": 0, "translation": [1.0, 0.0, 0.0]},
    ]
    path = glb_with_boxes(tmp_path / "a.glb", nodes, [0, 1], extensionsRequired=["KHR_node_visibility"])
    cad = load_cad(path)
    assert [component.name for component in cad.model.components] == ["plate"]
    np.testing.assert_allclose(np.ptp(cad.model.bounds_in_model, axis=0), SIZE_MM, atol=1e-5)
    told = "left out, because the glTF file hides them (show and export them to have them): jig"
    assert cad.notes == (told,)
