"""Examples for the pair comparator: near-symmetric poses of random solids, labelled."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from arview.core.atomic import replacing
from arview.detection import Detector
from arview.detection.disambiguation import turned
from arview.detection.features.image_pyramid import ImagePyramid
from arview.detection.scoring.pair_comparator import pair_crops
from arview.detection.search.global_search import QUICK
from arview.detection.search.hypothesis import Hypothesis
from arview.geometry import Array, exp_so3, log_so3, rigid
from arview_lab.semisynthetic.random_solids import random_near_symmetric, random_solid
from profile_ranker_examples import REFINED_APART, REFINED_NEAR, is_near, pictures_of
from seeded_files import missing_files

NEAR_POSES, ROTATED_POSES, MAX_POSES = 6, 4, 8
"""Near-symmetric poses and other rotations that are tried beside the true pose, and poses kept of them."""
START_DEG, START_SHARE = 3.0, 0.01
"""Standard deviation of the starts in rotation and, in diameters, in position; they are refined."""
ROTATED_DEG = (8.0, 50.0)
"""Range of the angles of the other rotations."""
OTHER_EVERY = 4
"""One solid in this many is not made near-symmetric."""


@dataclass(frozen=True)
class NearSymmetricPoses:
    """Poses of one picture with about the same position.

    Attributes:
        solid: seed of the solid.
        picture, drawn, edges: (S,S,4) uint8, (N,6,S,S) int8, 127 for 1, and (N,3,S,S) uint8, see `pair_crops`.
        logits: (N,) of each pose, without the contour verifier.
        is_right: (N,) bool, at least one True and one False.
    """

    solid: int
    picture: NDArray[np.uint8]
    drawn: NDArray[np.int8]
    edges: NDArray[np.uint8]
    logits: Array
    is_right: NDArray[np.bool_]

    @property
    def pixels(self) -> NDArray[np.uint8]:
        """(N,S,S,4) the picture, repeated for each pose."""
        return np.broadcast_to(self.picture, (len(self.logits), *self.picture.shape))


def collect_pairs(seeds: range, photos: Sequence[Path], folder: Path) -> None:
    """Write the near-symmetric poses in the pictures of each solid, unless its file exists."""
    for seed, path in missing_files(seeds, folder, "pairs_{}.pkl", "solids"):
        rng = np.random.default_rng([seed, 6])
        examples = []
        for detector, image, truth in pictures_of(
            seed, photos, (QUICK,), random_near_symmetric if seed % OTHER_EVERY else random_solid
        ):
            if truth is not None:
                examples += near_symmetric_poses(seed, detector, detector.local.pyramid(image), truth, rng)
        with replacing(path) as file:
            pickle.dump(examples, file)


def near_symmetric_poses(
    seed: int, detector: Detector, picture: ImagePyramid, truth: Array, rng: np.random.Generator
) -> list[NearSymmetricPoses]:
    """Poses refined from rotations of the true ``cam_from_body``; empty unless some are right and some wrong."""
    local = detector.local
    starts = [_perturbed(start, detector.views.diameter_mm, rng) for start in _rotated_starts(detector, truth, rng)]
    found = local.deduplicate(
        local.verify(picture, local.deduplicate(local.refine_fine(picture, starts), 5.0)), 5.0, MAX_POSES
    )
    poses = np.array([h.cam_from_body for h in found]).reshape(-1, 4, 4)
    limits = (REFINED_NEAR, REFINED_APART)
    right, near = (is_near(detector, poses, truth, detector.disambiguator.exact_rotations, *limit) for limit in limits)
    # Poses between the two limits have no label.
    kept: list[Hypothesis] = [h for h, is_known in zip(found, right | ~near, strict=True) if is_known]
    right = right[right | ~near]
    if not right.any() or right.all():
        return []
    crops = pair_crops(picture, local.refiner.part, [h.cam_from_body for h in kept])
    drawn, edges = np.stack([crop.drawn for crop in crops]), np.stack([crop.responses for crop in crops])
    logits = np.array([h.logit_without_contour for h in kept])
    return [NearSymmetricPoses(seed, crops[0].pixels, np.round(127.0 * drawn).astype(np.int8), edges, logits, right)]


def _rotated_starts(detector: Detector, truth: Array, rng: np.random.Generator) -> list[Array]:
    """The true pose, its near-symmetric poses, and smaller rotations, most of them about the axis of one of these."""
    near = rng.permutation(detector.symmetries.near)[:NEAR_POSES]
    turns = [np.eye(3), *near]
    for _ in range(ROTATED_POSES):
        axis = rng.normal(size=3)
        if len(near) and rng.random() < 0.7:
            axis = log_so3(near[int(rng.integers(len(near)))])
        angle = np.deg2rad(rng.uniform(*ROTATED_DEG)) * rng.choice((-1.0, 1.0))
        turns.append(turns[rng.integers(1 + len(near))] @ exp_so3(angle * axis / np.linalg.norm(axis)))
    return turned(truth, turns)


def _perturbed(pose: Array, diameter_mm: float, rng: np.random.Generator) -> Array:
    """A pose with a small random error."""
    turn = exp_so3(np.deg2rad(START_DEG) * rng.normal(size=3) / np.sqrt(3.0))
    return rigid(turn @ pose[:3, :3], pose[:3, 3] + START_SHARE * diameter_mm * rng.normal(size=3))
