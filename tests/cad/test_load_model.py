"""load_model: known geometry through every format, and files that must be refused with one clear line."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from arview.cad.fitness import clean_mesh, inspect_mesh, signed_volumes
from arview.cad.formats.obj import triangulate
from arview.cad.formats.raw import unique_names
from arview.cad.load import load_cad, load_model
from arview.cad.model import Component
from arview.errors import InputError
from helpers.cad_files import (
    NESTED_BOUNDS,
    SHIFT,
    StepAssembly,
    StepPart,
    StepWriter,
    box,
    glb_with_boxes,
    mesh_xml,
    nested_3mf,
    nested_glb,
    nested_scaled_glb,
    nested_step,
    nested_trimesh_glb,
    nested_trs_glb,
    obj_text,
    scaled,
    write_3mf,
    write_glb,
)
from helpers.paths import SAMPLES, SHARED

DATA = SHARED


@pytest.mark.parametrize(
    "make",
    [
        nested_glb,
        nested_trs_glb,
        nested_scaled_glb,
        nested_trimesh_glb,
        lambda folder: nested_step(folder, "mm"),
        lambda folder: nested_step(folder, "m"),
        lambda folder: nested_step(folder, "inch"),
        nested_3mf,
        lambda folder: nested_3mf(folder, "inch"),
    ],
    ids=["glb", "glb-trs", "glb-scaled", "glb-trimesh", "step-mm", "step-m", "step-inch", "3mf", "3mf-inch"],
)
def test_nested_transform_lands_in_mm(make, tmp_path):
    model = load_model(make(tmp_path))
    assert [component.name for component in model.components] == ["lug"]
    np.testing.assert_allclose(model.components[0].bounds_in_model, NESTED_BOUNDS, atol=2e-5)
    fitness = inspect_mesh(model.components[0])
    assert fitness.is_watertight
    assert fitness.volume_mm3 == pytest.approx(6000.0, rel=1e-5)
    np.testing.assert_allclose(fitness.extents_mm, [30, 20, 10], atol=1e-4)


@pytest.mark.parametrize("unit,mm", [("mm", 1.0), ("cm", 10.0), ("m", 1000.0), ("inch", 25.4)])
def test_obj_stl_ply_take_the_unit_given(unit, mm, tmp_path):
    import trimesh

    vertices, faces = box((1 / mm, 2 / mm, 3 / mm), (11 / mm, 22 / mm, 33 / mm))
    (tmp_path / "block.obj").write_text(obj_text("lug", vertices, faces))
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.export(tmp_path / "block.stl")
    mesh.export(tmp_path / "block.ply")
    (tmp_path / "ascii.stl").write_text(mesh.export(file_type="stl_ascii"))
    for name, component in [
        ("block.obj", "lug"),
        ("block.stl", "block"),
        ("block.ply", "block"),
        ("ascii.stl", "ascii"),
    ]:
        model = load_model(tmp_path / name, unit=unit)
        assert [c.name for c in model.components] == [component]
        np.testing.assert_allclose(model.bounds_in_model, [[1, 2, 3], [11, 22, 33]], rtol=1e-6)
        assert len(model.components[0].vertices_in_model) == 8


def test_obj_keeps_names_polygons_negative_indices_and_materials(tmp_path):
    (tmp_path / "two.mtl").write_text("newmtl red\nKd 1.0 0.25 0.0\nnewmtl odd\nKd a b c\n")
    vertices, faces = box((50, 0, 0), (60, 10, 10))
    text = "mtllib two.mtl\no base plate\nusemtl red\n"
    # An L-shaped sheet as one polygon that is not convex, by negative indices and over two lines.
    for x, y in [(0, 0), (20, 0), (20, 5), (5, 5), (5, 20), (0, 20)]:
        text += f"v {x} {y} 0\n"
    text += "f -6/1/1 -5/1/1 -4/1/1 \\\n-3/1/1 -2/1/1 -1/1/1\n" + obj_text("post", vertices, faces, offset=6)
    (tmp_path / "two.obj").write_text(text)
    model = load_model(tmp_path / "two.obj", unit="mm")
    assert [component.name for component in model.components] == ["base plate", "post"]
    assert model.components[0].color == (1.0, 0.25, 0.0)
    a, b, c = model.components[0].vertices_in_model[model.components[0].faces].transpose(1, 0, 2)
    areas = np.cross(b - a, c - a)[:, 2] / 2
    assert np.all(areas > 0)
    assert areas.sum() == pytest.approx(20 * 5 + 5 * 15)


def test_obj_groups_name_components_where_there_are_no_objects(tmp_path):
    vertices, faces = box((0, 0, 0), (10, 10, 10))
    half = obj_text("x", vertices, faces[:6]).replace("o x", "g left")
    rest = "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in faces[6:])
    other = obj_text("x", vertices + 50, faces, offset=8).replace("o x", "g right")
    (tmp_path / "groups.obj").write_text(half + other + "g left\n" + rest)
    model = load_model(tmp_path / "groups.obj", unit="mm")
    assert {component.name for component in model.components} == {"left", "right"}
    assert inspect_mesh(model.component("left")).is_watertight


@pytest.mark.parametrize("turn", [0, 1, 2])
@pytest.mark.parametrize("mirror", [False, True])
def test_triangulate_any_plane_and_sense(turn, mirror):
    polygon = np.array([[0, 0, 0], [4, 0, 0], [4, 1, 0], [1, 1, 0], [1, 3, 0], [0, 3, 0]], dtype=np.float64)
    polygon = np.roll(polygon[::-1] if mirror else polygon, turn, axis=1)
    triangles = polygon[np.array(triangulate(polygon, list(range(6))))]
    normal = np.cross(polygon, np.roll(polygon, -1, axis=0)).sum(axis=0) / 2
    doubled = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    assert np.all(doubled @ normal > 0)
    np.testing.assert_allclose(doubled.sum(axis=0) / 2, normal, atol=1e-12)
    assert np.linalg.norm(normal) == pytest.approx(6.0)


def test_multi_solid_ascii_stl_keeps_solid_names(tmp_path):
    import trimesh

    texts = []
    for name, at in [("left", 0.0), ("right", 50.0)]:
        mesh = trimesh.Trimesh(*box((at, 0, 0), (at + 10, 10, 10)), process=False)
        texts.append(mesh.export(file_type="stl_ascii").replace("solid \n", f"solid {name}\n", 1))
    (tmp_path / "two.stl").write_text("\n".join(texts))
    model = load_model(tmp_path / "two.stl", unit="mm")
    assert len(model.components) == 2
    np.testing.assert_allclose(model.bounds_in_model, [[0, 0, 0], [60, 10, 10]], atol=1e-5)


# --- names --------------------------------------------------------------------------------------------


def test_instances_keep_their_own_names_and_places(tmp_path):
    nodes: list[dict[str, object]] = [
        {"name": "post_1", "mesh": 0},
        {"name": "post_2", "mesh": 0, "translation": [0.1, 0, 0]},
        {"name": "post_2", "mesh": 0, "translation": [0.2, 0, 0]},
        {"name": "right", "children": [4]},
        {"name": "post_1", "mesh": 0, "translation": [0.3, 0, 0]},
        {"mesh": 0, "translation": [0.4, 0, 0]},
    ]
    cad = load_cad(glb_with_boxes(tmp_path / "many.glb", nodes, [0, 1, 2, 3, 5]))
    low_x = {c.name: round(float(c.bounds_in_model[0, 0])) for c in cad.model.components}
    assert low_x == {"post_1": 0, "post_2": 100, "post_2_2": 200, "right/post_1": 300, "box": 400}
    assert any("'post_1'" in note for note in cad.notes)
    assert any("post_2_2" in note for note in cad.notes)


def test_step_instances_of_two_subassemblies_have_names_of_their_own(tmp_path):
    post = StepPart("post", (1, 1, 40), radius=10, color=(0.5, 0.25, 1.0))
    sub = StepAssembly("sub", [("post", post, np.eye(4))])
    root = StepAssembly("root", [("sub_1", sub, np.eye(4)), ("sub_2", sub, scaled(SHIFT, 50.0))])
    model = load_model(StepWriter().write(tmp_path / "a.step", root))
    assert [c.name for c in model.components] == ["sub_1/post", "sub_2/post"]
    np.testing.assert_allclose(model.components[1].bounds_in_model[:, 2], [150, 190], atol=1e-4)
    # OpenCASCADE writes linear colours; what the STEP file says is sRGB.
    np.testing.assert_allclose(model.components[0].color, (0.5, 0.25, 1.0), atol=1e-4)


def test_single_part_step_has_the_product_name(tmp_path):
    model = load_model(StepWriter().write(tmp_path / "file.stp", StepPart("lonely", (10, 20, 30))))
    assert model.name == "file"
    assert [c.name for c in model.components] == ["lonely"]


def test_unique_names_never_collide():
    names, _ = unique_names([("a", "x"), ("a", "x"), ("x_2",), (), ("x",)], "file")
    assert len(set(names)) == 5
    assert "x_2" in names and "file" in names


# --- colours ------------------------------------------------------------------------------------------


def test_gltf_colour_is_turned_from_linear_to_srgb(tmp_path):
    path = glb_with_boxes(tmp_path / "c.glb", [{"name": "a", "mesh": 0}], [0])
    np.testing.assert_allclose(load_model(path).components[0].color, (0.5, 0.25, 1.0), atol=1e-4)


def test_3mf_and_ply_colours(tmp_path):
    import trimesh

    mesh = mesh_xml(*box((0, 0, 0), (10, 10, 10)))
    materials = '<basematerials id="9"><base name="m" displaycolor="#FF8000FF"/></basematerials>'
    resources = f'{materials}<object id="1" name="a" pid="9" pindex="0">{mesh}</object>'
    model = load_model(write_3mf(tmp_path / "c.3mf", resources, '<item objectid="1" partnumber="P-7"/>'))
    assert [c.name for c in model.components] == ["P-7"]
    np.testing.assert_allclose(model.components[0].color, (1.0, 128 / 255, 0.0), atol=1e-6)
    block = trimesh.Trimesh(*box((0, 0, 0), (10, 10, 10)), process=False)
    block.visual.vertex_colors = np.tile([0, 51, 255, 255], (8, 1))
    block.export(tmp_path / "c.ply")
    np.testing.assert_allclose(load_model(tmp_path / "c.ply", unit="mm").components[0].color, (0, 0.2, 1), atol=1e-3)


# --- units --------------------------------------------------------------------------------------------


def test_trimesh_unit_tag_is_believed_only_from_trimesh(tmp_path):
    import trimesh

    mesh = trimesh.Trimesh(*box((0, 0, 0), (10, 20, 30)), process=False)
    mesh.units = "mm"
    data = mesh.export(file_type="glb")
    (tmp_path / "tagged.glb").write_bytes(data)
    cad = load_cad(tmp_path / "tagged.glb")
    np.testing.assert_allclose(cad.model.bounds_in_model[1], [10, 20, 30], atol=1e-4)
    assert any("tagged" in note for note in cad.notes)
    # The same bytes from another program are metres by the specification: 30 m, fine as such.
    (tmp_path / "foreign.glb").write_bytes(data.replace(b"github.com/mikedh/trimesh", b"github.com/mikedh/notrims"))
    np.testing.assert_allclose(load_model(tmp_path / "foreign.glb").bounds_in_model[1], [1e4, 2e4, 3e4], rtol=1e-6)


def test_mixed_trimesh_tags_ask_for_the_unit(tmp_path):
    import trimesh

    scene = trimesh.Scene()
    for index, unit in enumerate(["mm", "inches"]):
        mesh = trimesh.Trimesh(*box((0, 0, 0), (10, 20, 30)), process=False)
        mesh.units = unit
        scene.add_geometry(mesh, node_name=f"n{index}")
    (tmp_path / "mixed.glb").write_bytes(scene.export(file_type="glb"))
    with pytest.raises(InputError, match=r"which unit\?.*inches.*--unit mm"):
        load_model(tmp_path / "mixed.glb")
    np.testing.assert_allclose(load_model(tmp_path / "mixed.glb", unit="mm").bounds_in_model[1], [10, 20, 30])


@pytest.mark.parametrize("file_unit", ["mm", "m", "inch"])
def test_unit_overrides_the_files_own(file_unit, tmp_path):
    # The numbers in the STEP file are those of mm / m / inch; read as metres they scale as numbers.
    per_mm = {"mm": 1.0, "m": 0.001, "inch": 1 / 25.4}[file_unit]
    model = load_model(nested_step(tmp_path, file_unit), unit="m")
    np.testing.assert_allclose(model.bounds_in_model, NESTED_BOUNDS * per_mm * 1000.0, rtol=1e-5, atol=5e-3)


def test_unit_overrides_glb_and_3mf(tmp_path):
    # A unit that the user gives is believed for small parts, too.
    small = load_model(nested_glb(tmp_path), unit="inch")
    np.testing.assert_allclose(np.ptp(small.bounds_in_model, axis=0), [0.508, 0.254, 0.762], rtol=1e-5)
    np.testing.assert_allclose(load_model(nested_3mf(tmp_path), unit="cm").bounds_in_model, NESTED_BOUNDS * 10.0)


def test_no_unit_is_asked_for_with_the_size_under_each(tmp_path):
    (tmp_path / "b.obj").write_text(obj_text("b", *box((0, 0, 0), (120, 80, 8))))
    with pytest.raises(InputError) as caught:
        load_model(tmp_path / "b.obj")
    message = str(caught.value)
    assert "OBJ files carry no unit" in message
    assert "--unit mm (120 × 80 × 8 mm)" in message
    assert "--unit m (120 × 80 × 8 m)" in message
    assert "--unit inch (3048 × 2032 × 203.2 mm)" in message
    assert "\n" not in message


@pytest.mark.parametrize("factor,size", [(1e-5, "0.1 × 0.2 × 0.3 mm"), (1e4, "100 × 200 × 300 m")])
def test_absurd_sizes_are_questioned_whatever_the_unit(factor, size, tmp_path):
    nodes: list[dict[str, object]] = [{"name": "a", "mesh": 0, "scale": [factor * 1000] * 3}]
    nodes[0]["scale"] = [0.01 if factor < 1 else 1e4] * 3
    path = glb_with_boxes(tmp_path / "odd.glb", nodes, [0])
    with pytest.raises(InputError, match=f"is it really {size}.*--unit mm"):
        load_model(path)
    if factor > 1:
        # The numbers are 100, 200 and 300: centimetres make sense of them.
        np.testing.assert_allclose(np.ptp(load_model(path, unit="cm").bounds_in_model, axis=0), [1000, 2000, 3000])
    else:
        with pytest.raises(InputError, match="is it really"):
            load_model(path, unit="cm")


def test_unknown_unit(tmp_path):
    with pytest.raises(InputError, match="unit 'furlong' is not known; give one of mm, cm, m, inch"):
        load_model(nested_glb(tmp_path), unit="furlong")


# --- tessellation and hash ----------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("unit", ["mm", "inch"])
def test_step_tolerance_is_in_mm_whatever_the_files_unit(unit, tmp_path):
    per_mm = {"mm": 1.0, "inch": 1 / 25.4}[unit]
    path = StepWriter(unit).write(tmp_path / "c.step", StepPart("c", (1, 1, 40 * per_mm), radius=10 * per_mm))
    for tolerance_mm in (0.02,) if unit == "inch" else (0.02, 0.5):
        component = load_model(path, tol_linear_mm=tolerance_mm, tol_angular_deg=60).components[0]
        fitness = inspect_mesh(component)
        assert fitness.is_watertight
        # n chords around a circle of 10 mm leave it by 10 (1 - cos(pi / n)): within the tolerance.
        rim = component.vertices_in_model[np.abs(component.vertices_in_model[:, 2]) < 1e-6]
        np.testing.assert_allclose(np.hypot(rim[:, 0], rim[:, 1]), 10.0, atol=1e-4)
        sag_mm = 10.0 * (1.0 - np.cos(np.pi / len(rim)))
        assert 0.2 * tolerance_mm < sag_mm <= tolerance_mm * 1.01
    angular = load_model(path, tol_linear_mm=5.0, tol_angular_deg=5.0)
    assert len(angular.components[0].faces) >= 4 * 72 - 8


@pytest.mark.slow
def test_hash_is_stable_between_runs_and_tells_parts_apart(tmp_path):
    path = nested_step(tmp_path, "mm")
    first = load_model(path).source_hash
    code = f"from arview.cad import load_model; print(load_model({str(path)!r}).source_hash)"
    again = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert again.stdout.strip() == first
    assert load_model(nested_3mf(tmp_path)).source_hash == load_model(nested_3mf(tmp_path)).source_hash
    assert load_model(path, unit="cm").source_hash != first


# --- cleaning -----------------------------------------------------------------------------------------


def test_cleaning_merges_and_drops_and_winds_outwards():
    vertices, faces = box((0, 0, 0), (10, 10, 10))
    rng = np.random.default_rng(1)
    soup = vertices[faces].reshape(-1, 3) + rng.uniform(-3e-5, 3e-5, (36, 3))
    soup = np.concatenate([soup, [[500.0, 0, 0]]])
    soup_faces = np.arange(36).reshape(12, 3)[:, ::-1]
    # A triangle without area, one with a repeated corner, and a double.
    soup_faces = np.concatenate([soup_faces, [[0, 0, 1], [0, 1, 0], soup_faces[3]]])
    clean_vertices, clean_faces = clean_mesh(soup, soup_faces)
    assert clean_vertices.shape == (8, 3)
    assert clean_faces.shape == (12, 3)
    assert signed_volumes(clean_vertices, clean_faces).sum() == pytest.approx(1000.0, rel=1e-4)


def test_inconsistent_winding_is_mended():
    vertices, faces = box((0, 0, 0), (10, 10, 10))
    faces[[1, 4, 7]] = faces[[1, 4, 7]][:, ::-1]
    clean_vertices, clean_faces = clean_mesh(vertices, faces)
    fitness = inspect_mesh(Component("a", clean_vertices, clean_faces.astype(np.int32)))
    assert fitness.is_consistent
    assert fitness.volume_mm3 == pytest.approx(1000.0)


def test_a_cavity_stays_a_cavity_and_a_second_body_turns_out():
    outer, faces = box((0, 0, 0), (10, 10, 10))
    inner, _ = box((2, 2, 2), (4, 4, 4))
    beside, _ = box((20, 0, 0), (21, 1, 1))
    vertices = np.concatenate([outer, inner, beside])
    everything = np.concatenate([faces, faces[:, ::-1] + 8, faces[:, ::-1] + 16])
    clean_vertices, clean_faces = clean_mesh(vertices, everything)
    assert signed_volumes(clean_vertices, clean_faces).sum() == pytest.approx(1000.0 - 8.0 + 1.0)


def test_mirrored_instance_still_faces_outwards(tmp_path):
    nodes: list[dict[str, object]] = [{"name": "a", "mesh": 0, "scale": [-1, 1, 1]}]
    model = load_model(glb_with_boxes(tmp_path / "m.glb", nodes, [0]))
    np.testing.assert_allclose(model.bounds_in_model[0], [-10, 0, 0], atol=1e-6)
    assert inspect_mesh(model.components[0]).volume_mm3 == pytest.approx(6000.0, rel=1e-6)


def test_mirrored_open_sheet_is_turned_over(tmp_path):
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3"},
        {"bufferView": 1, "componentType": 5123, "count": 6, "type": "SCALAR"},
    ]
    normals = []
    for name, scale in [("plain", [1, 1, 1]), ("mirrored", [-1, 1, 1])]:
        nodes: list[dict[str, object]] = [{"name": "a", "mesh": 0, "scale": scale}]
        model = load_model(glb_with_boxes(tmp_path / f"{name}.glb", nodes, [0], accessors=accessors))
        a, b, c = model.components[0].vertices_in_model[model.components[0].faces[0]]
        normals.append(np.cross(b - a, c - a))
        assert inspect_mesh(model.components[0]).open_edge_count == 4
    # The sheet lies in x = 0 and looks along -x; its mirror image looks along +x.
    assert normals[0][0] < 0 < normals[1][0]


def test_nodes_without_triangles_are_left_out(tmp_path):
    meshes = [
        {"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]},
        {"primitives": [{"attributes": {"POSITION": 0}, "mode": 0}]},
    ]
    nodes: list[dict[str, object]] = [{"name": "a", "mesh": 0}, {"name": "points", "mesh": 1}]
    model = load_model(glb_with_boxes(tmp_path / "g.glb", nodes, [0, 1], meshes=meshes))
    assert [c.name for c in model.components] == ["a"]


def test_gltf_strips_fans_strides_and_vertex_colours(tmp_path):
    corners = np.array([[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0], [0.01, 0.01, 0]], dtype="<f4")
    interleaved = np.concatenate([corners, np.tile(np.array([[1, 0.5, 0]], "<f4"), (4, 1))], axis=1).tobytes()
    tree: dict[str, object] = {
        "nodes": [{"name": "strip", "mesh": 0}, {"name": "fan", "mesh": 1, "translation": [0.1, 0, 0]}],
        "scenes": [{"nodes": [0, 1]}],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "mode": 5}]},
            {"primitives": [{"attributes": {"POSITION": 0}, "indices": 2, "mode": 6}]},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 0, "byteOffset": 12, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5121, "count": 4, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 96, "byteStride": 24},
            {"buffer": 0, "byteOffset": 96, "byteLength": 4},
        ],
    }
    model = load_model(write_glb(tmp_path / "s.glb", tree, interleaved + bytes([0, 1, 3, 2])))
    assert len(model.components) == 2
    for component in model.components:
        a, b, c = component.vertices_in_model[component.faces].transpose(1, 0, 2)
        normals = np.cross(b - a, c - a)
        assert np.all(normals[:, 2] > 0)
        assert normals[:, 2].sum() / 2 == pytest.approx(100.0, rel=1e-5)
    np.testing.assert_allclose(model.component("strip").color, (1.0, 0.7354, 0.0), atol=1e-3)


def test_gltf_with_external_buffer(tmp_path):
    glb = nested_glb(tmp_path).read_bytes()
    import json

    length = int.from_bytes(glb[12:16], "little")
    tree = json.loads(glb[20 : 20 + length])
    (tmp_path / "a b.bin").write_bytes(glb[28 + length :])
    tree["buffers"][0]["uri"] = "a%20b.bin"
    (tmp_path / "x.gltf").write_text(json.dumps(tree))
    np.testing.assert_allclose(load_model(tmp_path / "x.gltf").bounds_in_model, NESTED_BOUNDS, atol=1e-5)
    (tmp_path / "a b.bin").unlink()
    with pytest.raises(InputError, match=r"a b\.bin is missing"):
        load_model(tmp_path / "x.gltf")


def test_importing_the_room_is_light():
    code = "import sys, arview.cad; print([m for m in ('trimesh', 'scipy', 'cv2', 'lxml') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


# --- real files ---------------------------------------------------------------------------------------


@pytest.mark.shared
def test_plate_glb_is_in_metres_with_17_named_components():
    model = load_model(DATA / "plate" / "plate.glb")
    assert len(model.components) == 17
    assert model.components[0].name == "base_plate"
    np.testing.assert_allclose(model.bounds_in_model, [[-150, -150, -8], [150, 150, 40]], atol=1e-3)
    np.testing.assert_allclose(model.component("post_1").bounds_in_model, [[-78, 62, 0], [-62, 78, 40]], atol=2e-3)
    assert all(inspect_mesh(component).is_watertight for component in model.components)


@pytest.mark.shared
@pytest.mark.parametrize("name", ["castle", "cube", "teabox", "dragon"])
def test_sequence_glb_and_ply_are_the_same_part(name):
    folder = DATA / "sequences" / name / "models"
    assembly = load_model(folder / "assembly.glb")
    ply = load_model(folder / "obj_000001.ply", unit="mm")
    np.testing.assert_allclose(assembly.bounds_in_model, ply.bounds_in_model, atol=2e-3)
    if name == "castle":
        assert [c.name for c in assembly.components] == ["chateau_floor", "chateau_tower", "cube"]


def test_sample_step_comes_with_names_and_colours():
    path = SAMPLES / "bracket_plate" / "bracket_plate.step"
    model = load_model(path)
    assert "base_plate" in [c.name for c in model.components]
    assert len({c.color for c in model.components}) > 1
    assert all(inspect_mesh(component).is_watertight for component in model.components)


def test_winding_of_a_large_patchwork_is_mended_quickly():
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=4, radius=20)
    faces = np.asarray(sphere.faces, dtype=np.int64).copy()
    rng = np.random.default_rng(3)
    wrong = rng.random(len(faces)) < 0.4
    faces[wrong] = faces[wrong][:, ::-1]
    shell = faces[np.asarray(sphere.triangles_center)[:, 2] > 0]
    vertices = np.concatenate([sphere.vertices, sphere.vertices + 100])
    clean_vertices, clean_faces = clean_mesh(vertices, np.concatenate([faces, shell + len(sphere.vertices)]))
    assert inspect_mesh(Component("a", clean_vertices, clean_faces.astype(np.int32))).is_consistent
    a, b, c = clean_vertices[clean_faces].transpose(1, 0, 2)
    center = np.where((a[:, :1] > 50), 100.0, 0.0)
    outward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a - center)
    # The closed ball faces outwards whatever most triangles did; the open half keeps its majority's side.
    assert np.all(outward > 0)
