"""The inner loop of the tracker as one compiled call: project, measure, solve, stage after stage."""

from __future__ import annotations

import numpy as np

from arview.core.kernel import kernel
from arview.guideviews.mesh_edges import EDGE_CONTOUR, EDGE_SHARP
from arview.refinement.evidence import edge_evidence, region_evidence
from arview.refinement.gauss_newton import apply_twist, solve_step
from arview.refinement.modalities.edge import add_edges, measure_edges
from arview.refinement.modalities.region import (
    add_histograms,
    add_region,
    measure_region,
)
from arview.refinement.modalities.texture import add_features
from arview.refinement.projection import project_lines


@kernel
def nearest_view(directions, cam_from_body):  # type: ignore[no-untyped-def]
    """Index of the direction (N,3) nearest to that of the camera."""
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
def run_stages(  # type: ignore[no-untyped-def]
    image, gray, bin_of, odds, edge_function, part, cam_from_body, intrinsics, step_mm, stages, damping,
    region_weight, edge_weight, edge_sigma_px, edge_threshold, match_points, match_pixels, match_weights,
    feature_sigma_px
):  # fmt: skip
    """Pose and information after all stages.

    Args:
        part: arrays of all guide views, see `PartView.arrays`.
        stages: (S,7) region scale, edge reach, edge step px, edge spread px, updates, region gain, stride of points.
        region_weight, edge_weight: 0 leaves the modality out; match_points (0,3) leaves features out.

    Returns:
        cam_from_body (4,4), information (6,6).
    """
    directions, c_start, c_points, c_normals, c_runs, e_start, e_points, e_tangents, e_kinds = part
    pose = cam_from_body.copy()
    hessian = np.zeros((6, 6))
    gradient = np.zeros(6)
    focal = intrinsics[0]
    for s in range(stages.shape[0]):
        scale = int(stages[s, 0])
        spread = stages[s, 3]
        stride = int(stages[s, 6])
        view = nearest_view(directions, pose)
        contour = c_points[c_start[view] : c_start[view + 1] : stride]
        edges = e_points[e_start[view] : e_start[view + 1] : stride]
        region_gain = region_weight * stages[s, 5] * stride
        edge_gain = edge_weight * stride
        kinds = e_kinds[e_start[view] : e_start[view + 1] : stride]
        c_px, c_n, c_z = project_lines(
            contour, c_normals[c_start[view] : c_start[view + 1] : stride], False, pose, intrinsics, step_mm
        )
        e_px, e_n, e_z = project_lines(
            edges, e_tangents[e_start[view] : e_start[view + 1] : stride], True, pose, intrinsics, step_mm
        )
        if region_gain > 0:
            runs = c_runs[c_start[view] : c_start[view + 1] : stride]
            mean, information, _ = measure_region(
                image, bin_of, c_px, c_n, c_z, runs, focal, odds, edge_function, scale
            )
        else:
            mean, information = np.zeros(0), np.zeros(0)
        if edge_gain > 0:
            positions, strengths, _ = measure_edges(
                gray, e_px, e_n, e_z, int(stages[s, 1]), stages[s, 2], edge_threshold
            )
        else:
            positions, strengths = np.zeros((0, 5)), np.zeros((0, 5))
        for _ in range(int(stages[s, 4])):
            hessian[:] = 0.0
            gradient[:] = 0.0
            if region_gain > 0:
                add_region(
                    hessian,
                    gradient,
                    contour,
                    pose,
                    intrinsics,
                    c_px,
                    c_n,
                    mean,
                    information,
                    region_gain,
                    3.0 * scale,
                )
            if edge_gain > 0:
                add_edges(
                    hessian, gradient, edges, kinds, pose, intrinsics, e_px, e_n, positions, strengths,
                    15.0, edge_sigma_px * max(1.0, 0.5 * spread), spread, edge_gain,
                )  # fmt: skip
            if match_points.shape[0] > 0:
                add_features(
                    hessian, gradient, match_points, pose, intrinsics, match_pixels, match_weights,
                    feature_sigma_px, max(4.0, 2.0 * spread),
                )  # fmt: skip
            pose = apply_twist(pose, solve_step(hessian, gradient, damping))
    for i in range(6):
        for j in range(i):
            hessian[j, i] = hessian[i, j]
    # Keep the rotation a rotation: Gram-Schmidt over its rows.
    for i in range(3):
        for j in range(i):
            dot = pose[i, 0] * pose[j, 0] + pose[i, 1] * pose[j, 1] + pose[i, 2] * pose[j, 2]
            for k in range(3):
                pose[i, k] -= dot * pose[j, k]
        norm = np.sqrt(pose[i, 0] ** 2 + pose[i, 1] ** 2 + pose[i, 2] ** 2)
        for k in range(3):
            pose[i, k] /= norm
    return pose, hessian


