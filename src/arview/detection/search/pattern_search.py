"""Pattern search of poses on response maps.

Coordinate search with shrinking steps over tilt, roll and distance (Hooke & Jeeves, "Direct search solution of
numerical and statistical problems", JACM 1961); the image position is found by trying all shifts of a small window. The
score is the mean response under the projected outline and design edges. Unlike gradient methods it is not misled by
print or clutter that attracts single edge points.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.detection.features.response_maps import best_shift, collect_points
from arview.detection.search.template_bank import (
    SECTORS,
    TRIMMED_SHARE,
    min_adjacent_pair,
    sector_of,
)
from arview.detection.search.template_matching import visible_score
from arview.refinement import ViewArrays, nearest_view

MAX_OUTLINE_REACH = 1.4
"""Half diameters from the part's centre within which its outline lies in the image; near parts reach beyond 1."""

PROMISING_SHARE = 0.85
"""Share of the best response so far that an outline must have where it is, to be tried with shifts, too."""


@kernel
def pose_score(
    maps: NDArray[np.uint8],
    part: ViewArrays,
    pose: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    step_mm: float,
    contour_count: int,
    edge_count: int,
    shift_px: int,
    shift_step: int,
    buffer: NDArray[np.int64],
    sums: NDArray[np.int32],
) -> tuple[float, int, int]:
    """Mean response 0–1 at a pose, and the best shift dx, dy in px; 0 with too few points.

    Args:
        maps: (8,H,W) of `response_maps`, padded.
        part: arrays of all guide views, see `PartView.arrays`.
        intrinsics: (10,) of the maps, padding included.
        step_mm: length over which directions are projected.
        contour_count, edge_count: approximate numbers of outline and design-edge points.
        shift_px, shift_step: range and step of the shifts.
        buffer: (3, contour_count + edge_count + 96) int64 work buffer.
        sums: (S,S) int32 work buffer for the S² shifts.
    """
    view = nearest_view(part.directions, pose)
    count = collect_points(part, view, pose, intrinsics, step_mm, contour_count, edge_count, buffer)
    if count < 16:
        return 0.0, 0, 0
    best, dx, dy = best_shift(maps, buffer, count, shift_px, shift_step, sums)
    return best / (255.0 * count), dx, dy


@kernel
def _stepped(pose: NDArray[np.float64], axis: int, amount: float) -> NDArray[np.float64]:
    """A pose rotated about camera axis 0–2 through the part's centre, or moved in distance (axis 3)."""
    moved = pose.copy()
    if axis == 3:
        for i in range(3):
            moved[i, 3] = pose[i, 3] * (1.0 + amount)
        return moved
    a, b = (axis + 1) % 3, (axis + 2) % 3
    c, s = np.cos(amount), np.sin(amount)
    for j in range(3):
        moved[a, j] = c * pose[a, j] - s * pose[b, j]
        moved[b, j] = s * pose[a, j] + c * pose[b, j]
    return moved


