"""Contour verifier: a network that scores the image across the outline of a pose, straightened.

The pose verifier works at 35 px half diameter, where an outline off by one or two image pixels differs by less than a
pixel. Contour profiles are cut at full resolution: each row samples the image along a line across the outline, one
row after the other along it, and below them across the design edges inside; the middle column is where the pose puts
the edge. A right pose has one sharp step there in row after row, a wrong one has a step that drifts. The network was
trained on random solids before photos, see ``tools/training/fit.py``, to add to evidence, profile ranker, pose verifier
and edge responses.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.core.parallel import pool
from arview.detection.features.edge_net import MAX_SIDE_PX, SOLID_CHANNEL
from arview.detection.features.image_pyramid import STEPS_PER_OCTAVE, ImagePyramid, steps_to
from arview.detection.scoring.crops import MASK, write_relative_colours
from arview.detection.scoring.profile_ranker import sample_lines
from arview.detection.scoring.score_net import REFERENCE_RADIUS_PX, NetworkInput, ScoreNet, size_and_contrast
from arview.geometry import Array
from arview.refinement import PartView, ViewArrays, project_lines

OUTLINE_ROWS, INNER_ROWS = 96, 48
"""Maximum numbers of profiles across the outline and across design edges inside it."""
ROWS = OUTLINE_ROWS + INNER_ROWS
STEP_PX, COLUMNS = 0.5, 33
"""Spacing and number of the samples of a profile; the edge is in the middle of them."""
ORIENTED_RESPONSE, MAX_RESPONSE, SOLID_RESPONSE, EXPECTED_PART = range(4, 8)
"""Raw channels after red, green, blue and `MASK`: edge response of the profile's orientation, the strongest one of any,
and solidness; 255 where the CAD has the part, 128 beyond its other side or its next part, where anything may be."""
RAW_CHANNELS = 8
"""Channels of raw contour profiles, uint8."""
COLOUR_STEP, IS_INNER = range(RAW_CHANNELS, RAW_CHANNELS + 2)
"""Derived channels: colour change along the profile relative to its mean; 1 in rows of design edges."""
CHANNELS = RAW_CHANNELS + 2
"""Channels of the network's input: colours normalised, others scaled to 1."""
CONTOUR_SCALARS = 3
"""Scalar inputs: size of the part, contrast of the profiles, share of the rows inside the image."""
PROFILE_RADIUS_PX = 120.0
"""Half the part's diameter in the images that profiles are cut from, if they are large enough."""
MIN_MEAN_STEP = 1.0
"""Grey levels added to the mean step to which steps are relative."""


class ContourVerifier:
    """The contour verifier of the poses of one part.

    Args:
        part: of the poses.
    """

    def __init__(self, part: PartView) -> None:
        self._part = part
        self._network = ScoreNet("contour_verifier.onnx")

    def scores(self, pyramid: ImagePyramid, poses: Array) -> Array:
        """Log odds (N,) that the contour profiles add for refined poses (N,4,4) ``cam_from_body``."""
        radii_px = pyramid.radii_px(self._part.views.diameter_mm, poses)
        steps = [profile_step(pyramid, radius_px) for radius_px in radii_px]
        list(pool().map(pyramid.level, set(steps)))

        def of_pose(pose: Array, radius_px: float, step: int) -> NetworkInput:
            scale = 2.0 ** (step / STEPS_PER_OCTAVE)
            return network_input(contour_profiles(pyramid, self._part, pose), scale * radius_px)

        return self._network.scores(list(pool().map(of_pose, poses, radii_px.tolist(), steps)))


def profile_step(pyramid: ImagePyramid, radius_px: float) -> int:
    """Scale step at which the profiles of a part are cut.

    Full resolution, unless the edge network takes a reduced image or the part is larger than the network knows.

    Args:
        pyramid: of the image.
        radius_px: half the part's diameter in the image.
    """
    by_image = steps_to(float(MAX_SIDE_PX), np.array([float(max(pyramid.image.shape[:2]))]))
    return int(min(by_image[0], steps_to(PROFILE_RADIUS_PX, np.array([radius_px]))[0]))


