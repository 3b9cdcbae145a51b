"""Evidence gathered from each viewing direction.

Pictures from one direction show the same edges and the same occlusions, but for noise and blur. They are therefore
averaged, and further pictures add ever less; new directions add in full.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from arview.geometry import Array, direction_from

NEW_DIRECTION_DEG = 6.0
"""Directions this far from all others are new."""
MAX_DIRECTIONS = 64
"""Directions that are remembered, the latest."""
REPEAT_DECAY = 0.35
"""The n-th observation adds this to the power of n - 1 to the weight of their mean."""
REPEAT_FLOOR = 0.03
"""Every observation after the first ``REPEATS_WITHOUT_FLOOR`` adds this to the weight of their mean as well."""
REPEATS_WITHOUT_FLOOR = 4
"""Observations from one direction to whose weight nothing but the decaying share is added."""
CLEARING_WEIGHT = 0.5
"""Weight of a direction's evidence for a component that is called mismatched. A displaced component looks right from
directions along its displacement."""


class DirectionEvidence:
    """Log odds that observations have added, by direction.

    Args:
        component_count: C.
        center_in_model: (3,) the part's centre, mm.

    Attributes:
        observations: (C,) how many said anything of each component.
        spreads_deg: (C,) largest angle between the directions of these.
    """

    def __init__(self, component_count: int, center_in_model: Array) -> None:
        self._center_in_model = center_in_model
        self._directions = np.zeros((0, 3))
        self._counts, self._sums = np.zeros((0, component_count)), np.zeros((0, component_count))
        self.observations = np.zeros(component_count, dtype=np.int64)
        self.spreads_deg = np.zeros(component_count)

    def add(self, cam_from_model: Array, log_odds: Array, is_mismatched: NDArray[np.bool_]) -> Array:
        """Add an observation from a pose.

        Args:
            cam_from_model: (4,4).
            log_odds: (C,) against each component; 0 where the observation says nothing.
            is_mismatched: (C,) components that are called mismatched at present.

        Returns:
            (C,) by how much the evidence of this direction has changed.
        """
        nearest = self._nearest(cam_from_model)
        if nearest < 0:
            kept = MAX_DIRECTIONS - 1
            none = np.zeros((1, len(log_odds)))
            self._directions = np.concatenate([self._directions[-kept:], self._direction(cam_from_model)[None]])
            self._counts = np.concatenate([self._counts[-kept:], none])
            self._sums = np.concatenate([self._sums[-kept:], none])
        counts, sums = self._counts[nearest], self._sums[nearest]
        before = self._combined(counts, sums, is_mismatched)
        counts += log_odds != 0.0
        self.observations += log_odds != 0.0
        self._widen_spreads(self._directions[nearest], log_odds != 0.0)
        sums += log_odds
        return self._combined(counts, sums, is_mismatched) - before

    def turned(self, model_from_model: Array, source: NDArray[np.int64]) -> DirectionEvidence:
        """The evidence as it is in a turned pose.

        Args:
            model_from_model: (4,4) from the turned pose, on the model's side.
            source: (C,) the component of which each has the evidence from now on; -1 for none.
        """
        found = DirectionEvidence(len(source), self._center_in_model)
        found._directions = self._directions @ model_from_model[:3, :3]
        is_known = source >= 0
        found._counts, found._sums = (np.where(is_known, rows[:, source], 0.0) for rows in (self._counts, self._sums))
        found.observations = np.where(is_known, self.observations[source], 0)
        found.spreads_deg = np.where(is_known, self.spreads_deg[source], 0.0)
        return found

    def forget(self, is_meant: NDArray[np.bool_]) -> None:
        """Forget what was observed of some components (C,)."""
        self._counts[:, is_meant] = self._sums[:, is_meant] = 0.0

    def _widen_spreads(self, direction: Array, is_observed: NDArray[np.bool_]) -> None:
        """Take a new observation of some components into account in their spreads."""
        angles_deg = np.rad2deg(np.arccos(np.clip(self._directions @ direction, -1.0, 1.0)))
        spread = np.max(np.where(self._counts > 0, angles_deg[:, None], 0.0), axis=0)
        self.spreads_deg = np.where(is_observed, np.maximum(self.spreads_deg, spread), self.spreads_deg)

    def observations_from(self, cam_from_model: Array) -> int:
        """How many observations of a component, at most, were made from about this direction; 0 for a new one."""
        nearest = self._nearest(cam_from_model)
        return 0 if nearest < 0 else int(self._counts[nearest].max())

    def is_new(self, cam_from_model: Array) -> bool:
        """Whether no observation was made from about this direction."""
        return self._nearest(cam_from_model) < 0

    def _combined(self, counts: Array, sums: Array, is_mismatched: NDArray[np.bool_]) -> Array:
        """Log odds (C,) of all observations from one direction, by how many they are and their sum."""
        weight = (1.0 - REPEAT_DECAY**counts) / (1.0 - REPEAT_DECAY)
        weight += REPEAT_FLOOR * np.maximum(counts - REPEATS_WITHOUT_FLOOR, 0.0)
        weight = weight * np.where((sums < 0.0) & is_mismatched, CLEARING_WEIGHT, 1.0)
        return np.asarray(weight * sums / np.maximum(counts, 1.0))

    def _direction(self, cam_from_model: Array) -> Array:
        """(3,) unit vector from the part's centre to the camera."""
        return direction_from(cam_from_model, self._center_in_model)

    def _nearest(self, cam_from_model: Array) -> int:
        """Index of the remembered direction nearest to a pose's, or -1 if all are further than a new one's."""
        cosines = self._directions @ self._direction(cam_from_model)
        if len(cosines) == 0 or cosines.max() < np.cos(np.deg2rad(NEW_DIRECTION_DEG)):
            return -1
        return int(np.argmax(cosines))
