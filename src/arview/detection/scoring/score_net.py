"""Networks that predict one score from an image crop, its CAD channels and a few scalars.

The pose verifier, the contour verifier and the presence network are of this kind. Test-time augmentation (Krizhevsky et
al., "ImageNet classification with deep convolutional neural networks", NIPS 2012): averaging over mirrored crops
reduces variance. ``tools/training/networks/score_nets.py`` trains and writes such networks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.detection.scoring.crops import NORMAL_X, NORMAL_Y
from arview.geometry import Array
from arview.weights import load_network

REFERENCE_RADIUS_PX, REFERENCE_CONTRAST = 80.0, 40.0
"""Half diameter in pixels and contrast in grey levels relative to which scalar inputs are given."""


class NetworkInput(NamedTuple):
    """Input of a score network.

    Attributes:
        channels: (C,H,W) float32.
        scalars: (G,) float32.
    """

    channels: NDArray[np.float32]
    scalars: NDArray[np.float32]


class ScoreNet:
    """A score network of the package.

    Args:
        name: of its file, see `arview.weights.load_network`.
        mirrors: (left-right, upside-down) of each form in which an input is scored.
        max_batch: number of inputs that the network takes in one run.
    """

    def __init__(self, name: str, mirrors: Sequence[tuple[bool, bool]] = ((False, False),), max_batch: int = 8) -> None:
        self._network = load_network(name)
        self._mirrors = mirrors
        self._max_batch = max_batch

    def scores(self, inputs: Sequence[NetworkInput], in_mirrors: bool = True) -> Array:
        """Scores (N,): means over all mirrored forms, or of the first form alone."""
        mirrors = self._mirrors if in_mirrors else self._mirrors[:1]
        scores = np.empty(len(inputs))
        for first in range(0, len(inputs), self._max_batch):
            batch = slice(first, first + self._max_batch)
            channels, scalars = map(np.stack, zip(*inputs[batch], strict=True))
            forms = [mirrored(channels, *mirror) for mirror in mirrors]
            predicted = self._network(seen=np.concatenate(forms), both=np.concatenate([scalars] * len(forms)))
            scores[batch] = predicted.reshape(len(forms), -1).mean(axis=0)
        return scores


def mirrored(channels: NDArray[np.float32], across: bool = True, down: bool = False) -> NDArray[np.float32]:
    """Channels (N,C,S,S) mirrored left-right and upside-down; the surface normals change their signs with them."""
    other = channels[..., :: -1 if down else 1, :: -1 if across else 1].copy()
    other[:, NORMAL_X] *= -1.0 if across else 1.0
    other[:, NORMAL_Y] *= -1.0 if down else 1.0
    return other


def size_and_contrast(size: float, contrast: float) -> tuple[float, float]:
    """Scalar inputs for size and contrast: logarithms relative to reference values.

    Args:
        size: in the image, relative to a reference size.
        contrast: standard deviation of the colours, grey levels.
    """
    return np.log(size), 0.5 * np.log(contrast / REFERENCE_CONTRAST + 0.05)
