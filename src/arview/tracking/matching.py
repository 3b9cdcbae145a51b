"""Oriented-gradient template matching: the kernels behind the detector.

The picture becomes a response map for each of eight edge orientations, spread so that small errors of the template
do not matter; a template is a short list of (dx, dy, orientation) and its score at a place is the mean response
under its points: Hinterstoisser et al., "Gradient Response Maps for Real-Time Detection of Textureless Objects"
(PAMI 2012). Own here: responses are normalised by the local contrast and cleared of what all orientations share, so
that texture and clutter, which answer to everything, do not win.
"""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from arview.geometry import Array
from arview.guideviews.mesh_edges import EDGE_CONTOUR, EDGE_SHARP
from arview.tracking.refine import nearest_view
from arview.tracking.solver import project_lines

ORIENTATIONS = 8
"""Bins over 180°."""


def response_maps(image: NDArray[np.uint8], spread_px: int, pad_px: int) -> NDArray[np.uint8]:
    """(8, H + 2 pad, W + 2 pad) uint8 responses of an RGB or gray picture, 255 = a clear edge of that orientation."""
    smooth = cv2.GaussianBlur(image, (3, 3), 0)
    gx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3)
    gy = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3)
    if image.ndim == 3:
        # Per pixel the channel with the strongest gradient (Dalal & Triggs 2005).
        strongest = np.argmax(gx * gx + gy * gy, axis=2)[..., None]
        gx = np.take_along_axis(gx, strongest, axis=2)[..., 0]
        gy = np.take_along_axis(gy, strongest, axis=2)[..., 0]
    magnitude = cv2.magnitude(gx, gy) * 0.25
    around = cv2.boxFilter(magnitude, -1, (21, 21), borderType=cv2.BORDER_REFLECT)
    strength = magnitude / (magnitude + around + 3.0)
    # Thin: only pixels that are a maximum of their neighbourhood in some direction say where the edge is.
    strength[magnitude < 0.6 * cv2.dilate(magnitude, np.ones((3, 3), np.uint8))] = 0.0
    position = np.arctan2(gy, gx) / np.pi * ORIENTATIONS
    low = np.floor(position)
    share = position - low
    low_bin = low.astype(np.intp) % ORIENTATIONS
    high_bin = (low_bin + 1) % ORIENTATIONS
    size = (2 * spread_px + 1, 2 * spread_px + 1)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, size)
    spread = np.empty((ORIENTATIONS, *magnitude.shape), dtype=np.float32)
    for o in range(ORIENTATIONS):
        own = np.where(low_bin == o, strength * np.minimum(1.0, 2.0 * (1.0 - share)), 0.0)
        own += np.where(high_bin == o, strength * np.minimum(1.0, 2.0 * share), 0.0)
        spread[o] = cv2.dilate(own.astype(np.float32), kernel)
    common = spread.mean(axis=0)
    spread = np.clip((spread - common) * 1.6, 0.0, 1.0)
    padding = ((0, 0), (pad_px, pad_px), (pad_px, pad_px))
    return np.pad((spread * 255.0).astype(np.uint8), padding)


