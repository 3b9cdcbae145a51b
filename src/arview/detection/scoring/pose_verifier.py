"""A verifier of refined poses: whether the picture around a pose shows the part there.

The evidence and the judge ask each line for itself. What they cannot see is the whole: whether the surface inside the
outline is one thing and what lies around it another, whether strong edges run where the part has none, whether what
hides a stretch of the outline is something in front of it. A small convolutional network sees it: it is given the
picture around the pose beside what the CAD says is there: the distance to the outline, the design edges, the normals
and depth of the surface, and what of the brightness the normals explain (as Labbé et al., "MegaPose", CoRL 2022, score
poses by rendered normals); and what the line network sees there, for which noise is no matter. It knows nothing of a
part: it was fitted on random solids before photos, see ``tools/training/fit.py``.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.core.parallel import pool
from arview.detection.features.edge_net import INSIDE
from arview.detection.features.image_pyramid import ImagePyramid, steps_to
from arview.detection.scoring.score_net import NetworkInput, ScoreNet, size_and_contrast
from arview.geometry import Array
from arview.guideviews.mesh_edges import EDGE_CONTOUR, EDGE_SHARP
from arview.guideviews.surface import draw_surface
from arview.refinement.kernels import nearest_view
from arview.refinement.projection import project_lines
from arview.refinement.view_model import PartView

SIDE_PX, RADIUS_PX = 80, 35.0
"""Side of the picture around a pose, and half the part's diameter in it."""
BAND_PX = 6.0
"""Distances to the outline are told up to this."""
EDGE_PX, EDGE_SQUARE = 2, 1.4
"""Design edges are drawn so wide, and fade out with this square of the distance."""
DRAWN = 6
"""Drawn of the part: distance to the outline (-1 inside, 1 outside), nearness of design edges; of its surface the
normal, right, down and towards the camera, and the depth beyond the centre's in half diameters; 0 beside it."""
PLAIN = 4 + DRAWN
"""Red, green, blue, 1 inside the picture; what is drawn."""
CHANNELS = PLAIN + 6
"""What is plain; the gradient: all of it, across the outline, along it, under design edges; the shading that the
normals explain, and the rest of the brightness."""
LINES = 3
"""Then, of what the line network sees: the strongest line, one along the outline near it, and whether solids are there.
"""
GLOBALS = 6
"""The part's size in the picture, the contrast around the pose; what evidence, judge and scatter say of the pose; the
share of the brightness of the surface that its normals explain."""
SHADES = 9
"""Shading is made of so many functions of the normal: spherical harmonics up to the second order, of which all but
0.2 % of what far lights do to a matt surface is made (Basri and Jacobs, "Lambertian reflectance and linear subspaces",
PAMI 2003)."""
SHADE_PRIOR = 0.01
"""Of every pixel so much speaks for no shading, for few faces leave some of it open."""
LEAST_SHADED = 20
"""Pixels of the surface; of fewer no shading is told."""
LEAST_CONTRAST = 6.0
"""Grey levels that are added to the deviation that colours are divided by."""
LEAST_GRADIENT = 0.02
"""In such deviations per pixel: added to the mean gradient."""
BESIDE = 0.6
"""PyramidLevel count as the outline's within such a distance of it, in BAND_PX."""
TYPICAL_RADIUS_PX = 80.0
"""Half diameters count relative to this."""
MEANS, DEVIATIONS = np.array([2.0, 1.0, 0.5]), np.array([4.0, 3.0, 1.0 / 3.0])
"""Of what is known of a pose."""
_ORIGIN, _ANY_DIRECTION = np.zeros((1, 3), np.float32), np.array([[1.0, 0.0, 0.0]], np.float32)


class PoseVerifier:
    """The network, and the part that it looks for."""

    def __init__(self, part: PartView) -> None:
        self._part = part
        self._network = ScoreNet("pose_verifier.onnx")

    def scores(self, picture: ImagePyramid, poses: Array, known: Array) -> Array:
        """Log odds that refined poses are right, but for how often that is so.

        Args:
            picture: where the part is looked for.
            poses: (N,4,4) ``cam_from_body``.
            known: (N,3) of each the logit of its evidence, what the judge says, and the scatter of its steps in px.

        Returns:
            (N,) scores.
        """
        radii_px = picture.radii_px(self._part.views.diameter_mm, poses)
        list(pool().map(picture.gradients, set(steps_to(RADIUS_PX, radii_px).tolist())))

        def look(pose: Array, radius_px: float, of_it: Array) -> NetworkInput:
            pixels, drawn, lines = pose_crop(picture, self._part, pose, radius_px)
            plain, contrast = normalise_colours(pixels, drawn)
            shown, explained = append_gradients(plain)
            return append_edge_responses(shown, lines), overall(radius_px, contrast, of_it, explained)

        return self._network.scores(list(pool().map(look, poses, radii_px.tolist(), known)))


