"""Details of a measurement: pose, covariance, methods, uncertainty budget, datums, distances."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from types import UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

Vector3 = tuple[float, float, float]
Matrix = tuple[tuple[float, ...], ...]
T = TypeVar("T")

MEASURANDS = {
    "volume_centroid": "centre of mass (centroid of the volume)",
    "area_centroid": "centre of mass (centroid of the area of a sheet body)",
    "seat": "middle of the surface on which it stands",
    "axis": "foot of its axis",
    "hole": "centre of its hole",
    "given": "point named by the part file",
    "box_center": "centre of the bounding box",
}
"""The points whose displacement is stated, in words; the last one is that of older files."""


@dataclass(frozen=True)
class MethodResult:
    """The result of one method for a component, in the datum frame, or the reason why there is none.

    Attributes:
        method: sweep, edges or cloud.
        displacement_mm: displacement along the axes of the model, None where undetermined; None if not measured.
        rotation_deg: rotation vector, with the same conventions.
        std_mm: standard uncertainty of each component of ``displacement_mm`` due to the noise of this method.
        used: number of measurements.
        residual_mm: robust standard deviation of their residuals.
        support: fraction of the expected measurements that were found.
        reason: why the component was not measured; empty if it was.
        notes: doubts about the result.
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
    """The comparison of two methods.

    Attributes:
        methods: their names.
        difference_mm: length of the difference of their displacements.
        joint_mm: bound below which 95 % of such differences are expected.
        agree: whether the methods agree: neither the displacements nor shift and turn together differ by more.
        ratio: difference of shift and turn in all directions that both determine, divided by the one below which 95 %
            of such differences are expected.
    """

    methods: tuple[str, str]
    difference_mm: float
    joint_mm: float
    agree: bool
    ratio: float | None = None


@dataclass(frozen=True)
class BudgetLine:
    """A contribution to the uncertainty, with its standard uncertainty along the displacement, mm."""

    name: str
    std_mm: float


