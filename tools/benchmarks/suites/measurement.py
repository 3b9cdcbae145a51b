"""Measurement of photo sets with exact truth: displacement, uncertainty and verdict of each component."""

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
from arview.measurement.folder import read_folder
from arview.measurement.photo import load_views
from arview.measurement.uncertainty.decision import decide
from recordings import PhotoSet
from rows import ResultRow
from suites.reconstruction import timed_run

TOLERANCE_MM = 0.5
CLOUD_TARGET_MM = 0.20
CHOICES = 20


@dataclass(frozen=True)
class ComponentError:
    """Errors of one component, of the determined directions; mm.

    Attributes:
        on: name of the photo set.
        name: of the component.
        error: (3,) measured minus true displacement of its centre, NaN where undetermined; None: not measured.
        cloud: the same by the cloud alone.
        true_distance, distance, uncertainty: of the determined part of the displacement.
        is_covered: the interval contains the true distance.
        agree: sweep and edges agree; None when one of them has no result.
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


def measurement_rows(sets: Sequence[PhotoSet], folder: Path, details: dict[str, Any]) -> list[ResultRow]:
    """Rows of each photo set and of all together; reconstructions are kept in a folder and reused."""
    rows: list[ResultRow] = []
    of_all_sets: list[ComponentError] = []
    for photos in sets:
        out = folder / photos.name
        timed_run(photos, out)
        seconds = {name: timed_measure(photos, out, *options) for name, options in TIMED_RUNS.items()}
        components = component_errors(photos, out / "inspection.json")
        of_all_sets += components
        rows += set_rows(photos.name, components)
        text = ", ".join(f"{value:.0f} s {name}" for name, value in seconds.items())
        reached = seconds["in photos"] <= 30 and seconds["without Monte Carlo"] <= 8
        rows.append(ResultRow("time after the cloud", photos.name, text, "≤ 30 s, ≤ 8 s without Monte Carlo", reached))
        rows += repeatability_rows(photos, out)
        details.setdefault("measure", {})[photos.name] = [plain(component) for component in components]
    if of_all_sets:
        rows += coverage_rows(of_all_sets, len(sets))
    return rows


TIMED_RUNS = {
    "without Monte Carlo": ("--methods", "sweep,edges", "--no-monte-carlo"),
    "in photos": ("--methods", "sweep,edges"),
    "with the cloud": (),
}
"""Options of the timed runs; the inspection of the last one is evaluated."""


def timed_measure(photos: PhotoSet, out: Path, *options: str) -> float:
    """Seconds of a run of `arview measure`, whatever its verdict."""
    program = [sys.executable, "-m", "arview.cli", "measure", str(out), "--part", str(photos.part), "--no-maps"]
    began = time.perf_counter()
    done = subprocess.run([*program, *options], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    if done.returncode not in (0, 1, 2):
        raise RuntimeError(f"{' '.join(program)}: {done.stderr.strip()}")
    return time.perf_counter() - began


def component_errors(photos: PhotoSet, inspection: Path) -> list[ComponentError]:
    """Errors of the components of an inspection.json."""
    truth = json.loads(photos.truth.read_text())["truth"]
    components = []
    for one in load_inspection(inspection).components:
        if one.name not in truth:
            continue
        true = truth[one.name]
        pose = np.array(true.get("measured_from_nominal", rigid(np.eye(3), np.array(true["displacement_mm"]))))
        components.append(component_error(photos.name, one, pose))
    return components


def component_error(on: str, one: ComponentDeviation, true_pose: Array) -> ComponentError:
    full = one.details
    if full is None or one.distance_mm is None or one.uncertainty_mm is None:
        return ComponentError(on, one.name, None, None, 0.0, None, None, False, None)
    center = np.array(full.center_mm)
    true = apply(true_pose, center) - center
    error = difference(one.displacement_mm, true)
    true_distance = float(np.linalg.norm(true[np.isfinite(error)]))
    low, high = full.interval_mm or (0.0, np.inf)
    cloud = method_of(full, "cloud")
    pairs = [pair.agree for pair in full.agreement if set(pair.methods) == {"sweep", "edges"}]
    return ComponentError(
        on, one.name, error, None if cloud is None or cloud.displacement_mm is None
        else difference(cloud.displacement_mm, true), true_distance, one.distance_mm, one.uncertainty_mm,
        low <= true_distance <= high, pairs[0] if pairs else None,
    )  # fmt: skip


def difference(found: Sequence[float | None], true: Array) -> Array:
    """(3,) found − true, NaN where undetermined."""
    return np.array([np.nan if value is None else value for value in found]) - true


def method_of(full: Details, name: str) -> MethodResult | None:
    return next((one for one in full.methods if one.method == name), None)


def set_rows(on: str, components: Sequence[ComponentError]) -> list[ResultRow]:
    """Rows of one set: errors, verdicts, and errors by the cloud alone."""
    errors = np.array([component.error for component in components if component.error is not None])
    if len(errors) == 0:
        return [ResultRow("displacement", on, "nothing was measured", "every component", False)]
    across, height = np.hypot(errors[:, 0], errors[:, 1]), np.abs(errors[:, 2])
    median, p95, high = np.nanmedian(across), np.nanpercentile(across, 95), float(np.nanmax(height))
    text = f"{len(errors)}/{len(components)} components: in the plane {1e3 * median:.0f} µm median, "
    text += f"{1e3 * p95:.0f} µm 95 %, {1e3 * np.nanmax(across):.0f} µm worst; height {1e3 * high:.0f} µm worst"
    reached = len(errors) == len(components) and median <= 0.025 and p95 <= 0.06 and high <= 0.10
    rows = [ResultRow("displacement", on, text, "≤ 25 µm median, ≤ 60 µm 95 %, height ≤ 100 µm", reached)]
    counts = Counter(verdict_quality(component) for component in components)
    text = ", ".join(f"{count} {what}" for what, count in sorted(counts.items()))
    wrong = counts["false pass"] + counts["false fail"] + counts["not measured"]
    rows.append(ResultRow(f"verdicts at {TOLERANCE_MM:g} mm", on, text, "no false pass, no false fail", wrong == 0))
    by_cloud = np.array([component.cloud for component in components if component.cloud is not None])
    if len(by_cloud):
        size = np.sqrt(np.nansum(by_cloud**2, axis=1))
        text = f"{len(by_cloud)}/{len(components)} components, {np.median(size):.3f} mm median, "
        text += f"{np.percentile(size, 95):.3f} mm 95 %"
        reached = len(by_cloud) == len(components) and np.percentile(size, 95) <= CLOUD_TARGET_MM
        rows.append(ResultRow("displacement by cloud and ICP", on, text, "≤ 0.20 mm for 95 %", bool(reached)))
    return rows


def verdict_quality(component: ComponentError) -> str:
    """Whether the verdict is right, undecided, a false pass or a false fail, or the component was not measured."""
    verdict = decide(component.distance, component.uncertainty, TOLERANCE_MM)
    is_good = component.true_distance <= TOLERANCE_MM
    if verdict is Verdict.UNDECIDED:
        return "undecided"
    if verdict is Verdict.NOT_MEASURED:
        return "not measured"
    if (verdict is Verdict.PASS) == is_good:
        return "right"
    return "false pass" if verdict is Verdict.PASS else "false fail"


def repeatability_rows(photos: PhotoSet, out: Path) -> list[ResultRow]:
    """Spread of the datum frame over random choices of the photos; nothing without datums."""
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
        equations = measure_datums_in_photos(part.datums, load_views(some, part.model), {})
        middle, size_mm = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
        frames.append(align(equations, middle, size_mm).rough_from_datum)
    found = np.array(frames)
    spread_mm = float(np.ptp(found[:, :3, 3], axis=0).max())
    turn_deg = max(float(np.degrees(rotation_angle_rad(a, b))) for i, a in enumerate(found) for b in found[:i])
    text = f"origin within {spread_mm:.3f} mm, axes within {turn_deg:.4f}° of each other"
    on = f"{photos.name}, {CHOICES} choices of two thirds of the photos"
    return [ResultRow("datum repeatability", on, text, "≤ 0.03 mm, ≤ 0.01°", spread_mm <= 0.03 and turn_deg <= 0.01)]


def coverage_rows(components: Sequence[ComponentError], sets: int) -> list[ResultRow]:
    """Whether the stated uncertainties hold, over all sets."""
    measured = [component for component in components if component.uncertainty is not None]
    covered = float(np.mean([component.is_covered for component in measured]))
    mean = float(np.mean([component.uncertainty for component in measured if component.uncertainty is not None]))
    agree = [component.agree for component in measured if component.agree is not None]
    share = float(np.mean(agree)) if agree else 0.0
    on, outside = (
        f"{sets} sets",
        [f"{component.on} {component.name}" for component in measured if not component.is_covered],
    )
    text = f"{100 * covered:.1f} % of {len(measured)} intervals hold the truth, mean U {mean:.3f} mm"
    text += f"; not {', '.join(outside)}" if outside else ""
    is_valid = len(measured) >= 60 and 0.90 <= covered <= 0.99 and mean <= 0.12
    return [
        ResultRow("U holds", on, text, "90–99 % of ≥ 60, mean ≤ 0.12 mm", is_valid),
        ResultRow("sweep and edges agree", on, f"{100 * share:.0f} % of {len(agree)}", "≥ 90 %", share >= 0.90),
    ]


def plain(component: ComponentError) -> dict[str, Any]:
    """A component for JSON, with null where undetermined."""
    vectors = {
        name: None if value is None else [None if np.isnan(x) else round(float(x), 5) for x in value]
        for name, value in (("error_mm", component.error), ("cloud_error_mm", component.cloud))
    }
    return {
        "component": component.name,
        **vectors,
        "true_mm": component.true_distance,
        "distance_mm": component.distance,
        "U_mm": component.uncertainty,
        "covered": component.is_covered,
        "agree": component.agree,
        "verdict_quality": verdict_quality(component),
    }
