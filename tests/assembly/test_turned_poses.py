"""Poses in which the base looks the same: found, told apart by what is seen, and left open where nothing says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from arview.assembly.direction_evidence import DirectionEvidence
from arview.assembly.monitor import AssemblyMonitor
from arview.assembly.monitor_state import MonitorState
from arview.assembly.turned_poses import Turn, TurnedPoses, TurnEvidence, base_turns
from arview.cad.model import Component, make_model
from arview.cad.view_range import ViewRange
from arview.geometry import Array, apply, exp_so3, rigid
from arview.guideviews import GuideViewOptions
from arview.guideviews.cache import cached_guide_views
from arview.pose import Presence
from arview.tracking import SpecimenTracking
from helpers.cad_files import box
from helpers.synthetic import CAMERA, assembly, assembly_views, changed, component, picture, pose_from, wrong

NAMES = tuple(one.name for one in assembly().components)
PLATE = assembly().components[0]
TURNS = base_turns(assembly().components, 0)
FEW = ViewRange((380.0, 420.0), elevation_deg=(40.0, 50.0), azimuth_deg=(-10.0, 10.0), roll_deg=(-5.0, 5.0))
NOTHING = np.zeros(len(NAMES), dtype=bool)
SEEN = np.where(np.arange(len(NAMES)) > 0, 2.0, 0.0)


def upright_turn() -> Array:
    """The half turn about the plate's normal."""
    return next(turn.model_from_model for turn in TURNS if turn.model_from_model[2, 2] > 0.9)


def turns_of(base: Component) -> list[Array]:
    return [turn.model_from_model for turn in base_turns([base], 0)]


def test_the_symmetries_of_a_base_leave_it_where_it_is() -> None:
    assert len(TURNS) == 3
    corners = PLATE.vertices_in_model
    for turn in TURNS:
        turned = apply(turn.model_from_model, corners)
        assert np.allclose(np.sort(turned, axis=0), np.sort(corners, axis=0), atol=1e-6)
        assert not np.allclose(turned, corners, atol=1.0)
        assert turn.is_exact
    square = component("square", box((0, 0, 0), (50, 50, 10)), (0.5, 0.5, 0.5))
    assert len(turns_of(square)) == 5
    stepped = component("stepped", box((0, 0, 0), (80, 50, 20)), (0.5, 0.5, 0.5))
    uneven = np.array(stepped.vertices_in_model)
    uneven[(uneven[:, 0] > 40) & (uneven[:, 2] > 10)] += [0.0, 0.0, 12.0]
    assert turns_of(component("uneven", (uneven, stepped.faces), (0.5, 0.5, 0.5))) == []


def twins() -> tuple[Component, ...]:
    """A plate that looks the same after half a turn, by which two posts change places, and a block in one corner."""
    boxes = {
        "plate": ((0, 0, 0), (100, 60, 6)),
        "left": ((10, 26, 6), (18, 34, 20)),
        "right": ((82, 26, 6), (90, 34, 20)),
        "corner": ((5, 5, 6), (15, 15, 9)),
    }
    return tuple(component(name, box(*corners), (0.5, 0.5, 0.5)) for name, corners in boxes.items())


def test_components_of_one_shape_change_places() -> None:
    parts = twins()
    upright = next(turn for turn in base_turns(parts, 0) if turn.model_from_model[2, 2] > 0.9)
    assert upright.counterparts.tolist() == [0, 2, 1, -1]
    turned = TurnedPoses(parts, 0)
    assert len(turned.open_turns(np.array([True, True, True, False]))) == 1
    assert turned.open_turns(np.array([True, True, True, True])) == []
    # What is seen of the two says nothing, even where noise favours one pose.
    for _ in range(20):
        turned.compare(np.eye(4), lambda at: TurnEvidence(np.array([0.0, 3.0, 2.0, 0.0]) * (np.trace(at) > 3.9), 0.8))
    assert len(turned.open_turns(np.array([True, True, False, False]))) == 1 and turned.better is None


