"""Tools and hands drawn over the sample clips: ghost left over them, and ghost lost where nothing is before it."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.cad import Part
from arview.camera import Camera
from arview.geometry import Array, apply
from arview.overlay.ghost import Ghost, GhostView
from arview.overlay.mesh import topology
from arview.overlay.occluders import OccluderFinder
from arview.video import Image
from arview_lab.evaluation import Scene
from rows import ResultRow, watched
from suites.several import Half, bracket_half, plate_half

FRAMES, LEARNED = 75, 45
"""Frames of a clip, and how many of them are shown before something is drawn over the part."""
CLEAN_FRAMES, SKIPPED = 55, 8
"""Frames of the recorded scenes in which nothing is before the part, and those left out at the start."""
REACH = 0.55
"""Length of what is drawn, in heights of the frame."""
DEPTH_NOISE, LATERAL_NOISE = 0.0005, 0.0004
"""Standard deviation of the poses of the recorded scenes, shares of the distance."""
SEED = 0
MUST_LEAVE, MUST_LOSE = 0.10, 0.02
Rgb = tuple[int, int, int]


@dataclass(frozen=True)
class Capsule:
    """A shaded round bar between two places, in sizes of the sprite, with a highlight of some strength."""

    start: tuple[float, float]
    end: tuple[float, float]
    start_radius: float
    end_radius: float
    rgb: Rgb
    highlight: float


def hand(palm: Rgb, fingers: Sequence[Rgb], thumb: Rgb | None) -> tuple[Capsule, ...]:
    """A palm, four fingers, and a thumb where it has a colour."""
    tips = ((0.9, 0.3), (0.95, 0.45), (0.92, 0.6), (0.82, 0.72))
    parts = [Capsule((0.08, 0.6), (0.45, 0.5), 0.17, 0.17, palm, 0.05)]
    for k, (tip, rgb) in enumerate(zip(tips, fingers, strict=True)):
        parts.append(Capsule((0.42, 0.42 + 0.06 * k), tip, 0.055, 0.045, rgb, 0.06))
    if thumb is not None:
        parts.append(Capsule((0.3, 0.42), (0.6, 0.22), 0.06, 0.05, thumb, 0.05))
    return tuple(parts)


OCCLUDERS = {
    "screwdriver": (
        Capsule((0.55, 0.5), (0.95, 0.55), 0.018, 0.018, (150, 152, 156), 0.55),
        Capsule((0.12, 0.44), (0.55, 0.5), 0.065, 0.05, (34, 36, 42), 0.35),
        Capsule((0.2, 0.455), (0.3, 0.468), 0.067, 0.066, (150, 30, 28), 0.2),
    ),
    "pliers": (
        Capsule((0.1, 0.3), (0.55, 0.5), 0.04, 0.035, (26, 26, 28), 0.25),
        Capsule((0.1, 0.68), (0.55, 0.5), 0.04, 0.035, (26, 26, 28), 0.25),
        Capsule((0.52, 0.5), (0.64, 0.52), 0.075, 0.06, (70, 70, 74), 0.35),
        Capsule((0.64, 0.52), (0.92, 0.56), 0.05, 0.02, (62, 63, 66), 0.35),
    ),
    "black glove": hand((32, 32, 34), [(30 + 2 * k, 30 + 2 * k, 33 + 2 * k) for k in range(4)], (33, 33, 35)),
    "hand": hand((205, 150, 125), [(210, 155, 130)] * 4, None),
    "steel rod": (Capsule((0.05, 0.5), (0.95, 0.52), 0.06, 0.05, (140, 142, 146), 0.5),),
}  # fmt: skip


@dataclass
class Counts:
    """Pixels of the ghost behind the occluder, those of them that are drawn, those elsewhere, and the lost of them."""

    behind: int = 0
    left: int = 0
    beside: int = 0
    lost: int = 0

    def add(self, drawn: NDArray[np.bool_], covered: NDArray[np.bool_], hidden: NDArray[np.bool_]) -> None:
        """Count a frame."""
        self.behind += int((drawn & covered).sum())
        self.left += int((drawn & covered & ~hidden).sum())
        self.beside += int((drawn & ~covered).sum())
        self.lost += int((drawn & ~covered & hidden).sum())

    @property
    def shares(self) -> tuple[float, float]:
        """Shares left behind the occluder and lost elsewhere."""
        return self.left / max(1, self.behind), self.lost / max(1, self.beside)


class OccluderSuite:
    """The section ``occluders`` of the evaluation.

    Args:
        recorded: scenes by name; of castle and plate the first frames have nothing before the part.
        details: for evaluation.json.
    """

    def __init__(self, recorded: dict[str, Scene], details: dict[str, Any]) -> None:
        self._recorded, self._details = recorded, details

    def rows(self) -> list[ResultRow]:
        """Rows of what is drawn over both sample clips, and of recorded scenes as they are."""
        rows = []
        for half in (bracket_half(FRAMES), plate_half(FRAMES)):
            found = composites(half)
            self._details[f"occluders-{half.part.name}"] = found
            for name, (left, lost) in found.items():
                text = f"{100 * left:.1f} % of the ghost behind it left, {100 * lost:.2f} % lost elsewhere"
                target = f"≤ {100 * MUST_LEAVE:.0f} %, ≤ {100 * MUST_LOSE:.0f} %"
                is_reached = left <= MUST_LEAVE and lost <= MUST_LOSE
                rows.append(ResultRow(f"{name} before the part", half.part.name, text, target, is_reached))
        for name in ("castle", "plate", "cube"):
            if name in self._recorded:
                lost_shares = clean(self._recorded[name])
                self._details[f"occluders-clean-{name}"] = lost_shares
                mean, most = float(np.mean(lost_shares)), max(lost_shares)
                text = f"{100 * mean:.2f} % of the ghost lost, at most {100 * most:.1f} %"
                rows.append(ResultRow("nothing before the part", name, text, "mean ≤ 0.5 %", mean <= 0.005))
        return rows


def composites(half: Half) -> dict[str, tuple[float, float]]:
    """Shares of the ghost left behind each occluder and lost elsewhere, in the clip at its true poses."""
    ghost = ghost_of(half.part, half.camera)
    finder = OccluderFinder(half.part.model, half.camera)
    rng = np.random.default_rng(SEED)
    size = round(REACH * half.camera.height)
    sprites = {name: sprite(parts, size, rng) for name, parts in OCCLUDERS.items()}
    finders: dict[str, OccluderFinder] = {}
    counts = {name: Counts() for name in OCCLUDERS}
    count = min(FRAMES, len(half.images))
    for k in watched(range(count), half.part.name):
        image, pose = half.images[k], half.truth[k]
        view = ghost.view(pose)
        assert view is not None
        if k == LEARNED:
            finders = {name: copy.deepcopy(finder) for name in OCCLUDERS}
        # What is found before the part in the clip itself, as a hand, is not counted.
        own = found_in(finder, image, view, pose)
        drawn = (view.face_ids >= 0) & (cv2.dilate(own.astype(np.uint8), np.ones((9, 9), np.uint8)) == 0)
        for name, one in finders.items():
            t = (k - LEARNED) / max(1, count - LEARNED - 1)
            center = half.camera.project(apply(pose, half.part.model.center_in_model)[None])[0]
            at = center + size * np.array([0.7 * t - 0.35, 0.15 * np.sin(5 * t)])
            shown, mask = composite(image, *sprites[name], at, 20 * np.sin(3 * t) + 15)
            counts[name].add(drawn, in_window(mask, view), found_in(one, shown, view, pose))
    return {name: one.shares for name, one in counts.items()}


def clean(scene: Scene) -> list[float]:
    """Share of the ghost lost in each of the first frames of a scene, at poses with a little noise."""
    ghost = ghost_of(scene.part, scene.camera)
    finder = OccluderFinder(scene.part.model, scene.camera)
    rng = np.random.default_rng(SEED)
    shares = []
    for frame in watched(scene.frames[:CLEAN_FRAMES], scene.part.name):
        if frame.cam_from_model is None:
            continue
        pose = frame.cam_from_model.copy()
        pose[:3, 3] *= 1 + rng.normal(0, DEPTH_NOISE)
        pose[:2, 3] += rng.normal(0, LATERAL_NOISE * pose[2, 3], 2)
        view = ghost.view(pose)
        if view is not None:
            drawn = view.face_ids >= 0
            hidden = found_in(finder, scene.image(frame), view, pose)
            shares.append(float((drawn & hidden).sum() / drawn.sum()))
    return shares[SKIPPED:]


def ghost_of(part: Part, camera: Camera) -> Ghost:
    """Renders a part."""
    return Ghost(part.model, camera, [topology(component) for component in part.model.components])


def found_in(finder: OccluderFinder, image: Image, view: GhostView, pose: Array) -> NDArray[np.bool_]:
    """Pixels of a window that something is found before."""
    found = finder.find(image, view, pose, True)
    return np.zeros(view.face_ids.shape, dtype=np.bool_) if found is None else found


def in_window(mask: NDArray[np.bool_], view: GhostView) -> NDArray[np.bool_]:
    """Part of a mask of the picture that lies in the window of a view."""
    height, width = view.face_ids.shape
    return mask[view.v0 : view.v0 + height, view.u0 : view.u0 + width]


def sprite(parts: Sequence[Capsule], size: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Colour (size,size,3), times the opacity (size,size), of something made of round bars."""
    n = 2 * size
    colors, opacity = np.zeros((n, n, 3), dtype=np.float32), np.zeros((n, n), dtype=np.float32)
    ys, xs = np.mgrid[0:n, 0:n].astype(np.float32)
    light = np.array([-0.6, -0.8])
    for part in parts:
        start, end = n * np.array(part.start), n * np.array(part.end)
        length = float(np.hypot(*(end - start)))
        along = (end - start) / length
        across = np.array([-along[1], along[0]])
        t = np.clip(((xs - start[0]) * along[0] + (ys - start[1]) * along[1]) / length, 0.0, 1.0)
        radius = n * (part.start_radius + (part.end_radius - part.start_radius) * t)
        is_inside = np.hypot(xs - start[0] - t * length * along[0], ys - start[1] - t * length * along[1]) < radius
        side = np.clip(((xs - start[0]) * across[0] + (ys - start[1]) * across[1]) / radius, -1.0, 1.0)
        lit = float(across @ light)
        shade = np.clip(0.35 + 0.5 * np.sqrt(1.0 - side * side) + 0.35 * side * lit, 0.1, None)
        shine = 255.0 * part.highlight * np.exp(-(((side - 0.45 * np.sign(lit)) / 0.16) ** 2))
        color = np.array(part.rgb) * shade[..., None] + shine[..., None]
        colors[is_inside], opacity[is_inside] = color[is_inside], 1.0
    colors += 6.0 * cv2.GaussianBlur(rng.normal(0, 1, (n, n)).astype(np.float32), (0, 0), 3)[..., None]
    colors[opacity == 0] = 0.0
    reduced = [cv2.resize(one, (size, size), interpolation=cv2.INTER_AREA) for one in (colors, opacity)]
    return reduced[0], reduced[1]


def composite(
    image: Image, colors: Array, opacity: Array, at: Array, angle_deg: float
) -> tuple[Image, NDArray[np.bool_]]:
    """A frame with something drawn over it at a place, and the pixels that it covers."""
    height, width = image.shape[:2]
    n = len(opacity)
    turn = cv2.getRotationMatrix2D((n / 2, n / 2), angle_deg, 1.0)
    turn[:, 2] += at - n / 2
    color = cv2.warpAffine(colors, turn, (width, height))
    alpha = cv2.warpAffine(opacity, turn, (width, height))
    shown = image * (1.0 - alpha[..., None]) + color
    shown += np.random.default_rng(int(at[0] * 7)).normal(0, 2.0, shown.shape) * (alpha > 0)[..., None]
    return np.clip(shown, 0, 255).astype(np.uint8), alpha > 0.5
