"""What a measurement says beyond the label: placement, covariance, both methods, budget, datums, software."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from types import UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

Vector3 = tuple[float, float, float]
Matrix = tuple[tuple[float, ...], ...]
T = TypeVar("T")


@dataclass(frozen=True)
class MethodResult:
    """What one way of measuring says of a component, in the datum frame; or why it says nothing.

    Attributes:
        method: sweep, edges or cloud.
        displacement_mm: along the model's axes; undetermined ones None; None when not measured.
        rotation_deg: rotation vector, likewise.
        std_mm: standard uncertainty of each of ``displacement_mm`` by this method's noise.
        used: number of measurements.
        residual_mm: their robust standard deviation.
        support: share of what should be seen that was.
        reason: why it was not measured; empty when it was.
        notes: in words, what speaks against it.
    """

    method: str
    displacement_mm: tuple[float | None, ...] | None = None
    rotation_deg: tuple[float | None, ...] | None = None
    std_mm: tuple[float | None, ...] | None = None
    used: int = 0
    residual_mm: float | None = None
    support: float | None = None
    reason: str = ""
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class MethodAgreement:
    """Two methods compared: length of their difference, and what 95 % of such differences stay below."""

    methods: tuple[str, str]
    difference_mm: float
    joint_mm: float
    agree: bool


@dataclass(frozen=True)
class BudgetLine:
    """A contribution to the uncertainty: its standard uncertainty along the displacement, mm."""

    name: str
    std_mm: float


@dataclass(frozen=True)
class Details:
    """A component's measurement in full. Angles in degrees, lengths in mm, model axes, in the datum frame.

    Attributes:
        center_mm: nominal place of what ``displacement_mm`` is the displacement of: the middle of its bounding box.
        measured_from_nominal: (4,4) row-major, undetermined directions taken as nominal.
        covariance: (6,6) of rotation vector (rad) and displacement (mm).
        undetermined: (K,6) orthonormal directions that are not determined, rotations times ``radius_mm``.
        radius_mm: half the diagonal of the bounding box.
        k: coverage factor that U stands for along the displacement.
        interval_mm: ends of the 95 % coverage interval of the distance.
        corrected_distance_mm: most likely true distance: near zero, noise makes the measured one too large (Rice).
        zone_diameter_mm: diameter of the smallest position tolerance zone that holds the component (ISO 1101).
        angle_deg, angle_uncertainty_deg: of the determined rotation, with its U; None when undetermined.
        angle_tolerance_deg: largest rotation allowed; None when there is no such tolerance.
        methods: each way of measuring for itself.
        agreement: each pair of them.
        budget: contributions to the uncertainty of the distance, largest first; their squares sum to its square.
        notes: in words.
    """

    center_mm: Vector3
    measured_from_nominal: Matrix | None = None
    covariance: Matrix | None = None
    undetermined: Matrix = ()
    radius_mm: float | None = None
    k: float | None = None
    interval_mm: tuple[float, float] | None = None
    corrected_distance_mm: float | None = None
    zone_diameter_mm: float | None = None
    angle_deg: float | None = None
    angle_uncertainty_deg: float | None = None
    angle_tolerance_deg: float | None = None
    methods: tuple[MethodResult, ...] = ()
    agreement: tuple[MethodAgreement, ...] = ()
    budget: tuple[BudgetLine, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class DatumReport:
    """How a datum was met.

    Attributes:
        label, feature, component: of the part file.
        locked: in words, which degrees of freedom it decided.
        used, of: measurements that agree on it, and how many there should be.
        residual_mm: robust standard deviation about its own best place.
        rest_mm: rms after the alignment: what it contradicts the datums before it.
        radius_mm: how much larger a hole or pin looks; None of others.
        method: by which it was measured.
    """

    label: str
    feature: str
    component: str
    locked: str
    used: int
    of: int
    residual_mm: float
    rest_mm: float
    radius_mm: float | None = None
    method: str = ""


@dataclass(frozen=True)
class DatumSystem:
    """The frame of the deviations.

    Attributes:
        datums: in order of precedence.
        rough_from_datum: (4,4) row-major: the frame of the reconstruction from the datum frame, mm.
        covariance: (7,7) of rotation vector (rad), shift (mm) about ``origin_mm`` and relative scale.
        origin_mm: (3,) model frame.
        mm_per_unit: scale of the reconstruction; None when not recorded.
        scale_std: its relative standard uncertainty.
        scale_from: in words.
        notes: in words, what decided what.
    """

    datums: tuple[DatumReport, ...]
    rough_from_datum: Matrix
    covariance: Matrix
    origin_mm: Vector3
    mm_per_unit: float | None = None
    scale_std: float | None = None
    scale_from: str = ""
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class ForeignReport:
    """A surface that belongs to nothing in the CAD: box in the datum frame, mm, area, how far from what, in words."""

    center_mm: Vector3
    size_mm: Vector3
    area_mm2: float
    nearest_component: str
    distance_mm: float
    text: str


@dataclass(frozen=True)
class DistanceStatistics:
    """Of the signed distances of the cloud's points to one component's nominal surface, or to all: mm.

    Attributes:
        name: of the component, or ``all``.
        count: points.
        mean_mm, sigma_mm, median_mm: of the distances within the reach of the map.
        fwhm_mm: full width at half maximum of their distribution: the width of its core, however long its tails.
    """

    name: str
    count: int
    mean_mm: float
    sigma_mm: float
    median_mm: float
    fwhm_mm: float


@dataclass(frozen=True)
class DistanceReport:
    """Distances of the aligned cloud to the CAD: points within ``reach_mm`` alone; files beside the inspection."""

    reach_mm: float
    statistics: tuple[DistanceStatistics, ...]
    files: tuple[str, ...] = ()


def to_json(value: Any) -> Any:
    """Dataclasses as objects, tuples as lists; fields that hold their default are left out."""
    if is_dataclass(value) and not isinstance(value, type):
        shown = {f.name: getattr(value, f.name) for f in fields(value)}
        return {f.name: to_json(shown[f.name]) for f in fields(value) if shown[f.name] != f.default}
    if isinstance(value, Mapping):
        return {key: to_json(item) for key, item in value.items()}
    return [to_json(item) for item in value] if isinstance(value, tuple) else value


def from_json(kind: type[T], value: Any) -> T:
    """The inverse of ``to_json`` for a document that the schema has accepted."""
    hints = get_type_hints(kind)
    return kind(**{name: _read(hints[name], item) for name, item in value.items()})


def _read(hint: Any, value: Any) -> Any:
    if get_origin(hint) in (Union, UnionType):
        return None if value is None else _read(next(h for h in get_args(hint) if h is not type(None)), value)
    if get_origin(hint) is tuple:
        inner = get_args(hint)
        kinds = [inner[0]] * len(value) if len(inner) == 2 and inner[1] is Ellipsis else list(inner)
        return tuple(_read(one, item) for one, item in zip(kinds, value, strict=True))
    return from_json(hint, value) if isinstance(hint, type) and is_dataclass(hint) else hint(value)
