"""load_part: a complete part file, the defaults of a bare CAD file, and mistakes named with their place."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from arview.cad import PART_FILE_EXAMPLE, default_view_range, load_part
from arview.errors import ArviewError, InputError
from helpers.cad_files import box, glb_with_boxes, obj_text
from helpers.paths import SAMPLES


@pytest.fixture
def folder(tmp_path):
    """A folder with parts.obj: base_plate 200 × 100 × 10, post_1 and post_2 on it, a fixture beside it."""
    text, count = "", 0
    for name, low, high in [
        ("base_plate", (0, 0, 0), (200, 100, 10)),
        ("post_1", (20, 20, 10), (40, 40, 60)),
        ("post_2", (150, 60, 10), (160, 80, 40)),
        ("fixture", (0, 300, 0), (10, 310, 10)),
    ]:
        vertices, faces = box(low, high)
        text += obj_text(name, vertices, faces, count)
        count += 8
    (tmp_path / "parts.obj").write_text(text)
    return tmp_path


def write(folder: Path, text: str, head: str = '[part]\ncad = "parts.obj"\nunit = "mm"\n') -> Path:
    path = folder / "part.toml"
    path.write_text(head + text)
    return path


def test_everything_in_a_part_file_arrives(folder):
    part = load_part(
        write(
            folder,
            """
