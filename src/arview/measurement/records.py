"""Records of an inspection from the results of a measurement: components, datums, provenance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from typing import cast

import numpy as np
from numpy.typing import NDArray

from arview.cad import Part
from arview.core.stage_cache import content_key
from arview.geometry import Array, exp_so3, rigid
from arview.inspection import (
    BudgetLine,
    ComponentDeviation,
    DatumReport,
    DatumSystem,
    Details,
    FailedDatum,
    Finding,
    MeasuredPresence,
    MethodAgreement,
    MethodResult,
    Provenance,
    Verdict,
)
from arview.measurement.datums.alignment import Alignment, DatumResult
from arview.measurement.folder import MetricReconstruction
from arview.measurement.measurand import Measurand
from arview.measurement.options import ComponentMeasurement, MeasureOptions, combined_of
from arview.measurement.photo.patches import free_directions
from arview.measurement.types import Move
from arview.measurement.uncertainty.budget import FORM_MM, PROBABILITY, K, MeasuredPlacement, place, relative_twists
from arview.measurement.uncertainty.combine import Agreement, CombinedMove, agreements, quantile_of_length
from arview.measurement.uncertainty.decision import decide, worst, zone_diameter_mm
from arview.measurement.uncertainty.pose_propagation import PosePropagation
from arview.version import __version__

_SOFTWARE = ("numpy", "scipy", "opencv-contrib-python-headless", "pycolmap", "numba")
"""Packages whose versions are recorded."""


def component_record(
    name: str,
    measured: ComponentMeasurement,
    measurand: Measurand,
    alignment: Alignment,
    poses: PosePropagation | None,
    part: Part,
    options: MeasureOptions,
) -> ComponentDeviation:
    """Position of a component's stated point in the datum frame, with its verdict."""
    settings = part.component_settings(name)
    tolerance_mm = settings.position_tolerance_mm or options.tolerance_mm
    component, center = part.model.component(name), measurand.point_in_model
    together, nothing = combined_of(measured), (False,) * 6
    failures = tuple(MethodResult(f.method, reason=f.reason) for f in measured.failures)
    if together is None or any(f.is_missing for f in measured.failures if f.method != "cloud"):
        is_missing = any(f.is_missing for f in measured.failures)
        reasons = tuple(dict.fromkeys(f.reason for f in measured.failures))
        details = Details(_three(center), measurand.kind, methods=failures, notes=reasons)
        verdict, finding = (Verdict.FAIL, Finding.MISSING) if is_missing else (Verdict.NOT_MEASURED, None)
        is_unseen = not is_missing and all(f.is_unseen for f in measured.failures if f.method != "cloud")
        presence = MeasuredPresence.NOT_SEEN if is_unseen else MeasuredPresence.UNKNOWN
        return ComponentDeviation(
            name,
            (None, None, None),
            None,
            nothing,
            None,
            tolerance_mm,
            verdict,
            finding=finding,
            details=details,
            presence=MeasuredPresence.MISSING if is_missing else presence,
        )
    by_poses = None if poses is None else poses.covariance_of(component, center)
    together = together.at(center)
    moves = [move.at(center) for move in measured.moves]
    axes = measurand.axes_for(together.undetermined)
    placed = place(together, alignment, by_poses, options.uncertainty, axes)
    pairs = agreements(moves)
    notes: list[str] = [note for move in moves for note in move.notes]
    notes += [_difference(pair) for pair in pairs if pair.ratio > 1.0 or pair.is_contradiction]
    # The cloud is for comparison where there are photos, and does not count.
    counted = {move.method for move in moves if move.method != "cloud"}
    is_open = any(pair.is_contradiction and {pair.first, pair.second} <= counted for pair in pairs)
    free = free_directions(component, part, center, together.radius_mm)
    verdict = _verdict(placed, tolerance_mm, settings.angle_tolerance_deg, free, options, notes)
    if is_open and verdict is Verdict.PASS:
        verdict = Verdict.UNDECIDED
    tilt_deg, twist_deg = tilt_and_twist(placed)
    displacement = [float(v) if seen else None for v, seen in zip(placed.twist[3:], placed.observable[3:], strict=True)]
    methods = tuple(_method_result(move, alignment) for move in moves) + failures
    distance = placed.distance
    return ComponentDeviation(
        name=name,
        displacement_mm=(displacement[0], displacement[1], displacement[2]),
        distance_mm=None if distance is None else distance.value,
        observable=cast("tuple[bool, bool, bool, bool, bool, bool]", tuple(bool(v) for v in placed.observable)),
        uncertainty_mm=None if distance is None else distance.uncertainty,
        tolerance_mm=tolerance_mm,
        verdict=verdict,
        tilt_deg=tilt_deg,
        twist_deg=twist_deg,
        presence=MeasuredPresence.PRESENT,
        details=replace(
            _details(placed, together, measurand, settings.angle_tolerance_deg),
            methods=methods,
            notes=tuple(notes),
            agreement=tuple(
                MethodAgreement(
                    (p.first, p.second), p.difference_mm, p.joint_mm, max(p.ratio, p.mixed_ratio) <= 1.0, p.mixed_ratio
                )
                for p in pairs
            ),
        ),
    )


