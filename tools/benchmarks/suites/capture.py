"""Photos that guided capture chooses against the same number at random, from sets of photos with exact truth.

The matches and the first poses are those of all photos; each choice is then adjusted alone and measured in the normal
way, without a cloud. So a choice is not penalised for photos that would match no other one, unless the rest of it does
not hold together. Rough frame and scale are those of the whole set: the CAD gives the scale in every measurement.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from arview.cad import Part, load_part
from arview.camera import Camera
from arview.errors import ArviewError
from arview.geometry import Array, rigid
from arview.measurement.folder import MetricReconstruction, read_folder
from arview.measurement.options import MeasureOptions
from arview.measurement.run import measure
from arview.reconstruction.coverage import components_seen, unit
from arview.reconstruction.halves import adjusted_alone
from arview.station.capture.dome import component_points
from arview.station.capture.information import Views, choose_views, focal_px
from arview.station.capture.needs import component_weights
from arview.station.capture.options import MAX_STEP_DEG
from recordings import ROOT, PhotoSet, photo_sets, skip
from rows import ResultRow, watched
from suites.measurement import component_error

COUNTS = (8, 12)
START = 3
"""Photos that every choice begins with: the first of the set, which are neighbours."""
SEEDS = 3
TARGET = 0.20


def capture_sets(more: Sequence[Path] = ()) -> list[PhotoSet]:
    """The photo sets of the measurement, and the samples of other kinds."""
    found = photo_sets(more)
    for name in ("manifold", "panel"):
        folder = ROOT / "samples" / name
        if (folder / "photos").is_dir():
            files = (folder / "photos", folder / "part.toml", folder / "truth.json", folder / "as_built.ply")
            found.append(PhotoSet(name, *files))
        else:
            skip(name, f"{folder / 'photos'} is not here")
    return found


def capture_rows(sets: Sequence[PhotoSet], folder: Path, details: dict[str, Any]) -> list[ResultRow]:
    """Rows of each set and number of photos, and of all together; measurements are kept in the folder and reused."""
    rows: list[ResultRow] = []
    ratios: list[tuple[float, float]] = []
    for photos in sets:
        _reconstruct(photos, folder / photos.name)
    trials = {photos.name: _Trial(photos, folder / photos.name) for photos in sets}
    for count in COUNTS:
        for name, trial in trials.items():
            chosen = trial.measured(trial.guided(count))
            others = [
                trial.measured(trial.at_random(count, seed)) for seed in watched(range(SEEDS), f"{name}, {count}")
            ]
            on = f"{name}, {count} of {trial.available} photos"
            details.setdefault("capture", {})[on] = {"guided": chosen, "random": others}
            row, ratio = _compared(on, chosen, others)
            rows.append(row)
            if ratio is not None:
                ratios.append(ratio)
    if ratios:
        u, error = np.exp(np.mean(np.log(ratios), axis=0))
        text = f"U {100 * (u - 1):+.0f} %, true error {100 * (error - 1):+.0f} % (geometric mean of {len(ratios)})"
        rows.append(ResultRow("chosen views", "all", text, "U ≥ 20 % smaller than at random", bool(u <= 1.0 - TARGET)))
    return rows


def _reconstruct(photos: PhotoSet, out: Path) -> None:
    """Poses and scale of all photos, if they are not there."""
    if (out / "scale.json").is_file():
        return
    program = [sys.executable, "-m", "arview.cli", "reconstruct", str(photos.folder), "--part", str(photos.part)]
    subprocess.run([*program, "-o", str(out), "--until", "scale"], check=True, stdout=subprocess.DEVNULL)


class _Trial:
    """Choices of the photos of one set, and what is measured from them."""

    def __init__(self, photos: PhotoSet, out: Path) -> None:
        self._out = out
        self._part = load_part(photos.part)
        truth = json.loads(photos.truth.read_text())
        self._truth = truth["truth"]
        self._poses = {name: np.array(pose) for name, pose in truth["cam_from_model_mm"].items()}
        self._found: MetricReconstruction = read_folder(out, with_cloud=False)
        self.available = len(self._found.sparse.photos)
        self._names = [photo.name for photo in self._found.sparse.photos]
        self._store = out / "capture.json"
        self._known: dict[str, Any] = json.loads(self._store.read_text()) if self._store.is_file() else {}

    def guided(self, count: int) -> list[int]:
        """The photos that guided capture takes one after another, of those that are there, by their true poses."""
        camera = self._found.sparse.photos[0].camera
        views, directions = self._views(self._part, camera)
        start, rest = list(range(START)), list(range(START, self.available))
        order = choose_views(
            views[start], views[rest], component_weights(self._part), directions[rest], list(directions[start]),
            count - START, MAX_STEP_DEG,
        )  # fmt: skip
        return sorted([*start, *(rest[index] for index in order)])

    def at_random(self, count: int, seed: int) -> list[int]:
        """The same start and others at random."""
        rng = np.random.default_rng(100 * count + seed)
        some = START + rng.permutation(self.available - START)[: count - START]
        return sorted([*range(START), *(int(index) for index in some)])

    def _views(self, part: Part, camera: Camera) -> tuple[Views, Array]:
        """The views of all photos, and their directions (N,3)."""
        poses = [self._poses[name] for name in self._names]
        eyes = np.array([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])
        seen = np.array([components_seen(part.model, camera, pose) for pose in poses])
        views = Views.of(component_points(part), seen, eyes, focal_px(camera))
        return views, unit(eyes - part.model.center_in_model)

    def measured(self, chosen: list[int]) -> dict[str, Any]:
        """U and true error of each component, mm, or why there are none."""
        key = ",".join(str(index) for index in chosen)
        if key not in self._known:
            self._known[key] = self._measure(chosen)
            self._store.write_text(json.dumps(self._known))
        return {"photos": chosen, **self._known[key]}

    def _measure(self, chosen: list[int]) -> dict[str, Any]:
        whole = self._found.sparse
        try:
            sparse = adjusted_alone(self._out / "sparse" / "model", whole, [whole.photos[index] for index in chosen])
            options = MeasureOptions(methods=("sweep", "edges"))
            inspection = measure(replace(self._found, sparse=sparse), self._part, options)
        except ArviewError as error:
            return {"reason": str(error)}
        components = {}
        for one in inspection.components:
            if one.name not in self._truth:
                continue
            true = self._truth[one.name]
            place = true.get("measured_from_nominal", rigid(np.eye(3), np.array(true["displacement_mm"])))
            found = component_error("", one, np.array(place))
            if found.uncertainty is not None and found.error is not None:
                budget = {line.name: line.std_mm for line in one.details.budget} if one.details else {}
                length = float(np.linalg.norm(np.nan_to_num(found.error)))
                components[one.name] = {"U_mm": found.uncertainty, "error_mm": length, "budget": budget}
        return {"components": components}


def _compared(
    on: str, chosen: dict[str, Any], others: Sequence[dict[str, Any]]
) -> tuple[ResultRow, tuple[float, float] | None]:
    """The row of one set, and chosen over random of mean U and mean error, of components that all choices measure."""
    target = "U ≥ 20 % smaller than at random"
    failed = [one["reason"] for one in others if "reason" in one]
    valid = [one["components"] for one in others if "components" in one]
    if "reason" in chosen or not valid:
        return ResultRow("chosen views", on, chosen.get("reason", "nothing to compare with"), target, False), None
    ours = chosen["components"]
    names = sorted(set(ours).intersection(*valid))
    u_mm, error_mm = (np.mean([ours[name][key] for name in names]) for key in ("U_mm", "error_mm"))
    of_others = np.array(
        [[np.mean([one[name][key] for name in names]) for key in ("U_mm", "error_mm")] for one in valid]
    )
    ratio = float(u_mm / of_others[:, 0].mean()), float(error_mm / of_others[:, 1].mean())
    lengths = [len(one) for one in valid]
    text = (
        f"U {u_mm:.3f} mm against {of_others[:, 0].mean():.3f} ({of_others[:, 0].min():.3f} to "
        f"{of_others[:, 0].max():.3f}): {100 * (ratio[0] - 1):+.0f} %; error {error_mm:.3f} against "
        f"{of_others[:, 1].mean():.3f} mm; {len(ours)} against {min(lengths)} to {max(lengths)} components measured"
    )
    if failed:
        text += f"; {len(failed)} random choices cannot be measured"
    return ResultRow("chosen views", on, text, target, bool(ratio[0] <= 1.0 - TARGET)), ratio
