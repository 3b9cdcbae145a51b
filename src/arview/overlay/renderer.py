"""OverlayRenderer: draws model, inspection and status over a frame."""

from __future__ import annotations

from datetime import datetime
from types import NoneType

import numpy as np
from numpy.typing import NDArray

from arview.cad.model import Model
from arview.camera import Camera
from arview.core.checks import check_type
from arview.errors import MismatchError
from arview.geometry import Array, apply
from arview.inspection import ComponentDeviation, Inspection, Verdict
from arview.overlay import labels, paint
from arview.overlay.edges import Edges
from arview.overlay.ghost import CELL_PX, NEAR_MM, Ghost, GhostView, blend, count_cells
from arview.overlay.guide import GuideOutline
from arview.overlay.layout import LabelLayout, LabelRequest, PlacedLabel
from arview.overlay.mesh import anchor_in_model, topology
from arview.overlay.options import CONTEXT_RGB, NEUTRAL_RGB, VERDICT_RGB, OverlayOptions
from arview.overlay.status import StatusLine
from arview.pose import Pose, TrackingState

_CONTEXT_WEIGHT = 0.25
"""Cost of covering a component that was not inspected with a label, relative to one that was."""
_CONTEXT_EDGE_ALPHA = 0.5
"""Opacity of the edges of components that were not inspected."""
_SAME_PLACE = 0.02
"""Distance in diameters within which a component is at one place in all ambiguous poses."""
_CRITICAL_DIMMING = 0.55
"""Factor of the opacity of ghost and edges in the state `critical`."""
_PASS_DIMMING = 0.65
"""Factor of the opacity of components that passed, so that the others stand out."""
_PIECES = 16
"""Pieces per diameter of the part into which edges are cut for a distorting lens: exact to about 0.2 px."""
_ARROW_RGB = (255, 255, 255)
_SEEN_PX = 12
"""Visible pixels below which a component that passed gets no label."""


