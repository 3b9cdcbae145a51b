"""A station that plays the sample's clip, and says of the part what a test wants (see `told_session`)."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from unittest import mock

from arview.camera import Camera
from arview.live.stream.subject import Subject
from arview.video import VideoSink
from helpers import live_browser
from helpers.live_client import Running, running
from helpers.live_sample import INSPECTION, loader, options
from helpers.told_session import Told

FPS = 5


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
    start = Subject.session

    def session(subject: Subject, camera: Camera) -> Any:
        return Told(start(subject, camera), [one.name for one in subject.part.model.components])

    chosen = options(**{"source": str(path), "inspection": inspection, "record_folder": folder, **more})
    with mock.patch.object(Subject, "session", session), running(chosen, loader(chosen)) as server:
        yield server
