"""A small convolutional network that predicts whether a component is at a placement.

Edges cannot distinguish similar components, such as two nuts. The network takes the picture around a component, the
normals and depth that the CAD has there, and the edge-response maps; its input is made like that of the pose verifier,
for one component instead of the part. It was fitted to random assemblies with right, missing, displaced and swapped
components: see ``tools/training`` and the entry ``presence_net.onnx`` of the manifest of weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.detection import (
    BAND_PX,
    DRAWN_CHANNELS,
    NetworkInput,
    ScoreNet,
    append_edge_responses,
    append_gradients,
    crop_edge_responses,
    normalise_colours,
    size_and_contrast,
)
from arview.geometry import Array, apply
from arview.guideviews import Surface, draw_surface
from arview.refinement import project

SIDE_PX = 48
"""Side of the network's input."""
GLOBALS = 3
"""Inputs about the crop as a whole: the component's size in the picture, the contrast of the crop, and the share of
its brightness that the normals explain."""
MIRRORS = ((False, False), (True, False), (False, True), (True, True))
"""Test-time augmentation: (left for right, top for bottom) of the crops whose log odds are averaged."""


RADIUS_PX = 13.0
"""Half of the component's larger side in the crop."""
MIN_PIXELS = 40
"""Visible pixels of a component in the crop; with fewer the network does not predict."""
MIN_SOURCE_PX = 10
"""Smallest side of the cut-out piece of the picture."""
MAX_SOURCE_SHARE = 1.6
"""Largest side of the cut-out piece, as a multiple of the picture's larger side."""
NEAR_SHARE = 0.1
"""Components nearer to the camera than this share of the part's diameter are left out."""
DEPTH_JUMP = 0.03
"""Jump in depth that is drawn as an edge, in half diameters of the part."""
TURN_COS = 0.866
"""Normals that turn by more than 30° are drawn as an edge too."""
TYPICAL_SIZE_PX = 30.0
"""Size in the picture that the network's input of it is relative to."""


class PartImage(NamedTuple):
    """A picture around a part, and where the part is in it.

    Attributes:
        image: (H,W,3) uint8 RGB.
        edge_responses: (9,h,w) uint8 of the edge network, see `EdgeNet.predict`.
        intrinsics: (10,) of the picture, see `intrinsics_of`.
        cam_from_body: (4,4) pose about the model's centre.
    """

    image: NDArray[np.uint8]
    edge_responses: NDArray[np.uint8]
    intrinsics: Array
    cam_from_body: Array


@dataclass(frozen=True)
class ComponentCrop:
    """The picture around a component, and what the CAD has there.

    Attributes:
        index: of the component.
        pixels: (S,S,4) uint8, RGB and 255 inside the picture.
        drawn: (6,S,S) float32: distance to the component's visible outline (-1 inside, 1 outside); drawn edges; of the
            whole part the normal and the depth, see `crops`.
        edge_responses: (3,S,S) uint8 of the edge network, see `crops.RESPONSE_CHANNELS`.
        size_px: larger side of the component in the picture.
    """

    index: int
    pixels: NDArray[np.uint8]
    drawn: NDArray[np.float32]
    edge_responses: NDArray[np.uint8]
    size_px: float


class PresenceNet:
    """Predicts whether components are at the placement at which their crops were made."""

    def __init__(self) -> None:
        self._network = ScoreNet("presence_net.onnx", MIRRORS)

    def log_odds(self, crops: Sequence[ComponentCrop], is_mirrored: bool = True) -> Array:
        """Log odds (N,) of "not there" to "there"; without averaging over mirrored crops four times as fast."""
        return self._network.scores([network_input(crop) for crop in crops], is_mirrored)


def network_input(crop: ComponentCrop) -> NetworkInput:
    """The network's inputs: (CROP_CHANNELS + RESPONSE_CHANNELS,S,S) and (GLOBALS,)."""
    plain, contrast = normalise_colours(crop.pixels, crop.drawn)
    channels, explained = append_gradients(plain)
    scalars = global_inputs(crop.size_px, contrast, explained)
    return NetworkInput(append_edge_responses(channels, crop.edge_responses), scalars)


def global_inputs(size_px: float, contrast: float, explained: float) -> NDArray[np.float32]:
    """The network's inputs about the crop as a whole (GLOBALS,): see there."""
    typical_px = TYPICAL_SIZE_PX
    return np.array([*size_and_contrast(size_px / typical_px, contrast), explained], dtype=np.float32)


def component_crops(
    picture: PartImage,
    surface: Surface,
    diameter_mm: float,
    only: Sequence[int] | None = None,
) -> list[ComponentCrop]:
    """Crops of the components of which enough is visible.

    Args:
        picture: around the part.
        surface: of the part, about its centre.
        diameter_mm: of the part.
        only: indices of the components to cut out; None: all.
    """
    points = apply(picture.cam_from_body, surface.points.astype(np.float64))
    crops = []
    for index in range(int(surface.component.max()) + 1) if only is None else only:
        own = points[np.unique(surface.faces[surface.component == index])]
        if len(own) and own[:, 2].min() > NEAR_SHARE * diameter_mm:
            crop = _crop(index, own, picture, surface, diameter_mm)
            if crop is not None:
                crops.append(crop)
    return crops


