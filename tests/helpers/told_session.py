"""Sessions that track, but say of the components what a test wants."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from arview.pose import ComponentPresence, Pose, Presence, Visibility
from arview.station.live.stream.subjects import Subjects
from helpers import live_browser
from helpers.inspection_loop import Stop, WalkSession


class Told:
    """A session whose poses say something of the components."""

    def __init__(self, session: Any, names: list[str]) -> None:
        self._session, self._names = session, names

    def __getattr__(self, name: str) -> Any:
        return getattr(self._session, name)

    def process(self, image: Any, index: int, time_s: float) -> tuple[Pose, ...]:
        return tuple(self._told(pose) for pose in self._session.process(image, index, time_s))

    def _told(self, pose: Pose) -> Pose:
        present = ComponentPresence(Presence.PRESENT, Visibility.VISIBLE, 0.99, 9, 40.0)
        components = {**dict.fromkeys(self._names, present), **TOLD["components"]}
        return replace(pose, components=components if pose.cam_from_model is not None else {}, **TOLD["more"])


TOLD: dict[str, dict[str, Any]] = {"components": {}, "more": {}}
"""What all sessions say: of components that are not present, and more fields of the pose."""


def numbered_session(subjects: Subjects, camera: Any) -> WalkSession:
    """A session that reads the place of the camera from the number in the film of `live_browser`."""
    names = [one.name for one in subjects[0].part.model.components]
    return WalkSession([Stop(b"", pose) for pose in live_browser.truth()], names, camera)
