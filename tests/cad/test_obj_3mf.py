"""OBJ in other encodings and with many corners; 3MF files that unpack or multiply beyond all measure."""

from __future__ import annotations

import re
import time
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from arview.cad import check_part, load_part
from arview.cad.fitness import inspect_mesh
from arview.cad.formats.obj import triangulate
from arview.cad.formats.text_encoding import decode_text, text_encoding
from arview.cad.load import load_cad, load_model
from arview.errors import InputError
from helpers.cad_files import (
    QUARTER_TURN,
    SHIFT,
    StepAssembly,
    StepPart,
    StepWriter,
    box,
    mesh_xml,
    obj_text,
    write_3mf,
)

VERTICES, FACES = box((0, 0, 0), (10, 20, 30))
MESH = mesh_xml(VERTICES, FACES)
LOOSE = MESH.replace("</triangles>", '<triangle v1="0" v2="1" v3="99"/></triangles>')


@pytest.mark.parametrize(
    ("text", "encoding", "expected"),
    [
        ("Träger Tröger Größe", "latin-1", "cp1252"),
        ("Écrou à œillet, Ø12", "cp1252", "cp1252"),
        ("螺栓_1 底板 M6螺母", "gb18030", "gb18030"),
        ("轴", "gb18030", "gb18030"),
        ("轴承座\n板", "gb18030", "gb18030"),
        ("Пластина Болт М6 «А»", "cp1251", "cp1251"),
        ("ОСНОВАНИЕ", "cp1251", "cp1251"),
        ("プレート 部品1 支柱", "cp932", "cp932"),
        ("表示板 ソレノイド", "cp932", "cp932"),
        ("브라켓 하우징 커버", "cp949", "cp949"),
        ("底座 立柱 定位塊", "big5", "big5"),
        ("O’Ring – 45° créée", "cp1252", "cp1252"),
        ("底板 Träger", "utf-8", "utf-8"),
        ("Träger", "utf-8-sig", "utf-8-sig"),
        ("底板", "utf-16", "utf-16"),
        ("plain", "ascii", "utf-8"),
    ],
)
def test_encodings_are_recognized(text: str, encoding: str, expected: str) -> None:
    data = text.encode(encoding)
    assert text_encoding(data) == expected
    assert decode_text(data) == text


@pytest.mark.parametrize(
    ("encoding", "names"),
    [
        ("gb18030", ["底板", "定位块"]),
        ("cp932", ["表示板", "ソケット"]),
        ("cp1251", ["Основание", "Стойка"]),
        ("latin-1", ["Träger", "Fuß"]),
    ],
)
def test_names_of_step_in_bytes_of_an_encoding(encoding: str, names: list[str], tmp_path: Path) -> None:
    parts = [StepPart(name, (10.0, 20.0, 30.0)) for name in ("first_name", "second_name")]
    path = StepWriter().write(
        tmp_path / "a.stp",
        StepAssembly("a", [("first_name", parts[0], SHIFT), ("second_name", parts[1], QUARTER_TURN)]),
    )
    text = path.read_text().replace("first_name", names[0]).replace("second_name", names[1])
    path.write_bytes(text.encode(encoding))
    assert [component.name for component in load_cad(path).model.components] == names


def test_decimal_commas_of_3mf_are_read(tmp_path: Path) -> None:
    mesh = mesh_xml(*box((0.5, 0, 0), (10.5, 20, 30))).replace(".", ",")
    move = 'transform="1 0 0 0 1 0 0 0 1 0,25 0 0"'
    path = write_3mf(tmp_path / "a.3mf", f'<object id="1" name="a">{mesh}</object>', f'<item objectid="1" {move}/>')
    cad = load_cad(path)
    np.testing.assert_allclose(cad.model.bounds_in_model, [[0.75, 0, 0], [10.75, 20, 30]])
    assert cad.notes == ("its numbers have decimal commas",)


def test_commas_before_thousands_are_no_decimal_commas(tmp_path: Path) -> None:
    mesh = MESH.replace('x="10.0"', 'x="1,010.0"')
    path = write_3mf(tmp_path / "a.3mf", f'<object id="1" name="a">{mesh}</object>', '<item objectid="1"/>')
    with pytest.raises(InputError, match=r"broken 3MF.*1\.010\.0"):
        load_cad(path)


