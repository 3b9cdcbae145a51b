"""Examples for the network that tells twins apart: poses of nearly symmetric solids, and which of them is right."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from arview.core.atomic import replacing
from arview.detection import Detector
from arview.detection.features.image_pyramid import ImagePyramid
from arview.detection.scoring.pair_comparator import pair_crops
from arview.detection.search.global_search import QUICK
from arview.detection.search.local_search import Hypothesis
from arview.evaluation.semisynthetic.random_solids import random_near_symmetric, random_solid
from arview.geometry import Array, exp_so3, log_so3, rigid, turned
from profile_ranker_examples import REFINED_APART, REFINED_NEAR, is_near, pictures_of
from seeded_files import still_to_make

TWINS, ASIDE, MOST = 6, 4, 8
"""So many twins of the true pose are looked at and so many others turned from it; and so many in all that are left."""
OFF_DEG, OFF_SHARE = 3.0, 0.01
"""All are this far off at first, about, in rotation and in diameters: what is looked at is refined."""
ASIDE_DEG = (8.0, 50.0)
OTHER_EVERY = 4
"""Every so manieth solid is not made to have twins."""


@dataclass(frozen=True)
class Twins:
    """Poses of one picture at about the same place.

    Attributes:
        solid: its seed.
        picture: (S,S,4) uint8; drawn: (N,6,S,S) int8, 127 for 1; lines: (N,3,S,S) uint8: see `pair_crops`.
        logits: (N,) see `Hypothesis.logit_without_contour`.
        is_right: (N,) bool, at least one and not all.
    """

    solid: int
    picture: NDArray[np.uint8]
    drawn: NDArray[np.int8]
    lines: NDArray[np.uint8]
    logits: Array
    is_right: NDArray[np.bool_]

    @property
    def pixels(self) -> NDArray[np.uint8]:
        """(N,S,S,4) of each pose, the same."""
        return np.broadcast_to(self.picture, (len(self.logits), *self.picture.shape))


def collect_twins(seeds: range, photos: Sequence[Path], folder: Path) -> None:
    """Write the twins in each solid's pictures to a file of its own, unless it is there."""
    for seed, path in still_to_make(seeds, folder, "twins_{}.pkl", "solids"):
        rng = np.random.default_rng([seed, 6])
        examples = []
        for detector, image, truth in pictures_of(
            seed, photos, (QUICK,), random_near_symmetric if seed % OTHER_EVERY else random_solid
        ):
            if truth is not None:
                examples += twins_of(seed, detector, detector.local.pyramid(image), truth, rng)
        with replacing(path) as file:
            pickle.dump(examples, file)


def twins_of(
    seed: int, detector: Detector, picture: ImagePyramid, truth: Array, rng: np.random.Generator
) -> list[Twins]:
    """What becomes of poses turned from the true ``cam_from_body`` in a picture; empty where none is right or wrong."""
    local = detector.local
    starts = [_off(start, detector.views.diameter_mm, rng) for start in _turned(detector, truth, rng)]
    found = local.deduplicate(
        local.verify(picture, local.deduplicate(local.refine_fine(picture, starts), 5.0)), 5.0, MOST
    )
    poses = np.array([h.cam_from_body for h in found]).reshape(-1, 4, 4)
    limits = (REFINED_NEAR, REFINED_APART)
    right, near = (is_near(detector, poses, truth, detector.exact_rotations, *limit) for limit in limits)
    # Between the two it is neither right nor wrong.
    kept: list[Hypothesis] = [h for h, is_told in zip(found, right | ~near, strict=True) if is_told]
    right = right[right | ~near]
    if not right.any() or right.all():
        return []
    crops = pair_crops(picture, local.refiner.part, [h.cam_from_body for h in kept])
    drawn, lines = np.stack([crop.drawn for crop in crops]), np.stack([crop.responses for crop in crops])
    logits = np.array([h.logit_without_contour for h in kept])
    return [Twins(seed, crops[0].pixels, np.round(127.0 * drawn).astype(np.int8), lines, logits, right)]


def _turned(detector: Detector, truth: Array, rng: np.random.Generator) -> list[Array]:
    """A pose, its twins, and poses turned from it by less, mostly about the axis of one."""
    near = rng.permutation(detector.symmetries.near)[:TWINS]
    turns = [np.eye(3), *near]
    for _ in range(ASIDE):
        axis = rng.normal(size=3)
        if len(near) and rng.random() < 0.7:
            axis = log_so3(near[rng.integers(len(near))])
        angle = np.deg2rad(rng.uniform(*ASIDE_DEG)) * rng.choice((-1.0, 1.0))
        turns.append(turns[rng.integers(1 + len(near))] @ exp_so3(angle * axis / np.linalg.norm(axis)))
    return turned(truth, turns)


def _off(pose: Array, diameter_mm: float, rng: np.random.Generator) -> Array:
    """A pose a little off."""
    turn = exp_so3(np.deg2rad(OFF_DEG) * rng.normal(size=3) / np.sqrt(3.0))
    return rigid(turn @ pose[:3, :3], pose[:3, 3] + OFF_SHARE * diameter_mm * rng.normal(size=3))
