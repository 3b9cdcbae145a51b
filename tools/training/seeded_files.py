"""Files that are made of seeds, one of each; those that are there are kept."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from tqdm import tqdm


def still_to_make(seeds: Iterable[int], folder: Path, name: str, what: str) -> Iterator[tuple[int, Path]]:
    """The seeds whose files are not in a folder, which is made, and these files; ``name`` has {} for the seed."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed in tqdm(seeds, desc=what, disable=None):
        path = folder / name.format(seed)
        if not path.exists():
            yield seed, path
