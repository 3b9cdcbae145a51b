"""Search for another specimen of the part in a picture, beside the one that is known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from arview.detection import Detection
from arview.geometry import Array, exp_so3, rigid
from arview.tracking.identity.part_outline import PartOutline, PartPlace
from arview.tracking.search.guided_init import GuidedPose
from arview.tracking.several.specimens import hide_specimens

FOUND_QUALITY = 0.7
"""Quality of a pose found near a given one from which a specimen is there."""
TURN_DEG = 25.0
"""Angle by which a given pose is turned, where the camera may have gone round the part."""
SAME_DEPTH = 0.6
SAME_DEPTH_SHARE = 0.12
"""Shift along the line of sight up to which a specimen is the same, in diameters, and as a share of the distance; the
larger limit counts."""
APART = 0.5
"""Shift in diameters from which a second detection is another specimen."""
MAX_SPECIMENS = 3
"""Specimens looked for in one picture."""
PIXEL_TURNS_DEG: tuple[float, ...] = (0.0, 25.0, -25.0, 50.0, -50.0)
PIXEL_DISTANCES: tuple[float, ...] = (1.0, 0.8, 1.25, 0.64, 1.56)
"""Rotations about the vertical axis of the picture, and distances relative to that of the tracked part, that are tried
first for a part at a named pixel."""
PIXEL_MARGIN = 0.03
"""Distance from the outline, in diameters, at which a named pixel still lies on a part."""


class FindsNear(Protocol):
    """Finds the part near a pose."""

    def __call__(self, image: NDArray[np.uint8], cam_from_model: Array, /) -> GuidedPose | None:
        """The best pose near a given one, whatever its quality; None outside the picture."""
        ...


class FindsAnywhere(Protocol):
    """Finds the part in a whole picture."""

    def __call__(self, image: NDArray[np.uint8], max_results: int, is_thorough: bool, /) -> Sequence[Detection]:
        """Poses of the part in an image, best first."""
        ...


class SpecimenSearch:
    """Finds other specimens.

    Args:
        outline: of the part.
        find_near: the search around a pose.
        find_anywhere: the search of a whole picture.
    """

    def __init__(self, outline: PartOutline, find_near: FindsNear, find_anywhere: FindsAnywhere) -> None:
        self._outline = outline
        self._find_near, self._find_anywhere = find_near, find_anywhere

    def others(self, image: NDArray[np.uint8], known: Array, is_thorough: bool = False) -> list[Array]:
        """Poses (4,4) of the part in an image (H,W,3) uint8 RGB, apart from a known one (4,4)."""
        place = self._outline.place(known)
        picture = hide_specimens(image, [known], self._outline.views, self._outline.camera)
        found = self._find_anywhere(picture, MAX_SPECIMENS, is_thorough)
        return [one.cam_from_model for one in found if self.is_apart(self._outline.place(one.cam_from_model), place)]

    def at_place(self, image: NDArray[np.uint8], guess: Array, is_turned: bool = False) -> Array | None:
        """The pose (4,4) of a part at the place of a rough pose (4,4); None without one there.

        Args:
            image: (H,W,3) uint8 RGB.
            guess: rough pose.
            is_turned: whether the part may be turned far, as after a camera has gone round it.
        """
        wanted = self._outline.place(guess)
        for start in self._turned(guess) if is_turned else [guess]:
            found = self._find_near(image, start)
            is_there = found is not None and found.quality >= FOUND_QUALITY
            if found and is_there and self._is_near(self._outline.place(found.cam_from_model), wanted):
                return found.cam_from_model
        return None

    def at_pixel(self, image: NDArray[np.uint8], known: Array, pixel: Array) -> Array | None:
        """The pose (4,4) of the part at a pixel (2,) that lies on it, beside a known one (4,4); None without one there.

        Parts on one bench are seen from about the same side, so those of the known pose are tried before all others.
        """
        shift = np.eye(3)
        shift[:2, 2] = pixel - self._outline.place(known).center_px
        start = self._outline.moved(known, shift)
        guesses = []
        for turn_deg in PIXEL_TURNS_DEG:
            turned = self._turned_by(start, exp_so3([0.0, np.deg2rad(turn_deg), 0.0]))
            guesses += [self._farther(turned, factor) for factor in PIXEL_DISTANCES]
        for guess in guesses:
            found = self._find_near(image, guess)
            is_good = found is not None and found.quality >= FOUND_QUALITY
            if found and is_good and self._outline.contains(found.cam_from_model, pixel, PIXEL_MARGIN):
                return found.cam_from_model
        for other in self.others(image, known, is_thorough=True):
            if self._outline.contains(other, pixel, PIXEL_MARGIN):
                return other
        return None

    def is_apart(self, a: PartPlace, b: PartPlace) -> bool:
        """Whether two places in a picture are those of different specimens.

        Of two poses before each other one is wrong, because a specimen would hide the other.
        """
        aside_px = float(np.linalg.norm(a.center_px - b.center_px))
        return aside_px > APART * max(a.diameter_px, b.diameter_px)

    def _is_near(self, a: PartPlace, b: PartPlace) -> bool:
        """Whether a place is about another one, also along the line of sight."""
        far_mm = 2.0 * max(SAME_DEPTH * self._outline.views.diameter_mm, SAME_DEPTH_SHARE * b.distance_mm)
        return not self.is_apart(a, b) and abs(a.distance_mm - b.distance_mm) <= far_mm

    def _turned(self, cam_from_model: Array) -> list[Array]:
        """A pose (4,4), and poses with the part turned about its centre around the axes across the line of sight."""
        turns = [np.eye(3)]
        angle_rad = np.deg2rad(TURN_DEG)
        for x, y in ((0.0, 1.0), (0.0, -1.0), (1.0, 0.0), (-1.0, 0.0)):
            turns.append(exp_so3(angle_rad * np.array([x, y, 0.0])))
        return [self._turned_by(cam_from_model, turn) for turn in turns]

    def _turned_by(self, cam_from_model: Array, turn: Array) -> Array:
        """A pose (4,4) with the part turned about its centre by a rotation (3,3) of the camera frame."""
        rotation = turn @ cam_from_model[:3, :3]
        center = self._outline.center_in_cam(cam_from_model)
        return rigid(rotation, center - rotation @ self._outline.views.center_in_model)

    def _farther(self, cam_from_model: Array, factor: float) -> Array:
        """A pose (4,4) whose centre is farther away by a factor."""
        center = self._outline.center_in_cam(cam_from_model)
        return rigid(cam_from_model[:3, :3], cam_from_model[:3, 3] + (factor - 1.0) * center)
