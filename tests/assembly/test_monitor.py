"""Mismatched components of similar parts are reported; right parts and occluded components are not."""

from __future__ import annotations

import itertools
from functools import cache, partial

import numpy as np
import pytest
from numpy.typing import NDArray

from arview.assembly.monitor import AssemblyMonitor
from arview.assembly.observation import Observation
from arview.assembly.observation_schedule import OPEN_FRAMES, SUSPECT_FRAMES
from arview.cad.model import Model
from arview.geometry import Array, apply
from arview.tracking import SpecimenTracking
from helpers.synthetic import CAMERA, assembly, assembly_views, block, path, picture, pose_from, wrong
from helpers.synthetic import changed as changed_from

MOVED_MM = 20.0


@cache
def monitor() -> AssemblyMonitor:
    return AssemblyMonitor(assembly_views(), CAMERA, assembly())


changed = partial(changed_from, assembly())
"""The assembly with components moved along the plate by (x, y) mm, or left out."""

LOOK_ALIKES: dict[tuple[str, ...], Model] = {
    ("post_1",): changed(post_1=None),
    ("post_2",): changed(post_2=None),
    ("post_3",): changed(post_3=None),
    ("block_1",): changed(block_1=None),
    ("block_2",): changed(block_2=None),
    ("rail",): changed(rail=None),
    ("post_1", "moved"): changed(post_1=(0.0, MOVED_MM)),
    ("post_2", "moved"): changed(post_2=(0.0, MOVED_MM)),
    ("post_3", "moved"): changed(post_3=(-MOVED_MM, 0.0)),
    ("block_1", "moved"): changed(block_1=(0.0, -MOVED_MM)),
    ("block_2", "moved"): changed(block_2=(0.0, MOVED_MM)),
    ("post_1", "post_3"): changed(post_1=(94.0, 66.0), post_3=(-94.0, -66.0)),
    ("post_2", "block_2"): changed(post_2=(-43.0, 28.0), block_2=(43.0, -28.0)),
}


def views_of(count: int, seed: int) -> list[Array]:
    """Poses over the declared range."""
    rng = np.random.default_rng(seed)
    return [
        pose_from(rng.uniform(-80, 80), rng.uniform(20, 60), rng.uniform(430, 620), roll_deg=rng.uniform(-20, 20))
        for _ in range(count)
    ]


def said(log_odds: Array, is_visible: NDArray[np.bool_] | None = None) -> Observation:
    """An observation with log odds (C,), without suspects."""
    none = np.zeros(len(log_odds), dtype=bool)
    return Observation(
        log_odds=log_odds,
        is_suspect=none,
        is_visible=none if is_visible is None else is_visible,
        is_occluded=none,
        alternative=np.full(len(log_odds), -np.inf),
        shifts=np.zeros((len(log_odds), 3)),
    )


def about(pose: Array, seed: int) -> Array:
    """The pose as a tracker has it: half a degree and a millimetre off."""
    return wrong(pose, np.random.default_rng(seed), 0.3, 0.5)


def mismatched(messages: tuple[str, ...]) -> set[str]:
    names = {message.split()[1] for message in messages}
    assert set(messages) == {f"mismatch: {name} not seen where expected" for name in names}
    return names


def card_over(name: str, pose: Array, margin_px: int = 30) -> tuple[int, int, int, int]:
    part = next(part for part in assembly().components if part.name == name)
    pixels = CAMERA.project(apply(pose, part.vertices_in_model))
    left, top = np.floor(pixels.min(axis=0)).astype(int) - margin_px
    right, bottom = np.ceil(pixels.max(axis=0)).astype(int) + margin_px
    return max(left, 0), max(top, 0), min(right, CAMERA.width), min(bottom, CAMERA.height)


def watch(frames: list[tuple[NDArray[np.uint8], Array]]) -> AssemblyMonitor:
    """The monitor after frames with their poses."""
    monitor().reset()
    for image, pose in frames:
        monitor().update(image, pose)
    return monitor()


def walk(model: Model | None, count: int, seed: int = 0, noise: float = 4.0) -> list[tuple[NDArray[np.uint8], Array]]:
    poses = path(count, seed)
    return [
        (picture(pose, model, seed=100 * seed + k, scene=seed % 9, noise=noise), about(pose, k))
        for k, pose in enumerate(poses)
    ]


