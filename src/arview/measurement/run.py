"""From a reconstruction and a part file to an inspection: measure, align to the datums, combine, decide."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from typing import cast

import numpy as np
from numpy.typing import NDArray

from arview import __version__
from arview.cad.model import Model
from arview.cad.part import ComponentSettings, Part
from arview.errors import InputError
from arview.geometry import Array, exp_so3, rigid
from arview.inspection import (
    BudgetLine,
    ComponentDeviation,
    DatumReport,
    DatumSystem,
    Details,
    Finding,
    Inspection,
    MethodAgreement,
    MethodResult,
    Provenance,
    Verdict,
)
from arview.measurement.alignment import Alignment, AlignmentOptions, Equations, align, check_covered, move_equations
from arview.measurement.combine import Agreement, Combined, agreements, combine
from arview.measurement.datums import DatumOptions, base_plane, measure_datums
from arview.measurement.decision import DecisionOptions, decide, worst, zone_diameter_mm
from arview.measurement.folder import MetricReconstruction
from arview.measurement.photo import PhotoOptions, PhotoViews, load_views, measure_components_in_photos
from arview.measurement.types import Method, Move, NotMeasured
from arview.measurement.uncertainty import (
    Placement,
    PosePropagation,
    UncertaintyOptions,
    place,
    relative_twists,
)
from arview.reconstruction.scale.cad import base_names
from arview.reconstruction.stages import content_key

Progress = Callable[[str, int, int], None]
METHODS: tuple[Method, ...] = ("sweep", "edges", "cloud")
_SOFTWARE = ("numpy", "scipy", "opencv-contrib-python-headless", "pycolmap", "numba")


@dataclass(frozen=True)
class MeasureOptions:
    """Options of a measurement: those of its parts, and what is asked for."""

    methods: tuple[Method, ...] = METHODS  # the cloud only where there is one
    tolerance_mm: float | None = None  # of components for which the part file says nothing; None: not judged
    corrects_bias: bool = False  # decide on the most likely true distance instead of the measured one
    uses_inconsistent: bool = False  # go on though the reconstruction does not have the CAD's shape
    photo: PhotoOptions = field(default_factory=PhotoOptions)
    datums: DatumOptions = field(default_factory=DatumOptions)
    alignment: AlignmentOptions = field(default_factory=AlignmentOptions)
    uncertainty: UncertaintyOptions = field(default_factory=UncertaintyOptions)
    decision: DecisionOptions = field(default_factory=DecisionOptions)

    def __post_init__(self) -> None:
        unknown = [method for method in self.methods if method not in METHODS]
        if unknown or not self.methods:
            raise InputError(f"methods {', '.join(self.methods) or 'none'}: expected some of {', '.join(METHODS)}")
        if self.tolerance_mm is not None and not self.tolerance_mm > 0:
            raise InputError(f"tolerance {self.tolerance_mm} mm: expected more than 0")


@dataclass(frozen=True)
class Measured:
    """A component's results by all methods, before the datum frame."""

    moves: tuple[Move, ...]
    failures: tuple[NotMeasured, ...]


