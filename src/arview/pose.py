"""Pose: where the part is in one frame, how sure that is, and in which state the tracking is."""

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


MOST_NAMED = 3
"""More components are counted, not named, in a status line."""


@dataclass(frozen=True)
class Pose:
    """The answer for one frame.

    Attributes:
        cam_from_model: (4,4) OpenCV camera from model, mm; None while searching or lost.
        covariance: (6,6) of the twist (rotation rad, translation mm) applied on the right of
            ``cam_from_model`` about the model's centre; None when there is no pose.
        quality: 0–1, separates right from wrong poses at about 0.5.
        state: see TrackingState.
        time_s: time stamp of the frame.
        index: index of the frame in its source.
        ms: time spent on detection and tracking of this frame, milliseconds.
        reason: for ``searching``, ``critical`` and ``lost``: why, in words.
        mismatches: what is not as the CAD says, e.g. ``mismatch: nut_2 not seen where expected``; a part with
            any is never ``tracked`` but ``critical``: it may be another part of the family.
        unverified: names of components not yet confirmed at their place by any observation, because they are hidden,
            face away or are too small in the picture. They may be missing or misplaced.
        alternatives: other poses (4,4) that the frames so far bear out as well; not empty: the view is ambiguous.
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

    @property
    def remark(self) -> str:
        """What a status line says beside the state: the reason, or which components have not been seen yet."""
        if self.state is not TrackingState.TRACKED or not self.unverified:
            return self.reason
        few = ", ".join(self.unverified) if len(self.unverified) <= MOST_NAMED else f"{len(self.unverified)} components"
        return f"not surely seen yet: {few}"
