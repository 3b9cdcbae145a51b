"""Features of rendered plates with errors of place, size and tilt, measured in 24 photos, against truth."""

from __future__ import annotations

import tempfile
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit

from arview.geometry import Array
from arview.inspection import Inspection, Verdict
from arview.measurement.options import MeasureOptions
from arview.measurement.run import measure
from helpers import photo_scene
from helpers.feature_scene import CAMERA, FeatureScene, feature_scene
from helpers.photo_scene import photograph, ring
from helpers.placed_photos import placed
from rows import ResultRow, watched

PHOTOS, SETS = 24, 5
TARGETS = {"position": (0.025, 0.08), "size": (0.02, 0.06), "gap": (0.03, 0.09), "flush": (0.03, 0.09)}
"""Median and 95th percentile of the errors that must be reached, mm."""


def feature_rows(details: dict[str, Any]) -> list[ResultRow]:
    """Errors by kind, the share of values within U, and wrong verdicts."""
    errors: dict[str, list[float]] = defaultdict(list)
    held: list[bool] = []
    wrong = {"passed": 0, "failed": 0}
    for seed in watched(range(SETS), "features"):
        scene = feature_scene(seed)
        for one in measured(scene).characteristics:
            if one.value_mm is None or one.uncertainty_mm is None:
                errors[f"{one.kind}, not measured"].append(np.nan)
                continue
            true_mm = scene.true_mm[one.name]
            errors[one.kind].append(abs(one.value_mm - true_mm))
            held.append(errors[one.kind][-1] <= one.uncertainty_mm)
            low, high = one.range_mm
            is_within = (low is None or true_mm >= low) and (high is None or true_mm <= high)
            wrong["passed"] += one.verdict is Verdict.PASS and not is_within
            wrong["failed"] += one.verdict is Verdict.FAIL and is_within
    details["features"] = dict(errors) | {"held": float(np.mean(held)), **wrong}
    on = f"{SETS} rendered plates, {PHOTOS} photos each"
    rows = []
    for kind, values in errors.items():
        median, most = np.median(values), np.quantile(values, 0.95)
        wanted = TARGETS.get(kind)
        target = "-" if wanted is None else f"<= {1000 * wanted[0]:.0f}, <= {1000 * wanted[1]:.0f} um"
        found = f"median {1000 * median:.0f}, 95 % {1000 * most:.0f} um of {len(values)}"
        is_reached = wanted is None or (median <= wanted[0] and most <= wanted[1])
        rows.append(ResultRow(f"features: {kind}", on, found, target, bool(is_reached)))
    share = float(np.mean(held))
    rows.append(ResultRow("features: within U", on, f"{100 * share:.1f} %", ">= 93 %", share >= 0.93))
    text = f"{wrong['passed']} false passes, {wrong['failed']} false fails of {len(held)}"
    is_right = not wrong["passed"] and wrong["failed"] <= 0.005 * len(held)
    return [*rows, ResultRow("features: verdicts", on, text, "none, <= 0.5 %", is_right)]


def measured(scene: FeatureScene) -> Inspection:
    """The inspection of a plate by photos that are placed exactly, in a frame that is off."""
    with tempfile.TemporaryDirectory() as folder:
        poses = ring(PHOTOS, distance_mm=420.0)
        photo_scene.PAINT = _steel
        try:
            pictures = [photograph(scene.built, pose, CAMERA, seed=4, is_linear=True) for pose in poses]
        finally:
            photo_scene.PAINT = None
        reconstruction = placed(Path(folder), pictures, poses, CAMERA)
        return measure(reconstruction, scene.part, MeasureOptions(methods=("sweep", "edges")))


def _steel(points: Array) -> Array:
    """Grey values of points (N,3) of rolled steel: faint stains of 6, 2 and 0.8 mm."""
    return _stains(photo_scene._grid(3), np.ascontiguousarray(points))


@njit
def _stains(grid: Array, points: Array) -> Array:
    gray = np.full(len(points), 120.0)
    for i in range(len(points)):
        for size_mm in (6.0, 2.0, 0.8):
            x, y, z = points[i] / size_mm
            gray[i] += 9.0 * photo_scene._noise(grid, x + 0.3, y + 0.7, z + 0.1)
    return gray
