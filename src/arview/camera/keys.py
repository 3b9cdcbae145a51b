"""Names that camera files use. They are compared without case and without anything but letters and digits."""

from __future__ import annotations

import re
from typing import Any


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


TERMS = _words("k1 k2 k3 k4 k5 k6 p1 p2 s1 s2 s3 s4 tauy taux omega xi")
"""Roles of distortion terms given one by one."""
_NAMES_OF_ROLE = {
    "matrix": "cameramatrix intrinsicmatrix cameraintrinsics camk k mtx intrinsics",
    "terms": "distortioncoefficients distcoeffs distcoeff distcoefs distortion dist d distortioncoeffs distortioncoeff "
    "distortionparams distortionparameters coeffs",
    "model": "distortionmodel distortiontype cameramodel cameratype lensmodel model",
    "fisheye": "fisheyemodel isfisheye fisheye",
    "size": "imagesize imgsize size resolution",
    "fx": "fx flx",
    "fy": "fy fly",
    "cx": "cx ppx",
    "cy": "cy ppy",
    "fov_x": "cameraanglex",
    "width": "width imagewidth w",
    "height": "height imageheight h",
    "roi": "roi",
    "binning_x": "binningx",
    "binning_y": "binningy",
    **{name: name for name in TERMS},
}
ROLES = {name: role for role, names in _NAMES_OF_ROLE.items() for name in _words(names)}
"""What a name stands for: a new format needs its names here."""
CONTAINERS = _words(
    "intrinsics intrinsic intrinsicparameters distortion distortioncoefficients dist imagesize resolution size"
)
"""Maps whose content belongs to the camera that holds them."""
NERF_SIGNS = frozenset({"flx", "fly", "cameraanglex"})
"""Names that only nerfstudio and instant-ngp use, whose first pixel has its corner at (0, 0)."""
_IGNORED = _words(
    # Uncertainties, other pictures and places of the camera.
    "uncertainty std stddeviation covariance rectificationmatrix rectification projectionmatrix r p rotationmatrix "
    "camrw2c camtw2c tcamimu tcncnm1 timeshiftcamimu camoverlaps transformmatrix header extrinsics "
    "perviewreprojectionerrors extrinsicparameters imagepoints gridpoints "
    # Scales of depth and of the scene.
    "depthscale depthunitscalefactor integerdepthscale aabbscale appliedscale scenescale "
    # Of the calibration, not of the camera.
    "fixaspectratio aspectratio flags boardwidth boardheight squaresize markersize cameraangley orientationoverride "
    "lensposition"
)
_SUSPICIOUS = re.compile(
    r"distort|^dist$|coef|^lens|fisheye|crop|^roi|region|offset|binn|^bin$|scal|skip|zoom|skew|^tau|^xi$|omega|^alpha$"
    r"|decimat|(?:sub|down|up)sampl|resiz|mirror|flip|radial|tangential|prism|rectif|^[kpsdb]\d+$|^kc$|brown|equidist|kannala|^aoi|^pad|^trim|shift"
)
_ONES = re.compile(r"binn|^bin$|scal|skip|zoom|decimat|sampl|resiz")
"""Words whose value 1 changes nothing."""
_TURNS = re.compile(r"rotat|^turn|orientation")
_LENS_WORDS = re.compile(r"fish|equi|kannala|fov|divis|rational", re.IGNORECASE)


def plain_name(key: str) -> str:
    """A name without case and punctuation."""
    return re.sub(r"[^a-z0-9]", "", key.lower())


def is_ignored(key: str, value: Any) -> bool:
    """Whether a part of a file is no part of the camera: extrinsics, uncertainties, arview's records."""
    if key == "lens" and isinstance(value, dict):  # make, model and focal length of a profile
        told = {name: entry for name, entry in value.items() if name != "digital_zoom"}
        return not any(ROLES.get(plain_name(n)) in TERMS | {"terms"} or is_suspicious(n, told[n]) for n in told)
    is_record = key == "calibration" and isinstance(value, dict) and str(value.get("tool", "")).startswith("arview")
    return is_record or plain_name(key) in _IGNORED


def is_suspicious(key: str, value: Any) -> bool:
    """Whether a name that is not known speaks of the lens, a crop, a scale or a turn, with a value that matters."""
    words = re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", key)
    words = [word.lower() for word in words] + [key.lower(), plain_name(key)]
    if _is_nothing(value):
        return False
    if any(_TURNS.search(word) for word in words):
        return isinstance(value, int | float | str)
    if not any(_SUSPICIOUS.search(word) for word in words):
        return False
    return value is True or value != 1 or not any(_ONES.search(word) for word in words)


def is_of_a_camera(key: str, value: Any) -> bool:
    """Whether a name outside a camera's map is one that belongs into it, with a value that matters."""
    if plain_name(key) == "model":  # often that of the device
        return isinstance(value, str) and bool(_LENS_WORDS.search(value))
    return ROLES.get(plain_name(key), "matrix") != "matrix" and not _is_nothing(value)


def _is_nothing(value: Any) -> bool:
    """Whether a value is empty or zero, or holds nothing else."""
    if isinstance(value, dict):
        return all(_is_nothing(item) for item in value.values())
    if isinstance(value, list):
        return all(_is_nothing(item) for item in value)
    return value is None or value == "" or value == 0
