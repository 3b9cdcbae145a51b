"""Ghosts of displaced components at the places where they are seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from arview.cad import Model, make_model
from arview.camera import Camera
from arview.geometry import Array
from arview.overlay.edges import Edges
from arview.overlay.evidence import DISPLACED_RGB, PLAIN
from arview.overlay.ghost import Ghost, GhostView, blend
from arview.overlay.mesh import Topology
from arview.overlay.options import Rgb
from arview.overlay.paint import Image

_DEPTH_SLACK = 2e-3
"""Relative difference of depths up to which a surface does not hide another."""


class DisplacedGhosts:
    """Draws single components away from their nominal places; each is prepared when it is first drawn.

    Attributes:
        color: of ghosts and edges.
    """

    color: Rgb = DISPLACED_RGB

    def __init__(self, model: Model, camera: Camera, shapes: list[Topology], pieces_mm: float | None) -> None:
        self._model, self._camera, self._shapes, self._pieces_mm = model, camera, shapes, pieces_mm
        self._parts: dict[int, tuple[Ghost, Edges]] = {}

    def draw(
        self, image: Image, view: GhostView, index: int, cam_from_nominal: Array, opacity: float, line_px: float
    ) -> None:
        """Blend a component over the image in place, as far as the other components do not hide it.

        Args:
            image: (H,W,3) uint8 RGB.
            view: the whole model at its pose.
            index: of the component.
            cam_from_nominal: (4,4) mm, from the component's nominal place in the model frame.
            opacity: of the ghost, 0–1.
            line_px: width of the edges; 0: none.
        """
        if index not in self._parts:
            component, shape = self._model.components[index], self._shapes[index]
            alone = make_model(component.name, (component,))
            self._parts[index] = Ghost(alone, self._camera, [shape]), Edges([shape], self._pieces_mm)
        ghost, edges = self._parts[index]
        moved = ghost.view(cam_from_nominal)
        if moved is None:
            return
        cover = np.zeros(moved.face_ids.shape, dtype=np.uint8)
        owner = np.zeros(moved.face_ids.shape, dtype=np.int16)
        if line_px > 0:
            cover, owner = edges.draw(ghost, moved, cam_from_nominal, line_px, False)
        self._hide(view, index, moved, cover)
        style = np.array([[*self.color, opacity]], dtype=np.float32)
        line = np.array([[*(0.75 * np.array(self.color) + 0.25 * 255), 1.0]], dtype=np.float32)
        patterns = np.array([PLAIN], dtype=np.int8)
        blend(
            image,
            moved.u0,
            moved.v0,
            face_ids=moved.face_ids,
            shade=moved.shade,
            components=moved.components,
            ghost_style=style,
            edge_cover=cover,
            edge_owner=owner,
            edge_style=line,
            patterns=patterns,
            hatch_px=1,
        )

    def _hide(self, view: GhostView, index: int, moved: GhostView, cover: NDArray[np.uint8]) -> None:
        """Remove, in place, what other components hide; a component does not hide itself at its nominal place."""
        v0, u0 = max(view.v0, moved.v0), max(view.u0, moved.u0)
        v1 = min(view.v0 + view.face_ids.shape[0], moved.v0 + moved.face_ids.shape[0])
        u1 = min(view.u0 + view.face_ids.shape[1], moved.u0 + moved.face_ids.shape[1])
        if v1 <= v0 or u1 <= u0:
            return
        theirs = np.s_[v0 - view.v0 : v1 - view.v0, u0 - view.u0 : u1 - view.u0]
        ours = np.s_[v0 - moved.v0 : v1 - moved.v0, u0 - moved.u0 : u1 - moved.u0]
        faces = view.face_ids[theirs]
        is_other = (faces >= 0) & (view.components[np.maximum(faces, 0)] != index)
        nearer = view.inverse_depth[theirs] > moved.inverse_depth[ours] * (1.0 + _DEPTH_SLACK)
        hidden = is_other & nearer & (moved.inverse_depth[ours] > 0)
        moved.face_ids[ours][hidden] = -1
        cover[ours][hidden] = 0
