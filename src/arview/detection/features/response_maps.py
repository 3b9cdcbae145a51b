"""Response maps of an image by edge orientation, and the scores of poses on them.

After Hinterstoisser et al., "Gradient Response Maps for Real-Time Detection of Textureless Objects" (PAMI 2012): one
map for each of eight orientations, dilated so that small errors of a pose do not matter. In addition, responses are
normalised by the local contrast, and a share of their mean over all orientations is subtracted, because texture and
clutter respond at every orientation.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.geometry import Array
from arview.refinement import ViewArrays, nearest_view, project_lines
from arview.rendering import EDGE_CONTOUR, EDGE_SHARP

Channel = NDArray[np.float32]

ORIENTATIONS = 8
"""Orientation bins over 180°."""
MEAN_SHARE = 0.5
"""Share of the mean over all orientations that is subtracted from each map."""


def response_maps(image: NDArray[np.uint8], spread_px: int, pad_px: int, pool: int = 1) -> NDArray[np.uint8]:
    """Edge responses of an image by orientation; 255 is a clear edge.

    Args:
        image: (H,W,3) RGB or (H,W) grey, uint8.
        spread_px: radius of the dilation, in pixels of the maps.
        pad_px: empty border of the maps.
        pool: factor by which the maps are smaller than the image. Each of their pixels holds the maximum of its block,
            so that close fine lines keep their orientations.

    Returns:
        (8, H / pool + 2 pad_px, W / pool + 2 pad_px) uint8.
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
    return np.asarray(_subtract_mean(own, pad_px))


def colour_gradients(image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], Channel, Channel, Channel]:
    """The smoothed image, and x, y and magnitude of each pixel's strongest gradient; see `_strongest`."""
    smooth = cv2.GaussianBlur(image, (3, 3), 0)
    planes = cv2.split(smooth)
    gx = np.stack([cv2.Sobel(plane, cv2.CV_16S, 1, 0, ksize=3) for plane in planes])
    gy = np.stack([cv2.Sobel(plane, cv2.CV_16S, 0, 1, ksize=3) for plane in planes])
    x, y, magnitude = _strongest(gx, gy)
    return np.asarray(smooth), x, y, magnitude


