"""Features of photos and matches of pairs that were found before, so that they are not found again.

A measurement that begins while photos arrive finds them one photo at a time, and the reconstruction of all photos takes
them from here. Everything is identified by content: what is remembered is exactly what would be found.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import Any
from zipfile import BadZipFile

import numpy as np

from arview.core.atomic import replacing
from arview.core.stage_cache import content_key, key_of
from arview.reconstruction.features import DetectedFeatures, FeatureOptions, Features, detect_features, features_of
from arview.reconstruction.intake import read_photo
from arview.reconstruction.intake.masks import read_mask
from arview.reconstruction.matching import Matches
from arview.reconstruction.types import Photo


@dataclass
class SparseMemory:
    """What was found in photos, in this process, and of features also in a folder.

    Attributes:
        folder: of the features' files, which another process may have left; None: they are not written.
    """

    folder: Path | None = None
    _features: dict[str, Features] = field(default_factory=dict)
    _matches: dict[tuple[Any, ...], Matches] = field(default_factory=dict)
    _lock: Lock = field(default_factory=Lock)

    def features(self, photo: Photo, options: FeatureOptions, device: str | None = None) -> Features:
        """Features of a photo; see `find_features`. Raises InputError when it cannot be read."""
        masks = [] if photo.mask is None else [photo.mask]
        key = key_of(content_key([photo.path]), content_key(masks), options, device)
        found = self._features.get(key)
        if found is None:
            detected = self._read(key)
            if detected is None:
                detected = detect_features(read_photo(photo.path), options, read_mask(photo), device)
                self._write(key, detected)
            found = features_of(detected)
            with self._lock:
                self._features[key] = found
        return found

    def matches(self, key: tuple[Any, ...], find: Callable[[], Matches]) -> Matches:
        """Matches of a pair, identified by the prints of its features and by the options."""
        found = self._matches.get(key)
        if found is None:
            found = find()
            with self._lock:
                self._matches[key] = found
        return found

    def _file(self, key: str) -> Path | None:
        return None if self.folder is None else self.folder / f"{key}.npz"

    def _read(self, key: str) -> DetectedFeatures | None:
        """Features of a file; None if there is none, or it is damaged."""
        path = self._file(key)
        if path is None or not path.is_file():
            return None
        try:
            with np.load(path, allow_pickle=False) as content:
                points, sums, sizes, colors = (content[name] for name in ("points", "sums", "sizes", "colors"))
            return DetectedFeatures(points, sums.astype(np.float32), sizes, colors)
        except (OSError, ValueError, KeyError, EOFError, BadZipFile):
            return None

    def _write(self, key: str, found: DetectedFeatures) -> None:
        """Write features; a disk that is full costs time in another process, and nothing else."""
        path = self._file(key)
        if path is None:
            return
        small = found.sums.astype(np.uint8)
        sums = small if np.array_equal(small, found.sums) else found.sums
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with replacing(path) as file:
                np.savez(file, points=found.points_px, sums=sums, sizes=found.sizes_px, colors=found.colors)
        except OSError:
            return


def feature_prints(features: Sequence[Features]) -> list[str]:
    """A hash of each photo's features, by which their matches are remembered."""
    return [
        hashlib.blake2b(one.points_px.tobytes() + one.descriptors.tobytes(), digest_size=16).hexdigest()
        for one in features
    ]
