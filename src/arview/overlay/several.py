"""SeveralOverlay: draws several parts, or several specimens of one, in one picture."""

from __future__ import annotations

import colorsys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime

import numpy as np

from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import apply
from arview.overlay import labels, paint
from arview.overlay.annotations import Annotations, LaidOut, WantedLabels
from arview.overlay.options import Rgb
from arview.overlay.renderer import OverlayRenderer
from arview.pose import Pose

_HUES = (0.58, 0.08, 0.83, 0.47, 0.92, 0.14)
"""Hues of the specimens' tags, in turns; none is a colour of a verdict."""
_MARK = "●▲■◆▼★"
"""Marks of the tags, so that colour is never alone."""


def specimen_rgb(number: int) -> Rgb:
    """Colour of the tag of a specimen, by its number from 0; it comes again after six."""
    red, green, blue = colorsys.hsv_to_rgb(_HUES[number % len(_HUES)], 0.55, 1.0)
    return round(255 * red), round(255 * green), round(255 * blue)


def specimen_mark(number: int) -> str:
    """Mark of the tag of a specimen, by its number from 0; it comes again after six."""
    return _MARK[number % len(_MARK)]


class SeveralOverlay:
    """Draws specimens, each with ghost, labels and status line of its own, and a tag with its name.

    All parts are drawn before the first label, so that no ghost covers a label, and the labels of all of them are laid
    out together. A label begins with the mark of its specimen.

    Args:
        renderers: by the names of the specimens, `Pose.instance`, in the order of the poses.

    Attributes:
        laid_out: labels and arrows of the last picture, as drawn.

    Raises:
        InputError: no renderer, or renderers of different cameras.
    """

    def __init__(self, renderers: Mapping[str, OverlayRenderer]) -> None:
        if not renderers:
            raise InputError("overlay of several parts: no renderer given")
        self.renderers = dict(renderers)
        cameras = [one.camera for one in self.renderers.values()]
        if any(camera != cameras[0] for camera in cameras):
            raise InputError("overlay of several parts: the renderers have different cameras")
        self.camera: Camera = cameras[0]
        self._size_px = labels.text_size_px(self.camera.height)
        bottom_px = self.camera.height - sum(one.status_height_px for one in self.renderers.values())
        status_px = bottom_px
        for one in self.renderers.values():
            status_px += one.status_height_px
            one.stack(status_px, bottom_px)
        self._bottom_px = bottom_px
        self._marks = {name: specimen_mark(number) for number, name in enumerate(self.renderers)}
        self._tags = {name: self._tag(number, name) for number, name in enumerate(self.renderers)}
        most = sum(one.options.max_labels for one in self.renderers.values())
        self._annotations = Annotations(self.camera, self._size_px, [], most, bottom_px)
        self.laid_out = LaidOut()

    def draw(
        self,
        image: paint.Image,
        pose: Sequence[Pose],
        fps: float | None = None,
        now: datetime | None = None,
        in_place: bool = False,
    ) -> paint.Image:
        """The annotated frame.

        Args:
            image: (H,W,3) uint8 RGB, of the camera's size.
            pose: of each specimen in this frame, with its name.
            fps: frame rate to show; None: not shown.
            now: time from which the age of the inspections is computed; None: the current time.
            in_place: draw on the image itself, which must be writable, instead of a copy.

        Raises:
            MismatchError: the image is not of the camera's size.
        """
        canvas = image if in_place else np.array(image, order="C")
        frame = self._unpainted(image, canvas, pose)
        for one in pose:
            self.renderers[one.instance].draw_part(canvas, one, now, frame)
        bottom_px = min(self.renderers[one.instance].draw_legend(canvas) for one in pose)
        self.laid_out = self._annotations.draw_leaders(canvas, self._wanted(pose), bottom_px)
        for one in pose:
            self.renderers[one.instance].draw_arrows(canvas, one)
            self._draw_tag(canvas, one)
        self._annotations.draw_labels(canvas, self.laid_out)
        for number, one in enumerate(pose):
            self.renderers[one.instance].draw_state(canvas, one, fps if number == 0 else None, now)
        return canvas

    def _unpainted(self, image: paint.Image, canvas: paint.Image, poses: Sequence[Pose]) -> paint.Image | None:
        """The picture in which occluders of the second and later parts are searched; None if none are searched."""
        renderers = [self.renderers[one.instance] for one in poses if one.cam_from_model is not None]
        if not any(one.options.show_occlusion for one in renderers[1:]):
            return None
        # An image that is not drawn on stays as it is.
        return image.copy() if canvas is image else np.ascontiguousarray(image)

    def _wanted(self, poses: Sequence[Pose]) -> WantedLabels | None:
        """Labels of all specimens, with their marks; the urgent ones of all come first."""
        some = [(one.instance, self.renderers[one.instance].wanted_labels(one)) for one in poses]
        found = [(self._marks[name], wanted) for name, wanted in some if wanted is not None]
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

    def _draw_tag(self, canvas: paint.Image, pose: Pose) -> None:
        """Draw the tag at the specimen's centre."""
        renderer, sprite = self.renderers[pose.instance], self._tags[pose.instance]
        if pose.cam_from_model is not None:
            center = apply(pose.cam_from_model, renderer.model.center_in_model)
            if center[2] > 0:
                u, v = self.camera.project(center)
                x = round(float(np.clip(u - 0.5 * sprite.width, 0, self.camera.width - sprite.width)))
                y = round(float(np.clip(v - 0.5 * sprite.height, 0, self._bottom_px - sprite.height)))
                paint.put_sprite(canvas, sprite, x, y, 0.9)
