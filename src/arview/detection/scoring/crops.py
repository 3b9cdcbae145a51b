"""Crops: the square of an image around a pose, beside what the CAD shows there, as input of the scoring networks.

A network that compares an image with a pose needs both in the same pixels: colours, and what is drawn from the CAD: the
distance to the outline, the design edges, the normals and depth of the surface (as Labbé et al., "MegaPose", CoRL 2022,
score poses by rendered normals). Gradients along and across the outline, the shading that the normals explain, and the
responses of the edge network are added, because small networks do not learn them reliably.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.detection.features.edge_net import SOLID_CHANNEL
from arview.detection.features.image_pyramid import ImagePyramid, steps_to
from arview.geometry import Array
from arview.guideviews import draw_surface
from arview.refinement import PartView, ViewArrays, nearest_view, project_lines
from arview.rendering import EDGE_CONTOUR, EDGE_SHARP

CROP_SIDE_PX, CROP_RADIUS_PX = 80, 35.0
"""Side of the crop around a pose, and half the part's diameter in it."""
BAND_PX = 6.0
"""Distances to the outline are drawn up to this."""
EDGE_REACH_PX, EDGE_SQUARE_PX = 2, 1.4
"""Reach of a drawn design edge, and the squared distance over which it fades by a factor of e."""
MASK, OUTLINE_DISTANCE, DESIGN_EDGES, NORMAL_X, NORMAL_Y, NORMAL_Z, DEPTH = range(3, 10)
"""Plain channels after red, green and blue: 1 inside the image; signed distance to the outline in `BAND_PX` (-1 inside,
1 outside); nearness of design edges; surface normal to the right, down and towards the camera; depth behind the centre
in half diameters. The last four are 0 beside the part."""
GRADIENT, GRADIENT_ACROSS, GRADIENT_ALONG, GRADIENT_AT_EDGES, SHADING, RESIDUAL = range(10, 16)
"""Derived channels: gradient magnitude; its parts across and along the outline nearby; gradient magnitude at design
edges; brightness that the normals explain; the rest of the brightness."""
DRAWN_CHANNELS = 6
"""Channels drawn from the CAD: `OUTLINE_DISTANCE` to `DEPTH`."""
PLAIN_CHANNELS = 4 + DRAWN_CHANNELS
"""Colours, `MASK` and the drawn channels."""
CROP_CHANNELS = PLAIN_CHANNELS + 6
"""Plain and derived channels."""
RESPONSE_CHANNELS = 3
"""Edge-response channels after those: strongest edge response, response along the outline near it, solidness."""
SHADING_TERMS = 9
"""Spherical harmonics up to the second order, which hold all but 0.2 % of what distant lights do to a matt surface
(Basri & Jacobs, "Lambertian reflectance and linear subspaces", PAMI 2003)."""
SHADING_PRIOR = 0.01
"""Weight per pixel of the prior for no shading; few faces leave some of the terms undetermined."""
MIN_SHADED_PIXELS = 20
"""Surface pixels below which no shading is estimated."""
MIN_CONTRAST = 6.0
"""Grey levels added to the standard deviation that colours are divided by."""
MIN_GRADIENT = 0.02
"""Added to the mean gradient, in such deviations per pixel."""
OUTLINE_REACH = 0.6
"""Distance from the outline, in `BAND_PX`, within which gradients belong to it."""


class PoseCrop(NamedTuple):
    """Raw crop around a pose.

    Attributes:
        pixels: (S,S,4) uint8 RGB and 255 inside the image.
        drawn: (DRAWN_CHANNELS,S,S) float32.
        responses: (RESPONSE_CHANNELS,S,S) uint8.
    """

    pixels: NDArray[np.uint8]
    drawn: NDArray[np.float32]
    responses: NDArray[np.uint8]