def decimate(maps: NDArray[np.uint8], step: int) -> NDArray[np.uint8]:
    """(8, step, step, ceil(H/step), ceil(W/step)): phases of the maps apart, a coarse grid is contiguous."""
    count, height, width = maps.shape
    rows, columns = -(-height // step), -(-width // step)
    padded = np.zeros((count, rows * step, columns * step), dtype=np.uint8)
    padded[:, :height, :width] = maps
    return np.ascontiguousarray(padded.reshape(count, rows, step, columns, step).transpose(0, 2, 4, 1, 3))


@njit(cache=True, nogil=True)
def match_templates(phases, offsets, bins, counts, top, lowest):  # type: ignore[no-untyped-def]
    """Best places of each template on a grid of ``step`` px.

    Args:
        phases: from `decimate`.
        offsets: (T,N,2) int dx, dy of the points, shifted to be ≥ 0; bins: (T,N) orientation; counts: (T,).
        lowest: templates that nowhere score this much are skipped.
        top: places kept per template, at least about a template's core apart.

    Returns:
        scores (T,top) 0–1 and places (T,top,2) of the shifted template's origin, in full pixels.
    """
    step = phases.shape[1]
    rows, columns = phases.shape[3], phases.shape[4]
    templates = offsets.shape[0]
    scores = np.zeros((templates, top))
    places = np.zeros((templates, top, 2), dtype=np.int32)
    total = np.empty(rows * columns, dtype=np.uint16)
    flat = phases.reshape((phases.shape[0], step, step, rows * columns))
    for t in range(templates):
        reach_x = 0
        reach_y = 0
        for i in range(counts[t]):
            reach_x = max(reach_x, offsets[t, i, 0])
            reach_y = max(reach_y, offsets[t, i, 1])
        last_row = rows - reach_y // step - 1
        last_column = columns - reach_x // step - 1
        if last_row < 1 or last_column < 1:
            continue
        span = (last_row - 1) * columns + last_column
        total[:] = 0
        for i in range(counts[t]):
            dx, dy = offsets[t, i, 0], offsets[t, i, 1]
            source = flat[bins[t, i], dy % step, dx % step]
            shift = (dy // step) * columns + dx // step
            moved = source[shift : shift + span]
            for k in range(span):
                total[k] += moved[k]
        highest = 0
        for k in range(span):
            highest = max(highest, total[k])
        if highest < lowest * 255.0 * counts[t]:
            continue
        for n in range(top):
            best = 0
            where = -1
            for row in range(last_row):
                line = total[row * columns : row * columns + last_column]
                peak = 0
                for k in range(last_column):
                    peak = max(peak, line[k])
                if peak > best:
                    best = peak
                    for k in range(last_column):
                        if line[k] == peak:
                            where = row * columns + k
                            break
            if where < 0:
                break
            row, column = where // columns, where % columns
            scores[t, n] = best / (255.0 * counts[t])
            places[t, n, 0] = column * step
            places[t, n, 1] = row * step
            for y in range(max(0, row - 4), min(last_row, row + 5)):
                for x in range(max(0, column - 4), min(last_column, column + 5)):
                    total[y * columns + x] = 0
    return scores, places


def orientation_bins(normals_px: Array) -> NDArray[np.uint8]:
    """Orientation bin (N,) of image normals (N,2); the gradient of an edge runs along its normal."""
    position = np.arctan2(normals_px[:, 1], normals_px[:, 0]) / np.pi * ORIENTATIONS
    return (np.round(position).astype(np.intp) % ORIENTATIONS).astype(np.uint8)


@njit(cache=True, nogil=True)
def score_around(  # type: ignore[no-untyped-def]
    maps, part, cam_from_body, intrinsics, step_mm, turns, stretches, shift_px, shift_step, contour_count, edge_count
):
    """Score poses around one pose by the responses under their projected outline and design edges.

    Args:
        maps: (8,H,W) from `response_maps`, padded.
        part: arrays of all guide views, see `PartView.arrays`.
        cam_from_body: (4,4) the pose to search around.
        intrinsics: (10,) of the picture that the maps were made from, padding included.
        step_mm: length over which directions are projected.
        turns: (R,3,3) rotations about the part's centre, applied on the camera's side.
        stretches: (D,) factors of the distance.
        shift_px, shift_step: every turned and stretched pose is tried at shifts of ± shift_px.
        contour_count, edge_count: about so many points are looked at.

    Returns:
        scores (R·D,) 0–1 and poses (R·D,4,4), the best shift applied.
    """
    directions, c_start, c_points, c_normals, _, e_start, e_points, e_tangents, e_kinds = part
    total = turns.shape[0] * stretches.shape[0]
    scores = np.zeros(total)
    poses = np.zeros((total, 4, 4))
    steps = 2 * (shift_px // shift_step) + 1
    sums = np.empty((steps, steps), dtype=np.int32)
    columns = np.empty(contour_count + edge_count + 64, dtype=np.int64)
    rows = np.empty(contour_count + edge_count + 64, dtype=np.int64)
    bins = np.empty(contour_count + edge_count + 64, dtype=np.int64)
    for t in range(turns.shape[0]):
        pose = cam_from_body.copy()
        for i in range(3):
            for j in range(3):
                pose[i, j] = (
                    turns[t, i, 0] * cam_from_body[0, j]
                    + turns[t, i, 1] * cam_from_body[1, j]
                    + turns[t, i, 2] * cam_from_body[2, j]
                )
        view = nearest_view(directions, pose)
        c_size = c_start[view + 1] - c_start[view]
        e_size = e_start[view + 1] - e_start[view]
        c_stride = max(1, c_size // contour_count)
        e_stride = max(1, e_size // (2 * edge_count))
        contour = c_points[c_start[view] : c_start[view + 1] : c_stride]
        contour_normals = c_normals[c_start[view] : c_start[view + 1] : c_stride]
        edges = e_points[e_start[view] : e_start[view + 1] : e_stride]
        edge_tangents = e_tangents[e_start[view] : e_start[view + 1] : e_stride]
        kinds = e_kinds[e_start[view] : e_start[view + 1] : e_stride]
        for d in range(stretches.shape[0]):
            index = t * stretches.shape[0] + d
            for i in range(3):
                pose[i, 3] = cam_from_body[i, 3] * stretches[d]
            poses[index] = pose
            count = 0
            for group in range(2):
                if group == 0:
                    px, normals, depths = project_lines(contour, contour_normals, False, pose, intrinsics, step_mm)
                else:
                    px, normals, depths = project_lines(edges, edge_tangents, True, pose, intrinsics, step_mm)
                limit = contour_count + 32 if group == 0 else contour_count + edge_count + 64
                for i in range(px.shape[0]):
                    if group == 1 and ((kinds[i] & EDGE_CONTOUR) > 0 or (kinds[i] & EDGE_SHARP) == 0):
                        continue
                    if depths[i] <= 0 or count >= limit:
                        continue
                    columns[count] = int(np.round(px[i, 0]))
                    rows[count] = int(np.round(px[i, 1]))
                    turn = np.arctan2(normals[i, 1], normals[i, 0]) / np.pi * 8.0
                    bins[count] = int(np.round(turn)) % 8
                    count += 1
            if count < 16:
                continue
            best, best_dx, best_dy = _best_shift(maps, columns, rows, bins, count, shift_px, shift_step, sums)
            scores[index] = best / (255.0 * count)
            poses[index, 0, 3] += best_dx * pose[2, 3] / intrinsics[0]
            poses[index, 1, 3] += best_dy * pose[2, 3] / intrinsics[1]
    return scores, poses


@njit(cache=True, nogil=True)
def _best_shift(maps, columns, rows, bins, count, shift_px, shift_step, sums):  # type: ignore[no-untyped-def]
    """Highest sum of responses under the first ``count`` points over all shifts, and that shift dx, dy in px.

    ``sums`` (S,S) int32 is room to work in. Points that a shift moves outside the maps add nothing.
    """
    height, width = maps.shape[1], maps.shape[2]
    steps = sums.shape[0]
    reach = shift_px // shift_step * shift_step
    sums[:] = 0
    for i in range(count):
        x0 = columns[i] - reach
        y0 = rows[i] - reach
        plane = maps[bins[i]]
        if x0 >= 0 and y0 >= 0 and x0 + 2 * reach < width and y0 + 2 * reach < height:
            for sy in range(steps):
                line = plane[y0 + sy * shift_step]
                for sx in range(steps):
                    # An unsigned index spares the test for counting from the end.
                    sums[sy, sx] += line[np.uint64(x0 + sx * shift_step)]
        else:
            for sy in range(steps):
                y = y0 + sy * shift_step
                if y < 0 or y >= height:
                    continue
                for sx in range(steps):
                    x = x0 + sx * shift_step
                    if 0 <= x < width:
                        sums[sy, sx] += plane[y, x]
    best = -1
    best_dx = 0
    best_dy = 0
    for sy in range(steps):
        for sx in range(steps):
            if sums[sy, sx] > best:
                best = sums[sy, sx]
                best_dx = sx * shift_step - reach
                best_dy = sy * shift_step - reach
    return best, best_dx, best_dy
