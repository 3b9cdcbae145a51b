"""CaptureNeeds: what the photos taken show of each component, which are lacking, and from where to take the next."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from arview import reconstruction
from arview.cad import Part
from arview.camera import Camera
from arview.core.messages import sentence
from arview.geometry import Array, apply, direction_from
from arview.station.capture import words
from arview.station.capture.advice import ComponentNeed
from arview.station.capture.dome import CaptureDome, component_points
from arview.station.capture.information import (
    KnownViews,
    Views,
    choose_views,
    expanded_uncertainty,
    focal_px,
    gains,
)
from arview.station.capture.options import MAX_STEP_DEG, CaptureOptions

APART_SHARE = 0.6
"""Share of the distance of two directions by which two photos differ at least."""
U_SHARE = 0.25
"""Share of the tolerance; a predicted U below it is enough."""
REACH_SHARE = 2.0
"""Multiple of the U that photos from all directions would give; a predicted U below it is enough, too."""


class CaptureNeeds:
    """The photos of one job, as information on the places of the components.

    Attributes:
        photos: number of them.
        filled: cells of the dome from which one was taken.
        plan: cells from which photos are still wanted, the next one first.
        best_gain: by how much the best next photo lowers the sum of expected errors relative to the tolerances.
        apart_deg: angle by which two photos differ at least.
        revision: grows with each change.
    """

    def __init__(self, part: Part, camera: Camera, dome: CaptureDome, options: CaptureOptions) -> None:
        self._model, self._camera, self._dome, self._options = part.model, camera, dome, options
        self._points = component_points(part)
        self._center = part.model.center_in_model
        self._is_asked = asked_components(part, options.components)
        self._weights = component_weights(part) * self._is_asked
        self._known: KnownViews = KnownViews(dome.views[:0])
        self._reach_mm: Array = expanded_uncertainty(KnownViews(dome.views).information())
        self._directions: list[Array] = []
        self._tolerances = [part.component_settings(one.name).position_tolerance_mm for one in part.model.components]
        self.apart_deg = APART_SHARE * dome.cell_deg
        self.filled: set[int] = set()
        self.plan: list[int] = []
        self.best_gain = 0.0
        self.revision = 0
        self._rows: dict[int | None, tuple[ComponentNeed, ...]] = {}
        self._state: tuple[Array, NDArray[np.bool_], NDArray[np.bool_]] = self._assess()
        self._replan()

    @property
    def photos(self) -> int:
        """Number of photos taken."""
        return len(self._directions)

    @property
    def is_enough(self) -> bool:
        """Whether nothing more is asked for."""
        return not self.plan

    @property
    def progress(self) -> float:
        """Share of the photos that are taken, 0–1."""
        return self.photos / max(1, self.photos + len(self.plan))

    @property
    def predicted_u_mm(self) -> Array:
        """(C,) expanded uncertainty to be expected of each component's place."""
        return self._state[0]

    def add(self, cam_from_model: Array) -> None:
        """Count a photo at a pose (4,4)."""
        seen = np.array(reconstruction.components_seen(self._model, self._camera, cam_from_model))
        eye = -cam_from_model[:3, :3].T @ cam_from_model[:3, 3]
        direction = direction_from(cam_from_model, self._center)
        self._known.add(self._view(seen, eye))
        self._directions.append(direction)
        cell = self._dome.nearest(direction)
        if self._dome.directions[cell] @ direction >= np.cos(np.deg2rad(0.75 * self._dome.cell_deg)):
            self.filled.add(cell)
        self.revision += 1
        self._rows.clear()
        self._state = self._assess()
        self._replan()

    def nearest_deg(self, direction: Array) -> float:
        """Angle from a direction (3,) to the nearest photo; 180 without any."""
        if not self._directions:
            return 180.0
        return float(np.rad2deg(np.arccos(np.clip(np.max(np.array(self._directions) @ direction), -1.0, 1.0))))

    def gain_of(self, cam_from_model: Array, cell: int) -> float:
        """By how much a photo at a pose (4,4) would lower that sum; it sees what the nearest cell sees."""
        eye = -cam_from_model[:3, :3].T @ cam_from_model[:3, 3]
        pixels = self._camera.project(apply(cam_from_model, self._points))
        size = np.array([self._camera.width, self._camera.height])
        inside = np.all((pixels > 0) & (pixels < size - 1), axis=1)
        view = self._view(self._dome.is_seen[cell] & inside, eye)
        return float(gains(self._known, view, self._weights)[0])

    def hidden_from(self, cell: int) -> list[str]:
        """Names of the components that lack photos and are not seen from a cell, the neediest first."""
        u_mm, is_enough, can_be_seen = self._state
        hidden = self._is_asked & ~is_enough & can_be_seen & ~self._dome.is_seen[cell]
        order = np.argsort(-u_mm * self._weights, kind="stable")
        return [self._model.components[index].name for index in order if hidden[index]]

    def components(self, cell: int | None) -> tuple[ComponentNeed, ...]:
        """What each component lacks, with a text for a camera at a cell, or None where it is unknown."""
        if cell not in self._rows:
            self._rows[cell] = tuple(self._row(index, cell) for index in range(len(self._model.components)))
        return self._rows[cell]

    # --- the parts -------------------------------------------------------------------------------------------

    def _view(self, seen: NDArray[np.bool_], eye: Array) -> Views:
        """The view of a camera at a place (3,) that shows some components (C,)."""
        focal = focal_px(self._camera) * self._options.photo_px_per_px
        return Views.of(self._points, seen[None], eye[None], focal)

    def _row(self, index: int, cell: int | None) -> ComponentNeed:
        u_mm, is_enough, can_be_seen = self._state
        photos, directions = self._counts(index, self._known.views)
        lacking = ""
        if self._is_asked[index] and not can_be_seen[index]:
            lacking = sentence("capture.never_seen")
        elif self._is_asked[index] and not is_enough[index]:
            is_hidden = cell is not None and not self._dome.is_seen[cell, index]
            lacking = words.lacking_message(reconstruction.PHOTOS_WANTED - photos, is_hidden)
        predicted = float(u_mm[index]) if photos >= 2 else None
        return ComponentNeed(
            self._model.components[index].name, photos, directions, predicted, bool(is_enough[index]), lacking
        )

    def _counts(self, index: int, views: Views) -> tuple[int, int]:
        """Photos that show a component, and the directions of these that differ."""
        rays = views.rays[views.is_seen[:, index], index]
        return len(rays), reconstruction.count_separated(rays, reconstruction.DIRECTION_DEG)

    def _assess(self, known: KnownViews | None = None) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
        """For some photos, by default those taken: (C,) U, which components have enough, and which can be seen."""
        known = known or self._known
        u_mm = expanded_uncertainty(known.information())
        cells = self._dome.is_seen.sum(axis=0)
        is_enough = np.zeros(len(u_mm), dtype=bool)
        can_be_seen = cells > 0
        for index, tolerance in enumerate(self._tolerances):
            photos, directions = self._counts(index, known.views)
            can_be_seen[index] |= photos > 0
            if not can_be_seen[index]:
                continue
            goal_mm = max(REACH_SHARE * float(self._reach_mm[index]), U_SHARE * (tolerance or 0.0))
            wanted = min(reconstruction.PHOTOS_WANTED, photos + int(cells[index]))
            is_enough[index] = (
                photos >= wanted
                and directions >= min(reconstruction.DIRECTIONS_WANTED, wanted)
                and u_mm[index] <= goal_mm
            )
        return u_mm, is_enough, can_be_seen

    def _suffices(self, count: int, state: tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]) -> bool:
        """Whether some photos are enough: the wanted number, and every component that can be seen is seen well."""
        o = self._options
        _, is_enough, can_be_seen = state
        is_complete = bool(np.all(is_enough | ~can_be_seen | ~self._is_asked))
        return count >= o.max_photos or (is_complete and count >= o.wanted_photos)

    def _replan(self) -> None:
        """Plan the photos that are still wanted."""
        o = self._options
        self.plan, self.best_gain = [], 0.0
        if self._suffices(self.photos, self._state):
            return
        is_open = np.ones(len(self._dome.directions), dtype=bool)
        is_open[sorted(self.filled)] = False
        cells = np.flatnonzero(is_open)
        if len(cells) == 0:
            return
        views, directions = self._dome.views[cells], self._dome.directions[cells]
        order = choose_views(
            self._known.views,
            views,
            self._weights,
            directions,
            self._directions,
            min(len(cells), o.max_photos - self.photos),
            MAX_STEP_DEG,
        )
        self.best_gain = float(gains(self._known, views, self._weights).max())
        self.plan = self._until_enough([int(cells[index]) for index in order])

    def _until_enough(self, order: list[int]) -> list[int]:
        """The first cells of an order that suffice."""
        known = KnownViews(self._known.views)
        for index, cell in enumerate(order):
            known.add(self._dome.views[cell : cell + 1])
            is_near_end = len(known.views) >= self._options.wanted_photos
            if is_near_end and self._suffices(len(known.views), self._assess(known)):
                return order[: index + 1]
        return order


def asked_components(part: Part, names: Sequence[str]) -> NDArray[np.bool_]:
    """(C,) which components of the model must be seen well: those of the names, or all for none.

    Raises:
        InputError: the model has no component of a name.
    """
    for name in names:
        part.model.component(name)
    return np.array([not names or component.name in names for component in part.model.components])


def component_weights(part: Part) -> Array:
    """(C,) weight of each component's U, 1/mm: one over its tolerance, or over the median one."""
    tolerances = [part.component_settings(one.name).position_tolerance_mm for one in part.model.components]
    known = [value for value in tolerances if value]
    usual = float(np.median(known)) if known else 1.0
    return np.array([1.0 / (value or usual) for value in tolerances])