class CropWindow:
    """Square window of an image around a pose, in which this pose and poses nearby are drawn.

    Args:
        pyramid: of the image.
        part: that is drawn.
        pose: (4,4) ``cam_from_body`` at the centre of the window.
        radius_px: half the part's diameter in the image there, see `ImagePyramid.radii_px`.
        side_px: side of the window.
        drawn_px: half the part's diameter in the window.

    Attributes:
        pixels: (S,S,4) uint8 RGB and 255 inside the image.
    """

    def __init__(
        self,
        pyramid: ImagePyramid,
        part: PartView,
        pose: Array,
        radius_px: float,
        side_px: int = CROP_SIDE_PX,
        drawn_px: float = CROP_RADIUS_PX,
    ) -> None:
        self._part, self._side_px = part, side_px
        self._level = pyramid.level(int(steps_to(drawn_px, np.array([radius_px]))[0]))
        intrinsics = self._level.intrinsics
        height, width = self._level.colours.shape[:2]
        self._zoom = drawn_px / radius_px * pyramid.focal_px / intrinsics[0]
        self._shift_px = 0.5 * (side_px - 1) - self._zoom * self._center_px(pose)
        affine = np.column_stack([self._zoom * np.eye(2), self._shift_px])
        crop = cv2.warpAffine(self._level.colours, affine, (side_px, side_px), flags=cv2.INTER_LINEAR)
        columns, rows = ((np.arange(side_px) - shift) / self._zoom for shift in self._shift_px)
        is_inside = np.outer(
            np.abs(rows - 0.5 * (height - 1)) <= 0.5 * height, np.abs(columns - 0.5 * (width - 1)) <= 0.5 * width
        )
        self.pixels: NDArray[np.uint8] = np.dstack([crop, 255 * is_inside.astype(np.uint8)])

    def crop(self, pose: Array) -> PoseCrop:
        """The window with the part drawn at a pose (4,4)."""
        intrinsics, side = self._level.intrinsics, self._side_px
        diameter_mm = self._part.views.diameter_mm
        drawn = np.empty((DRAWN_CHANNELS, side, side), dtype=np.float32)
        draw_edges(self._part.arrays, pose, intrinsics, 0.01 * diameter_mm, self._zoom, self._shift_px, drawn[:2])
        face_ids = np.empty((side, side), dtype=np.int32)
        center_px = self._zoom * self._center_px(pose) + self._shift_px
        draw_surface(self._part.surface, pose, self._zoom * intrinsics[:2], center_px, diameter_mm, drawn[2:], face_ids)
        is_far = drawn[0] > 1.0
        drawn[0][is_far] = np.where(face_ids[is_far] >= 0, -1.0, 1.0)
        responses = self._level.edge_responses
        shrunk = responses.shape[2] / self._level.colours.shape[1]
        cropped = crop_edge_responses(responses, shrunk, self._zoom, self._shift_px, drawn[0])
        return PoseCrop(self.pixels, drawn, cropped)

    def _center_px(self, pose: Array) -> Array:
        """Pixel (2,) of the part's centre in the level of the pyramid."""
        center, any_direction = np.zeros((1, 3), np.float32), np.array([[1.0, 0.0, 0.0]], np.float32)
        return np.asarray(project_lines(center, any_direction, True, pose, self._level.intrinsics, 1.0)[0][0])


def pose_crop(pyramid: ImagePyramid, part: PartView, pose: Array, radius_px: float) -> PoseCrop:
    """The crop around a pose (4,4) ``cam_from_body`` with the part drawn at it; see `CropWindow`."""
    return CropWindow(pyramid, part, pose, radius_px).crop(pose)


def without_outside(crop: PoseCrop) -> PoseCrop:
    """A crop in which nothing is expected beyond the image's border, and the colours at the border continue.

    A network that saw few cut parts takes lines drawn beyond the border for lines that the image lacks.
    """
    is_inside = crop.pixels[..., 3] > 0
    rows, columns = np.flatnonzero(is_inside.any(axis=1)), np.flatnonzero(is_inside.any(axis=0))
    if is_inside.all() or not len(rows):
        return crop
    places = np.arange(len(is_inside))
    nearest = np.ix_(np.clip(places, rows[0], rows[-1]), np.clip(places, columns[0], columns[-1]))
    drawn = crop.drawn * is_inside.astype(np.float32)
    drawn[0][~is_inside] = 1.0
    return PoseCrop(np.ascontiguousarray(crop.pixels[nearest]), drawn, crop.responses)