@kernel
def run_evidence(  # type: ignore[no-untyped-def]
    image, gray, bin_of, odds, has_colours, edge_function, part, cam_from_body, intrinsics, step_mm,
    edge_threshold, tolerance_px
):  # fmt: skip
    """The numbers of `PoseEvidence` at a pose."""
    directions, c_start, c_points, c_normals, c_runs, e_start, e_points, e_tangents, e_kinds = part
    view = nearest_view(directions, cam_from_body)
    first, last = e_start[view], e_start[view + 1]
    pixels, normals, depths = project_lines(
        e_points[first:last], e_tangents[first:last], True, cam_from_body, intrinsics, step_mm
    )
    positions, strengths, seen = measure_edges(gray, pixels, normals, depths, 10, 1.0, edge_threshold)
    contour, inner, share, sharpness, inside, scatter = edge_evidence(
        positions, strengths, seen, e_kinds[first:last], 10.0, tolerance_px
    )
    region, region_information = -1.0, 0.0
    if has_colours:
        first, last = c_start[view], c_start[view + 1]
        pixels, normals, depths = project_lines(
            c_points[first:last], c_normals[first:last], False, cam_from_body, intrinsics, step_mm
        )
        mean, information, agreement = measure_region(
            image, bin_of, pixels, normals, depths, c_runs[first:last], intrinsics[0], odds, edge_function, 2
        )
        region, region_information = region_evidence(mean, information, agreement, 2.0)
    return contour, inner, share, sharpness, region, region_information, inside, scatter


@kernel
def run_edge_steps(gray, part, cam_from_body, intrinsics, step_mm, edge_threshold, tolerance_px):  # type: ignore[no-untyped-def]
    """Outline and design edges at a pose: pixels (N,2), normals (N,2), and support (N,) beyond chance, -1 to 1."""
    directions, _, _, _, _, e_start, e_points, e_tangents, e_kinds = part
    view = nearest_view(directions, cam_from_body)
    first, last = e_start[view], e_start[view + 1]
    pixels, normals, depths = project_lines(
        e_points[first:last], e_tangents[first:last], True, cam_from_body, intrinsics, step_mm
    )
    positions, strengths, seen = measure_edges(gray, pixels, normals, depths, 10, 1.0, edge_threshold)
    chosen = seen & ((e_kinds[first:last] & (EDGE_CONTOUR | EDGE_SHARP)) > 0)
    support = np.zeros(last - first)
    for i in range(last - first):
        steps = 0
        for j in range(positions.shape[1]):
            if strengths[i, j] != 0.0 and abs(positions[i, j]) <= 10.0:
                steps += 1
                if abs(positions[i, j]) <= tolerance_px:
                    support[i] = 1.0
        support[i] -= 1.0 - (1.0 - tolerance_px / 10.0) ** steps
    return pixels[chosen], normals[chosen], support[chosen]


@kernel
def count_colours(image, bin_of, part, cam_from_body, intrinsics, step_mm, fore, back):  # type: ignore[no-untyped-def]
    """Add the colours inside and outside of the contour at a pose to the histograms."""
    directions, c_start, c_points, c_normals, c_runs, _, _, _, _ = part
    view = nearest_view(directions, cam_from_body)
    first, last = c_start[view], c_start[view + 1]
    pixels, normals, depths = project_lines(
        c_points[first:last], c_normals[first:last], False, cam_from_body, intrinsics, step_mm
    )
    add_histograms(image, bin_of, pixels, normals, depths, c_runs[first:last], intrinsics[0], fore, back, 20.0, 1.5)


@kernel
def median_brightness_ratio(gray, before, step):  # type: ignore[no-untyped-def]
    """Median ratio of the brightness to that of the last frame on a grid, by a histogram of logarithms.

    ``before`` (rows, columns) holds the last frame's grid and is overwritten. Saturated and black pixels do not
    count; 1 when too few are left.
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
