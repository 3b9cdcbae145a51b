"""Coverage of the stated uncertainty over many photo sets with exact truth, class by class.

Sets are folders with photos/, part.toml and truth.json, as `make_sets.py` writes them; its sets.json beside them names
their classes and which of them are kept for judging. Reconstructions are kept and reused.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from arview.errors import InputError
from arview.geometry import Array, apply, rigid
from arview.inspection import ComponentDeviation, Verdict, load_inspection
from recordings import skip
from rows import ResultRow, watched

RESAMPLES = 2000
CLASSES = ("kind", "light", "photos", "layout")


@dataclass(frozen=True)
class CoverageSet:
    """A photo set and its classes.

    Attributes:
        folder: with photos/, part.toml and truth.json.
        kind, light, photos, layout: its classes; ``?`` where sets.json does not name them.
        use: ``develop``, or ``judge`` for those that nothing may be tuned on.
    """

    folder: Path
    kind: str = "?"
    light: str = "?"
    photos: str = "?"
    layout: str = "?"
    use: str = "develop"


@dataclass(frozen=True)
class Measured:
    """A component whose displacement and U are known.

    Attributes:
        on: the set.
        name: of the component.
        error_mm: measured minus true distance, of the determined directions.
        uncertainty_mm: U of the distance.
        is_held: the interval holds the true distance.
        z: errors along the own axes that are determined, each divided by its standard uncertainty.
        is_false: a wrong pass or fail.
        budget: standard uncertainty of each contribution, mm.
    """

    on: CoverageSet
    name: str
    error_mm: float
    uncertainty_mm: float
    is_held: bool
    z: tuple[float, ...]
    is_false: bool
    budget: dict[str, float]


def coverage_sets(root: Path, use: str) -> list[CoverageSet]:
    """The finished sets of a folder with the given use, or all; raises InputError without any."""
    listed = root / "sets.json"
    named = {one["folder"]: one for one in json.loads(listed.read_text())} if listed.is_file() else {}
    found = []
    for folder in sorted(root.iterdir()) if root.is_dir() else []:
        entry = named.get(folder.name, {} if not named else None)
        if entry is None or not (folder / "truth.json").is_file() or not (folder / "photos").is_dir():
            continue
        known = {name: str(entry[name]) for name in (*CLASSES, "use") if name in entry}
        one = CoverageSet(folder, **known)
        if use in ("all", one.use):
            found.append(one)
    if not found:
        raise InputError(f"{root}: no photo sets with truth.json; make them with tools/benchmarks/make_sets.py")
    return found


def coverage_rows(root: Path, use: str, out: Path, details: dict[str, Any]) -> list[ResultRow]:
    """Rows of all sets together, of each class and of each direction."""
    measured: list[Measured] = []
    for one in watched(coverage_sets(root, use), "coverage"):
        try:
            measured += measured_set(one, out / one.folder.name)
        except subprocess.CalledProcessError as error:
            skip(one.folder.name, f"{' '.join(map(str, error.cmd[3:5]))}: {error.stderr.strip().splitlines()[-1]}")
    if not measured:
        raise InputError(f"{root}: nothing could be measured")
    details["coverage"] = [
        {**asdict(one), "on": one.on.folder.name, "classes": {name: getattr(one.on, name) for name in CLASSES}}
        for one in measured
    ]
    rows = [class_row("all", measured, (0.93, 0.97))]
    for name in CLASSES:
        for value in sorted({getattr(one.on, name) for one in measured}):
            some = [one for one in measured if getattr(one.on, name) == value]
            rows.append(class_row(f"{name} {value}", some, (0.90, 0.99)))
    rows += [budget_row(measured), false_row(measured)]
    return rows


def measured_set(one: CoverageSet, out: Path) -> list[Measured]:
    """Reconstruct a set as far as its scale, where that is not done yet, measure it in the photos and compare."""
    part = str(one.folder / "part.toml")
    inspection = out / "inspection.json"
    run("reconstruct", str(one.folder / "photos"), "--part", part, "-o", str(out), "--until", "scale")
    run(
        "measure", str(out), "--part", part, "-o", str(inspection), "--methods", "sweep,edges", "--no-maps",
        verdicts=(0, 1, 2),
    )  # fmt: skip
    return errors_of(one, inspection)


def run(*words: str, verdicts: tuple[int, ...] = (0,)) -> None:
    """Run a command of arview; raises CalledProcessError where it ends with another code than ``verdicts``."""
    program = [sys.executable, "-m", "arview.cli", *words]
    done = subprocess.run(program, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    if done.returncode not in verdicts or "Error" in done.stderr:
        raise subprocess.CalledProcessError(done.returncode, program, stderr=done.stderr or "no message")


def errors_of(one: CoverageSet, inspection: Path) -> list[Measured]:
    """The components of an inspection that have a distance with U and a true place."""
    truth = json.loads((one.folder / "truth.json").read_text())["truth"]
    found = [
        measured_component(one, component, truth[component.name])
        for component in load_inspection(inspection).components
        if component.name in truth
    ]
    return [component for component in found if component is not None]


def measured_component(on: CoverageSet, one: ComponentDeviation, true: dict[str, Any]) -> Measured | None:
    """A component compared with its true place; None where it is absent, or was not measured."""
    full = one.details
    if full is None or one.distance_mm is None or one.uncertainty_mm is None or full.covariance is None:
        return None
    pose = np.array(true.get("measured_from_nominal", rigid(np.eye(3), np.array(true.get("displacement_mm", 3 * [0])))))
    center = np.array(full.center_mm)
    axes = np.array(full.axes) if full.axes is not None else np.eye(3)
    own = np.array([np.nan if value is None else value for value in full.own_displacement_mm or 3 * [None]], float)
    seen = np.isfinite(own)
    shift = axes @ (apply(pose, center) - center)
    std = np.sqrt(np.diag(axes @ np.array(full.covariance)[3:, 3:] @ axes.T))
    true_mm = float(np.linalg.norm(shift[seen]))
    low, high = full.interval_mm or (0.0, np.inf)
    limit = one.tolerance_mm
    is_false = limit is not None and (
        (one.verdict is Verdict.PASS and true_mm > limit)
        or (one.verdict is Verdict.FAIL and true_mm <= limit and one.distance_mm > limit)
    )
    return Measured(
        on, one.name, one.distance_mm - true_mm, one.uncertainty_mm, low <= true_mm <= high,
        tuple(((own - shift) / std)[seen].round(3).tolist()), is_false,
        {line.name: line.std_mm for line in full.budget},
    )  # fmt: skip


# --- statistics ------------------------------------------------------------------------------------------


def by_bootstrap(measured: Sequence[Measured], figure: Callable[[Sequence[Measured]], float]) -> Array:
    """(2,) 95 % interval of a figure, by drawing sets with replacement: components of one set share its errors."""
    by_set: dict[Path, list[Measured]] = {}
    for one in measured:
        by_set.setdefault(one.on.folder, []).append(one)
    groups, rng = list(by_set.values()), np.random.default_rng(0)
    drawn = [
        figure([one for index in rng.integers(len(groups), size=len(groups)) for one in groups[index]])
        for _ in range(RESAMPLES)
    ]
    return np.quantile(drawn, [0.025, 0.975])


def share_held(measured: Sequence[Measured]) -> float:
    """Share of intervals that hold the truth."""
    return float(np.mean([one.is_held for one in measured]))


def class_row(name: str, measured: Sequence[Measured], limits: tuple[float, float]) -> ResultRow:
    """Coverage, U and normalised errors of a class.

    All sets together must be within the limits; a class, whose limits are wider, misses them only where its whole
    interval does.
    """
    share, sets = share_held(measured), len({one.on.folder for one in measured})
    low, high = by_bootstrap(measured, share_held)
    uncertainty = float(np.mean([one.uncertainty_mm for one in measured]))
    z = np.array([value for one in measured for value in one.z])
    inside = float(np.mean(np.abs(z) <= 1.96))
    text = f"{100 * share:.1f} % [{100 * low:.1f}, {100 * high:.1f}] of {len(measured)} in {sets} sets"
    text += f", mean U {uncertainty:.3f} mm; along own axes {100 * inside:.1f} % of {len(z)} within 1.96 u,"
    text += f" rms of error / u {np.sqrt(np.mean(z**2)):.2f}"
    worst, best = (share, share) if name == "all" else (low, high)
    is_reached = best >= limits[0] and worst <= limits[1]
    target = f"{100 * limits[0]:.0f}–{100 * limits[1]:.0f} %"
    return ResultRow("coverage of U", name, text, target, bool(is_reached))


def budget_row(measured: Sequence[Measured]) -> ResultRow:
    """Root mean square of each line of the budget."""
    squares: dict[str, list[float]] = {}
    for one in measured:
        for name, value in one.budget.items():
            squares.setdefault(name, []).append(value**2)
    lines = sorted(((float(np.sqrt(np.mean(v))), name) for name, v in squares.items()), reverse=True)
    text = ", ".join(f"{name} {1e3 * value:.0f}" for value, name in lines)
    return ResultRow("budget of U, µm rms", "all", text, "for information", True)


def false_row(measured: Sequence[Measured]) -> ResultRow:
    """Wrong passes and fails."""
    wrong = Counter(f"{one.on.folder.name} {one.name}" for one in measured if one.is_false)
    text = ", ".join(wrong) or f"none of {len(measured)}"
    return ResultRow("false verdicts on positions", "all", text, "none", not wrong)