@dataclass(frozen=True)
class Details:
    """The full measurement of a component in the datum frame, with the axes of the model; degrees and mm.

    Attributes:
        center_mm: nominal position of the point that ``displacement_mm`` refers to.
        measurand: which point that is, a key of `MEASURANDS`; files of older versions state the centre of the box.
        measured_from_nominal: (4,4) row-major pose relative to the nominal one; undetermined directions are nominal.
        covariance: (6,6) covariance of rotation vector (rad) and displacement (mm).
        undetermined: (K,6) orthonormal undetermined directions; rotations are multiplied by ``radius_mm``.
        radius_mm: half the diagonal of the bounding box.
        axes: (3,3) rows are the component's own axes in the model; tilt and twist are those of the last one.
        axis_from: what the last own axis is: symmetry, seat (normal of the surface on which it stands), face or model.
        own_displacement_mm, own_rotation_deg: displacement and rotation vector along the own axes, None where
            undetermined.
        tilt_uncertainty_deg: U of the tilt.
        photos: number of photos that show the component.
        k: coverage factor of U along the displacement.
        interval_mm: ends of the 95 % coverage interval of the distance.
        corrected_distance_mm: most likely true distance; near zero, noise makes the measured one too large (Rice).
        zone_diameter_mm: diameter of the smallest position tolerance zone that holds the component (ISO 1101).
        angle_deg, angle_uncertainty_deg: angle of the determined rotation and its U; None when undetermined.
        angle_tolerance_deg: largest rotation allowed; None without such a tolerance.
        methods: results of the methods.
        agreement: comparisons of the pairs of methods.
        budget: contributions to the uncertainty of the distance, largest first; their squares sum to its square.
        notes: remarks on the measurement.
    """

    center_mm: Vector3
    measurand: str = "box_center"
    measured_from_nominal: Matrix | None = None
    covariance: Matrix | None = None
    undetermined: Matrix = ()
    radius_mm: float | None = None
    axes: Matrix | None = None
    axis_from: str | None = None
    own_displacement_mm: tuple[float | None, ...] | None = None
    own_rotation_deg: tuple[float | None, ...] | None = None
    tilt_uncertainty_deg: float | None = None
    photos: int | None = None
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
    """The measurement of a datum.

    Attributes:
        label, feature, component: definition in the part file.
        locked: description of the degrees of freedom that it constrains.
        used, of: number of consistent measurements, and of possible ones.
        residual_mm: robust standard deviation about its own best fit.
        rest_mm: rms in the datum frame, which shows contradictions to the datums of higher precedence.
        radius_mm: by how much the radius of a hole or pin is larger than nominal; None for other features.
        method: measurement method.
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
class FailedDatum:
    """A datum of the part file that could not be measured.

    Attributes:
        label, feature, component: of the datum.
        reason: why.
        instead: features that could be measured instead, best first.
        directions: degrees of freedom that it would have locked, and that were taken from elsewhere.
    """

    label: str
    feature: str
    component: str
    reason: str
    instead: tuple[str, ...] = ()
    directions: str = ""


@dataclass(frozen=True)
class DatumSystem:
    """The frame of the deviations.

    Attributes:
        datums: the datums in order of precedence.
        rough_from_datum: (4,4) row-major transform from the datum frame to the frame of the reconstruction, mm.
        covariance: (7,7) covariance of rotation vector (rad), shift (mm) about ``origin_mm`` and relative scale.
        origin_mm: (3,) point in the model frame.
        mm_per_unit: scale of the reconstruction; None when not recorded.
        scale_std: relative standard uncertainty of the scale.
        scale_from: sources of the scale.
        notes: remarks on the alignment.
        not_measured: datums of the part file that could not be measured.
        frame: datums, best_fit (the part file has none), or partial: of those datums that could be measured.
    """

    datums: tuple[DatumReport, ...]
    rough_from_datum: Matrix
    covariance: Matrix
    origin_mm: Vector3
    mm_per_unit: float | None = None
    scale_std: float | None = None
    scale_from: str = ""
    notes: tuple[str, ...] = ()
    not_measured: tuple[FailedDatum, ...] = ()
    frame: str = "datums"


@dataclass(frozen=True)
class ForeignReport:
    """A foreign object: a surface that belongs to no component of the CAD model.

    Attributes:
        center_mm, size_mm: its bounding box in the datum frame.
        area_mm2: its area.
        nearest_component, distance_mm: the component nearest to it, and the distance of its farthest point to the CAD.
        text: description.
    """

    center_mm: Vector3
    size_mm: Vector3
    area_mm2: float
    nearest_component: str
    distance_mm: float
    text: str


@dataclass(frozen=True)
class DistanceStatistics:
    """Statistics of the signed distances of cloud points to the nominal surface of a component, or of all.

    Attributes:
        name: name of the component, or ``all``.
        count: number of points.
        mean_mm, sigma_mm, median_mm: mean, standard deviation and median of the distances within the reach of the map.
        fwhm_mm: full width at half maximum of their distribution, which does not depend on its tails.
    """

    name: str
    count: int
    mean_mm: float
    sigma_mm: float
    median_mm: float
    fwhm_mm: float


@dataclass(frozen=True)
class DistanceReport:
    """Distances of the aligned cloud to the CAD model.

    Attributes:
        reach_mm: points at larger distances are ignored.
        statistics: statistics of all points and of each component.
        files: names of the coloured cloud and the pictures, relative to the inspection.
    """

    reach_mm: float
    statistics: tuple[DistanceStatistics, ...]
    files: tuple[str, ...] = ()


@dataclass(frozen=True)
class HalvesDifference:
    """A component measured in two halves of the photos.

    Attributes:
        name: of the component.
        difference_mm: length of the difference of its displacements, along the axes that both halves determine; None if
            a half could not measure it.
        joint_mm: length that 95 % of such differences do not exceed if the U of both halves are right.
        e_n: ``difference_mm`` divided by ``joint_mm`` (E_n of ISO 13528); above 1 the halves contradict each other.
        uncertainties_mm: U of the distance in each half, None where it was not measured.
        reason: why it is not compared; empty if it is.
    """

    name: str
    difference_mm: float | None = None
    joint_mm: float | None = None
    e_n: float | None = None
    uncertainties_mm: tuple[float | None, ...] = (None, None)
    reason: str = ""


@dataclass(frozen=True)
class Repeatability:
    """The comparison of two interleaved halves of the photos, each adjusted and measured without the other.

    Attributes:
        photos: number of photos of each half.
        components: the comparison of each component.
        rms_mm: root mean square of the differences of the compared components; None without any.
        cpu_s: processor time that it took.
        reason: why the halves could not be compared; empty if they were.
    """

    photos: tuple[int, ...] = ()
    components: tuple[HalvesDifference, ...] = ()
    rms_mm: float | None = None
    cpu_s: float | None = None
    reason: str = ""

    @property
    def contradictions(self) -> tuple[HalvesDifference, ...]:
        """The components at which the halves differ by more than their U allow."""
        return tuple(one for one in self.components if one.e_n is not None and one.e_n > 1.0)


def to_json(value: Any) -> Any:
    """Convert dataclasses to objects and tuples to lists; fields with their default value are omitted."""
    if is_dataclass(value) and not isinstance(value, type):
        values = {f.name: getattr(value, f.name) for f in fields(value)}
        return {f.name: to_json(values[f.name]) for f in fields(value) if values[f.name] != f.default}
    if isinstance(value, Mapping):
        return {key: to_json(item) for key, item in value.items()}
    return [to_json(item) for item in value] if isinstance(value, tuple) else value


_type_hints: Callable[[Any], dict[str, Any]] = cache(get_type_hints)


def from_json(kind: type[T], value: Any) -> T:
    """The inverse of `to_json`, for a document that complies with the schema."""
    hints = _type_hints(kind)
    return kind(**{name: _read(hints[name], item) for name, item in value.items()})


def _read(hint: Any, value: Any) -> Any:
    if get_origin(hint) in (Union, UnionType):
        return None if value is None else _read(next(h for h in get_args(hint) if h is not type(None)), value)
    if get_origin(hint) is tuple:
        inner = get_args(hint)
        kinds = [inner[0]] * len(value) if len(inner) == 2 and inner[1] is Ellipsis else list(inner)
        return tuple(_read(one, item) for one, item in zip(kinds, value, strict=True))
    return from_json(hint, value) if isinstance(hint, type) and is_dataclass(hint) else hint(value)
