"""PresenceReport: presence and visibility of each component in words, by what is known of all of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from arview.assembly.monitor_state import VERIFIED_LOG_ODDS, MonitorState
from arview.assembly.observation import ComponentObserver
from arview.assembly.turned_poses import TurnedPoses
from arview.cad import Model
from arview.camera import Camera
from arview.geometry import Array, are_near, rigid
from arview.pose import ComponentPresence, Presence, Visibility

VISIBILITIES = (Visibility.VISIBLE, Visibility.HIDDEN, Visibility.OUTSIDE)
"""In the order in which arrays number them."""
DISPLACED_LOG_ODDS = 2.4
"""A mismatched component is displaced if its alternative placement has more."""
INSIDE_SHARE = 0.5
"""Share of the corners of a component's box that must be in the picture."""
VISIBILITY_EVERY = 4
"""Frames from one look at which components are visible to the next, unless they were observed meanwhile."""
JUMP, JUMP_DEG = 0.1, 5.0
"""Motion since then, in diameters of the part's box and in degrees, from which they are looked at at once."""


class PresenceReport:
    """Reports on the components of one part with one camera.

    Args:
        model: of the part.
        camera: of the pictures.
        observer: of the components.
        turned: poses in which the base looks the same.
    """

    def __init__(self, model: Model, camera: Camera, observer: ComponentObserver, turned: TurnedPoses) -> None:
        self._names = tuple(one.name for one in model.components)
        self._camera, self._observer, self._turned = camera, observer, turned
        boxes = np.array([one.bounds_in_model for one in model.components])
        # (8 C,3) corners of the boxes of the components, and (8,3) of the part's.
        self._corners = _box_corners(boxes).reshape(-1, 3)
        low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
        self._part_corners = _box_corners(np.array([[low, high]])).reshape(-1, 3)
        self._jump_mm = JUMP * float(np.linalg.norm(high - low))
        self.forget()

    def forget(self) -> None:
        """Another state follows: nothing that was reported holds any longer."""
        self._last: tuple[tuple[object, ...], Mapping[str, ComponentPresence]] | None = None
        self._visibility: tuple[int, Array, NDArray[np.int8]] | None = None
        self._frames = 0

    def presence(
        self,
        state: MonitorState,
        cam_from_model: Array,
        is_ambiguous: bool,
        may_be_missing: bool,
        awaited: tuple[Presence | None, ...] = (),
    ) -> Mapping[str, ComponentPresence]:
        """Presence of each component by its name; the same mapping as long as nothing changes.

        Args:
            state: what is known of the components.
            cam_from_model: (4,4) mm pose of the present frame, for the visibility.
            is_ambiguous: other poses fit as well, in which components other than the base would be elsewhere.
            may_be_missing: whether the pose is known well enough to call a component missing.
            awaited: presence of each component that is not mounted yet, None of the others; empty: all are mounted.
        """
        self._frames += 1
        last = self._visibility
        is_kept = last is not None and last[0] == state.observations and self._frames % VISIBILITY_EVERY != 0
        if last is None or not (is_kept and are_near(cam_from_model, last[1], self._jump_mm, JUMP_DEG)):
            last = self._visibility = state.observations, cam_from_model, self._visibilities(state, cam_from_model)
        visibilities = last[2]
        key = (state.observations, is_ambiguous, may_be_missing, visibilities.tobytes(), awaited)
        if self._last is None or self._last[0] != key:
            found = self._presence_now(state, visibilities, is_ambiguous, may_be_missing)
            expected = {name: one for name, one in zip(self._names, awaited, strict=False) if one is not None}
            found |= {name: replace(found[name], presence=one) for name, one in expected.items()}
            self._last = key, MappingProxyType(found)
        return self._last[1]

    def _presence_now(
        self, state: MonitorState, visibilities: NDArray[np.int8], is_ambiguous: bool, may_be_missing: bool
    ) -> dict[str, ComponentPresence]:
        """Presence of each component by its name, for visibilities (C,) as indices of `VISIBILITIES`."""
        presences, is_open = self._presences(state, is_ambiguous, may_be_missing)
        probabilities, spreads_deg = 1.0 / (1.0 + np.exp(state.log_odds)), state.directions.spreads_deg
        return {
            name: ComponentPresence(
                presence=presences[c],
                visibility=VISIBILITIES[visibilities[c]],
                probability=0.5 if is_open[c] else float(probabilities[c]),
                observations=int(state.directions.observations[c]),
                spread_deg=float(spreads_deg[c]),
                model_from_nominal=rigid(np.eye(3), state.shifts[c]) if presences[c] is Presence.DISPLACED else None,
            )
            for c, name in enumerate(self._names)
        }

    def _presences(
        self, state: MonitorState, is_ambiguous: bool, may_be_missing: bool
    ) -> tuple[list[Presence], NDArray[np.bool_]]:
        """Presence of each component, and (C,) those of which it depends on which of several poses is right."""
        is_displaced = state.is_missing & (state.alternative > DISPLACED_LOG_ODDS)
        is_uncertain = state.is_uncertain | state.is_mismatched
        found = np.select(
            [is_displaced, state.is_missing, state.is_verified, is_uncertain],
            [Presence.DISPLACED, Presence.MISSING, Presence.PRESENT, Presence.UNCERTAIN],
            Presence.UNVERIFIED,
        )
        is_open = np.full(len(found), is_ambiguous)
        # One that stays verified although the evidence for it has become weak does not vouch for another.
        firm = np.where(state.is_verified & (state.log_odds >= VERIFIED_LOG_ODDS), Presence.UNVERIFIED, found)
        for turn in self._turned.open_turns(state.is_verified):
            # In the turned pose each component is what was found at the place of its counterpart.
            turned = np.where(turn.counterparts >= 0, firm[turn.counterparts], Presence.UNVERIFIED)
            is_open |= (turned != found) & ((found == Presence.PRESENT) | state.is_missing)
        if not may_be_missing:
            is_open |= state.is_missing
        is_open[self._observer.base] = False
        unsure = Presence.UNCERTAIN if is_ambiguous or state.is_suspect.any() else Presence.UNVERIFIED
        found[is_open] = unsure
        return [Presence(one) for one in found], is_open

    def _visibilities(self, state: MonitorState, cam_from_model: Array) -> NDArray[np.int8]:
        """(C,) visibility of each component in a frame, as indices of `VISIBILITIES`."""
        is_hidden = ~self._observer.visible_from(cam_from_model, state.is_mismatched) | state.was_occluded
        found = is_hidden.astype(np.int8)
        # Mostly the whole part is inside the picture.
        if not self._is_inside(self._part_corners, cam_from_model).all():
            is_inside = self._is_inside(self._corners, cam_from_model).reshape(8, -1)
            found[is_inside.mean(axis=0) < INSIDE_SHARE] = VISIBILITIES.index(Visibility.OUTSIDE)
        return found

    def _is_inside(self, corners: Array, cam_from_model: Array) -> NDArray[np.bool_]:
        """(N,) which points (N,3) of the model are inside the picture at a pose."""
        camera = self._camera
        in_cam = corners @ cam_from_model[:3, :3].T + cam_from_model[:3, 3]
        if in_cam[:, 2].min() <= 1.0:
            in_cam[in_cam[:, 2] <= 1.0] = [1e6, 1e6, 1.0]
        pixels = camera.project(in_cam)
        return np.asarray(((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1))


def _box_corners(boxes: Array) -> Array:
    """(8,N,3) corners of boxes (N,2,3)."""
    return np.stack([np.stack([boxes[:, k >> a & 1, a] for a in range(3)], axis=1) for k in range(8)])
