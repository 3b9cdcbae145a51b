"""Components that no view shows: there twice, or inside others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from arview.cad import check_part, load_part
from arview.cad.model import Component
from arview.cad.shape import hidden_components as module
from arview.cad.shape.hidden_components import hidden_components
from helpers.cad_files import box, obj_text


def block(name: str, low: tuple[float, float, float], high: tuple[float, float, float]) -> Component:
    vertices, faces = box(low, high)
    return Component(name, vertices, faces.astype(np.int32))


BASE, POST = block("base", (0, 0, 0), (90, 60, 10)), block("post", (10, 10, 10), (30, 30, 40))


def hollow(name: str) -> Component:
    """A box of 40 mm with a cavity of 30 mm."""
    (outer, faces), (inner, _) = box((0, 0, 0), (40, 40, 40)), box((5, 5, 5), (35, 35, 35))
    return Component(name, np.concatenate([outer, inner]), np.concatenate([faces, faces[:, ::-1] + 8]).astype(np.int32))


def refined(component: Component) -> Component:
    """The same shape of four times as many triangles."""
    corners = component.vertices_in_model[component.faces]
    middles = 0.5 * (corners + np.roll(corners, -1, axis=1))
    (a, b, c), (ab, bc, ca) = corners.transpose(1, 0, 2), middles.transpose(1, 0, 2)
    pieces = np.concatenate(
        [np.stack(piece, axis=1) for piece in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    )
    return Component(component.name + " fine", pieces.reshape(-1, 3), np.arange(3 * len(pieces)).reshape(-1, 3))


def l_shape(name: str, sign: float) -> Component:
    """Two blocks that fill the same box as their mirror image, and have another middle."""
    one, two = block("", (0, 0, 0), (40, 10, 10)), block("", (0, 10, 0), (10, 40, 10))
    vertices = np.concatenate([one.vertices_in_model, two.vertices_in_model]) - [20.0, 20.0, 0.0]
    faces = np.concatenate([one.faces, two.faces + 8])
    return Component(name, vertices * [sign, 1.0, 1.0], faces if sign > 0 else faces[:, ::-1])


@pytest.mark.parametrize(
    ("components", "twice", "inside"),
    [
        ([BASE, POST], [], []),
        ([BASE, POST, block("again", (10, 10, 10), (30, 30, 40))], ["again (in post)"], []),
        ([BASE, POST, refined(POST)], ["post fine (in post)"], []),
        ([l_shape("left", 1.0), l_shape("right", -1.0)], [], []),
        ([BASE, block("insert", (5, 5, 2), (20, 20, 8)), POST], [], ["insert (in base)"]),
        # One face is flush with another, or stands out.
        ([BASE, block("flush", (5, 5, 2), (20, 20, 10)), block("out", (40, 5, 2), (50, 20, 11))], [], []),
        ([hollow("case"), block("core", (10, 10, 10), (20, 20, 20))], [], ["core (in case)"]),
        ([hollow("case"), block("core", (5, 5, 5), (35, 35, 35))], [], ["core (in case)"]),
    ],
)
def test_what_no_view_shows(components: list[Component], twice: list[str], inside: list[str]) -> None:
    assert hidden_components(components) == (twice, inside, [])


def test_a_search_that_takes_too_long_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_WORK", 20)
    inserts = [block(f"i{k}", (5 + 20 * k, 5, 2), (20 + 20 * k, 20, 8)) for k in range(3)]
    assert hidden_components([BASE, *inserts]) == ([], ["i0 (in base)"], ["i1", "i2"])


def test_check_names_both(tmp_path: Path) -> None:
    bodies = {"base": ((0, 0, 0), (90, 60, 10)), "copy": ((0, 0, 0), (90, 60, 10)), "insert": ((5, 5, 2), (20, 20, 8))}
    texts = [obj_text(name, *box(*corners), 8 * k) for k, (name, corners) in enumerate(bodies.items())]
    (tmp_path / "a.obj").write_text("".join(texts))
    findings = {one.text.split(",")[0]: one for one in check_part(load_part(tmp_path / "a.obj", "mm")).findings}
    for beginning, name in (("there twice", "copy (in base)"), ("wholly inside another", "insert (in base)")):
        assert findings[beginning].severity == "warning" and findings[beginning].text.endswith(f": {name}")
