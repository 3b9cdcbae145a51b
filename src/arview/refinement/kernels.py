"""Kernels of the refinement: the stages of a pose, its evidence, and its colours, each as one compiled call."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.refinement.evidence import edge_evidence, region_evidence
from arview.refinement.gauss_newton import apply_twist, solve_step, trust_in
from arview.refinement.modalities.edge import HYPOTHESES, EdgeProfiles, add_edges, measure_edges, weigh_by_color
from arview.refinement.modalities.region import (
    ColorModel,
    RegionLines,
    add_histograms,
    add_region,
    log_odds,
    measure_region,
)
from arview.refinement.modalities.texture import TextureMatches
from arview.refinement.modalities.texture_matching import add_matches
from arview.refinement.projection import ProjectedLines, ViewArrays, project_lines
from arview.refinement.schedules import StageTable
from arview.rendering import EDGE_CONTOUR, EDGE_SHARP

STRENGTH_HALF = 15.0
"""Strength of an edge step, in grey levels over two pixels, that has half the weight of a very strong one."""
SETTLED_PX = 0.1
"""Last move of the part, px of the picture, up to which no stage follows that would begin anew with coarser ones."""
EVIDENCE_REACH, EVIDENCE_STEP_PX = 10, 1.0
"""Samples to either side of an edge, and their distance, in the profiles of the evidence."""
EVIDENCE_SCALE, EVIDENCE_REGION_PX = 2, 2.0
"""Pixels per segment, and tolerated displacement, of the lines across the outline in the evidence."""
MIN_HISTOGRAM_COUNT = 50
"""Pixels needed on either side of the outline to learn colours."""
HISTOGRAM_REACH_PX, HISTOGRAM_GAP_PX = 20.0, 1.5
"""Pixels counted to either side of the outline, and left out beside it, in the colour histograms."""

STEP_SHARE = 0.01
"""Length, in diameters, by which the projections of normals and tangents are measured."""


class ModalityWeights(NamedTuple):
    """Weights of the modalities; a weight of 0 leaves a modality out. See `RefinerOptions`."""

    region: float
    edge: float
    edge_sigma_px: float
    edge_threshold: float
    texture_sigma_px: float


class EvidenceTerms(NamedTuple):
    """The attributes of `PoseEvidence`, in the form of a kernel's result."""

    contour_support: float
    inner_support: float
    inner_share: float
    sharpness: float
    region_support: float
    region_information: float
    points_in_picture: float
    scatter_px: float


class ViewLines(NamedTuple):
    """Points of the nearest guide view, and their projections.

    Attributes:
        contour: (C,3) contour points in the body frame.
        contour_runs_mm: (C,2) see `ViewArrays`.
        contour_lines: `ProjectedLines` of the contour points and their normals.
        edges: (E,3) edge points in the body frame.
        edge_kinds: (E,) EDGE_* bits.
        edge_lines: `ProjectedLines` of the edge points and the normals of their edges.
    """

    contour: NDArray[np.float32]
    contour_runs_mm: NDArray[np.float32]
    contour_lines: ProjectedLines
    edges: NDArray[np.float32]
    edge_kinds: NDArray[np.uint8]
    edge_lines: ProjectedLines


@kernel
def nearest_view(directions: NDArray[np.float64], cam_from_body: NDArray[np.float64]) -> int:
    """Index of the view whose direction (N,3) is nearest to that of the camera."""
    r = cam_from_body
    x = -(r[0, 0] * r[0, 3] + r[1, 0] * r[1, 3] + r[2, 0] * r[2, 3])
    y = -(r[0, 1] * r[0, 3] + r[1, 1] * r[1, 3] + r[2, 1] * r[2, 3])
    z = -(r[0, 2] * r[0, 3] + r[1, 2] * r[1, 3] + r[2, 2] * r[2, 3])
    best = -1e300
    index = 0
    for i in range(directions.shape[0]):
        along = directions[i, 0] * x + directions[i, 1] * y + directions[i, 2] * z
        if along > best:
            best = along
            index = i
    return index


