"""Photos with exact truth: what `arview measure` says of every component, its uncertainty and its verdict."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from arview.cad import load_part
from arview.geometry import Array, apply, rigid, rotation_angle_rad
from arview.inspection import ComponentDeviation, Details, MethodResult, Verdict, load_inspection
from arview.measurement.datums.alignment import align
from arview.measurement.datums.in_photos import measure_datums_in_photos
from arview.measurement.datums.options import DatumOptions
from arview.measurement.folder import read_folder
from arview.measurement.photo import load_views
from arview.measurement.uncertainty.decision import decide
from recordings import PhotoSet
from rows import Line
from suites.reconstruction import timed_run

TOLERANCE_MM = 0.5
CLOUD_TARGET_MM = 0.20
CHOICES = 20


@dataclass(frozen=True)
class Row:
    """One component against truth, of what is determined; mm.

    Attributes:
        on: the photo set. name: the component.
        error: (3,) measured minus true displacement of its middle, NaN where undetermined; None: not measured.
        cloud: the same by the cloud alone.
        true_distance, distance, uncertainty: of the determined part.
        is_covered: whether the interval holds the true distance.
        agree: whether sweep and edges agree; None when one of them has nothing.
    """

    on: str
    name: str
    error: Array | None
    cloud: Array | None
    true_distance: float
    distance: float | None
    uncertainty: float | None
    is_covered: bool
    agree: bool | None


def measure_lines(sets: Sequence[PhotoSet], folder: Path, details: dict[str, Any]) -> list[Line]:
    """Lines for every photo set, and for all together; reconstructions are kept in the folder and read again."""
    lines: list[Line] = []
    every: list[Row] = []
    for photos in sets:
        out = folder / photos.name
        timed_run(photos, out)
        seconds = {name: timed_measure(photos, out, *options) for name, options in WAYS.items()}
        rows = rows_of(photos, out / "inspection.json")
        every += rows
        lines += set_lines(photos.name, rows)
        text = ", ".join(f"{value:.0f} s {name}" for name, value in seconds.items())
        reached = seconds["in photos"] <= 30 and seconds["without Monte Carlo"] <= 8
        lines.append(Line("time after the cloud", photos.name, text, "≤ 30 s, ≤ 8 s without Monte Carlo", reached))
        lines += repeatability_lines(photos, out)
        details.setdefault("measure", {})[photos.name] = [plain(row) for row in rows]
    if every:
        lines += honesty_lines(every, len(sets))
    return lines


WAYS = {
    "without Monte Carlo": ("--methods", "sweep,edges", "--no-monte-carlo"),
    "in photos": ("--methods", "sweep,edges"),
    "with the cloud": (),
}
"""Options of the runs that are timed; the last one's inspection is judged."""