def append_edge_responses(channels: NDArray[np.float32], responses: NDArray[np.uint8]) -> NDArray[np.float32]:
    """All channels of a crop (CROP_CHANNELS + RESPONSE_CHANNELS,S,S)."""
    return np.concatenate([channels, responses.astype(np.float32) / np.float32(255.0)])


@kernel
def crop_edge_responses(
    responses: NDArray[np.uint8], shrunk: float, zoom: float, shift: NDArray[np.float64], outline: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """Edge responses around a pose (RESPONSE_CHANNELS,S,S) uint8.

    Args:
        responses: (9,h,w) uint8 of `EdgeNet.predict`.
        shrunk: size of these maps relative to the image.
        zoom, shift: scale and (2,) offset that map image pixels to crop pixels.
        outline: (S,S) float32 drawn distance to the outline.
    """
    rows, columns = responses.shape[1:]
    side = outline.shape[0]
    cropped = np.zeros((RESPONSE_CHANNELS, side, side), dtype=np.uint8)
    normal = np.empty(2, dtype=np.float32)
    for v in range(side):
        row = int(np.floor(((v - shift[1]) / zoom + 0.5) * shrunk))
        for u in range(side):
            column = int(np.floor(((u - shift[0]) / zoom + 0.5) * shrunk))
            if not (0 <= row < rows and 0 <= column < columns):
                continue
            for k in range(SOLID_CHANNEL):
                cropped[0, v, u] = max(cropped[0, v, u], responses[k, row, column])
            if abs(outline[v, u]) < 1.0:
                _slope_at(outline, v, u, normal)
                turn = int(np.round(np.arctan2(normal[1], normal[0]) / np.pi * SOLID_CHANNEL)) % SOLID_CHANNEL
                cropped[1, v, u] = responses[turn, row, column]
            cropped[2, v, u] = responses[SOLID_CHANNEL, row, column]
    return cropped


@kernel(fastmath=True)
def normalise_colours(pixels: NDArray[np.uint8], drawn: NDArray[np.float32]) -> tuple[NDArray[np.float32], float]:
    """Plain channels (PLAIN_CHANNELS,S,S) of a raw crop with normalised colours, and the contrast in grey levels."""
    plain = np.zeros((PLAIN_CHANNELS, *pixels.shape[:2]), dtype=np.float32)
    plain[4:] = drawn
    return plain, write_relative_colours(pixels, plain)


@kernel(fastmath=True)
def write_relative_colours(pixels: NDArray[np.uint8], plain: NDArray[np.float32]) -> float:
    """Write colours less their mean, divided by their standard deviation, and return that deviation in grey levels.

    Args:
        pixels: (H,W,4) RGB and a mask; pixels with mask 0 are ignored.
        plain: (4 or more,H,W) float32, zero before; receives the colours, and 1 in `MASK` where the mask is not 0.
    """
    rows, columns = pixels.shape[:2]
    sums = np.zeros(3)
    count = 1.0
    for v in range(rows):
        for u in range(columns):
            if pixels[v, u, 3] > 0:
                count += 1.0
                for c in range(3):
                    sums[c] += pixels[v, u, c]
    square = 0.0
    for v in range(rows):
        for u in range(columns):
            if pixels[v, u, 3] > 0:
                plain[MASK, v, u] = 1.0
                for c in range(3):
                    value = pixels[v, u, c] - sums[c] / count
                    plain[c, v, u] = value
                    square += value * value
    contrast = np.sqrt(square / (3.0 * count) + 1e-6)
    plain[:3] /= np.float32(contrast + MIN_CONTRAST)
    return contrast


@kernel(fastmath=True)
def append_gradients(plain: NDArray[np.float32]) -> tuple[NDArray[np.float32], float]:
    """Plain and derived channels (CROP_CHANNELS,S,S) of plain ones, and the share of brightness that shading explains.

    Gradients are relative to their mean.
    """
    rows, columns = plain.shape[1:]
    channels = np.zeros((CROP_CHANNELS, rows, columns), dtype=np.float32)
    channels[:PLAIN_CHANNELS] = plain
    slope = np.empty(2, dtype=np.float32)
    normal = np.empty(2, dtype=np.float32)
    total = 0.0
    for v in range(rows):
        for u in range(columns):
            if plain[MASK, v, u] == 0.0:
                continue
            across, down, most = np.float32(0.0), np.float32(0.0), np.float32(-1.0)
            for c in range(3):
                _slope_at(plain[c], v, u, slope)
                square = slope[0] * slope[0] + slope[1] * slope[1]
                if square > most:
                    across, down, most = slope[0], slope[1], square
            _slope_at(plain[OUTLINE_DISTANCE], v, u, normal)
            size = np.sqrt(most)
            total += size
            channels[GRADIENT, v, u] = size
            if abs(plain[OUTLINE_DISTANCE, v, u]) < OUTLINE_REACH:
                steep = np.sqrt(normal[0] * normal[0] + normal[1] * normal[1]) + np.float32(1e-3)
                channels[GRADIENT_ACROSS, v, u] = abs(across * normal[0] + down * normal[1]) / steep
                channels[GRADIENT_ALONG, v, u] = abs(across * normal[1] - down * normal[0]) / steep
    mean = np.float32(total / (rows * columns) + MIN_GRADIENT)
    for channel in range(GRADIENT, GRADIENT_AT_EDGES):
        for v in range(rows):
            for u in range(columns):
                channels[channel, v, u] /= channels[channel, v, u] + mean
    channels[GRADIENT_AT_EDGES] = channels[GRADIENT] * plain[DESIGN_EDGES]
    return channels, _explain_shading(plain, channels[SHADING], channels[RESIDUAL])


@kernel(fastmath=True)
def _explain_shading(plain: NDArray[np.float32], shading: NDArray[np.float32], residual: NDArray[np.float32]) -> float:
    """Write the brightness (S,S) that the normals explain and its residual, and return the explained share.

    Two rounds of iteratively reweighted least squares: pixels that the first fit leaves far off may be occluded,
    specular or printed, and weigh little in the second.
    """
    rows, columns = plain.shape[1:]
    products, values = np.zeros((SHADING_TERMS, SHADING_TERMS)), np.zeros(SHADING_TERMS)
    f, terms = np.empty(SHADING_TERMS), np.zeros(SHADING_TERMS)
    scale = 1e9
    for iteration in range(3):
        is_last = iteration == 2
        products[:], values[:] = 0.0, 0.0
        pixels, count, total, square, left = 0, 0.0, 0.0, 0.0, 0.0
        for v in range(rows):
            for u in range(columns):
                x, y, z = plain[NORMAL_X, v, u], plain[NORMAL_Y, v, u], plain[NORMAL_Z, v, u]
                if plain[MASK, v, u] == 0.0 or z == 0.0:
                    continue
                f[0], f[1], f[2], f[3] = 1.0, x, y, z
                f[4], f[5], f[6], f[7], f[8] = x * y, x * z, y * z, x * x - y * y, 3.0 * z * z - 1.0
                value = (plain[0, v, u] + plain[1, v, u] + plain[2, v, u]) / 3.0
                fitted = 0.0
                for i in range(SHADING_TERMS):
                    fitted += terms[i] * f[i]
                off = value - fitted
                if is_last:
                    shading[v, u], residual[v, u] = fitted, off
                weight = 1.0 if is_last else 1.0 / (1.0 + off * off / scale)
                pixels += 1
                count += weight
                total += weight * value
                square += weight * value * value
                left += weight * off * off
                for i in range(SHADING_TERMS):
                    values[i] += weight * f[i] * value
                    for j in range(i + 1):
                        products[i, j] += weight * f[i] * f[j]
        if pixels < MIN_SHADED_PIXELS:
            return 0.0
        if is_last:
            return max(1.0 - left / (square - total * total / count + 1e-3 * count), -1.0)
        for i in range(SHADING_TERMS):
            products[i, i] += (SHADING_PRIOR if i > 0 else 1e-6) * count
            for j in range(i):
                products[j, i] = products[i, j]
        terms[:] = np.linalg.solve(products, values)
        scale = max(square - (terms * values).sum(), 0.0) / count + 1e-3
    return 0.0


@kernel(fastmath=True)
def _slope_at(plane: NDArray[np.float32], v: int, u: int, slope: NDArray[np.float32]) -> None:
    """Write the gradient x, y of a plane at a pixel by Sobel's weights; the border is replicated."""
    up, low = max(v - 1, 0), min(v + 1, plane.shape[0] - 1)
    left, right = max(u - 1, 0), min(u + 1, plane.shape[1] - 1)
    a, b, c, d = plane[up, left], plane[up, right], plane[low, left], plane[low, right]
    slope[0] = np.float32(0.125) * (b - a + d - c + np.float32(2.0) * (plane[v, right] - plane[v, left]))
    slope[1] = np.float32(0.125) * (c - a + d - b + np.float32(2.0) * (plane[low, u] - plane[up, u]))


@kernel(fastmath=True)
def draw_edges(
    part: ViewArrays,
    pose: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    step_mm: float,
    zoom: float,
    shift: NDArray[np.float64],
    drawn: NDArray[np.float32],
) -> None:
    """Draw the outline and the design edges of the part at a pose.

    Args:
        part: arrays of all guide views, see `PartView.arrays`.
        pose: (4,4) ``cam_from_body``.
        intrinsics: (10,) of the image.
        step_mm: length over which directions are projected.
        zoom, shift: scale and (2,) offset that map image pixels to drawn pixels.
        drawn: (2,S,S) float32, receives the signed distance to the outline (more than 1 far from it) and the nearness
            of design edges.
    """
    side = drawn.shape[1]
    view = nearest_view(part.directions, pose)
    first, last = part.contour_starts[view], part.contour_starts[view + 1]
    pixels, normals, depths = project_lines(
        part.contour_points[first:last], part.contour_normals[first:last], False, pose, intrinsics, step_mm
    )
    nearest = np.full((side, side), BAND_PX * BAND_PX, dtype=np.float32)
    reach = int(BAND_PX) + 1
    drawn[0] = 2.0
    for i in range(pixels.shape[0]):
        if depths[i] <= 0.0:
            continue
        x, y = pixels[i, 0] * zoom + shift[0], pixels[i, 1] * zoom + shift[1]
        column, row = int(np.floor(x + 0.5)), int(np.floor(y + 0.5))
        for v in range(max(0, row - reach), min(side, row + reach + 1)):
            for u in range(max(0, column - reach), min(side, column + reach + 1)):
                square = (u - x) ** 2 + (v - y) ** 2
                if square >= nearest[v, u]:
                    continue
                nearest[v, u] = square
                across, distance = (u - x) * normals[i, 0] + (v - y) * normals[i, 1], np.sqrt(square)
                # Beside a point the outline continues; beyond its end the distance is to the point itself.
                if abs(across) < 0.5 * distance:
                    across = distance if across > 0.0 else -distance
                drawn[0, v, u] = min(max(across / BAND_PX, -1.0), 1.0)
    drawn[1] = 0.0
    first, last = part.edge_starts[view], part.edge_starts[view + 1]
    pixels, normals, depths = project_lines(
        part.edge_points[first:last], part.edge_tangents[first:last], True, pose, intrinsics, step_mm
    )
    for i in range(pixels.shape[0]):
        kind = part.edge_kinds[first + i]
        if (kind & EDGE_CONTOUR) > 0 or (kind & EDGE_SHARP) == 0 or depths[i] <= 0.0:
            continue
        x, y = pixels[i, 0] * zoom + shift[0], pixels[i, 1] * zoom + shift[1]
        column, row = int(np.floor(x + 0.5)), int(np.floor(y + 0.5))
        for v in range(max(0, row - EDGE_REACH_PX), min(side, row + EDGE_REACH_PX + 1)):
            for u in range(max(0, column - EDGE_REACH_PX), min(side, column + EDGE_REACH_PX + 1)):
                near = np.exp(-((u - x) ** 2 + (v - y) ** 2) / EDGE_SQUARE_PX)
                drawn[1, v, u] = max(drawn[1, v, u], near)