@kernel
def run_stages(
    image: NDArray[np.uint8], gray: NDArray[np.uint8], colors: ColorModel, part: ViewArrays,
    cam_from_body: NDArray[np.float64], intrinsics: NDArray[np.float64], step_mm: float, stages: StageTable,
    damping: NDArray[np.float64], weights: ModalityWeights, matches: TextureMatches
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:  # fmt: skip
    """Refine a pose through some stages.

    Args:
        image: (H,W,3) uint8 RGB.
        gray: (H,W) uint8, smoothed.
        colors: `ColorModel`.
        part: `ViewArrays`.
        cam_from_body: (4,4) start.
        intrinsics: as of `intrinsics_of`.
        step_mm: length along a normal or tangent by which its projection is measured.
        stages: `StageTable`.
        damping: (6,) diagonal that holds every update towards no change, as in `solve_step`.
        weights: `ModalityWeights`.
        matches: `TextureMatches`; without any match texture is left out.

    Returns:
        cam_from_body (4,4) and information (6,6) of the twist on its right.
    """
    pose = cam_from_body.copy()
    hessian = np.zeros((6, 6))
    gradient = np.zeros(6)
    twist = np.zeros(6)
    for s in range(stages.stride.shape[0]):
        stride = stages.stride[s]
        region_weight = weights.region * stages.region_gain[s] * stride
        edge_weight = weights.edge * stride
        spread_px = stages.edge_spread_px[s]
        view = _project_view(part, pose, intrinsics, step_mm, stride)
        region = _measure_contour(image, colors, view, intrinsics, stages.region_scale[s], region_weight > 0)
        profiles = _measure_profiles(
            gray, view, stages.edge_reach[s], stages.edge_step_px[s], weights.edge_threshold, intrinsics[10],
            is_used=edge_weight > 0,
        )  # fmt: skip
        if edge_weight > 0 and weights.region > 0:
            weigh_by_color(image, colors, view.edge_lines, view.edge_kinds, profiles, intrinsics[10])
        trust = 1.0
        for update in range(stages.updates[s]):
            hessian[:] = 0.0
            gradient[:] = 0.0
            if region_weight > 0:
                squares, count = add_region(
                    hessian, gradient, view.contour, pose, intrinsics, view.contour_lines, region, region_weight,
                    3.0 * stages.region_scale[s],
                )  # fmt: skip
                if update == 0:
                    trust = trust_in(hessian, gradient, squares, count, region_weight)
                hessian *= trust
                gradient *= trust
            if edge_weight > 0:
                add_edges(
                    hessian, gradient, view.edges, view.edge_kinds, pose, intrinsics, view.edge_lines, profiles,
                    STRENGTH_HALF, weights.edge_sigma_px * max(1.0, 0.5 * spread_px), spread_px, edge_weight,
                )  # fmt: skip
            if matches.weights.shape[0] > 0:
                add_matches(
                    hessian, gradient, matches.points_in_body, pose, intrinsics, matches.pixels, matches.weights,
                    weights.texture_sigma_px, max(4.0, 2.0 * spread_px),
                )  # fmt: skip
            twist = solve_step(hessian, gradient, damping)
            pose = apply_twist(pose, twist)
        is_finest = s + 1 < stages.stride.shape[0] and stages.edge_spread_px[s + 1] > spread_px
        if is_finest and _move_px(twist, pose, intrinsics, step_mm) < SETTLED_PX:
            break
    _fill_upper(hessian)
    _orthonormalize(pose)
    return pose, hessian


@kernel
def _move_px(
    twist: NDArray[np.float64], pose: NDArray[np.float64], intrinsics: NDArray[np.float64], step_mm: float
) -> float:
    """Largest move of a point of the part in the picture by a twist (6,)."""
    radius_mm = 0.5 * step_mm / STEP_SHARE
    turn, shift = (twist[:3] * twist[:3]).sum(), (twist[3:] * twist[3:]).sum()
    return intrinsics[0] / max(pose[2, 3], 1.0) * (np.sqrt(turn) * radius_mm + np.sqrt(shift))


@kernel
def _project_view(
    part: ViewArrays, pose: NDArray[np.float64], intrinsics: NDArray[np.float64], step_mm: float, stride: int
) -> ViewLines:
    """`ViewLines` of every ``stride``-th point of the nearest view at a pose."""
    view = nearest_view(part.directions, pose)
    first, last = part.contour_starts[view], part.contour_starts[view + 1]
    contour = part.contour_points[first:last:stride]
    normals = part.contour_normals[first:last:stride]
    runs_mm = part.contour_runs_mm[first:last:stride]
    contour_lines = project_lines(contour, normals, False, pose, intrinsics, step_mm)
    first, last = part.edge_starts[view], part.edge_starts[view + 1]
    edges = part.edge_points[first:last:stride]
    tangents = part.edge_tangents[first:last:stride]
    kinds = part.edge_kinds[first:last:stride]
    edge_lines = project_lines(edges, tangents, True, pose, intrinsics, step_mm)
    return ViewLines(contour, runs_mm, contour_lines, edges, kinds, edge_lines)


@kernel
def _measure_contour(
    image: NDArray[np.uint8], colors: ColorModel, view: ViewLines, intrinsics: NDArray[np.float64], scale: int,
    is_used: bool,
) -> RegionLines:  # fmt: skip
    """`RegionLines` of the contour; empty without the region modality."""
    if is_used:
        return measure_region(image, colors, view.contour_lines, view.contour_runs_mm, intrinsics, scale)
    return RegionLines(np.zeros(0), np.zeros(0), np.zeros(0))


@kernel
def _measure_profiles(
    gray: NDArray[np.uint8],
    view: ViewLines,
    reach: int,
    step_px: float,
    threshold: float,
    pitch: float,
    is_used: bool,
) -> EdgeProfiles:
    """`EdgeProfiles` of the edges; empty without the edge modality."""
    if is_used:
        return measure_edges(gray, view.edge_lines, reach, step_px, threshold, pitch)
    return EdgeProfiles(np.zeros((0, HYPOTHESES)), np.zeros((0, HYPOTHESES)), np.zeros(0, dtype=np.bool_))


@kernel
def _fill_upper(matrix: NDArray[np.float64]) -> None:
    """Mirror the lower triangle of a matrix (6,6)."""
    for i in range(6):
        for j in range(i):
            matrix[j, i] = matrix[i, j]


@kernel
def _orthonormalize(pose: NDArray[np.float64]) -> None:
    """Make the rotation of a pose (4,4) orthonormal again: Gram-Schmidt over its rows."""
    for i in range(3):
        for j in range(i):
            dot = pose[i, 0] * pose[j, 0] + pose[i, 1] * pose[j, 1] + pose[i, 2] * pose[j, 2]
            for k in range(3):
                pose[i, k] -= dot * pose[j, k]
        norm = np.sqrt(pose[i, 0] ** 2 + pose[i, 1] ** 2 + pose[i, 2] ** 2)
        for k in range(3):
            pose[i, k] /= norm


@kernel
def run_evidence(
    image: NDArray[np.uint8],
    gray: NDArray[np.uint8],
    colors: ColorModel,
    has_colors: bool,
    part: ViewArrays,
    cam_from_body: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    step_mm: float,
    edge_threshold: float,
    tolerance_px: float,
) -> EvidenceTerms:
    """`EvidenceTerms` of the picture for a pose; arguments as of `run_stages`.

    Args:
        has_colors: whether ``colors`` have been learned.
        tolerance_px: steps at most this far from an edge support it.
    """
    view = nearest_view(part.directions, cam_from_body)
    first, last = part.edge_starts[view], part.edge_starts[view + 1]
    points, tangents = part.edge_points[first:last], part.edge_tangents[first:last]
    lines = project_lines(points, tangents, True, cam_from_body, intrinsics, step_mm)
    profiles = measure_edges(gray, lines, EVIDENCE_REACH, EVIDENCE_STEP_PX, edge_threshold, intrinsics[10])
    edges = edge_evidence(profiles, part.edge_kinds[first:last], EVIDENCE_REACH * EVIDENCE_STEP_PX, tolerance_px)
    region_support, region_information = -1.0, 0.0
    if has_colors:
        first, last = part.contour_starts[view], part.contour_starts[view + 1]
        lines = project_lines(
            part.contour_points[first:last], part.contour_normals[first:last], False, cam_from_body, intrinsics, step_mm
        )
        runs_mm = part.contour_runs_mm[first:last]
        region = measure_region(image, colors, lines, runs_mm, intrinsics, EVIDENCE_SCALE)
        terms = region_evidence(region, EVIDENCE_REGION_PX)
        region_support, region_information = terms.region_support, terms.region_information
    return EvidenceTerms(
        edges.contour_support,
        edges.inner_support,
        edges.inner_share,
        edges.sharpness,
        region_support,
        region_information,
        edges.points_in_picture,
        edges.scatter_px,
    )


@kernel
def learn_odds(
    image: NDArray[np.uint8],
    colors: ColorModel,
    part: ViewArrays,
    cam_from_body: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    step_mm: float,
) -> bool:
    """Fill the log odds of colours from the outline at a pose; whether there are enough pixels on either side of it."""
    fore, back = np.zeros(colors.odds.shape[0]), np.zeros(colors.odds.shape[0])
    count_colors(image, colors.bin_of, part, cam_from_body, intrinsics, step_mm, fore, back)
    if min(fore.sum(), back.sum()) < MIN_HISTOGRAM_COUNT:
        return False
    log_odds(fore, back, colors.odds)
    return True


@kernel
def run_fresh(
    image: NDArray[np.uint8], gray: NDArray[np.uint8], colors: ColorModel, part: ViewArrays,
    cam_from_body: NDArray[np.float64], intrinsics: NDArray[np.float64], step_mm: float, stages: StageTable,
    damping: NDArray[np.float64], weights: ModalityWeights, matches: TextureMatches
) -> NDArray[np.float64]:  # fmt: skip
    """Refine a pose through some stages, before each of which colours are learned anew; arguments as of `run_stages`.

    Returns:
        cam_from_body (4,4).
    """
    plain = ModalityWeights(0.0, weights.edge, weights.edge_sigma_px, weights.edge_threshold, weights.texture_sigma_px)
    pose = cam_from_body
    for s in range(stages.stride.shape[0]):
        one = StageTable(
            stages.region_scale[s : s + 1], stages.edge_reach[s : s + 1], stages.edge_step_px[s : s + 1],
            stages.edge_spread_px[s : s + 1], stages.updates[s : s + 1], stages.region_gain[s : s + 1],
            stages.stride[s : s + 1],
        )  # fmt: skip
        known = learn_odds(image, colors, part, pose, intrinsics, step_mm)
        pose, _ = run_stages(
            image, gray, colors, part, pose, intrinsics, step_mm, one, damping, weights if known else plain, matches
        )
    return pose


@kernel
def run_edge_steps(
    gray: NDArray[np.uint8],
    part: ViewArrays,
    cam_from_body: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    step_mm: float,
    edge_threshold: float,
    tolerance_px: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Outline and design edges at a pose, see `EdgeSteps`; arguments as of `run_evidence`."""
    view = nearest_view(part.directions, cam_from_body)
    first, last = part.edge_starts[view], part.edge_starts[view + 1]
    lines = project_lines(
        part.edge_points[first:last], part.edge_tangents[first:last], True, cam_from_body, intrinsics, step_mm
    )
    profiles = measure_edges(gray, lines, EVIDENCE_REACH, EVIDENCE_STEP_PX, edge_threshold, intrinsics[10])
    positions, strengths = profiles.positions, profiles.strengths
    reach_px = EVIDENCE_REACH * EVIDENCE_STEP_PX
    chosen = profiles.visible & ((part.edge_kinds[first:last] & (EDGE_CONTOUR | EDGE_SHARP)) > 0)
    support = np.zeros(last - first)
    for i in range(last - first):
        steps = 0
        for j in range(positions.shape[1]):
            if strengths[i, j] != 0.0 and abs(positions[i, j]) <= reach_px:
                steps += 1
                if abs(positions[i, j]) <= tolerance_px:
                    support[i] = 1.0
        support[i] -= 1.0 - (1.0 - tolerance_px / reach_px) ** steps
    return lines.pixels[chosen], lines.normals[chosen], support[chosen]


@kernel
def count_colors(
    image: NDArray[np.uint8],
    bin_of: NDArray[np.int64],
    part: ViewArrays,
    cam_from_body: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    step_mm: float,
    fore: NDArray[np.float64],
    back: NDArray[np.float64],
) -> None:
    """Add the colours inside and outside the contour at a pose to histograms of part and background (BINS³,)."""
    view = nearest_view(part.directions, cam_from_body)
    first, last = part.contour_starts[view], part.contour_starts[view + 1]
    lines = project_lines(
        part.contour_points[first:last], part.contour_normals[first:last], False, cam_from_body, intrinsics, step_mm
    )
    runs_mm = part.contour_runs_mm[first:last]
    add_histograms(image, bin_of, lines, runs_mm, intrinsics, fore, back, HISTOGRAM_REACH_PX, HISTOGRAM_GAP_PX)


@kernel
def median_brightness_ratio(gray: NDArray[np.uint8], before: NDArray[np.float64], step: int) -> float:
    """Median ratio of the brightness to that of the last frame on a grid; 1 where too few pixels are usable.

    The median is that of a histogram of logarithms. Saturated and black pixels do not count.

    Args:
        gray: (H,W) uint8.
        before: (rows,columns) the last frame on the grid; overwritten with this frame.
        step: distance of the grid's points, px.
    """
    histogram = np.zeros(401, dtype=np.int64)
    count = 0
    for row in range(before.shape[0]):
        for column in range(before.shape[1]):
            value = gray[row * step + step // 2, column * step + step // 2]
            last = before[row, column]
            if 8 < value < 250 and 8 < last < 250:
                log_ratio = np.log(value / last)
                histogram[min(max(int(log_ratio * 100.0 + 200.5), 0), 400)] += 1
                count += 1
            before[row, column] = value
    if count < 50:
        return 1.0
    below = 0
    for i in range(401):
        below += histogram[i]
        if 2 * below >= count:
            return np.exp((i - 200) / 100.0)
    return 1.0