def _verdict(
    placed: MeasuredPlacement,
    tolerance_mm: float | None,
    angle_tolerance_deg: float | None,
    free: Array,
    options: MeasureOptions,
    notes: list[str],
) -> Verdict:
    """Verdict on the position and, where it has a tolerance, the angle; what could not be judged cannot pass.

    Rotations that the component's symmetry leaves free (K,6) are not judged.
    """
    guard, distance, angle = options.decision.guard, placed.distance, placed.angle
    verdicts = []
    if distance is not None:
        value = distance.corrected if options.corrects_bias else distance.value
        verdicts.append(decide(value, distance.uncertainty, tolerance_mm, guard))
        if verdicts[0] is Verdict.PASS and distance.value > cast(float, tolerance_mm):
            verdicts = [Verdict.UNDECIDED]
    if angle_tolerance_deg is not None and angle is not None:
        limit = np.deg2rad(angle_tolerance_deg)
        verdicts.append(
            decide(angle.corrected if options.corrects_bias else angle.value, angle.uncertainty, limit, guard)
        )
        if verdicts[-1] is Verdict.FAIL:
            notes.append(f"turned by {np.rad2deg(angle.value):.2f}°, {angle_tolerance_deg:g}° allowed")
    verdict = worst(verdicts)
    unjudged = _unjudged(placed, free, angle_tolerance_deg)
    notes += unjudged
    if unjudged and verdict is Verdict.PASS:
        verdict = Verdict.UNDECIDED
    return verdict if verdicts else Verdict.UNDECIDED


def _unjudged(placed: MeasuredPlacement, free: Array, angle_tolerance_deg: float | None) -> list[str]:
    """Texts on the own axes along or about which a tolerance could not be judged."""
    texts, hidden = [], placed.axes[~placed.own_observable[3:]]
    if len(hidden):
        texts.append(f"the displacement along {' and '.join(_direction_text(axis) for axis in hidden)} is undetermined")
    turned = [
        axis
        for axis in placed.axes[~placed.own_observable[:3]]
        if not len(free) or np.linalg.norm(axis - np.linalg.pinv(free[:, :3]) @ free[:, :3] @ axis) > 0.05
    ]
    if turned and angle_tolerance_deg is not None:
        axes = " and ".join(_direction_text(axis) for axis in turned)
        texts.append(
            f"the rotation about {axes} is undetermined: the angle tolerance of {angle_tolerance_deg:g}° is not judged"
        )
    return texts


def _direction_text(axis: Array) -> str:
    """A direction as ``x``, or as a vector."""
    for name, value in zip("xyz", axis, strict=True):
        if abs(value) > 0.9986:
            return name
    return f"({', '.join(f'{value + 0.0:.2f}' for value in axis)})"


