"""Studies of the registration with simulated posts; each writes its results as CSV and a picture."""

from arview.measurement.studies.common import Study, write_study
from arview.measurement.studies.density import density_study
from arview.measurement.studies.displacement import displacement_study
from arview.measurement.studies.noise import noise_study
from arview.measurement.studies.rice import rice_study
from arview.measurement.studies.threshold import threshold_study

__all__ = [
    "Study",
    "density_study",
    "displacement_study",
    "noise_study",
    "rice_study",
    "threshold_study",
    "write_study",
]
