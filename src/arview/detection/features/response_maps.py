"""Response maps of a picture by edge orientation, and the scores of poses on them.

After Hinterstoisser et al., "Gradient Response Maps for Real-Time Detection of Textureless Objects" (PAMI 2012): a map
for each of eight orientations, spread so that small errors of a pose do not matter. Own here: responses are
normalised by the local contrast and cleared of what all orientations share, so that texture and clutter, which answer
to everything, do not win.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.geometry import Array
from arview.guideviews.mesh_edges import EDGE_CONTOUR, EDGE_SHARP
from arview.refinement.kernels import nearest_view
from arview.refinement.projection import project_lines

Plane = NDArray[np.float32]

ORIENTATIONS = 8
"""Bins over 180°."""


COMMON = 0.5
"""Share of the mean of all orientations that is taken from each: clutter answers to all of them."""


def response_maps(image: NDArray[np.uint8], spread_px: int, pad_px: int, pool: int = 1) -> NDArray[np.uint8]:
    """(8, H + 2 pad, W + 2 pad) uint8 responses of an RGB or gray picture, 255 = a clear edge of that orientation.

    With ``pool`` the maps are so many times smaller than the picture; each of their pixels has the strongest edge of
    those it stands for: fine lines that lie close keep their directions. ``spread_px`` is in pixels of the maps.
    """
    _, x, y, magnitude = colour_gradients(image)
    phase = cv2.phase(x, y, angleInDegrees=False)
    size = 20 * pool + 1
    around = cv2.boxFilter(magnitude, -1, (size, size), borderType=cv2.BORDER_REFLECT)
    own = _oriented(phase, magnitude, around, cv2.dilate(magnitude, np.ones((3, 3), np.uint8)), pool)
    shape = cv2.MORPH_RECT if spread_px == 1 else cv2.MORPH_ELLIPSE
    kernel = cv2.getStructuringElement(shape, (2 * spread_px + 1, 2 * spread_px + 1))
    for plane in own:
        cv2.dilate(plane, kernel, dst=plane)
    return np.asarray(_without_common(own, pad_px))


def colour_gradients(image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], Plane, Plane, Plane]:
    """The smoothed picture, the gradient x, y of each pixel's strongest channel and its size, see `_strongest`."""
    smooth = cv2.GaussianBlur(image, (3, 3), 0)
    planes = cv2.split(smooth)
    gx = np.stack([cv2.Sobel(plane, cv2.CV_16S, 1, 0, ksize=3) for plane in planes])
    gy = np.stack([cv2.Sobel(plane, cv2.CV_16S, 0, 1, ksize=3) for plane in planes])
    x, y, magnitude = _strongest(gx, gy)
    return np.asarray(smooth), x, y, magnitude


@kernel
def _strongest(gx, gy):  # type: ignore[no-untyped-def]
    """Gradient (H,W) of the channel with the strongest one (Dalal & Triggs 2005), and its magnitude in grey levels."""
    channels, height, width = gx.shape
    x = np.empty((height, width), dtype=np.float32)
    y = np.empty((height, width), dtype=np.float32)
    magnitude = np.empty((height, width), dtype=np.float32)
    for row in range(height):
        a, b, m = x[row], y[row], magnitude[row]
        for column in range(width):
            dx, dy = np.float32(gx[0, row, column]), np.float32(gy[0, row, column])
            a[column], b[column], m[column] = dx, dy, dx * dx + dy * dy
        for c in range(1, channels):
            for column in range(width):
                dx, dy = np.float32(gx[c, row, column]), np.float32(gy[c, row, column])
                square = dx * dx + dy * dy
                is_stronger = square > m[column]
                a[column] = dx if is_stronger else a[column]
                b[column] = dy if is_stronger else b[column]
                m[column] = square if is_stronger else m[column]
        for column in range(width):
            m[column] = np.float32(0.25) * np.sqrt(m[column])
    return x, y, magnitude


@kernel
def _oriented(phase, magnitude, around, peak, pool):  # type: ignore[no-untyped-def]
    """(8, H / pool, W / pool) strength of thin edges by orientation, relative to the contrast around.

    An edge between two orientations counts for both. ``phase`` (H,W) rad, 0 to 2π.
    """
    rows, columns = magnitude.shape[0] // pool, magnitude.shape[1] // pool
    own = np.zeros((ORIENTATIONS, rows, columns), dtype=np.uint8)
    per_rad = np.float32(ORIENTATIONS / np.pi)
    places = np.empty(columns * pool, dtype=np.int32)
    for y in range(rows * pool):
        row = y // pool
        # Thin: only a maximum of the neighbourhood in some direction says where the edge is.
        count = 0
        for x in range(columns * pool):
            m = magnitude[y, x]
            places[count] = x
            count += int((m >= np.float32(0.6) * peak[y, x]) & (m >= np.float32(0.5)))
        for k in range(count):
            x = places[k]
            m = magnitude[y, x]
            strength = np.float32(255.0) * m / (m + around[y, x] + np.float32(3.0))
            position = phase[y, x] * per_rad
            low = int(position)
            share = position - np.float32(low)
            a, b = low % ORIENTATIONS, (low + 1) % ORIENTATIONS
            column = x // pool
            value = np.uint8(strength * min(np.float32(1.0), np.float32(2.0) * (np.float32(1.0) - share)))
            own[a, row, column] = max(own[a, row, column], value)
            value = np.uint8(strength * min(np.float32(1.0), np.float32(2.0) * share))
            own[b, row, column] = max(own[b, row, column], value)
    return own


