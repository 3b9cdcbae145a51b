"""COLMAP beside arview: structure from motion of one folder of photos, neither of which is told the camera."""

from __future__ import annotations

import shutil
import tempfile
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from peers.alone import alone, cpu_s
from peers.programs import MissingPeerError
from suites.scaling import write_photos

GET = "pip install pycolmap"


@dataclass
class Steps:
    """CPU seconds by step, children included: a step lasts from the call that names it to the next call."""

    seconds: dict[str, float]
    step: str
    last_s: float

    @classmethod
    def begin(cls, step: str) -> Steps:
        """Start with a step."""
        return cls(defaultdict(float), step, cpu_s())

    def __call__(self, step: str, done: int = 0, total: int = 0) -> None:
        """Begin a step, which ends the one before; the counts of a progress callback are ignored."""
        now_s = cpu_s()
        self.seconds[self.step] += now_s - self.last_s
        self.step, self.last_s = step, now_s


@dataclass(frozen=True)
class PhotoRun:
    """CPU seconds by step of one run, and how many photos were placed by each way of placing them."""

    seconds: dict[str, float]
    placed: dict[str, int]


@dataclass(frozen=True)
class PhotoRow:
    """One step, or one way from photos to their places: CPU seconds of each round, photos placed in the first."""

    way: str
    step: str
    rounds_s: list[float]
    placed: int | None
    photos: int

    @property
    def median_s(self) -> float:
        """Median over the rounds."""
        return float(np.median(self.rounds_s))


def with_arview(photos: Path, part: Path | None) -> PhotoRun:
    """Reconstruct with arview, up to the scale, which takes the part; without it up to the cameras."""
    from arview.cad import load_part
    from arview.reconstruction.run import ReconstructOptions, reconstruct

    with tempfile.TemporaryDirectory() as folder:
        loaded = load_part(part) if part is not None else None
        steps = Steps.begin("start")
        found = reconstruct(photos, folder, loaded, None, ReconstructOptions(last_stage="scale"), progress=steps)
        steps("end")
    kind = "to the scale" if loaded is not None else "to the cameras"
    return PhotoRun(dict(steps.seconds), {kind: len(found.sparse.photos) if found.sparse is not None else 0})


def with_colmap(photos: Path) -> PhotoRun:
    """Features, exhaustive matching, then incremental and global mapping by COLMAP's defaults on the processor."""
    import zlib  # noqa: F401 - before pycolmap, which brings a zlib of its own

    import pycolmap

    pycolmap.logging.minloglevel = 3
    cpu = pycolmap.Device.cpu
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        database, copy = folder / "database.db", folder / "copy.db"
        steps = Steps.begin("features")
        pycolmap.extract_features(database, photos, device=cpu)
        steps("matching")
        pycolmap.match_exhaustive(database, device=cpu)
        steps("copy")
        shutil.copyfile(database, copy)
        (folder / "incremental").mkdir()
        (folder / "global").mkdir()
        steps("incremental mapping")
        placed = {"incremental": _placed(pycolmap.incremental_mapping(database, photos, folder / "incremental"))}
        if hasattr(pycolmap, "global_mapping"):
            steps("global mapping")
            placed["global"] = _placed(pycolmap.global_mapping(copy, photos, folder / "global"))
        steps("end")
    del steps.seconds["copy"]
    return PhotoRun(dict(steps.seconds), placed)


def _placed(models: dict[int, object]) -> int:
    """Photos in the largest of the models."""
    return max((int(model.num_reg_images()) for model in models.values()), default=0)  # type: ignore[attr-defined]


def photo_rows(folder: Path | None, part: Path | None, count: int, rounds: int) -> list[PhotoRow]:
    """Both on the photos of a folder, or on ``count`` photos made of the sample plate's; raises MissingPeerError."""
    if find_spec("pycolmap") is None:
        raise MissingPeerError(GET)
    with tempfile.TemporaryDirectory() as made:
        if folder is None:
            folder, part = Path(made) / "photos", None
            write_photos(folder, count)
        photos = sum(path.is_file() for path in folder.iterdir())
        works: dict[str, Callable[[], PhotoRun]] = {
            "arview": partial(alone, with_arview, folder, part),
            "COLMAP": partial(alone, with_colmap, folder),
        }
        runs: dict[str, list[PhotoRun]] = {way: [] for way in works}
        for _ in range(rounds):
            for way, work in works.items():
                runs[way].append(work())
    return [row for way, of_way in runs.items() for row in _rows(way, of_way, photos)]


def _rows(way: str, runs: list[PhotoRun], photos: int) -> list[PhotoRow]:
    totals = []
    for kind, placed in runs[0].placed.items():
        left_out = {f"{other} mapping" for other in runs[0].placed if other != kind}
        sums = [sum(s for step, s in run.seconds.items() if step not in left_out) for run in runs]
        totals.append(PhotoRow(way, f"all, {kind}", sums, placed, photos))
    steps = [
        PhotoRow(way, step, [run.seconds.get(step, 0.0) for run in runs], None, photos) for step in runs[0].seconds
    ]
    return [*totals, *steps]
