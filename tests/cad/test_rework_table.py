"""The tables of a part file about rework: what they say arrives, and mistakes are named with file, table and key."""

from __future__ import annotations

from pathlib import Path

import pytest

from arview.cad import load_part
from arview.cad.part import Part, ReworkAxis
from arview.errors import InputError
from helpers.cad_files import box, obj_text

HEAD = """[part]
cad = "parts.obj"
unit = "mm"
[datums.B]
feature = "hole"
component = "plate"
point_mm = [5, 5, 0]
axis = [0, 0, 1]
diameter_mm = 8
"""


def load(folder: Path, text: str) -> Part:
    content, count = "", 0
    for name, low, high in (("plate", (0, 0, 0), (200, 100, 10)), ("post_1", (20, 20, 10), (40, 40, 60)),
                            ("post_2", (150, 60, 10), (160, 80, 40))):  # fmt: skip
        vertices, faces = box(low, high)
        content += obj_text(name, vertices, faces, count)
        count += 8
    (folder / "parts.obj").write_text(content)
    (folder / "pictures").mkdir(exist_ok=True)
    (folder / "pictures" / "bolts.jpg").write_bytes(b"x")
    (folder / "part.toml").write_text(HEAD + text)
    return load_part(folder / "part.toml")


def test_everything_arrives(tmp_path: Path) -> None:
    part = load(
        tmp_path,
        """
[components.post_1.rework]
how = "unbolt"
text = "2 × M6, 9 N m"
steps = ["Loosen {component}", "{move}"]
pictures = ["pictures/bolts.jpg"]
axes = [
  { toward = "hole_B" }, { away_from = "post_2", name = "to the stop" },
  { direction = [0, 2, 0], name = "towards the hinge" },
]
""",
    )
    rework = part.component_settings("post_1").rework
    assert (rework.name, rework.text) == ("unbolt", "2 × M6, 9 N m")
    assert rework.steps == ("Loosen {component}", "{move}") and rework.pictures == ("pictures/bolts.jpg",)
    assert rework.axes == (
        ReworkAxis("towards", "hole_B"), ReworkAxis("away from", "post_2", name="to the stop"),
        ReworkAxis("towards", "", (0.0, 1.0, 0.0), "towards the hinge"),
    )  # fmt: skip
    assert part.component_settings("post_2").rework.name == "adjust"


def test_defaults_wildcards_and_kinds_come_before_the_components_own(tmp_path: Path) -> None:
    part = load(
        tmp_path,
        """
[defaults.rework]
how = "reweld"
[rework.reweld]
text = "MAG, seam 3 mm"
[rework.press]
steps = ["Press {component} out.", "Press it in: {move}"]
[components."post_*".rework]
how = "press"
[components.post_2.rework]
text = "from below"
""",
    )
    plate, first, second = (part.component_settings(name).rework for name in ("plate", "post_1", "post_2"))
    assert (plate.name, plate.text) == ("reweld", "MAG, seam 3 mm")
    assert (first.name, len(first.steps), first.text) == ("press", 2, "")
    assert (second.name, len(second.steps), second.text) == ("press", 2, "from below")


def test_the_rework_changes_neither_model_nor_hash(tmp_path: Path) -> None:
    plain = load(tmp_path, "").model.source_hash
    assert load(tmp_path, '[components.post_1.rework]\nhow = "shim"\n').model.source_hash == plain


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('how = "unbold"', 'how = \'unbold\': expected one of "adjust", "unbolt"'),
        ('ho = "unbolt"', "unknown key 'ho' (did you mean 'how'?)"),
        ("how = 3", "how = 3"),
        ("text = 3", "expected text in quotes"),
        ('steps = "one"', "expected a list of texts"),
        ("steps = []", "expected a list of texts"),
        ('steps = ["move {way}"]', "expected no braces but {move} and {component}"),
        ('pictures = ["none.jpg"]', "there is no file"),
        ('pictures = ["/etc/passwd"]', "a path below the folder"),
        ('pictures = ["../x.jpg"]', "a path below the folder"),
        ('pictures = ["parts.obj"]', "expected a picture: .jpg"),
        ("axes = 3", "axes = 3"),
        ('axes = [{ toward = "post_3" }]', "did you mean 'post_2'?"),
        ('axes = [{ toward = "hole_C" }]', "did you mean 'hole_B'?"),
        ('axes = [{ toward = "post_2", away_from = "plate" }]', "one of toward, away_from and direction"),
        ("axes = [{ direction = [0, 0, 1] }]", "the text for the fitter"),
        ('axes = [{ direction = [0, 0, 0], name = "up" }]', "a direction other than zero"),
        ('axes = [{ toward = "post_2", nam = "x" }]', "unknown key 'nam'"),
    ],
)
def test_mistakes_are_named_with_their_place(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        load(tmp_path, f"[components.post_1.rework]\n{text}\n")
    told = str(caught.value)
    assert message in told and "part.toml: [components.post_1.rework" in told and "\n" not in told


def test_a_kind_without_steps_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\[rework\] rewelt = .*did you mean 'reweld'"):
        load(tmp_path, '[rework.rewelt]\ntext = "x"\n')
    with pytest.raises(InputError, match="unknown key 'stepz'"):
        load(tmp_path, '[rework.reweld]\nstepz = ["x"]\n')