class OverlayRenderer:
    """Draws ghosts, edges, labels, arrows and the status line for one model, camera and inspection.

    The places of labels depend on earlier frames, so each video needs a renderer of its own; it is not thread-safe. All
    numbers in the picture are from the inspection; the pose only determines where they are drawn.

    Raises:
        MismatchError: the inspection belongs to another model.
    """

    def __init__(
        self,
        model: Model,
        camera: Camera,
        inspection: Inspection | None = None,
        options: OverlayOptions | None = None,
    ) -> None:
        check_type(model, Model, "OverlayRenderer: model")
        check_type(camera, Camera, "OverlayRenderer: camera")
        check_type(inspection, (Inspection, NoneType), "OverlayRenderer: inspection")
        if inspection is not None:
            inspection.check_model(model)
        self.model, self.camera, self.inspection = model, camera, inspection
        self.options = options or OverlayOptions()
        shapes = [topology(component) for component in model.components]
        self._ghost = Ghost(model, camera, shapes)
        self._edges = Edges(shapes, model.diameter_mm / _PIECES if camera.is_distorted else None)
        self._ghost_style, self._edge_style, self._weight = self._styles()
        self._anchors_in_model = np.stack(
            [anchor_in_model(component, shape) for component, shape in zip(model.components, shapes, strict=True)]
        )
        self._line_px = max(1.0, 0.7 + camera.height / 800)
        self._guide = GuideOutline(self._ghost, self._edges, self._line_px)

        size_px = labels.text_size_px(camera.height)
        self._size_px = size_px
        urgent = labels.by_urgency(inspection) if inspection else []
        self._arrow_scale = labels.arrow_scale(inspection, model.diameter_mm, self.options) if inspection else 1.0
        self._arrows = self._arrow_list(urgent) if self.options.show_arrows else []
        self._status = StatusLine(
            camera.width, camera.height, round(0.95 * size_px), inspection,
            self._arrow_scale if self._arrows else None,
        )  # fmt: skip
        self._labelled = urgent if self.options.show_labels else []
        self._index = {component.name: index for index, component in enumerate(model.components)}
        self._verdict = {deviation.name: deviation.verdict for deviation in self._labelled}
        margin_px, gap_px = round(0.6 * size_px), round(0.5 * size_px)
        widest_px = (camera.width - 2 * margin_px - 2 * gap_px) // 2
        self._noted: dict[tuple[str, int], paint.Sprite] = {}
        self._sprites = {
            deviation.name: labels.label_sprite(deviation, self.options, size_px, widest_px)
            for deviation in self._labelled
        }
        widest_px = max((sprite.width for sprite in self._sprites.values()), default=0)
        # Labels with a note are at most as wide as the layout expects.
        self._label_px = size_px, widest_px
        bottom_px = camera.height - margin_px - (self._status.height_px if self.options.show_status else 0)
        self._layout = LabelLayout(camera.width, margin_px, bottom_px, margin_px, gap_px, widest_px)
        self._was_seen: set[str] = set()

    def draw(
        self,
        image: paint.Image,
        pose: Pose,
        fps: float | None = None,
        now: datetime | None = None,
        in_place: bool = False,
    ) -> paint.Image:
        """The annotated frame.

        Args:
            image: (H,W,3) uint8 RGB, of the camera's size.
            pose: of this frame; without ``cam_from_model`` only the status line is drawn, and the outline at its
                ``guide_cam_from_model`` if it has one.
            fps: frame rate to show; None: not shown.
            now: time from which the age of the inspection is computed; None: the current time.
            in_place: draw on the image itself, which must be writable, instead of a copy.

        Raises:
            MismatchError: the image is not of the camera's size.
        """
        expected = (self.camera.height, self.camera.width, 3)
        if image.shape != expected or image.dtype != np.uint8:
            raise MismatchError(f"overlay: image is {image.dtype} {image.shape}, the camera expects uint8 {expected}")
        canvas = image if in_place else np.array(image, order="C")
        view = self._ghost.view(pose.cam_from_model) if pose.cam_from_model is not None else None
        if pose.cam_from_model is None or view is None:
            self._layout.reset()
            self._was_seen.clear()
            if pose.guide_cam_from_model is not None:
                self._guide.draw(canvas, pose.guide_cam_from_model)
        else:
            self._draw_model(canvas, view, pose.cam_from_model, pose.state)
            self._draw_annotations(canvas, view, pose)
        if self.options.show_status:
            self._status.draw(canvas, pose, fps, now)
        return canvas

    def _styles(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Ghost and edge style (C,4) r, g, b, alpha of all components, and their weight (C,) in the layout."""
        ghost_style, edge_style, weight = [], [], []
        for component in self.model.components:
            deviation = self.inspection.find(component.name) if self.inspection else None
            opacity, edge_alpha, cost = self.options.opacity, 1.0, 1.0
            if deviation is not None:
                color = VERDICT_RGB[deviation.verdict]
                opacity *= _PASS_DIMMING if deviation.verdict is Verdict.PASS else 1.0
            elif self.inspection is None:
                color = NEUTRAL_RGB
            else:
                color, opacity, edge_alpha, cost = CONTEXT_RGB, 0.0, _CONTEXT_EDGE_ALPHA, _CONTEXT_WEIGHT
            ghost_style.append([*color, opacity if self.options.show_ghost else 0.0])
            edge_style.append([*(0.75 * np.array(color) + 0.25 * 255), edge_alpha])
            weight.append(cost)
        return (
            np.array(ghost_style, dtype=np.float32),
            np.array(edge_style, dtype=np.float32),
            np.array(weight, dtype=np.float32),
        )

    def _draw_model(self, canvas: paint.Image, view: GhostView, cam_from_model: Array, state: TrackingState) -> None:
        options = self.options
        if options.show_edges == "none":
            cover = np.zeros(view.face_ids.shape, dtype=np.uint8)
            owner = np.zeros(view.face_ids.shape, dtype=np.int16)
        else:
            cover, owner = self._edges.draw(
                self._ghost, view, cam_from_model, self._line_px, options.show_edges == "all"
            )
        dimming = np.array([1, 1, 1, _CRITICAL_DIMMING if state is TrackingState.CRITICAL else 1], dtype=np.float32)
        blend(
            canvas, view.u0, view.v0, view.face_ids, view.shade, view.components,
            self._ghost_style * dimming, cover, owner, self._edge_style * dimming,
        )  # fmt: skip

    def _draw_annotations(self, canvas: paint.Image, view: GhostView, pose: Pose) -> None:
        cam_from_model = pose.cam_from_model
        assert cam_from_model is not None
        placed: list[PlacedLabel] = []
        sprites = {**self._sprites, **self._open_sprites(pose)}
        if self._labelled:
            anchors_px = self._ghost.project(apply(cam_from_model, self._anchors_in_model))
            seen_px, placed = self._place_labels(view, anchors_px, sprites)
            for label in placed:
                self._draw_leader(canvas, label, anchors_px, seen_px)
        self._draw_arrows(canvas, cam_from_model)
        for label in placed:
            paint.put_sprite(canvas, sprites[label.key], label.x, label.y, label.opacity)

    def _open_sprites(self, pose: Pose) -> dict[str, paint.Sprite]:
        """Sprites of the components whose place depends on which of the ambiguous poses is right."""
        if pose.cam_from_model is None or not pose.alternatives:
            return {}
        anchors = apply(pose.cam_from_model, self._anchors_in_model)
        moved = [apply(other, self._anchors_in_model) - anchors for other in pose.alternatives]
        apart = np.max(np.linalg.norm(moved, axis=2), axis=0) > _SAME_PLACE * self.model.diameter_mm
        count = len(pose.alternatives) + 1
        note = "one of two places" if count == 2 else f"one of {count} places"
        sprites = {}
        for deviation in self._labelled:
            if apart[self._index[deviation.name]]:
                key = deviation.name, count
                if key not in self._noted:
                    self._noted[key] = labels.label_sprite(deviation, self.options, *self._label_px, note)
                sprites[deviation.name] = self._noted[key]
        return sprites

    def _place_labels(
        self, view: GhostView, anchors_px: Array, sprites: dict[str, paint.Sprite]
    ) -> tuple[NDArray[np.int64], list[PlacedLabel]]:
        """Visible pixels (C,) of the components, and the placed labels."""
        camera = self.camera
        cells = np.zeros((-(-camera.height // CELL_PX), -(-camera.width // CELL_PX)), dtype=np.float32)
        seen_px = np.zeros(len(self.model.components), dtype=np.int64)
        count_cells(view.u0, view.v0, view.face_ids, view.components, self._weight, cells, seen_px)
        requests: list[LabelRequest] = []
        for deviation in self._labelled:
            if len(requests) == self.options.max_labels:
                break
            index = self._index[deviation.name]
            if self._deserves_label(deviation, anchors_px[index], int(seen_px[index])):
                sprite = sprites[deviation.name]
                requests.append(LabelRequest(deviation.name, sprite.width, sprite.height, anchors_px[index]))
        self._was_seen = {request.key for request in requests}
        part_px = (float(view.u0), float(view.u0 + view.face_ids.shape[1]))
        return seen_px, self._layout.place(requests, part_px, cells)

    def _deserves_label(self, deviation: ComponentDeviation, anchor_px: Array, seen_px: int) -> bool:
        """Whether the component is in the picture, and visible if it passed; with hysteresis."""
        was_seen = deviation.name in self._was_seen
        slack = 0.02 * self.camera.height if was_seen else 0.0
        u, v = anchor_px
        inside = -slack <= u < self.camera.width + slack and -slack <= v < self.camera.height + slack
        if not inside:
            return False
        if deviation.verdict in (Verdict.FAIL, Verdict.UNDECIDED):
            return True
        return seen_px >= (_SEEN_PX // 3 if was_seen else _SEEN_PX)

    def _draw_leader(
        self, canvas: paint.Image, label: PlacedLabel, anchors_px: Array, seen_px: NDArray[np.int64]
    ) -> None:
        if label.opacity < 0.5:
            return
        index, verdict = self._index[label.key], self._verdict[label.key]
        color = VERDICT_RGB[verdict]
        anchor = np.clip(anchors_px[index], 0, [self.camera.width - 1, self.camera.height - 1])
        points = np.array([*self._leader_start(label, anchor), anchor])
        is_urgent = verdict in (Verdict.FAIL, Verdict.UNDECIDED)
        paint.line(canvas, points, color, 2 if is_urgent and self._size_px > 13 else 1)
        paint.dot(canvas, anchor, color, 0.2 * self._size_px, bool(seen_px[index] == 0))

    def _leader_start(self, label: PlacedLabel, anchor_px: Array) -> list[tuple[float, float]]:
        """First points of a leader line: sideways from its box with a short stub, else from its top or bottom."""
        stub = 0.8 * self._size_px if label.on_left else -0.8 * self._size_px
        x = float(label.x + label.width if label.on_left else label.x)
        if (anchor_px[0] - x - stub) * stub > 0:
            y = label.y + 0.5 * min(label.height, 1.9 * self._size_px)
            return [(x, y), (x + stub, y)]
        inside = min(max(float(anchor_px[0]), label.x + 4.0), label.x + label.width - 4.0)
        return [(inside, float(label.y if anchor_px[1] < label.y else label.y + label.height))]

    def _arrow_list(self, deviations: list[ComponentDeviation]) -> list[Array]:
        """Tail and exaggerated tip (2,3) of all arrows in the model frame, mm, the most urgent last."""
        arrows = []
        for deviation in reversed(deviations):
            displacement = labels.arrow_in_model(deviation)
            if displacement is not None and deviation.verdict is not Verdict.PASS:
                tail = self.model.component(deviation.name).bounds_in_model.mean(axis=0)
                arrows.append(np.stack([tail, tail + self._arrow_scale * np.array(displacement)]))
        return arrows

    def _draw_arrows(self, canvas: paint.Image, cam_from_model: Array) -> None:
        if not self._arrows:
            return
        ends_in_cam = apply(cam_from_model, np.stack(self._arrows))
        ends_px = self._ghost.project(ends_in_cam)
        limit_px = 2 * max(self.camera.width, self.camera.height)
        for in_cam, (tail_px, tip_px) in zip(ends_in_cam, ends_px, strict=True):
            if in_cam[:, 2].min() > NEAR_MM and max(np.abs(tail_px).max(), np.abs(tip_px).max()) < limit_px:
                paint.arrow(canvas, tail_px, tip_px, _ARROW_RGB, 0.24 * self._size_px)
