"""Unit of a cloud: given, declared by the file, or found by comparing its size with the CAD's."""

from __future__ import annotations

import numpy as np

from arview.errors import InputError
from arview.measurement.cloud.reading.raw_points import RawPoints

UNITS_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4, "ft": 304.8, "um": 1e-3}
"""Millimetres in each unit that may be given."""
USUAL_UNITS = ("mm", "m", "inch")
"""Units that are found by size, the usual ones first."""
_RARE = ("cm", "ft", "um")
"""Units near to these, which are tried beside them, and only where the size is clearly right."""
_CLEAR = (0.45, 2.2)
"""Size of the cloud over that of the CAD within which a unit is certain: no other is nearer than a factor of 11."""
_POSSIBLE = (0.12, 12.0)
"""The same within which a unit is possible, for fragments of a part and for parts on a table."""
_GIVEN = (0.02, 60.0)
"""The same outside which a unit that was given, or that the file declares, is wrong."""


def unit_of_option(name: str) -> str:
    """The name of a unit as given by a user. Raises InputError for an unknown one."""
    known = {"in": "inch", "inches": "inch", '"': "inch", "metre": "m", "meter": "m", "metres": "m", "µm": "um"}
    unit = known.get(name.strip().lower(), name.strip().lower())
    if unit not in UNITS_MM:
        raise InputError(f"unit {name!r} of the cloud: expected one of {', '.join(UNITS_MM)}")
    return unit


def possible_units(raw: RawPoints, diameter_mm: float, name: str) -> list[str]:
    """Units in which the cloud has about the size of the CAD, the most likely first.

    Args:
        raw: the points.
        diameter_mm: of the CAD.
        name: of the file, for messages.

    Raises:
        InputError: in no unit it has.
    """
    extent = _extent(raw)
    sizes = {unit: extent * UNITS_MM[unit] / diameter_mm for unit in (*USUAL_UNITS, *_RARE)}
    clear = [unit for unit, size in sizes.items() if _CLEAR[0] <= size <= _CLEAR[1]]
    if any(unit in USUAL_UNITS for unit in clear):
        return clear
    found = clear + [unit for unit in USUAL_UNITS if _POSSIBLE[0] <= sizes[unit] <= _POSSIBLE[1]]
    if not found:
        raise InputError(
            f"{name}: is {extent:.4g} units across, the CAD {diameter_mm:.4g} mm: neither in mm, m nor inch does it"
            " have the size of the part; give its unit with --cloud-unit, or cut away what is not the part"
        )
    return sorted(found, key=lambda unit: abs(np.log(sizes[unit])))


def check_given_unit(raw: RawPoints, unit: str, diameter_mm: float, name: str) -> None:
    """Raise InputError where a cloud in a given unit is far smaller or larger than the CAD."""
    extent = _extent(raw)
    if _GIVEN[0] <= extent * UNITS_MM[unit] / diameter_mm <= _GIVEN[1]:
        return
    fitting = [one for one in UNITS_MM if _CLEAR[0] <= extent * UNITS_MM[one] / diameter_mm <= _CLEAR[1]]
    hint = f"--cloud-unit {' or '.join(fitting)} fits" if fitting else "cut away what is not the part"
    raise InputError(
        f"{name}: in {unit} it is {extent * UNITS_MM[unit]:.4g} mm across, the CAD {diameter_mm:.4g} mm: the unit "
        f"is wrong: {hint}"
    )


def _extent(raw: RawPoints) -> float:
    """Diagonal of the box of all but the outermost points, in the unit of the file."""
    few = raw.points[:: max(1, len(raw) // 100_000)].astype(np.float64)
    return float(np.linalg.norm(np.diff(np.quantile(few, [0.02, 0.98], axis=0), axis=0)))
