"""Characteristics of the drawing, measured and judged: zones of ISO 1101, and sizes and distances between limits.

A characteristic with a zone is judged in the frame of its own datums, in their order of precedence (ISO 5459): the zone
is free to move along what they leave free, and a datum at maximum material lets it shift by what the datum is off that
size (ISO 2692). Only a measured size gives a bonus.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from arview.cad import Characteristic, Datum, Part
from arview.core.fits import orthogonal_complement
from arview.errors import InputError
from arview.geometry import Array
from arview.inspection import CharacteristicResult, Verdict
from arview.measurement.datums.alignment import Alignment, align
from arview.measurement.datums.cad_features import round_faces
from arview.measurement.datums.equations import DatumEquations, point_from_move
from arview.measurement.features import STATE, MeasuredFeature, component_feature, feature_of, joint_state
from arview.measurement.measurand import measurand_of
from arview.measurement.options import ComponentMeasurement, combined_of
from arview.measurement.uncertainty.budget import K
from arview.measurement.uncertainty.decision import decide, worst
from arview.measurement.uncertainty.pose_propagation import PosePropagation
from arview.measurement.zones import Zone, with_uncertainty

ORIENTATIONS = ("perpendicularity", "parallelism", "angularity")
FORM_NOTE = "the form of the surface between its edges is not in the value"
MEANS_NOTE = "of the means of {count} cells of the surface: shorter waves are not in the value"
OFFSET_NOTE = "the middle of the zone lies {offset_mm:+g} mm off nominal"
OF_WHOLE_NOTE = "{component} as a whole was measured: its shape is taken to be that of the CAD"
MeasureFeature = Callable[[Datum], tuple[Sequence[DatumEquations], str]]
"""Measures the offsets of a feature, by one or two methods, and has a note about it or an empty text."""


@dataclass(frozen=True)
class Frames:
    """What is needed for the frame of any datums of the part.

    Attributes:
        whole: the frame of all datums.
        base: fit that fixes what datums leave free, where the zone is free anyhow.
        size_mm: half the diagonal of the base.
        scale_std: relative standard deviation of the scale.
        poses: for the errors of the camera poses in the whole frame, or None.
    """

    whole: Alignment
    base: DatumEquations
    size_mm: float
    scale_std: float
    poses: PosePropagation | None

    def of(self, labels: tuple[str, ...]) -> tuple[Alignment, PosePropagation | None]:
        """The frame of some datums in an order of precedence.

        Raises:
            InputError: one of them was not measured.
        """
        equations = {one.label: one for one in self.whole.equations}
        missing = [label for label in labels if label not in equations]
        if missing:
            raise InputError(f"datum {', '.join(missing)} could not be measured")
        chosen = [equations[label] for label in labels]
        alignment = align(chosen, self.whole.origin_in_model, self.size_mm, self.base, self.scale_std)
        return alignment, None if self.poses is None else self.poses.relative_to(alignment)


def measure_characteristics(
    part: Part,
    measure_one: MeasureFeature,
    results: Mapping[str, ComponentMeasurement],
    frames: Frames,
    guard: float,
    mm_per_px: Callable[[Array], float],
    tell: Callable[[str, int, int], None],
) -> tuple[CharacteristicResult, ...]:
    """Every characteristic of a part file; one that cannot be measured says why.

    Args:
        part: the part.
        measure_one: measures a feature.
        results: of the components.
        frames: see `Frames`.
        guard: share of U kept from a limit.
        mm_per_px: size of a pixel at a point (3,).
        tell: called with (what, done, total).
    """
    features: dict[str, MeasuredFeature | str] = {}
    datums = {datum.label: datum for datum in (*part.datums, *part.features)}
    wanted = list(dict.fromkeys(name for one in part.characteristics for name in one.of))
    for done, name in enumerate(wanted):
        tell("features", done, len(wanted))
        try:
            if name in datums:
                datum = datums[name]
                component, px_mm = part.model.component(datum.component), mm_per_px(np.array(datum.point_in_model))
                ways, note = measure_one(datum)
                features[name] = replace(feature_of(datum, component, ways, frames.poses, px_mm), note=note)
            else:
                features[name] = _component(name, part, results, frames.poses)
        except InputError as error:
            features[name] = str(error).removeprefix("datum ")
    decisions = _Decisions(part, features, frames, guard)
    # A bonus needs the sizes first, which have limits and no zone.
    ordered = sorted(part.characteristics, key=lambda one: one.tolerance_mm is not None)
    found = {one.name: decisions.result(one) for one in ordered}
    return tuple(found[one.name] for one in part.characteristics)


def _component(
    name: str,
    part: Part,
    results: Mapping[str, ComponentMeasurement],
    poses: PosePropagation | None,
) -> MeasuredFeature:
    """A component as a feature. Raises InputError where it was not measured."""
    together = combined_of(results[name]) if name in results else None
    if together is None:
        raise InputError(f"{name!r} was not measured")
    measurand = measurand_of(name, part)
    return component_feature(part.model.component(name), measurand.point_in_model, measurand.axes[2], together, poses)


class _Decisions:
    """Judges the characteristics of one part from its measured features; sizes are remembered for the bonus."""

    def __init__(self, part: Part, features: Mapping[str, MeasuredFeature | str], frames: Frames, guard: float) -> None:
        self.part, self.features, self.frames, self.guard = part, features, frames, guard
        self._frame_of = cache(frames.of)  # the errors of the poses are worked out anew for each
        self.datums = {datum.label: datum for datum in (*part.datums, *part.features)}
        self.sizes: dict[tuple[str, str], tuple[float, float]] = {}
        """By feature and limit of its size: how far its size is off that, and U, mm."""

    def result(self, one: Characteristic) -> CharacteristicResult:
        """The result of one characteristic."""
        marked = tuple(f"{label}(M)" if label in one.datums_at_maximum else label for label in one.datums)
        empty = CharacteristicResult(
            one.name,
            one.kind,
            one.of,
            Verdict.NOT_MEASURED,
            zone_mm=one.tolerance_mm,
            zone=one.zone,
            limits_mm=one.limits_mm,
            datums=marked,
            components=tuple(
                dict.fromkeys(self.datums[name].component if name in self.datums else name for name in one.of)
            ),
            source=one.source,
        )
        try:
            features = [self._feature(name) for name in one.of]
            x, y, z = (float(v) for v in np.mean([feature.center for feature in features], axis=0).tolist())
            noted = tuple(dict.fromkeys(feature.note for feature in features if feature.note))
            empty = replace(empty, point_mm=(x, y, z), notes=noted)
            measure = self._limited if one.tolerance_mm is None else self._zone
            return measure(one, features, empty)
        except InputError as error:
            return replace(empty, reason=str(error))

    def _feature(self, name: str) -> MeasuredFeature:
        found = self.features[name]
        if isinstance(found, str):
            raise InputError(found)
        return found

    def _limited(
        self, one: Characteristic, features: list[MeasuredFeature], empty: CharacteristicResult
    ) -> CharacteristicResult:
        """A size, distance, gap or flush, which need no datums."""
        row, nominal = _limited_value(one, features)
        state, covariance = joint_state(features, self.frames.whole, self.frames.poses)
        _check_determined(Zone(row[None, None], np.zeros((1, 1, 0)), np.zeros(0)), features)
        value = nominal + float(row @ state)
        uncertainty = K * math.sqrt(max(0.0, float(row @ covariance @ row)))
        if one.kind == "size":
            order = ("maximum", "least") if self._is_hole(one.of[0]) else ("least", "maximum")
            for material, limit, sign in zip(order, one.limits_mm, (1.0, -1.0), strict=True):
                if limit is not None:
                    self.sizes[one.of[0], material] = sign * (value - limit), uncertainty
        low, high = one.limits_mm
        verdicts = [decide(value, uncertainty, high, self.guard)] if high is not None else []
        verdicts += [decide(-value, uncertainty, -low, self.guard)] if low is not None else []
        return replace(empty, verdict=worst(verdicts), value_mm=value, uncertainty_mm=uncertainty, nominal_mm=nominal)

    def _is_hole(self, name: str) -> bool:
        datum = self.datums[name]
        if datum.feature != "cylinder":
            return datum.feature in ("hole", "slot")
        return round_faces(self.part.model.component(datum.component), datum)[1] < 0

    def _zone(
        self, one: Characteristic, features: list[MeasuredFeature], empty: CharacteristicResult
    ) -> CharacteristicResult:
        """A characteristic with a tolerance zone."""
        alignment, poses = self._frame_of(one.datums)
        state, covariance = joint_state(features, alignment, poses)
        zone = _zone_of(one, features, self._free_motions(one, alignment), alignment.origin_in_model)
        form = features[0].form if one.kind in ("profile", "flatness") else None
        if one.offset_mm:
            for index, feature in enumerate(features if form is None else ()):
                state[STATE * index + 3 : STATE * index + 6] -= one.offset_mm * _directions_across(one, feature)[0]
            empty = replace(empty, notes=(*empty.notes, OFFSET_NOTE.format(offset_mm=one.offset_mm)))
        if one.kind in ("profile", "flatness"):
            note = FORM_NOTE if form is None else MEANS_NOTE.format(count=len(form.points))
            empty = replace(empty, notes=(*empty.notes, note))
            if form is not None:
                state = np.concatenate([state, form.offsets_mm - one.offset_mm])
                covariance = np.block([
                    [covariance, np.zeros((len(covariance), len(form.variances)))],
                    [np.zeros((len(form.variances), len(covariance))), np.diag(form.variances)],
                ])  # fmt: skip
            elif one.kind == "flatness":
                raise InputError(f"{one.of[0]}: its surface was not measured, only its edges")
        _check_determined(zone, features)
        value, uncertainty = with_uncertainty(zone, state, covariance)
        assert one.tolerance_mm is not None
        bonus, of_bonus = self._bonus(one.of, one.material) if one.material else (0.0, 0.0)
        uncertainty = math.hypot(uncertainty, of_bonus)
        allowed = one.tolerance_mm + bonus
        verdict = decide(value, uncertainty, allowed, self.guard)
        if FORM_NOTE in empty.notes and verdict is Verdict.PASS:
            verdict = Verdict.UNDECIDED
        return replace(
            empty, verdict=verdict, value_mm=value, uncertainty_mm=uncertainty, zone_mm=allowed, bonus_mm=bonus,
        )  # fmt: skip

    def _bonus(self, names: Sequence[str], material: str) -> tuple[float, float]:
        """The smallest distance of some features from maximum or least material, and its U.

        Raises:
            InputError: a size was not measured.
        """
        missing = [name for name in names if (name, material) not in self.sizes]
        if missing:
            raise InputError(f"the size of {', '.join(missing)} was not measured, which {material} material asks for")
        off, uncertainty = min(self.sizes[name, material] for name in names)
        return max(0.0, off), uncertainty if off > 0.0 else 0.0

    def _free_motions(self, one: Characteristic, alignment: Alignment) -> tuple[Array, Array]:
        """Motions (6,K) about the frame's origin along which the zone may move, and how far along each, mm."""
        if one.kind == "flatness":
            return np.eye(6), np.full(6, np.inf)
        motions, reaches = [], []
        origin = alignment.origin_in_model
        for equations, locks in zip(alignment.equations, alignment.locks, strict=False):
            if equations.label == self.frames.base.label:
                motions.append(locks)
                reaches.append(np.full(locks.shape[1], np.inf))
            elif equations.label in one.datums_at_maximum:
                at = point_from_move((equations.points.mean(axis=0) - origin)[None])[0, :, :6] @ locks
                lengths = np.linalg.norm(at, axis=0)
                motions.append(locks / np.maximum(lengths, 1e-12))
                reaches.append(np.full(locks.shape[1], 0.5 * self._bonus([equations.label], "maximum")[0]))
        if one.kind in ORIENTATIONS:
            motions.append(np.eye(6)[:, 3:])
            reaches.append(np.full(3, np.inf))
        if not motions:
            return np.zeros((6, 0)), np.zeros(0)
        return np.concatenate(motions, axis=1), np.concatenate(reaches)


