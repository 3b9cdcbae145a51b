"""Pose verifier: a network that predicts whether the image around a refined pose shows the part at that pose.

Evidence and profile rankers measure each line by itself. The verifier sees the whole: whether the surface inside the
outline differs from its surroundings, whether strong edges run where the part has none, and whether something in front
of the part hides a stretch of the outline. Its input is a crop of the image with the part drawn at the pose, see
`crops`. It is not specific to a part: it was trained on random solids before photos, see ``tools/training/fit.py``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from arview.core.parallel import pool
from arview.detection.features.image_pyramid import ImagePyramid, steps_to
from arview.detection.scoring.crops import (
    CROP_RADIUS_PX,
    append_edge_responses,
    append_gradients,
    normalise_colours,
    pose_crop,
    without_outside,
)
from arview.detection.scoring.score_net import REFERENCE_RADIUS_PX, NetworkInput, ScoreNet, size_and_contrast
from arview.geometry import Array
from arview.refinement import PartView

POSE_SCALARS = 6
"""Scalar inputs: size, contrast, evidence logit, profile score, scatter, and the share of brightness explained."""
KNOWN_MEANS, KNOWN_DEVIATIONS = np.array([2.0, 1.0, 0.5]), np.array([4.0, 3.0, 1.0 / 3.0])
"""Normalisation of what is known of a pose before the verifier."""


class PoseVerifier:
    """The verifier of the poses of one part.

    Args:
        part: of the poses.
        cut_fill: the part's diameter, as a share of the picture's shorter side, from which nothing is expected of what
            the picture's border cuts off; smaller cut poses often fit clutter by chance.
    """

    def __init__(self, part: PartView, cut_fill: float = 0.7) -> None:
        self._part, self._cut_fill = part, cut_fill
        self._network = ScoreNet("pose_verifier.onnx")

    def scores(self, pyramid: ImagePyramid, poses: Array, known: Array) -> Array:
        """Log odds (N,) that refined poses are right, up to a constant for how often poses are.

        Args:
            pyramid: of the image.
            poses: (N,4,4) ``cam_from_body``.
            known: (N,3) evidence logit, profile score, and scatter of the edge steps in px.
        """
        radii_px = pyramid.radii_px(self._part.views.diameter_mm, poses)
        list(pool().map(pyramid.level, set(steps_to(CROP_RADIUS_PX, radii_px).tolist())))

        def network_input(pose: Array, radius_px: float, of_pose: Array) -> NetworkInput:
            crop = pose_crop(pyramid, self._part, pose, radius_px)
            if 2.0 * radius_px >= self._cut_fill * min(pyramid.image.shape[:2]):
                crop = without_outside(crop)
            plain, contrast = normalise_colours(crop.pixels, crop.drawn)
            channels, explained = append_gradients(plain)
            scalars = pose_scalars(radius_px, contrast, of_pose, explained)
            return NetworkInput(append_edge_responses(channels, crop.responses), scalars)

        return self._network.scores(list(pool().map(network_input, poses, radii_px.tolist(), known)))


def pose_scalars(radius_px: float, contrast: float, known: Array, explained: float) -> NDArray[np.float32]:
    """Scalar inputs (POSE_SCALARS,) of the network.

    Args:
        radius_px: half the part's diameter in the image.
        contrast: standard deviation of the crop's colours, grey levels.
        known: (3,) see `PoseVerifier.scores`.
        explained: share of the brightness that shading explains.
    """
    both = size_and_contrast(radius_px / REFERENCE_RADIUS_PX, contrast)
    return np.concatenate([both, (known - KNOWN_MEANS) / KNOWN_DEVIATIONS, [explained]]).astype(np.float32)
