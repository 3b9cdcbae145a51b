"""Disambiguation: which of several near-symmetric poses the frames of a video support."""

from __future__ import annotations

import numpy as np

from arview.geometry import Array

DECIDED = 0.25
"""The same for the sum of the differences over frames."""


class HypothesisSet:
    """Twins of a tracked pose, told from it by what the frames bear out.

    Args:
        model_from_twins: (4,4) transforms on the model's side that lead from the tracked pose to each twin.
    """

    def __init__(self, model_from_twins: list[Array]) -> None:
        self.model_from_twins = model_from_twins
        self._leads = [0.0] * len(model_from_twins)

    def __bool__(self) -> bool:
        return bool(self.model_from_twins)

    def update(self, worth: float, twin_worths: list[float]) -> Array | None:
        """Count a frame: twins that are clearly worse are dropped; the transform to one that is clearly better."""
        self._leads = [lead + worth - other for lead, other in zip(self._leads, twin_worths, strict=True)]
        worst = int(np.argmin(self._leads))
        if self._leads[worst] <= -DECIDED:
            return self.model_from_twins[worst]
        kept = [k for k, lead in enumerate(self._leads) if lead < DECIDED]
        self.model_from_twins = [self.model_from_twins[k] for k in kept]
        self._leads = [self._leads[k] for k in kept]
        return None
