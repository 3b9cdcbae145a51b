"""Presence of each component: absent, occluded, displaced and right ones, by pictures with noise."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray

from arview.assembly.monitor import AssemblyMonitor
from arview.assembly.observation import base_of
from arview.cad.model import Model
from arview.geometry import Array, apply, exp_se3
from arview.pose import Completeness, ComponentPresence, Presence, Visibility
from arview.tracking import SpecimenTracking
from helpers.synthetic import CAMERA, assembly, assembly_views, block, path, picture, pose_from, wrong
from helpers.synthetic import changed as changed_from

NAMES = tuple(component.name for component in assembly().components)
BASE = NAMES[base_of(assembly())]
changed = partial(changed_from, assembly())
Frames = Iterable[tuple[NDArray[np.uint8], Array]]
Said = list[Mapping[str, ComponentPresence]]


def watch(frames: Frames, each: int = 6) -> Said:
    """Presences after each frame, which is shown some times because not every frame is observed."""
    seen = AssemblyMonitor(assembly_views(), CAMERA, assembly())
    said = []
    for image, pose in frames:
        for _ in range(each):
            seen.update(image, pose)
            said.append(seen.presence(pose))
    return said


def round_walk(model: Model | None, count: int = 7, noise: float = 4.0) -> Frames:
    """Pictures from different sides, with poses as a tracker has them."""
    for k in range(count):
        pose = pose_from(-70 + 140 * k / (count - 1), 35 + 5 * (k % 3), 500 + 20 * (k % 2))
        image = picture(pose, model, seed=k, scene=k % 9, noise=noise)
        yield image, wrong(pose, np.random.default_rng(k), 0.3, 0.5)


def at_last(said: Said) -> dict[str, Presence]:
    return {name: one.presence for name, one in said[-1].items()}


def ever(said: Said, name: str) -> set[Presence]:
    return {one[name].presence for one in said}


def card_over(name: str, pose: Array, margin_px: int = 30) -> tuple[int, int, int, int]:
    part = next(part for part in assembly().components if part.name == name)
    pixels = CAMERA.project(apply(pose, part.vertices_in_model))
    left, top = np.floor(pixels.min(axis=0)).astype(int) - margin_px
    right, bottom = np.ceil(pixels.max(axis=0)).astype(int) + margin_px
    return max(left, 0), max(top, 0), min(right, CAMERA.width), min(bottom, CAMERA.height)


@pytest.mark.slow
@pytest.mark.parametrize(
    "absent",
    [
        ("post_2",),
        ("post_1", "post_3", "block_1"),
        ("post_1", "post_2", "post_3", "block_2", "rail"),
    ],
)
def test_absent_components_are_missing_and_the_others_present(absent: tuple[str, ...]) -> None:
    said = watch(round_walk(changed(**dict.fromkeys(absent))))
    assert at_last(said) == {name: Presence.MISSING if name in absent else Presence.PRESENT for name in NAMES}
    for name in NAMES:
        assert (Presence.PRESENT if name in absent else Presence.MISSING) not in ever(said, name)
        one = said[-1][name]
        assert one.probability < 0.1 if name in absent else one.probability > 0.98
        assert one.observations >= 3 and 60.0 < one.spread_deg <= 180.0


@pytest.mark.slow
def test_a_bare_symmetric_base_is_ambiguous() -> None:
    # Turned upside down it would hide all components.
    seen = AssemblyMonitor(assembly_views(), CAMERA, assembly())
    for image, pose in round_walk(changed(**dict.fromkeys(name for name in NAMES if name != BASE)), 5):
        for _ in range(6):
            seen.update(image, pose)
        said = {name: one.presence for name, one in seen.presence(pose).items() if name != BASE}
        assert not set(said.values()) & {Presence.PRESENT, Presence.MISSING, Presence.DISPLACED}
    assert set(said.values()) == {Presence.UNCERTAIN}
    assert len(seen.other_poses(pose)) >= 1 and seen.better_turn is None


@pytest.mark.slow
@pytest.mark.parametrize("noise", [2.0, 8.0])
def test_nothing_of_a_right_part_is_ever_missing(noise: float) -> None:
    said = watch(round_walk(None, noise=noise))
    for name in NAMES:
        assert not ever(said, name) & {Presence.MISSING, Presence.DISPLACED}
    assert set(at_last(said).values()) == {Presence.PRESENT}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["post_1", "block_2"])
def test_a_component_behind_something_is_not_missing(name: str) -> None:
    poses = [pose_from(-60 + 20 * k, 45, 520) for k in range(6)]
    frames = [
        (
            picture(pose, seed=k, scene=k, noise=3.0, card=card_over(name, pose)),
            wrong(pose, np.random.default_rng(k), 0.3, 0.5),
        )
        for k, pose in enumerate(poses)
    ]
    said = watch(frames)
    for other in NAMES:
        assert not ever(said, other) & {Presence.MISSING, Presence.DISPLACED}, other
    assert at_last(said)[BASE] is Presence.PRESENT


@pytest.mark.slow
def test_a_displaced_component_is_said_to_be_where_it_is() -> None:
    said = watch(round_walk(changed(post_3=(-20.0, 0.0)), 9))
    assert at_last(said)["post_3"] is Presence.DISPLACED
    shift = said[-1]["post_3"].model_from_nominal
    assert shift is not None
    assert np.linalg.norm(shift[:3, 3] - [-20.0, 0.0, 0.0]) < 4.0
    assert all(one.model_from_nominal is None for name, one in said[-1].items() if name != "post_3")


@pytest.mark.slow
def test_a_wrong_pose_makes_nothing_missing() -> None:
    off = exp_se3([0.0, np.deg2rad(6.0), np.deg2rad(12.0), 14.0, -9.0, 0.0])
    said = watch([(image, off @ pose) for image, pose in round_walk(None, 5)])
    for name in NAMES:
        assert not ever(said, name) & {Presence.MISSING, Presence.DISPLACED}, name


@pytest.mark.slow
def test_visibility_is_of_the_frame_and_presence_of_all_frames() -> None:
    seen = AssemblyMonitor(assembly_views(), CAMERA, assembly())
    before = seen.presence(pose_from(0, 45, 520))
    assert {one.presence for one in before.values()} == {Presence.UNVERIFIED}
    assert all(one.probability == 0.5 and one.observations == 0 for one in before.values())
    for image, pose in round_walk(None, 3):
        for _ in range(6):
            seen.update(image, pose)
    aside = exp_se3([0.0, 0.0, 0.0, 400.0, 0.0, 0.0]) @ pose_from(0, 45, 520)
    shown = seen.presence(aside)
    assert {one.visibility for one in shown.values()} == {Visibility.OUTSIDE}
    assert {one.presence for one in shown.values()} == {Presence.PRESENT}
    assert {one.visibility for one in seen.presence(pose_from(0, 45, 520)).values()} == {Visibility.VISIBLE}
    unsure = seen.presence(pose_from(0, 45, 520), is_ambiguous=True)
    assert {name for name, one in unsure.items() if one.presence is Presence.UNCERTAIN} == set(NAMES) - {BASE}


def test_a_part_of_one_component_has_no_presences() -> None:
    assert AssemblyMonitor(assembly_views(), CAMERA, block()).presence(pose_from(0, 45, 520)) == {}


@pytest.mark.slow
def test_a_session_follows_a_part_of_which_most_is_absent() -> None:
    absent = ("post_1", "post_2", "block_1", "rail")
    model = changed(**dict.fromkeys(absent))
    session = SpecimenTracking(assembly_views(), CAMERA, assembly(), initial_cam_from_model=path(1, 4)[0])
    for k, pose in enumerate(path(36, 4)):
        result = session.process(picture(pose, model, seed=k, scene=4, noise=4.0), k, k / 30)
        assert result.cam_from_model is not None, f"frame {k}: {result.reason}"
        assert not any(result.components[name].presence is Presence.PRESENT for name in absent)
    assert {name for name, one in result.components.items() if one.presence is Presence.MISSING} == set(absent)
    assert {name for name, one in result.components.items() if one.presence is Presence.PRESENT} == (
        set(NAMES) - set(absent)
    )
    assert result.completeness is Completeness.INCOMPLETE


def test_what_was_known_before_a_loss_is_taken_up_for_the_same_specimen() -> None:
    absent = "post_2"
    model = changed(**{absent: None})
    frames = list(round_walk(model))
    monitor = AssemblyMonitor(assembly_views(), CAMERA, assembly())
    for image, pose in frames:
        for _ in range(6):
            monitor.update(image, pose)
    before = monitor.presence(frames[-1][1])
    assert before[absent].presence is Presence.MISSING
    monitor.set_aside()
    monitor.reset()
    image, pose = frames[3]
    monitor.update(image, pose)
    fresh = monitor.presence(pose)
    assert fresh[absent].presence is not Presence.MISSING
    monitor.resume()
    again = monitor.presence(pose)
    assert again[absent].presence is Presence.MISSING
    assert all(again[name].presence is Presence.PRESENT for name in NAMES if name != absent)
    assert again["post_1"].observations > fresh["post_1"].observations
    # Only once, and nothing after everything was forgotten.
    monitor.resume()
    assert monitor.presence(pose) == again
    monitor.set_aside()
    monitor.forget()
    monitor.resume()
    assert all(one.observations == 0 for one in monitor.presence(pose).values())


def test_a_component_that_was_added_during_a_loss_becomes_present() -> None:
    absent = "post_2"
    monitor = AssemblyMonitor(assembly_views(), CAMERA, assembly())
    for image, pose in round_walk(changed(**{absent: None})):
        for _ in range(6):
            monitor.update(image, pose)
    monitor.set_aside()
    monitor.reset()
    for number, (image, pose) in enumerate(round_walk(None, count=9)):
        for _ in range(6):
            monitor.update(image, pose)
            if number == 0:
                monitor.resume()
    assert monitor.presence(pose)[absent].presence is Presence.PRESENT
