"""OverlayRenderer: draws model, inspection and status of one or many specimens over a frame.

All specimens are drawn before the first label, so that no ghost covers a label, and the labels of all of them are laid
out together. With several of them each has a tag with its name, and a label begins with the mark of its specimen.
"""

from __future__ import annotations

import colorsys
from collections.abc import Collection, Sequence
from dataclasses import replace
from datetime import datetime
from types import NoneType

import numpy as np

from arview.cad import Model
from arview.camera import Camera
from arview.core.checks import check_type
from arview.errors import MismatchError
from arview.geometry import apply
from arview.inspection import Inspection
from arview.overlay import labels, paint
from arview.overlay.annotations import Annotations, LaidOut, WantedLabels
from arview.overlay.options import OverlayOptions, Rgb
from arview.overlay.part_layers import PartLayers
from arview.pose import Pose

_HUES = (0.58, 0.08, 0.83, 0.47, 0.92, 0.14)
"""Hues of the specimens' tags, in turns; none is a colour of a verdict."""
_MARK = "●▲■◆▼★"
"""Marks of the tags, so that colour is never alone."""

Drawn = Sequence[tuple[PartLayers, Pose]]
"""The specimens of a picture with their poses."""


def specimen_rgb(number: int) -> Rgb:
    """Colour of the tag of a specimen, by its number from 0; it comes again after six."""
    red, green, blue = colorsys.hsv_to_rgb(_HUES[number % len(_HUES)], 0.55, 1.0)
    return round(255 * red), round(255 * green), round(255 * blue)


def specimen_mark(number: int) -> str:
    """Mark of the tag of a specimen, by its number from 0; it comes again after six."""
    return _MARK[number % len(_MARK)]


