"""Estimate: the result of the tracker for one frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from arview.geometry import Array
from arview.refinement import PoseEvidence, apply_twist, relative_twist


@dataclass(frozen=True)
class Estimate:
    """Pose of the part in one frame, before the session decides on the state.

    Attributes:
        cam_from_model: (4,4) mm.
        information: (6,6) of the twist (rad, mm) on the right of the pose, about the model's centre.
        quality: 0–1, support of the picture by which the state is chosen, see `PoseEvidence.quality`.
        evidence: evidence of the picture for the pose.
        is_restless: whether the pose jumped in several of the last frames, as a wrong one does, see `MotionModel`.
        texture_share: share of the expected texture that was found; 0 where it was not used.
    """

    cam_from_model: Array
    information: Array
    quality: float
    evidence: PoseEvidence
    is_restless: bool = False
    texture_share: float = 0.0


MAX_CONTRADICTION = 22.5
"""Squared Mahalanobis distance above which a prior contradicts the picture: one in a thousand exceeds it by chance."""


class PosePrior(NamedTuple):
    """What is known of the pose in a frame from elsewhere: a robot, a phone that knows its own motion, a station.

    Attributes:
        cam_from_model: (4,4) mm.
        covariance: (6,6) of the twist (rotation rad, translation mm) on its right about the model's centre, as
            `Pose.covariance`; None: it is only where the part is looked for.
    """

    cam_from_model: Array
    covariance: Array | None = None

    def joined(self, cam_from_body: Array, body_from_model: Array, covariance: Array) -> tuple[Array, Array]:
        """The mean of a measured pose (4,4) and the prior, weighted by their covariances, and its covariance (6,6).

        A prior that contradicts the measured pose is left out.
        """
        if self.covariance is None:
            return cam_from_body, covariance
        apart = relative_twist(cam_from_body, self.cam_from_model @ np.linalg.inv(body_from_model))
        both = covariance + self.covariance
        if apart @ np.linalg.solve(both, apart) > MAX_CONTRADICTION:
            return cam_from_body, covariance
        gain = np.linalg.solve(both, covariance).T
        joined = covariance - gain @ covariance
        return apply_twist(cam_from_body, gain @ apart), 0.5 * (joined + joined.T)