def _details(
    placed: MeasuredPlacement, together: CombinedMove, measurand: Measurand, angle_tolerance_deg: float | None
) -> Details:
    """Details of a component's record."""
    rotation = exp_so3(placed.twist[:3])
    center, distance, angle = together.center_in_model, placed.distance, placed.angle
    own = np.concatenate([np.rad2deg(placed.axes @ placed.twist[:3]), placed.axes @ placed.twist[3:]])
    stated = [float(value) if seen else None for value, seen in zip(own, placed.own_observable, strict=True)]
    across = placed.covariance[:3, :3]
    tilt = placed.axes[:2] @ across @ placed.axes[:2].T if placed.own_observable[:2].all() else None
    return Details(
        center_mm=_three(center),
        measurand=measurand.kind,
        measured_from_nominal=_matrix(rigid(rotation, center - rotation @ center + placed.twist[3:])),
        covariance=_matrix(placed.covariance),
        undetermined=_matrix(placed.undetermined),
        radius_mm=together.radius_mm,
        axes=_matrix(placed.axes),
        axis_from=measurand.axis_from,
        own_displacement_mm=tuple(stated[3:]),
        own_rotation_deg=tuple(stated[:3]),
        tilt_uncertainty_deg=None if tilt is None else float(np.rad2deg(quantile_of_length(tilt))),
        k=None if distance is None else distance.k,
        interval_mm=None if distance is None else (distance.low, distance.high),
        corrected_distance_mm=None if distance is None else distance.corrected,
        zone_diameter_mm=None if distance is None else zone_diameter_mm(distance.value),
        angle_deg=None if angle is None else float(np.rad2deg(angle.value)),
        angle_uncertainty_deg=None if angle is None else float(np.rad2deg(angle.uncertainty)),
        angle_tolerance_deg=angle_tolerance_deg,
        budget=() if distance is None else tuple(BudgetLine(*line) for line in placed.budget()),
    )


def _method_result(move: Move, alignment: Alignment) -> MethodResult:
    """Result of one method in the datum frame."""
    alone = CombinedMove(move.twist, {}, np.zeros((6, 6)), move.undetermined, move.radius_mm, move.center_in_model)
    twist = relative_twists(move.twist[None], alignment.move[None], alone, alignment)[0]
    std = np.sqrt(np.maximum(np.diag(move.covariance), 0.0))

    def shown(values: Array, seen: NDArray[np.bool_]) -> tuple[float | None, ...]:
        return tuple(float(v) if ok else None for v, ok in zip(values, seen, strict=True))

    seen = move.observable
    return MethodResult(
        move.method,
        shown(twist[3:], seen[3:]),
        shown(np.rad2deg(twist[:3]), seen[:3]),
        shown(std[3:], seen[3:]),
        move.used,
        move.residual_mm,
        move.support,
        notes=move.notes,
    )


def tilt_and_twist(placed: MeasuredPlacement) -> tuple[float | None, float | None]:
    """Angle in degrees between a component's own axis and its nominal direction, and rotation about it; or None."""
    axis, seen = placed.axes[2], placed.own_observable[:3]
    rotation = exp_so3(placed.twist[:3])
    tilt = float(np.arctan2(np.linalg.norm(np.cross(axis, rotation @ axis)), axis @ rotation @ axis))
    twist = float(placed.twist[:3] @ axis)
    return (float(np.rad2deg(tilt)) if seen[:2].all() else None), (float(np.rad2deg(twist)) if seen[2] else None)


def _difference(pair: Agreement) -> str:
    """Message about two methods that differ, or contradict each other."""
    if pair.is_contradiction:
        return (
            f"{pair.first} and {pair.second} contradict each other: {pair.difference_mm:.3f} mm and"
            f" {pair.turn_deg:.2f}° apart, {pair.mixed_ratio:.1f} times what their uncertainties allow"
        )
    return (
        f"{pair.first} and {pair.second} differ by {pair.difference_mm:.3f} mm, more than their uncertainties allow"
        f" ({pair.joint_mm:.3f} mm)"
    )


def datum_doubts(alignment: Alignment) -> list[str]:
    """Messages about datums that contradict those before them."""
    doubts = []
    for result in alignment.datums:
        excess = np.sqrt(max(0.0, result.rest_mm**2 - result.residual_mm**2))
        if result.feature != "fit" and excess > max(0.1, result.residual_mm):
            doubts.append(
                f"datum {result.label}: {excess:.2f} mm rms off the earlier datums; is the feature where the CAD says?"
            )
    return doubts


