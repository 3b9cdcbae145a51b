"""Profile ranker: small networks that rank poses by profiles of the image across the part's lines.

The mean response under an outline says how much edge there is, not whether it is one clean edge, whether others cross
it, whether colours change there, or whether a whole stretch of it is missing. Profiles of gradients, colours and edge
responses across each line show all this. The same weights describe every profile; their means over outline and design
edges and the minimum over stretches of the outline make the score (after Qi et al., "PointNet", CVPR 2017). The
networks are not specific to a part: they were trained on random solids before photos, see ``tools/training/fit.py``, by
which of an image's poses is right (Cao et al., "Learning to rank: from pairwise approach to listwise approach", ICML
2007). There is one for rough poses and two for refined poses, which see the part at two sizes.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.core.parallel import pool
from arview.detection.features.edge_net import SOLID_CHANNEL
from arview.detection.features.image_pyramid import ImagePyramid, PyramidLevel, steps_to
from arview.geometry import Array
from arview.refinement import PartView, ViewArrays, nearest_view, project_lines
from arview.rendering import EDGE_CONTOUR, EDGE_SHARP
from arview.weights import load_arrays

ROUGH, FINE = ("rough",), ("fine", "close")
"""Names of the networks for rough and for refined poses."""
RADII_PX = {"rough": 48.0, "fine": 48.0, "close": 96.0}
"""Half the part's diameter in the images that each network sees; images are never enlarged."""
OUTLINE_LINES, INNER_LINES = 48, 32
"""Maximum numbers of lines across the outline and across the design edges inside it."""
STRETCHES = 8
"""Consecutive stretches into which the lines of the outline are divided."""
REACH_PX = 6
"""Reach of a profile to either side of its edge."""
PLACES = 2 * REACH_PX + 1
"""Samples of a profile."""
GRADIENT_NORMAL, GRADIENT_TANGENT = 0, PLACES
"""First features of the gradients along the profile and across it, relative to their mean."""
WIDTHS = 2 * PLACES
"""First of two features: widths of part and background along the profile."""
COLOUR_DIFFERENCES = WIDTHS + 2
"""First of three features: colour difference between both sides, of the inside from the part's mean, and of the outside
from it."""
IS_SEEN, IS_DESIGN_EDGE = WIDTHS + 5, WIDTHS + 6
"""Features that are 1 for a profile in the image, and for one across a design edge."""
EDGE_RESPONSE, SOLID_RESPONSE = WIDTHS + 7, WIDTHS + 7 + PLACES
"""First features of the responses to edges of this orientation and to solids."""
FEATURES = 4 * PLACES + 7
"""Features of a profile."""
RANKER_SCALARS = 6
"""Features of a pose: mean gradient, size, share of the outline in the image, number of design edges, length of the
outline, distinct lines."""
MAX_WIDTH_PX, REFERENCE_RADIUS_PX = 16.0, 48.0
"""Largest width that is distinguished; half diameter relative to which sizes are given."""
REFERENCE_GRADIENT, HALF_COLOUR = 10.0, 40.0
"""Grey levels: unit of the mean gradient; colour difference that gives a feature of one half."""
UPPER_BOUND = np.float32(1e30)
"""Larger than any mean; infinity is undefined under fast arithmetic."""
SIDE_PX = 2
"""Distance from the edge at which the sides of a profile begin."""
MAX_OUTLINE_POINTS, LOG_LINES_WEIGHT = 400, 0.3
"""Outline length that is distinguished at most; factor that brings the logarithm of the lines to the others' scale."""


class RankerLayers(NamedTuple):
    """Weights (in, out) and biases (out,) float32: two layers for each profile, two for the pooled features."""

    first: NDArray[np.float32]
    first_bias: NDArray[np.float32]
    second: NDArray[np.float32]
    second_bias: NDArray[np.float32]
    third: NDArray[np.float32]
    third_bias: NDArray[np.float32]
    last: NDArray[np.float32]
    last_bias: NDArray[np.float32]


