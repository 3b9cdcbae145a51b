"""Which pairs of photos are matched: by what they have in common, by rough poses, or as recorded by an earlier run."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from arview.core.stage_cache import write_json
from arview.errors import InputError
from arview.geometry import Array
from arview.reconstruction.features import Features
from arview.reconstruction.matching import match_descriptors
from arview.reconstruction.types import Photo

Pair = tuple[int, int]
FORMAT, VERSION = "arview pairs", 1
MAX_PAIR_ANGLE_DEG = 45.0
"""Largest angle between the viewing directions of a pair; beyond it SIFT finds nothing in common."""


PREVIEW_FEATURES = 400
"""Per photo, to choose the pairs to match; Wu 2013."""
PREVIEW_MATCHES = 5
"""Of these that a chosen pair needs; chance gives 0 to 3."""
ALL_PAIRS_UP_TO = 12
"""Photos; up to this number every pair is matched."""
NEIGHBOURS = 3
"""Following photos that are always matched: a walk around the part, a video."""
HINTS_FROM = 30
"""Photos from which rough poses choose the pairs; fewer are matched as without them."""
MAX_HINT_ANGLE_DEG = 60.0
"""Between the directions of two rough poses; SIFT finds nothing beyond 45°."""
MIN_PARTNERS = 2
"""Of a photo with a rough pose; with fewer, its pose is not trusted."""


@dataclass(frozen=True)
class KnownPairs:
    """What is known of the pairs before the photos are matched.

    Attributes:
        recorded: names of the pairs that are matched, and no others; None: not known.
        poses: rough ``cam_from_model`` (4,4) of photos, by name, as a tracker saw them.
    """

    recorded: tuple[tuple[str, str], ...] | None = None
    poses: Mapping[str, Array] = field(default_factory=dict)

    def key(self) -> tuple[Any, ...]:
        """What the choice of pairs depends on, for a stage's key."""
        return self.recorded, tuple((name, pose.tolist()) for name, pose in sorted(self.poses.items()))


def chosen_pairs(
    photos: Sequence[Photo],
    features: Sequence[Features],
    known: KnownPairs,
    pool: ThreadPoolExecutor,
) -> list[Pair]:
    """Pairs of photos to be matched, in a fixed order."""
    if known.recorded is not None:
        place = {photo.name: index for index, photo in enumerate(photos)}
        given = ((place.get(one), place.get(other)) for one, other in known.recorded)
        return sorted({(min(i, j), max(i, j)) for i, j in given if i is not None and j is not None and i != j})
    pairs = list(itertools.combinations(range(len(photos)), 2))
    poses = _trusted_poses(photos, known)
    axes = [None if (pose := poses.get(photo.name)) is None else pose[2, :3] for photo in photos]
    if len(photos) <= ALL_PAIRS_UP_TO and all(axis is None for axis in axes):
        return pairs
    limit = np.cos(np.deg2rad(MAX_HINT_ANGLE_DEG))

    def by_pose(pair: Pair) -> bool | None:
        one, other = (axes[index] for index in pair)
        return None if one is None or other is None else bool(one @ other > limit)

    unknown = [pair for pair in pairs if by_pose(pair) is None]
    promising = set(promising_pairs(features, unknown, pool))
    return [pair for pair in pairs if by_pose(pair) or pair in promising]


def _trusted_poses(photos: Sequence[Photo], known: KnownPairs) -> Mapping[str, Array]:
    """The rough poses, where there are so many photos that to choose by them saves time.

    With few photos the pairs, and so the numbers, are those that the photos alone give.
    """
    return known.poses if len(photos) >= HINTS_FROM else {}


def doubtful_pairs(
    photos: Sequence[Photo],
    features: Sequence[Features],
    known: KnownPairs,
    tried: Sequence[Pair],
    matched: Sequence[Pair],
    pool: ThreadPoolExecutor,
) -> list[Pair]:
    """More pairs of photos whose rough pose led to too few partners, so that it is likely to be wrong."""
    poses = _trusted_poses(photos, known)
    if known.recorded is not None or not poses:
        return []
    partners = np.zeros(len(photos), dtype=int)
    for pair in matched:
        partners[list(pair)] += 1
    lonely = {i for i, photo in enumerate(photos) if photo.name in poses and partners[i] < MIN_PARTNERS}
    rest = sorted(set(itertools.combinations(range(len(photos)), 2)) - set(tried))
    return promising_pairs(features, [pair for pair in rest if lonely & set(pair)], pool)


def promising_pairs(features: Sequence[Features], pairs: Sequence[Pair], pool: ThreadPoolExecutor) -> list[Pair]:
    """Of some pairs, those whose largest features match often enough (preemptive matching, Wu 2013)."""
    if len(features) <= ALL_PAIRS_UP_TO:
        return list(pairs)
    wanted = sorted({index for pair in pairs for index in pair})
    largest = {index: _largest(features[index], PREVIEW_FEATURES) for index in wanted}

    def is_promising(pair: Pair) -> bool:
        if pair[1] - pair[0] <= NEIGHBOURS:
            return True
        return len(match_descriptors(largest[pair[0]], largest[pair[1]])) >= PREVIEW_MATCHES

    return [pair for pair, is_chosen in zip(pairs, pool.map(is_promising, pairs), strict=True) if is_chosen]


def _largest(features: Features, count: int) -> Any:
    return np.ascontiguousarray(features.descriptors[np.argsort(-features.sizes_px, kind="stable")[:count]])


def pairs_in_common_view(poses: Mapping[int, Array]) -> list[Pair]:
    """Pairs of placed photos that look in similar enough directions."""
    limit = np.cos(np.radians(MAX_PAIR_ANGLE_DEG))
    return [(i, j) for i, j in itertools.combinations(sorted(poses), 2) if poses[i][2, :3] @ poses[j][2, :3] > limit]


def write_pairs(path: Path, photos: Sequence[Photo], pairs: Sequence[Pair]) -> None:
    """Record which pairs were matched, so that another run can do the same. Raises OutputError."""
    names = [[photos[i].name, photos[j].name] for i, j in pairs]
    write_json(path, {"format": FORMAT, "version": VERSION, "pairs": names})


def read_pairs(path: str | Path) -> KnownPairs:
    """The pairs that an earlier run recorded. Raises InputError when the file holds none."""
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except ValueError as error:
        raise InputError(f"{path}: is no list of pairs ({error})") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT or content.get("version") != VERSION:
        raise InputError(f"{path}: is no list of pairs; give the sparse/pairs.json of an inspection")
    pairs = content.get("pairs")
    is_list = isinstance(pairs, list) and all(
        isinstance(pair, list) and len(pair) == 2 and all(isinstance(name, str) for name in pair) for pair in pairs
    )
    if not is_list or not pairs:
        raise InputError(f"{path}: holds no pairs of names of photos")
    return KnownPairs(tuple((str(one), str(other)) for one, other in pairs))
