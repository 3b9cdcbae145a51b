"""Session state: the table of transitions, and the counters that lead from one state to the next."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from arview.pose import TrackingState
from arview.tracking.disambiguation import HypothesisSet
from arview.tracking.session_state import TRANSITIONS, Event, SessionState

SEARCHING, TRACKED, CRITICAL, LOST = TrackingState
HAS_POSE = {TRACKED, CRITICAL}


def test_every_pair_of_state_and_event_leads_to_one_state_or_is_impossible() -> None:
    impossible = set(itertools.product(TrackingState, Event)) - set(TRANSITIONS)
    assert impossible == {
        (SEARCHING, Event.CONTRADICTED),
        (SEARCHING, Event.RETRACTED),
        (TRACKED, Event.RETRACTED),
        (LOST, Event.CONTRADICTED),
        (LOST, Event.RETRACTED),
    }
    for state, event in impossible:
        with pytest.raises(KeyError):
            SessionState(state).apply(event)


def test_support_tracks_weakness_warns_and_failure_keeps_the_part_lost() -> None:
    for state in TrackingState:
        assert TRANSITIONS[state, Event.SUPPORTED] == TRACKED
        assert TRANSITIONS[state, Event.WEAK] == CRITICAL
        assert TRANSITIONS[state, Event.FAILED] == (SEARCHING if state == SEARCHING else LOST)
    assert TRANSITIONS[TRACKED, Event.CONTRADICTED] == TRANSITIONS[CRITICAL, Event.CONTRADICTED] == CRITICAL
    assert TRANSITIONS[CRITICAL, Event.RETRACTED] == SEARCHING


def test_a_pose_is_found_confirmed_and_lost() -> None:
    s = SessionState()
    assert not s.has_pose
    s.begin(is_confirmed=False, is_given=False)
    assert (s.state, s.is_confirmed, s.was_tracked, s.has_pose) == (CRITICAL, False, False, True)
    s.confirm()
    assert (s.state, s.is_confirmed, s.was_tracked) == (TRACKED, True, True)
    s.poor_frames, s.critical_frames, s.frames_without_pose = 2, 3, 4
    s.hypotheses = HypothesisSet([np.eye(4)])
    s.lose("too dark")
    assert (s.state, s.is_confirmed, s.was_tracked) == (LOST, False, True)
    assert (s.poor_frames, s.critical_frames, s.frames_without_pose, len(s.hypotheses)) == (0, 0, 0, 0)
    assert (s.reason, s.loss_reason) == ("too dark", "too dark")


@pytest.mark.parametrize(("was_tracked", "expected"), [(False, SEARCHING), (True, LOST)])
def test_an_unconfirmed_pose_of_the_guide_view_is_retracted(was_tracked: bool, expected: TrackingState) -> None:
    s = SessionState(LOST if was_tracked else SEARCHING, was_tracked=was_tracked, frames_without_pose=7, reason="wait")
    s.begin(is_confirmed=False, is_given=False)
    s.retract()
    assert (s.state, s.frames_without_pose, s.reason, s.loss_reason) == (expected, 7, "wait", "")


def test_alternatives_are_dropped_or_chosen_by_the_sum_of_their_differences() -> None:
    turns = [np.diag([-1.0, -1.0, 1.0, 1.0]), np.diag([1.0, -1.0, -1.0, 1.0])]
    hypotheses = HypothesisSet(turns)
    np.testing.assert_array_equal(hypotheses.poses(np.eye(4)), turns)
    assert hypotheses.update(0.9, [0.7, 0.9]) is None
    assert len(hypotheses) == 2
    assert hypotheses.update(0.9, [0.7, 1.0]) is None
    assert len(hypotheses) == 1
    better = hypotheses.update(0.7, [0.9])
    assert better is not None
    np.testing.assert_array_equal(better, turns[1])
