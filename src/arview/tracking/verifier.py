"""A verifier of refined poses: whether the picture around a pose shows the part there.

The evidence and the judge ask each line for itself. What they cannot see is the whole: whether the surface inside the
outline is one thing and what lies around it another, whether strong edges run where the part has none, whether what
hides a stretch of the outline is something in front of it. A small convolutional network sees it: it is given the
picture around the pose beside what the CAD says is there, the distance to the outline and the design edges (as Labbé
et al., "MegaPose", CoRL 2022, score poses by rendered views; here from the lines of the guide views, so that nothing is
rendered). It knows nothing of a part: it was fitted on random solids before photos, see ``tools/fit_judge``.
"""

from __future__ import annotations

from importlib.resources import files

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from arview.geometry import Array
from arview.guideviews.mesh_edges import EDGE_CONTOUR, EDGE_SHARP
from arview.tracking.picture import Picture, steps_to
from arview.tracking.refine import nearest_view
from arview.tracking.solver import project_lines
from arview.tracking.threads import pool
from arview.tracking.tracker import PartView

SIDE_PX, RADIUS_PX = 64, 28.0
"""Side of the picture around a pose, and half the part's diameter in it."""
BAND_PX = 6.0
"""Distances to the outline are told up to this."""
EDGE_PX, EDGE_SQUARE = 2, 1.4
"""Design edges are drawn so wide, and fade out with this square of the distance."""
CHANNELS = 10
"""Red, green, blue, 1 inside the picture; distance to the outline (-1 inside, 1 outside), nearness of design edges;
the gradient: all of it, across the outline, along it, under design edges."""
GLOBALS = 5
"""The part's size in the picture, the contrast around the pose; what evidence, judge and scatter say of the pose."""
LEAST_CONTRAST = 6.0
"""Grey levels that are added to the deviation that colours are divided by."""
LEAST_GRADIENT = 0.02
"""In such deviations per pixel: added to the mean gradient."""
BESIDE = 0.6
"""Gradients count as the outline's within such a distance of it, in BAND_PX."""
TYPICAL_RADIUS_PX, TYPICAL_CONTRAST = 80.0, 40.0
"""Half diameters and contrasts count relative to these."""
MEANS, DEVIATIONS = np.array([2.0, 1.0, 0.5]), np.array([4.0, 3.0, 1.0 / 3.0])
"""Of what is known of a pose."""
MOST_AT_ONCE = 16
"""Poses that the network looks at together."""
_ORIGIN, _ANY_DIRECTION = np.zeros((1, 3), np.float32), np.array([[1.0, 0.0, 0.0]], np.float32)


class Verifier:
    """The network, and the part that it looks for."""

    def __init__(self, part: PartView) -> None:
        self._part = part
        model = files("arview.tracking").joinpath("verifier.onnx").read_bytes()
        self._network = cv2.dnn.readNetFromONNX(np.frombuffer(model, dtype=np.uint8))

    def scores(self, picture: Picture, poses: Array, known: Array) -> Array:
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

        def look(pose: Array, radius_px: float, of_it: Array) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
            plain, contrast = contrasted(*raw_look(picture, self._part, pose, radius_px))
            return with_gradients(plain), overall(radius_px, contrast, of_it)

        looks = list(pool().map(look, poses, radii_px.tolist(), known))
        scores = np.empty(len(poses))
        for first in range(0, len(poses), MOST_AT_ONCE):
            some = slice(first, first + MOST_AT_ONCE)
            seen, both = zip(*looks[some], strict=True)
            self._network.setInput(np.stack(seen), "seen")
            self._network.setInput(np.stack(both), "both")
            scores[some] = self._network.forward().ravel()
        return scores


