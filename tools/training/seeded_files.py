"""Example files, one for each seed; existing files are kept."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from tqdm import tqdm


def missing_files(seeds: Iterable[int], folder: Path, name: str, label: str) -> Iterator[tuple[int, Path]]:
    """The seeds whose files do not exist yet, with the paths of these files.

    Args:
        seeds: of all files.
        folder: of the files; it is created.
        name: of a file, with {} for the seed.
        label: of the progress bar.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for seed in tqdm(seeds, desc=label, disable=None):
        path = folder / name.format(seed)
        if not path.exists():
            yield seed, path
