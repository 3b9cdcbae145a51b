"""Pattern search of poses on response maps: tilt, roll and distance step by step, the place by trying shifts.

Coordinate search with shrinking steps (Hooke & Jeeves 1961). The score is the mean response under the projected
outline and design edges: over the whole part at once it is not misled by print or clutter that draws single edge
points away, which gradient methods follow.
"""

from __future__ import annotations

import numpy as np

from arview.core.kernel import kernel
from arview.detection.features.response_maps import best_shift, collect_points
from arview.detection.search.template_bank import (
    SECTORS,
    TRIMMED_SHARE,
    min_adjacent_pair,
    sector_of,
)
from arview.refinement.kernels import nearest_view


@kernel
def pose_score(maps, part, pose, intrinsics, step_mm, contour_count, edge_count, shift_px, shift_step, room, sums):  # type: ignore[no-untyped-def]
    """Mean response 0–1 at a pose and the best shift dx, dy of the picture in px; 0 with too few points.

    Args:
        maps: (8,H,W) from `response_maps`, padded.
        part: arrays of all guide views, see `PartView.arrays`.
        intrinsics: (10,) of the picture that the maps were made from, padding included.
        step_mm: length over which directions are projected.
        contour_count, edge_count: about so many points are looked at.
        shift_px, shift_step: shifts of ± shift_px are tried; ``sums`` (S,S) int32 is room for them.
        room: (3, contour_count + edge_count + 96) int64 to work in.
    """
    view = nearest_view(part[0], pose)
    count = collect_points(part, view, pose, intrinsics, step_mm, contour_count, edge_count, room)
    if count < 16:
        return 0.0, 0, 0
    best, dx, dy = best_shift(maps, room, count, shift_px, shift_step, sums)
    return best / (255.0 * count), dx, dy


@kernel
def _stepped(pose, axis, amount):  # type: ignore[no-untyped-def]
    """A pose turned about axis 0–2 of the camera through the part's centre, or moved in distance (axis 3)."""
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
def search_poses(  # type: ignore[no-untyped-def]
    maps, part, poses, intrinsics, step_mm, turn_step_rad, stretch_step, rounds, halvings, shift_px, shift_step,
    contour_count, edge_count
):  # fmt: skip
    """Improve poses, each by itself.

    Args:
        maps, part, intrinsics, step_mm, contour_count, edge_count, shift_px, shift_step: see `pose_score`.
        poses: (N,4,4) ``cam_from_body``.
        turn_step_rad, stretch_step: first steps of tilt, roll and of the distance as a share.
        rounds: over the four axes before the steps are halved; halvings: how often they are.

    Returns:
        scores (N,) 0–1 and poses (N,4,4).
    """
    steps = 2 * (shift_px // shift_step) + 1
    sums = np.empty((steps, steps), dtype=np.int32)
    room = np.empty((3, contour_count + edge_count + 96), dtype=np.int64)
    scores = np.zeros(poses.shape[0])
    found = poses.copy()
    for n in range(poses.shape[0]):
        pose = poses[n].copy()
        best, dx, dy = pose_score(
            maps, part, pose, intrinsics, step_mm, contour_count, edge_count, shift_px, shift_step, room, sums
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
                            maps, part, trial, intrinsics, step_mm, contour_count, edge_count, shift_px, shift_step,
                            room, sums
                        )  # fmt: skip
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
def outline_score(  # type: ignore[no-untyped-def]
    maps, points, angles, roll, radius_px, nearness, x0, y0, shift_px, shift_step, is_trimmed, room, sums, sectors
):  # fmt: skip
    """Mean response 0–1 of an outline (N,3), (N,) at a roll, size and place, and the best shift dx, dy in px.

    ``is_trimmed`` as in `match_templates`.
    """
    a, b = np.float32(radius_px * np.cos(roll)), np.float32(radius_px * np.sin(roll))
    turn = int(np.round(roll * (256.0 / np.pi))) + 16
    left, top = np.float32(x0 + 0.5), np.float32(y0 + 0.5)
    for i in range(points.shape[0]):
        scale = np.float32(1.0) / (np.float32(1.0) + np.float32(nearness) * points[i, 2])
        x, y = points[i, 0] * scale, points[i, 1] * scale
        room[0, i] = int(np.floor(a * x - b * y + left))
        room[1, i] = int(np.floor(b * x + a * y + top))
        room[2, i] = ((angles[i] + turn) >> 5) & 7
    count = points.shape[0]
    best, dx, dy = best_shift(maps, room, count, shift_px, shift_step, sums)
    if not is_trimmed:
        return best / (255.0 * count), dx, dy
    return _sum_but_a_pair(maps, room, count, dx, dy, sectors) / (255.0 * count * (1.0 - TRIMMED_SHARE)), dx, dy


@kernel
def _sum_but_a_pair(maps, room, count, dx, dy, sums):  # type: ignore[no-untyped-def]
    """Sum of the responses under the points of an outline at a shift, but of the pair of sectors with the least."""
    height, width = maps.shape[1], maps.shape[2]
    sums[:] = 0
    for i in range(count):
        x, y = room[0, i] + dx, room[1, i] + dy
        if 0 <= x < width and 0 <= y < height:
            sums[sector_of(i)] += np.int64(maps[room[2, i], y, x])
    return np.sum(sums) - min_adjacent_pair(sums)


@kernel
def search_outlines(  # type: ignore[no-untyped-def]
    maps, points, angles, neighbours, turns, views, rolls, radii_px, places, focal_px, roll_step_rad, stretch_step,
    rounds, shift_px, shift_step, is_trimmed
):  # fmt: skip
    """Improve matches of outlines, each by itself, in the picture: view, roll, size and place.

    Quicker than `search_poses`: nothing is projected. For matches that are still rough.

    Args:
        maps: (8,H,W) from `response_maps`, padded.
        points, angles: see `ViewOutlines`; neighbours, turns: see `NeighbourViews`.
        views (M,), rolls (M,) rad, radii_px (M,), places (M,2) px of the maps: the matches.
        focal_px: of the maps.
        roll_step_rad, stretch_step: steps of the roll and, as a share, of the size.
        rounds: over all steps.
        shift_px, shift_step: shifts of ± shift_px are tried.
        is_trimmed: see `match_templates`.

    Returns:
        scores (M,) 0–1, views (M,), rolls (M,), radii_px (M,), places (M,2).
    """
    steps = 2 * (shift_px // shift_step) + 1
    sums = np.empty((steps, steps), dtype=np.int32)
    room = np.empty((3, points.shape[1]), dtype=np.int64)
    sectors = np.empty(SECTORS, dtype=np.int64)
    scores = np.empty(len(views))
    views, rolls, radii_px, places = views.copy(), rolls.copy(), radii_px.copy(), places.copy()
    count = neighbours.shape[1]
    for n in range(len(views)):
        view, roll, radius = views[n], rolls[n], radii_px[n]
        best, dx, dy = outline_score(
            maps, points[view], angles[view], roll, radius, radius / focal_px, places[n, 0], places[n, 1],
            shift_px, shift_step, is_trimmed, room, sums, sectors,
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
                    maps, points[v], angles[v], r, s, s / focal_px, x, y, shift_px, shift_step, is_trimmed, room, sums,
                    sectors,
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
