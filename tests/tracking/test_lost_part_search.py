"""Search for a lost part: how often, how widely, and how soon it is found where it appears again."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from arview.detection.detector import Detection
from arview.pose import TrackingState
from arview.tracking import SessionOptions, SpecimenTracking
from helpers.synthetic import CAMERA, assembly, assembly_views, error, path, picture

OPTIONS = SessionOptions()


class RecordingDetector:
    """Finds nothing, and records the searches of each frame."""

    wider_searches = (1, 2, 3)
    best_rejected = None

    def __init__(self) -> None:
        self.made: dict[int, list[int] | None] = {}
        self.frame = 0

    def detect(self, image: NDArray[np.uint8], searches: list[int] | None = None, **_: Any) -> list[Detection]:
        self.made[self.frame] = searches
        return []


def searches_of(images: list[NDArray[np.uint8]], state: TrackingState = TrackingState.LOST) -> dict[int, Any]:
    """The searches by frame, the first of which is 1."""
    session = SpecimenTracking(assembly_views(), CAMERA, assembly(), OPTIONS)
    detector = vars(session.search)["_detector"] = RecordingDetector()
    session._state.state = state
    for frame, image in enumerate(images, 1):
        detector.frame = frame
        assert session.process(image, frame, frame / 30).cam_from_model is None
    return detector.made


def still(count: int, scene: int = 2) -> list[NDArray[np.uint8]]:
    shots = [picture(None, seed=k, scene=scene, noise=5.0) for k in range(4)]
    return [shots[k % 4] for k in range(count)]


def moving(count: int) -> list[NDArray[np.uint8]]:
    wide = np.concatenate([picture(None, scene=k, noise=3.0) for k in range(4)], axis=1)
    return [np.ascontiguousarray(wide[:, 30 * k : 30 * k + 640]) for k in range(count)]


def test_a_picture_in_which_nothing_changes_is_searched_completely_once_a_second() -> None:
    made = searches_of(still(50))
    assert made == {1: [0], 2: [0], 6: [1], 9: [2], 12: [3], 42: [1], 45: [2], 48: [3]}


def test_a_picture_that_changes_is_searched_every_third_frame_and_now_and_then_thoroughly() -> None:
    made = searches_of(moving(46))
    assert list(made) == [1, 2, *range(5, 47, 3)]
    thorough = {frame: searches for frame, searches in made.items() if searches != [0]}
    assert thorough == {8: [1], 11: [2], 14: [3], 38: [1], 41: [2], 44: [3]}


@pytest.mark.parametrize("changed_frame", [20, 21, 22])
def test_the_first_frame_that_shows_something_else_is_searched(changed_frame: int) -> None:
    made = searches_of([*still(changed_frame - 1), *still(3, scene=3)])
    assert min(frame for frame in made if frame > 12) == changed_frame


def test_a_part_that_was_never_found_is_searched_in_the_first_frames_and_then_like_a_lost_one() -> None:
    made = searches_of(moving(40), TrackingState.SEARCHING)
    first = {frame: None if frame % 6 == 1 else [0] for frame in range(1, 13)}
    assert {frame: searches for frame, searches in made.items() if frame <= 12} == first
    assert [frame for frame in made if frame > 12] == list(range(13, 41, 3))
    assert [made[frame] for frame in (13, 16, 19, 22)] == [[1], [2], [3], [0]]


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [17, 25])
def test_a_part_shown_again_is_found_within_three_frames(hidden: int) -> None:
    poses = path(16)
    session = SpecimenTracking(assembly_views(), CAMERA, assembly(), OPTIONS, initial_cam_from_model=poses[0])
    for k, pose in enumerate(poses[:10]):
        tracked = session.process(picture(pose, seed=k, scene=1), k, k / 30)
    assert tracked.state == TrackingState.TRACKED
    for k in range(hidden):
        lost = session.process(picture(None, seed=k, scene=5, noise=4.0), 10 + k, 1.0)
    assert lost.state == TrackingState.LOST
    found = [session.process(picture(pose, seed=50 + k, scene=1), 100 + k, 3.0) for k, pose in enumerate(poses[10:])]
    first = next(k for k, pose in enumerate(found) if pose.cam_from_model is not None)
    assert first <= 3
    last = found[-1]
    assert last.state == TrackingState.TRACKED and last.cam_from_model is not None
    assert error(last.cam_from_model, poses[-1])[0] < 4.0
