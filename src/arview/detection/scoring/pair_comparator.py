"""Which of several poses of a part at one place is right: a network that looks where they differ.

Twins share nearly all that the verifier looks at; the notch or the hole that tells them apart is a few of its pixels,
and what it says of the many others is chance. Here poses are told apart in pairs, in a finer picture. What the picture
and the CAD show beside each other is seen for each pose as the verifier sees it; the layers after that see two poses
at once, and count only where these are drawn differently. One over the other is worth as much as the other over the one
is not, by how the network is made (as the pairwise comparisons of Burges et al., "Learning to rank using gradient
descent", ICML 2005). It knows nothing of a part: it was fitted on random solids before photos, see ``tools/training``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from arview.core.parallel import pool
from arview.detection.features.image_pyramid import ImagePyramid
from arview.detection.scoring.pose_verifier import (
    CHANNELS,
    LINES,
    CropWindow,
    append_edge_responses,
    append_gradients,
    normalise_colours,
)
from arview.geometry import Array
from arview.refinement.view_model import PartView
from arview.weights import load_network

SIDE_PX, RADIUS_PX = 128, 54.0
"""Side of the picture around the poses, and half the part's diameter in it."""
SHOWN = CHANNELS + LINES
"""Channels of a pose, as the verifier's."""


class PairComparator:
    """The network, and the part that it looks for."""

    def __init__(self, part: PartView) -> None:
        self._part = part
        self._network = load_network("pair_comparator.onnx")

    def log_odds(self, picture: ImagePyramid, poses: Sequence[Array]) -> Array:
        """Log odds (N,N) that each of some poses is right rather than each other, if one of them is.

        Args:
            picture: where the part is.
            poses: (4,4) ``cam_from_body``, at about the same place.
        """
        pixels, drawn, lines = pair_crops(picture, self._part, poses)
        seen = np.stack(list(pool().map(lambda k: shown(pixels, drawn[k], lines[k]), range(len(poses)))))
        one, other = (side.astype(np.int64) for side in np.triu_indices(len(poses), 1))
        leads = np.zeros((len(poses), len(poses)))
        leads[one, other] = self._network(seen=seen, one=one, other=other)
        return leads - leads.T


def pair_crops(
    picture: ImagePyramid, part: PartView, poses: Sequence[Array]
) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.uint8]]:
    """The picture (S,S,4) around the first of some poses, the part (N,6,S,S) and the lines (N,3,S,S) at each."""
    radius_px = float(picture.radii_px(part.views.diameter_mm, poses[0][None])[0])
    window = CropWindow(picture, part, poses[0], radius_px, SIDE_PX, RADIUS_PX)
    drawn, lines = zip(*pool().map(window.look, poses), strict=True)
    return window.pixels, np.stack(drawn), np.stack(lines)


def shown(pixels: NDArray[np.uint8], drawn: NDArray[np.float32], lines: NDArray[np.uint8]) -> NDArray[np.float32]:
    """What the network is shown (SHOWN,S,S) of a pose."""
    return append_edge_responses(append_gradients(normalise_colours(pixels, drawn)[0])[0], lines)