@kernel
def _strongest(
    gx: NDArray[np.int16], gy: NDArray[np.int16]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Gradient (H,W) of each pixel's strongest channel (Dalal & Triggs, CVPR 2005), and its size in grey levels."""
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
def _oriented(
    phase: NDArray[np.float32],
    magnitude: NDArray[np.float32],
    around: NDArray[np.float32],
    peak: NDArray[np.float32],
    pool: int,
) -> NDArray[np.uint8]:
    """Strength of thin edges by orientation (8, H / pool, W / pool), relative to the contrast around them.

    An edge between two orientations counts for both.

    Args:
        phase: (H,W) direction of the gradient in rad, 0 to 2π.
        magnitude: (H,W) of the gradient.
        around: (H,W) mean magnitude of the neighbourhood.
        peak: (H,W) maximum of the 3×3 neighbourhood.
        pool: see `response_maps`.
    """
    rows, columns = magnitude.shape[0] // pool, magnitude.shape[1] // pool
    own = np.zeros((ORIENTATIONS, rows, columns), dtype=np.uint8)
    per_rad = np.float32(ORIENTATIONS / np.pi)
    places = np.empty(columns * pool, dtype=np.int32)
    for y in range(rows * pool):
        row = y // pool
        # Thinning: only pixels near the maximum of their neighbourhood lie on the edge.
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
def _subtract_mean(spread: NDArray[np.uint8], pad: int) -> NDArray[np.uint8]:
    """Responses beyond a share of their mean over all orientations, rescaled and padded with zeros."""
    count, height, width = spread.shape
    maps = np.zeros((count, height + 2 * pad, width + 2 * pad), dtype=np.uint8)
    total = np.empty(width, dtype=np.int32)
    # In integers: MEAN_SHARE · mean is sum · MEAN_SHARE / count; the stretch compensates for the subtraction.
    part = np.int32(MEAN_SHARE * 256 / count)
    stretch = np.int32(256 * (1.0 + 0.6 * MEAN_SHARE))
    for y in range(height):
        total[:] = 0
        for o in range(count):
            line = spread[o, y]
            for x in range(width):
                total[x] += np.int32(line[x])
        for x in range(width):
            total[x] = np.int32(total[x] * part) >> np.int32(8)
        for o in range(count):
            # Slices and 32-bit integers throughout, so that the loop is vectorised.
            line, out = spread[o, y], maps[o, y + pad, pad : pad + width]
            for x in range(width):
                value = np.int32((np.int32(line[x]) - total[x]) * stretch) >> np.int32(8)
                out[x] = np.uint8(min(max(value, np.int32(0)), np.int32(255)))
    return maps


def orientation_bins(normals_px: Array) -> NDArray[np.uint8]:
    """Orientation bins (N,) of image normals (N,2); the gradient of an edge points along its normal."""
    position = np.arctan2(normals_px[:, 1], normals_px[:, 0]) / np.pi * ORIENTATIONS
    return (np.round(position).astype(np.intp) % ORIENTATIONS).astype(np.uint8)


@kernel
def collect_points(
    part: ViewArrays,
    view: int,
    pose: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    step_mm: float,
    contour_count: int,
    edge_count: int,
    points: NDArray[np.int64],
) -> int:
    """Project a guide view's outline and design edges, and return the number of points.

    ``points`` (3,N) int64 receives their columns, rows and orientation bins; see `score_around` for the rest.
    """
    count = 0
    for group in range(2):
        if group == 0:
            first, last = part.contour_starts[view], part.contour_starts[view + 1]
            stride = max(1, (last - first) // contour_count)
            limit = contour_count + 32
            px, normals, depths = project_lines(
                part.contour_points[first:last:stride],
                part.contour_normals[first:last:stride],
                False,
                pose,
                intrinsics,
                step_mm,
            )
        else:
            first, last = part.edge_starts[view], part.edge_starts[view + 1]
            stride = max(1, (last - first) // (2 * edge_count))
            limit = points.shape[1]
            px, normals, depths = project_lines(
                part.edge_points[first:last:stride],
                part.edge_tangents[first:last:stride],
                True,
                pose,
                intrinsics,
                step_mm,
            )
        for i in range(px.shape[0]):
            if group == 1:
                kind = part.edge_kinds[first + i * stride]
                if (kind & EDGE_CONTOUR) > 0 or (kind & EDGE_SHARP) == 0:
                    continue
            if depths[i] <= 0 or count >= limit:
                continue
            points[0, count] = int(np.round(px[i, 0]))
            points[1, count] = int(np.round(px[i, 1]))
            turn = np.arctan2(normals[i, 1], normals[i, 0]) / np.pi * ORIENTATIONS
            points[2, count] = int(np.round(turn)) % ORIENTATIONS
            count += 1
    return count


@kernel
def score_around(
    maps: NDArray[np.uint8],
    part: ViewArrays,
    cam_from_body: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    step_mm: float,
    turns: NDArray[np.float64],
    stretches: NDArray[np.float64],
    shift_px: int,
    shift_step: int,
    contour_count: int,
    edge_count: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Score poses around one pose by the responses under their projected outline and design edges.

    Args:
        maps: (8,H,W) of `response_maps`, padded.
        part: arrays of all guide views, see `PartView.arrays`.
        cam_from_body: (4,4) pose to search around.
        intrinsics: (10,) of the maps, padding included.
        step_mm: length over which directions are projected.
        turns: (R,3,3) rotations about the part's centre, in camera axes.
        stretches: (D,) factors of the distance.
        shift_px, shift_step: range and step of the image shifts at which each rotated and moved pose is scored.
        contour_count, edge_count: approximate numbers of outline and design-edge points.

    Returns:
        Scores (R·D,) 0–1 and poses (R·D,4,4) with the best shift applied.
    """
    total = turns.shape[0] * stretches.shape[0]
    scores = np.zeros(total)
    poses = np.zeros((total, 4, 4))
    steps = 2 * (shift_px // shift_step) + 1
    sums = np.empty((steps, steps), dtype=np.int32)
    points = np.empty((3, contour_count + edge_count + 64), dtype=np.int64)
    for t in range(turns.shape[0]):
        pose = cam_from_body.copy()
        for i in range(3):
            for j in range(3):
                pose[i, j] = (
                    turns[t, i, 0] * cam_from_body[0, j]
                    + turns[t, i, 1] * cam_from_body[1, j]
                    + turns[t, i, 2] * cam_from_body[2, j]
                )
        view = nearest_view(part.directions, pose)
        for d in range(stretches.shape[0]):
            index = t * stretches.shape[0] + d
            for i in range(3):
                pose[i, 3] = cam_from_body[i, 3] * stretches[d]
            poses[index] = pose
            count = collect_points(
                part,
                view,
                pose,
                intrinsics=intrinsics,
                step_mm=step_mm,
                contour_count=contour_count,
                edge_count=edge_count,
                points=points,
            )
            if count < 16:
                continue
            best, best_dx, best_dy = best_shift(maps, points, count, shift_px, shift_step, sums)
            scores[index] = best / (255.0 * count)
            poses[index, 0, 3] += best_dx * pose[2, 3] / intrinsics[0]
            poses[index, 1, 3] += best_dy * pose[2, 3] / intrinsics[1]
    return scores, poses


@kernel
def best_shift(
    maps: NDArray[np.uint8],
    points: NDArray[np.int64],
    count: int,
    shift_px: int,
    shift_step: int,
    sums: NDArray[np.int32],
) -> tuple[int, int, int]:
    """Highest sum of responses under the first ``count`` points over all shifts, and that shift dx, dy in px.

    ``points`` is as `collect_points` fills it; ``sums`` (S,S) int32 is a work buffer. Points that a shift moves outside
    the maps add nothing.
    """
    height, width = maps.shape[1], maps.shape[2]
    steps = sums.shape[0]
    reach = shift_px // shift_step * shift_step
    sums[:] = 0
    for i in range(count):
        x0 = points[0, i] - reach
        y0 = points[1, i] - reach
        plane = maps[points[2, i]]
        if x0 >= 0 and y0 >= 0 and x0 + 2 * reach < width and y0 + 2 * reach < height:
            for sy in range(steps):
                line = plane[y0 + sy * shift_step]
                for sx in range(steps):
                    # An unsigned index avoids the check for negative indices.
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
