"""Studies of the registration with simulated posts, clouds and photos; each writes its results as CSV and a picture."""

from arview_lab.studies.bias_map import bias_study
from arview_lab.studies.cloud_registration import cloud_registration_study
from arview_lab.studies.common import Study, write_study
from arview_lab.studies.density import density_study
from arview_lab.studies.displacement import displacement_study
from arview_lab.studies.finding import finding_study
from arview_lab.studies.minima import minima_study
from arview_lab.studies.noise import noise_study
from arview_lab.studies.photos import photo_study
from arview_lab.studies.registration import registration_study
from arview_lab.studies.rice import rice_study
from arview_lab.studies.sampling import sampling_study
from arview_lab.studies.threshold import threshold_study

__all__ = [
    "Study",
    "bias_study",
    "cloud_registration_study",
    "density_study",
    "displacement_study",
    "finding_study",
    "minima_study",
    "noise_study",
    "photo_study",
    "registration_study",
    "rice_study",
    "sampling_study",
    "threshold_study",
    "write_study",
]
