"""Small networks that score looks: a picture around or along something beside what the CAD says is there.

The verifier, the network of strips and the component network are of this kind. A look may be scored in mirrors, too:
neither form is truer, and where they differ it is chance, of which the mean has less (Krizhevsky et al., NIPS 2012,
average over forms of a picture). ``tools/training/networks/score_nets.py`` makes and writes such networks.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from arview.geometry import Array
from arview.weights import load_network

RIGHTWARD, DOWNWARD = 6, 7
"""Channels with the parts of the surface's normal to the right and down: mirrors turn them round."""
MOST_AT_ONCE = 8
"""Looks that a network is given together."""
TYPICAL_CONTRAST = 40.0
"""Contrasts count relative to this."""

NetworkInput = tuple[NDArray[np.float32], NDArray[np.float32]]
"""What a network is shown (C,H,W), and what else it is told (G,)."""


class ScoreNet:
    """A network of the package.

    Args:
        name: of its file.
        mirrors: (right for left, upside down) of each form in which a look is scored.
    """

    def __init__(self, name: str, mirrors: Sequence[tuple[bool, bool]] = ((False, False),)) -> None:
        self._network = load_network(name)
        self._mirrors = mirrors

    def scores(self, looks: Sequence[NetworkInput], in_mirrors: bool = True) -> Array:
        """Scores (N,) of some looks, means over their forms or of the first form alone."""
        mirrors = self._mirrors if in_mirrors else self._mirrors[:1]
        scores = np.empty(len(looks))
        for first in range(0, len(looks), MOST_AT_ONCE):
            some = slice(first, first + MOST_AT_ONCE)
            seen, told = map(np.stack, zip(*looks[some], strict=True))
            forms = [mirrored(seen, *mirror) for mirror in mirrors]
            answers = self._network(seen=np.concatenate(forms), both=np.concatenate([told] * len(forms)))
            scores[some] = answers.reshape(len(forms), -1).mean(axis=0)
        return scores


def mirrored(seen: NDArray[np.float32], across: bool = True, down: bool = False) -> NDArray[np.float32]:
    """What a network is shown (N,C,S,S), right for left and upside down."""
    other = seen[..., :: -1 if down else 1, :: -1 if across else 1].copy()
    other[:, RIGHTWARD] *= -1.0 if across else 1.0
    other[:, DOWNWARD] *= -1.0 if down else 1.0
    return other


def size_and_contrast(size: float, contrast: float) -> tuple[float, float]:
    """Of what is looked at in the picture and of the look, as networks are told: logarithms against typical ones.

    Args:
        size: relative to a typical one.
        contrast: deviation of the colours, grey levels.
    """
    return np.log(size), 0.5 * np.log(contrast / TYPICAL_CONTRAST + 0.05)