def measure(
    reconstruction: MetricReconstruction, part: Part, options: MeasureOptions | None = None,
    progress: Progress | None = None,
) -> Inspection:  # fmt: skip
    """Where every inspected component stands in the datum frame, with its uncertainty and verdict.

    Args:
        reconstruction: see `read_folder`.
        part: CAD, roles, tolerances, datums.
        options: see there.
        progress: called with (what, done, total).

    Raises:
        InputError: the reconstruction contradicts the CAD; a datum is not covered; nothing to inspect.
    """
    options, tell = options or MeasureOptions(), progress or (lambda what, done, total: None)
    began = time.process_time()
    warnings = list(reconstruction.scale.warnings)
    consistency = reconstruction.scale.consistency
    if not consistency.is_consistent:
        if not options.uses_inconsistent:
            raise InputError(f"{consistency.reason}; take other photos (--anyway measures all the same)")
        warnings.append(consistency.reason)
    base = base_names(part)
    names = [name for name in part.inspected if name not in base]
    if not names:
        raise InputError(f"part {part.name!r}: no component has the role 'inspect'")
    # Without the covariance of the poses: it is carried to the components relative to the datums below.
    views = load_views(replace(reconstruction.sparse, pose_covariance=None), part.model)
    results = measure_all(reconstruction, views, part, [*base, *names], options, tell)
    tell("datums", 0, 1)
    alignment = align_to_datums(reconstruction, views, part, base, results, options)
    warnings += _doubts(alignment)
    poses = None
    if reconstruction.sparse.pose_covariance is None:
        warnings.append("the covariance of the camera poses is unknown: it is not in U")
    else:
        poses = PosePropagation(reconstruction.sparse, part.model, alignment, base)
    deviations = []
    for done, name in enumerate(names, 1):
        deviations.append(_deviation(name, results[name], alignment, poses, part, options))
        tell("uncertainty", done, len(names))
    return Inspection(
        part=part.name,
        serial=part.serial or "",
        model_hash=part.model.source_hash,
        created=datetime.now(UTC),
        components=tuple(deviations),
        provenance=_provenance(reconstruction, options, time.process_time() - began),
        datum_system=_datum_system(alignment, part, base, reconstruction),
        warnings=tuple(warnings),
    )


def measure_all(
    reconstruction: MetricReconstruction, views: PhotoViews, part: Part, names: Sequence[str],
    options: MeasureOptions, tell: Progress,
) -> dict[str, Measured]:  # fmt: skip
    """Every component by every method asked for, in the rough frame."""
    found: dict[str, list[Move | NotMeasured]] = {name: [] for name in names}
    if {"sweep", "edges"} & set(options.methods):

        def step(name: str, share: float) -> None:
            tell("components", round(share * len(names)), len(names))

        both = measure_components_in_photos(views, part, part.model, options.photo, step, names)
        for name, by_method in both.items():
            found[name] += [by_method[method] for method in options.methods if method in by_method]
    if "cloud" in options.methods and reconstruction.cloud is not None:
        from arview.measurement.cloud_deviation import measure_components_in_cloud

        tell("cloud", 0, 1)
        try:
            measured = measure_components_in_cloud(reconstruction.cloud, part.model, part, reconstruction.sparse.photos)
        except InputError as error:
            measured = [NotMeasured(name, "cloud", str(error)) for name in names]
        for one in measured:
            if one.component in found:
                found[one.component].append(one)
    return {
        name: Measured(
            tuple(one for one in all_of if isinstance(one, Move)),
            tuple(one for one in all_of if isinstance(one, NotMeasured)),
        )
        for name, all_of in found.items()
    }


def combined_of(measured: Measured) -> Combined | None:
    """The move that counts: sweep and edges together; the cloud's alone where neither could."""
    direct = [move for move in measured.moves if move.method != "cloud"]
    moves = direct or list(measured.moves)
    return combine(moves) if moves else None


def align_to_datums(
    reconstruction: MetricReconstruction, views: PhotoViews, part: Part, base: Sequence[str],
    results: Mapping[str, Measured], options: MeasureOptions,
) -> Alignment:  # fmt: skip
    """The datum frame of the part file; where it leaves something free, or without datums, the base's best fit."""
    fitted = {}
    for name in [*base, *(datum.component for datum in part.datums)]:
        together = combined_of(results[name]) if name in results else None
        if together is not None:
            fitted[name] = _as_move(name, together)
    equations = measure_datums(part.datums, views, fitted, options.datums)
    if not part.datums:
        equations = _plane_of_base(views, part.model, base, options)
    rest = next((_rest_of_base(results[name], fitted[name], equations) for name in base if name in fitted), None)
    if rest is None and not equations:
        reasons = "; ".join(f.reason for name in base for f in results[name].failures)
        raise InputError(f"{', '.join(base)}: could not be measured, there is no frame: {reasons}")
    holes = [datum for datum in part.datums if datum.feature in ("hole", "pin")]
    if part.datums:
        origin = np.array((holes or part.datums)[0].point_in_model)
    else:
        origin = fitted[next(name for name in base if name in fitted)].center_in_model
    size_mm = 0.5 * float(np.linalg.norm(np.ptp(_bounds(part.model, base), axis=0)))
    kinds = {evidence.kind for evidence in reconstruction.scale.evidence if evidence.is_used}
    scale_std = reconstruction.scale.scale_std or 0.0
    return align(equations, origin, size_mm, rest, scale_std, kinds <= {"cad"}, options.alignment)


