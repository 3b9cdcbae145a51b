"""A small convolutional network that sees whether a component is where the CAD has it.

Edges say little of components that look much alike, as two nuts do. The network, shown the picture around a component
beside the normals and the depth that the CAD has there and what the line network sees, sees the whole of it: what it
is shown is made as for the `verifier`, about one component instead of the part. It was fitted on random assemblies in
which components were right, missing, moved or swapped, see ``tools/training/fit.py``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.detection.scoring.pose_verifier import (
    BAND_PX,
    DRAWN,
    append_edge_responses,
    append_gradients,
    crop_edge_responses,
    normalise_colours,
)
from arview.detection.scoring.score_net import NetworkInput, ScoreNet, size_and_contrast
from arview.geometry import Array, apply
from arview.guideviews.surface import Surface, draw_surface
from arview.refinement.projection import project

SIDE_PX, RADIUS_PX = 48, 13.0
"""Side of the picture around a component, and half the component's larger side in it."""
LEAST_PIXELS = 40
"""Pixels of a component that are seen in it; of fewer nothing is said."""
LEAST_WINDOW_PX = 10
"""Smaller pieces of a picture are not looked at."""
NEAREST_SHARE = 0.1
"""Components nearer to the camera than this share of the diameter are not looked at."""
MOST_SHARE = 1.6
"""Nor are those around which so many times as much as the larger side of the picture would be shown."""
JUMP = 0.03
"""A jump in depth, in half diameters of the part, is drawn as an edge, as normals that turn by more than 30° are."""
TURN_COS = 0.866
TYPICAL_SIZE_PX = 30.0
"""Sizes count relative to this."""
MIRRORS = ((False, False), (True, False), (False, True), (True, True))
"""Forms in which a look is scored: of 4,454 wrong components of assemblies not fitted to 59 % are then above 99 % of
the right ones, with the first form alone 57 %. The verifier of poses gains nothing from it.
"""
GLOBALS = 3
"""The component's size in the picture, the contrast around it, the share that its normals explain."""


@dataclass(frozen=True)
class ComponentLook:
    """What is shown of a component.

    Attributes:
        index: of the component.
        pixels: (S,S,4) uint8, RGB and 255 inside the picture.
        drawn: (6,S,S) float32: distance to its outline as it is seen (-1 inside, 1 outside), edges of what is drawn;
            of the whole part the normal and the depth, see `verifier.DRAWN`.
        lines: (3,S,S) uint8, what the line network sees there, see `verifier.LINES`.
        size_px: larger side of the component in the picture.
    """

    index: int
    pixels: NDArray[np.uint8]
    drawn: NDArray[np.float32]
    lines: NDArray[np.uint8]
    size_px: float


class ComponentNetwork:
    """The network."""

    def __init__(self) -> None:
        self._network = ScoreNet("presence_net.onnx", MIRRORS)

    def ratios(self, looks: list[ComponentLook], in_mirrors: bool = True) -> Array:
        """Log-likelihood ratios of "not where expected" to "as expected" (N,); without mirrors four times as fast."""
        return self._network.scores([shown(look) for look in looks], in_mirrors)


def shown(look: ComponentLook) -> NetworkInput:
    """A look as the network takes it: (CHANNELS + LINES,S,S) and (GLOBALS,)."""
    plain, contrast = normalise_colours(look.pixels, look.drawn)
    seen, explained = append_gradients(plain)
    return append_edge_responses(seen, look.lines), overall(look.size_px, contrast, explained)


def overall(size_px: float, contrast: float, explained: float) -> NDArray[np.float32]:
    """What the network is told of a component as a whole (GLOBALS,): see there."""
    return np.array([*size_and_contrast(size_px / TYPICAL_SIZE_PX, contrast), explained], dtype=np.float32)


def component_looks(
    window: NDArray[np.uint8],
    answers: NDArray[np.uint8],
    intrinsics: Array,
    surface: Surface,
    diameter_mm: float,
    cam_from_body: Array,
    only: Sequence[int] | None = None,
) -> list[ComponentLook]:
    """Looks at those components, all or only some, of which enough is seen.

    Args:
        window: (H,W,3) RGB, the picture around the part.
        answers: (9,h,w) of the line network to it, see `EdgeNet.predict`.
        intrinsics: (10,) of the window, see `intrinsics_of`.
        surface: of the part, about its centre.
        diameter_mm: of the part.
        cam_from_body: (4,4).
    """
    points = apply(cam_from_body, surface.points.astype(np.float64))
    looks = []
    for index in range(int(surface.component.max()) + 1) if only is None else only:
        own = points[np.unique(surface.faces[surface.component == index])]
        if len(own) and own[:, 2].min() > NEAREST_SHARE * diameter_mm:
            look = _look(index, own, window, answers, intrinsics, surface, diameter_mm, cam_from_body)
            if look is not None:
                looks.append(look)
    return looks


