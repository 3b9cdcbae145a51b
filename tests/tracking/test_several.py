"""Two specimens of one part in one stream: each keeps its own session, whatever happens to the other."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import cv2
import numpy as np
import pytest

from arview.cad import load_part
from arview.errors import InputError
from arview.fiducials.serial_code import SerialNumbers
from arview.geometry import Array
from arview.guideviews import GuideViewSet
from arview.guideviews.cache import cached_guide_views
from arview.pose import Pose, TrackingState
from arview.tracking import SpecimenTracking, TrackedPart, TrackingSession
from arview.tracking.search.search_plan import SEARCH_EVERY, SearchPlan
from arview.tracking.session_state import SessionState
from arview.tracking.several.specimens import hide_specimens, is_same_specimen, searched_picture
from arview.video import Image
from helpers import two_specimens
from helpers.live_sample import PART

NEAR_MM = 3.0
"""Largest error of the centre: the picture of the part is a seventh of a metre wide in 320 px."""
COVERED = range(6, 12)
"""Frames in which the left specimen is hidden."""


@cache
def views() -> GuideViewSet:
    part = load_part(str(PART))
    return cached_guide_views(part.model, part.effective_view_range)


def session_of(*parts: TrackedPart) -> TrackingSession:
    return TrackingSession(parts, two_specimens.wide_camera())


def tracked(name: str, of: GuideViewSet | None = None) -> TrackedPart:
    return TrackedPart(of or views(), load_part(str(PART)).model, name)


def error_mm(cam_from_model: Array, truth: Array) -> float:
    center = np.append(views().center_in_model, 1.0)
    return float(np.linalg.norm((cam_from_model @ center - truth @ center)[:3]))


def sides(poses: tuple[Pose, ...], truths: tuple[Array, Array]) -> list[int | None]:
    """Which specimen each pose lies on, 0 for the left one; None without a pose."""
    found: list[int | None] = []
    for pose in poses:
        if pose.cam_from_model is None:
            found.append(None)
            continue
        errors = [error_mm(pose.cam_from_model, truth) for truth in truths]
        assert min(errors) < NEAR_MM
        found.append(int(np.argmin(errors)))
    return found


def covered(image: Image) -> Image:
    """The picture with a cloth over its left half."""
    hidden = image.copy()
    width = image.shape[1] // 2
    grain = np.random.default_rng(0).normal(110.0, 6.0, (image.shape[0], width, 1))
    hidden[:, :width] = np.clip(cv2.GaussianBlur(grain, (0, 0), 1.0)[..., None], 0, 255).astype(np.uint8)
    return hidden


@pytest.mark.slow
def test_two_specimens_are_tracked_and_keep_their_names_through_an_occlusion() -> None:
    several, seen = session_of(tracked("one"), tracked("two")), []
    frames = two_specimens.frames()
    for index, (image, truths) in enumerate([*frames, *frames[-2::-1]]):
        shown = covered(image) if index in COVERED else image
        poses = several.process(shown, index, index / 10.0)
        assert [pose.instance for pose in poses] == ["one", "two"]
        if index in COVERED:
            # The last pose may linger for a moment; it never goes over to the other specimen.
            on_right = [pose for pose in poses if pose.state is TrackingState.TRACKED]
            assert all(error_mm(pose.cam_from_model, truths[1]) < NEAR_MM for pose in on_right)
            assert len(on_right) <= 1
        else:
            seen.append(sides(poses, truths))
    last = seen[-1]
    assert sorted(side for side in last if side is not None) == [0, 1]
    for name in range(2):
        assert {found[name] for found in seen} <= {None, last[name]}, "a specimen changed over"
    assert sum(found == last for found in seen) >= 12


def test_a_hidden_specimen_is_not_in_the_picture_any_longer() -> None:
    image, truths = two_specimens.frames()[3]
    camera = two_specimens.wide_camera()
    hidden = hide_specimens(image, truths[:1], views(), camera)
    corners = camera.project((truths[0] @ np.append(views().center_in_model, 1.0))[None, :3])[0]
    around = np.s_[int(corners[1]) - 30 : int(corners[1]) + 30, int(corners[0]) - 40 : int(corners[0]) + 40]
    before, after = (float(cv2.Laplacian(one[around], cv2.CV_64F).std()) for one in (image, hidden))
    assert after < 0.15 * before
    right = np.s_[:, image.shape[1] // 2 + 60 :]
    np.testing.assert_array_equal(hidden[right], image[right])
    assert hide_specimens(image, (), views(), camera) is image


@pytest.mark.slow
def test_another_part_that_is_tracked_is_hidden_from_the_first_round_of_searches_only() -> None:
    """Guide views made anew stand for another part: it looks the same, and is found only where the first is not."""
    camera, others = two_specimens.wide_camera(), replace(views())
    several = session_of(tracked("one"), tracked("two", others))
    second = several.specimens[1].search
    frames = two_specimens.frames()
    for index, (image, _) in enumerate(frames[:4]):
        poses = several.process(image, index, index / 10.0)
    found = sides(poses, frames[3][1])
    assert sorted(side for side in found if side is not None) == [0, 1]
    assert len(second.covers) == 1 and second.others == ()
    # A part may stand on another: in the next round nothing is hidden.
    plan = SearchPlan(others, camera)
    assert plan.hides_parts(SessionState(frames_without_pose=1))
    assert not plan.hides_parts(SessionState(frames_without_pose=2 * SEARCH_EVERY))
    assert searched_picture(image, (), second.covers, others, camera) is not image
    assert searched_picture(image, (), (), others, camera) is image
    # Nor is a place hidden at which the other part is not sure.
    several._poses[0] = replace(several._poses[0], state=TrackingState.CRITICAL)
    assert several._covers(1) == ()


def test_specimens_are_told_apart_by_their_place() -> None:
    _, (left, right) = two_specimens.frames()[3]
    assert not is_same_specimen(left, right, views())
    moved = left.copy()
    moved[0, 3] += 5.0
    assert is_same_specimen(left, moved, views())


class ScriptedSpecimen(SpecimenTracking):
    """A specimen that is tracked from the first frame on, or never found; it counts its frames."""

    def __init__(self, is_found: bool) -> None:
        super().__init__(views(), two_specimens.wide_camera(), load_part(str(PART)).model)
        self.is_found, self.calls = is_found, 0

    @property
    def has_pose(self) -> bool:
        return self.is_found and self.calls > 0

    def process(self, image: Image, index: int, time_s: float, *_: object) -> Pose:
        self.calls += 1
        state = TrackingState.TRACKED if self.is_found else TrackingState.SEARCHING
        return Pose(np.eye(4) if self.is_found else None, None, 1.0, state, time_s, index)


@pytest.mark.slow
def test_a_part_that_is_not_found_is_soon_searched_for_in_every_third_frame_only() -> None:
    several = session_of(tracked("found"), tracked("missing"))
    several.specimens = found, missing = ScriptedSpecimen(True), ScriptedSpecimen(False)
    image = two_specimens.frames()[0][0]
    searched = []
    for index in range(36):
        before = missing.calls
        several.process(image, index, index / 30.0)
        searched.append(missing.calls > before)
    assert found.calls == 36
    assert not searched[0] and all(searched[1:6]), "one search a frame, and at first in every one"
    assert 9 <= sum(searched[6:]) <= 11


def test_a_session_without_a_part_is_refused() -> None:
    with pytest.raises(InputError, match="no part"):
        session_of()


def test_specimens_of_one_part_share_their_detector() -> None:
    first, second = session_of(tracked("one"), tracked("two")).specimens
    assert first.search.detector is second.search.detector


def test_each_specimen_is_confirmed_and_reset_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    session = session_of(tracked("one"), tracked("other"))
    told: list[list[object]] = [[], []]
    for specimen, calls in zip(session.specimens, told, strict=True):
        monkeypatch.setattr(specimen, "confirm", partial(calls.append, "confirm"))
        monkeypatch.setattr(specimen, "reset", partial(calls.append, "reset"))
        monkeypatch.setattr(specimen.identity, "expect", calls.append)
    session.confirm(1)
    assert told == [[], ["confirm"]]
    session.confirm()  # it is not known which one is meant
    session.reset(0)
    assert told == [["reset"], ["confirm"]]
    session.reset()
    session.expect([SerialNumbers("1"), None])
    assert told == [["reset", "reset", SerialNumbers("1")], ["confirm", "reset", None]]