class CropWindow:
    """A square of a picture around a pose, and what the CAD says is in it there and at poses nearby.

    Args:
        picture, part: what is looked for, and where.
        pose: (4,4) ``cam_from_body`` that it is around.
        radius_px: half the part's diameter in the picture there, see `ImagePyramid.radii_px`.
        side_px: of the square.
        drawn_px: half the part's diameter in it.

    Attributes:
        pixels: (S,S,4) uint8, RGB and 255 inside of the picture.
    """

    def __init__(
        self,
        picture: ImagePyramid,
        part: PartView,
        pose: Array,
        radius_px: float,
        side_px: int = SIDE_PX,
        drawn_px: float = RADIUS_PX,
    ) -> None:
        self._part, self._side_px = part, side_px
        self._gradients = picture.gradients(int(steps_to(drawn_px, np.array([radius_px]))[0]))
        intrinsics = self._gradients.intrinsics
        height, width = self._gradients.colours.shape[:2]
        self._zoom = drawn_px / radius_px * picture.focal_px / intrinsics[0]
        self._shift_px = 0.5 * (side_px - 1) - self._zoom * self._center_px(pose)
        way = np.column_stack([self._zoom * np.eye(2), self._shift_px])
        crop = cv2.warpAffine(self._gradients.colours, way, (side_px, side_px), flags=cv2.INTER_LINEAR)
        columns, rows = ((np.arange(side_px) - shift) / self._zoom for shift in self._shift_px)
        is_inside = np.outer(
            np.abs(rows - 0.5 * (height - 1)) <= 0.5 * height, np.abs(columns - 0.5 * (width - 1)) <= 0.5 * width
        )
        self.pixels: NDArray[np.uint8] = np.dstack([crop, 255 * is_inside.astype(np.uint8)])

    def look(self, pose: Array) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """The part (6,S,S) at a pose, see DRAWN, and the lines (3,S,S) around it, see LINES."""
        intrinsics, side = self._gradients.intrinsics, self._side_px
        diameter_mm = self._part.views.diameter_mm
        drawn = np.empty((DRAWN, side, side), dtype=np.float32)
        draw_edges(self._part.arrays, pose, intrinsics, 0.01 * diameter_mm, self._zoom, self._shift_px, drawn[:2])
        face_ids = np.empty((side, side), dtype=np.int32)
        center_px = self._zoom * self._center_px(pose) + self._shift_px
        draw_surface(self._part.surface, pose, self._zoom * intrinsics[:2], center_px, diameter_mm, drawn[2:], face_ids)
        is_far = drawn[0] > 1.0
        drawn[0][is_far] = np.where(face_ids[is_far] >= 0, -1.0, 1.0)
        seen = self._gradients.lines
        shrunk = seen.shape[2] / self._gradients.colours.shape[1]
        return drawn, crop_edge_responses(seen, shrunk, self._zoom, self._shift_px, drawn[0])

    def _center_px(self, pose: Array) -> Array:
        intrinsics = self._gradients.intrinsics
        return np.asarray(project_lines(_ORIGIN, _ANY_DIRECTION, True, pose, intrinsics, 1.0)[0][0])


def pose_crop(
    picture: ImagePyramid, part: PartView, pose: Array, radius_px: float
) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.uint8]]:
    """The picture around a pose (4,4) ``cam_from_body``, and what is drawn and seen there: see `CropWindow`."""
    window = CropWindow(picture, part, pose, radius_px)
    return window.pixels, *window.look(pose)


def append_edge_responses(shown: NDArray[np.float32], lines: NDArray[np.uint8]) -> NDArray[np.float32]:
    """All that the verifier is shown (CHANNELS + LINES,S,S)."""
    return np.concatenate([shown, lines.astype(np.float32) / np.float32(255.0)])


@kernel
def crop_edge_responses(answers, shrunk, zoom, shift, outline):  # type: ignore[no-untyped-def]
    """What the line network sees around a pose (3,S,S) uint8: see LINES.

    Args:
        answers: (9,h,w) uint8, see `EdgeNet.predict`; shrunk: their size against the picture's.
        zoom, shift: (2,) what brings the picture's pixels to those of the look.
        outline: (S,S) float32, distance to the outline as drawn.
    """
    rows, columns = answers.shape[1:]
    side = outline.shape[0]
    seen = np.zeros((LINES, side, side), dtype=np.uint8)
    normal = np.empty(2, dtype=np.float32)
    for v in range(side):
        row = int(np.floor(((v - shift[1]) / zoom + 0.5) * shrunk))
        for u in range(side):
            column = int(np.floor(((u - shift[0]) / zoom + 0.5) * shrunk))
            if not (0 <= row < rows and 0 <= column < columns):
                continue
            for k in range(INSIDE):
                seen[0, v, u] = max(seen[0, v, u], answers[k, row, column])
            if abs(outline[v, u]) < 1.0:
                _slope_at(outline, v, u, normal)
                turn = int(np.round(np.arctan2(normal[1], normal[0]) / np.pi * INSIDE)) % INSIDE
                seen[1, v, u] = answers[turn, row, column]
            seen[2, v, u] = answers[INSIDE, row, column]
    return seen