def _plane_of_base(views: PhotoViews, model: Model, base: Sequence[str], options: MeasureOptions) -> list[Equations]:
    """The base's large flat face, which is known better than the height of its edges; nothing where there is none."""
    component = model.component(base[0])
    plane = base_plane(component, views.centres.mean(axis=0) - component.bounds_in_model.mean(axis=0))
    if plane is None:
        return []
    try:
        equations = measure_datums((plane,), views, {}, options.datums)
        check_covered(equations[0], options.alignment)
    except InputError:
        return []
    return equations


def _rest_of_base(measured: Measured, fitted: Move, datums: Sequence[Equations]) -> Equations:
    """The base's best fit; within a plane that is already known by its edges, as its narrow sides tell little."""
    edges = [move for move in measured.moves if move.method == "edges"]
    is_flat = any(datum.feature == "plane" for datum in datums)
    return move_equations(fitted.component, edges[0] if edges and is_flat else fitted)[0]


def _as_move(name: str, together: Combined) -> Move:
    covariance = np.sum([*together.covariances.values(), together.disagreement], axis=0)
    return Move(
        name, "sweep", together.center_in_model, together.twist, covariance, together.undetermined,
        together.radius_mm, 0, 0.0, 1.0,
    )  # fmt: skip


def _bounds(model: Model, names: Sequence[str]) -> Array:
    corners = np.concatenate([model.component(name).bounds_in_model for name in names])
    return np.stack([corners.min(axis=0), corners.max(axis=0)])


# --- one component ---------------------------------------------------------------------------------------


def _deviation(
    name: str, measured: Measured, alignment: Alignment, poses: PosePropagation | None, part: Part,
    options: MeasureOptions,
) -> ComponentDeviation:  # fmt: skip
    """The record of one component."""
    settings = part.component_settings(name)
    tolerance_mm = settings.position_tolerance_mm or options.tolerance_mm
    component = part.model.component(name)
    center = component.bounds_in_model.mean(axis=0)
    together = combined_of(measured)
    nothing = (False,) * 6
    failures = tuple(MethodResult(f.method, reason=f.reason) for f in measured.failures)
    if together is None or any(f.is_missing for f in measured.failures if f.method != "cloud"):
        is_missing = any(f.is_missing for f in measured.failures)
        reasons = tuple(dict.fromkeys(f.reason for f in measured.failures))
        details = Details(_three(center), methods=failures, notes=reasons)
        verdict, finding = (Verdict.FAIL, Finding.MISSING) if is_missing else (Verdict.NOT_MEASURED, None)
        return ComponentDeviation(
            name, (None, None, None), None, nothing, None, tolerance_mm, verdict, finding=finding, details=details
        )
    by_poses = None if poses is None else poses.covariance_of(component, center)
    placed = place(together, alignment, by_poses, options.uncertainty)
    pairs = agreements(measured.moves)
    notes: list[str] = [note for move in measured.moves for note in move.notes]
    notes += [_contradiction(pair) for pair in pairs if pair.ratio > 1.0]
    verdict = _verdict(placed, tolerance_mm, settings, options, notes)
    axis = _axis(settings, placed, part)
    tilt_deg, twist_deg = tilt_and_twist(placed, axis)
    displacement = [float(v) if seen else None for v, seen in zip(placed.twist[3:], placed.observable[3:], strict=True)]
    methods = tuple(_method_result(move, alignment) for move in measured.moves) + failures
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
        details=replace(
            _details(placed, together, settings), methods=methods, notes=tuple(notes),
            agreement=tuple(
                MethodAgreement((p.first, p.second), p.difference_mm, p.joint_mm, p.ratio <= 1.0) for p in pairs
            ),
        ),
    )  # fmt: skip