def contour_profiles(pyramid: ImagePyramid, part: PartView, pose: Array) -> NDArray[np.uint8]:
    """Raw profiles (RAW_CHANNELS, ROWS, COLUMNS) across the lines of a part at a pose (4,4) ``cam_from_body``."""
    radius_px = float(pyramid.radii_px(part.views.diameter_mm, pose[None])[0])
    level = pyramid.level(profile_step(pyramid, radius_px))
    profiles = np.zeros((RAW_CHANNELS, ROWS, COLUMNS), dtype=np.uint8)
    _sample_profiles(
        level.colours,
        level.edge_responses,
        part.arrays,
        pose,
        level.intrinsics,
        0.01 * part.views.diameter_mm,
        profiles,
    )
    return profiles


@kernel(fastmath=True)
def _sample_profiles(
    colours: NDArray[np.uint8],
    responses: NDArray[np.uint8],
    part: ViewArrays,
    pose: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    step_mm: float,
    profiles: NDArray[np.uint8],
) -> None:
    """Write the samples of `contour_profiles`."""
    height, width = colours.shape[:2]
    rows, columns = responses.shape[1:]
    shrunk = columns / width
    points, directions, runs, outline, inner, _ = sample_lines(part, pose, OUTLINE_ROWS, INNER_ROWS)
    px, normals, depths = project_lines(points[:outline], directions[:outline], False, pose, intrinsics, step_mm)
    inner_px, inner_normals, inner_depths = project_lines(
        points[OUTLINE_ROWS : OUTLINE_ROWS + inner],
        directions[OUTLINE_ROWS : OUTLINE_ROWS + inner],
        True,
        pose,
        intrinsics,
        step_mm,
    )
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
        turn = int(np.round(np.arctan2(nv, nu) / np.pi * SOLID_CHANNEL)) % SOLID_CHANNEL
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
                profiles[c, row, column] = np.uint8((1.0 - b) * upper + b * lower + 0.5)
            profiles[MASK, row, column] = 255
            low, over = min(int((y + 0.5) * shrunk), rows - 1), min(int((x + 0.5) * shrunk), columns - 1)
            profiles[ORIENTED_RESPONSE, row, column] = responses[turn, low, over]
            most = 0
            for o in range(SOLID_CHANNEL):
                most = max(most, responses[o, low, over])
            profiles[MAX_RESPONSE, row, column] = most
            profiles[SOLID_RESPONSE, row, column] = responses[SOLID_CHANNEL, low, over]
            run_px = 1e9 if is_inner else runs[k, 0 if t <= 0.0 else 1] * intrinsics[0] / depth
            profiles[EXPECTED_PART, row, column] = 128 if abs(t) > run_px else 255 if is_inner or t <= 0.0 else 0


@kernel(fastmath=True)
def _channels(profiles: NDArray[np.uint8]) -> tuple[NDArray[np.float32], float, float]:
    """Channels (CHANNELS, ROWS, COLUMNS) float32 of raw profiles, contrast, and share of rows in the image."""
    out = np.zeros((CHANNELS, ROWS, COLUMNS), dtype=np.float32)
    contrast = write_relative_colours(profiles[:4].transpose(1, 2, 0), out)
    count, seen, total = 1, 0, 0.0
    for row in range(ROWS):
        seen += 1 if profiles[MASK, row, COLUMNS // 2] > 0 else 0
        for column in range(COLUMNS):
            if profiles[MASK, row, column] == 0:
                continue
            count += 1
            for c in range(4, RAW_CHANNELS):
                out[c, row, column] = np.float32(profiles[c, row, column]) / np.float32(255.0)
            out[IS_INNER, row, column] = 1.0 if row >= OUTLINE_ROWS else 0.0
            if 0 < column < COLUMNS - 1 and profiles[MASK, row, column - 1] > 0 and profiles[MASK, row, column + 1] > 0:
                step = 0.0
                for c in range(3):
                    step = max(step, abs(float(profiles[c, row, column + 1]) - float(profiles[c, row, column - 1])))
                out[COLOUR_STEP, row, column] = step
                total += step
    mean = np.float32(total / count + MIN_MEAN_STEP)
    for row in range(ROWS):
        for column in range(COLUMNS):
            out[COLOUR_STEP, row, column] /= out[COLOUR_STEP, row, column] + mean
    return out, contrast, seen / ROWS


def network_input(profiles: NDArray[np.uint8], radius_px: float) -> NetworkInput:
    """Input of the network from raw profiles and half the part's diameter in the image."""
    channels, contrast, share = _channels(profiles)
    scalars = np.array([*size_and_contrast(radius_px / REFERENCE_RADIUS_PX, contrast), share], dtype=np.float32)
    return NetworkInput(channels, scalars)
