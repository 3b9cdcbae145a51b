"""Consensus of detections of the part in several photos on one similarity.

Each detection gives the part's pose relative to its camera; the reconstruction gives the cameras' poses. Any two that
agree define a similarity, whose score is the sum over the photos with a detection that supports it (consensus: Fischler
& Bolles 1981). Wrong detections and symmetric alternatives agree with few others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from arview.geometry import Array, apply, invert, orthonormalise, rigid, rotation_angle_rad
from arview.reconstruction.scale.similarity import Similarity

AGREE_RAD = float(np.deg2rad(2.5))
"""Largest difference in rotation of detections that agree."""
ACROSS = 0.02
ALONG = 0.06
"""Largest differences of the centre, across and along the view, in diameters of the part."""
SAME_RAD = float(np.deg2rad(8.0))
SAME_PLACE = 0.1
SAME_SCALE = 0.06
"""Differences in rotation, position (diameters) and log scale below which two similarities count as one."""


@dataclass(frozen=True)
class Sighting:
    """A detection in one photo.

    Attributes:
        photo: index of the photo.
        cam_from_scan: (4,4) pose of the photo in the reconstruction.
        cam_from_model: (4,4) detected pose, mm.
        quality: of the detection, 0–1.
    """

    photo: int
    cam_from_scan: Array
    cam_from_model: Array
    quality: float


@dataclass(frozen=True)
class Vote:
    """A similarity, the detections that support it (one per photo), and the sum of their qualities."""

    similarity: Similarity
    sightings: tuple[Sighting, ...]
    score: float


def vote(sightings: Sequence[Sighting], center_in_model: Array, diameter_mm: float) -> list[Vote]:
    """Similarities on which at least two photos agree, best first, each different from those before it.

    Args:
        sightings: detections; a photo may have several.
        center_in_model: (3,) centre of the part, mm.
        diameter_mm: of the part.
    """
    votes = []
    for a, b in combinations(sightings, 2):
        if a.photo == b.photo or rotation_angle_rad(_rotation(a), _rotation(b)) > AGREE_RAD:
            continue
        chosen: Sequence[Sighting] = (a, b)
        for _ in range(2):
            similarity = _fit(chosen, center_in_model)
            chosen = _supporting(similarity, sightings, center_in_model, diameter_mm) if similarity else ()
            if len(chosen) < 2:
                break
        if similarity is not None and len(chosen) >= 2:
            votes.append(Vote(similarity, tuple(chosen), sum(sighting.quality for sighting in chosen)))
    votes.sort(key=lambda v: -v.score)
    apart: list[Vote] = []
    for candidate in votes:
        if not any(_same(candidate.similarity, v.similarity, center_in_model, diameter_mm) for v in apart):
            apart.append(candidate)
    return apart


def _rotation(sighting: Sighting) -> Array:
    """Rotation (3,3) of ``model_from_scan`` according to one detection."""
    return np.asarray(sighting.cam_from_model[:3, :3].T @ sighting.cam_from_scan[:3, :3])


def _fit(sightings: Sequence[Sighting], center_in_model: Array) -> Similarity | None:
    """Least-squares similarity: the mean rotation, then the position and scale that fit the detected centres."""
    rotation = orthonormalise(rigid(np.mean([_rotation(s) for s in sightings], axis=0), np.zeros(3)))[:3, :3]
    rows, right = [], []
    for s in sightings:
        scan_from_cam = s.cam_from_scan[:3, :3].T
        towards = scan_from_cam @ apply(s.cam_from_model, center_in_model)
        rows.append(np.column_stack([np.eye(3), -towards]))
        right.append(-scan_from_cam @ s.cam_from_scan[:3, 3])
    solution = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
    if not solution[3] > 0:
        return None
    scale = 1.0 / float(solution[3])
    return Similarity(scale, rigid(rotation, center_in_model - scale * rotation @ solution[:3]))


def _supporting(
    similarity: Similarity, sightings: Sequence[Sighting], center_in_model: Array, diameter_mm: float
) -> list[Sighting]:
    """The best detection of each photo that agrees with a similarity."""
    best: dict[int, Sighting] = {}
    for sighting in sightings:
        if _agrees(similarity, sighting, center_in_model, diameter_mm):
            rival = best.get(sighting.photo)
            if rival is None or sighting.quality > rival.quality:
                best[sighting.photo] = sighting
    return list(best.values())


def _agrees(similarity: Similarity, sighting: Sighting, center_in_model: Array, diameter_mm: float) -> bool:
    """Whether a detection agrees with a similarity."""
    expected = similarity.cam_from_model(sighting.cam_from_scan)
    if rotation_angle_rad(expected, sighting.cam_from_model) > AGREE_RAD:
        return False
    middle = apply(sighting.cam_from_model, center_in_model)
    away = apply(expected, center_in_model) - middle
    along = away @ middle / np.linalg.norm(middle)
    across = float(np.sqrt(max(0.0, away @ away - along**2)))
    return bool(across < ACROSS * diameter_mm and abs(along) < ALONG * diameter_mm)


def _same(a: Similarity, b: Similarity, center_in_model: Array, diameter_mm: float) -> bool:
    """Whether two similarities are equal for practical purposes."""
    if rotation_angle_rad(a.model_from_scan, b.model_from_scan) > SAME_RAD:
        return False
    middles = [apply(invert(s.model_from_scan), center_in_model) / s.scale for s in (a, b)]
    is_near = np.linalg.norm(middles[0] - middles[1]) * a.scale < SAME_PLACE * diameter_mm
    return bool(is_near and abs(np.log(a.scale / b.scale)) < SAME_SCALE)