@kernel(fastmath=True)
def normalise_colours(pixels, drawn):  # type: ignore[no-untyped-def]
    """A raw look with colours less their mean, in units of their deviation (PLAIN,S,S), and that deviation."""
    plain = np.zeros((PLAIN, *pixels.shape[:2]), dtype=np.float32)
    plain[4:] = drawn
    return plain, write_relative_colours(pixels, plain)


@kernel(fastmath=True)
def write_relative_colours(pixels, plain):  # type: ignore[no-untyped-def]
    """Write colours (H,W,4) less their mean in units of their deviation, which it returns; 1 where the 4th is not 0.

    ``plain`` (4 or more,H,W) float32 is 0 there before.
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
                plain[3, v, u] = 1.0
                for c in range(3):
                    value = pixels[v, u, c] - sums[c] / count
                    plain[c, v, u] = value
                    square += value * value
    contrast = np.sqrt(square / (3.0 * count) + 1e-6)
    plain[:3] /= np.float32(contrast + LEAST_CONTRAST)
    return contrast


@kernel(fastmath=True)
def append_gradients(plain):  # type: ignore[no-untyped-def]
    """All that the network is shown (CHANNELS,S,S) from what is plain, and the share of brightness that is explained.

    PyramidLevel are relative to their mean.
    """
    rows, columns = plain.shape[1:]
    shown = np.zeros((CHANNELS, rows, columns), dtype=np.float32)
    shown[:PLAIN] = plain
    all_of_it, across_it, along_it, at_edges = PLAIN, PLAIN + 1, PLAIN + 2, PLAIN + 3
    slope = np.empty(2, dtype=np.float32)
    normal = np.empty(2, dtype=np.float32)
    total = 0.0
    for v in range(rows):
        for u in range(columns):
            if plain[3, v, u] == 0.0:
                continue
            across, down, most = np.float32(0.0), np.float32(0.0), np.float32(-1.0)
            for c in range(3):
                _slope_at(plain[c], v, u, slope)
                square = slope[0] * slope[0] + slope[1] * slope[1]
                if square > most:
                    across, down, most = slope[0], slope[1], square
            _slope_at(plain[4], v, u, normal)
            size = np.sqrt(most)
            total += size
            shown[all_of_it, v, u] = size
            if abs(plain[4, v, u]) < BESIDE:
                steep = np.sqrt(normal[0] * normal[0] + normal[1] * normal[1]) + np.float32(1e-3)
                shown[across_it, v, u] = abs(across * normal[0] + down * normal[1]) / steep
                shown[along_it, v, u] = abs(across * normal[1] - down * normal[0]) / steep
    mean = np.float32(total / (rows * columns) + LEAST_GRADIENT)
    for channel in range(all_of_it, at_edges):
        for v in range(rows):
            for u in range(columns):
                shown[channel, v, u] /= shown[channel, v, u] + mean
    shown[at_edges] = shown[all_of_it] * plain[5]
    return shown, _explain(plain, shown[PLAIN + 4], shown[PLAIN + 5])


@kernel(fastmath=True)
def _explain(plain, shading, rest):  # type: ignore[no-untyped-def]
    """Write the shading (S,S) that the normals explain, and the rest of the brightness; the share explained.

    Least squares, twice: what the first shading leaves most of counts little in the second, for it may be hidden,
    shiny or printed.
    """
    rows, columns = plain.shape[1:]
    products, values = np.zeros((SHADES, SHADES)), np.zeros(SHADES)
    f, shades = np.empty(SHADES), np.zeros(SHADES)
    scale = 1e9
    for turn in range(3):
        is_last = turn == 2
        products[:], values[:] = 0.0, 0.0
        pixels, count, total, square, left = 0, 0.0, 0.0, 0.0, 0.0
        for v in range(rows):
            for u in range(columns):
                x, y, z = plain[6, v, u], plain[7, v, u], plain[8, v, u]
                if plain[3, v, u] == 0.0 or z == 0.0:
                    continue
                f[0], f[1], f[2], f[3] = 1.0, x, y, z
                f[4], f[5], f[6], f[7], f[8] = x * y, x * z, y * z, x * x - y * y, 3.0 * z * z - 1.0
                value = (plain[0, v, u] + plain[1, v, u] + plain[2, v, u]) / 3.0
                fitted = 0.0
                for i in range(SHADES):
                    fitted += shades[i] * f[i]
                off = value - fitted
                if is_last:
                    shading[v, u], rest[v, u] = fitted, off
                weight = 1.0 if is_last else 1.0 / (1.0 + off * off / scale)
                pixels += 1
                count += weight
                total += weight * value
                square += weight * value * value
                left += weight * off * off
                for i in range(SHADES):
                    values[i] += weight * f[i] * value
                    for j in range(i + 1):
                        products[i, j] += weight * f[i] * f[j]
        if pixels < LEAST_SHADED:
            return 0.0
        if is_last:
            return max(1.0 - left / (square - total * total / count + 1e-3 * count), -1.0)
        for i in range(SHADES):
            products[i, i] += (SHADE_PRIOR if i > 0 else 1e-6) * count
            for j in range(i):
                products[j, i] = products[i, j]
        shades[:] = np.linalg.solve(products, values)
        scale = max(square - (shades * values).sum(), 0.0) / count + 1e-3
    return 0.0


@kernel(fastmath=True)
def _slope_at(plane, v, u, slope):  # type: ignore[no-untyped-def]
    """Slopes of a plane at a pixel by Sobel's weights, to the right and down; beyond the rim it goes on as there."""
    up, low = max(v - 1, 0), min(v + 1, plane.shape[0] - 1)
    left, right = max(u - 1, 0), min(u + 1, plane.shape[1] - 1)
    a, b, c, d = plane[up, left], plane[up, right], plane[low, left], plane[low, right]
    slope[0] = np.float32(0.125) * (b - a + d - c + np.float32(2.0) * (plane[v, right] - plane[v, left]))
    slope[1] = np.float32(0.125) * (c - a + d - b + np.float32(2.0) * (plane[low, u] - plane[up, u]))


