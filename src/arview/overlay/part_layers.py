"""PartLayers: what is drawn of one specimen, as layers: model, legend, arrows, status line, and the labels it wants."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from datetime import datetime
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.cad import Model
from arview.camera import Camera
from arview.core.messages import sentence
from arview.geometry import Array, apply
from arview.inspection import ComponentDeviation, Inspection, Verdict
from arview.overlay import labels, paint
from arview.overlay.annotations import LabelledComponent, WantedLabels
from arview.overlay.displaced import DisplacedGhosts
from arview.overlay.edges import Edges
from arview.overlay.evidence import ComponentStyles, DrawnEvidence, component_styles, evidence_of, presence_of
from arview.overlay.ghost import CELL_PX, NEAR_MM, Ghost, GhostView, blend, count_cells
from arview.overlay.guide import GuideOutline
from arview.overlay.legend import banner_sprite, legend_entries, legend_sprite, withheld_title
from arview.overlay.mesh import anchor_in_model, topology
from arview.overlay.occluders import HiddenComponents, OccluderFinder
from arview.overlay.options import OverlayOptions
from arview.overlay.status import StatusLine
from arview.pose import ComponentPresence, Pose, TrackingState

SHOW_ARROWS = True
"""Draw displacements as arrows."""

_SAME_PLACE = 0.02
"""Distance in diameters within which a component is at one place in all ambiguous poses."""
_CRITICAL_DIMMING = 0.55
"""Factor of the opacity of ghost and edges in the state `critical`."""
_PIECES = 16
"""Pieces per diameter of the part into which edges are cut for a distorting lens: exact to about 0.2 px."""
_HATCH = 7.0
"""Distance of the lines of a hatched ghost, in widths of an edge."""
_LEARNING_QUALITY = 0.5
"""Quality of a pose from which on the colours of the part are learned."""
_ARROW_RGB = (255, 255, 255)


_POINT_PX = 1000
"""Visible pixels that count for the point of a characteristic, which has no area."""


@dataclass(frozen=True)
class _PartLook:
    """What is drawn of the components, as long as the evidence on them stays the same.

    Attributes:
        key: evidence on each component, and the doubt about the inspection.
        evidence: the same by component.
        styles: their appearance.
        order: components that may get a label, the most urgent first.
        arrows: (A,2,3) mm, tail and tip in the model frame.
        texts: of the labels, by component and note; those of displaced components change from frame to frame.
    """

    key: tuple[tuple[DrawnEvidence, ...], str]
    evidence: tuple[DrawnEvidence, ...]
    styles: ComponentStyles
    order: tuple[int, ...]
    arrows: Array
    texts: dict[tuple[int, str], labels.LabelText]


class _PartInPicture(NamedTuple):
    """What was drawn of the part in this picture: its view, the presence of its components, and their appearance."""

    view: GhostView
    presences: list[ComponentPresence | None]
    scene: _PartLook


class PartLayers:
    """Draws ghosts, edges, arrows, legend and status line for one model, camera and inspection.

    Args:
        model, camera, inspection, options: what is drawn, and how.
        size_px: size of the text.
        serial: serial number of the part in view, where it is known.
        pending: names of the components that are being measured: without a value, their labels say so.

    Raises:
        MismatchError: the inspection belongs to another model.
    """

    def __init__(
        self,
        model: Model,
        camera: Camera,
        inspection: Inspection | None,
        options: OverlayOptions,
        size_px: int,
        serial: str | None = None,
        pending: Collection[str] = (),
    ) -> None:
        if inspection is not None:
            inspection.check_model(model)
        self.model, self.camera, self.inspection = model, camera, inspection
        self.options, self._size_px, self._serial = options, size_px, serial
        shapes = [topology(component) for component in model.components]
        self._ghost = Ghost(model, camera, shapes)
        pieces_mm = model.diameter_mm / _PIECES if camera.is_distorted else None
        self._edges = Edges(shapes, pieces_mm)
        self._displaced = DisplacedGhosts(model, camera, shapes, pieces_mm)
        self._anchors_in_model = np.stack(
            [anchor_in_model(component, shape) for component, shape in zip(model.components, shapes, strict=True)]
        )
        self._centers_in_model = np.stack([one.bounds_in_model.mean(axis=0) for one in model.components])
        self._line_px = max(1.0, 0.7 + camera.height / 800)
        self._hatch_px = max(6, round(_HATCH * self._line_px))
        self._guide = GuideOutline(self._ghost, self._edges, self._line_px)
        self._arrow_scale = labels.arrow_scale(inspection, model.diameter_mm, self.options) if inspection else 1.0
        self._names = tuple(component.name for component in model.components)
        self._deviations = [inspection.find(name) if inspection else None for name in self._names]
        found = zip(self._names, self._deviations, strict=True)
        self._characteristics = labels.characteristic_labels(inspection)
        self._pending = frozenset(name for name, one in found if one is None and name in pending)
        self._status = self._make_status()
        self._bottom_px = camera.height
        self._occluders = OccluderFinder(model, camera) if self.options.show_occlusion else None
        self._hidden = HiddenComponents(len(self._names))
        self._scene: _PartLook | None = None
        self._drawn: _PartInPicture | None = None

    @property
    def status_height_px(self) -> int:
        """Height of the status line; 0 without one."""
        return self._status.height_px if self.options.show_status else 0

    def stack(self, status_bottom_px: int, bottom_px: int) -> None:
        """Leave room for the status lines of all parts.

        Args:
            status_bottom_px: row at which the own status line ends.
            bottom_px: row above which everything else must stay.
        """
        self._status.bottom_px = status_bottom_px
        self._bottom_px = bottom_px

    def usual_texts(self) -> list[labels.LabelText]:
        """Texts of the labels that are to be expected, by which the width of the labels is chosen."""
        if not self.options.show_labels:
            return []
        measured = [one for one in self._deviations if one is not None]
        texts = [labels.label_text(one.name, one, None, self.options) for one in measured]
        pending = sorted(self._pending)
        return texts + [labels.label_text(name, None, None, self.options, is_pending=True) for name in pending]

    def draw_model(
        self, canvas: paint.Image, pose: Pose, now: datetime | None = None, frame: paint.Image | None = None
    ) -> None:
        """Draw ghosts and edges on a picture in place; the other layers follow.

        Args:
            canvas: (H,W,3) uint8 RGB.
            pose: of this frame.
            now: time from which the age of the inspection is computed; None: the current time.
            frame: the picture without anything drawn on it; None: the canvas is.
        """
        shows, count = self.options.show_evidence, len(self._names)
        presences = [presence_of(pose, name, count) if shows else None for name in self._names]
        if pose.steps is not None:
            self._ghost.leave_out(np.array([evidence_of(one) is DrawnEvidence.LATER for one in presences]))
        view = self._ghost.view(pose.cam_from_model) if pose.cam_from_model is not None else None
        self._drawn = None
        if view is not None:
            scene = self._scene_of(pose, presences, now)
            self._drawn = _PartInPicture(view, presences, scene)
            occluder = self._find_occluder(canvas if frame is None else frame, view, pose, scene)
            self._hidden.update(view, occluder, presences)
            self._blend(canvas, view, pose, scene, presences, occluder)

    def wanted_labels(self, pose: Pose) -> WantedLabels | None:
        """Labels of the part that `draw_model` has drawn; None where it has none."""
        if self._drawn is None or not self._drawn.scene.order:
            return None
        view, presences, scene = self._drawn
        components, cells = self._labelled(view, pose, scene, presences)
        return WantedLabels(components, (float(view.u0), float(view.u0 + view.face_ids.shape[1])), cells)

    def draw_legend(self, canvas: paint.Image) -> int:
        """Draw the legend above the status line if it is needed; returns the row above which labels must stay."""
        entries = legend_entries(self._drawn.scene.evidence) if self._drawn and self.options.show_legend else ()
        if not entries:
            return self._bottom_px
        margin = round(0.4 * self._size_px)
        sprite = legend_sprite(entries, self._size_px, self.camera.width - 2 * margin)
        top = self._bottom_px - margin - sprite.height
        paint.put_sprite(canvas, sprite, margin, top)
        return top

    def draw_arrows(self, canvas: paint.Image, pose: Pose) -> None:
        """Draw the arrows of measured displacements, and those to where displaced components are seen."""
        if self._drawn is None or pose.cam_from_model is None:
            return
        _, presences, scene = self._drawn
        for tail_px, tip_px in self._projected(pose.cam_from_model, scene.arrows):
            paint.arrow(canvas, tail_px, tip_px, _ARROW_RGB, 0.24 * self._size_px)
        links = [
            np.stack([center, apply(presence.model_from_nominal, center[None])[0]])
            for center, presence, seen in zip(self._centers_in_model, presences, scene.evidence, strict=True)
            if seen is DrawnEvidence.DISPLACED and presence is not None and presence.model_from_nominal is not None
        ]
        if links:
            for tail_px, tip_px in self._projected(pose.cam_from_model, np.stack(links)):
                paint.arrow(canvas, tail_px, tip_px, self._displaced.color, 0.3 * self._size_px)

    def draw_state(
        self, canvas: paint.Image, pose: Pose, fps: float | None = None, now: datetime | None = None
    ) -> None:
        """Draw the status line, why labels are withheld or what is wrong, and the outline of the guide pose."""
        if pose.cam_from_model is None and pose.guide_cam_from_model is not None:
            self._guide.draw(canvas, pose.guide_cam_from_model)
        if pose.is_label_withheld and self.options.show_evidence:
            self._draw_banner(canvas, withheld_title(pose), pose.identity_reason)
        elif pose.steps is not None and pose.steps.faults:
            self._draw_banner(canvas, pose.steps.faults[0], "; ".join(pose.steps.faults[1:]))
        if self.options.show_status:
            self._status.draw(canvas, pose, fps, now)

    def _make_status(self) -> StatusLine:
        arrows = self._arrows_in_model([DrawnEvidence.SEEN] * len(self._names))
        return StatusLine(
            self.camera.width,
            self.camera.height,
            round(0.95 * self._size_px),
            self.inspection,
            self._arrow_scale if SHOW_ARROWS and len(arrows) else None,
            len(self._names) > 1 and self.options.show_evidence,
            bool(self._pending),
        )

    def _scene_of(self, pose: Pose, presences: list[ComponentPresence | None], now: datetime | None) -> _PartLook:
        """What is drawn of the components; computed again when the evidence changes."""
        is_withheld = pose.is_label_withheld and self.options.show_evidence
        evidence = tuple(evidence_of(presence, is_withheld) for presence in presences)
        doubt = labels.inspection_doubt(self.inspection, self._serial, self.options, now) if self.inspection else ""
        key = evidence, doubt
        if self._scene is None or self._scene.key != key:
            styles = component_styles(self.model, self.inspection, self.options, evidence, bool(doubt))
            by_name = dict(zip(self._names, evidence, strict=True))
            index = {name: number for number, name in enumerate(self._names)}
            wanted = labels.text_urgency(self._names, self.inspection, by_name, self._pending)
            order = tuple(index[name] for name in wanted) if self.options.show_labels and not is_withheld else ()
            arrows = self._arrows_in_model(list(evidence)) if SHOW_ARROWS else np.zeros((0, 2, 3))
            self._scene = _PartLook(key, evidence, styles, order, arrows, {})
        return self._scene

    def _blend(
        self,
        canvas: paint.Image,
        view: GhostView,
        pose: Pose,
        scene: _PartLook,
        presences: list[ComponentPresence | None],
        occluder: NDArray[np.bool_] | None,
    ) -> None:
        assert pose.cam_from_model is not None
        options, styles = self.options, scene.styles
        if options.show_edges == "none":
            cover = np.zeros(view.face_ids.shape, dtype=np.uint8)
            owner = np.zeros(view.face_ids.shape, dtype=np.int16)
        else:
            cover, owner = self._edges.draw(
                self._ghost, view, pose.cam_from_model, self._line_px, options.show_edges == "all", styles.dashed
            )
        face_ids = view.face_ids
        if occluder is not None:
            face_ids = np.where(occluder, np.int32(-1), face_ids)
            cover[occluder] = 0
        is_critical = pose.state is TrackingState.CRITICAL
        dimming = np.ones((len(scene.evidence), 4), dtype=np.float32)
        if is_critical:
            # What was seen to be missing or displaced is shown in full, because it may be why the pose is critical.
            dimming[[not (seen.is_refuted or seen.is_awaited) for seen in scene.evidence], 3] = _CRITICAL_DIMMING
        blend(
            canvas,
            view.u0,
            view.v0,
            face_ids=face_ids,
            shade=view.shade,
            components=view.components,
            ghost_style=styles.ghost * dimming,
            edge_cover=cover,
            edge_owner=owner,
            edge_style=styles.edges * dimming,
            patterns=styles.patterns,
            hatch_px=self._hatch_px,
        )
        for index, seen in enumerate(scene.evidence):
            presence = presences[index]
            if seen is DrawnEvidence.DISPLACED and presence is not None and presence.model_from_nominal is not None:
                moved = pose.cam_from_model @ presence.model_from_nominal
                opacity = options.opacity if options.show_ghost else 0.0
                line_px = 0.0 if options.show_edges == "none" else self._line_px
                self._displaced.draw(canvas, view, index, moved, opacity, line_px)

    def _labelled(
        self, view: GhostView, pose: Pose, scene: _PartLook, presences: list[ComponentPresence | None]
    ) -> tuple[list[LabelledComponent], NDArray[np.float32]]:
        """Components that may get a label, and the weighted covered area of each cell of the picture."""
        assert pose.cam_from_model is not None
        camera = self.camera
        cells = np.zeros((-(-camera.height // CELL_PX), -(-camera.width // CELL_PX)), dtype=np.float32)
        seen_px = np.zeros(len(self._names), dtype=np.int64)
        count_cells(view.u0, view.v0, view.face_ids, view.components, scene.styles.weight, cells, seen_px)
        anchors_in_cam = apply(pose.cam_from_model, self._anchors_in_model)
        anchors_px = self._ghost.project(anchors_in_cam)
        notes = self._open_notes(pose)
        result = []
        is_withheld = pose.is_label_withheld and self.options.show_evidence
        for label, point in [] if is_withheld else self._characteristics:
            at = apply(pose.cam_from_model, point)
            result.append(LabelledComponent(label, self._ghost.project(at[None])[0], at, _POINT_PX))
        for index in scene.order:
            note = notes.get(index) or (labels.OCCLUDED if self._hidden.flags[index] else "")
            text = self._text(index, presences[index], scene, note)
            result.append(LabelledComponent(text, anchors_px[index], anchors_in_cam[index], int(seen_px[index])))
        return result, cells

    def _text(self, index: int, presence: ComponentPresence | None, scene: _PartLook, note: str) -> labels.LabelText:
        """Texts of a component's label."""
        text = scene.texts.get((index, note))
        if text is None or scene.evidence[index] is DrawnEvidence.DISPLACED:
            text = labels.label_text(
                self._names[index],
                self._deviations[index],
                presence,
                self.options,
                center_in_model=self._centers_in_model[index],
                doubt=scene.key[1],
                note=note,
                is_pending=self._names[index] in self._pending,
            )
            scene.texts[index, note] = text
        return text

    def _find_occluder(
        self, canvas: paint.Image, view: GhostView, pose: Pose, scene: _PartLook
    ) -> NDArray[np.bool_] | None:
        """Pixels (h,w) of the view that something before the part covers; None if there is nothing."""
        if self._occluders is None or pose.cam_from_model is None:
            return None
        learns = pose.state is TrackingState.TRACKED and pose.quality >= _LEARNING_QUALITY
        absent = np.array([seen.is_refuted or seen.is_awaited for seen in scene.evidence])
        return self._occluders.find(canvas, view, pose.cam_from_model, learns, absent)

    def _open_notes(self, pose: Pose) -> dict[int, str]:
        """Notes on the components, by index, whose place depends on which of the ambiguous poses is right."""
        if pose.cam_from_model is None or not pose.alternatives:
            return {}
        anchors = apply(pose.cam_from_model, self._anchors_in_model)
        moved = [apply(other, self._anchors_in_model) - anchors for other in pose.alternatives]
        apart = np.max(np.linalg.norm(moved, axis=2), axis=0) > _SAME_PLACE * self.model.diameter_mm
        count = len(pose.alternatives) + 1
        note = sentence("label.one_of_two") if count == 2 else sentence("label.one_of", count=count)
        return {int(index): note for index in np.flatnonzero(apart)}

    def _draw_banner(self, canvas: paint.Image, title: str, text: str) -> None:
        margin = round(0.6 * self._size_px)
        width_px = self.camera.width - 2 * margin
        sprite = banner_sprite(title, text, self._size_px, width_px)
        paint.put_sprite(canvas, sprite, (self.camera.width - sprite.width) // 2, margin)

    def _arrows_in_model(self, evidence: list[DrawnEvidence]) -> Array:
        """Tail and exaggerated tip (A,2,3) of the arrows in the model frame, mm, the most urgent last.

        Components have none that were seen to be elsewhere, are not verified, or whose measurement is withheld.
        """
        arrows = []
        seen = dict(zip(self._names, evidence, strict=True))
        urgent: list[ComponentDeviation] = labels.by_urgency(self.inspection) if self.inspection else []
        for deviation in reversed(urgent):
            displacement = labels.arrow_in_model(deviation)
            is_shown = seen.get(deviation.name) is DrawnEvidence.SEEN and deviation.verdict is not Verdict.PASS
            if displacement is not None and is_shown:
                tail = self.model.component(deviation.name).bounds_in_model.mean(axis=0)
                arrows.append(np.stack([tail, tail + self._arrow_scale * np.array(displacement)]))
        return np.stack(arrows) if arrows else np.zeros((0, 2, 3))

    def _projected(self, cam_from_model: Array, ends_in_model: Array) -> list[Array]:
        """Ends (2,2) px of those arrows (A,2,3) that lie in front of the camera and near the picture."""
        if not len(ends_in_model):
            return []
        ends_in_cam = apply(cam_from_model, ends_in_model)
        ends_px = self._ghost.project(ends_in_cam)
        limit_px = 2 * max(self.camera.width, self.camera.height)
        return [
            ends
            for in_cam, ends in zip(ends_in_cam, ends_px, strict=True)
            if in_cam[:, 2].min() > NEAR_MM and np.abs(ends).max() < limit_px
        ]