def raw_look(
    picture: Picture, part: PartView, pose: Array, radius_px: float
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """The picture around a pose (S,S,4), RGB and 255 inside of it, and the part's lines (2,S,S), see CHANNELS.

    Args:
        picture, part: what is looked for, and where.
        pose: (4,4) ``cam_from_body``.
        radius_px: half the part's diameter in the picture there, see `Picture.radii_px`.
    """
    gradients = picture.gradients(int(steps_to(RADIUS_PX, np.array([radius_px]))[0]))
    intrinsics = gradients.intrinsics
    height, width = gradients.colours.shape[:2]
    center = project_lines(_ORIGIN, _ANY_DIRECTION, True, pose, intrinsics, 1.0)[0][0]
    zoom = RADIUS_PX / radius_px * picture.focal_px / intrinsics[0]
    middle = 0.5 * (SIDE_PX - 1)
    way = np.array([[zoom, 0.0, middle - zoom * center[0]], [0.0, zoom, middle - zoom * center[1]]])
    crop = cv2.warpAffine(gradients.colours, way, (SIDE_PX, SIDE_PX), flags=cv2.INTER_LINEAR)
    columns, rows = ((np.arange(SIDE_PX) - shift) / zoom for shift in way[:, 2])
    is_inside = np.outer(
        np.abs(rows - 0.5 * (height - 1)) <= 0.5 * height, np.abs(columns - 0.5 * (width - 1)) <= 0.5 * width
    )
    lines = np.empty((2, SIDE_PX, SIDE_PX), dtype=np.float32)
    draw_lines(part.arrays, pose, intrinsics, 0.01 * part.views.diameter_mm, zoom, way[:, 2], lines)
    return np.dstack([crop, 255 * is_inside.astype(np.uint8)]), lines


@njit(cache=True, nogil=True, fastmath=True)
def contrasted(pixels, lines):  # type: ignore[no-untyped-def]
    """A raw look with colours less their mean, in units of their deviation (6,S,S), and that deviation."""
    rows, columns = pixels.shape[:2]
    plain = np.zeros((6, rows, columns), dtype=np.float32)
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
            plain[4, v, u], plain[5, v, u] = lines[0, v, u], lines[1, v, u]
            if pixels[v, u, 3] > 0:
                plain[3, v, u] = 1.0
                for c in range(3):
                    value = pixels[v, u, c] - sums[c] / count
                    plain[c, v, u] = value
                    square += value * value
    contrast = np.sqrt(square / (3.0 * count) + 1e-6)
    plain[:3] /= np.float32(contrast + LEAST_CONTRAST)
    return plain, contrast


@njit(cache=True, nogil=True, fastmath=True)
def with_gradients(plain):  # type: ignore[no-untyped-def]
    """All that the network is shown (CHANNELS,S,S) from the first six of it; gradients relative to their mean."""
    rows, columns = plain.shape[1:]
    shown = np.zeros((CHANNELS, rows, columns), dtype=np.float32)
    shown[:6] = plain
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
            shown[6, v, u] = size
            if abs(plain[4, v, u]) < BESIDE:
                steep = np.sqrt(normal[0] * normal[0] + normal[1] * normal[1]) + np.float32(1e-3)
                shown[7, v, u] = abs(across * normal[0] + down * normal[1]) / steep
                shown[8, v, u] = abs(across * normal[1] - down * normal[0]) / steep
    mean = np.float32(total / (rows * columns) + LEAST_GRADIENT)
    for channel in range(6, 9):
        for v in range(rows):
            for u in range(columns):
                shown[channel, v, u] /= shown[channel, v, u] + mean
    shown[9] = shown[6] * plain[5]
    return shown


@njit(cache=True, nogil=True, fastmath=True)
def _slope_at(plane, v, u, slope):  # type: ignore[no-untyped-def]
    """Slopes of a plane at a pixel by Sobel's weights, to the right and down; beyond the rim it goes on as there."""
    up, low = max(v - 1, 0), min(v + 1, plane.shape[0] - 1)
    left, right = max(u - 1, 0), min(u + 1, plane.shape[1] - 1)
    a, b, c, d = plane[up, left], plane[up, right], plane[low, left], plane[low, right]
    slope[0] = np.float32(0.125) * (b - a + d - c + np.float32(2.0) * (plane[v, right] - plane[v, left]))
    slope[1] = np.float32(0.125) * (c - a + d - b + np.float32(2.0) * (plane[low, u] - plane[up, u]))


def overall(radius_px: float, contrast: float, known: Array) -> NDArray[np.float32]:
    """What the network is told of a pose as a whole (GLOBALS,): see there."""
    both = [np.log(radius_px / TYPICAL_RADIUS_PX), 0.5 * np.log(contrast / TYPICAL_CONTRAST + 0.05)]
    return np.concatenate([both, (known - MEANS) / DEVIATIONS]).astype(np.float32)


@njit(cache=True, nogil=True, fastmath=True)
def draw_lines(part, pose, intrinsics, step_mm, zoom, shift, drawn):  # type: ignore[no-untyped-def]
    """Draw the lines of the part at a pose: see CHANNELS.

    Args:
        part: as in `PartView.arrays`; pose: (4,4) ``cam_from_body``.
        intrinsics: (10,) of the picture; step_mm: length over which directions are projected.
        zoom, shift: (2,) what brings the picture's pixels to those drawn.
        drawn: (2,S,S) float32, becomes them.
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
    for v in range(side):
        # Far from the outline the side is that of the last place near it.
        beyond = np.float32(1.0)
        for u in range(side):
            if drawn[0, v, u] > 1.0:
                drawn[0, v, u] = beyond
            else:
                beyond = np.float32(1.0) if drawn[0, v, u] > 0.0 else np.float32(-1.0)
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