def overall(radius_px: float, contrast: float, known: Array, explained: float) -> NDArray[np.float32]:
    """What the network is told of a pose as a whole (GLOBALS,): see there."""
    both = size_and_contrast(radius_px / TYPICAL_RADIUS_PX, contrast)
    return np.concatenate([both, (known - MEANS) / DEVIATIONS, [explained]]).astype(np.float32)


@kernel(fastmath=True)
def draw_edges(part, pose, intrinsics, step_mm, zoom, shift, drawn):  # type: ignore[no-untyped-def]
    """Draw the lines of the part at a pose: see DRAWN.

    Args:
        part: as in `PartView.arrays`; pose: (4,4) ``cam_from_body``.
        intrinsics: (10,) of the picture; step_mm: length over which directions are projected.
        zoom, shift: (2,) what brings the picture's pixels to those drawn.
        drawn: (2,S,S) float32, becomes them; more than 1 where the outline is far.
    """
    directions, c_start, c_points, c_normals, _, e_start, e_points, e_tangents, e_kinds = part
    side = drawn.shape[1]
    view = nearest_view(directions, pose)
    first, last = c_start[view], c_start[view + 1]
    pixels, normals, depths = project_lines(
        c_points[first:last], c_normals[first:last], False, pose, intrinsics, step_mm
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
                # Beside a point the outline goes on; beyond its end there is the distance to the point itself.
                if abs(across) < 0.5 * distance:
                    across = distance if across > 0.0 else -distance
                drawn[0, v, u] = min(max(across / BAND_PX, -1.0), 1.0)
    drawn[1] = 0.0
    first, last = e_start[view], e_start[view + 1]
    pixels, normals, depths = project_lines(
        e_points[first:last], e_tangents[first:last], True, pose, intrinsics, step_mm
    )
    for i in range(pixels.shape[0]):
        kind = e_kinds[first + i]
        if (kind & EDGE_CONTOUR) > 0 or (kind & EDGE_SHARP) == 0 or depths[i] <= 0.0:
            continue
        x, y = pixels[i, 0] * zoom + shift[0], pixels[i, 1] * zoom + shift[1]
        column, row = int(np.floor(x + 0.5)), int(np.floor(y + 0.5))
        for v in range(max(0, row - EDGE_PX), min(side, row + EDGE_PX + 1)):
            for u in range(max(0, column - EDGE_PX), min(side, column + EDGE_PX + 1)):
                near = np.exp(-((u - x) ** 2 + (v - y) ** 2) / EDGE_SQUARE)
                drawn[1, v, u] = max(drawn[1, v, u], near)
