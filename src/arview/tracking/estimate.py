"""Estimate: the result of the tracker for one frame."""

from __future__ import annotations

from dataclasses import dataclass

from arview.geometry import Array
from arview.refinement import PoseEvidence


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
