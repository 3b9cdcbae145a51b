"""From a reconstruction and a part file to an inspection: measure, align to the datums, combine, decide."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path

import numpy as np
import scipy.linalg  # noqa: F401  its BLAS is loaded before threads are limited
from threadpoolctl import threadpool_limits

from arview.cad import Datum, Model, Part
from arview.core.checks import PATH, check_type
from arview.core.parallel import pool
from arview.core.progress import Progress
from arview.errors import InputError
from arview.geometry import Array
from arview.inspection import (
    CharacteristicResult,
    ComponentDeviation,
    DistanceReport,
    FailedDatum,
    ForeignReport,
    Inspection,
)
from arview.measurement.characteristics import OF_WHOLE_NOTE, Frames, MeasureFeature, measure_characteristics
from arview.measurement.cloud.points import CloudPoints
from arview.measurement.cloud_report import inspect_cloud, scatter_doubts
from arview.measurement.datums.alignment import Alignment, align
from arview.measurement.datums.datum_fit import check_covered
from arview.measurement.datums.equations import DatumEquations, DatumNotMeasuredError, move_equations
from arview.measurement.datums.in_cloud import measure_datum_in_cloud, points_for_datums
from arview.measurement.datums.in_photos import measure_datums_in_photos, measure_plane_in_photos
from arview.measurement.datums.partial import MeasureDatum, measure_each
from arview.measurement.datums.plane_edges import with_form
from arview.measurement.datums.planes import base_plane
from arview.measurement.folder import BY_SHAPE, MetricReconstruction, in_model_frame, read_folder
from arview.measurement.look_alikes import with_unsure_names
from arview.measurement.measurand import measurand_of
from arview.measurement.options import ComponentMeasurement, MeasureOptions, combined_of
from arview.measurement.photo import PhotoViews, load_views, measure_components_in_photos
from arview.measurement.photo.measure import MethodResults
from arview.measurement.photo.patches import turning_center
from arview.measurement.records import (
    component_record,
    datum_doubts,
    datum_record,
    failed_datum_text,
    in_partial_frame,
    provenance_of,
)
from arview.measurement.seen_from import (
    MOSTLY_HIDDEN,
    is_covered,
    is_mostly_hidden,
    seen_from,
    with_covered,
    with_hidden,
    with_seen_from,
)
from arview.measurement.types import Move, NotMeasured
from arview.measurement.uncertainty.combine import CombinedMove
from arview.measurement.uncertainty.pose_propagation import PosePropagation
from arview.reconstruction import base_names

ROUGH_STD_MM = 0.3
"""Standard uncertainty of the rough frame, where neither datums nor base give a frame."""


def measure(
    reconstruction: MetricReconstruction | str | Path,
    part: Part,
    options: MeasureOptions | None = None,
    *,
    progress: Progress | None = None,
    known: dict[str, MethodResults] | None = None,
    starts: Mapping[str, Array] | None = None,
) -> Inspection:
    """Measure every inspected component in the datum frame, with its uncertainty and verdict.

    Args:
        reconstruction: from `read_folder` or `read_cloud`, or the folder of `arview reconstruct`.
        part: CAD, roles, tolerances, datums.
        options: see `MeasureOptions`.
        progress: called with (what, done, total).
        known: what the methods by photos found of each component in the same reconstruction; an empty one is filled, so
            that a measurement with the cloud need not repeat it.
        starts: (4,4) measured_from_nominal of components that are known within two pixels, by name.

    Raises:
        InputError: the reconstruction contradicts the CAD, a datum is not covered, or there is nothing to inspect.
        OutputError: the distance map cannot be written.
    """
    check_type(reconstruction, (MetricReconstruction, *PATH), "measure: reconstruction")
    check_type(part, Part, "measure: part")
    if isinstance(reconstruction, str | Path):
        reconstruction = read_folder(reconstruction)
    # One thread for BLAS: work is parallel over components, and the matrices have only some hundred rows.
    with threadpool_limits(1, "blas"):
        tell = progress or (lambda what, done, total: None)
        return _measure(
            reconstruction, part, options or MeasureOptions(), tell, {} if known is None else known, starts or {}
        )


def _measure(
    reconstruction: MetricReconstruction,
    part: Part,
    options: MeasureOptions,
    tell: Progress,
    known: dict[str, MethodResults],
    starts: Mapping[str, Array],
) -> Inspection:
    """The steps of `measure`, on the rough frame of the reconstruction."""
    began, warnings = time.process_time(), list(reconstruction.scale.warnings)
    consistency = reconstruction.scale.consistency
    if not consistency.is_consistent:
        if not options.uses_inconsistent:
            raise InputError(f"{consistency.reason}; take other photos, or measure nevertheless with --anyway")
        warnings.append(consistency.reason)
    base = base_names(part)
    names = [name for name in part.inspected if name not in base]
    if not names and not part.characteristics:
        raise InputError(
            f"part {part.name!r}: no component has the role 'inspect', and nothing stands in [[characteristics]]"
        )
    measurands = {name: measurand_of(name, part) for name in names}
    # The views get no covariance of the poses: it is propagated below, relative to the datums.
    reconstruction = in_model_frame(reconstruction, part)
    warnings += [one for one in reconstruction.scale.warnings if one not in warnings]
    has_photos = bool(reconstruction.sparse.photos)
    if not has_photos and "cloud" not in options.methods:
        raise InputError("a cloud without photos can only be measured by the method 'cloud'")
    views = load_views(replace(reconstruction.sparse, pose_covariance=None), part.model) if has_photos else None
    results = measure_all(reconstruction, views, part, [*base, *names], options, tell, known, starts)
    tell("datums", 0, 1)
    alignment, failed = align_to_datums(reconstruction, views, part, base, results)
    warnings += [*(failed_datum_text(one) for one in failed), *datum_doubts(alignment)]
    poses = None
    if views is None:
        warnings.append("a cloud without photos: U does not include errors of its scale and its deformation")
    elif reconstruction.sparse.pose_covariance is None:
        warnings.append("the covariance of the camera poses is unknown: U does not include it")
    else:
        poses = PosePropagation(reconstruction.sparse, part.model, alignment, base)
    deviations = []
    seen, is_hidden = seen_from(reconstruction.sparse, part.model), is_mostly_hidden(consistency)

    def recorded(name: str) -> ComponentDeviation:
        record = component_record(name, results[name], measurands[name], alignment, poses, part, options)
        record = in_partial_frame(record, failed)
        return with_seen_from(with_hidden(record, MOSTLY_HIDDEN) if is_hidden else record, seen)

    for done, record in enumerate(pool().map(recorded, names), 1):
        deviations.append(record)
        tell("uncertainty", done, len(names))
    if BY_SHAPE in warnings:
        deviations, doubts = with_unsure_names(deviations, part)
        warnings += doubts
    foreign: tuple[ForeignReport, ...] = ()
    distances: DistanceReport | None = None
    if reconstruction.cloud is not None and "cloud" in options.methods:
        tell("distance map", 0, 1)
        foreign, distances = inspect_cloud(reconstruction.cloud, part.model, alignment, deviations, options.maps_folder)
        if views is None and distances is not None:
            warnings += scatter_doubts(distances, part.model.diameter_mm)
        for index, name in enumerate(names):
            if is_covered(part.model.component(name).centroid_in_model.tolist(), foreign):
                deviations[index] = with_covered(deviations[index])
    return Inspection(
        part=part.name,
        serial=part.serial or "",
        model_hash=part.model.source_hash,
        drawing=part.drawing,
        created=datetime.now(UTC),
        components=tuple(deviations),
        provenance=provenance_of(reconstruction, options, time.process_time() - began),
        characteristics=_characteristics(reconstruction, views, part, results, alignment, poses, options, tell),
        datum_system=datum_record(alignment, part, base, reconstruction, failed),
        warnings=tuple(warnings),
        foreign_objects=foreign,
        distance_map=distances,
    )


def measure_all(
    reconstruction: MetricReconstruction,
    views: PhotoViews | None,
    part: Part,
    names: Sequence[str],
    options: MeasureOptions,
    tell: Progress,
    known: dict[str, MethodResults],
    starts: Mapping[str, Array] | None = None,
) -> dict[str, ComponentMeasurement]:
    """Measure every component by every requested method, in the rough frame; for the last two see `measure`."""
    found: dict[str, list[Move | NotMeasured]] = {name: [] for name in names}
    if views is not None and {"sweep", "edges"} & set(options.methods):

        def step(name: str, share: float) -> None:
            tell("components", round(share * len(names)), len(names))

        if not known:
            known.update(
                measure_components_in_photos(
                    views, part, part.model, step, names=names, methods=options.methods, starts=starts
                )
            )
        for name, by_method in known.items():
            found[name] += [by_method[method] for method in options.methods if method in by_method]
    if "cloud" in options.methods and reconstruction.cloud is not None:
        from arview.measurement.cloud.deviation import measure_components_in_cloud

        tell("cloud", 0, 1)
        try:
            measured = measure_components_in_cloud(
                reconstruction.cloud,
                part.model,
                part,
                reconstruction.sparse.photos,
                names=names if views is None else None,
            )
        except InputError as error:
            if views is None:
                raise
            measured = [NotMeasured(name, "cloud", str(error)) for name in names]
        for one in measured:
            if one.component not in found:
                continue
            # All methods state their moves about the same point.
            center = turning_center(part.model.component(one.component), part)
            found[one.component].append(one.at(center) if isinstance(one, Move) else one)
    return {
        name: ComponentMeasurement(
            tuple(one for one in all_of if isinstance(one, Move)),
            tuple(one for one in all_of if isinstance(one, NotMeasured)),
        )
        for name, all_of in found.items()
    }


def align_to_datums(
    reconstruction: MetricReconstruction,
    views: PhotoViews | None,
    part: Part,
    base: Sequence[str],
    results: Mapping[str, ComponentMeasurement],
) -> tuple[Alignment, tuple[FailedDatum, ...]]:
    """The datum frame of the part file, and the datums that could not be measured.

    What they leave free follows from the base's fit, as does all without datums.
    """
    fitted = {}
    for name in [*base, *(datum.component for datum in part.datums)]:
        together = combined_of(results[name]) if name in results else None
        if together is not None:
            fitted[name] = _as_move(name, together)
    fits = {name: _rest_of_base(results[name], fitted[name], part) for name in base if name in fitted}
    rest = next(iter(fits.values()), None)
    found = measure_each(
        part.datums,
        _datum_measurement(reconstruction, views, part, fitted),
        part.model,
        rest,
    )
    equations = found.equations
    if not part.datums and views is not None:
        equations = _plane_of_base(views, part.model, base)
        if equations and base[0] in fitted:
            rest = _rest_of_base(results[base[0]], fitted[base[0]], part, is_flat=True)
    if rest is None and not equations:
        reasons = "; ".join(f.reason for name in base for f in results[name].failures)
        named = "".join(f" datum {one.label} ({one.feature}): {one.reason};" for one in found.failed)
        raise InputError(f"{', '.join(base)}: could not be measured, so there is no frame:{named} {reasons}")
    holes = [datum for datum in part.datums if datum.feature in ("hole", "pin", "cylinder")]
    if part.datums:
        origin = np.array((holes or part.datums)[0].point_in_model)
    else:
        origin = fitted[next(name for name in base if name in fitted)].center_in_model
    size_mm = _size_mm(part.model, base)
    kinds = {evidence.kind for evidence in reconstruction.scale.evidence if evidence.is_used}
    scale_std = reconstruction.scale.scale_std or 0.0
    finds_scale = bool(kinds) and kinds <= {"cad"}
    if found.failed and rest is None:
        rest = _rough_frame(origin, size_mm)
    return align(equations, origin, size_mm, rest, scale_std, finds_scale), found.failed


def _datum_measurement(
    reconstruction: MetricReconstruction,
    views: PhotoViews | None,
    part: Part,
    fitted: Mapping[str, Move],
) -> MeasureDatum:
    """The function that measures one datum, in the photos or in the cloud."""

    @cache
    def points() -> CloudPoints:
        assert reconstruction.cloud is not None
        return points_for_datums(part.model, reconstruction.cloud)

    def measure_one(datum: Datum) -> DatumEquations:
        if views is not None:
            return measure_datums_in_photos((datum,), views, fitted)[0]
        return measure_datum_in_cloud(datum, part.model, points(), fitted)

    return measure_one


def _characteristics(
    reconstruction: MetricReconstruction,
    views: PhotoViews | None,
    part: Part,
    results: Mapping[str, ComponentMeasurement],
    alignment: Alignment,
    poses: PosePropagation | None,
    options: MeasureOptions,
    tell: Progress,
) -> tuple[CharacteristicResult, ...]:
    """The characteristics of the part file, measured and judged."""
    if not part.characteristics:
        return ()
    size_mm = _size_mm(part.model, base_names(part))
    rough = _rough_frame(alignment.origin_in_model, size_mm)
    moves = {name: _as_move(name, together) for name in results if (together := combined_of(results[name])) is not None}
    return measure_characteristics(
        part,
        _feature_measurement(reconstruction, views, part, moves),
        results,
        Frames(alignment, rough, size_mm, reconstruction.scale.scale_std or 0.0, poses),
        options.decision.guard,
        views.mm_per_px if views is not None else lambda point: 0.0,
        tell,
    )


def _feature_measurement(
    reconstruction: MetricReconstruction, views: PhotoViews | None, part: Part, fitted: Mapping[str, Move]
) -> MeasureFeature:
    """The function that measures one feature, and what is noted about it.

    A face or an edge that is not seen by itself, as in a narrow gap, is where its component is.
    """
    measure_datum = _datum_measurement(reconstruction, views, part, fitted)

    def measure_one(datum: Datum) -> tuple[Sequence[DatumEquations], str]:
        whole, ways = fitted.get(datum.component), []
        has_whole = whole is not None and datum.feature in ("plane", "edge")
        try:
            if views is not None and datum.feature == "plane":
                ways = measure_plane_in_photos(datum, views, fitted, is_one_enough=False)
            else:
                ways = [measure_datum(datum)]
        except DatumNotMeasuredError:
            if not has_whole:
                raise
        # The fit of a plane's border is combined with that of its component already.
        if whole is None or not has_whole or any(one.feature == "fit" for one in ways):
            return ways, ""
        note = "" if ways else OF_WHOLE_NOTE.format(component=datum.component)
        return [*ways, move_equations(datum.label, with_form(whole))[0]], note

    return measure_one


def _rough_frame(origin: Array, size_mm: float) -> DatumEquations:
    """Equations of the rough frame of the reconstruction, for what neither datums nor base determine."""
    std = ROUGH_STD_MM
    covariance = np.diag([(std / size_mm) ** 2] * 3 + [std**2] * 3)
    move = Move(
        "part",
        "sweep",
        origin,
        twist=np.zeros(6),
        covariance=covariance,
        undetermined=np.zeros((0, 6)),
        radius_mm=size_mm,
        used=0,
        residual_mm=0.0,
        support=1.0,
    )
    return move_equations("the rough frame", move)[0]


def _plane_of_base(views: PhotoViews, model: Model, base: Sequence[str]) -> list[DatumEquations]:
    """Equations of the base's large flat face, whose height is known better than that of its edges; or none."""
    component = model.component(base[0])
    plane = base_plane(component, views.centres.mean(axis=0) - component.bounds_in_model.mean(axis=0))
    if plane is None:
        return []
    try:
        equations = measure_datums_in_photos((plane,), views, {})
        check_covered(equations[0])
    except InputError:
        return []
    return equations


def _rest_of_base(
    measured: ComponentMeasurement, fitted: Move, part: Part, is_flat: bool | None = None
) -> DatumEquations:
    """Equations of the base's best fit; beside a datum plane only that by edges, because narrow sides tell little."""
    edges = [move for move in measured.moves if move.method == "edges"]
    if is_flat is None:
        is_flat = any(datum.feature == "plane" for datum in part.datums)
    return move_equations(fitted.component, edges[0] if edges and is_flat else fitted)[0]


def _as_move(name: str, together: CombinedMove) -> Move:
    """The combined move as that of one method."""
    covariance = np.sum([*together.covariances.values(), together.disagreement], axis=0)
    return Move(
        name,
        "sweep",
        together.center_in_model,
        twist=together.twist,
        covariance=covariance,
        undetermined=together.undetermined,
        radius_mm=together.radius_mm,
        used=0,
        residual_mm=0.0,
        support=1.0,
    )


def _size_mm(model: Model, names: Sequence[str]) -> float:
    """Half the diagonal of the common bounding box of some components."""
    corners = np.concatenate([model.component(name).bounds_in_model for name in names])
    return 0.5 * float(np.linalg.norm(np.ptp(corners, axis=0)))
