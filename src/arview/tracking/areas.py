"""What lies on both sides of a pose's outline: do the colours part there, and is the part plain inside?

Edges alone fit clutter by chance, for it has edges everywhere. Two more questions, asked of areas and not of lines,
tell such poses from right ones: are the colours within the outline others than those around it (after the histograms
of Prisacariu & Reid, "PWP3D", IJCV 2012, here learned at the pose itself and compared as a whole), and are the steps
inside, off the design edges, weaker than those on the outline? The second is own; of all that was tried on
semi-synthetic and recorded frames it told most.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from arview.geometry import Array
from arview.guideviews.mesh_edges import EDGE_CONTOUR
from arview.tracking.picture import COLOURS, STEPS_PER_OCTAVE, Picture
from arview.tracking.refine import nearest_view
from arview.tracking.solver import project, project_lines
from arview.tracking.threads import pool
from arview.tracking.tracker import PartView

RADIUS_PX = 48.0
"""Half the part's diameter in the pictures that areas are looked at in; nothing is enlarged."""
LINES = 48
"""About so many lines across the outline are looked at."""
NEAR_PX, COLOURS_PX = 2.0, 12.0
"""Colours are compared from and up to so far away from the outline."""
PLAIN_FROM_PX, PLAIN_PX = 3.0, 32.0
"""Steps inside are looked at from and up to so far away from it."""
EDGE_PX = 3
"""Steps this near to a design edge are its own."""
WINDOW_PX = 160
"""Side of the window in which design edges are marked."""
FEWEST = 10
"""Of fewer places nothing is said."""
UNKNOWN = np.array([0.5, -1.0])
"""The areas of poses of which too little is in the picture."""


def look_at_areas(picture: Picture, part: PartView, poses: Array) -> Array:
    """`Areas` (N,2) of poses (N,4,4) ``cam_from_body``, each in the picture at a scale at which it has one size."""
    radii_px = picture.focal_px * 0.5 * part.views.diameter_mm / np.linalg.norm(poses[:, :3, 3], axis=1)
    # Half octaves are near enough.
    half = STEPS_PER_OCTAVE // 2
    scales = half * np.minimum(np.round(STEPS_PER_OCTAVE / half * np.log2(RADIUS_PX / radii_px)), 0).astype(int)
    found = np.empty((len(poses), 2))
    jobs = [(scale, some) for scale in np.unique(scales) for some in np.array_split(np.flatnonzero(scales == scale), 2)]

    def measure(job: tuple[int, NDArray[np.intp]]) -> None:
        scale, some = job
        step_mm = 0.01 * part.views.diameter_mm
        found[some] = measure_areas(picture.surroundings(int(scale)), part.arrays, poses[some], step_mm)

    list(pool().map(picture.surroundings, np.unique(scales).tolist()))
    list(pool().map(measure, [job for job in jobs if len(job[1])]))
    return found


@njit(cache=True, nogil=True)
def measure_areas(surroundings, part, poses, step_mm):  # type: ignore[no-untyped-def]
    """`Areas` (N,2) of poses (N,4,4) ``cam_from_body``; ``part`` as in `PartView.arrays`."""
    colours, steps, intrinsics = surroundings
    directions, c_start, c_points, c_normals, c_runs, e_start, e_points, _, e_kinds = part
    height, width = steps.shape
    found = np.empty((poses.shape[0], 2))
    # Numbers of the poses that have an edge there, about the part's centre.
    edges = np.full((WINDOW_PX, WINDOW_PX), -1, dtype=np.int32)
    counts = np.zeros((2, COLOURS))
    for n in range(poses.shape[0]):
        pose = poses[n]
        view = nearest_view(directions, pose)
        first, last = e_start[view], e_start[view + 1]
        left, top = _mark_edges(edges, n, e_points[first:last], e_kinds[first:last], pose, intrinsics)
        first, last = c_start[view], c_start[view + 1]
        stride = max(1, (last - first) // LINES)
        runs = c_runs[first:last:stride]
        pixels, normals, depths = project_lines(
            c_points[first:last:stride], c_normals[first:last:stride], False, pose, intrinsics, step_mm
        )
        counts[:] = 0.0
        on_outline, inside = 0.0, 0.0
        lines, places = 0, 0
        for i in range(pixels.shape[0]):
            if depths[i] <= 0:
                continue
            u, v, nu, nv = pixels[i, 0] + 0.5, pixels[i, 1] + 0.5, normals[i, 0], normals[i, 1]
            strongest = -1.0
            for k in range(-2, 3):
                x, y = int(np.floor(u + k * nu)), int(np.floor(v + k * nv))
                if 0 <= x < width and 0 <= y < height:
                    strongest = max(strongest, float(steps[y, x]))
            if strongest < 0.0:
                continue
            on_outline += strongest
            lines += 1
            for side in range(2):
                sign = -1.0 if side == 0 else 1.0
                run = runs[i, side] * intrinsics[0] / depths[i] - NEAR_PX
                t = NEAR_PX
                while t <= min(COLOURS_PX, run):
                    x, y = int(np.floor(u + sign * t * nu)), int(np.floor(v + sign * t * nv))
                    if 0 <= x < width and 0 <= y < height:
                        counts[side, colours[y, x]] += 1.0
                    t += 1.0
                if side == 1:
                    continue
                t = PLAIN_FROM_PX
                while t <= min(PLAIN_PX, run):
                    x, y = int(np.floor(u - t * nu)), int(np.floor(v - t * nv))
                    if not (0 <= x < width and 0 <= y < height):
                        break
                    a, b = x - left, y - top
                    if not (0 <= a < WINDOW_PX and 0 <= b < WINDOW_PX and edges[b, a] == n):
                        inside += steps[y, x]
                        places += 1
                    t += 2.0
        found[n] = UNKNOWN
        fore, back = counts[0].sum(), counts[1].sum()
        if min(fore, back) >= FEWEST:
            found[n, 0] = 0.5 * np.abs(counts[0] / fore - counts[1] / back).sum()
        if lines >= FEWEST and places >= FEWEST:
            found[n, 1] = np.log((inside / places + 1.0) / (on_outline / lines + 1.0))
    return found


@njit(cache=True, nogil=True)
def _mark_edges(edges, number, points, kinds, pose, intrinsics):  # type: ignore[no-untyped-def]
    """Write a number to the pixels near the projected edges inside the outline; returns the window's first pixel."""
    height, width = edges.shape
    u, v = project(pose[0, 3], pose[1, 3], pose[2, 3], intrinsics)
    left, top = int(np.floor(u + 0.5)) - width // 2, int(np.floor(v + 0.5)) - height // 2
    for i in range(points.shape[0]):
        if (kinds[i] & EDGE_CONTOUR) > 0:
            continue
        p = points[i]
        z = pose[2, 0] * p[0] + pose[2, 1] * p[1] + pose[2, 2] * p[2] + pose[2, 3]
        if z < 1.0:
            continue
        x = pose[0, 0] * p[0] + pose[0, 1] * p[1] + pose[0, 2] * p[2] + pose[0, 3]
        y = pose[1, 0] * p[0] + pose[1, 1] * p[1] + pose[1, 2] * p[2] + pose[1, 3]
        u, v = project(x, y, z, intrinsics)
        column, row = int(np.floor(u + 0.5)) - left, int(np.floor(v + 0.5)) - top
        for b in range(max(0, row - EDGE_PX), min(height, row + EDGE_PX + 1)):
            for a in range(max(0, column - EDGE_PX), min(width, column + EDGE_PX + 1)):
                edges[b, a] = number
    return left, top
