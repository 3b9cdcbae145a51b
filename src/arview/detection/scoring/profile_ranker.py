"""A judge of poses: what is seen across the part's lines, weighed by small networks.

The mean response under an outline says how much edge there is, not what it looks like: whether it is one clean edge or
one of many, whether other edges cross it, whether the part is of one colour along it and its surroundings are not, and
whether a whole stretch of the outline has nothing. All that is in the profiles across the lines, of gradients, of
colours, and of what the line network sees. The same few weights look at each line's profile; the means over the outline
and over the design edges, and the least of any stretch of the outline, make the score (after Qi et al., "PointNet",
CVPR 2017). The weights know nothing of a part: they were fitted on random solids before photos, see
``tools/training/fit.py``, by which of a picture's poses is the right one (Cao et al., "Learning to rank: from pairwise
approach to listwise approach", ICML 2007). There are three: for rough poses, and two for refined ones, which look at
the part at two sizes.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.core.parallel import pool
from arview.detection.features.edge_net import INSIDE
from arview.detection.features.image_pyramid import ImagePyramid, steps_to
from arview.geometry import Array
from arview.guideviews.mesh_edges import EDGE_CONTOUR, EDGE_SHARP
from arview.refinement.kernels import nearest_view
from arview.refinement.projection import project_lines
from arview.refinement.view_model import PartView
from arview.weights import load_arrays

ROUGH, FINE = ("rough",), ("fine", "close")
"""The networks for rough and for refined poses."""
RADII_PX = {"rough": 48.0, "fine": 48.0, "close": 96.0}
"""Half the part's diameter in the pictures that each looks at; nothing is enlarged."""
OUTLINE_LINES, INNER_LINES = 48, 32
"""At most so many lines across the outline and across the design edges inside are looked at."""
STRETCHES = 8
"""Parts of the outline, one after the other."""
REACH_PX = 6
"""Profiles reach so far to both sides."""
PLACES = 2 * REACH_PX + 1
FEATURES = 4 * PLACES + 7
"""Of each line: gradients along and across it at each place, widths of the part and of the background along it,
differences of colour (between both sides, inside from the part's mean, outside from it), 1, 1 if a design edge; what
the line network says at each place of lines like this one and of solids."""
SEEN = 2 * PLACES + 5
"""The feature that is 1."""
GLOBALS = 6
"""Of the pose: mean gradient, size, share of the outline in the picture, design edges, length of the outline, lines."""
WIDEST_PX, SIZE_PX = 16.0, 48.0
HALF_STEP, HALF_COLOUR = 10.0, 40.0
"""Grey levels: the unit of the mean gradient; the difference of colours that counts half."""
MOST = np.float32(1e30)
"""More than any mean; fast arithmetic knows no infinity."""
SIDE_PX = 2
"""The sides of a line begin so far from it."""
LONGEST, LINES_WEIGHT = 400, 0.3
"""ViewOutlines of more points count as such of so many; what brings the logarithm of the lines to the others' size."""


class Network(NamedTuple):
    """Weights (in, out) and biases (out,) of its layers, float32: two for each line, two for all together."""

    first: NDArray[np.float32]
    first_bias: NDArray[np.float32]
    second: NDArray[np.float32]
    second_bias: NDArray[np.float32]
    third: NDArray[np.float32]
    third_bias: NDArray[np.float32]
    last: NDArray[np.float32]
    last_bias: NDArray[np.float32]


@cache
def network(name: str) -> Network:
    """A network as fitted."""
    stored = load_arrays("profile_ranker.npz")
    return Network(*(stored[f"{name}_{field}"] for field in Network._fields))


def judge(
    picture: ImagePyramid, part: PartView, poses: Array, view_lines: Array, networks: tuple[str, ...] = ROUGH
) -> Array:
    """How much likelier than others each of a picture's poses is: differences are log odds.

    Args:
        picture, part: what is looked for, and where.
        poses: (N,4,4) ``cam_from_body``.
        view_lines: (N,) distinct lines that the views at them show.
        networks: whose scores are added.

    Returns:
        (N,) scores.
    """
    looks = [(name, step, some) for name in networks for step, some in _looks(picture, part, poses, RADII_PX[name])]
    list(pool().map(picture.gradients, {step for _, step, _ in looks}))

    def score(look: tuple[str, int, NDArray[np.intp]]) -> Array:
        name, step, some = look
        return np.asarray(
            score_profiles(
                picture.gradients(step), part.distinct, poses[some], np.log(view_lines[some]), part.views.diameter_mm,
                network(name),
            )
        )  # fmt: skip

    total = np.zeros(len(poses))
    for (_, _, some), scores in zip(looks, pool().map(score, looks), strict=True):
        total[some] += scores
    return total


