"""Features that stand still in the picture while others move: the background of a turntable, a watermark, dirt.

Structure from motion places the cameras relative to whatever most features belong to. Where a part turns before a
camera on a stand, the background holds the same places in every photo, and the part cannot be placed against it. Such
features are recognised without knowing the part: the same appearance at the same pixel in most other photos.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from arview.reconstruction.features import Features
from arview.reconstruction.matching import MAX_ANGLE_RAD, Matches


@dataclass(frozen=True)
class StillOptions:
    """When a feature counts as still, and when a set of photos has a still background."""

    max_shift_px: float = 1.5  # of a still feature between two photos; those of a part that turns move by more
    compared_photos: int = 8  # others to which each photo is compared, spread over the set
    min_share: float = 0.5  # of these, in which the feature is found again at its place
    min_photos: int = 4  # sets with fewer photos are left as they are
    max_size_ratio: float = 1.5  # between the sizes of a feature and of the one found again
    usual_share: float = 0.02  # of a photo's features; fewer are chance, dirt on the lens or a watermark
    candidates: int = 4  # nearest features that are compared with each feature


def still_features(
    features: Sequence[Features], options: StillOptions | None = None, threads: int = 1
) -> list[NDArray[np.bool_]]:
    """For each photo, which of its features (N,) stand still in the picture."""
    options = options or StillOptions()
    if len(features) < options.min_photos:
        return [np.zeros(len(one), dtype=np.bool_) for one in features]
    trees = [cKDTree(one.points_px) if len(one) else None for one in features]

    def of_photo(index: int) -> NDArray[np.bool_]:
        others = _spread_others(index, len(features), options.compared_photos)
        counts = np.zeros(len(features[index]))
        for other in others:
            counts += _found_again(features[index], features[other], trees[other], options)
        return np.asarray(counts >= max(2.0, options.min_share * len(others)))

    with ThreadPoolExecutor(max(1, threads)) as pool:
        return list(pool.map(of_photo, range(len(features))))


def without(features: Features, dropped: NDArray[np.bool_]) -> Features:
    """The features that are not dropped, in their order."""
    return features.taken(~dropped)


def still_remark(
    features: Sequence[Features], still: Sequence[NDArray[np.bool_]], options: StillOptions | None = None
) -> str:
    """What is said of the still features; empty if they are no more than chance or a watermark."""
    options = options or StillOptions()
    shares = [float(np.mean(one)) for one in still if len(one)]
    if not shares or float(np.median(shares)) < options.usual_share:
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


def _found_again(ones: Features, others: Features, tree: cKDTree | None, options: StillOptions) -> NDArray[np.bool_]:
    """(N,) whether each feature is found in the other photo at the same pixel with the same appearance."""
    found = np.zeros(len(ones), dtype=np.bool_)
    if tree is None or len(ones) == 0:
        return found
    count = min(options.candidates, len(others))
    _, near = tree.query(ones.points_px, k=count, distance_upper_bound=options.max_shift_px)
    near = near.reshape(len(ones), count)
    for column in near.T:
        rows = np.flatnonzero(column < len(others))
        partners = column[rows]
        similarity = np.einsum("ij,ij->i", ones.descriptors[rows], others.descriptors[partners])
        ratio = np.abs(np.log(ones.sizes_px[rows] / np.maximum(others.sizes_px[partners], 1e-6)))
        is_same = (similarity > np.cos(MAX_ANGLE_RAD)) & (ratio < np.log(options.max_size_ratio))
        found[rows[is_same]] = True
    return found