def _zone_of(
    one: Characteristic, features: Sequence[MeasuredFeature], free: tuple[Array, Array], origin: Array
) -> Zone:
    """The zone of a characteristic, for the joint state of its features and, at the end, the form of a face."""
    motions, reaches = free
    form = features[0].form if one.kind in ("profile", "flatness") else None
    size = STATE * len(features) + (0 if form is None else len(form.points))
    rows, by_motion = [], []
    for index, feature in enumerate(features):
        across = _directions_across(one, feature) if form is None else form.normals[:, None]
        places = feature.places if form is None else form.points
        if one.kind == "position" and feature.feature in ("fit", "point", "hole", "pin"):
            places = feature.center[None]
        own = across @ point_from_move(places - feature.center)[:, :, :6]  # (P,D,6)
        row = np.zeros((len(places), across.shape[-2], size))
        row[:, :, STATE * index : STATE * index + 6] = own
        if form is not None:
            row[np.arange(len(places)), 0, STATE * len(features) + np.arange(len(places))] = 1.0
        rows.append(row)
        by_motion.append(across @ point_from_move(places - origin)[:, :, :6])
    return Zone(np.concatenate(rows), np.concatenate(by_motion) @ motions, reaches)


def _directions_across(one: Characteristic, feature: MeasuredFeature) -> Array:
    """(D,3) orthonormal directions in which a zone is bounded."""
    if one.zone == "sphere":
        return np.eye(3)
    if one.zone == "width":
        return np.array(one.direction_in_model or feature.axis)[None]
    return orthogonal_complement(np.array(one.direction_in_model or feature.axis)[None])