class OverlayRenderer:
    """Draws ghosts, edges, labels, arrows and status lines for one camera.

    The places of labels depend on earlier frames, so each video needs a renderer of its own; it is not thread-safe. All
    measured numbers in the picture are from the inspections; the poses determine where they are drawn, and whether they
    are drawn at all.

    Attributes:
        laid_out: labels and arrows of the last picture, as drawn.

    Raises:
        MismatchError: the inspection belongs to another model.
    """

    def __init__(
        self,
        model: Model,
        camera: Camera,
        inspection: Inspection | None = None,
        options: OverlayOptions | None = None,
        *,
        name: str = "",
        serial: str | None = None,
        pending: Collection[str] = (),
    ) -> None:
        """Prepare the drawing of one specimen; `add` gives others.

        Args:
            model, camera, inspection, options: what is drawn, and how.
            name: of the specimen, see `Pose.instance`; empty for the only one.
            serial: serial number of the part in view, where it is known.
            pending: names of the components that are being measured: without a value, their labels say so.
        """
        check_type(model, Model, "OverlayRenderer: model")
        check_type(camera, Camera, "OverlayRenderer: camera")
        check_type(inspection, (Inspection, NoneType), "OverlayRenderer: inspection")
        self.camera, self.options = camera, options or OverlayOptions()
        self._size_px = self.options.text_px or labels.text_size_px(camera.height)
        self._layers: dict[str, PartLayers] = {}
        self.laid_out = LaidOut()
        self.add(model, inspection, name=name, serial=serial, pending=pending)

    def add(
        self,
        model: Model,
        inspection: Inspection | None = None,
        *,
        name: str,
        serial: str | None = None,
        pending: Collection[str] = (),
    ) -> None:
        """Draw a further specimen of the same or another model; the arguments are those of the constructor."""
        self._layers[name] = PartLayers(
            model, self.camera, inspection, self.options, self._size_px, serial=serial, pending=pending
        )
        layers = list(self._layers.values())
        bottom_px = status_px = self.camera.height - self.status_height_px
        for part in layers:
            status_px += part.status_height_px
            part.stack(status_px, bottom_px)
        self._bottom_px = bottom_px
        texts = layers[0].usual_texts() if len(layers) == 1 else []
        most = len(layers) * self.options.max_labels
        self._annotations = Annotations(self.camera, self._size_px, texts, most, bottom_px)
        self._marks = {name: specimen_mark(number) for number, name in enumerate(self._layers)}
        self._tags = {name: self._tag(number, name) for number, name in enumerate(self._layers)}

    @property
    def status_height_px(self) -> int:
        """Height of all status lines; 0 without them."""
        return sum(part.status_height_px for part in self._layers.values())

    def _knows(self, pose: Pose) -> bool:
        """Whether a pose is of a specimen that is drawn; a pose without a name is of the only one."""
        return len(self._layers) == 1 or pose.instance in self._layers

    def draw(
        self,
        image: paint.Image,
        pose: Pose | Sequence[Pose],
        fps: float | None = None,
        now: datetime | None = None,
        in_place: bool = False,
    ) -> paint.Image:
        """The annotated frame.

        Args:
            image: (H,W,3) uint8 RGB, of the camera's size.
            pose: of each specimen in this frame, with its name; or of the only one. Without ``cam_from_model`` only the
                status line is drawn, and the outline at its ``guide_cam_from_model`` if it has one.
            fps: frame rate to show; None: not shown.
            now: time from which the age of the inspections is computed; None: the current time.
            in_place: draw on the image itself, which must be writable, instead of a copy.

        Raises:
            MismatchError: the image is not of the camera's size, or a pose is of no specimen that is drawn.
        """
        canvas = image if in_place else np.array(image, order="C")
        expected = (self.camera.height, self.camera.width, 3)
        if canvas.shape != expected or canvas.dtype != np.uint8:
            raise MismatchError(f"overlay: image is {canvas.dtype} {canvas.shape}, the camera expects uint8 {expected}")
        poses = [pose] if isinstance(pose, Pose) else list(pose)
        strange = [one for one in poses if not isinstance(one, Pose) or not self._knows(one)]
        if strange:
            raise MismatchError(f"overlay: {strange[0]!r} is no pose of {', '.join(self._layers) or 'the part'}")
        only = next(iter(self._layers.values())) if len(self._layers) == 1 else None
        drawn = [(only or self._layers[one.instance], one) for one in poses]
        frame = _unpainted(image, canvas, drawn)
        for part, found in drawn:
            part.draw_model(canvas, found, now, frame)
        bottom_px = min(part.draw_legend(canvas) for part, _ in drawn)
        self.laid_out = self._annotations.draw_leaders(canvas, self._wanted(drawn), bottom_px)
        for part, found in drawn:
            part.draw_arrows(canvas, found)
            if only is None:
                self._draw_tag(canvas, part, found)
        self._annotations.draw_labels(canvas, self.laid_out)
        for number, (part, found) in enumerate(drawn):
            part.draw_state(canvas, found, fps if number == 0 else None, now)
        return canvas

    def _wanted(self, drawn: Drawn) -> WantedLabels | None:
        """Labels of all specimens; those of several have marks, and the urgent ones of all come first."""
        if len(self._layers) == 1:
            return drawn[0][0].wanted_labels(drawn[0][1])
        some = [(self._marks[pose.instance], part.wanted_labels(pose)) for part, pose in drawn]
        found = [(mark, wanted) for mark, wanted in some if wanted is not None]
        if not found:
            return None
        ranked = [
            (not one.text.is_urgent, rank, replace(one, text=replace(one.text, name=f"{mark} {one.text.name}")))
            for mark, wanted in found
            for rank, one in enumerate(wanted.components)
        ]
        # In turns, so that each specimen gets its share of the room.
        components = [one for _, _, one in sorted(ranked, key=lambda of: of[:2])]
        first, last = zip(*(wanted.part_px for _, wanted in found), strict=True)
        cells = np.sum([wanted.cells for _, wanted in found], axis=0)
        return WantedLabels(components, (min(first), max(last)), cells)

    def _tag(self, number: int, name: str) -> paint.Sprite:
        """Sprite with mark, number and name of a specimen."""
        color = specimen_rgb(number)
        text = paint.text_mask(f"{self._marks[name]} {name}", self._size_px, True)
        pad = round(0.4 * self._size_px)
        sprite = paint.panel(text.shape[1] + 2 * pad, text.shape[0] + pad, 0.3 * self._size_px, 0.85)
        paint.write(sprite, text, pad, pad // 2, color)
        return sprite

    def _draw_tag(self, canvas: paint.Image, part: PartLayers, pose: Pose) -> None:
        """Draw the tag at the specimen's centre."""
        sprite = self._tags[pose.instance]
        if pose.cam_from_model is not None:
            center = apply(pose.cam_from_model, part.model.center_in_model)
            if center[2] > 0:
                u, v = self.camera.project(center)
                x = round(float(np.clip(u - 0.5 * sprite.width, 0, self.camera.width - sprite.width)))
                y = round(float(np.clip(v - 0.5 * sprite.height, 0, self._bottom_px - sprite.height)))
                paint.put_sprite(canvas, sprite, x, y, 0.9)


def _unpainted(image: paint.Image, canvas: paint.Image, drawn: Drawn) -> paint.Image | None:
    """The picture in which occluders of the second and later parts are searched; None if none are searched."""
    in_view = [part for part, pose in drawn if pose.cam_from_model is not None]
    if not any(part.options.show_occlusion for part in in_view[1:]):
        return None
    # An image that is not drawn on stays as it is.
    return image.copy() if canvas is image else np.ascontiguousarray(image)
