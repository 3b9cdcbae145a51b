"""Repeatability on photos without truth: two halves of the photos are measured apart and compared.

The difference of two independent measurements of a component, divided by its expected bound (E_n, ISO 13528), shows
whether U is right for these photos. Errors that both halves share are not seen: form, the CAD, and a scale from the
same board. Where the halves differ by more than their U allow, the excess enters U.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from arview.cad import Part
from arview.core.progress import Progress
from arview.errors import CannotMeasureError, InputError
from arview.geometry import Array
from arview.inspection import (
    BudgetLine,
    ComponentDeviation,
    Finding,
    HalvesDifference,
    Inspection,
    Repeatability,
    Verdict,
)
from arview.measurement.folder import MetricReconstruction
from arview.measurement.options import MeasureOptions
from arview.measurement.run import measure
from arview.measurement.uncertainty.combine import quantile_of_length
from arview.measurement.uncertainty.decision import decide
from arview.reconstruction import SparseModel

BUDGET_LINE = "halves of the photos differ"
"""Name of the line of the budget for what two halves differ by beyond their U."""


def measure_halves(
    reconstruction: MetricReconstruction,
    halves: Sequence[SparseModel],
    part: Part,
    options: MeasureOptions | None = None,
    *,
    progress: Progress | None = None,
) -> Repeatability:
    """Measure two halves of the photos apart, each in its own datum frame, and compare them.

    Args:
        reconstruction: of all photos; gives the rough frame and the scale from other sources than the CAD.
        halves: the two halves in the same rough frame, mm (`arview.reconstruction.halves`).
        part: CAD, roles, tolerances, datums.
        options: of the measurement; the cloud, which is of all photos, is left out.
        progress: called with (what, done, total).
    """
    options = options or MeasureOptions()
    began = time.process_time()
    methods = tuple(method for method in options.methods if method != "cloud")
    if not methods:
        return Repeatability(reason="the cloud, which is of all photos, cannot be halved")
    measured = []
    for number, half in enumerate(halves):
        one = replace(reconstruction, sparse=half, cloud=None)
        try:
            measured.append(measure(one, part, replace(options, methods=methods, maps_folder=None)))
        except (InputError, CannotMeasureError) as error:
            return Repeatability(reason=f"half of the photos cannot be measured alone: {error}")
        if progress is not None:
            progress("halves", number + 1, len(halves))
    rows = tuple(compare(a, b) for a, b in zip(measured[0].components, measured[1].components, strict=True))
    known = [row.difference_mm for row in rows if row.difference_mm is not None]
    return Repeatability(
        tuple(len(half.photos) for half in halves),
        rows,
        float(np.sqrt(np.mean(np.square(known)))) if known else None,
        round(time.process_time() - began, 2),
    )


def compare(first: ComponentDeviation, second: ComponentDeviation) -> HalvesDifference:
    """Difference of two independent measurements of one component, beside what their covariances allow."""
    uncertainties = (first.uncertainty_mm, second.uncertainty_mm)
    ours, theirs = _displacement(first), _displacement(second)
    if ours is None or theirs is None:
        missing = sum(one.finding is Finding.MISSING for one in (first, second))
        reason = ("half of the photos cannot measure it alone", "missing in one half only", "missing in both halves")
        return HalvesDifference(first.name, uncertainties_mm=uncertainties, reason=reason[missing])
    (one, own_axes, one_seen), (other, other_axes, other_seen) = ours, theirs
    if not np.allclose(own_axes, other_axes, atol=1e-6):
        own_axes = np.eye(3)
        one_seen = np.array([value is not None for value in first.displacement_mm])
        other_seen = np.array([value is not None for value in second.displacement_mm])
    axes = own_axes[np.logical_and(one_seen, other_seen)]
    if not len(axes):
        return HalvesDifference(
            first.name, uncertainties_mm=uncertainties, reason="the halves determine no common axis"
        )
    joint = np.sum([np.array(c.details.covariance)[3:, 3:] for c in (first, second) if c.details is not None], axis=0)
    difference = float(np.linalg.norm(axes @ (one - other)))
    allowed = quantile_of_length(axes @ joint @ axes.T)
    ratio = difference / allowed if allowed > 0 else 0.0
    return HalvesDifference(first.name, difference, allowed, ratio, uncertainties)


def _displacement(one: ComponentDeviation) -> tuple[Array, Array, Array] | None:
    """Displacement (3,) of the stated point, the own axes (3,3), and which of them (3,) are determined; or None."""
    details = one.details
    if one.distance_mm is None or details is None or details.measured_from_nominal is None or details.axes is None:
        return None
    center, pose = np.array(details.center_mm), np.array(details.measured_from_nominal)
    moved = pose[:3, :3] @ center + pose[:3, 3] - center
    seen = np.array([value is not None for value in details.own_displacement_mm or (None,) * 3])
    return moved, np.array(details.axes), seen


def with_repeatability(
    inspection: Inspection, found: Repeatability, options: MeasureOptions | None = None
) -> Inspection:
    """The inspection with the comparison of the halves: contradictions are named, and enter U and the verdicts."""
    options = options or MeasureOptions()
    beyond = {one.name: one for one in found.contradictions}
    components = tuple(
        one if one.name not in beyond else _widened(one, beyond[one.name], options) for one in inspection.components
    )
    warnings = inspection.warnings
    if beyond:
        named = ", ".join(
            f"{one.name} ({one.difference_mm:.3f} mm, {one.joint_mm:.3f} mm expected)" for one in found.contradictions
        )
        warnings = (*warnings, f"two halves of the photos contradict each other at {named}: U is larger there")
    return replace(inspection, components=components, warnings=warnings, repeatability=found)


def _widened(one: ComponentDeviation, halves: HalvesDifference, options: MeasureOptions) -> ComponentDeviation:
    """A component whose U also explains the difference of the halves.

    The whole set measures about the mean of the halves, so its error is about half of their difference. Only what the
    halves' covariances do not explain is added (Birge 1932).
    """
    details = one.details
    if details is None or one.uncertainty_mm is None or one.distance_mm is None or details.covariance is None:
        return one
    assert halves.difference_mm is not None and halves.e_n is not None
    std = 0.5 * halves.difference_mm * float(np.sqrt(1.0 - 1.0 / halves.e_n**2))
    along = float(np.sqrt(sum(line.std_mm**2 for line in details.budget)))
    if along <= 0:
        return one
    uncertainty = one.uncertainty_mm * float(np.hypot(along, std)) / along
    covariance = np.array(details.covariance)
    covariance[3:, 3:] += std**2 * np.eye(3)
    budget = sorted([*details.budget, BudgetLine(BUDGET_LINE, std)], key=lambda line: -line.std_mm)
    note = (
        f"two halves of the photos differ by {halves.difference_mm:.3f} mm, more than their U allow"
        f" ({halves.joint_mm:.3f} mm)"
    )
    details = replace(
        details,
        covariance=tuple(tuple(float(v) for v in row) for row in covariance),
        budget=tuple(budget),
        interval_mm=(max(0.0, one.distance_mm - uncertainty), one.distance_mm + uncertainty),
        notes=(*details.notes, note),
    )
    value = details.corrected_distance_mm if options.corrects_bias else one.distance_mm
    by_position = decide(value, uncertainty, one.tolerance_mm, options.decision.guard)
    verdict = one.verdict
    is_open = by_position is Verdict.UNDECIDED
    if is_open and (verdict is Verdict.PASS or (verdict is Verdict.FAIL and details.angle_tolerance_deg is None)):
        verdict = Verdict.UNDECIDED
    return replace(one, uncertainty_mm=uncertainty, verdict=verdict, details=details)
