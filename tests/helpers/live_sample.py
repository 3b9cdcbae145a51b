"""The sample clip as the camera of a page: small frames, their true poses, and errors of poses."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import cv2
import numpy as np
import pytest

from arview.geometry import Array
from arview.station.live.options import LiveOptions, RequestLimits
from arview.station.live.security import connections
from arview.station.live.server import app, hub
from arview.station.live.server.loading import load_subjects
from arview.station.live.stream.subjects import Subjects
from arview.video import Image, open_source
from helpers.paths import SAMPLES

SAMPLE = SAMPLES / "bracket_plate"
PART, CAMERA, INSPECTION, CLIP = (SAMPLE / name for name in ("part.toml", "camera.json", "inspection.json", "clip.mp4"))
WIDTH, HEIGHT = 640, 360
START, STRIDE, COUNT = 27, 3, 16
"""Every third frame: the part moves 2.3 to 4.6 mm from one to the next, far more than a pose is wrong."""
CENTER_IN_MODEL = np.array([0.0, 0.0, 26.0])


@cache
def frames() -> list[Image]:
    """(360,640,3) frames of the clip in which the part is in full view."""
    source = open_source(CLIP, start=START, end=START + COUNT * STRIDE, stride=STRIDE)
    return [cv2.resize(frame.image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA) for frame in source]


@cache
def truth() -> list[Array]:
    """``cam_from_model`` (4,4) mm of each."""
    described = json.loads((SAMPLE / "truth.json").read_text())["frames"]
    return [np.array(described[START + STRIDE * k]["cam_from_model"]) for k in range(COUNT)]


def there_and_back() -> list[int]:
    """Order of the frames in a loop without jumps: forwards, then backwards."""
    return [*range(COUNT), *range(COUNT - 2, 0, -1)]


@contextmanager
def patience() -> Iterator[None]:
    """Servers accept any rate of handshakes and wait longer than usual, because tests share their cores."""
    with pytest.MonkeyPatch.context() as patched:
        for name in ("HANDSHAKES_PER_S", "HANDSHAKES_BURST"):
            patched.setattr(connections, name, 1e6)
        patched.setattr(hub, "JPEG_SILENCE_S", 120.0)
        patched.setattr(hub, "CONNECT_TIMEOUT_S", 60.0)
        patched.setattr(app, "TRACKING_TIMEOUT_S", 60.0)
        yield


def options(**more: Any) -> LiveOptions:
    """Options of a server that shows the sample to phones, without rate limits; `patience` does the rest."""
    usual: dict[str, Any] = {
        "camera": str(CAMERA), "inspections": (INSPECTION,), "width": WIDTH, "height": HEIGHT,
        "requests": RequestLimits(
            per_s=1e6, burst=1e6, unauthenticated_per_s=1e6, unauthenticated_burst=1e6, joins_per_s=1e6, joins_burst=1e6
        ),
    }  # fmt: skip
    if "inspection" in more:
        more["inspections"] = () if (path := more.pop("inspection")) is None else (path,)
    return LiveOptions(**{**usual, **more})


def loader(chosen: LiveOptions, instances: int = 1) -> Callable[[], Subjects]:
    """A function that loads the part of the sample, or several specimens of it."""
    return lambda: load_subjects([str(PART)], None, None, chosen, instances=instances)


def errors(answer: dict[str, Any], cam_from_model: Array) -> tuple[float, float]:
    """Errors of a pose: of the centre of the part, mm, and of the rotation, degrees."""
    found = np.array(answer["cam_from_model"]).reshape(4, 4)
    center = np.append(CENTER_IN_MODEL, 1.0)
    turn = found[:3, :3].T @ cam_from_model[:3, :3]
    angle_deg = np.degrees(np.arccos(np.clip(0.5 * (np.trace(turn) - 1.0), -1.0, 1.0)))
    return float(np.linalg.norm((found @ center - cam_from_model @ center)[:3])), float(angle_deg)


def nearest(answer: dict[str, Any]) -> int:
    """Index of the frame whose true pose is nearest to the one of a response."""
    return int(np.argmin([errors(answer, pose)[0] for pose in truth()]))