def describe_poses(
    picture: ImagePyramid, part: PartView, poses: Array, view_lines: Array, radius_px: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What a network is shown of poses, to fit it: (N, lines, FEATURES) and (N, GLOBALS); see `judge`."""
    lines = np.empty((len(poses), OUTLINE_LINES + INNER_LINES, FEATURES), dtype=np.float32)
    both = np.empty((len(poses), GLOBALS), dtype=np.float32)
    for step, some in _looks(picture, part, poses, radius_px):
        for k in some:
            describe_profiles(
                picture.gradients(step), part.distinct, poses[k], np.log(view_lines[k]), part.views.diameter_mm,
                lines[k], both[k],
            )  # fmt: skip
    return lines, both


def _looks(picture: ImagePyramid, part: PartView, poses: Array, radius_px: float) -> list[tuple[int, NDArray[np.intp]]]:
    """Scale steps with the poses to be looked at there, in halves."""
    steps = steps_to(radius_px, picture.radii_px(part.views.diameter_mm, poses))
    halves = [
        (int(step), some) for step in np.unique(steps) for some in np.array_split(np.flatnonzero(steps == step), 2)
    ]
    return [(step, some) for step, some in halves if len(some)]


@kernel(fastmath=True)
def score_profiles(gradients, part, poses, log_lines, diameter_mm, weights):  # type: ignore[no-untyped-def]
    """Scores (N,), see `judge`; ``part`` as in `PartView.arrays`, ``weights`` a `Network`."""
    first, first_bias, second, second_bias, third, third_bias, last, last_bias = weights
    zero = np.float32(0.0)
    width = second.shape[1]
    lines = np.empty((OUTLINE_LINES + INNER_LINES, FEATURES), dtype=np.float32)
    pooled = np.empty(3 * width + GLOBALS, dtype=np.float32)
    stretch = np.empty(width, dtype=np.float32)
    scores = np.empty(poses.shape[0])
    for n in range(poses.shape[0]):
        describe_profiles(gradients, part, poses[n], log_lines[n], diameter_mm, lines, pooled[3 * width :])
        hidden = np.maximum(np.dot(lines, first) + first_bias, zero)
        hidden = np.maximum(np.dot(hidden, second) + second_bias, zero)
        pooled[: 2 * width] = zero
        pooled[2 * width : 3 * width] = MOST
        counts = np.zeros(2, dtype=np.float32)
        stretch[:] = zero
        count = np.float32(0.5)
        for i in range(OUTLINE_LINES + INNER_LINES):
            if lines[i, SEEN] > zero:
                group = 0 if i < OUTLINE_LINES else 1
                counts[group] += np.float32(1.0)
                count += np.float32(1.0)
                for k in range(width):
                    pooled[group * width + k] += hidden[i, k]
                    stretch[k] += hidden[i, k]
            if i < OUTLINE_LINES and (i + 1) % (OUTLINE_LINES // STRETCHES) == 0:
                for k in range(width):
                    pooled[2 * width + k] = min(pooled[2 * width + k], stretch[k] / count)
                    stretch[k] = zero
                count = np.float32(0.5)
        for k in range(2 * width):
            pooled[k] /= counts[k // width] + np.float32(1.0)
        scores[n] = np.dot(np.maximum(np.dot(pooled, third) + third_bias, zero), last)[0] + last_bias[0]
    return scores


@kernel(fastmath=True)
def describe_profiles(gradients, part, pose, log_lines, diameter_mm, lines, both):  # type: ignore[no-untyped-def]
    """Write what the network is shown of a pose to ``lines`` (L, FEATURES) and ``both`` (GLOBALS,), float32.

    Lines outside the picture are all zero.
    """
    gx, gy, colours, answers, intrinsics = gradients
    height, width = gx.shape
    rows, columns = answers.shape[1:]
    shrunk = columns / width
    along = 2 * PLACES
    answered = SEEN + 2
    points, directions, runs, outline, inner, length = sample_lines(part, pose, OUTLINE_LINES, INNER_LINES)
    step_mm = 0.01 * diameter_mm
    outline_px, outline_normals, outline_depths = project_lines(
        points[:outline], directions[:outline], False, pose, intrinsics, step_mm
    )
    inner_px, inner_normals, inner_depths = project_lines(
        points[OUTLINE_LINES : OUTLINE_LINES + inner], directions[OUTLINE_LINES : OUTLINE_LINES + inner], True, pose,
        intrinsics, step_mm,
    )  # fmt: skip
    lines[:] = np.float32(0.0)
    sides = np.zeros((lines.shape[0], 2, 3))
    mean = np.zeros(3)
    total, places, seen, coloured = 0.0, 0, 0, 0
    for i in range(outline + inner):
        is_inner = i >= outline
        k = i - outline if is_inner else i
        slot = OUTLINE_LINES + k if is_inner else i
        u, v = (inner_px[k, 0], inner_px[k, 1]) if is_inner else (outline_px[k, 0], outline_px[k, 1])
        nu, nv = (
            (inner_normals[k, 0], inner_normals[k, 1]) if is_inner else (outline_normals[k, 0], outline_normals[k, 1])
        )
        depth = inner_depths[k] if is_inner else outline_depths[k]
        if depth <= 0.0 or not (0 <= int(np.floor(u + 0.5)) < width and 0 <= int(np.floor(v + 0.5)) < height):
            continue
        line = lines[slot]
        line[SEEN] = 1.0
        line[SEEN + 1] = 1.0 if is_inner else 0.0
        turn = int(np.round(np.arctan2(nv, nu) / np.pi * INSIDE)) % INSIDE
        for side in range(2):
            run_px = WIDEST_PX if is_inner else min(WIDEST_PX, runs[i, side] * intrinsics[0] / depth)
            line[along + side] = run_px / WIDEST_PX
        counts = np.zeros(2)
        for t in range(-REACH_PX, REACH_PX + 1):
            x, y = int(np.floor(u + t * nu + 0.5)), int(np.floor(v + t * nv + 0.5))
            if not (0 <= x < width and 0 <= y < height):
                continue
            a = abs(gx[y, x] * nu + gy[y, x] * nv)
            b = abs(gx[y, x] * nv - gy[y, x] * nu)
            line[REACH_PX + t] = a
            line[PLACES + REACH_PX + t] = b
            row, column = min(int((y + 0.5) * shrunk), rows - 1), min(int((x + 0.5) * shrunk), columns - 1)
            line[answered + REACH_PX + t] = answers[turn, row, column] / np.float32(255.0)
            line[answered + PLACES + REACH_PX + t] = answers[INSIDE, row, column] / np.float32(255.0)
            total += a + b
            places += 1
            if abs(t) >= SIDE_PX:
                side = 0 if t < 0 else 1
                counts[side] += 1.0
                for c in range(3):
                    sides[slot, side, c] += colours[y, x, c]
        for side in range(2):
            if counts[side] > 0.0:
                sides[slot, side] /= counts[side]
        if not is_inner:
            seen += 1
            if counts[0] > 0.0:
                coloured += 1
                mean += sides[slot, 0]
        if min(counts[0], counts[1]) == 0.0:
            sides[slot, 0, 0] = -1.0
    mean /= max(coloured, 1)
    step = total / max(places, 1) + 1.0
    for slot in range(lines.shape[0]):
        line = lines[slot]
        if line[SEEN] == 0.0:
            continue
        for t in range(along):
            line[t] = line[t] / (line[t] + step)
        if sides[slot, 0, 0] < 0.0:
            continue
        for k in range(3):
            square = 0.0
            for c in range(3):
                inside, outside = sides[slot, 0, c], sides[slot, 1, c]
                square += ((inside - outside) if k == 0 else (inside - mean[c]) if k == 1 else (outside - mean[c])) ** 2
            line[along + 2 + k] = np.sqrt(square) / (np.sqrt(square) + HALF_COLOUR)
    distance_mm = np.sqrt(pose[0, 3] ** 2 + pose[1, 3] ** 2 + pose[2, 3] ** 2)
    both[0] = np.log(step / HALF_STEP)
    both[1] = np.log(intrinsics[0] * 0.5 * diameter_mm / distance_mm / SIZE_PX)
    both[2] = seen / max(outline, 1)
    both[3] = inner / INNER_LINES
    both[4] = min(length, LONGEST) / LONGEST
    both[5] = LINES_WEIGHT * log_lines


@kernel
def sample_lines(part, pose, most_outline, most_inner):  # type: ignore[no-untyped-def]
    """Evenly spread lines of the nearest view: points and directions (L,3), runs (L,2), how many are of the outline.

    The last two: how many are design edges, which begin at ``most_outline``; how many points the outline has in all.
    """
    directions, c_start, c_points, c_normals, c_runs, e_start, e_points, e_tangents, e_kinds = part
    view = nearest_view(directions, pose)
    points = np.empty((most_outline + most_inner, 3), dtype=np.float32)
    across = np.empty((most_outline + most_inner, 3), dtype=np.float32)
    runs = np.empty((most_outline, 2), dtype=np.float32)
    first, length = c_start[view], c_start[view + 1] - c_start[view]
    outline = min(most_outline, length)
    for i in range(outline):
        k = first + (i * length) // outline
        points[i], across[i], runs[i] = c_points[k], c_normals[k], c_runs[k]
    design = 0
    for k in range(e_start[view], e_start[view + 1]):
        design += int((e_kinds[k] & EDGE_CONTOUR) == 0 and (e_kinds[k] & EDGE_SHARP) > 0)
    inner, passed = 0, 0
    wanted = min(most_inner, design)
    for k in range(e_start[view], e_start[view + 1]):
        if (e_kinds[k] & EDGE_CONTOUR) > 0 or (e_kinds[k] & EDGE_SHARP) == 0:
            continue
        if inner < wanted and passed * wanted >= inner * design:
            points[most_outline + inner], across[most_outline + inner] = e_points[k], e_tangents[k]
            inner += 1
        passed += 1
    return points, across, runs, outline, inner, length
