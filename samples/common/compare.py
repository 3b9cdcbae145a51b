"""Comparison of the result of `arview inspect` with the truth of a sample."""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

NEAR_MM = 15.0
"""How far outside its true box the centre of a reported foreign object may lie."""
BORDER_MM, BORDER_DEG = 0.02, 0.05
"""What is nearer than this to its limit may be judged either way."""


@dataclass(frozen=True)
class Row:
    """One component: what was reported against what is true.

    Attributes:
        name: name of the component.
        verdict: as reported.
        error_mm: (3,) measured minus true displacement at the stated point, NaN where undetermined; None if not
            measured.
        std_mm: (3,) standard uncertainty along the axes of the model; NaN where undetermined.
        uncertainty_mm: U of the distance.
        distance_error_mm: measured minus true length of the determined part of the displacement.
        fault: what is wrong with the verdict; empty if nothing is.
    """

    name: str
    verdict: str
    error_mm: np.ndarray | None = None
    std_mm: np.ndarray | None = None
    uncertainty_mm: float | None = None
    distance_error_mm: float | None = None
    fault: str = ""

    @property
    def is_covered(self) -> bool | None:
        """Whether U holds the error of the distance; None if there is no U."""
        if self.uncertainty_mm is None or self.distance_error_mm is None:
            return None
        return abs(self.distance_error_mm) <= self.uncertainty_mm


def compare(inspection: dict, truth: dict) -> list[Row]:
    """The judged components of an inspection, as `arview inspect` writes it, beside the truth."""
    return [_row(entry, truth["truth"][entry["name"]]) for entry in inspection["components"]]


def _row(entry: dict, true: dict) -> Row:
    name, verdict, details = entry["name"], entry["verdict"], entry.get("details") or {}
    if not true.get("present", True):
        named = entry.get("finding") == "missing"
        return Row(name, verdict, fault="" if named else f"is missing, reported as {verdict}")
    if entry.get("finding") == "missing":
        return Row(name, verdict, fault="is there, reported as missing")
    if entry["distance_mm"] is None:
        return Row(name, verdict)
    pose, point = np.array(true["measured_from_nominal"]), np.array(true["centroid_mm"])
    # The point whose displacement is stated.
    if details.get("center_mm") is not None:
        point = np.array(details["center_mm"], dtype=float)
    expected = pose[:3, :3] @ point + pose[:3, 3] - point
    measured = np.array([np.nan if value is None else value for value in entry["displacement_mm"]], dtype=float)
    std = np.full(3, np.nan)
    if details.get("covariance") is not None:
        std = np.sqrt(np.diag(np.array(details["covariance"], dtype=float))[3:])
        std[np.isnan(measured)] = np.nan
    seen = np.linalg.norm(expected[~np.isnan(measured)])
    return Row(
        name,
        verdict,
        measured - expected,
        std,
        entry["uncertainty_mm"],
        entry["distance_mm"] - float(seen),
        _fault(entry, details, float(np.linalg.norm(expected)), float(np.linalg.norm(true["tilt_deg"]))),
    )


def _fault(entry: dict, details: dict, distance_mm: float, angle_deg: float) -> str:
    """What is wrong with a verdict, by the true distance and angle; empty if nothing is."""
    limit, angle_limit = entry["tolerance_mm"], details.get("angle_tolerance_deg")
    if limit is None:
        return ""
    # The twist of a body of revolution cannot be seen, so that only a tilt is held against a pass.
    far, near = distance_mm > limit + BORDER_MM, distance_mm < limit - BORDER_MM
    turned = angle_limit is not None and angle_deg > angle_limit + BORDER_DEG
    straight = angle_limit is None or angle_deg < angle_limit - BORDER_DEG
    if entry["verdict"] == "pass" and far:
        return f"passes, {distance_mm:.3f} mm off"
    if entry["verdict"] == "pass" and turned and entry["observable"][:3] != [False] * 3:
        return f"passes, turned by {angle_deg:.2f}°"
    if entry["verdict"] == "fail" and near and straight:
        return f"fails, {distance_mm:.3f} mm off"
    return ""


def foreign_faults(inspection: dict, truth: dict) -> list[str]:
    """Foreign objects of the truth that are not reported, and reported ones that are not there."""
    boxes = {
        name: (np.array(box["low_mm"]) - NEAR_MM, np.array(box["high_mm"]) + NEAR_MM)
        for name, box in truth.get("foreign", {}).items()
    }
    found, faults = set(), []
    for one in inspection.get("foreign_objects", []):
        center = np.array(one["center_mm"])
        names = [name for name, (low, high) in boxes.items() if np.all((center > low) & (center < high))]
        found.update(names)
        if not names:
            faults.append(f"no foreign object is at {np.round(center).astype(int).tolist()} mm: {one['text']}")
    return faults + [f"{name} is not reported" for name in boxes if name not in found]


def main(folder: Path, text: str) -> None:
    """The command line: prints a line for each component and the sums; exits with 1 if a verdict is wrong."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("inspection", type=Path, help="inspection.json, or the folder that `arview inspect -o` wrote")
    parser.add_argument("--truth", type=Path, default=folder / "truth.json", help="default: of this sample")
    arguments = parser.parse_args()
    path = arguments.inspection
    path = path / "inspection.json" if path.is_dir() else path
    for file in (path, arguments.truth):
        if not file.is_file():
            parser.error(f"{file}: no such file")
    inspection, truth = json.loads(path.read_text()), json.loads(arguments.truth.read_text())
    if inspection["part"] != truth["part"]:
        parser.error(f"{path} is of {inspection['part']}, {arguments.truth} of {truth['part']}")
    rows, faults = compare(inspection, truth), foreign_faults(inspection, truth)
    print(table(rows))
    print("\n".join([f"foreign: {fault}" for fault in faults] or ["foreign: as it is"]))
    raise SystemExit(1 if faults or any(row.fault for row in rows) else 0)


def table(rows: list[Row]) -> str:
    """A line for each component, and their sums."""
    lines = [f"{'component':<14}{'verdict':<14}{'error x y z, mm':<27}{'U, mm':>7}{'covered':>9}  fault"]
    for row in rows:
        error = "-" if row.error_mm is None else " ".join(f"{value:+8.3f}" for value in row.error_mm)
        uncertainty = "-" if row.uncertainty_mm is None else f"{row.uncertainty_mm:.3f}"
        covered = {None: "-", True: "yes", False: "no"}[row.is_covered]
        lines.append(f"{row.name:<14}{row.verdict:<14}{error:<27}{uncertainty:>7}{covered:>9}  {row.fault}")
    measured = [row for row in rows if row.error_mm is not None]
    lines.append(f"{len(measured)} of {len(rows)} measured, {sum(bool(row.fault) for row in rows)} wrong verdicts")
    if measured:
        size = [float(np.sqrt(np.nansum(row.error_mm**2))) for row in measured]
        judged = [row.is_covered for row in measured if row.is_covered is not None]
        lines.append(
            f"error: median {np.median(size):.3f} mm, 95 % {np.percentile(size, 95):.3f} mm; U holds {sum(judged)} of"
            f" {len(judged)}"
        )
    return "\n".join(lines)