@pytest.mark.slow
def test_one_picture_shows_missing_moved_and_swapped_components() -> None:
    hits, pictures, others = 0, 0, 0
    for number, (parts, model) in enumerate(LOOK_ALIKES.items()):
        for k, pose in enumerate(views_of(1, seed=number)):
            image = picture(pose, model, seed=k, scene=(number + k) % 9, noise=4.0)
            found = mismatched(monitor().mismatches_in(image, about(pose, k)))
            pictures += 1
            hits += bool(found & set(parts))
            others += bool(found - set(parts))
    assert hits >= 0.9 * pictures
    assert others <= 0.04 * pictures


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "gain"), [(2.0, 1.0), (8.0, 1.0), (4.0, 0.55)])
def test_a_right_part_is_not_mismatched(noise: float, gain: float) -> None:
    for k, pose in enumerate(views_of(5, seed=50)):
        image = picture(pose, seed=k, scene=k % 9, noise=noise, gain=gain)
        assert monitor().mismatches_in(image, about(pose, k)) == (), f"view {k}"


@pytest.mark.slow
def test_a_component_a_little_off_nominal_is_not_mismatched() -> None:
    near = changed(post_1=(1.0, -0.7), block_1=(-0.8, 0.8))
    for k, pose in enumerate(views_of(4, seed=60)):
        assert monitor().mismatches_in(picture(pose, near, seed=k, scene=k % 9), about(pose, k)) == (), f"view {k}"


@pytest.mark.slow
def test_evidence_adds_up_over_frames_until_reset() -> None:
    seen = watch(walk(changed(post_3=None), 4))
    assert mismatched(seen.mismatches) == {"post_3"}
    assert seen.uncertain == ()
    seen.reset()
    assert seen.mismatches == () and seen.uncertain == ()
    for image, pose in walk(None, 4):
        seen.update(image, pose)
    assert seen.mismatches == () and seen.uncertain == ()


@pytest.mark.slow
def test_a_corrected_component_is_cleared() -> None:
    seen = watch(walk(changed(block_2=None), 4))
    assert mismatched(seen.mismatches) == {"block_2"}
    for azimuth_deg in range(-60, 20, 10):
        pose = pose_from(azimuth_deg, 45, 520)
        image = picture(pose, seed=azimuth_deg + 60)
        for _ in range(7):  # not every frame is observed
            seen.update(image, pose)
    assert seen.mismatches == ()