@kernel
def _without_common(spread, pad):  # type: ignore[no-untyped-def]
    """What an orientation has beyond a share of the mean of all, stretched and padded by zeros."""
    count, height, width = spread.shape
    maps = np.zeros((count, height + 2 * pad, width + 2 * pad), dtype=np.uint8)
    common = np.empty(width, dtype=np.int32)
    # In integers: COMMON · mean is sum · COMMON / count; the stretch makes up for what is taken.
    part = np.int32(COMMON * 256 / count)
    stretch = np.int32(256 * (1.0 + 0.6 * COMMON))
    for y in range(height):
        common[:] = 0
        for o in range(count):
            line = spread[o, y]
            for x in range(width):
                common[x] += np.int32(line[x])
        for x in range(width):
            common[x] = np.int32(common[x] * part) >> np.int32(8)
        for o in range(count):
            # Slices and 32 bits throughout, or the loop is not done several pixels at a time.
            line, out = spread[o, y], maps[o, y + pad, pad : pad + width]
            for x in range(width):
                value = np.int32((np.int32(line[x]) - common[x]) * stretch) >> np.int32(8)
                out[x] = np.uint8(min(max(value, np.int32(0)), np.int32(255)))
    return maps


def orientation_bins(normals_px: Array) -> NDArray[np.uint8]:
    """Orientation bin (N,) of image normals (N,2); the gradient of an edge runs along its normal."""
    position = np.arctan2(normals_px[:, 1], normals_px[:, 0]) / np.pi * ORIENTATIONS
    return (np.round(position).astype(np.intp) % ORIENTATIONS).astype(np.uint8)


@kernel
def collect_points(part, view, pose, intrinsics, step_mm, contour_count, edge_count, room):  # type: ignore[no-untyped-def]
    """Project a guide view's outline and design edges; returns the number of points.

    ``room`` (3,N) int64 becomes their columns, rows and orientation bins; see `score_around` for the rest.
    """
    _, c_start, c_points, c_normals, _, e_start, e_points, e_tangents, e_kinds = part
    count = 0
    for group in range(2):
        if group == 0:
            first, last = c_start[view], c_start[view + 1]
            stride = max(1, (last - first) // contour_count)
            limit = contour_count + 32
            px, normals, depths = project_lines(
                c_points[first:last:stride], c_normals[first:last:stride], False, pose, intrinsics, step_mm
            )
        else:
            first, last = e_start[view], e_start[view + 1]
            stride = max(1, (last - first) // (2 * edge_count))
            limit = room.shape[1]
            px, normals, depths = project_lines(
                e_points[first:last:stride], e_tangents[first:last:stride], True, pose, intrinsics, step_mm
            )
        for i in range(px.shape[0]):
            if group == 1:
                kind = e_kinds[first + i * stride]
                if (kind & EDGE_CONTOUR) > 0 or (kind & EDGE_SHARP) == 0:
                    continue
            if depths[i] <= 0 or count >= limit:
                continue
            room[0, count] = int(np.round(px[i, 0]))
            room[1, count] = int(np.round(px[i, 1]))
            turn = np.arctan2(normals[i, 1], normals[i, 0]) / np.pi * ORIENTATIONS
            room[2, count] = int(np.round(turn)) % ORIENTATIONS
            count += 1
    return count


@kernel
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
    total = turns.shape[0] * stretches.shape[0]
    scores = np.zeros(total)
    poses = np.zeros((total, 4, 4))
    steps = 2 * (shift_px // shift_step) + 1
    sums = np.empty((steps, steps), dtype=np.int32)
    room = np.empty((3, contour_count + edge_count + 64), dtype=np.int64)
    for t in range(turns.shape[0]):
        pose = cam_from_body.copy()
        for i in range(3):
            for j in range(3):
                pose[i, j] = (
                    turns[t, i, 0] * cam_from_body[0, j]
                    + turns[t, i, 1] * cam_from_body[1, j]
                    + turns[t, i, 2] * cam_from_body[2, j]
                )
        view = nearest_view(part[0], pose)
        for d in range(stretches.shape[0]):
            index = t * stretches.shape[0] + d
            for i in range(3):
                pose[i, 3] = cam_from_body[i, 3] * stretches[d]
            poses[index] = pose
            count = collect_points(part, view, pose, intrinsics, step_mm, contour_count, edge_count, room)
            if count < 16:
                continue
            best, best_dx, best_dy = best_shift(maps, room, count, shift_px, shift_step, sums)
            scores[index] = best / (255.0 * count)
            poses[index, 0, 3] += best_dx * pose[2, 3] / intrinsics[0]
            poses[index, 1, 3] += best_dy * pose[2, 3] / intrinsics[1]
    return scores, poses


@kernel
def best_shift(maps, room, count, shift_px, shift_step, sums):  # type: ignore[no-untyped-def]
    """Highest sum of responses under the first ``count`` points over all shifts, and that shift dx, dy in px.

    ``room`` holds the points, see `collect_points`; ``sums`` (S,S) int32 is room to work in. Points that a shift moves
    outside the maps add nothing.
    """
    height, width = maps.shape[1], maps.shape[2]
    steps = sums.shape[0]
    reach = shift_px // shift_step * shift_step
    sums[:] = 0
    for i in range(count):
        x0 = room[0, i] - reach
        y0 = room[1, i] - reach
        plane = maps[room[2, i]]
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
