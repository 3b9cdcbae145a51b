"""Labels in narrow and wide pictures: numbers whole, nothing overlaps or crosses, every failure shown."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest
from overlay.test_overlay import NOW, box, deviation, inspection, orbit, pose, post

from arview.cad.model import Model, make_model
from arview.camera import Camera
from arview.geometry import Array
from arview.inspection import Inspection
from arview.overlay import OverlayRenderer, labels, paint
from arview.overlay.annotations import LaidOut
from arview.overlay.label_sprite import label_sprite

Point = tuple[float, float]
SIZES = ((360, 640), (360, 480), (480, 854), (640, 480), (1280, 720), (1080, 1920))
LONG = "left_rear_mounting_bracket_of_the_hydraulic_pump_housing_bolt_no_{:03d}"
CJK = "液压泵壳体左后安装支架螺栓第{:d}号部品"
NAMES = {"long": [LONG] * 40, "cjk": [CJK] * 40, "mixed": [LONG, CJK, "b{:d}", "部品{:d}"] * 10}


def forty(kind: str) -> Model:
    names = [name.format(k) for k, name in enumerate(NAMES[kind])]
    posts = [post(names[8 * i + j], -90.0 + 45 * i, -100.0 + 28 * j, 6.0, 25.0) for i in range(5) for j in range(8)]
    return make_model("plate", (box("base", (0, 0, -4), (240, 240, 8)), *posts))


def record(model: Model, rng: np.random.Generator) -> Inspection:
    entries = []
    for component in model.components[1:]:
        kind = rng.choice(["fail", "undecided", "pass"], p=[0.2, 0.1, 0.7])
        shift = {"fail": (112.0, -10.61, 11.02), "undecided": (0.0, 0.45, 0.05), "pass": (0.03, 0.01, -0.04)}[kind]
        entries.append(deviation(component.name, shift, kind))
    return inspection(model, *entries)


def segments(points: tuple[Point, ...]) -> list[tuple[Point, Point]]:
    return list(itertools.pairwise(points))


def side(a: Point, b: Point, c: Point) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def crosses(s: tuple[Point, Point], t: tuple[Point, Point]) -> bool:
    return side(*s, t[0]) * side(*s, t[1]) < -1e-6 and side(*t, s[0]) * side(*t, s[1]) < -1e-6


def crossed_pairs(laid_out: LaidOut) -> list[tuple[str, str]]:
    """Pairs of labels whose leaders cross, or of which the leader of one runs through the box of the other."""
    found = []
    for one, other in itertools.permutations(laid_out.labels, 2):
        x, y, width, height = other.box.x, other.box.y, other.box.width, other.box.height
        dense = np.concatenate([np.linspace(a, b, 400) for a, b in segments(one.box.leader)])
        inside = np.all((dense > [x + 1, y + 1]) & (dense < [x + width - 1, y + height - 1]), axis=1).any()
        lines = itertools.product(segments(one.box.leader), segments(other.box.leader))
        if inside or any(crosses(s, t) for s, t in lines):
            found.append((one.text.name, other.text.name))
    return found


def overlapping(laid_out: LaidOut) -> int:
    boxes = [label.box for label in laid_out.labels]
    return sum(
        a.x < b.x + b.width and b.x < a.x + a.width and a.y < b.y + b.height and b.y < a.y + a.height
        for a, b in itertools.combinations(boxes, 2)
    )


def is_drawn_whole(sprite: paint.Sprite, text: str, sizes: range, is_bold: bool) -> bool:
    """Whether a text is found in a sprite, in some size, as the font draws it."""
    grey = sprite.rgb.astype(np.float32).mean(axis=2)
    for size in sizes:
        mask = paint.text_mask(text, size, is_bold).astype(np.float32)
        rows = np.flatnonzero(mask.any(axis=1))
        mask = mask[rows[0] : rows[-1] + 1]
        if mask.shape[0] <= grey.shape[0] and mask.shape[1] <= grey.shape[1]:
            match = cv2.matchTemplate(grey, mask, cv2.TM_CCOEFF_NORMED)
            if max(match.max(), -match.min()) > 0.95:
                return True
    return False


LAYOUTS = [(size, kind, 3 * number) for number, (size, kind) in enumerate(itertools.product(SIZES, NAMES))]
LAYOUTS += [(size, kind, 1 + 3 * number) for number, (size, kind) in enumerate(itertools.product(SIZES[:4], NAMES))]


@pytest.mark.slow
@pytest.mark.parametrize(("size", "kind", "seed"), LAYOUTS)
def test_thirty_layouts(size: tuple[int, int], kind: str, seed: int) -> None:
    assert len(LAYOUTS) == 30
    width, height = size
    rng = np.random.default_rng(seed)
    focal = 1.2 * min(width, height) * rng.uniform(0.9, 1.8)
    camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    model = forty(kind)
    inspected = record(model, rng)
    renderer = OverlayRenderer(model, camera, inspected)
    cam_from_model: Array = orbit(rng.uniform(0.0, 360.0), rng.uniform(30.0, 70.0), rng.uniform(350.0, 620.0))
    cam_from_model[:2, 3] += rng.uniform(-70.0, 70.0, 2)
    renderer.draw(np.full((height, width, 3), 118, np.uint8), pose(cam_from_model), 30.0, NOW)
    laid_out = renderer.laid_out
    assert len(laid_out.labels) >= 4
    for label in laid_out.labels:
        assert label.text.value in label.lines and label.text.word in label.lines
        name = label.lines[0]
        if name != label.text.name:
            start, end = name.split("…")
            assert start and label.text.name.startswith(start) and label.text.name.endswith(end)
        assert label.box.x >= 0 and label.box.x + label.box.width <= width
        assert label.box.y >= 0 and label.box.y + label.box.height <= height - renderer.status_height_px
    assert overlapping(laid_out) == 0
    assert crossed_pairs(laid_out) == []
    urgent = {one.name for one in inspected.components if one.verdict != "pass"}
    shown = {one.text.name for one in laid_out.labels} | {one.key for one in laid_out.pointers}
    assert urgent and urgent <= shown
    for pointer in laid_out.pointers:
        for end in (pointer.tail_px, pointer.tip_px):
            assert -2 <= end[0] <= width + 1 and -2 <= end[1] <= height - renderer.status_height_px + 1


@pytest.mark.parametrize("widest_px", [60, 100, 166, 320])
@pytest.mark.parametrize("name", [LONG.format(7), CJK.format(7), "b"])
def test_numbers_units_and_verdicts_are_drawn_whole(widest_px: int, name: str) -> None:
    failed = deviation(name, (112.0, -10.61, 11.02), "fail")
    text = labels.label_text(name, failed, None, labels.OverlayOptions())
    drawn = label_sprite(text, 13, widest_px)
    assert drawn.sprite.width <= widest_px
    assert text.value == "113.04 mm" and text.value in drawn.lines
    assert is_drawn_whole(drawn.sprite, text.value, range(7, 14), False)
    assert is_drawn_whole(drawn.sprite, "FAIL", range(7, 14), True)


def test_names_are_shortened_in_the_middle() -> None:
    short = paint.shortened(LONG.format(7), 13, 120, True)
    assert short.startswith("left") and short.endswith("007") and short.count("…") == 1
    assert paint.text_width(short, 13, True) <= 120 < paint.text_width(short[:5] + "xx" + short[5:], 13, True)


def test_glyphs_that_the_font_lacks_are_drawn_as_code_points() -> None:
    assert paint.legible("部品 7 × 2°") == "部品 7 × 2°"
    assert paint.legible("x\u0e01\n") == "x<E01> "
    assert paint.legible("\u0e01") != paint.legible("\u0e02")
    first, other = (paint.text_mask(name, 13) for name in ("液压", "部品"))
    assert first.shape != other.shape or np.any(first != other)
    assert min(first.max(), other.max()) > 200


def test_components_off_the_picture_are_shown_by_an_arrow_at_its_edge() -> None:
    model = make_model("m", (box("base", (0, 0, -4), (200, 200, 8)), post("far", 90, 0), post("near", -40, 0)))
    result = inspection(model, deviation("far", (1.0, 0, 0), "fail"), deviation("near", (0.03, 0, 0), "pass"))
    camera = Camera(640, 480, 700.0, 700.0, 319.5, 239.5)
    renderer = OverlayRenderer(model, camera, result)
    cam_from_model = orbit(90.0, 60.0, 400.0)
    sign = np.sign((cam_from_model[:3, :3] @ [1.0, 0, 0])[0])
    cam_from_model[0, 3] += sign * 200.0
    renderer.draw(np.full((480, 640, 3), 118, np.uint8), pose(cam_from_model), 30.0, NOW)
    (pointer,) = renderer.laid_out.pointers
    assert pointer.key == "far" and pointer.is_outside
    assert (pointer.tip_px[0] - pointer.tail_px[0]) * sign > 0
    assert min(pointer.tip_px[0], 640 - pointer.tip_px[0]) < 8
    shown = {label.text.name: label for label in renderer.laid_out.labels}
    assert shown["far"].text.value == "1.00 mm"
    assert shown["far"].box.leader[-1] == pointer.tail_px
