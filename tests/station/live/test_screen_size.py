"""Annotated video for the size of a screen: no larger than it, with labels that can be read there."""

from __future__ import annotations

import numpy as np
import pytest

from arview.pose import Pose, TrackingState
from arview.station.live.stream.annotator import FrameAnnotator, Screen
from arview.station.live.stream.feed import TrackedFrame
from arview.station.live.stream.frames import DecodedFrame
from arview.station.live.stream.subject import OverlayStyle
from helpers import live_browser
from helpers.live_sample import loader, options

SIZE = 1280, 720
TEXT_CSS_PX = 13.0


def tracked() -> TrackedFrame:
    width, height = SIZE
    pose = Pose(live_browser.truth()[0], np.eye(6), 0.9, TrackingState.TRACKED, 0.0, 0, 1.0)
    picture = DecodedFrame(7, live_browser.frames(width, height)[0])
    return TrackedFrame(picture, (pose,), live_browser.camera(width, height), 1.0, 1.01, 1.03, 0, 1, 0)


@pytest.mark.parametrize(
    ("screen", "size"),
    [
        (Screen(780, 438, 2.0), (778, 438)),  # a phone in portrait
        (Screen(390, 220, 1.0), (390, 220)),
        (Screen(2560, 1440, 1.0), SIZE),  # never enlarged
    ],
)
def test_pictures_and_text_fit_the_screen(screen: Screen, size: tuple[int, int]) -> None:
    camera = screen.fitted(live_browser.camera(*SIZE))
    assert (camera.width, camera.height) == size
    shown_px = screen.text_px(camera) * screen.width / camera.width / screen.density
    assert shown_px >= TEXT_CSS_PX * 0.95
    assert shown_px <= TEXT_CSS_PX * 1.05 or screen.text_px(camera) == 9


@pytest.mark.slow
def test_the_overlay_of_a_small_picture_is_where_the_large_one_has_it() -> None:
    subjects = loader(options())()
    annotator = FrameAnnotator(subjects)
    frame, style = tracked(), OverlayStyle(edges="none", labels=False, status=False, opacity=0.9)
    plain = OverlayStyle(ghost=False, edges="none", labels=False, status=False)
    screen = Screen(640, 360, 1.0)
    masks = []
    for target in (None, screen):
        drawn, bare = (annotator.draw(frame, one, target).image for one in (style, plain))
        assert drawn.shape == ((360, 640, 3) if target else (720, 1280, 3))
        masks.append(live_browser.difference_mask(drawn, bare, 12))
    large, small = masks
    assert small.sum() > 4000
    halved = (large.reshape(360, 2, 640, 2).mean(axis=(1, 3)) > 0.5).astype(np.uint8)
    shared = {(x, y): (halved & np.roll(small, (y, x), axis=(0, 1))).sum() for x in range(-3, 4) for y in range(-3, 4)}
    assert max(shared, key=lambda shift: shared[shift]) == (0, 0)
    assert shared[0, 0] > 0.85 * small.sum()