def _crop(
    index: int,
    points_in_cam: Array,
    picture: PartImage,
    surface: Surface,
    diameter_mm: float,
) -> ComponentCrop | None:
    """Crop of a component with some points (N,3); None where too little of it is visible."""
    intrinsics, cam_from_body = picture.intrinsics, picture.cam_from_body
    focal_px, principal_px = intrinsics[:2], intrinsics[2:4]
    center = 0.5 * (points_in_cam.min(axis=0) + points_in_cam.max(axis=0))
    ideal = focal_px * points_in_cam[:, :2] / points_in_cam[:, 2:] + principal_px
    # The lens is taken to displace all of the component as it does its centre.
    displaced = project(center[0], center[1], center[2], intrinsics) - (
        focal_px * center[:2] / center[2] + principal_px
    )
    low, high = ideal.min(axis=0) + displaced, ideal.max(axis=0) + displaced
    size_px = float(np.max(high - low))
    side = max(MIN_SOURCE_PX, round(size_px * SIDE_PX / (2.0 * RADIUS_PX)))
    if side > MAX_SOURCE_SHARE * max(picture.image.shape[:2]):
        return None
    corner = np.round(0.5 * (low + high) - 0.5 * (side - 1)).astype(int)
    zoom = SIDE_PX / side
    drawn = np.empty((DRAWN_CHANNELS, SIDE_PX, SIDE_PX), dtype=np.float32)
    face_ids = np.empty((SIDE_PX, SIDE_PX), dtype=np.int32)
    place = cam_from_body[:3, 3]
    origin = focal_px * place[:2] / place[2] + principal_px + displaced
    draw_surface(
        surface, cam_from_body, zoom * focal_px, zoom * (origin - corner + 0.5) - 0.5, diameter_mm, drawn[2:], face_ids
    )
    owners = np.where(face_ids >= 0, surface.component[face_ids], -1)
    is_own = (owners == index).astype(np.uint8)
    if np.count_nonzero(is_own) < MIN_PIXELS:
        return None
    outside, inside = (cv2.distanceTransform(mask, cv2.DIST_L2, 3) - 0.5 for mask in (1 - is_own, is_own))
    drawn[0] = np.clip(np.where(is_own, -inside, outside) / BAND_PX, -1.0, 1.0)
    drawn[1] = _drawn_edges(drawn[2:], owners)
    # Depths are relative to the component's own.
    middle, scale = np.median(drawn[5][is_own > 0]), diameter_mm / float(np.max(np.ptp(points_in_cam, axis=0)))
    drawn[5] = np.where(face_ids >= 0, np.clip(scale * (drawn[5] - middle), -1.0, 1.0), 0.0)
    shift = zoom * (0.5 - corner) - 0.5
    shrunk = picture.edge_responses.shape[2] / picture.image.shape[1]
    responses = crop_edge_responses(picture.edge_responses, shrunk, zoom, shift, drawn[0])
    return ComponentCrop(index, _cut(picture.image, corner, side), drawn, responses, size_px)


def _drawn_edges(surface: NDArray[np.float32], owners: NDArray[np.int16]) -> NDArray[np.float32]:
    """1 on edges of what is drawn (S,S), fading beside them: borders of components, jumps in depth, sharp turns."""
    is_edge = np.zeros(owners.shape, dtype=np.float32)
    for before, after in ((np.s_[..., :-1, :], np.s_[..., 1:, :]), (np.s_[..., :-1], np.s_[..., 1:])):
        one, other = surface[before], surface[after]
        turns = np.sum(one[:3] * other[:3], axis=0) < TURN_COS
        is_line = (owners[before] != owners[after]) | turns | (np.abs(one[3] - other[3]) > DEPTH_JUMP)
        is_edge[before] = np.maximum(is_edge[before], is_line)
        is_edge[after] = np.maximum(is_edge[after], is_line)
    return np.asarray(cv2.GaussianBlur(is_edge, (3, 3), 0.7))


def _cut(image: NDArray[np.uint8], corner: NDArray[np.intp], side: int) -> NDArray[np.uint8]:
    """A square of a picture, scaled to (S,S,4): RGB and 255 inside the picture."""
    height, width = image.shape[:2]
    low, high = np.clip(corner, 0, [width, height]), np.clip(corner + side, 0, [width, height])
    cut = np.zeros((side, side, 4), dtype=np.uint8)
    inside = np.s_[low[1] - corner[1] : high[1] - corner[1], low[0] - corner[0] : high[0] - corner[0]]
    cut[inside][..., :3] = image[low[1] : high[1], low[0] : high[0]]
    cut[inside][..., 3] = 255
    method = cv2.INTER_AREA if side > SIDE_PX else cv2.INTER_LINEAR
    scaled = np.asarray(cv2.resize(cut, (SIDE_PX, SIDE_PX), interpolation=method))
    scaled[..., 3] = np.where(scaled[..., 3] > 200, 255, 0)
    return scaled