def test_an_author_in_another_encoding_does_not_change_the_names() -> None:
    data = "底板 定位块 立柱 螺栓 支架 轴承座\n".encode() + "Müller".encode("latin-1")
    assert text_encoding(data) == "utf-8"
    assert decode_text(data).startswith("底板 定位块 立柱 螺栓 支架 轴承座")


def test_bytes_that_no_encoding_knows_stay_different() -> None:
    assert decode_text(b"a\x81b\xff") != decode_text(b"a\x8db\xff")


@pytest.mark.parametrize(
    ("encoding", "names"),
    [
        ("latin-1", ("Träger", "Tröger")),
        ("gb18030", ("支架", "底板")),
        ("cp932", ("ブロック", "表示板")),
        ("cp1251", ("Плита", "Стойка")),
        ("utf-8", ("支架", "Träger")),
        ("utf-8-sig", ("支架", "Träger")),
    ],
)
def test_names_in_an_encoding_stay_two(encoding: str, names: tuple[str, str], tmp_path: Path) -> None:
    first, second = (obj_text(name, VERTICES + 50 * i, FACES, 8 * i) for i, name in enumerate(names))
    text = f"mtllib m.mtl\n{first}".replace("\nf", f"\nusemtl {names[0]}\nf", 1) + second
    (tmp_path / "p.obj").write_bytes(text.encode(encoding))
    (tmp_path / "m.mtl").write_bytes(f"newmtl {names[0]}\nKd 1 0.5 0\n".encode(encoding.removesuffix("-sig")))
    cad = load_cad(tmp_path / "p.obj", "mm")
    assert [c.name for c in cad.model.components] == list(names)
    np.testing.assert_allclose(cad.model.components[0].bounds_in_model, [[0, 0, 0], [10, 20, 30]])
    assert cad.model.components[0].color == (1.0, 0.5, 0.0)
    assert not cad.notes


def test_names_that_are_there_twice_are_told(tmp_path: Path) -> None:
    text = "".join(obj_text("bolt", VERTICES + 50 * i, FACES, 8 * i) for i in range(3))
    (tmp_path / "p.obj").write_text(text)
    cad = load_cad(tmp_path / "p.obj", "mm")
    assert [c.name for c in cad.model.components] == ["bolt", "bolt_2", "bolt_3"]
    assert cad.notes == ("2 more components are named 'bolt': called bolt_2, bolt_3",)


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (3, 1, 0, 2), (2, 3, 1, 0)])
def test_numbers_of_equal_names_do_not_depend_on_the_order_of_the_file(order: tuple[int, ...], tmp_path: Path) -> None:
    places = np.array([[0, 0, 0], [1e-5, 40, 0], [50, -1e-5, 0], [50 - 1e-5, 40, 0]])
    text = "".join(obj_text("bolt", VERTICES + places[i], FACES, 8 * k) for k, i in enumerate(order))
    (tmp_path / "p.obj").write_text(text)
    (tmp_path / "part.toml").write_text(
        '[part]\ncad = "p.obj"\nunit = "mm"\n[components.bolt_2]\nposition_tolerance_mm = 0.25\n'
    )
    part = load_part(tmp_path)
    found = {c.name: c.bounds_in_model[0] for c in part.model.components}
    for name, place in zip(["bolt", "bolt_2", "bolt_3", "bolt_4"], places, strict=True):
        np.testing.assert_allclose(found[name], place, atol=1e-6)
    told = [finding.text for finding in check_part(part).findings if "one name" in finding.text]
    assert len(told) == 1 and sorted(told[0].partition("there: ")[2].split(", ")) == sorted(found)


def test_equal_names_with_equal_settings_are_not_told(tmp_path: Path) -> None:
    (tmp_path / "p.obj").write_text("".join(obj_text("bolt", VERTICES + 50 * i, FACES, 8 * i) for i in range(3)))
    findings = check_part(load_part(tmp_path / "p.obj", "mm")).findings
    assert not [finding for finding in findings if "numbered" in finding.text]


def test_names_of_stl_solids_in_latin_1(tmp_path: Path) -> None:
    import trimesh

    texts = []
    for i, name in enumerate(("Träger", "Tröger")):
        mesh = trimesh.Trimesh(VERTICES + 50 * i, FACES, process=False)
        texts.append(mesh.export(file_type="stl_ascii").replace("solid \n", f"solid {name}\n", 1))
    (tmp_path / "p.stl").write_bytes("\n".join(texts).encode("latin-1"))
    model = load_model(tmp_path / "p.stl", "mm")
    assert [c.name for c in model.components] == ["Träger", "Tröger"]


