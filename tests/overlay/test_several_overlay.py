"""Several specimens in one picture: labels apart, each with the name of its specimen."""

from __future__ import annotations

from functools import cache

import numpy as np

from arview.cad import load_part
from arview.inspection import load_inspection
from arview.overlay import OverlayRenderer
from arview.overlay.layout import PlacedLabel
from arview.overlay.renderer import specimen_rgb
from arview.pose import ComponentPresence, Pose, Presence, TrackingState, Visibility
from helpers import two_specimens
from helpers.live_sample import INSPECTION, PART

SEEN = ComponentPresence(Presence.PRESENT, Visibility.VISIBLE, 0.99, 9, 40.0)


@cache
def overlay() -> OverlayRenderer:
    model = load_part(str(PART)).model
    inspection, camera = load_inspection(INSPECTION, model), two_specimens.wide_camera()
    renderer = OverlayRenderer(model, camera, inspection, name="plate#1")
    renderer.add(model, inspection, name="plate#2")
    return renderer


def poses(index: int) -> tuple[Pose, ...]:
    names = [component.name for component in load_part(str(PART)).model.components]
    components = dict.fromkeys(names, SEEN)
    return tuple(
        Pose(truth, None, 1.0, TrackingState.TRACKED, 0.0, index, components=components, instance=f"plate#{number}")
        for number, truth in enumerate(two_specimens.frames()[index][1], 1)
    )


def are_apart(one: PlacedLabel, other: PlacedLabel) -> bool:
    return bool(
        one.x + one.width <= other.x
        or other.x + other.width <= one.x
        or one.y + one.height <= other.y
        or other.y + other.height <= one.y
    )


def test_both_specimens_have_labels_that_do_not_cover_each_other() -> None:
    image = two_specimens.frames()[3][0]
    drawn = overlay().draw(image, poses(3))
    boxes = {label.box.key: label.box for label in overlay().laid_out.labels}
    for mark in "●▲":
        assert sum(key.startswith(mark) for key in boxes) >= 4
    assert all(are_apart(a, b) for a in boxes.values() for b in boxes.values() if a is not b)
    half = image.shape[1] // 2
    assert boxes["● post_1"].x < half < boxes["▲ post_1"].x
    changed = np.any(drawn != image, axis=2)
    assert changed[:, :half].mean() > 0.2 and changed[:, half:].mean() > 0.2


def test_status_lines_are_stacked() -> None:
    rows = [(one._status.bottom_px - one.status_height_px, one._status.bottom_px) for one in overlay()._layers.values()]
    assert rows[0][1] == rows[1][0] and rows[1][1] == overlay().camera.height


def test_tags_differ_in_colour_and_mark() -> None:
    colors = [specimen_rgb(number) for number in range(6)]
    assert min(sum(abs(a - b) for a, b in zip(x, y, strict=True)) for x in colors for y in colors if x != y) > 40
    assert len({tuple(sprite.alpha.ravel().tolist()) for sprite in overlay()._tags.values()}) == 2
