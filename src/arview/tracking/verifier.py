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


def contrasted(pixels: NDArray[np.uint8], lines: NDArray[np.float32]) -> tuple[NDArray[np.float32], float]:
    """A raw look with colours less their mean, in units of their deviation (6,S,S), and that deviation."""
    is_inside = (pixels[..., 3] > 0).astype(np.float32)
    count = float(is_inside.sum()) + 1.0
    colours = pixels[..., :3].transpose(2, 0, 1).astype(np.float32)
    colours = (colours - (colours * is_inside).sum(axis=(1, 2), keepdims=True) / count) * is_inside
    contrast = float(np.sqrt((colours**2).sum() / (3.0 * count) + 1e-6))
    return np.concatenate([colours / (contrast + LEAST_CONTRAST), is_inside[None], lines]), contrast


def with_gradients(plain: NDArray[np.float32]) -> NDArray[np.float32]:
    """All that the network is shown (CHANNELS,S,S) from the first six of it; gradients relative to their mean."""
    is_inside, lines = plain[3], plain[4:6]
    across, down = (
        is_inside[..., None] * slope for slope in _slopes(np.ascontiguousarray(plain[:3].transpose(1, 2, 0)))
    )
    strongest = np.argmax(across**2 + down**2, axis=2)[..., None]
    across, down = (np.take_along_axis(slope, strongest, axis=2)[..., 0] for slope in (across, down))
    normal_x, normal_y = _slopes(np.ascontiguousarray(lines[0]))
    beside = (np.abs(lines[0]) < BESIDE) / (np.sqrt(normal_x**2 + normal_y**2) + 1e-3)
    size = np.sqrt(across**2 + down**2)
    gradients = np.stack(
        [
            size,
            np.abs(across * normal_x + down * normal_y) * beside,
            np.abs(across * normal_y - down * normal_x) * beside,
        ]
    )
    gradients /= gradients + (size.mean() + LEAST_GRADIENT)
    return np.concatenate([plain, gradients, gradients[:1] * lines[1:]]).astype(np.float32, copy=False)


def overall(radius_px: float, contrast: float, known: Array) -> NDArray[np.float32]:
    """What the network is told of a pose as a whole (GLOBALS,): see there."""
    both = [np.log(radius_px / TYPICAL_RADIUS_PX), 0.5 * np.log(contrast / TYPICAL_CONTRAST + 0.05)]
    return np.concatenate([both, (known - MEANS) / DEVIATIONS]).astype(np.float32)


def _slopes(plane: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Slopes of a plane or of several, to the right and down."""
    kind, border = cv2.CV_32F, cv2.BORDER_REPLICATE
    right = cv2.Sobel(plane, kind, 1, 0, ksize=3, scale=0.125, borderType=border)
    down = cv2.Sobel(plane, kind, 0, 1, ksize=3, scale=0.125, borderType=border)
    return np.asarray(right), np.asarray(down)


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
