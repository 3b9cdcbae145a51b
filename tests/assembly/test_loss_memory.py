"""A part found again after a short loss: what was known of its components, and how it lies, holds at once."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from arview.assembly.loss_memory import KnownBefore, LossMemory
from arview.assembly.monitor import AssemblyMonitor
from arview.assembly.turned_poses import Turn, TurnEvidence
from arview.geometry import Array, exp_so3, rigid
from arview.pose import ComponentPresence, Presence
from helpers.synthetic import CAMERA, assembly, assembly_views, pose_from

NAMES = tuple(one.name for one in assembly().components)
POSE = pose_from(10, 45, 520)
BRIEF = LossMemoryOptions().brief_frames


@cache
def monitor() -> AssemblyMonitor:
    return AssemblyMonitor(assembly_views(), CAMERA, assembly())


def known_bare() -> AssemblyMonitor:
    """A monitor that knows that all components but the plate are missing, and that the part is not turned."""
    found = monitor()
    found.forget()
    state = found._state
    state.log_odds = np.array([-6.0, *([5.5] * (len(NAMES) - 1))])
    state.is_verified = state.log_odds < 0.0
    state.is_mismatched, state.is_missing = state.log_odds > 0.0, state.log_odds > 0.0
    state.observations = 8
    found._turned.exclude(frozenset(range(len(found._turned.turns))))
    return found


def said(found: AssemblyMonitor) -> dict[str, ComponentPresence]:
    return {name: one for name, one in found.presence(POSE).items() if name != "plate"}


def upright(found: AssemblyMonitor) -> Turn:
    return next(turn for turn in found._turned.turns if turn.model_from_model[2, 2] > 0.9)


def lost_and_found(found: AssemblyMonitor, pose: Array, frames_lost: int) -> None:
    """The part is lost, and found again at a pose by its base alone."""
    found.set_aside(POSE)
    found.reset()
    found.is_placed = False
    found.resume(pose, frames_lost)


def test_a_part_that_lies_as_before_is_known_at_once() -> None:
    found = known_bare()
    assert all(one.presence is Presence.MISSING for one in said(found).values())
    lost_and_found(found, pose_from(30, 40, 540), 6)
    assert found.is_placed and found.other_poses(POSE) == ()
    assert all(one.presence is Presence.MISSING for one in said(found).values())


@pytest.mark.parametrize(
    ("turn_deg", "frames_lost"),
    [(180.0, 6), (90.0, 6), (20.0, BRIEF + 1)],
    ids=["half a turn", "a quarter turn", "a long loss"],
)
def test_a_part_that_may_have_been_turned_is_open_again(turn_deg: float, frames_lost: int) -> None:
    found = known_bare()
    lost_and_found(found, pose_from(10 + turn_deg, 45, 520), frames_lost)
    assert not found.is_placed and len(found.other_poses(POSE)) == 3
    assert all(one.presence is Presence.UNCERTAIN for one in said(found).values())


def test_what_was_sure_before_the_loss_holds_again_when_the_part_was_found_turned() -> None:
    found = known_bare()
    lost_and_found(found, POSE @ upright(found).model_from_model, 6)
    found.turn(upright(found))
    share = LossMemoryOptions().carried_share
    assert np.allclose(found._state.log_odds[1:], share * 5.5)
    assert found._state.is_missing[1:].all()
    # The same turn where nothing had ruled it out before: nothing is known of places that were not looked at.
    found = known_bare()
    found._turned.reset()
    lost_and_found(found, POSE, 6)
    found.turn(upright(found))
    assert not found._state.is_missing.any() and np.all(found._state.log_odds[1:] == 0.0)
    # Nor where another specimen was found, so that nothing was taken up.
    found = known_bare()
    found.set_aside(POSE)
    found.reset()
    found.turn(upright(found))
    assert not found._state.is_missing.any() and np.all(found._state.log_odds == 0.0)


def test_a_bare_base_is_found_as_it_lay_before_a_short_loss() -> None:
    turned, nothing = known_bare()._turned, TurnEvidence(np.zeros(len(NAMES)), 0.8)
    half = upright(monitor()).model_from_model
    memory = LossMemory()
    memory.set_aside(KnownBefore(monitor()._state, frozenset(), frozenset(), True), POSE)
    best = turned.best(POSE @ half, lambda pose: nothing, lambda pose: memory.is_as_before(pose, 4))
    assert np.allclose(best, POSE, atol=1e-6)
    best = turned.best(POSE @ half, lambda pose: nothing, lambda pose: memory.is_as_before(pose, BRIEF + 1))
    assert np.allclose(best, POSE @ half)
    # What the picture shows of the components counts for more.
    seen = TurnEvidence(np.where(np.arange(len(NAMES)) > 0, 2.0, 0.0), 0.8)
    best = turned.best(
        POSE @ half,
        lambda pose: seen if np.allclose(pose, POSE @ half) else nothing,
        lambda pose: memory.is_as_before(pose, 4),
    )
    assert np.allclose(best, POSE @ half)


def test_how_the_part_lay_is_unknown_without_a_pose_before_the_loss() -> None:
    memory = LossMemory()
    known = KnownBefore(monitor()._state, frozenset({0}), frozenset({0, 1}), True)
    memory.set_aside(known, None)
    assert not memory.is_as_before(POSE, 1)
    assert memory.still_known(POSE, 1) == (frozenset(), False)
    memory.set_aside(known, POSE)
    tilted = POSE @ rigid(exp_so3([0.0, 0.0, np.deg2rad(30.0)]), np.zeros(3))
    assert memory.still_known(tilted, 1) == (frozenset({0}), True)
