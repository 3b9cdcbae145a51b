"""Features that stand still in the picture while others move: the background of a turntable, a watermark, dirt.

Structure from motion places the cameras relative to whatever most features belong to. Where a part turns before a
camera on a stand, the background holds the same places in every photo, and the part cannot be placed against it. Such
features are recognised without knowing the part: the same appearance at the same pixel in most other photos.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from arview.reconstruction.features import Features
from arview.reconstruction.matching import MAX_ANGLE_RAD, Matches

MAX_SHIFT_PX = 1.5
"""Of a still feature between two photos; those of a part that turns move by more."""
COMPARED_PHOTOS = 8
"""Others to which each photo is compared, spread over the set."""
MIN_SHARE = 0.5
"""Of these, in which the feature is found again at its place."""
MIN_PHOTOS = 4
"""Sets with fewer photos are left as they are."""
MAX_SIZE_RATIO = 1.5
"""Between the sizes of a feature and of the one found again."""
USUAL_SHARE = 0.02
"""Of a photo's features; fewer are chance, dirt on the lens or a watermark."""
CANDIDATES = 4
"""Nearest features that are compared with each feature."""


def still_features(features: Sequence[Features], threads: int = 1) -> list[NDArray[np.bool_]]:
    """For each photo, which of its features (N,) stand still in the picture."""
    if len(features) < MIN_PHOTOS:
        return [np.zeros(len(one), dtype=np.bool_) for one in features]
    trees = [cKDTree(one.points_px) if len(one) else None for one in features]

    def of_photo(index: int) -> NDArray[np.bool_]:
        others = _spread_others(index, len(features), COMPARED_PHOTOS)
        counts = np.zeros(len(features[index]))
        for other in others:
            counts += _found_again(features[index], features[other], trees[other])
        return np.asarray(counts >= max(2.0, MIN_SHARE * len(others)))

    with ThreadPoolExecutor(max(1, threads)) as pool:
        return list(pool.map(of_photo, range(len(features))))


def without(features: Features, dropped: NDArray[np.bool_]) -> Features:
    """The features that are not dropped, in their order."""
    return features.taken(~dropped)


def still_remark(features: Sequence[Features], still: Sequence[NDArray[np.bool_]]) -> str:
    """What is said of the still features; empty if they are no more than chance or a watermark."""
    shares = [float(np.mean(one)) for one in still if len(one)]
    if not shares or float(np.median(shares)) < USUAL_SHARE:
        return ""
    return (
        f"{100 * float(np.median(shares)):.0f} % of the features stand still in the picture while others move: a "
        "turntable, or a part that is moved before a camera on a stand; the still background is left out. Where the "
        "part is still not placed, give masks (--masks auto, or a folder)"
    )


def moved_matches(ones: Features, others: Features, matches: Matches, min_px: float) -> Matches:
    """The matches whose features are at least ``min_px`` apart in the two pictures."""
    apart = ones.points_px[matches[:, 0]] - others.points_px[matches[:, 1]]
    return matches[np.linalg.norm(apart, axis=1) >= min_px]


def _spread_others(index: int, count: int, wanted: int) -> list[int]:
    """Other photos, evenly spread over the set."""
    others = [i for i in range(count) if i != index]
    step = max(1.0, len(others) / wanted)
    return [others[int(k * step)] for k in range(min(wanted, len(others)))]


def _found_again(ones: Features, others: Features, tree: cKDTree | None) -> NDArray[np.bool_]:
    """(N,) whether each feature is found in the other photo at the same pixel with the same appearance."""
    found = np.zeros(len(ones), dtype=np.bool_)
    if tree is None or len(ones) == 0:
        return found
    count = min(CANDIDATES, len(others))
    _, near = tree.query(ones.points_px, k=count, distance_upper_bound=MAX_SHIFT_PX)
    near = near.reshape(len(ones), count)
    for column in near.T:
        rows = np.flatnonzero(column < len(others))
        partners = column[rows]
        similarity = np.einsum("ij,ij->i", ones.descriptors[rows], others.descriptors[partners])
        ratio = np.abs(np.log(ones.sizes_px[rows] / np.maximum(others.sizes_px[partners], 1e-6)))
        is_same = (similarity > np.cos(MAX_ANGLE_RAD)) & (ratio < np.log(MAX_SIZE_RATIO))
        found[rows[is_same]] = True
    return found