def timed_measure(photos: PhotoSet, out: Path, *options: str) -> float:
    """Seconds of a run of the command; what it decides is not looked at."""
    program = [sys.executable, "-m", "arview.cli", "measure", str(out), "--part", str(photos.part), "--no-maps"]
    began = time.perf_counter()
    done = subprocess.run([*program, *options], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    if done.returncode not in (0, 1, 2):
        raise RuntimeError(f"{' '.join(program)}: {done.stderr.strip()}")
    return time.perf_counter() - began


def rows_of(photos: PhotoSet, inspection: Path) -> list[Row]:
    """The components of an inspection.json against the set's truth."""
    truth = json.loads(photos.truth.read_text())["truth"]
    rows = []
    for one in load_inspection(inspection).components:
        if one.name not in truth:
            continue
        true = truth[one.name]
        pose = np.array(true.get("measured_from_nominal", rigid(np.eye(3), np.array(true["displacement_mm"]))))
        rows.append(row_of(photos.name, one, pose))
    return rows


def row_of(on: str, one: ComponentDeviation, true_pose: Array) -> Row:
    full = one.details
    if full is None or one.distance_mm is None or one.uncertainty_mm is None:
        return Row(on, one.name, None, None, 0.0, None, None, False, None)
    center = np.array(full.center_mm)
    true = apply(true_pose, center) - center
    error = difference(one.displacement_mm, true)
    true_distance = float(np.linalg.norm(true[np.isfinite(error)]))
    low, high = full.interval_mm or (0.0, np.inf)
    cloud = method_of(full, "cloud")
    pairs = [pair.agree for pair in full.agreement if set(pair.methods) == {"sweep", "edges"}]
    return Row(
        on, one.name, error, None if cloud is None or cloud.displacement_mm is None
        else difference(cloud.displacement_mm, true), true_distance, one.distance_mm, one.uncertainty_mm,
        low <= true_distance <= high, pairs[0] if pairs else None,
    )  # fmt: skip


def difference(found: Sequence[float | None], true: Array) -> Array:
    """(3,) found − true, NaN where nothing is determined."""
    return np.array([np.nan if value is None else value for value in found]) - true


def method_of(full: Details, name: str) -> MethodResult | None:
    return next((one for one in full.methods if one.method == name), None)


def set_lines(on: str, rows: Sequence[Row]) -> list[Line]:
    """Errors, verdicts and the cloud's way of one set."""
    errors = np.array([row.error for row in rows if row.error is not None])
    if len(errors) == 0:
        return [Line("displacement", on, "nothing was measured", "every component", False)]
    across, height = np.hypot(errors[:, 0], errors[:, 1]), np.abs(errors[:, 2])
    median, most, high = np.nanmedian(across), np.nanpercentile(across, 95), float(np.nanmax(height))
    text = f"{len(errors)}/{len(rows)} components: in the plane {1e3 * median:.0f} µm median, {1e3 * most:.0f} µm 95 %,"
    text += f" {1e3 * np.nanmax(across):.0f} µm worst; height {1e3 * high:.0f} µm worst"
    reached = len(errors) == len(rows) and median <= 0.025 and most <= 0.06 and high <= 0.10
    lines = [Line("displacement", on, text, "≤ 25 µm median, ≤ 60 µm 95 %, height ≤ 100 µm", reached)]
    counts = Counter(judgement(row) for row in rows)
    text = ", ".join(f"{count} {what}" for what, count in sorted(counts.items()))
    wrong = counts["false pass"] + counts["false fail"] + counts["not measured"]
    lines.append(Line(f"verdicts at {TOLERANCE_MM:g} mm", on, text, "no false pass, no false fail", wrong == 0))
    by_cloud = np.array([row.cloud for row in rows if row.cloud is not None])
    if len(by_cloud):
        size = np.sqrt(np.nansum(by_cloud**2, axis=1))
        text = f"{len(by_cloud)}/{len(rows)} components, {np.median(size):.3f} mm median, "
        text += f"{np.percentile(size, 95):.3f} mm 95 %"
        reached = len(by_cloud) == len(rows) and np.percentile(size, 95) <= CLOUD_TARGET_MM
        lines.append(Line("displacement by cloud and ICP", on, text, "≤ 0.20 mm for 95 %", bool(reached)))
    return lines


def judgement(row: Row) -> str:
    """What the verdict is worth; undecided is wrong only when the limit is farther away than U."""
    verdict = decide(row.distance, row.uncertainty, TOLERANCE_MM)
    is_good = row.true_distance <= TOLERANCE_MM
    if verdict is Verdict.UNDECIDED:
        return "undecided"
    if verdict is Verdict.NOT_MEASURED:
        return "not measured"
    if (verdict is Verdict.PASS) == is_good:
        return "right"
    return "false pass" if verdict is Verdict.PASS else "false fail"


def repeatability_lines(photos: PhotoSet, out: Path) -> list[Line]:
    """How the datum frame spreads when it is measured in random choices of the photos; nothing without datums."""
    part = load_part(photos.part)
    if not part.datums:
        return []
    sparse = replace(read_folder(out).sparse, pose_covariance=None)
    low, high = part.model.component(part.datums[0].component).bounds_in_model
    rng = np.random.default_rng(0)
    frames = []
    for _ in range(CHOICES):
        kept = np.sort(rng.choice(len(sparse.photos), 2 * len(sparse.photos) // 3, replace=False))
        is_kept = np.isin(sparse.observed_photo, kept)
        some = replace(
            sparse, photos=tuple(sparse.photos[k] for k in kept), observed_point=sparse.observed_point[is_kept],
            observed_photo=np.searchsorted(kept, sparse.observed_photo[is_kept]).astype(np.int32),
            observed_px=sparse.observed_px[is_kept],
        )  # fmt: skip
        equations = measure_datums_in_photos(part.datums, load_views(some, part.model), {}, DatumOptions())
        middle, size_mm = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
        frames.append(align(equations, middle, size_mm).rough_from_datum)
    found = np.array(frames)
    spread_mm = float(np.ptp(found[:, :3, 3], axis=0).max())
    turn_deg = max(float(np.degrees(rotation_angle_rad(a, b))) for i, a in enumerate(found) for b in found[:i])
    text = f"origin within {spread_mm:.3f} mm, axes within {turn_deg:.4f}° of each other"
    on = f"{photos.name}, {CHOICES} choices of two thirds of the photos"
    return [Line("datum repeatability", on, text, "≤ 0.03 mm, ≤ 0.01°", spread_mm <= 0.03 and turn_deg <= 0.01)]


def honesty_lines(rows: Sequence[Row], sets: int) -> list[Line]:
    """Whether the stated uncertainties hold, over all sets."""
    measured = [row for row in rows if row.uncertainty is not None]
    covered = float(np.mean([row.is_covered for row in measured]))
    mean = float(np.mean([row.uncertainty for row in measured if row.uncertainty is not None]))
    agree = [row.agree for row in measured if row.agree is not None]
    share = float(np.mean(agree)) if agree else 0.0
    on, outside = f"{sets} sets", [f"{row.on} {row.name}" for row in measured if not row.is_covered]
    text = f"{100 * covered:.1f} % of {len(measured)} intervals hold the truth, mean U {mean:.3f} mm"
    text += f"; not {', '.join(outside)}" if outside else ""
    is_honest = len(measured) >= 60 and 0.90 <= covered <= 0.99 and mean <= 0.12
    return [
        Line("U is honest", on, text, "90–99 % of ≥ 60, mean ≤ 0.12 mm", is_honest),
        Line("sweep and edges agree", on, f"{100 * share:.0f} % of {len(agree)}", "≥ 90 %", share >= 0.90),
    ]


def plain(row: Row) -> dict[str, Any]:
    """A row for JSON; what is undetermined is null."""
    vectors = {
        name: None if value is None else [None if np.isnan(x) else round(float(x), 5) for x in value]
        for name, value in (("error_mm", row.error), ("cloud_error_mm", row.cloud))
    }
    return {
        "component": row.name, **vectors, "true_mm": row.true_distance, "distance_mm": row.distance,
        "U_mm": row.uncertainty, "covered": row.is_covered, "agree": row.agree, "judgement": judgement(row),
    }  # fmt: skip
