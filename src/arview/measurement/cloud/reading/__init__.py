"""Reading clouds of scanners and other programs: PLY, PCD, XYZ, PTS, PTX, CSV, LAS, LAZ, E57 and meshes."""

from arview.measurement.cloud.reading.files import SUFFIXES, read_points
from arview.measurement.cloud.reading.raw_points import RawPoints
from arview.measurement.cloud.reading.units import (
    UNITS_MM,
    USUAL_UNITS,
    check_given_unit,
    possible_units,
    unit_of_option,
)

__all__ = [
    "SUFFIXES",
    "UNITS_MM",
    "USUAL_UNITS",
    "RawPoints",
    "check_given_unit",
    "possible_units",
    "read_points",
    "unit_of_option",
]
