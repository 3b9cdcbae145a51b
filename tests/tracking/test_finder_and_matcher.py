"""A finder in place of the detector, and a matcher as one more modality, given to a session by its options."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from numpy.typing import NDArray

from arview.cad import ViewRange
from arview.detection import Detection
from arview.geometry import Array, apply
from arview.guideviews import GuideViewOptions
from arview.guideviews.cache import cached_guide_views
from arview.pose import TrackingState
from arview.tracking import PointMatches, SessionOptions, Tracker, TrackerOptions, TrackingSession
from arview.tracking.specimen import PLAIN_FACE
from helpers.synthetic import (
    CAMERA,
    assembly,
    assembly_views,
    background,
    block,
    error,
    path,
    picture,
    pose_from,
    wrong,
)

POSES = path(12)
ALL_ROUND = ViewRange((300.0, 640.0), elevation_deg=(-10.0, 75.0), azimuth_deg=(-80.0, 80.0), roll_deg=(-20.0, 20.0))
POINTS_MM = np.random.default_rng(3).uniform((0.0, 0.0, 12.0), (160.0, 120.0, 12.0), (60, 3))
"""Points of the plate that a matcher finds."""


@dataclass
class ToldFinder:
    """Finds the part where it is told, if at all."""

    cams_from_model: list[Array]
    asked: int = 0
    quality: float = 0.9

    def detect(self, image: NDArray[np.uint8]) -> list[Detection]:
        assert image.shape == (CAMERA.height, CAMERA.width, 3)
        self.asked += 1
        return [Detection(pose, self.quality) for pose in self.cams_from_model]


@dataclass
class ToldMatcher:
    """Finds points of the plate to ``noise_px``; the frames are those of `POSES` from the second on."""

    noise_px: float
    predicted: list[Array] = field(default_factory=list)

    def match(self, image: NDArray[np.uint8], cam_from_model: Array) -> PointMatches:
        self.predicted.append(cam_from_model)
        pixels = CAMERA.project(apply(POSES[len(self.predicted)], POINTS_MM))
        noise = np.random.default_rng(len(self.predicted)).normal(0.0, self.noise_px, pixels.shape)
        return PointMatches(POINTS_MM, pixels + noise, np.ones(len(POINTS_MM)))


def last_pose(finder: ToldFinder, monkeypatch: pytest.MonkeyPatch) -> tuple[TrackingState, Array | None]:
    """State and pose after four frames; the detector itself is never asked."""
    monkeypatch.setattr("arview.detection.Detector.detect", lambda *_, **__: pytest.fail("the detector was asked"))
    session = TrackingSession.of(assembly_views(), CAMERA, assembly(), SessionOptions(finder=finder))
    for index, truth in enumerate(POSES[:4]):
        (pose,) = session.process(picture(truth, seed=index), index, index / 30.0)
    assert finder.asked
    return pose.state, pose.cam_from_model


def test_what_a_finder_finds_is_refined_and_tracked(monkeypatch: pytest.MonkeyPatch) -> None:
    state, found = last_pose(ToldFinder([wrong(POSES[0], np.random.default_rng(5), 4.0, 2.0)]), monkeypatch)
    assert state is TrackingState.TRACKED and found is not None
    mm, _, deg = error(found, POSES[3])
    assert mm < 1.5 and deg < 0.5


def test_a_pose_is_no_surer_than_what_found_it_until_other_views_confirm_it() -> None:
    """The picture supports the pose from the first frame on, but the finder gave it 0.7; then the camera goes round."""
    truths = [pose_from(40.0 + angle_deg, 35.0, 520.0) for angle_deg in (0.0, 0.0, 3.0, 6.0, 9.0, 12.0, 15.0, 18.0)]
    options = SessionOptions(finder=ToldFinder([truths[0]], quality=0.7))
    session = TrackingSession.of(assembly_views(), CAMERA, assembly(), options)
    poses = [session.process(picture(truth, seed=k), k, k / 30.0)[0] for k, truth in enumerate(truths)]
    assert {pose.state for pose in poses} == {TrackingState.TRACKED}
    assert [pose.quality for pose in poses[:4]] == [0.7] * 4
    assert min(pose.quality for pose in poses[-2:]) > 0.9


def test_one_plain_face_is_ambiguous_until_another_side_is_seen() -> None:
    """A block is found from in front, where any rectangle fits as well; then the camera goes round it."""
    truths = [pose_from(angle_deg, 0.0, 420.0, block()) for angle_deg in (0.0, 0.0, 0.0, 8.0, 16.0, 24.0)]
    views = cached_guide_views(block(), ALL_ROUND, GuideViewOptions(renderer="zbuffer"))
    session = TrackingSession.of(views, CAMERA, block(), SessionOptions(finder=ToldFinder([truths[0]])))
    poses = [session.process(picture(truth, block(), seed=k), k, k / 30.0)[0] for k, truth in enumerate(truths)]
    assert [pose.state for pose in poses] == [TrackingState.CRITICAL] * 3 + [TrackingState.TRACKED] * 3
    assert {pose.reason for pose in poses[:3]} == {PLAIN_FACE}
    assert poses[-1].cam_from_model is not None and error(poses[-1].cam_from_model, truths[-1], block())[2] < 0.5


def test_what_is_not_found_is_not_tracked(monkeypatch: pytest.MonkeyPatch) -> None:
    assert last_pose(ToldFinder([]), monkeypatch) == (TrackingState.SEARCHING, None)


def test_what_is_found_but_not_there_is_not_tracked() -> None:
    finder = ToldFinder([POSES[0]])
    session = TrackingSession.of(assembly_views(), CAMERA, assembly(), SessionOptions(finder=finder))
    poses = [session.process(background(seed), seed, seed / 30.0)[0] for seed in range(3)]
    assert finder.asked == 3 and {pose.state for pose in poses} == {TrackingState.SEARCHING}


def test_points_of_a_matcher_support_the_pose() -> None:
    """With colours alone the part is followed less exactly than with points that are found to 0.3 px as well."""
    medians = []
    matcher = ToldMatcher(0.3)
    for one in (None, matcher):
        tracker = Tracker(
            assembly_views(), CAMERA, assembly(), TrackerOptions(use_edge=False, use_texture=False, matcher=one)
        )
        tracker.start(picture(POSES[0], seed=0), POSES[0])
        errors = [
            error(tracker.track(picture(truth, seed=k)).cam_from_model, truth)
            for k, truth in enumerate(POSES[1:], start=1)
        ]
        medians.append(np.median(errors, axis=0))
    assert len(matcher.predicted) == len(POSES) - 1
    assert all(error(one, truth)[2] < 5.0 for one, truth in zip(matcher.predicted, POSES[1:], strict=True))
    colors_only, with_points = medians
    assert (with_points[1:] < 0.7 * colors_only[1:]).all() and with_points[0] < colors_only[0], medians
