"""Labels with their leaders, and arrows to components that are off the picture or for whose label there is no room."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.geometry import Array
from arview.overlay import paint
from arview.overlay.label_sprite import LabelSprite, label_sprite
from arview.overlay.labels import OCCLUDED, LabelText
from arview.overlay.layout import LabelLayout, LabelRequest, PlacedLabel
from arview.overlay.legend import banner_sprite
from arview.overlay.options import Rgb

_MIN_WIDEST = 14.0
"""Width to which labels may always extend, in letter heights, as far as the picture has room for two side by side."""
_SEEN_PX = 12
"""Visible pixels below which a component that need not be shown gets no label."""
_MAX_COVERED = 0.35
"""Share of the picture that labels may cover; the least urgent ones are left out."""
_EDGE_MARGIN = 1.1
"""Distance of an arrow's tail from the border of the picture, in letter heights; its tip is near the border."""
_POINTER_LENGTH = 2.0
"""Length of an arrow to a component without a label, in letter heights."""
_MAX_SPRITES = 512
"""Sprites that are kept; a displaced component needs a new one whenever its rounded distance changes."""


@dataclass(frozen=True)
class Pointer:
    """An arrow to an urgent component: at the border of the picture, or at the component if it has no label.

    Attributes:
        key: name of the component.
        tail_px, tip_px: (x, y) of its ends.
        rgb: its colour.
        is_outside: the component is off the picture.
    """

    key: str
    tail_px: tuple[float, float]
    tip_px: tuple[float, float]
    rgb: Rgb
    is_outside: bool


@dataclass(frozen=True)
class LaidOutLabel:
    """A label as it was drawn.

    Attributes:
        text: the texts that were asked for.
        lines: the texts as drawn; only the name, the first one, may be shortened.
        box: place, size, opacity and leader.
    """

    text: LabelText
    lines: tuple[str, ...]
    box: PlacedLabel


@dataclass(frozen=True)
class LaidOut:
    """Labels and arrows of one picture, and how many components have no label, by what theirs would say."""

    labels: tuple[LaidOutLabel, ...] = ()
    pointers: tuple[Pointer, ...] = ()
    unlabelled: str = ""


@dataclass(frozen=True)
class LabelledComponent:
    """A component that may get a label.

    Attributes:
        text: texts of its label.
        anchor_px: (2,) its point in the image; NaN if it is not in front of the camera.
        anchor_in_cam: (3,) mm, the same point.
        seen_px: its visible pixels.
    """

    text: LabelText
    anchor_px: Array
    anchor_in_cam: Array
    seen_px: int


class WantedLabels(NamedTuple):
    """Components of a part that may get a label, the most urgent first; the columns of the image that the part covers;
    and the weighted covered area, px², of each cell of the image.
    """

    components: list[LabelledComponent]
    part_px: tuple[float, float]
    cells: NDArray[np.float32]


