"""Disambiguation: which of several near-symmetric poses the frames of a video support."""

from __future__ import annotations

import numpy as np

from arview.geometry import Array

DECISION_MARGIN = 0.25
"""Sum over the frames of the differences in score that decides between two poses."""


class HypothesisSet:
    """Near-symmetric alternatives of a tracked pose, compared with it frame by frame.

    Args:
        model_from_other: (4,4) transforms on the model's side that lead from the tracked pose to each alternative.
    """

    def __init__(self, model_from_other: list[Array]) -> None:
        self.model_from_other = model_from_other
        self._margins = [0.0] * len(model_from_other)

    def __len__(self) -> int:
        return len(self.model_from_other)

    def poses(self, cam_from_model: Array) -> list[Array]:
        """The alternatives (4,4) of a tracked pose."""
        return [cam_from_model @ turn for turn in self.model_from_other]

    def update(self, score: float, other_scores: list[float]) -> Array | None:
        """Count a frame.

        Alternatives whose scores sum up to clearly less than those of the tracked pose are dropped.

        Args:
            score: score of the tracked pose in this frame.
            other_scores: scores of the alternatives.

        Returns:
            Transform (4,4) to the alternative that is clearly better than the tracked pose; None if there is none.
        """
        pairs = zip(self._margins, other_scores, strict=True)
        self._margins = [margin + score - other for margin, other in pairs]
        worst = int(np.argmin(self._margins))
        if self._margins[worst] <= -DECISION_MARGIN:
            return self.model_from_other[worst]
        kept = [k for k, margin in enumerate(self._margins) if margin < DECISION_MARGIN]
        self.model_from_other = [self.model_from_other[k] for k in kept]
        self._margins = [self._margins[k] for k in kept]
        return None
