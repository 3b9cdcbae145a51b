"""Contour profiles: the picture across the outline of a pose, straightened, and a network that looks at them.

The pose verifier works at 35 px half diameter, where an outline off by one or two image pixels differs by less than a
pixel. Contour profiles are cut at full resolution: each row samples the image along a line across the outline, one
row after the other along it, and below them across the design edges inside; the middle column is where the pose puts
the edge. A right pose has one sharp step there in row after row, a wrong one has a step that drifts. The network was
trained on random solids before photos to add to the evidence, profile ranker, pose verifier and edge responses.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.core.parallel import pool
from arview.detection.features.edge_net import INSIDE, LONGEST_SIDE_PX
from arview.detection.features.image_pyramid import ImagePyramid, steps_to
from arview.detection.scoring.pose_verifier import (
    TYPICAL_RADIUS_PX,
    write_relative_colours,
)
from arview.detection.scoring.profile_ranker import sample_lines
from arview.detection.scoring.score_net import NetworkInput, ScoreNet, size_and_contrast
from arview.geometry import Array
from arview.refinement.projection import project_lines
from arview.refinement.view_model import PartView

OUTLINE_ROWS, INNER_ROWS = 96, 48
"""Lines at most across the outline, and across design edges inside."""
ROWS = OUTLINE_ROWS + INNER_ROWS
STEP_PX, COLUMNS = 0.5, 33
"""Samples of a line; the edge is in the middle of them."""
RAW = 8
"""Of each sample: red, green, blue, 255 in the picture; what the line network says of lines like this one, of any, and
of solids; 255 where the part is to be, 128 where beyond its other side or its next part all may be."""
CHANNELS = RAW + 2
"""Colours less their mean in units of their deviation and the others to 1; the step of colours from the sample before,
relative to the mean step; 1 in the rows of design edges."""
GLOBALS = 3
"""The part's size in the picture, the contrast of the strips, the share of rows in the picture."""
LEAST_STEP = 1.0
"""Grey levels added to the mean step, relative to which steps count."""


class ContourVerifier:
    """The network, and the part whose outlines it looks along."""

    def __init__(self, part: PartView) -> None:
        self._part = part
        self._network = ScoreNet("contour_verifier.onnx")

    def scores(self, picture: ImagePyramid, poses: Array) -> Array:
        """What strips say (N,) for refined poses (N,4,4) ``cam_from_body`` beyond all else, as log odds."""
        picture.gradients(picture_step(picture))
        radii_px = picture.radii_px(self._part.views.diameter_mm, poses)

        def look(pose: Array, radius_px: float) -> NetworkInput:
            return shown(contour_profiles(picture, self._part, pose), radius_px)

        return self._network.scores(list(pool().map(look, poses, radii_px.tolist())))


def picture_step(picture: ImagePyramid) -> int:
    """Scale step at which strips are cut: the picture's own, unless the line network sees it shrunk."""
    return int(steps_to(float(LONGEST_SIDE_PX), np.array([float(max(picture.image.shape[:2]))]))[0])


def contour_profiles(picture: ImagePyramid, part: PartView, pose: Array) -> NDArray[np.uint8]:
    """Samples (RAW, ROWS, COLUMNS) across the lines of a part at a pose (4,4) ``cam_from_body``: see RAW."""
    gradients = picture.gradients(picture_step(picture))
    strips = np.zeros((RAW, ROWS, COLUMNS), dtype=np.uint8)
    _cut(
        gradients.colours, gradients.lines, part.arrays, pose, gradients.intrinsics, 0.01 * part.views.diameter_mm,
        strips,
    )  # fmt: skip
    return strips


