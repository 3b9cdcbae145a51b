"""What the pixels tell of two poses that look alike but for a few of them.

A notch or a hole that tells twins apart is a handful of edge points, but some tens of pixels. Each pixel at which one
twin shows something else than the other is asked which of them explains its colour. What either says is there (the part
with such a normal, or what lies around it) is seen nearby, too, where both agree: a kernel density of these colours
(Parzen, "On estimation of a probability density function and mode", 1962), weighted by nearness and likeness of the
normals. Beside it stands a broad one, for what is in front of the part or has nothing alike nearby: a pixel that
neither explains says nothing. Own here.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from arview.geometry import Array, rigid
from arview.guideviews.surface import differing, draw_surface
from arview.tracking.picture import Picture, steps_to
from arview.tracking.solver import project
from arview.tracking.tracker import PartView

RADIUS_PX, REACH = 100.0, 1.25
"""Half the part's diameter in what is looked at, about, unless the picture has less; it reaches so much further."""
OTHER_NORMAL, OTHER_DEPTH = 0.3, 0.04
"""Parts of normals, and depths in half diameters, that differ by more show something else there."""
LEAST_PIXELS = 4
"""Of fewer that differ nothing is told."""
AROUND_PX = 20
"""So far from them others are looked at."""
NEAR_PX, ALIKE_NORMAL, ALIKE_COLOUR = 9.0, 0.25, 12.0
"""Deviations at which a pixel nearby, its normal and its colour (grey levels) count as like another one's."""
LEAST_SPREAD = 20.0
"""Grey levels that are added to the deviation of all colours looked at, for the broad density."""
BROAD_WORTH = 1.0
"""The broad density counts as so many pixels that are alike."""
MOST_CHANGED, MOST_AROUND = 150, 500
"""Of more pixels so many are looked at, spread evenly."""
MOST_TOLD = 3.0
"""A single pixel says no more than this, a log-likelihood ratio."""


class TwinPixels:
    """The picture around a pose, and the part as the pose has it there.

    Args:
        picture: where the part is.
        part: it.
        cam_from_body: (4,4).
    """

    def __init__(self, picture: Picture, part: PartView, cam_from_body: Array) -> None:
        self._part, self._pose = part, cam_from_body
        diameter_mm = part.views.diameter_mm
        radii_px = picture.radii_px(diameter_mm, cam_from_body[None])
        seen = picture.gradients(int(steps_to(RADIUS_PX, radii_px)[0]))
        self._focal_px = seen.intrinsics[:2]
        center_px = np.array(project(*cam_from_body[:3, 3], seen.intrinsics))
        reach_px = REACH * radii_px * seen.intrinsics[0] / picture.focal_px
        limits = np.array(seen.colours.shape[1::-1])
        low, high = (np.clip(np.round(center_px + way * reach_px), 0, limits).astype(int) for way in (-1, 1))
        self._colours = np.ascontiguousarray(seen.colours[low[1] : high[1], low[0] : high[0]])
        self._center_px = center_px - low
        self._drawn, self._inside = self._draw(cam_from_body)

    def lead(self, turn: Array) -> float:
        """By how much the pose explains the pixels better than the pose turned (3,3) about the part's centre.

        Log-likelihood ratio, divided by the root of the number of pixels that differ: neighbours err together.
        """
        if not self._colours.size:
            return 0.0
        drawn, inside = self._draw(rigid(self._pose[:3, :3] @ turn, self._pose[:3, 3]))
        changed = differing(self._drawn, drawn, OTHER_NORMAL, OTHER_DEPTH).astype(np.uint8)
        changed = cv2.morphologyEx(changed, cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
        count = cv2.countNonZero(changed)
        if count < LEAST_PIXELS:
            return 0.0
        own = self._inside.astype(np.uint8)
        # Pixels on the rim show a mixture.
        beside = cv2.dilate(changed | (self._inside != inside), np.ones((3, 3), np.uint8))
        beside |= cv2.morphologyEx(own, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
        around = cv2.dilate(changed, np.ones((2 * AROUND_PX + 1, 2 * AROUND_PX + 1), np.uint8))
        places, others = _some(changed, MOST_CHANGED), _some(around & (1 - beside), MOST_AROUND)
        if len(others) < LEAST_PIXELS:
            return 0.0
        told = _told(self._colours, places, others, self._drawn, self._inside, drawn, inside)
        return float(told * count / math.sqrt(count + 1.0))

    def _draw(self, pose: Array) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        drawn = np.empty((4, *self._colours.shape[:2]), dtype=np.float32)
        face_ids = np.empty(self._colours.shape[:2], dtype=np.int32)
        diameter_mm = self._part.views.diameter_mm
        draw_surface(self._part.surface, pose, self._focal_px, self._center_px, diameter_mm, drawn, face_ids)
        return drawn, face_ids >= 0


def _some(mask: NDArray[np.uint8], most: int) -> NDArray[np.int64]:
    """Rows and columns (N,2) of pixels of a mask, at most so many."""
    places = np.argwhere(mask)
    return places[np.linspace(0, len(places) - 1, most).astype(int)] if len(places) > most else places


@njit(cache=True, nogil=True)
def _told(colours, places, others, drawn, inside, drawn_twin, inside_twin):  # type: ignore[no-untyped-def]
    """Mean log-likelihood ratio of a pose to its twin, of pixels (N,2) at which they differ, by others (M,2)."""
    shown = np.empty((len(places) + len(others), 3))
    for i in range(len(shown)):
        v, u = places[i] if i < len(places) else others[i - len(places)]
        for c in range(3):
            shown[i, c] = colours[v, u, c]
    spread = LEAST_SPREAD + (np.std(shown[:, 0]) + np.std(shown[:, 1]) + np.std(shown[:, 2])) / 3.0
    broad = math.exp(-1.0) / (spread * math.sqrt(2.0 * math.pi)) ** 3
    narrow = 1.0 / (ALIKE_COLOUR * math.sqrt(2.0 * math.pi)) ** 3
    total = 0.0
    for i in range(len(places)):
        v, u = places[i]
        ratio = 0.0
        for twin in range(2):
            said, is_part = (drawn, inside[v, u]) if twin == 0 else (drawn_twin, inside_twin[v, u])
            weights, density = BROAD_WORTH, BROAD_WORTH * broad
            for j in range(len(others)):
                y, x = others[j]
                if inside[y, x] != is_part:
                    continue
                exponent = ((y - v) ** 2 + (x - u) ** 2) / (2.0 * NEAR_PX**2)
                if is_part:
                    turned = 0.0
                    for a in range(3):
                        turned += (said[a, v, u] - drawn[a, y, x]) ** 2
                    exponent += turned / (2.0 * ALIKE_NORMAL**2)
                if exponent > 12.0:
                    continue
                apart = 0.0
                for c in range(3):
                    apart += (shown[i, c] - shown[len(places) + j, c]) ** 2
                weight = math.exp(-exponent)
                weights += weight
                density += weight * narrow * math.exp(-apart / (2.0 * ALIKE_COLOUR**2))
            ratio += math.log(density / weights) * (1.0 if twin == 0 else -1.0)
        total += min(max(ratio, -MOST_TOLD), MOST_TOLD)
    return total / len(places)