def _look(
    index: int,
    points_in_cam: Array,
    window: NDArray[np.uint8],
    answers: NDArray[np.uint8],
    intrinsics: Array,
    surface: Surface,
    diameter_mm: float,
    cam_from_body: Array,
) -> ComponentLook | None:
    """A look at a component with some points (N,3); None where it is hardly seen."""
    focal_px, principal_px = intrinsics[:2], intrinsics[2:4]
    center = 0.5 * (points_in_cam.min(axis=0) + points_in_cam.max(axis=0))
    ideal = focal_px * points_in_cam[:, :2] / points_in_cam[:, 2:] + principal_px
    # The lens moves all of the component as it does its centre.
    moved = project(*center, intrinsics) - (focal_px * center[:2] / center[2] + principal_px)
    low, high = ideal.min(axis=0) + moved, ideal.max(axis=0) + moved
    size_px = float(np.max(high - low))
    side = max(LEAST_WINDOW_PX, round(size_px * SIDE_PX / (2.0 * RADIUS_PX)))
    if side > MOST_SHARE * max(window.shape[:2]):
        return None
    corner = np.round(0.5 * (low + high) - 0.5 * (side - 1)).astype(int)
    zoom = SIDE_PX / side
    drawn = np.empty((DRAWN, SIDE_PX, SIDE_PX), dtype=np.float32)
    face_ids = np.empty((SIDE_PX, SIDE_PX), dtype=np.int32)
    place = cam_from_body[:3, 3]
    origin = focal_px * place[:2] / place[2] + principal_px + moved
    draw_surface(
        surface, cam_from_body, zoom * focal_px, zoom * (origin - corner + 0.5) - 0.5, diameter_mm, drawn[2:], face_ids
    )
    owners = np.where(face_ids >= 0, surface.component[face_ids], -1)
    is_own = (owners == index).astype(np.uint8)
    if np.count_nonzero(is_own) < LEAST_PIXELS:
        return None
    off, within = (cv2.distanceTransform(mask, cv2.DIST_L2, 3) - 0.5 for mask in (1 - is_own, is_own))
    drawn[0] = np.clip(np.where(is_own, -within, off) / BAND_PX, -1.0, 1.0)
    drawn[1] = _edges(drawn[2:], owners)
    # Depths are told about the component's own.
    middle, scale = np.median(drawn[5][is_own > 0]), diameter_mm / _extent(points_in_cam)
    drawn[5] = np.where(face_ids >= 0, np.clip(scale * (drawn[5] - middle), -1.0, 1.0), 0.0)
    shift = zoom * (0.5 - corner) - 0.5
    lines = crop_edge_responses(answers, answers.shape[2] / window.shape[1], zoom, shift, drawn[0])
    return ComponentLook(index, _cut(window, corner, side), drawn, lines, size_px)


def _extent(points: Array) -> float:
    return float(np.max(np.ptp(points, axis=0)))


def _edges(surface: NDArray[np.float32], owners: NDArray[np.int16]) -> NDArray[np.float32]:
    """1 on edges of what is drawn (S,S), less beside them: other components, jumps in depth, sharp turns."""
    is_edge = np.zeros(owners.shape, dtype=np.float32)
    for before, after in ((np.s_[..., :-1, :], np.s_[..., 1:, :]), (np.s_[..., :-1], np.s_[..., 1:])):
        one, other = surface[before], surface[after]
        turns = np.sum(one[:3] * other[:3], axis=0) < TURN_COS
        is_line = (owners[before] != owners[after]) | turns | (np.abs(one[3] - other[3]) > JUMP)
        is_edge[before] = np.maximum(is_edge[before], is_line)
        is_edge[after] = np.maximum(is_edge[after], is_line)
    return np.asarray(cv2.GaussianBlur(is_edge, (3, 3), 0.7))


def _cut(window: NDArray[np.uint8], corner: NDArray[np.intp], side: int) -> NDArray[np.uint8]:
    """A square of a picture as (S,S,4), RGB and 255 inside the picture."""
    height, width = window.shape[:2]
    low, high = np.clip(corner, 0, [width, height]), np.clip(corner + side, 0, [width, height])
    cut = np.zeros((side, side, 4), dtype=np.uint8)
    inside = np.s_[low[1] - corner[1] : high[1] - corner[1], low[0] - corner[0] : high[0] - corner[0]]
    cut[inside][..., :3] = window[low[1] : high[1], low[0] : high[0]]
    cut[inside][..., 3] = 255
    way = cv2.INTER_AREA if side > SIDE_PX else cv2.INTER_LINEAR
    sized = np.asarray(cv2.resize(cut, (SIDE_PX, SIDE_PX), interpolation=way))
    sized[..., 3] = np.where(sized[..., 3] > 200, 255, 0)
    return sized
