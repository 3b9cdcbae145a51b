"""Examples for the contour verifier: contour profiles at the final hypotheses of the detector, labelled."""

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
from arview.detection.search.hypothesis import Hypothesis
from arview.geometry import Array
from profile_ranker_examples import REFINED_APART, REFINED_NEAR, label_poses, pictures_of
from seeded_files import missing_files

VERIFIED = 8
"""Poses of each search that are verified, more than by default: the network learns from wrong hypotheses."""


@dataclass(frozen=True)
class ContourProfiles:
    """Contour profiles at the verified poses of one picture.

    Attributes:
        solid: seed of the solid.
        profiles: (N,RAW,ROWS,COLUMNS) uint8, see `contour_profiles`.
        radii_px: (N,) half the diameter in the picture.
        known: (N,4) verifier score, logit of the evidence, profile score and edge response.
        is_right, is_known: (N,) bool: the pose is right; its label is known.
        is_from_truth: (N,) bool: refined from the true pose, not found by the search.
        has_part: the part is in the picture.
    """

    solid: int
    profiles: NDArray[np.uint8]
    radii_px: Array
    known: Array
    is_right: NDArray[np.bool_]
    is_known: NDArray[np.bool_]
    is_from_truth: NDArray[np.bool_]
    has_part: bool


def collect_contours(seeds: range, photos: Sequence[Path], folder: Path) -> None:
    """Write the contour profiles in the pictures of each solid, unless its file exists."""
    for seed, path in missing_files(seeds, folder, "contours_{}.pkl", "solids"):
        examples = []
        for detector, image, truth in pictures_of(seed, photos, DetectorOptions().budgets):
            detector.local.options = replace(detector.local.options, max_verified=VERIFIED)
            example = contours_of(seed, detector, image, truth)
            examples += [example] if example is not None else []
        with replacing(path) as file:
            pickle.dump(examples, file)


def contours_of(seed: int, detector: Detector, image: NDArray[np.uint8], truth: Array | None) -> ContourProfiles | None:
    """Contour profiles at the verified poses of a picture; None without any.

    Args:
        seed: of the solid.
        detector: of the solid.
        image: (H,W,3) RGB.
        truth: (4,4) true ``cam_from_body``; None for a picture without the solid.
    """
    picture, local = detector.local.pyramid(image), detector.local
    found: list[Hypothesis] = detector.hypotheses(picture)
    from_truth = local.refine_and_verify(picture, [PoseCandidate(0.0, truth)]) if truth is not None else []
    both = [*found, *from_truth]
    if not both:
        return None
    poses = np.stack([h.cam_from_body for h in both])
    right, is_known = label_poses(detector, poses, truth, REFINED_NEAR, REFINED_APART, 1.0)
    return ContourProfiles(
        seed,
        np.stack([contour_profiles(picture, local.refiner.part, pose) for pose in poses]),
        picture.radii_px(detector.views.diameter_mm, poses),
        np.array(
            [(h.verifier_score, h.evidence_logit, h.profile_score, h.edge_response) for h in both], dtype=np.float64
        ),
        right,
        is_known,
        np.arange(len(both)) >= len(found),
        truth is not None,
    )