name = "demo"
serial = "S-1"
serial_pattern = "S-[0-9]+"
[view_range]
distance_mm = [400, 900.0]
elevation_deg = [10, 80]
[defaults]
position_tolerance_mm = 1.0
[components.base_plate]
role = "base"
color = "#ff8000"
[components.post_1]
position_tolerance_mm = 0.5
angle_tolerance_deg = 2
symmetry = { axis = [0, 0, 2], order = 4 }
[components.fixture]
role = "ignore"
[[symmetry]]
axis = [0, 0, 1]
through_mm = [1, 2, 3]
order = "continuous"
[datums.A]
feature = "plane"
component = "base_plate"
point_mm = [0, 0, 10]
normal = [0, 0, -3]
[datums.B]
feature = "hole"
component = "base_plate"
point_mm = [5, 5, 0]
axis = [0, 0, 1]
diameter_mm = 8
""",
        )
    )
    assert (part.name, part.serial, part.serial_pattern) == ("demo", "S-1", "S-[0-9]+")
    assert [c.name for c in part.model.components] == ["base_plate", "post_1", "post_2"]
    assert part.model.component("base_plate").color == (1.0, 128 / 255, 0.0)
    assert part.inspected == ("post_1", "post_2")
    assert part.component_settings("fixture").role == "ignore"
    post = part.component_settings("post_1")
    assert (post.position_tolerance_mm, post.angle_tolerance_deg) == (0.5, 2.0)
    assert post.symmetry is not None
    assert post.symmetry.axis_in_model == (0, 0, 1)
    assert post.symmetry.through_in_model == (30, 30, 35)
    assert post.symmetry.order == 4
    assert part.component_settings("post_2").position_tolerance_mm == 1.0
    assert part.symmetries[0].order is None
    assert part.symmetries[0].through_in_model == (1, 2, 3)
    assert part.view_range is not None
    assert part.view_range.distance_mm == (400, 900)
    assert part.view_range.azimuth_deg == (-180, 180)
    a, b = part.datums
    assert (a.label, a.feature, a.direction_in_model, a.diameter_mm) == ("A", "plane", (0, 0, -1), None)
    assert (b.feature, b.point_in_model, b.diameter_mm) == ("hole", (5, 5, 0), 8)


def test_ignored_components_change_the_hash_and_colours_do_not(folder):
    plain = load_part(write(folder, "")).model.source_hash
    assert load_part(write(folder, '[components.post_1]\ncolor = "#000000"\n')).model.source_hash == plain
    assert load_part(write(folder, '[components.post_1]\nrole = "ignore"\n')).model.source_hash != plain


def test_the_documented_example_is_valid(folder):
    (folder / "parts.obj").rename(folder / "bracket_plate.obj")
    text = PART_FILE_EXAMPLE.replace("bracket_plate.step", "bracket_plate.obj").replace("# unit", "unit")
    (folder / "example.toml").write_text(text)
    part = load_part(folder / "example.toml")
    assert part.name == "bracket plate"
    assert part.component_settings("post_1").position_tolerance_mm == 0.5
    assert len(part.datums) == 2
    (folder / "example.toml").write_text(
        text.replace("# [[sym", "[[sym").replace("# axis", "axis").replace("# order", "order")
    )
    assert load_part(folder / "example.toml").symmetries[0].order == 2


def test_bare_cad_file_has_defaults(folder):
    part = load_part(folder / "parts.obj", unit="cm")
    assert part.name == "parts"
    assert part.view_range is None
    assert part.inspected == ("base_plate", "post_1", "post_2", "fixture")
    assert part.model.bounds_in_model[1, 0] == pytest.approx(2000)
    view_range = part.effective_view_range
    assert view_range == default_view_range(part.model)
    assert view_range.is_full_sphere
    np.testing.assert_allclose(view_range.distance_mm, [0.9 * part.model.diameter_mm, 40 * part.model.diameter_mm])


def test_a_folder_stands_for_its_part_file_and_unit_overrides(folder):
    write(folder, "")
    assert load_part(folder).name == folder.name
    assert load_part(folder, unit="cm").model.bounds_in_model[1, 0] == pytest.approx(2000)


BAD = [
    ('colour = "x"\n', r"\[part\] unknown key 'colour'.*allowed: name, cad, unit"),
    ('seriall = "x"\n', "did you mean 'serial'"),
    ('serial_pattern = "("\n', r"\[part\] serial_pattern = '\(': expected a regular expression"),
    ("name = 5\n", r"\[part\] name = 5: expected text"),
    ("tol_linear_mm = 0\n", "tol_linear_mm = 0: expected a positive number"),
    ("[viewrange]\n", r"unknown key 'viewrange' \(did you mean 'view_range'\?\); allowed: part"),
    ("[view_range]\n", "'distance_mm' is missing"),
    (
        "[view_range]\ndistance_mm = 400\n",
        r"\[view_range\] distance_mm = 400: expected two numbers \[low, high\]",
    ),
    ("[view_range]\ndistance_mm = [900, 400]\n", r"\[view_range\].*not an interval"),
    ("[view_range]\ndistance_mm = [1, 2]\nelevation_deg = [0, 95]\n", "leaves"),
    ("[view_range]\ndistance_mm = [1, 2]\nelevaton_deg = [0, 9]\n", "did you mean 'elevation_deg'"),
    (
        "[components.post_3]\n",
        r"no component 'post_3' in the CAD; did you mean 'post_\d'\? It has: base_plate",
    ),
    ("[components.zebra]\n", "no component 'zebra' in the CAD; It has: base_plate, post_1, post_2, fixture"),
    ("[components]\npost_1 = 3\n", r"\[components\] post_1 = 3: expected a table"),
    (
        '[components.post_1]\nrole = "basis"\n',
        r'\[components.post_1\] role = \'basis\': expected one of "base"',
    ),
    ("[components.post_1]\ncolor = 'red'\n", 'expected a colour like "#8a8f98"'),
    ("[components.post_1]\nposition_tolerance_mm = true\n", "expected a positive number"),
    (
        "[components.post_1]\ntolerance_mm = 1\n",
        "unknown key 'tolerance_mm' .did you mean 'position_tolerance_mm'",
    ),
    ("[components.post_1]\nsymmetry = { axis = [0, 0, 0], order = 2 }\n", "a direction other than zero"),
    ("[components.post_1]\nsymmetry = { axis = [0, 0, 1], order = 1 }\n", 'at least 2, or "continuous"'),
    ("[components.post_1]\nsymmetry = { axis = [0, 0], order = 2 }\n", r"three numbers \[x, y, z\]"),
    ("[symmetry]\naxis = [0, 0, 1]\n", r"expected tables \[\[symmetry\]\]"),
    ('[datums.A]\nfeature = "cone"\n', 'expected one of "plane", "hole", "pin"'),
    ('[datums.A]\nfeature = "plane"\ncomponent = "base"\n', "no component 'base' in the CAD"),
    (
        '[datums.A]\nfeature = "hole"\ncomponent = "post_1"\npoint_mm = [0, 0, 0]\naxis = [0, 0, 1]\n',
        "diameter_mm",
    ),
    (
        '[features.post_1]\nfeature = "fit"\ncomponent = "post_2"\n',
        r"\[features.post_1\] 'post_1' is the name of a component or datum",
    ),
    ('[features.top]\nfeature = "fit"\ncomponent = "post_2"\nlocks = ["tx"]\n', "unknown key 'locks'"),
    ('[[characteristics]]\nkind = "place"\n', 'kind = .place.: expected one of "position"'),
    ('[[characteristics]]\nkind = "position"\nof = "bore"\n', "of = 'bore': expected features or components, of base_"),
    (
        '[[characteristics]]\nkind = "size"\nof = "post_1"\nmax_mm = 3\n',
        r"of = \['post_1'\]: expected a hole, pin, cylinder or slot",
    ),
    ('[[characteristics]]\nkind = "gap"\nof = ["post_1", "post_2"]\nmin_mm = 3\n', "expected flat faces"),
    (
        '[features.skin]\nfeature = "surface"\ncomponent = "post_1"\npoint_mm = [0, 0, 0]\n'
        '[[characteristics]]\nkind = "position"\nof = "skin"\ntolerance_mm = 1\n',
        'kind = .position.: expected "profile", all that can be required of a surface',
    ),
    ('[datums.A]\nfeature = "surface"\ncomponent = "post_1"\n', 'expected one of "plane"'),
    (
        '[features.slot]\nfeature = "slot"\ncomponent = "post_1"\npoint_mm = [0, 0, 0]\naxis = [0, 0, 1]\n',
        "width_mm",
    ),
    (
        '[datums.A]\nfeature = "plane"\ncomponent = "post_1"\npoint_mm = [0, 0, 0]\nnormal = [0, 0, 1]\n'
        "targets_mm = [[0, 0]]\n",
        r"targets_mm = \[0, 0\]: expected three numbers",
    ),
    (
        '[[characteristics]]\nkind = "position"\nof = "post_1"\ntolerance_mm = 1\nat_maximum_material = true\n'
        "at_least_material = true\n",
        "maximum or least material, not both",
    ),
    ('[[characteristics]]\nkind = "position"\nof = "post_1"\ntolerance_mm = 1\noffset_mm = 1\n', "offset_mm"),
    ('[[characteristics]]\nkind = "distance"\nof = "post_1"\nmin_mm = 3\n', "expected two names"),
    ('[[characteristics]]\nkind = "distance"\nof = ["post_1", "post_2"]\n', "expected min_mm below max_mm, or one"),
    (
        '[[characteristics]]\nkind = "distance"\nof = ["post_1", "post_2"]\nmin_mm = 3\nmax_mm = 2\n',
        "min_mm = 3.0: expected min_mm below max_mm",
    ),
    ('[[characteristics]]\nkind = "position"\nof = "post_1"\n', "'tolerance_mm' is missing"),
    (
        '[[characteristics]]\nkind = "position"\nof = "post_1"\ntolerance_mm = 1\ndatums = ["A"]\n',
        "datums = 'A': expected datums of the part",
    ),
    (
        '[[characteristics]]\nkind = "position"\nof = "post_1"\ntolerance_mm = 1\nzone = "width"\n',
        "a direction across the zone",
    ),
    (
        '[[characteristics]]\nkind = "position"\nof = "post_1"\ntolerance_mm = 1\nat_maximum_material = true\n',
        "maximum material needs the limits of the size of post_1",
    ),
    (
        '[[characteristics]]\nkind = "position"\nof = "post_1"\ntolerance_mm = 1\ntolerance = 2\n',
        "unknown key 'tolerance' .did you mean 'tolerance_mm'",
    ),
    ('[defaults]\nrole = "ignore"\n', "every component has the role 'ignore'"),
    ("[components\n", "not valid TOML"),
]


@pytest.mark.parametrize("text,expected", BAD, ids=[str(i) for i in range(len(BAD))])
def test_mistakes_are_named_with_file_and_place(text, expected, folder):
    path = write(folder, text)
    with pytest.raises(ArviewError, match=expected) as caught:
        load_part(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_missing_files(folder, tmp_path):
    with pytest.raises(InputError, match="no such file; give a part file"):
        load_part(tmp_path / "nothing.toml")
    with pytest.raises(InputError, match=r"there is no file .*gone\.step"):
        load_part(write(folder, "", '[part]\ncad = "gone.step"\n'))
    with pytest.raises(InputError, match="the key 'cad' is missing"):
        load_part(write(folder, "", "[part]\n"))
    with pytest.raises(InputError, match="the key 'part' is missing"):
        load_part(write(folder, "", ""))
    with pytest.raises(InputError, match="which unit"):
        load_part(write(folder, "", '[part]\ncad = "parts.obj"\n'))


def test_settings_of_an_unknown_component(folder):
    with pytest.raises(InputError, match="did you mean 'fixture'"):
        load_part(folder / "parts.obj", unit="mm").component_settings("fixtur")


def test_sample_part_file():
    path = SAMPLES / "bracket_plate" / "part.toml"
    part = load_part(path)
    assert "base_plate" not in part.inspected
    assert part.view_range is not None


def test_a_table_holds_for_all_that_its_selector_names(folder):
    text = (
        '[defaults]\nrole = "ignore"\n[components."post_*"]\nrole = "inspect"\nposition_tolerance_mm = 0.5\n'
        'color = "#ff0000"\n[components.post_2]\nposition_tolerance_mm = 0.2\n[components.base_plate]\nrole = "base"\n'
    )
    part = load_part(write(folder, text))
    assert [s.role for s in part.settings] == ["base", "inspect", "inspect", "ignore"]
    assert [s.position_tolerance_mm for s in part.settings] == [None, 0.5, 0.2, None]
    assert [c.color for c in part.model.components[1:]] == [(1.0, 0.0, 0.0)] * 2
    with pytest.raises(InputError, match=r"no component 'pots_\*' in the CAD; did you mean 'post_"):
        load_part(write(folder, '[components."pots_*"]\nrole = "base"\n'))


def test_a_selector_names_an_assembly(tmp_path):
    nodes: list[dict[str, object]] = [
        {"name": "root", "children": [1, 3]},
        {"name": "sub_1", "children": [2]},
        {"name": "post", "mesh": 0},
        {"name": "sub_2", "children": [4, 5]},
        {"name": "post", "mesh": 0, "translation": [0.1, 0, 0]},
        {"name": "nut", "mesh": 0, "translation": [0.2, 0, 0]},
    ]
    glb_with_boxes(tmp_path / "a.glb", nodes, [0])
    text = '[part]\ncad = "a.glb"\n[components."sub_2/*"]\nrole = "base"\n'
    (tmp_path / "p.toml").write_text(text)
    roles = {s.name: s.role for s in load_part(tmp_path / "p.toml").settings}
    assert roles == {"sub_1/post": "inspect", "sub_2/post": "base", "nut": "base"}


@pytest.mark.parametrize("name", ["a\\u0000b", "a\\u001bb", "a\\nb", "a\\u2028b"])
def test_names_are_one_line_without_control_characters(folder: Path, name: str) -> None:
    for key in ("name", "serial"):
        with pytest.raises(InputError, match=rf"\[part\] {key} = .*expected text") as caught:
            load_part(write(folder, f'{key} = "{name}"\n'))
        assert str(caught.value).isprintable()


def test_control_characters_in_the_names_of_a_cad_file_are_replaced(tmp_path: Path) -> None:
    nodes: list[dict[str, object]] = [{"name": "po\u0000st\u001b", "mesh": 0}, {"name": "\u0007", "mesh": 0}]
    path = glb_with_boxes(tmp_path / "parts.glb", nodes, [0, 1])
    part = load_part(path)
    assert [one.name for one in part.model.components] == ["po st", "parts"]
    assert any("control characters in the names of 2 components" in note for note in part.notes)
