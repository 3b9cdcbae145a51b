"""Synthetic inspections: every kind of verdict, undetermined axes, missing components and foreign objects."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np

from arview.cad.model import Model
from arview.geometry import Array, exp_so3, rigid
from arview.inspection import (
    BudgetLine,
    ComponentDeviation,
    DatumReport,
    DatumSystem,
    Details,
    Finding,
    ForeignReport,
    Inspection,
    MethodResult,
    Provenance,
    Verdict,
)

CREATED = datetime(2026, 3, 1, 12, 30, 15, tzinfo=UTC)
ALL = (True, True, True, True, True, True)
NOTHING = (False, False, False, False, False, False)


def deviation(
    name: str, moved: tuple[float | None, float | None, float | None], center: Array, tolerance_mm: float | None = 0.5,
    uncertainty_mm: float = 0.06, turn_deg: float = 0.0, angle_tolerance_deg: float | None = None,
) -> ComponentDeviation:  # fmt: skip
    """A component with a displacement and a rotation about z; the verdict follows ISO 14253-1."""
    x, y, z = (value is not None for value in moved)
    distance = float(np.linalg.norm([value or 0.0 for value in moved]))
    rotation = exp_so3(np.array([0.0, 0.0, np.deg2rad(turn_deg)]))
    shift = np.array([value or 0.0 for value in moved])
    place = rigid(rotation, center - rotation @ center + shift)
    if tolerance_mm is None:
        verdict = Verdict.MEASURED
    elif distance + uncertainty_mm > tolerance_mm >= distance - uncertainty_mm:
        verdict = Verdict.UNDECIDED
    else:
        verdict = Verdict.PASS if distance + uncertainty_mm <= tolerance_mm else Verdict.FAIL
    if None in moved and verdict is Verdict.PASS:
        verdict = Verdict.UNDECIDED
    details = Details(
        center_mm=(float(center[0]), float(center[1]), float(center[2])),
        measured_from_nominal=tuple(tuple(float(v) for v in row) for row in place),
        covariance=tuple(tuple(float(v) for v in row) for row in np.diag([1e-6] * 3 + [4e-4, 9e-4, 1.6e-3])),
        radius_mm=20.0,
        k=2.0,
        interval_mm=(max(0.0, distance - uncertainty_mm), distance + uncertainty_mm),
        zone_diameter_mm=2.0 * distance,
        angle_deg=abs(turn_deg),
        angle_uncertainty_deg=0.1,
        angle_tolerance_deg=angle_tolerance_deg,
        methods=(MethodResult("sweep", moved, (0.0, 0.0, turn_deg), (0.01, 0.01, 0.02), 321, 0.04, 0.8),
                 MethodResult("cloud", reason="fewer than 100 points")),
        budget=(BudgetLine("datum A", 0.4 * uncertainty_mm), BudgetLine("noise of edges", 0.3 * uncertainty_mm)),
        notes=("held by its edges alone",),
    )  # fmt: skip
    return ComponentDeviation(
        name, moved, distance, (True, True, True, x, y, z), uncertainty_mm, tolerance_mm, verdict,
        tilt_deg=0.0, twist_deg=turn_deg, details=details,
    )  # fmt: skip


def missing(name: str, center: Array) -> ComponentDeviation:
    """A missing component."""
    details = Details((float(center[0]), float(center[1]), float(center[2])))
    none = (None, None, None)
    return ComponentDeviation(
        name, none, None, NOTHING, None, 0.5, Verdict.FAIL, finding=Finding.MISSING, details=details
    )


def not_measured(name: str, center: Array) -> ComponentDeviation:
    """A component that was not measured."""
    details = Details((float(center[0]), float(center[1]), float(center[2])), notes=("seen by one photo",))
    return ComponentDeviation(name, (None,) * 3, None, NOTHING, None, 0.5, Verdict.NOT_MEASURED, details=details)


def inspection(
    model: Model, components: tuple[ComponentDeviation, ...], serial: str = "SN-7", foreign: bool = False,
    part: str = "bench", minutes: int = 0,
) -> Inspection:  # fmt: skip
    """An inspection of a model, with datums and provenance."""
    chip = ForeignReport((80.0, 80.0, 2.0), (6.0, 5.0, 4.0), 90.0, "plate", 0.0, "foreign object on plate, 90 mm²")
    eye = tuple(tuple(float(v) for v in row) for row in np.eye(4))
    datums = (
        DatumReport("A", "plane", "plate", "rx ry tz", 290, 293, 0.017, 0.018, method="sweep"),
        DatumReport("B", "hole", "plate", "tx ty", 2074, 2232, 0.072, 0.071, -0.05, "edges"),
    )
    system = DatumSystem(
        datums, eye, tuple((0.0,) * 7 for _ in range(7)), (0.0, 0.0, 0.0), 1.0, 1e-4, "ChArUco", ("scale from C",)
    )  # fmt: skip
    return Inspection(
        part=part,
        serial=serial,
        model_hash=model.source_hash,
        created=CREATED + timedelta(minutes=minutes),
        components=components,
        provenance=Provenance(
            "arview measure", "0.1.0", "sweep, edges in 12 photos", "", "abc", 12, (("numpy", "2.0"),),
            (("methods", "sweep,edges"), ("guard", "1"), ("k", "2"), ("probability", "0.95"), ("monte_carlo", "20000")),
            12.0,
        ),
        datum_system=system,
        warnings=("the photos are few",) if foreign else (),
        foreign_objects=(chip,) if foreign else (),
    )  # fmt: skip


def bench_inspection(model: Model) -> Inspection:
    """An inspection of `photo_scene.bench` with every kind of verdict and a foreign object."""
    center = {c.name: c.bounds_in_model.mean(axis=0) for c in model.components}
    return inspection(
        model,
        (
            deviation("block_1", (0.03, -0.02, 0.01), center["block_1"]),
            deviation("block_2", (2.4, -1.8, 0.0), center["block_2"], turn_deg=0.7, angle_tolerance_deg=1.0),
            deviation("block_3", (0.1, 0.05, None), center["block_3"]),
            missing("block_4", center["block_4"]),
            not_measured("plate", center["plate"]),
        ),
        foreign=True,
    )


def one_failing(model: Model) -> Inspection:
    """An inspection of `photo_scene.bench` with one component in tolerance and one out of it."""
    center = {c.name: c.bounds_in_model.mean(axis=0) for c in model.components}
    return inspection(
        model,
        (
            deviation("block_1", (0.03, -0.02, 0.01), center["block_1"]),
            deviation("block_2", (2.4, -1.8, 0.0), center["block_2"]),
        ),
    )