class SampledLines(NamedTuple):
    """Evenly spread lines of the view nearest to a pose; the rows of outline and design edges have fixed places.

    Attributes:
        points, directions: (L,3) float32. Outline rows begin at 0, rows of design edges at the maximum number of
            outline rows; directions are normals of the outline and tangents of design edges.
        runs: (outline rows,2) mm that the normal stays on the part and on the background.
        outline_count, inner_count: numbers of rows used.
        outline_length: points of the whole outline.
    """

    points: NDArray[np.float32]
    directions: NDArray[np.float32]
    runs: NDArray[np.float32]
    outline_count: int
    inner_count: int
    outline_length: int


@cache
def ranker_layers(name: str) -> RankerLayers:
    """The layers of the network ``rough``, ``fine`` or ``close``."""
    stored = load_arrays("profile_ranker.npz")
    return RankerLayers(*(stored[f"{name}_{field}"] for field in RankerLayers._fields))


class ProfileRanker:
    """Ranker of the poses of one part.

    Args:
        part: of the poses.
        networks: names of the networks whose scores are added, see `ROUGH` and `FINE`.
    """

    def __init__(self, part: PartView, networks: tuple[str, ...] = ROUGH) -> None:
        self._part = part
        self._networks = networks

    def scores(self, pyramid: ImagePyramid, poses: Array, view_lines: Array) -> Array:
        """Scores (N,) of the poses of one image; their differences are log odds.

        Args:
            pyramid: of the image.
            poses: (N,4,4) ``cam_from_body``.
            view_lines: (N,) distinct lines that the views at the poses show.
        """
        part = self._part
        batches = [
            (name, step, some)
            for name in self._networks
            for step, some in _batches(pyramid, part, poses, RADII_PX[name])
        ]
        list(pool().map(pyramid.level, {step for _, step, _ in batches}))

        def score(batch: tuple[str, int, NDArray[np.intp]]) -> Array:
            name, step, some = batch
            return np.asarray(
                score_profiles(
                    pyramid.level(step),
                    part.resolvable,
                    poses[some],
                    np.log(view_lines[some]),
                    part.views.diameter_mm,
                    ranker_layers(name),
                )
            )

        total = np.zeros(len(poses))
        for (_, _, some), scores in zip(batches, pool().map(score, batches), strict=True):
            total[some] += scores
        return total