def _limited_value(one: Characteristic, features: Sequence[MeasuredFeature]) -> tuple[Array, float]:
    """Derivative (S,) of a size, distance, gap or flush by the state of its features, and its nominal value.

    Raises:
        InputError: the distance has no direction.
    """
    row = np.zeros(STATE * len(features))
    if one.kind == "size":
        row[6] = 2.0
        return row, 2.0 * features[0].radius_mm
    first, second = features
    arm = second.center - first.center
    if one.direction_in_model is not None:
        direction = np.array(one.direction_in_model)
    elif one.kind == "distance":
        if np.linalg.norm(arm) < 1e-6:
            raise InputError(f"{' and '.join(one.of)} are at the same place: give the direction of their distance")
        direction = arm / np.linalg.norm(arm)
    else:
        direction = first.axis
    points = (first.center, second.center)
    if one.kind != "distance":
        # Both faces are taken at the middle of the smaller one.
        spans = [float(np.linalg.norm(np.ptp(feature.places, axis=0))) for feature in features]
        points = (points[int(np.argmin(spans))],) * 2
    for index, (feature, point, sign) in enumerate(zip(features, points, (-1.0, 1.0), strict=True)):
        own = direction @ point_from_move((point - feature.center)[None])[0, :, :6]
        row[STATE * index : STATE * index + 6] = sign * own
    return row, float(direction @ arm)


def _check_determined(zone: Zone, features: Sequence[MeasuredFeature]) -> None:
    """Raise InputError where the data leave something of a feature free on which its zone depends."""
    size = zone.displacements.shape[2]
    for index, feature in enumerate(features):
        free = np.zeros((len(feature.undetermined), size))
        free[:, STATE * index : STATE * (index + 1)] = feature.undetermined
        if zone.depends_on(free):
            raise InputError(
                f"{feature.name}: what was seen of it does not determine "
                f"{'its tilt' if feature.feature in ('hole', 'pin', 'slot') else 'all that the zone limits'}"
            )
