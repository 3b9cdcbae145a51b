"""Motion of a part from frame to frame: how far a pose is from the predicted one, and whether that is usual.

A pose is predicted at constant velocity. What a tracked pose differs from its prediction by is its innovation. Hands
accelerate and tremble, each in its own way, so the usual innovations are learned from the stream: their covariance is
averaged over the last frames, with the weights of a robust M-estimator, because the innovation of a wrong pose must not
count as usual. Whether an innovation is unusual is then a chi-squared test of its Mahalanobis distance (Bar-Shalom, Li
& Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from arview.core.kernel import kernel
from arview.geometry import Array

ROTATION_UNIT_RAD = 0.785
"""Rotation that has a distance of 1."""
LATERAL_UNIT, AXIAL_UNIT = 0.35, 0.7
"""Shifts across and along the line of sight, in diameters of the part, that have a distance of 1."""


@kernel
def squared_motion_distance(cam_from_body: Array, predicted: Array, diameter_mm: float) -> float:
    """Squared normalised distance of a pose from the predicted pose, the square of the length of `innovation`.

    It is 1 for a rotation of 45°, a lateral shift of 0.35 diameters or an axial shift of 0.7 diameters.
    """
    difference = innovation(cam_from_body, predicted, diameter_mm)
    return float((difference * difference).sum())


@kernel
def innovation(cam_from_body: Array, predicted: Array, diameter_mm: float) -> Array:
    """Normalised difference (6,) of a pose from the predicted pose, in the camera frame.

    Args:
        cam_from_body: (4,4) pose about the part's centre.
        predicted: (4,4) predicted pose about the part's centre.
        diameter_mm: diameter of the part.
    """
    a, b = cam_from_body, predicted
    turn = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            turn[i, j] = a[i, 0] * b[j, 0] + a[i, 1] * b[j, 1] + a[i, 2] * b[j, 2]
    difference = np.empty(6)
    difference[0] = 0.5 * (turn[2, 1] - turn[1, 2])
    difference[1] = 0.5 * (turn[0, 2] - turn[2, 0])
    difference[2] = 0.5 * (turn[1, 0] - turn[0, 1])
    sine = np.sqrt((difference[:3] * difference[:3]).sum())
    cosine = 0.5 * (turn[0, 0] + turn[1, 1] + turn[2, 2] - 1.0)
    if sine > 1e-6:
        difference[:3] *= np.arctan2(sine, cosine) / sine
    elif cosine < 0.0:
        difference[0] = np.pi  # half a turn, about whichever axis
    for i in range(3):
        difference[i] /= ROTATION_UNIT_RAD
        difference[3 + i] = (a[i, 3] - b[i, 3]) / (diameter_mm * (AXIAL_UNIT if i == 2 else LATERAL_UNIT))
    return difference


@kernel
def normalised_covariance(covariance: Array, cam_from_body: Array, diameter_mm: float) -> Array:
    """Covariance (6,6) of a twist (rad, mm) on the right of a pose (4,4), in the frame and units of `innovation`."""
    turn = np.zeros((6, 6))
    for i in range(3):
        for j in range(3):
            turn[i, j] = cam_from_body[i, j] / ROTATION_UNIT_RAD
            turn[3 + i, 3 + j] = cam_from_body[i, j] / (diameter_mm * (AXIAL_UNIT if i == 2 else LATERAL_UNIT))
    return turn @ covariance @ turn.T


@kernel
def _squared_mahalanobis(difference: Array, covariance: Array) -> float:
    """Squared Mahalanobis distance of a difference (6,) with a covariance (6,6)."""
    return float((difference * np.linalg.solve(covariance, difference)).sum())


PRIOR_SIGMA = 0.03
"""Standard deviation of each component before anything is learned: a steady hand."""
MIN_SIGMA = 0.012
"""Standard deviation of the measured poses themselves, which is added."""
NOISE = MIN_SIGMA**2 * np.eye(6)
RATE = 0.05
"""Share by which the covariance follows each frame."""
MAX_SQUARED = 10.0
"""Squared Mahalanobis distance from which an innovation weighs less; one in eight normally distributed ones exceeds
it."""
ROBUST_GAIN = 1.06
"""Factor that makes up for the smaller weight of large innovations in the mean of normally distributed ones."""
MIN_UNUSUAL = 16.0
"""Squared Mahalanobis distance of an unusual innovation; one in seventy normally distributed ones exceeds it, more
where motion has heavy tails."""
MIN_UNUSUAL_MOTION = 0.005
"""Smallest squared length of an unusual innovation, about 3°."""
MAX_USUAL_MOTION = 0.1
"""Largest squared length of a usual innovation, about 14°: the refinement reaches no farther."""
UNREST_DECAY = 0.75
"""Factor by which the number of recent unusual innovations decreases in each frame."""
MAX_UNREST = 1.4
"""Number of recent unusual innovations from which the pose is not to be trusted: two within four frames. A hand starts
or stops; a wrong pose jumps again and again."""
MAX_CALM_UNREST = 0.5
"""Number of recent unusual innovations up to which motion is calm: none within three frames."""


class MotionModel:
    """The usual innovations of one part in one stream."""

    def __init__(self) -> None:
        self._covariance = PRIOR_SIGMA**2 * np.eye(6)
        self._unrest = 0.0

    @property
    def covariance(self) -> Array:
        """Covariance (6,6) of the usual innovations, with the noise of the measured poses."""
        return self._covariance + NOISE

    @property
    def is_calm(self) -> bool:
        """Whether none of the last innovations was unusual."""
        return self._unrest < MAX_CALM_UNREST

    @property
    def is_restless(self) -> bool:
        """Whether several of the last innovations were unusual, as those of a wrong pose are."""
        return self._unrest > MAX_UNREST

    def squared_distance(self, difference: Array, pose_covariance: Array | None = None) -> float:
        """Squared Mahalanobis distance of an innovation (6,).

        Args:
            difference: of `innovation`.
            pose_covariance: (6,6) of `normalised_covariance`, of the pose that was measured.
        """
        covariance = self.covariance if pose_covariance is None else self.covariance + pose_covariance
        return float(_squared_mahalanobis(difference, covariance))

    def is_unusual(self, difference: Array, pose_covariance: Callable[[], Array]) -> bool:
        """Whether an innovation (6,) is neither usual in this stream nor explained by the covariance of the pose.

        Args:
            difference: of `innovation`.
            pose_covariance: gives that of the pose (6,6), of `normalised_covariance`; seldom needed.
        """
        squared_length = difference @ difference
        if squared_length > MAX_USUAL_MOTION:
            return True
        if squared_length <= MIN_UNUSUAL_MOTION or self.squared_distance(difference) <= MIN_UNUSUAL:
            return False
        return self.squared_distance(difference, pose_covariance()) > MIN_UNUSUAL

    def learn(self, difference: Array, is_unusual: bool, is_confirmed: bool = False) -> None:
        """Take the innovation of a frame in; one confirmed by other means counts in full, however unusual.

        Args:
            difference: (6,) of `innovation`.
            is_unusual: see there.
            is_confirmed: whether the pose was confirmed or found by a recheck.
        """
        self._unrest = UNREST_DECAY * self._unrest + is_unusual
        weight = 1.0
        if not is_confirmed:
            weight = ROBUST_GAIN * min(1.0, MAX_SQUARED / max(self.squared_distance(difference), 1e-9))
        self._covariance += RATE * (weight * np.outer(difference, difference) - self._covariance)
