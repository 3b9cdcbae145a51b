"""Pose: the result of detection and tracking for one frame, with its uncertainty and the tracking state."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from arview.geometry import Array


class TrackingState(StrEnum):
    """State of a tracking session."""

    SEARCHING = "searching"
    TRACKED = "tracked"
    CRITICAL = "critical"
    LOST = "lost"


MAX_NAMES = 3
"""Unverified components listed by name in a status line; of more than these only the number is given."""


@dataclass(frozen=True)
class Pose:
    """The result for one frame.

    Attributes:
        cam_from_model: (4,4) OpenCV camera from model, mm; None while searching or lost.
        covariance: (6,6) of the twist (rotation rad, translation mm) applied on the right of
            ``cam_from_model`` about the model's centre; None without a pose.
        quality: 0–1; right poses mostly exceed 0.5, wrong ones mostly do not.
        state: see `TrackingState`.
        time_s: time stamp of the frame.
        index: index of the frame in its source.
        ms: time spent on detection and tracking of this frame, milliseconds.
        reason: why the state is ``searching``, ``critical`` or ``lost``, in words.
        mismatches: components that are not as in the CAD, e.g. ``mismatch: nut_2 not seen where expected``. A part
            with any is ``critical``, never ``tracked``, because it may be another member of a product family.
        unverified: names of the components that no frame so far has shown clearly at their nominal place, because
            they are hidden, face away or show too little. Any of them may be missing or displaced.
        alternatives: other poses (4,4) that the frames so far support equally well; if there are any, the view is
            ambiguous.
        guide_cam_from_model: (4,4) where the user should bring the part; None unless the session waits for that.
    """

    cam_from_model: Array | None
    covariance: Array | None
    quality: float
    state: TrackingState
    time_s: float
    index: int
    ms: float = 0.0
    reason: str = ""
    mismatches: tuple[str, ...] = ()
    unverified: tuple[str, ...] = ()
    alternatives: tuple[Array, ...] = ()
    guide_cam_from_model: Array | None = None

    def __repr__(self) -> str:
        if self.cam_from_model is None:
            return f"<Pose {self.index}: {self.state}>"
        x, y, z = self.cam_from_model[:3, 3]
        return f"<Pose {self.index}: {self.state}, quality {self.quality:.2f}, at {x:.1f}, {y:.1f}, {z:.1f} mm>"

    @property
    def remark(self) -> str:
        """Text for a status line: the reason, or, of a tracked part, the components not verified yet."""
        if self.state is not TrackingState.TRACKED or not self.unverified:
            return self.reason
        few = ", ".join(self.unverified) if len(self.unverified) <= MAX_NAMES else f"{len(self.unverified)} components"
        return f"not yet verified: {few}"