@kernel(fastmath=True)
def _cut(colours, answers, part, pose, intrinsics, step_mm, strips):  # type: ignore[no-untyped-def]
    """Write the samples of `contour_profiles`."""
    height, width = colours.shape[:2]
    rows, columns = answers.shape[1:]
    shrunk = columns / width
    points, directions, runs, outline, inner, _ = sample_lines(part, pose, OUTLINE_ROWS, INNER_ROWS)
    px, normals, depths = project_lines(points[:outline], directions[:outline], False, pose, intrinsics, step_mm)
    inner_px, inner_normals, inner_depths = project_lines(
        points[OUTLINE_ROWS : OUTLINE_ROWS + inner], directions[OUTLINE_ROWS : OUTLINE_ROWS + inner], True, pose,
        intrinsics, step_mm,
    )  # fmt: skip
    half = COLUMNS // 2
    for i in range(outline + inner):
        is_inner = i >= outline
        k = i - outline if is_inner else i
        row = OUTLINE_ROWS + k if is_inner else i
        u, v = (inner_px[k, 0], inner_px[k, 1]) if is_inner else (px[k, 0], px[k, 1])
        nu, nv = (inner_normals[k, 0], inner_normals[k, 1]) if is_inner else (normals[k, 0], normals[k, 1])
        depth = inner_depths[k] if is_inner else depths[k]
        if depth <= 0.0:
            continue
        turn = int(np.round(np.arctan2(nv, nu) / np.pi * INSIDE)) % INSIDE
        for column in range(COLUMNS):
            t = (column - half) * STEP_PX
            x, y = u + t * nu, v + t * nv
            left, top = int(np.floor(x)), int(np.floor(y))
            if not (0 <= left < width - 1 and 0 <= top < height - 1):
                continue
            a, b = x - left, y - top
            for c in range(3):
                upper = (1.0 - a) * colours[top, left, c] + a * colours[top, left + 1, c]
                lower = (1.0 - a) * colours[top + 1, left, c] + a * colours[top + 1, left + 1, c]
                strips[c, row, column] = np.uint8((1.0 - b) * upper + b * lower + 0.5)
            strips[3, row, column] = 255
            low, over = min(int((y + 0.5) * shrunk), rows - 1), min(int((x + 0.5) * shrunk), columns - 1)
            strips[4, row, column] = answers[turn, low, over]
            most = 0
            for o in range(INSIDE):
                most = max(most, answers[o, low, over])
            strips[5, row, column] = most
            strips[6, row, column] = answers[INSIDE, low, over]
            run_px = 1e9 if is_inner else runs[k, 0 if t <= 0.0 else 1] * intrinsics[0] / depth
            strips[7, row, column] = 128 if abs(t) > run_px else 255 if is_inner or t <= 0.0 else 0


@kernel(fastmath=True)
def _shown(strips):  # type: ignore[no-untyped-def]
    """What the network is shown (CHANNELS, ROWS, COLUMNS) float32, the contrast, and the share of rows seen."""
    out = np.zeros((CHANNELS, ROWS, COLUMNS), dtype=np.float32)
    contrast = write_relative_colours(strips[:4].transpose(1, 2, 0), out)
    count, seen, total = 1, 0, 0.0
    for row in range(ROWS):
        seen += 1 if strips[3, row, COLUMNS // 2] > 0 else 0
        for column in range(COLUMNS):
            if strips[3, row, column] == 0:
                continue
            count += 1
            for c in range(4, RAW):
                out[c, row, column] = np.float32(strips[c, row, column]) / np.float32(255.0)
            out[RAW + 1, row, column] = 1.0 if row >= OUTLINE_ROWS else 0.0
            if 0 < column < COLUMNS - 1 and strips[3, row, column - 1] > 0 and strips[3, row, column + 1] > 0:
                step = 0.0
                for c in range(3):
                    step = max(step, abs(float(strips[c, row, column + 1]) - float(strips[c, row, column - 1])))
                out[RAW, row, column] = step
                total += step
    mean = np.float32(total / count + LEAST_STEP)
    for row in range(ROWS):
        for column in range(COLUMNS):
            out[RAW, row, column] /= out[RAW, row, column] + mean
    return out, contrast, seen / ROWS


def shown(strips: NDArray[np.uint8], radius_px: float) -> NetworkInput:
    """What the network is shown of raw strips, and told: see CHANNELS and GLOBALS."""
    seen, contrast, share = _shown(strips)
    return seen, np.array([*size_and_contrast(radius_px / TYPICAL_RADIUS_PX, contrast), share], dtype=np.float32)