def describe_poses(
    pyramid: ImagePyramid, part: PartView, poses: Array, view_lines: Array, radius_px: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Features of poses for training a network: (N, lines, FEATURES) and (N, RANKER_SCALARS); see `ProfileRanker`."""
    profiles = np.empty((len(poses), OUTLINE_LINES + INNER_LINES, FEATURES), dtype=np.float32)
    scalars = np.empty((len(poses), RANKER_SCALARS), dtype=np.float32)
    for step, some in _batches(pyramid, part, poses, radius_px):
        for k in some:
            describe_profiles(
                pyramid.level(step),
                part.resolvable,
                poses[k],
                np.log(view_lines[k]),
                part.views.diameter_mm,
                profiles[k],
                scalars[k],
            )
    return profiles, scalars


def _batches(
    pyramid: ImagePyramid, part: PartView, poses: Array, radius_px: float
) -> list[tuple[int, NDArray[np.intp]]]:
    """Scale steps with the indices of the poses to be scored there, in halves for the threads."""
    steps = steps_to(radius_px, pyramid.radii_px(part.views.diameter_mm, poses))
    halves = [
        (int(step), some) for step in np.unique(steps) for some in np.array_split(np.flatnonzero(steps == step), 2)
    ]
    return [(step, some) for step, some in halves if len(some)]


@kernel(fastmath=True)
def score_profiles(
    level: PyramidLevel,
    part: ViewArrays,
    poses: NDArray[np.float64],
    log_lines: NDArray[np.float64],
    diameter_mm: float,
    layers: RankerLayers,
) -> NDArray[np.float64]:
    """Scores (N,) of poses; see `ProfileRanker.scores`.

    Args:
        level: `PyramidLevel` of the image.
        part: arrays of all guide views, see `PartView.arrays`.
        poses: (N,4,4) ``cam_from_body``.
        log_lines: (N,) logarithm of the distinct lines.
        diameter_mm: of the part.
        layers: `RankerLayers` of one network.
    """
    first, first_bias, second, second_bias, third, third_bias, last, last_bias = layers
    zero = np.float32(0.0)
    width = second.shape[1]
    profiles = np.empty((OUTLINE_LINES + INNER_LINES, FEATURES), dtype=np.float32)
    pooled = np.empty(3 * width + RANKER_SCALARS, dtype=np.float32)
    stretch = np.empty(width, dtype=np.float32)
    scores = np.empty(poses.shape[0])
    for n in range(poses.shape[0]):
        describe_profiles(level, part, poses[n], log_lines[n], diameter_mm, profiles, pooled[3 * width :])
        hidden = np.maximum(np.dot(profiles, first) + first_bias, zero)
        hidden = np.maximum(np.dot(hidden, second) + second_bias, zero)
        pooled[: 2 * width] = zero
        pooled[2 * width : 3 * width] = UPPER_BOUND
        counts = np.zeros(2, dtype=np.float32)
        stretch[:] = zero
        count = np.float32(0.5)
        for i in range(OUTLINE_LINES + INNER_LINES):
            if profiles[i, IS_SEEN] > zero:
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
def describe_profiles(
    level: PyramidLevel,
    part: ViewArrays,
    pose: NDArray[np.float64],
    log_lines: float,
    diameter_mm: float,
    profiles: NDArray[np.float32],
    scalars: NDArray[np.float32],
) -> None:
    """Write the features of a pose to ``profiles`` (L, FEATURES) and ``scalars`` (RANKER_SCALARS,), float32.

    Profiles outside the image are all zero.
    """
    lines = sample_lines(part, pose, OUTLINE_LINES, INNER_LINES)
    profiles[:] = np.float32(0.0)
    sides = np.zeros((profiles.shape[0], 2, 3))
    mean_colour = np.zeros(3)
    step, seen = _sample_profiles(level, lines, pose, 0.01 * diameter_mm, profiles, sides, mean_colour)
    _compare_sides(sides, mean_colour, step, profiles)
    distance_mm = np.sqrt(pose[0, 3] ** 2 + pose[1, 3] ** 2 + pose[2, 3] ** 2)
    scalars[0] = np.log(step / REFERENCE_GRADIENT)
    scalars[1] = np.log(level.intrinsics[0] * 0.5 * diameter_mm / distance_mm / REFERENCE_RADIUS_PX)
    scalars[2] = seen / max(lines.outline_count, 1)
    scalars[3] = lines.inner_count / INNER_LINES
    scalars[4] = min(lines.outline_length, MAX_OUTLINE_POINTS) / MAX_OUTLINE_POINTS
    scalars[5] = LOG_LINES_WEIGHT * log_lines


@kernel(fastmath=True)
def _sample_profiles(
    level: PyramidLevel, lines: SampledLines, pose: NDArray[np.float64], step_mm: float,
    profiles: NDArray[np.float32], sides: NDArray[np.float64], mean_colour: NDArray[np.float64]
) -> tuple[float, int]:  # fmt: skip
    """Sample gradients and responses across all lines, and the colours of their sides.

    Args:
        level: `PyramidLevel` of the image.
        lines: `SampledLines` of the pose.
        pose: (4,4) ``cam_from_body``.
        step_mm: length over which directions are projected.
        profiles: (L, FEATURES) float32, zero before; receives all features but the colour differences.
        sides: (L,2,3), zero before; receives the mean colours inside and outside, or -1 first where a side is missing.
        mean_colour: (3,), zero before; receives the mean colour inside the outline.

    Returns:
        The mean gradient plus 1, and the number of outline profiles in the image.
    """
    gx, gy, colours, responses, intrinsics = level
    height, width = gx.shape
    rows, columns = responses.shape[1:]
    shrunk = columns / width
    points, directions, runs, outline, inner, _ = lines
    outline_px, outline_normals, outline_depths = project_lines(
        points[:outline], directions[:outline], False, pose, intrinsics, step_mm
    )
    inner_px, inner_normals, inner_depths = project_lines(
        points[OUTLINE_LINES : OUTLINE_LINES + inner], directions[OUTLINE_LINES : OUTLINE_LINES + inner], True, pose,
        intrinsics, step_mm,
    )  # fmt: skip
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
        line = profiles[slot]
        line[IS_SEEN] = 1.0
        line[IS_DESIGN_EDGE] = 1.0 if is_inner else 0.0
        turn = int(np.round(np.arctan2(nv, nu) / np.pi * SOLID_CHANNEL)) % SOLID_CHANNEL
        for side in range(2):
            run_px = MAX_WIDTH_PX if is_inner else min(MAX_WIDTH_PX, runs[i, side] * intrinsics[0] / depth)
            line[WIDTHS + side] = run_px / MAX_WIDTH_PX
        counts = np.zeros(2)
        for t in range(-REACH_PX, REACH_PX + 1):
            x, y = int(np.floor(u + t * nu + 0.5)), int(np.floor(v + t * nv + 0.5))
            if not (0 <= x < width and 0 <= y < height):
                continue
            a = abs(gx[y, x] * nu + gy[y, x] * nv)
            b = abs(gx[y, x] * nv - gy[y, x] * nu)
            line[GRADIENT_NORMAL + REACH_PX + t] = a
            line[GRADIENT_TANGENT + REACH_PX + t] = b
            row, column = min(int((y + 0.5) * shrunk), rows - 1), min(int((x + 0.5) * shrunk), columns - 1)
            line[EDGE_RESPONSE + REACH_PX + t] = responses[turn, row, column] / np.float32(255.0)
            line[SOLID_RESPONSE + REACH_PX + t] = responses[SOLID_CHANNEL, row, column] / np.float32(255.0)
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
                mean_colour += sides[slot, 0]
        if min(counts[0], counts[1]) == 0.0:
            sides[slot, 0, 0] = -1.0
    mean_colour /= max(coloured, 1)
    return total / max(places, 1) + 1.0, seen


@kernel(fastmath=True)
def _compare_sides(
    sides: NDArray[np.float64], mean_colour: NDArray[np.float64], step: float, profiles: NDArray[np.float32]
) -> None:
    """Make gradients relative to their mean ``step``, and write the colour differences; see `_sample_profiles`."""
    for slot in range(profiles.shape[0]):
        line = profiles[slot]
        if line[IS_SEEN] == 0.0:
            continue
        for t in range(WIDTHS):
            line[t] = line[t] / (line[t] + step)
        if sides[slot, 0, 0] < 0.0:
            continue
        for k in range(3):
            square = 0.0
            for c in range(3):
                inside, outside = sides[slot, 0, c], sides[slot, 1, c]
                difference = (
                    (inside - outside)
                    if k == 0
                    else (inside - mean_colour[c])
                    if k == 1
                    else (outside - mean_colour[c])
                )
                square += difference**2
            line[COLOUR_DIFFERENCES + k] = np.sqrt(square) / (np.sqrt(square) + HALF_COLOUR)


@kernel
def sample_lines(part: ViewArrays, pose: NDArray[np.float64], max_outline: int, max_inner: int) -> SampledLines:
    """`SampledLines` of the view nearest to a pose, with at most ``max_outline`` and ``max_inner`` rows."""
    view = nearest_view(part.directions, pose)
    points = np.empty((max_outline + max_inner, 3), dtype=np.float32)
    directions = np.empty((max_outline + max_inner, 3), dtype=np.float32)
    runs = np.empty((max_outline, 2), dtype=np.float32)
    first, length = part.contour_starts[view], part.contour_starts[view + 1] - part.contour_starts[view]
    outline = min(max_outline, length)
    for i in range(outline):
        k = first + (i * length) // outline
        points[i], directions[i], runs[i] = part.contour_points[k], part.contour_normals[k], part.contour_runs_mm[k]
    design = 0
    for k in range(part.edge_starts[view], part.edge_starts[view + 1]):
        design += int((part.edge_kinds[k] & EDGE_CONTOUR) == 0 and (part.edge_kinds[k] & EDGE_SHARP) > 0)
    inner, passed = 0, 0
    wanted = min(max_inner, design)
    for k in range(part.edge_starts[view], part.edge_starts[view + 1]):
        if (part.edge_kinds[k] & EDGE_CONTOUR) > 0 or (part.edge_kinds[k] & EDGE_SHARP) == 0:
            continue
        if inner < wanted and passed * wanted >= inner * design:
            points[max_outline + inner], directions[max_outline + inner] = part.edge_points[k], part.edge_tangents[k]
            inner += 1
        passed += 1
    return SampledLines(points, directions, runs, outline, inner, length)