def _verdict(
    placed: Placement, tolerance_mm: float | None, settings: ComponentSettings, options: MeasureOptions,
    notes: list[str],
) -> Verdict:  # fmt: skip
    """Position and, where it has a tolerance, angle; what could not be determined cannot pass."""
    guard, distance, angle = options.decision.guard, placed.distance, placed.angle
    verdicts = []
    if distance is not None:
        value = distance.corrected if options.corrects_bias else distance.value
        verdicts.append(decide(value, distance.uncertainty, tolerance_mm, guard))
        if verdicts[0] is Verdict.PASS and distance.value > cast(float, tolerance_mm):
            verdicts = [Verdict.UNDECIDED]
    if settings.angle_tolerance_deg is not None and angle is not None:
        limit = np.deg2rad(settings.angle_tolerance_deg)
        verdicts.append(
            decide(angle.corrected if options.corrects_bias else angle.value, angle.uncertainty, limit, guard)
        )
        if verdicts[-1] is Verdict.FAIL:
            notes.append(f"turned by {np.rad2deg(angle.value):.2f}°, {settings.angle_tolerance_deg:g}° allowed")
    verdict = worst(verdicts)
    hidden = [axis for axis, seen in zip("xyz", placed.observable[3:], strict=True) if not seen]
    if hidden:
        notes.append(f"the displacement along {' '.join(hidden)} is undetermined")
        verdict = Verdict.UNDECIDED if verdict is Verdict.PASS else verdict
    return verdict if verdicts else Verdict.UNDECIDED


def _details(placed: Placement, together: Combined, settings: ComponentSettings) -> Details:
    rotation = exp_so3(placed.twist[:3])
    center, distance, angle = together.center_in_model, placed.distance, placed.angle
    return Details(
        center_mm=_three(center),
        measured_from_nominal=_matrix(rigid(rotation, center - rotation @ center + placed.twist[3:])),
        covariance=_matrix(placed.covariance),
        undetermined=_matrix(placed.undetermined),
        radius_mm=together.radius_mm,
        k=None if distance is None else distance.k,
        interval_mm=None if distance is None else (distance.low, distance.high),
        corrected_distance_mm=None if distance is None else distance.corrected,
        zone_diameter_mm=None if distance is None else zone_diameter_mm(distance.value),
        angle_deg=None if angle is None else float(np.rad2deg(angle.value)),
        angle_uncertainty_deg=None if angle is None else float(np.rad2deg(angle.uncertainty)),
        angle_tolerance_deg=settings.angle_tolerance_deg,
        budget=() if distance is None else tuple(BudgetLine(*line) for line in placed.budget()),
    )


def _method_result(move: Move, alignment: Alignment) -> MethodResult:
    """A method's own result in the datum frame."""
    alone = Combined(move.twist, {}, np.zeros((6, 6)), move.undetermined, move.radius_mm, move.center_in_model)
    twist = relative_twists(move.twist[None], alignment.move[None], alone, alignment)[0]
    std = np.sqrt(np.maximum(np.diag(move.covariance), 0.0))

    def shown(values: Array, seen: NDArray[np.bool_]) -> tuple[float | None, ...]:
        return tuple(float(v) if ok else None for v, ok in zip(values, seen, strict=True))

    seen = move.observable
    return MethodResult(
        move.method, shown(twist[3:], seen[3:]), shown(np.rad2deg(twist[:3]), seen[:3]), shown(std[3:], seen[3:]),
        move.used, move.residual_mm, move.support, notes=move.notes,
    )  # fmt: skip


def _axis(settings: ComponentSettings, placed: Placement, part: Part) -> Array:
    """Axis that tilt is of and twist about: of symmetry, else the normal of the first datum plane, else +Z."""
    if settings.symmetry is not None:
        return np.array(settings.symmetry.axis_in_model)
    turns = [row[:3] / np.linalg.norm(row[:3]) for row in placed.undetermined if np.linalg.norm(row[:3]) > 0.95]
    if len(turns) == 1:
        axis = turns[0]
        return np.asarray(axis if axis[np.argmax(np.abs(axis))] > 0 else -axis)
    planes = [np.array(datum.direction_in_model) for datum in part.datums if datum.feature == "plane"]
    return planes[0] if planes else np.array([0.0, 0.0, 1.0])