def datum_record(
    alignment: Alignment,
    part: Part,
    base: Sequence[str],
    reconstruction: MetricReconstruction,
    failed: tuple[FailedDatum, ...] = (),
) -> DatumSystem:
    """The datum system of an inspection."""
    components = {datum.label: datum.component for datum in part.datums}
    features = {datum.label: datum.feature for datum in part.datums if datum.feature != "fit"}
    reports = tuple(
        DatumReport(
            one.label,
            features.get(one.label, one.feature),
            components.get(one.label, base[0]),
            locked=one.locked,
            used=one.used,
            of=one.of,
            residual_mm=one.residual_mm,
            rest_mm=one.rest_mm,
            radius_mm=one.radius_mm,
            method=_datum_method(one, features) if reconstruction.sparse.photos else "cloud",
        )
        for one in alignment.datums
    )
    notes = alignment.notes
    if not part.datums:
        notes = (f"no datums in the part file: best fit of {', '.join(base)}", *notes)
    scale = reconstruction.scale
    used = [evidence.detail for evidence in scale.evidence if evidence.is_used]
    return DatumSystem(
        reports,
        _matrix(alignment.rough_from_datum),
        _matrix(alignment.covariance),
        origin_mm=_three(alignment.origin_in_model),
        mm_per_unit=scale.scale,
        scale_std=scale.scale_std,
        scale_from="; ".join(used),
        notes=notes,
        not_measured=failed,
        frame="partial" if failed else "datums" if part.datums else "best_fit",
    )


def _datum_method(one: DatumResult, features: Mapping[str, str]) -> str:
    """The method by which a datum was measured in photos."""
    if one.feature == "fit":
        return "edges" if one.label in features else "sweep and edges"
    return "edges" if one.feature in ("hole", "pin", "slot", "edge") else "sweep"


def failed_datum_text(one: FailedDatum) -> str:
    """Warning about a datum that could not be measured: why, what could be measured instead, and what it means."""
    instead = f" Could be measured: {'; '.join(one.instead)}." if one.instead else ""
    taken = f" The base's best fit takes its place for {one.directions}." if one.directions else ""
    return f"datum {one.label} ({one.feature}): {one.reason}.{instead}{taken} The frame is not that of the part file."


def in_partial_frame(record: ComponentDeviation, failed: Sequence[FailedDatum]) -> ComponentDeviation:
    """The record of a component in a frame that lacks datums: what would pass is undecided."""
    if not failed or record.verdict is Verdict.NOT_MEASURED or record.details is None:
        return record
    labels = ", ".join(one.label for one in failed)
    note = f"stated in a frame without datum {labels}"
    verdict = Verdict.UNDECIDED if record.verdict is Verdict.PASS else record.verdict
    return replace(record, verdict=verdict, details=replace(record.details, notes=(*record.details.notes, note)))


def provenance_of(reconstruction: MetricReconstruction, options: MeasureOptions, cpu_s: float) -> Provenance:
    """Tool, versions, options and inputs of a measurement."""
    photos = reconstruction.sparse.photos
    used = [m for m in options.methods if m != "cloud" or reconstruction.cloud is not None]
    asked = {
        "methods": ",".join(options.methods),
        "guard": f"{options.decision.guard:g}",
        "k": f"{K:g}",
        "probability": f"{PROBABILITY:g}",
        "monte_carlo": str(options.uncertainty.draws if options.uncertainty.monte_carlo else 0),
        "seed": str(options.uncertainty.seed),
        "form_mm": f"{FORM_MM:g}",
        "corrects_bias": str(options.corrects_bias).lower(),
    }
    return Provenance(
        tool="arview measure",
        version=__version__,
        method=f"{', '.join(used)} in {len(photos)} photos" if photos else "cloud alone",
        photos_hash=content_key(photo.path for photo in photos) if photos else "",
        photos=len(photos),
        software=tuple((name, _version(name)) for name in _SOFTWARE),
        options=tuple(asked.items()),
        cpu_s=round(cpu_s, 2),
    )


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "unknown"


def _three(point: Array) -> tuple[float, float, float]:
    return float(point[0]), float(point[1]), float(point[2])


def _matrix(values: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(value) for value in row) for row in values)
