"""Alternative placements, and misplaced components that are found there though their nominal placement is occluded."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from arview.assembly.monitor import AssemblyMonitor
from arview.assembly.placement_search import Alternatives
from arview.assembly.placements import Placements, alternative_placements
from arview.cad.model import Model, make_model
from arview.cad.view_range import ViewRange
from arview.geometry import exp_so3
from arview.guideviews import GuideViewOptions, make_guide_views
from helpers.cad_files import box
from helpers.synthetic import CAMERA, assembly, block, changed, component, picture, pose_from, post, wrong

NAMES = [part.name for part in assembly().components]
TURN = exp_so3([0.3, -0.5, 0.8])


@cache
def placements() -> Placements:
    return alternative_placements(assembly())


@cache
def walled() -> Model:
    """A plate with a wall, something small behind it, and posts before it."""
    return make_model(
        "walled",
        (
            component("plate", box((0, 0, 0), (160, 120, 12)), (0.62, 0.62, 0.64)),
            component("wall", box((60, 50, 12), (120, 60, 62)), (0.55, 0.40, 0.65)),
            component("hidden", post((98, 80), 9, 12, 26), (0.30, 0.55, 0.75)),
            component("post_1", post((24, 30), 10, 12, 50), (0.80, 0.35, 0.25)),
            component("post_2", post((132, 24), 8, 12, 40), (0.85, 0.70, 0.25)),
            component("block", box((60, 14, 12), (96, 32, 30)), (0.35, 0.65, 0.40)),
        ),
    )


@cache
def monitor() -> AssemblyMonitor:
    around = ViewRange((420.0, 560.0), elevation_deg=(15.0, 35.0), azimuth_deg=(-95.0, -60.0))
    views = make_guide_views(walled(), around, GuideViewOptions(renderer="zbuffer"))
    return AssemblyMonitor(views, CAMERA, walled())


POSES = [pose_from(azimuth, 24.0, 480.0, walled()) for azimuth in (-80.0, -77.0, -74.0, -71.0)]


def against(model: Model | None, seed: int, noise: float = 3.0) -> dict[str, float]:
    """Log odds against each component by one picture."""
    pose = POSES[seed % len(POSES)]
    image = picture(pose, model or walled(), seed=seed, scene=seed % 9, noise=noise)
    observation = monitor().observer.observe(image, wrong(pose, np.random.default_rng(seed), 0.2, 0.4, walled()))
    return dict(zip([part.name for part in walled().components], observation.log_odds.tolist(), strict=True))


def test_alternative_placements_lie_on_the_plate_and_clear_of_other_components() -> None:
    assert len(placements().shifts) == len(NAMES) == 7
    assert len(placements().shifts[NAMES.index("plate")]) == 0
    for index, shifts in enumerate(placements().shifts):
        if NAMES[index] == "plate":
            continue
        assert len(shifts) >= 8, NAMES[index]
        assert np.abs(shifts[:, 2]).max() < 1e-9
        far = np.linalg.norm(shifts, axis=1)
        assert far.min() > 5.9 and far.max() < 30.1
        low, high = assembly().components[index].bounds_in_model
        for shift in shifts:
            for other, part in enumerate(assembly().components):
                if other in (index, NAMES.index("plate")):
                    continue
                apart = np.maximum(part.bounds_in_model[0] - high - shift, low + shift - part.bounds_in_model[1])
                assert apart[:2].max() > -0.5, f"{NAMES[index]} in {part.name}"


def test_placements_turn_with_the_model() -> None:
    turned = [replace(part, vertices_in_model=part.vertices_in_model @ TURN.T) for part in assembly().components]
    found = alternative_placements(make_model("turned", tuple(turned))).shifts
    assert len(found) == len(NAMES)
    for index, shifts in enumerate(found):
        assert (len(shifts) == 0) == (NAMES[index] == "plate")
        if len(shifts):
            assert np.abs(shifts @ TURN[:, 2]).max() < 0.03 * np.linalg.norm(shifts, axis=1).max()


def test_a_sunk_post_has_a_base_and_a_floating_one_has_none() -> None:
    plate = assembly().components[0]
    sunk = component("sunk", post((40, 40), 8, 4, 50), (0.5, 0.5, 0.5))
    floating = component("floating", post((110, 80), 8, 20, 50), (0.5, 0.5, 0.5))
    found = alternative_placements(make_model("both", (plate, sunk, floating)))
    assert [len(shifts) > 0 for shifts in found.shifts] == [False, True, False]
    assert found.swaps == ()


def test_one_component_alone_has_no_placements() -> None:
    assert [len(shifts) for shifts in alternative_placements(block()).shifts] == [0]


def test_swapped_components_share_their_foot() -> None:
    pairs = {(NAMES[one], NAMES[other]): shift for one, other, shift in placements().swaps}
    assert len(pairs) == 15
    assert pairs["post_1", "post_3"] == pytest.approx([94.0, 66.0, 0.0], abs=0.5)
    assert pairs["block_1", "block_2"] == pytest.approx([42.0, -27.0, 0.0], abs=0.5)


@pytest.mark.slow
def test_a_component_occluded_at_its_place_is_found_at_an_alternative_one() -> None:
    found = [against(changed(walled(), hidden=(26.0, 0.0)), seed) for seed in range(8)]
    assert np.median([said["hidden"] for said in found]) > 1.0
    assert sum(said["hidden"] > 0.5 for said in found) >= 6
    assert all(ratio < 0.0 for said in found for name, ratio in said.items() if name != "hidden")


@pytest.mark.slow
@pytest.mark.parametrize("noise", [3.0, 8.0])
def test_an_occluded_right_component_is_found_at_no_other_place(noise: float) -> None:
    for seed in range(8):
        said = against(None, seed, noise)
        assert said["hidden"] <= 0.1, f"picture {seed}"
        assert max(said.values()) < 1.0, f"picture {seed}"


@pytest.mark.slow
def test_a_verified_component_is_not_searched_for(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def never(*of: object) -> Alternatives:
        asked.append(of[-1])
        count = len(walled().components)
        return Alternatives(np.full(count, -np.inf), np.zeros((count, 3)))

    monkeypatch.setattr(monitor().observer._search, "search", never)
    image = picture(POSES[0], walled(), seed=1, noise=3.0)
    monitor().reset()
    for _ in range(4):
        monitor().update(image, POSES[0])
    hidden = [part.name for part in walled().components].index("hidden")
    assert asked[0].all()
    assert np.flatnonzero(asked[-1]).tolist() == [hidden]
