"""Pair comparator: a network that predicts which of several poses at one place is right, from where they differ.

Near-symmetric poses share nearly all that the pose verifier sees: the notch or hole that distinguishes them covers few
of its pixels, and its score on the rest is noise. The pair comparator works on finer crops and in pairs: it encodes
each pose as the verifier does, then compares two encodings only where the CAD draws them differently. It is
antisymmetric by construction, as in the pairwise comparisons of Burges et al., "Learning to rank using gradient
descent" (ICML 2005). It is not specific to a part: it was trained on random solids before photos, see
``tools/training/fit.py``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from arview.core.parallel import pool
from arview.detection.features.image_pyramid import ImagePyramid
from arview.detection.scoring.crops import (
    CROP_CHANNELS,
    RESPONSE_CHANNELS,
    CropWindow,
    PoseCrop,
    append_edge_responses,
    append_gradients,
    normalise_colours,
)
from arview.geometry import Array
from arview.refinement import PartView
from arview.weights import load_network

PAIR_SIDE_PX, PAIR_RADIUS_PX = 128, 54.0
"""Side of the crop around the poses, and half the part's diameter in it."""
PAIR_CHANNELS = CROP_CHANNELS + RESPONSE_CHANNELS
"""Input channels of a pose, as those of the pose verifier."""


class PairComparator:
    """The comparator of the poses of one part.

    Args:
        part: of the poses.
    """

    def __init__(self, part: PartView) -> None:
        self._part = part
        self._network = load_network("pair_comparator.onnx")

    def log_odds(self, pyramid: ImagePyramid, poses: Sequence[Array]) -> Array:
        """Log odds (N,N) of each pose being right rather than each other one, given that one of them is.

        Args:
            pyramid: of the image.
            poses: (4,4) ``cam_from_body``, at about the same place.
        """
        crops = pair_crops(pyramid, self._part, poses)
        seen = np.stack(list(pool().map(pair_channels, crops)))
        one, other = (side.astype(np.int64) for side in np.triu_indices(len(poses), 1))
        log_odds = np.zeros((len(poses), len(poses)))
        log_odds[one, other] = self._network(seen=seen, one=one, other=other)
        return log_odds - log_odds.T


def pair_crops(pyramid: ImagePyramid, part: PartView, poses: Sequence[Array]) -> list[PoseCrop]:
    """Crops of several poses in one window around the first of them; they share their pixels."""
    radius_px = float(pyramid.radii_px(part.views.diameter_mm, poses[0][None])[0])
    window = CropWindow(pyramid, part, poses[0], radius_px, PAIR_SIDE_PX, PAIR_RADIUS_PX)
    return list(pool().map(window.crop, poses))


def pair_channels(crop: PoseCrop) -> NDArray[np.float32]:
    """Input channels (PAIR_CHANNELS,S,S) of one pose."""
    plain, _ = normalise_colours(crop.pixels, crop.drawn)
    return append_edge_responses(append_gradients(plain)[0], crop.responses)
