"""A rendered film of an assembly in twelve steps: a hand sets one component after another on a plate."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.cad.model import Component, Model, Step, make_model
from arview.cad.view_range import ViewRange
from arview.geometry import Array, apply
from arview.guideviews import GuideViewOptions, GuideViewSet
from arview.guideviews.cache import cached_guide_views
from helpers.cad_files import box
from helpers.synthetic import CAMERA, component, picture, pose_from, post

RANGE = ViewRange((420.0, 700.0), elevation_deg=(25.0, 75.0), azimuth_deg=(-110.0, -10.0), roll_deg=(-15.0, 15.0))
REACH_S, LEAVE_S = 0.5, 0.4
"""Time in which the hand brings a component, and in which it is taken away."""
LIFT_MM = 120.0
SKIN = (205, 150, 125)


@cache
def assembly() -> Model:
    """A plate with a raised corner and twelve components, each mounted by a step, 240 × 160 × 52 mm."""
    plate, corner = box((0, 0, 0), (240, 160, 12)), box((226, 112, 12), (240, 160, 24))
    base = np.concatenate([plate[0], corner[0]]), np.concatenate([plate[1], corner[1] + len(plate[0])])
    components = (
        component("plate", base, (0.62, 0.62, 0.64)),
        component("post_1", post((30, 30), 12, 12, 52), (0.80, 0.35, 0.25)),
        component("post_2", post((88, 26), 9, 12, 40), (0.30, 0.55, 0.75)),
        component("post_3", post((210, 30), 12, 12, 34), (0.85, 0.70, 0.25)),
        component("block_1", box((16, 62, 12), (56, 100, 36)), (0.35, 0.65, 0.40)),
        component("block_2", box((76, 50, 12), (104, 78, 50)), (0.55, 0.40, 0.65)),
        component("rail_1", box((116, 14, 12), (184, 26, 26)), (0.25, 0.30, 0.35)),
        component("rail_2", box((116, 132, 12), (190, 144, 24)), (0.70, 0.30, 0.30)),
        component("post_4", post((30, 132), 10, 12, 44), (0.85, 0.80, 0.75)),
        component("block_3", box((66, 112, 12), (100, 142, 32)), (0.30, 0.45, 0.30)),
        component("block_4", box((132, 56, 12), (164, 88, 44)), (0.80, 0.55, 0.30)),
        component("post_5", post((146, 108), 11, 12, 30), (0.35, 0.35, 0.75)),
        component("post_6", post((196, 84), 13, 12, 46), (0.50, 0.75, 0.75)),
    )
    names = [one.name for one in components[1:]]
    steps = tuple(Step(name, (name,), tuple(names[max(k - 1, 0) : k])) for k, name in enumerate(names))
    return replace(make_model("twelve", components), steps=steps)


@cache
def views() -> GuideViewSet:
    return cached_guide_views(assembly(), RANGE, GuideViewOptions(renderer="zbuffer"))


def look_alike(name: str, radial: float, axial: float = 1.0) -> Component:
    """A component of another size on the same seat."""
    one = assembly().component(name)
    low, high = one.bounds_in_model
    foot = np.array([*(0.5 * (low + high))[:2], low[2]])
    return replace(one, vertices_in_model=(one.vertices_in_model - foot) * [radial, radial, axial] + foot)


@dataclass(frozen=True)
class Mounting:
    """What the hand does: it sets a component at a time; one that is there gives way to it."""

    time_s: float
    component: Component


def in_order(names: Sequence[str], step_s: float, lead_s: float = 1.5) -> list[Mounting]:
    """One component after another."""
    return [Mounting(lead_s + k * step_s, assembly().component(name)) for k, name in enumerate(names)]


def pose_at(time_s: float) -> Array:
    """``cam_from_model`` of a camera held in a hand."""
    s = np.sin(2 * np.pi * time_s / np.array([9.0, 7.0, 11.0, 5.0, 6.0, 8.0]) + np.arange(6.0))
    pose = pose_from(-60 + 14 * s[0], 48 + 6 * s[1], 560 + 25 * s[2], assembly(), 3 * s[3])
    pose[:2, 3] += [12 * s[4], 8 * s[5]]
    return pose


def frames(
    done: Sequence[Mounting], end_s: float, fps: float, seed: int = 0, blur_px: float = 0.7
) -> Iterator[tuple[float, NDArray[np.uint8], Array]]:
    """Time, picture and pose of each frame; with blur and noise."""
    for index in range(round(end_s * fps)):
        time_s = index / fps
        there = {"plate": assembly().components[0]}
        there |= {one.component.name: one.component for one in done if one.time_s <= time_s}
        coming = next((one for one in done if 0.0 < one.time_s - time_s < REACH_S), None)
        gone = next((one for one in done if 0.0 <= time_s - one.time_s < LEAVE_S), None)
        pose, hand = pose_at(time_s), None
        if coming is not None:
            lift_mm = LIFT_MM * (coming.time_s - time_s) / REACH_S
            held = coming.component
            there[held.name] = replace(held, vertices_in_model=held.vertices_in_model + np.array([0.0, 0.0, lift_mm]))
            hand = held, lift_mm
        elif gone is not None:
            hand = gone.component, LIFT_MM * (time_s - gone.time_s) / LEAVE_S
        image = picture(pose, make_model("film", tuple(there.values())), scene=2 + seed, noise=0.0)
        if hand is not None:
            image = _with_hand(image, pose, *hand)
        blurred = cv2.GaussianBlur(image, (0, 0), blur_px).astype(np.float32)
        noise = np.random.default_rng((seed, index)).normal(0.0, 3.0, blurred.shape)
        yield time_s, np.clip(np.round(blurred + noise), 0, 255).astype(np.uint8), pose


def _with_hand(image: NDArray[np.uint8], pose: Array, held: Component, lift_mm: float) -> NDArray[np.uint8]:
    """A hand and its arm above a component, from the upper right."""
    low, high = held.bounds_in_model
    top = np.array([*(0.5 * (low + high))[:2], high[2] + lift_mm + 10.0])
    u, v = np.round(CAMERA.project(apply(pose, top))).astype(int).tolist()
    shown = image.copy()
    cv2.ellipse(shown, (u + 35, v - 25), (55, 22), -35, 0, 360, SKIN, -1, cv2.LINE_AA)
    cv2.line(shown, (u + 70, v - 50), (u + 300, v - 230), SKIN, 46, cv2.LINE_AA)
    return shown