def test_a_displaced_component_stays_mismatched_when_seen_along_its_displacement(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen = AssemblyMonitor(assembly_views(), CAMERA, assembly())
    count = len(assembly().components)

    def watched(*ratios: float) -> tuple[str, ...]:
        """The mismatches after observations from new directions with these log odds against the third component."""
        seen.reset()
        for k, ratio in enumerate(ratios):
            against = np.where(np.arange(count) == 2, ratio, 0.0)
            monkeypatch.setattr(seen.observer, "observe", lambda *_: said(against))  # noqa: B023
            for _ in range(SUSPECT_FRAMES):
                seen.update(np.zeros((480, 640, 3), np.uint8), pose_from(-70 + 10 * k, 45, 520))
        return seen.mismatches

    assert len(watched(3.0)) == 1
    assert len(watched(3.0, 3.0, -1.5, -1.5, -4.0)) == 1
    assert watched(3.0, -4.0, -4.0) == ()
    assert watched(-4.0, 3.0) == ()


def test_evidence_of_blurred_pictures_is_soon_outweighed_from_the_same_direction(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen = AssemblyMonitor(assembly_views(), CAMERA, assembly())
    count = len(assembly().components)
    ratios = itertools.chain([3.0, 3.0], itertools.repeat(-2.5))

    def observe(*_: object) -> Observation:
        return said(np.where(np.arange(count) == 2, next(ratios), -3.0))

    monkeypatch.setattr(seen.observer, "observe", observe)
    blank, pose = np.zeros((480, 640, 3), np.uint8), pose_from(0, 45, 520)
    for _ in range(2):
        seen.update(blank, pose)
    assert len(seen.mismatches) == 1
    for _ in range(4 * SUSPECT_FRAMES):
        seen.update(blank, pose)
    assert seen.mismatches == () and seen.uncertain == ()


@pytest.mark.parametrize(("second", "is_mismatched"), [(3.0, True), (-1.2, False)])
def test_one_frame_alone_reports_no_mismatch(
    monkeypatch: pytest.MonkeyPatch, second: float, is_mismatched: bool
) -> None:
    seen = AssemblyMonitor(assembly_views(), CAMERA, assembly())
    count = len(assembly().components)
    against = iter([np.where(np.arange(count) == 2, ratio, -3.0) for ratio in (3.0, second)])
    monkeypatch.setattr(seen.observer, "observe", lambda *_: said(next(against)))
    blank, pose = np.zeros((480, 640, 3), np.uint8), pose_from(0, 45, 520)
    seen.update(blank, pose)
    assert seen.mismatches == () and len(seen.uncertain) == 1
    seen.update(blank, pose)
    assert (len(seen.mismatches) == 1) == is_mismatched


@pytest.mark.parametrize(("was_visible", "frames"), [(True, OPEN_FRAMES), (False, SUSPECT_FRAMES)])
def test_a_component_entering_the_view_is_observed_soon(
    monkeypatch: pytest.MonkeyPatch, was_visible: bool, frames: int
) -> None:
    seen = AssemblyMonitor(assembly_views(), CAMERA, assembly())
    count = len(assembly().components)
    others = np.arange(count) != 2
    observation = said(np.where(others, -3.0, 0.0), others | was_visible)
    observed = []
    monkeypatch.setattr(seen.observer, "observe", lambda *_: observed.append(1) or observation)
    for _ in range(2):
        seen.update(np.zeros((480, 640, 3), np.uint8), pose_from(-40, 45, 520))
    waited = 0
    while len(observed) < 3:
        seen.update(np.zeros((480, 640, 3), np.uint8), pose_from(20, 45, 520))
        waited += 1
    assert waited == frames


@pytest.mark.slow
def test_an_occluded_component_is_no_mismatch() -> None:
    for name in ("post_1", "post_3", "block_1", "block_2"):
        for k, pose in enumerate(views_of(2, seed=70)):
            image = picture(pose, seed=k, scene=k, noise=3.0, card=card_over(name, pose))
            assert name not in mismatched(monitor().mismatches_in(image, about(pose, k))), f"{name}, view {k}"


@pytest.mark.slow
def test_what_is_hidden_at_first_is_mismatched_later_even_at_a_fast_turn() -> None:
    model = changed(block_2=None)
    poses = [pose_from(-70 + 7 * k, 40, 520) for k in range(20)]
    cards = [card_over("block_2", pose, 50) if k < 3 else None for k, pose in enumerate(poses)]
    frames = [(picture(p, model, seed=k, card=card), p) for k, (p, card) in enumerate(zip(poses, cards, strict=True))]
    assert watch(frames[:3]).mismatches == ()
    assert mismatched(watch(frames).mismatches) == {"block_2"}


@pytest.mark.slow
@pytest.mark.parametrize("is_there", [True, False])
def test_a_component_is_unverified_until_it_is_confirmed_at_its_place(is_there: bool) -> None:
    model = None if is_there else changed(block_2=None)
    poses = [pose_from(-70 + 10 * k, 45, 520) for k in range(14)]
    cards = [card_over("block_2", pose, 50) if k < 3 else None for k, pose in enumerate(poses)]
    frames = [(picture(p, model, seed=k, card=card), p) for k, (p, card) in enumerate(zip(poses, cards, strict=True))]
    seen = watch([])
    assert set(seen.unverified) == set(assembly_views().component_names)
    for image, pose in frames[:3]:
        seen.update(image, pose)
    assert "block_2" in seen.unverified and len(seen.unverified) < len(assembly_views().component_names)
    for image, pose in frames[3:]:
        for _ in range(SUSPECT_FRAMES):
            seen.update(image, pose)
    assert ("block_2" in seen.unverified) != is_there
    assert not set(seen.unverified) - {"block_2"}


def test_a_verified_part_is_observed_now_and_then(monkeypatch: pytest.MonkeyPatch) -> None:
    observed = []
    seen = AssemblyMonitor(assembly_views(), CAMERA, assembly())
    observe = seen.observer.observe
    monkeypatch.setattr(seen.observer, "observe", lambda *of: observed.append(1) or observe(*of))
    image = picture(pose_from(30, 45, 520))
    for _ in range(200):
        seen.update(image, pose_from(30, 45, 520))
    assert 3 <= len(observed) <= 10


def test_a_part_of_one_component_has_nothing_to_mismatch() -> None:
    alone = AssemblyMonitor(assembly_views(), CAMERA, block())
    pose = pose_from(30, 40, 520)
    alone.update(picture(pose), pose)
    assert alone.mismatches_in(picture(None), pose) == ()
    assert alone.mismatches == () and alone.uncertain == () and alone.unverified == ()


@pytest.mark.slow
def test_a_session_never_calls_a_similar_part_tracked() -> None:
    session = SpecimenTracking(assembly_views(), CAMERA, assembly(), initial_cam_from_model=path(1, 4)[0])
    for k, pose in enumerate(path(5, 4)):
        result = session.process(picture(pose, changed(post_1=None), seed=k, scene=4, noise=4.0), k, k / 30)
        if k >= 1:
            assert mismatched(result.mismatches) == {"post_1"}
            assert result.state.value == "critical"
            assert "post_1 not seen where expected" in result.reason