def tilt_and_twist(placed: Placement, axis: Array) -> tuple[float | None, float | None]:
    """Angle in degrees between a component's axis (3,) and where it should point, and turn about it; None if open."""
    if not placed.observable[:3].any():
        return None, None
    turns = placed.undetermined[:, :3]
    across = turns - (turns @ axis)[:, None] * axis
    rotation = exp_so3(placed.twist[:3])
    tilt = float(np.arctan2(np.linalg.norm(np.cross(axis, rotation @ axis)), axis @ rotation @ axis))
    twist = float(placed.twist[:3] @ axis)
    is_tilt = bool((np.linalg.norm(across, axis=1) < 0.05).all())
    is_twist = bool((np.abs(turns @ axis) < 0.05).all())
    return (float(np.rad2deg(tilt)) if is_tilt else None), (float(np.rad2deg(twist)) if is_twist else None)


def _contradiction(pair: Agreement) -> str:
    return (
        f"{pair.first} and {pair.second} differ by {pair.difference_mm:.3f} mm, more than the {pair.joint_mm:.3f} mm"
        " that both allow"
    )


# --- the whole -------------------------------------------------------------------------------------------


def _doubts(alignment: Alignment) -> list[str]:
    """Datums that contradict those before them."""
    doubts = []
    for result in alignment.datums:
        excess = np.sqrt(max(0.0, result.rest_mm**2 - result.residual_mm**2))
        if result.feature != "fit" and excess > max(0.1, result.residual_mm):
            doubts.append(
                f"datum {result.label}: {excess:.2f} mm rms off the datums before it; is it where the CAD says?"
            )
    return doubts


def _datum_system(
    alignment: Alignment, part: Part, base: Sequence[str], reconstruction: MetricReconstruction
) -> DatumSystem:
    components = {datum.label: datum.component for datum in part.datums}
    reports = tuple(
        DatumReport(
            one.label, one.feature, components.get(one.label, base[0]), one.locked, one.used, one.of,
            one.residual_mm, one.rest_mm, one.radius_mm,
            {"plane": "sweep", "point": "sweep", "hole": "edges", "pin": "edges"}.get(one.feature, "sweep and edges"),
        )
        for one in alignment.datums
    )  # fmt: skip
    notes = alignment.notes
    if not part.datums:
        notes = (f"no datums in the part file: best fit of {', '.join(base)}", *notes)
    scale = reconstruction.scale
    used = [evidence.detail for evidence in scale.evidence if evidence.is_used]
    return DatumSystem(
        reports, _matrix(alignment.rough_from_datum), _matrix(alignment.covariance), _three(alignment.origin_in_model),
        scale.scale, scale.scale_std, "; ".join(used), notes,
    )  # fmt: skip


def _provenance(reconstruction: MetricReconstruction, options: MeasureOptions, cpu_s: float) -> Provenance:
    used = [m for m in options.methods if m != "cloud" or reconstruction.cloud is not None]
    asked = {
        "methods": ",".join(options.methods),
        "guard": f"{options.decision.guard:g}",
        "k": f"{options.uncertainty.k:g}",
        "probability": f"{options.uncertainty.probability:g}",
        "monte_carlo": str(options.uncertainty.draws if options.uncertainty.monte_carlo else 0),
        "seed": str(options.uncertainty.seed),
        "form_mm": f"{options.uncertainty.form_mm:g}",
        "corrects_bias": str(options.corrects_bias).lower(),
    }
    return Provenance(
        tool="arview measure",
        version=__version__,
        method=f"{', '.join(used)} in {len(reconstruction.sparse.photos)} photos",
        photos_hash=content_key(photo.path for photo in reconstruction.sparse.photos),
        photos=len(reconstruction.sparse.photos),
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
