"""What a feed tracks with: one session for one part, or a session for each of several, with the same methods."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from arview import tracking
from arview.camera import Camera
from arview.fiducials import SerialNumbers
from arview.pose import Pose
from arview.video import Image


class FeedSession(Protocol):
    """The tracking of all parts of a feed. Parts are numbered from 0."""

    @property
    def camera(self) -> Camera | None:
        """The camera in use where it is replaced while the session runs, else None."""
        ...

    @property
    def estimate(self) -> tracking.FocalEstimate | None:
        """The last estimate of a guessed camera; None without one."""
        ...

    def process(self, image: Image, index: int, time_s: float) -> tuple[Pose, ...]:
        """Pose of each part in the next frame."""
        ...

    def expect(self, serials: Sequence[SerialNumbers | None]) -> None:
        """Serial numbers to which the labels of the parts belong."""
        ...

    def reset(self, part: int | None) -> None:
        """Search again for a part, or for all of them."""
        ...

    def confirm(self, part: int | None) -> None:
        """The user says that the part in view is the one to which its labels belong; None: the only one."""
        ...

    def finish(self) -> tracking.FocalEstimate | None:
        """The estimate of a guessed camera from all frames, after the last one; None where it is not estimated."""
        ...


class OnePartSession:
    """One part in one stream; a guessed camera is replaced once its focal length is known."""

    def __init__(self, session: tracking.TrackingSession | tracking.SelfCalibratingSession) -> None:
        self._session = session

    @property
    def camera(self) -> Camera | None:
        """See `FeedSession`."""
        return self._session.camera if isinstance(self._session, tracking.SelfCalibratingSession) else None

    @property
    def estimate(self) -> tracking.FocalEstimate | None:
        """See `FeedSession`."""
        return self._session.estimate if isinstance(self._session, tracking.SelfCalibratingSession) else None

    def process(self, image: Image, index: int, time_s: float) -> tuple[Pose, ...]:
        """See `FeedSession`."""
        return (self._session.process(image, index, time_s),)

    def expect(self, serials: Sequence[SerialNumbers | None]) -> None:
        """See `FeedSession`."""
        self._session.identity.expect(serials[0])

    def reset(self, part: int | None) -> None:
        """See `FeedSession`."""
        self._session.reset()

    def confirm(self, part: int | None) -> None:
        """See `FeedSession`."""
        self._session.confirm()

    def finish(self) -> tracking.FocalEstimate | None:
        """See `FeedSession`."""
        return self._session.finish() if isinstance(self._session, tracking.SelfCalibratingSession) else None


class SeveralPartsSession:
    """Several parts in one stream, each with a session of its own. A guessed camera is kept."""

    camera: Camera | None = None
    estimate: tracking.FocalEstimate | None = None

    def __init__(self, several: tracking.SeveralSessions) -> None:
        self._several = several
        self._sessions = tuple(several.sessions.values())

    def process(self, image: Image, index: int, time_s: float) -> tuple[Pose, ...]:
        """See `FeedSession`."""
        return self._several.process(image, index, time_s)

    def expect(self, serials: Sequence[SerialNumbers | None]) -> None:
        """See `FeedSession`."""
        for session, numbers in zip(self._sessions, serials, strict=True):
            session.identity.expect(numbers)

    def reset(self, part: int | None) -> None:
        """See `FeedSession`."""
        for session in self._sessions if part is None else [self._sessions[part]]:
            session.reset()

    def confirm(self, part: int | None) -> None:
        """See `FeedSession`; without a part nothing is confirmed, because it is not known which one is meant."""
        if part is not None:
            self._sessions[part].confirm()

    def finish(self) -> tracking.FocalEstimate | None:
        """See `FeedSession`."""
        return None