def test_faces_that_are_wrong_are_told_and_mended(tmp_path: Path) -> None:
    inverted = obj_text("inverted", VERTICES, FACES[:, ::-1])
    mixed = np.concatenate([FACES[:5, ::-1], FACES[5:]])
    text = inverted + obj_text("mixed", VERTICES + 50, mixed, 8) + obj_text("right", VERTICES + 100, FACES, 16)
    flat = np.concatenate([FACES, FACES[:1], [[0, 0, 1]]])
    text += obj_text("flat", VERTICES + 150, flat, 24) + obj_text("open", VERTICES + 200, FACES[2:, ::-1], 32)
    (tmp_path / "p.obj").write_text(text)
    cad = load_cad(tmp_path / "p.obj", "mm")
    for component in cad.model.components[:4]:
        assert inspect_mesh(component).volume_mm3 == pytest.approx(6000.0)
    assert cad.notes == (
        "triangles that faced inwards were turned: inverted, mixed",
        "triangles without area, or that were there twice, were left out: flat",
    )


def test_materials_are_read_beside_the_file_only(tmp_path: Path) -> None:
    (tmp_path / "m.mtl").write_text("newmtl a\nKd 1 0 0\n")
    (tmp_path / "part").mkdir()
    for name, color in (("../m.mtl", (0.6, 0.6, 0.62)), ("m.mtl", (1.0, 0.0, 0.0))):
        text = f"mtllib {name}\nusemtl a\n" + obj_text("lug", VERTICES, FACES)
        (tmp_path / "part" / "p.obj").write_text(text)
        assert load_model(tmp_path / "part" / "p.obj", "mm").components[0].color == color
        (tmp_path / "part" / "m.mtl").write_text("newmtl a\nKd 1 0 0\n")


@pytest.mark.parametrize("kind", ["comb", "crossing"])
def test_polygons_of_many_corners_take_no_minutes(kind: str) -> None:
    x = np.arange(200.0)
    if kind == "comb":
        top = np.where(np.arange(200) % 2, 10.0, 1.0)
        flat = np.concatenate([np.stack([x[::-1], top], axis=1), np.stack([x, 0 * x], axis=1)])
    else:
        flat = np.random.default_rng(0).normal(size=(400, 2))
    polygon = np.pad(flat, ((0, 0), (0, 1)))
    start = time.process_time()
    triangles = polygon[np.array(triangulate(polygon, list(range(400))))]
    assert time.process_time() - start < 2.0
    assert len(triangles) == 398
    areas = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])[:, 2] / 2
    expected = np.cross(polygon, np.roll(polygon, -1, axis=0))[:, 2].sum() / 2
    assert areas.sum() == pytest.approx(expected)
    assert kind == "crossing" or np.abs(areas).sum() == pytest.approx(abs(expected))


def test_polygons_beyond_measure_are_refused(tmp_path: Path) -> None:
    corners = "".join(f"v {x} {x * x} 0\n" for x in range(1200))
    (tmp_path / "p.obj").write_text(corners + "f " + " ".join(map(str, range(1, 1102))) + "\n")
    with pytest.raises(InputError, match="a face of 1101 corners; export triangles"):
        load_model(tmp_path / "p.obj", "mm")
    (tmp_path / "p.obj").write_text(corners + ("f " + " ".join(map(str, range(1, 901))) + "\n") * 70)
    with pytest.raises(InputError, match="too many faces of many corners"):
        load_model(tmp_path / "p.obj", "mm")


def levels(copies: int, depth: int) -> tuple[str, str]:
    """Resources and build of objects that hold copies of the one before."""
    component = '<component objectid="{}"/>'
    objects = [f'<object id="1">{MESH}</object>']
    for i in range(2, depth + 2):
        parts = component.format(i - 1) * copies
        objects.append(f'<object id="{i}"><components>{parts}</components></object>')
    return "".join(objects), f'<item objectid="{depth + 1}"/>'


def test_nested_copies_multiply(tmp_path: Path) -> None:
    model = load_model(write_3mf(tmp_path / "l.3mf", *levels(3, 3)))
    assert len(model.components) == 27