@pytest.mark.parametrize(
    ("here", "there", "is_better", "is_open"),
    [
        (TurnEvidence(0.0 * SEEN, 0.8), TurnEvidence(SEEN, 0.8), True, True),
        (TurnEvidence(SEEN, 0.8), TurnEvidence(0.0 * SEEN, 0.8), False, False),
        (TurnEvidence(0.0 * SEEN, 0.8), TurnEvidence(0.05 * SEEN, 0.8), False, True),
        # The plate is exactly symmetric: that less of its edges are found says nothing.
        (TurnEvidence(0.0 * SEEN, 0.5), TurnEvidence(0.0 * SEEN, 0.8), False, True),
    ],
)
def test_what_is_seen_decides_between_poses(
    here: TurnEvidence, there: TurnEvidence, is_better: bool, is_open: bool
) -> None:
    turned = TurnedPoses(assembly().components, 0)
    assert len(turned.open_turns(NOTHING)) == 3 and turned.better is None
    pose = pose_from(0, 45, 520)
    for _ in range(2):
        turned.compare(pose, lambda at: here if at is pose else there)
    assert (turned.better is not None) == is_better
    assert bool(turned.open_turns(NOTHING)) == is_open
    turned.reset()
    assert len(turned.open_turns(NOTHING)) == 3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("left", "right", "said"),
    [
        (-5.0, -5.0, (Presence.PRESENT, Presence.PRESENT)),
        # The right one stays verified by what was seen before, but hardly is: the left one may be what is seen there.
        (-5.0, -0.2, (Presence.UNVERIFIED, Presence.PRESENT)),
        (-5.0, 5.0, (Presence.UNCERTAIN, Presence.UNCERTAIN)),
    ],
)
def test_one_of_two_that_may_have_changed_places_is_present_only_if_both_are(
    left: float, right: float, said: tuple[Presence, Presence]
) -> None:
    model = make_model("twins", twins())
    seen = AssemblyMonitor(cached_guide_views(model, FEW, GuideViewOptions(renderer="zbuffer")), CAMERA, model)
    pose = pose_from(0, 45, 400, model)
    log_odds = np.array([-6.0, left, right, 0.0])
    seen._state = replace(
        seen._state, log_odds=log_odds, is_verified=log_odds < 0.0, is_mismatched=log_odds > 4.0,
        is_missing=log_odds > 4.0, observations=4,
    )  # fmt: skip
    found = seen.presence(pose)
    assert (found["left"].presence, found["right"].presence) == said
    # The block in the corner tells the two poses apart: once it is seen each is what it looks like.
    log_odds = np.array([-6.0, left, right, -5.0])
    seen._state = replace(seen._state, log_odds=log_odds, is_verified=log_odds < 0.0, observations=5)
    found = seen.presence(pose)
    assert found["left"].presence is Presence.PRESENT
    assert found["right"].presence is (Presence.MISSING if right > 4.0 else Presence.PRESENT)


@pytest.mark.slow
def test_nothing_is_missing_while_the_part_may_be_turned() -> None:
    left = ("plate", "post_1")
    model = changed(assembly(), **dict.fromkeys(name for name in NAMES if name not in left))
    seen = AssemblyMonitor(assembly_views(), CAMERA, assembly())
    for k in range(3):
        pose = pose_from(-60 + 20 * k, 45, 520)
        seen.update(picture(pose, model, seed=k, scene=k, noise=3.0), pose @ upright_turn())
        said = seen.presence(pose)
        assert not any(one.presence is Presence.MISSING for one in said.values())
        if seen.better_turn is not None:
            break
    assert seen.better_turn is not None
    assert np.allclose(pose @ upright_turn() @ seen.better_turn.model_from_model, pose, atol=1e-6)


@pytest.mark.slow
def test_a_session_started_turned_turns_back() -> None:
    left = ("plate", "post_1", "block_1")
    model = changed(assembly(), **dict.fromkeys(name for name in NAMES if name not in left))
    poses = [pose_from(-40 + 3 * k, 45, 520) for k in range(20)]
    start = wrong(poses[0] @ upright_turn(), np.random.default_rng(0), 0.3, 0.5)
    session = SpecimenTracking(assembly_views(), CAMERA, assembly(), initial_cam_from_model=start)
    for k, pose in enumerate(poses):
        result = session.process(picture(pose, model, seed=k, scene=3, noise=3.0), k, k / 30)
        assert not any(result.components[name].presence is Presence.MISSING for name in left if result.components)
    assert result.cam_from_model is not None
    off = apply(result.cam_from_model, PLATE.vertices_in_model) - apply(pose, PLATE.vertices_in_model)
    assert np.abs(off).max() < 3.0
    present = {name for name, one in result.components.items() if one.presence is Presence.PRESENT}
    missing = {name for name, one in result.components.items() if one.presence is Presence.MISSING}
    assert present == set(left) and missing == set(NAMES) - set(left)


def test_what_is_known_of_a_place_stays_known_when_the_pose_is_turned() -> None:
    """Components 1 and 2 change places by half a turn; nothing of the shape of component 3 is where it goes."""
    half = rigid(exp_so3([0.0, 0.0, np.pi]), np.zeros(3))
    turn = Turn(half, np.array([0, 2, 1, -1]), is_exact=True)
    directions = DirectionEvidence(4, np.zeros(3))
    wrong_pose = pose_from(30, 40, 500)
    directions.add(wrong_pose, np.array([0.0, 5.0, -4.0, 6.0]), np.zeros(4, dtype=bool))
    before = MonitorState(
        log_odds=np.array([0.0, 5.0, -4.0, 6.0]), directions=directions,
        is_mismatched=np.array([False, True, False, True]), is_missing=np.array([False, True, False, True]),
        is_verified=np.array([True, False, True, False]), was_visible=np.ones(4, dtype=bool),
        was_occluded=np.zeros(4, dtype=bool), alternative=np.zeros(4), shifts=np.zeros((4, 3)), observations=7,
    )  # fmt: skip
    now = before.turned(turn, 0.5)
    assert now.log_odds.tolist() == [0.0, -2.0, 2.5, 0.0]
    assert now.is_missing.tolist() == [False, False, True, False]
    assert now.is_verified.tolist() == [True, True, False, False]
    assert now.directions.observations.tolist() == [0, 1, 1, 0]
    # The camera did not move: from the turned pose the same direction is no new one.
    assert not now.directions.is_new(wrong_pose @ half)
    assert now.directions.is_new(wrong_pose)
