"""A station that plays the sample's clip and knows the true pose of each frame: for tests without a tracker.

What it says of the part beside the pose is in `told_session.TOLD`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np

from arview.geometry import Array
from arview.pose import ComponentPresence, Pose, Presence, TrackingState, Visibility
from arview.station.live.options import LiveOptions
from arview.station.live.stream.subjects import Subjects
from arview.video import Image, VideoSink
from helpers import live_browser, live_sample
from helpers.live_client import Running, running
from helpers.live_sample import INSPECTION, loader, options
from helpers.told_session import TOLD

FPS = 5
SMALL = 64, 36
"""Size at which frames are compared, px."""
PRESENT = ComponentPresence(Presence.PRESENT, Visibility.VISIBLE, 0.99, 9, 40.0)


class TrueSession:
    """Recognises frames whose poses (4,4) it knows."""

    estimate = None

    def __init__(self, images: Sequence[Image], truth: Sequence[Array], names: Sequence[str], camera: object) -> None:
        self.camera, self._truth = camera, truth
        self._small = np.stack([_small(image) for image in images])
        self._names = names

    def process(self, image: Image, index: int, time_s: float) -> tuple[Pose, ...]:
        number = int(np.argmin(np.abs(self._small - _small(image)).mean(axis=(1, 2, 3))))
        pose = Pose(self._truth[number], np.eye(6), 0.9, TrackingState.TRACKED, time_s, index, 1.0)
        told = replace(pose, **TOLD["more"])
        components = {**dict.fromkeys(self._names, PRESENT), **TOLD["components"]}
        return (replace(told, components=components if told.cam_from_model is not None else {}),)

    def expect(self, serials: Any) -> None:
        pass

    def reset(self, part: int | None) -> None:
        pass

    def confirm(self, part: int | None) -> None:
        pass

    def finish(self) -> None:
        pass


def _small(image: Image) -> Any:
    return cv2.resize(image, SMALL, interpolation=cv2.INTER_AREA).astype(np.float32)


def told_loader(chosen: LiveOptions) -> Callable[[], Subjects]:
    """What loads the sample, with sessions that recognise the frames of `live_sample`."""

    def load() -> Subjects:
        subjects = loader(chosen)()
        names = [one.name for one in subjects[0].part.model.components]
        images, truth = live_sample.frames(), live_sample.truth()
        vars(subjects)["session"] = lambda camera: TrueSession(images, truth, names, camera)
        return subjects

    return load


@contextmanager
def told_station(folder: Path, width: int, height: int, has_numbers: bool = True, **more: Any) -> Iterator[Running]:
    """A running station with a fresh inspection.

    Args:
        folder: for the clip, the inspection and recordings.
        width, height: of the clip.
        has_numbers: whether the number of each frame is drawn into its corner.
        more: further options of the server.
    """
    path = folder / "station.mp4"
    images = live_browser.plain_frames(width, height, live_browser.STRIDE, live_browser.COUNT)
    if has_numbers:
        images = live_browser.numbered(images)
    with VideoSink(path, width, height, FPS) as sink:
        for count, k in enumerate(live_browser.there_and_back()):
            sink.write(images[k], count / FPS)
    record = json.loads(INSPECTION.read_text())
    record["created"] = (datetime.now(UTC) - timedelta(minutes=30)).strftime("%Y-%m-%dT%H:%M:%SZ")
    inspection = folder / "inspection.json"
    inspection.write_text(json.dumps(record))

    def session(subjects: Subjects, camera: object) -> TrueSession:
        names = [one.name for one in subjects[0].part.model.components]
        return TrueSession(images, live_browser.truth(), names, camera)

    chosen = options(**{"source": str(path), "inspection": inspection, "record_folder": folder, **more})
    with mock.patch.object(Subjects, "session", session), running(chosen, loader(chosen)) as server:
        yield server