def bomb_blanks(folder: Path) -> Path:
    """60 MB of blanks in 60 kB."""
    path = write_3mf(folder / "b.3mf", "", "")
    xml = f'<model><resources><object id="1">{MESH}{" " * 60_000_000}</object></resources></model>'
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("3D/3dmodel.model", xml)
    return path


def bomb_entities(folder: Path) -> Path:
    """Ten levels of ten entities."""
    path = folder / "e.3mf"
    entities = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10}">' for i in range(1, 10))
    with zipfile.ZipFile(path, "w") as archive:
        xml = f'<!DOCTYPE model [<!ENTITY e0 "aaaaaaaaaa">{entities}]><model>&e9;</model>'
        archive.writestr("3D/3dmodel.model", xml)
    return path


HOSTILE_3MF = [
    (lambda f: write_3mf(f / "l.3mf", *levels(10, 10)), "more than 10,000 components"),
    (bomb_blanks, "unpack to 60 MB are no mesh"),
    (bomb_entities, "a document type declaration, which 3MF does not allow"),
    (
        lambda f: write_3mf(
            f / "c.3mf",
            '<object id="1"><components><component objectid="2"/></components></object>'
            '<object id="2"><components><component objectid="1"/></components></object>',
            '<item objectid="1"/>',
        ),
        "nested in a circle",
    ),
    (
        lambda f: write_3mf(f / "t.3mf", f'<object id="1">{LOOSE}</object>', '<item objectid="1"/>'),
        "a triangle of .t. refers to a vertex that does not exist",
    ),
]


@pytest.mark.parametrize(("make", "expected"), HOSTILE_3MF, ids=[str(i) for i in range(len(HOSTILE_3MF))])
def test_hostile_3mf_is_refused_with_little_memory(make, expected: str, tmp_path: Path) -> None:
    path = make(tmp_path)
    tracemalloc.start()
    start = time.process_time()
    try:
        with pytest.raises(InputError, match=expected) as caught:
            load_model(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert time.process_time() - start < 2.0
    assert peak < 20e6
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def stl_text(vertices: np.ndarray, faces: np.ndarray) -> str:
    facets = ["".join(f"  vertex {x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in vertices[face]) for face in faces]
    body = "".join(f" facet normal 0 0 0\n  outer loop\n{facet}  endloop\n endfacet\n" for facet in facets)
    return f"solid a, v1.2\n{body}endsolid a, v1.2\n"


def ply_text(vertices: np.ndarray, faces: np.ndarray) -> str:
    points = "".join(f"{x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in vertices)
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\n{properties}element face {len(faces)}\n"
    triangles = "".join(f"3 {a} {b} {c}\n" for a, b, c in faces)
    return f"{head}property list uchar int vertex_indices\nend_header\n{points}{triangles}"


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply"])
def test_decimal_commas_are_read_and_told(suffix: str, tmp_path: Path) -> None:
    mesh = box((-1.5, 0.25, 0.0), (60.125, 40.5, 5.75))
    text = {"stl": stl_text(*mesh), "obj": obj_text("a", *mesh), "ply": ply_text(*mesh)}[suffix]
    path = tmp_path / f"a.{suffix}"
    path.write_text(re.sub(r"(?<=\d)\.(?=\d+ |\d+\n)", ",", text).replace("ascii 1,0", "ascii 1.0"))
    assert "60,125" in path.read_text()
    cad = load_cad(path, "mm")
    np.testing.assert_allclose(cad.model.bounds_in_model, [[-1.5, 0.25, 0.0], [60.125, 40.5, 5.75]])
    assert cad.notes == ("its numbers have decimal commas",)
    with pytest.raises(InputError, match=rf"which unit\? {suffix.upper()} files carry no unit; give"):
        load_cad(path)


def test_commas_between_thousands_are_no_decimals(tmp_path: Path) -> None:
    path = tmp_path / "a.stl"
    path.write_text(stl_text(*box((0.0, 0.0, 0.0), (60.0, 40.0, 5.0))).replace("vertex 60.000000", "vertex 1,060.000"))
    with pytest.raises(InputError, match=r"a\.stl: broken STL \(no numbers: '.*vertex 1,060\.000 .*'\)"):
        load_cad(path, "mm")