class Annotations:
    """Places and draws labels and arrows, stable from frame to frame."""

    def __init__(
        self, camera: Camera, size_px: int, texts: Sequence[LabelText], max_labels: int, bottom_px: int
    ) -> None:
        """``texts`` are the usual ones: the longest of them decides how wide the columns may be."""
        self._camera, self._size_px, self._max_labels, self._bottom = camera, size_px, max_labels, bottom_px
        margin_px, gap_px = round(0.6 * size_px), round(0.5 * size_px)
        half_px = (camera.width - 2 * margin_px - 2 * gap_px) // 2
        self._sprites = {text: label_sprite(text, size_px, half_px) for text in texts}
        usual_px = max((one.sprite.width for one in self._sprites.values()), default=0)
        self._widest_px = max(usual_px, min(half_px, round(_MIN_WIDEST * size_px)))
        self._margin_px = margin_px
        self._layout = LabelLayout(camera.width, margin_px, bottom_px - margin_px, margin_px, gap_px, self._widest_px)
        self._was_shown: set[str] = set()
        self._shown: dict[str, tuple[LabelText, LabelSprite]] = {}

    def reset(self) -> None:
        """Forget where labels were."""
        self._layout.reset()
        self._was_shown.clear()
        self._shown.clear()

    def lay_out(
        self,
        components: Sequence[LabelledComponent],
        part_px: tuple[float, float],
        cells: NDArray[np.float32],
        bottom_px: int,
    ) -> LaidOut:
        """Labels and arrows of one picture.

        Args:
            components: the most urgent first.
            part_px: first and last column of the image that the part covers.
            cells: weighted covered area of each cell of the image, see `LabelLayout.place`.
            bottom_px: row above which all must stay.
        """
        self._bottom = bottom_px
        self._layout.set_bottom(bottom_px - self._margin_px)
        requests: list[LabelRequest] = []
        edges: dict[str, Pointer] = {}
        covered_px = 0
        for one in components:
            name = one.text.name
            if len(requests) >= self._max_labels and not one.text.is_urgent:
                continue
            is_inside = self._is_inside(one.anchor_px, name in self._was_shown)
            if not is_inside and one.text.is_urgent:
                edges[name] = self._edge_pointer(one)
            if not self._deserves_label(one, is_inside) or len(requests) >= self._max_labels:
                continue
            sprite = self._kept_sprite(one.text).sprite
            covered_px += sprite.width * sprite.height
            if covered_px > _MAX_COVERED * self._camera.width * bottom_px:
                continue
            anchor = np.array(edges[name].tail_px) if name in edges else self._clipped(one.anchor_px)
            requests.append(LabelRequest(name, sprite.width, sprite.height, anchor, one.text.is_urgent))
        self._was_shown = {request.key for request in requests}
        asked = {request.key for request in requests}
        unlabelled = [one.anchor_px for one in components if one.text.is_urgent and one.text.name not in asked]
        placed = self._layout.place(requests, part_px, cells, unlabelled)
        # Labels that fade out are no longer asked for.
        drawn = [(self._shown[box.key][1], box) for box in placed]
        labels = tuple(LaidOutLabel(sprite.text, sprite.lines, box) for sprite, box in drawn)
        shown = {label.box.key for label in labels}
        without = [one for one in components if one.text.is_urgent and one.text.name not in {*shown, *edges}]
        others = Counter(one.text.word or one.text.value for one in components if one.text.name not in shown)
        rest = ", ".join(f"{count} {word}" for word, count in sorted(others.items()))
        return LaidOut(labels, (*edges.values(), *(self._pointer(one, placed) for one in without)), rest)

    def draw_leaders(self, canvas: paint.Image, wanted: WantedLabels | None, bottom_px: int) -> LaidOut:
        """Lay out the labels of a picture, and draw their leaders and arrows; `draw_labels` follows.

        Args:
            canvas: (H,W,3) uint8 RGB, drawn on in place.
            wanted: labels; None: where labels were is forgotten.
            bottom_px: row above which all must stay.
        """
        if wanted is None:
            self.reset()
            return LaidOut()
        laid_out = self.lay_out(*wanted, bottom_px)
        self._draw_leaders(canvas, laid_out, {one.text.name: one.seen_px for one in wanted.components})
        return laid_out

    def _draw_leaders(self, canvas: paint.Image, laid_out: LaidOut, seen_px: Mapping[str, int]) -> None:
        """Draw leaders and arrows; ``seen_px`` are the visible pixels of each component."""
        outside = {pointer.key for pointer in laid_out.pointers if pointer.is_outside}
        for label in laid_out.labels:
            if label.box.opacity < 0.5:
                continue
            points = np.array(label.box.leader)
            is_bold = label.text.is_urgent and not label.text.is_dimmed and self._size_px > 13
            paint.line(canvas, points, label.text.rgb, 2 if is_bold else 1)
            if label.box.key not in outside:
                is_hollow = seen_px.get(label.box.key, 0) == 0 or OCCLUDED in label.text.notes
                paint.dot(canvas, points[-1], label.text.rgb, 0.2 * self._size_px, is_hollow)
        for pointer in laid_out.pointers:
            tail, tip = np.array(pointer.tail_px), np.array(pointer.tip_px)
            paint.arrow(canvas, tail, tip, pointer.rgb, 0.34 * self._size_px)

    def draw_labels(self, canvas: paint.Image, laid_out: LaidOut) -> None:
        """Draw the boxes of the labels."""
        for label in laid_out.labels:
            sprite = self._shown[label.box.key][1].sprite
            paint.put_sprite(canvas, sprite, label.box.x, label.box.y, label.box.opacity)
        if laid_out.unlabelled:
            note = banner_sprite("", f"without a label: {laid_out.unlabelled}", self._size_px, self._camera.width)
            paint.put_sprite(
                canvas, note, (self._camera.width - note.width) // 2, self._bottom - note.height - self._margin_px
            )

    def _kept_sprite(self, text: LabelText) -> LabelSprite:
        """Sprite of a label, looked up only when its text has changed."""
        kept = self._shown.get(text.name)
        if kept is None or (kept[0] is not text and kept[0] != text):
            kept = self._shown[text.name] = text, self._sprite(text)
        return kept[1]

    def _sprite(self, text: LabelText) -> LabelSprite:
        if text not in self._sprites:
            if len(self._sprites) >= _MAX_SPRITES:
                self._sprites.clear()
            self._sprites[text] = label_sprite(text, self._size_px, self._widest_px)
        return self._sprites[text]

    def _is_inside(self, anchor_px: Array, was_shown: bool) -> bool:
        slack = 0.02 * self._camera.height if was_shown else 0.0
        u, v = anchor_px
        return bool(-slack <= u < self._camera.width + slack and -slack <= v < self._bottom + slack)

    def _deserves_label(self, one: LabelledComponent, is_inside: bool) -> bool:
        """Whether the component is urgent, or visible in the picture; with hysteresis."""
        if one.text.is_urgent:
            return True
        return is_inside and one.seen_px >= (_SEEN_PX // 3 if one.text.name in self._was_shown else _SEEN_PX)

    def _clipped(self, anchor_px: Array) -> Array:
        u, v = anchor_px
        return np.array([min(max(u, 0.0), self._camera.width - 1.0), min(max(v, 0.0), self._bottom - 1.0)])

    def _edge_pointer(self, one: LabelledComponent) -> Pointer:
        """Arrow at the border towards a component off the picture."""
        margin = _EDGE_MARGIN * self._size_px
        low, high = np.full(2, margin), np.array([self._camera.width, self._bottom]) - margin
        middle = 0.5 * (low + high)
        if np.isfinite(one.anchor_px).all():
            goal = np.clip(one.anchor_px, -1e4, 1e4)
        else:
            # Behind the camera: the direction in which it has to be turned.
            aside = one.anchor_in_cam[:2]
            goal = middle + 1e4 * aside / max(float(np.linalg.norm(aside)), 1e-9)
        tail = np.clip(goal, low, high)
        along = goal - tail
        length = float(np.linalg.norm(along))
        along = along / length if length > 1e-6 else np.array([0.0, 1.0])
        tip = tail + 0.9 * margin * along
        return Pointer(one.text.name, _xy(tail), _xy(tip), one.text.rgb, True)

    def _pointer(self, one: LabelledComponent, boxes: Sequence[PlacedLabel]) -> Pointer:
        """Arrow at a component in the picture that has no label; it ends at the border of a label that covers it."""
        anchor = self._clipped(one.anchor_px)
        length = _POINTER_LENGTH * self._size_px
        best: tuple[float, Array, Array] | None = None
        for away in np.array([[0.0, -1.0], [0.0, 1.0], [-1.0, 0.0], [1.0, 0.0]]):
            tip = anchor
            for _ in boxes:
                covering = [box for box in boxes if _is_within(tip, box)]
                if not covering:
                    break
                tip = _border(tip, covering[0], away)
            tail = tip + length * away
            covered = sum(_is_within(tail, box) or _is_within(0.5 * (tip + tail), box) for box in boxes)
            limit = np.array([self._camera.width, self._bottom])
            outside = float(np.sum(np.maximum(-tail, 0.0)) + np.sum(np.maximum(tail - limit, 0.0)))
            cost = 1e3 * covered + 10.0 * outside + float(np.linalg.norm(tip - anchor))
            if best is None or cost < best[0]:
                best = cost, tail, tip
        assert best is not None
        return Pointer(one.text.name, _xy(best[1]), _xy(best[2]), one.text.rgb, False)


def _is_within(point: Array, box: PlacedLabel) -> bool:
    return bool(box.x < point[0] < box.x + box.width and box.y < point[1] < box.y + box.height)


def _border(point: Array, box: PlacedLabel, away: Array) -> Array:
    """The point moved along one of the axes to the border of a box."""
    if away[0] != 0.0:
        return np.array([box.x + (box.width if away[0] > 0 else 0), point[1]])
    return np.array([point[0], box.y + (box.height if away[1] > 0 else 0)])


def _xy(point: Array) -> tuple[float, float]:
    return float(point[0]), float(point[1])
