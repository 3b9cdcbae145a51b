"""Examples for the network that looks at strips: what the whole detector ends with, and which of it is right."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from arview.core.atomic import replacing
from arview.detection import Detector, DetectorOptions
from arview.detection.scoring.contour_verifier import contour_profiles
from arview.detection.search.global_search import PoseCandidate
from arview.detection.search.local_search import Hypothesis
from arview.geometry import Array
from profile_ranker_examples import REFINED_APART, REFINED_NEAR, pictures_of, told
from seeded_files import still_to_make

VERIFIED = 8
"""So many poses of each search are verified, more than in use: rivals are what is learned from."""


@dataclass(frozen=True)
class Stripped:
    """The verified poses of one picture.

    Attributes:
        solid: its seed.
        strips: (N,RAW,ROWS,COLUMNS) uint8, see `contour_profiles`.
        radii_px: (N,) half the diameter in the picture.
        known: (N,4) verification, logit of the evidence, profile_score, support by lines.
        is_right, is_told: (N,) bool: right, and that it is known whether so.
        is_given: (N,) bool: found from the true pose, not by the search.
        has_part: the part is in the picture.
    """

    solid: int
    strips: NDArray[np.uint8]
    radii_px: Array
    known: Array
    is_right: NDArray[np.bool_]
    is_told: NDArray[np.bool_]
    is_given: NDArray[np.bool_]
    has_part: bool


def collect_strips(seeds: range, photos: Sequence[Path], folder: Path) -> None:
    """Write the verified poses of each solid's pictures to a file of its own, unless it is there."""
    for seed, path in still_to_make(seeds, folder, "strips_{}.pkl", "solids"):
        examples = []
        for detector, image, truth in pictures_of(seed, photos, DetectorOptions().budgets):
            detector.local.options = replace(detector.local.options, verified=VERIFIED)
            example = strips_of(seed, detector, image, truth)
            examples += [example] if example is not None else []
        with replacing(path) as file:
            pickle.dump(examples, file)


def strips_of(seed: int, detector: Detector, image: NDArray[np.uint8], truth: Array | None) -> Stripped | None:
    """The verified poses of a picture with the true ``cam_from_body`` of the part, or without it; None if none."""
    picture, local = detector.local.pyramid(image), detector.local
    found: list[Hypothesis] = detector.hypotheses(picture)
    given = local.refine_and_verify(picture, [PoseCandidate(0.0, truth)]) if truth is not None else []
    both = [*found, *given]
    if not both:
        return None
    poses = np.stack([h.cam_from_body for h in both])
    right, is_told = told(detector, poses, truth, REFINED_NEAR, REFINED_APART, 1.0)
    return Stripped(
        seed,
        np.stack([contour_profiles(picture, local.refiner.part, pose) for pose in poses]),
        picture.radii_px(detector.views.diameter_mm, poses),
        np.array(
            [(h.verifier_score, h.evidence_logit, h.profile_score, h.edge_response) for h in both], dtype=np.float64
        ),
        right,
        is_told,
        np.arange(len(both)) >= len(found),
        truth is not None,
    )