@kernel
def search_poses(
    maps: NDArray[np.uint8],
    part: ViewArrays,
    poses: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    step_mm: float,
    turn_step_rad: float,
    stretch_step: float,
    rounds: int,
    halvings: int,
    shift_px: int,
    shift_step: int,
    contour_count: int,
    edge_count: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Improve poses independently of each other.

    Args:
        maps, part, intrinsics, step_mm, contour_count, edge_count, shift_px, shift_step: see `pose_score`.
        poses: (N,4,4) ``cam_from_body``.
        turn_step_rad, stretch_step: first steps of the rotations, and of the distance as a share of it.
        rounds: maximum number of passes over the four axes before the steps are halved.
        halvings: number of times that the steps are halved.

    Returns:
        Scores (N,) 0–1 and poses (N,4,4).
    """
    steps = 2 * (shift_px // shift_step) + 1
    sums = np.empty((steps, steps), dtype=np.int32)
    buffer = np.empty((3, contour_count + edge_count + 96), dtype=np.int64)
    scores = np.zeros(poses.shape[0])
    found = poses.copy()
    for n in range(poses.shape[0]):
        pose = poses[n].copy()
        best, dx, dy = pose_score(
            maps, part, pose, intrinsics, step_mm, contour_count, edge_count, shift_px, shift_step, buffer, sums
        )
        pose[0, 3] += dx * pose[2, 3] / intrinsics[0]
        pose[1, 3] += dy * pose[2, 3] / intrinsics[1]
        turn, stretch = turn_step_rad, stretch_step
        for _ in range(halvings + 1):
            for _ in range(rounds):
                has_moved = False
                for axis in range(4):
                    for sign in range(-1, 2, 2):
                        trial = _stepped(pose, axis, sign * (stretch if axis == 3 else turn))
                        score, dx, dy = pose_score(
                            maps,
                            part,
                            trial,
                            intrinsics,
                            step_mm,
                            contour_count,
                            edge_count,
                            shift_px,
                            shift_step,
                            buffer,
                            sums,
                        )
                        if score > best:
                            best = score
                            trial[0, 3] += dx * trial[2, 3] / intrinsics[0]
                            trial[1, 3] += dy * trial[2, 3] / intrinsics[1]
                            pose = trial
                            has_moved = True
                            break
                if not has_moved:
                    break
            turn *= 0.5
            stretch *= 0.5
        scores[n] = best
        found[n] = pose
    return scores, found


@kernel
def outline_score(
    maps: NDArray[np.uint8],
    points: NDArray[np.float32],
    angles: NDArray[np.uint8],
    roll: float,
    radius_px: float,
    nearness: float,
    x0: float,
    y0: float,
    shift_px: int,
    shift_step: int,
    is_trimmed: bool,
    pad_px: int,
    min_cut_px: float,
    floor: float,
    buffer: NDArray[np.int64],
    sums: NDArray[np.int32],
    sectors: NDArray[np.int64],
    best_so_far: float,
) -> tuple[float, int, int]:
    """Mean response 0–1 of an outline at a roll, size and place, and the best shift dx, dy in px.

    Args:
        maps: (8,H,W) of `response_maps`, padded.
        points, angles: (N,3) and (N,) of one outline, see `ViewOutlines`.
        roll: rad.
        radius_px: half the part's diameter in the maps.
        nearness: half the part's diameter relative to its distance.
        x0, y0: place of the part's centre in the maps.
        shift_px, shift_step: range and step of the shifts.
        is_trimmed: see `match_templates`.
        pad_px: empty border of the maps.
        min_cut_px: half diameter from which an outline that reaches into that border is scored by its points inside.
        floor: typical response, see `visible_score`.
        buffer, sums, sectors: work buffers (3,N) int64, (S,S) int32 and (SECTORS,) int64.
        best_so_far: score that is to be exceeded; 0 is returned without shifts where that is unlikely.
    """
    a, b = np.float32(radius_px * np.cos(roll)), np.float32(radius_px * np.sin(roll))
    turn = int(np.round(roll * (256.0 / np.pi))) + 16
    left, top = np.float32(x0 + 0.5), np.float32(y0 + 0.5)
    height, width = maps.shape[1], maps.shape[2]
    unshifted = 0
    for i in range(points.shape[0]):
        scale = np.float32(1.0) / (np.float32(1.0) + np.float32(nearness) * points[i, 2])
        x, y = points[i, 0] * scale, points[i, 1] * scale
        buffer[0, i] = int(np.floor(a * x - b * y + left))
        buffer[1, i] = int(np.floor(b * x + a * y + top))
        buffer[2, i] = ((angles[i] + turn) >> 5) & 7
        column, row = buffer[0, i], buffer[1, i]
        if 0 <= column < width and 0 <= row < height:
            unshifted += int(maps[buffer[2, i], row, column])
    count = points.shape[0]
    counted = count * (1.0 - TRIMMED_SHARE) if is_trimmed else 1.0 * count
    if unshifted < PROMISING_SHARE * best_so_far * 255.0 * counted:
        return 0.0, 0, 0
    best, dx, dy = best_shift(maps, buffer, count, shift_px, shift_step, sums)
    total = 1.0 * (_trimmed_sum(maps, buffer, count, dx, dy, sectors) if is_trimmed else best)
    score = total / (255.0 * counted)
    reach = radius_px * MAX_OUTLINE_REACH + pad_px
    if radius_px < min_cut_px or (reach <= x0 < width - reach and reach <= y0 < height - reach):
        return score, dx, dy
    shown = 0
    for i in range(count):
        x, y = buffer[0, i] + dx, buffer[1, i] + dy
        shown += int(pad_px <= x < width - pad_px and pad_px <= y < height - pad_px)
    return visible_score(score, min(shown / counted, 1.0), floor), dx, dy


@kernel
def _trimmed_sum(
    maps: NDArray[np.uint8], buffer: NDArray[np.int64], count: int, dx: int, dy: int, sums: NDArray[np.int64]
) -> int | np.int64:
    """Sum of the responses under the points of an outline at a shift, without the lowest adjacent pair of sectors."""
    height, width = maps.shape[1], maps.shape[2]
    sums[:] = 0
    for i in range(count):
        x, y = buffer[0, i] + dx, buffer[1, i] + dy
        if 0 <= x < width and 0 <= y < height:
            sums[sector_of(i)] += np.int64(maps[buffer[2, i], y, x])
    return np.sum(sums) - min_adjacent_pair(sums)


@kernel
def search_outlines(
    maps: NDArray[np.uint8], points: NDArray[np.float32], angles: NDArray[np.uint8], neighbours: NDArray[np.int32],
    turns: NDArray[np.float64], views: NDArray[np.int32], rolls: NDArray[np.float64], radii_px: NDArray[np.float64],
    places: NDArray[np.float64], focal_px: float, roll_step_rad: float, stretch_step: float, rounds: int,
    shift_px: int, shift_step: int, is_trimmed: bool, pad_px: int, min_cut_px: float, floor: float
) -> tuple[
    NDArray[np.float64], NDArray[np.int32], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]
]:  # fmt: skip
    """Improve matches of outlines in view, roll, size and place, independently of each other.

    Faster than `search_poses`, because nothing is projected; accurate enough for rough matches.

    Args:
        maps: (8,H,W) of `response_maps`, padded.
        points, angles: see `ViewOutlines`.
        neighbours, turns: views and rolls of `NeighbourViews`.
        views, rolls, radii_px, places: (M,), (M,) rad, (M,) and (M,2) px of the maps: the matches.
        focal_px: of the maps.
        roll_step_rad, stretch_step: steps of the roll, and of the size as a share of it.
        rounds: maximum number of passes over all steps.
        shift_px, shift_step: range and step of the shifts.
        is_trimmed: see `match_templates`.
        pad_px, min_cut_px, floor: see `outline_score`.

    Returns:
        Scores (M,) 0–1, views (M,), rolls (M,), radii_px (M,) and places (M,2).
    """
    steps = 2 * (shift_px // shift_step) + 1
    sums = np.empty((steps, steps), dtype=np.int32)
    buffer = np.empty((3, points.shape[1]), dtype=np.int64)
    sectors = np.empty(SECTORS, dtype=np.int64)
    scores = np.empty(len(views))
    views, rolls, radii_px, places = views.copy(), rolls.copy(), radii_px.copy(), places.copy()
    count = neighbours.shape[1]
    for n in range(len(views)):
        view, roll, radius = views[n], rolls[n], radii_px[n]
        best, dx, dy = outline_score(
            maps, points[view], angles[view], roll, radius, radius / focal_px, places[n, 0], places[n, 1],
            shift_px, shift_step, is_trimmed, pad_px, min_cut_px, floor, buffer, sums, sectors, 0.0,
        )  # fmt: skip
        x, y = places[n, 0] + dx, places[n, 1] + dy
        for _ in range(rounds):
            before = best
            for step in range(4 + count):
                v, r, s = view, roll, radius
                if step < 2:
                    r += roll_step_rad if step == 0 else -roll_step_rad
                elif step < 4:
                    s *= 1.0 + stretch_step if step == 2 else 1.0 / (1.0 + stretch_step)
                else:
                    v = neighbours[view, step - 4]
                    r += turns[view, step - 4]
                score, dx, dy = outline_score(
                    maps, points[v], angles[v], r, s, s / focal_px, x, y,
                    shift_px, shift_step, is_trimmed, pad_px, min_cut_px, floor, buffer, sums, sectors, best,
                )  # fmt: skip
                if score > best:
                    best = score
                    view, roll, radius = v, r, s
                    x += dx
                    y += dy
            if best == before:
                break
        scores[n] = best
        views[n], rolls[n], radii_px[n] = view, roll, radius
        places[n, 0], places[n, 1] = x, y
    return scores, views, rolls, radii_px, places
