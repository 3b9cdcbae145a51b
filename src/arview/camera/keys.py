"""Names that camera files use. They are compared without case and without anything but letters and digits."""

from __future__ import annotations

import re
from typing import Any

MATRIX = frozenset({"cameramatrix", "intrinsicmatrix", "camk", "k", "mtx"})
DIST = frozenset(
    {
        "distortioncoefficients",
        "distcoeffs",
        "distcoeff",
        "distcoefs",
        "distortion",
        "dist",
        "d",
        "distortioncoeffs",
        "distortioncoeff",
        "distortionparams",
        "distortionparameters",
        "coeffs",
    }
)
MODEL = frozenset({"distortionmodel", "distortiontype", "cameramodel", "cameratype", "lensmodel", "model"})
FISHEYE_SWITCHES = frozenset({"fisheyemodel", "isfisheye", "fisheye"})
SIZE = frozenset({"imagesize", "imgsize", "size", "resolution"})
CONTAINERS = frozenset(
    {
        "intrinsics",
        "intrinsic",
        "intrinsicparameters",
        "distortion",
        "distortioncoefficients",
        "dist",
        "imagesize",
        "resolution",
        "size",
    }
)
"""Maps whose content belongs to the camera that holds them."""
NUMBERS = {
    "fx": "fx",
    "fy": "fy",
    "cx": "cx",
    "cy": "cy",
    "ppx": "cx",
    "ppy": "cy",
    "flx": "fx",
    "fly": "fy",
    "cameraanglex": "fov_x",
    "width": "width",
    "height": "height",
    "imagewidth": "width",
    "imageheight": "height",
    "w": "width",
    "h": "height",
}
NERF_SIGNS = frozenset({"flx", "fly", "cameraanglex"})
"""Names that only nerfstudio and instant-ngp use, whose first pixel has its corner at (0, 0)."""
TERMS = {
    name: name
    for name in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s1", "s2", "s3", "s4", "tauy", "taux", "omega", "xi")
}
IGNORED = frozenset(
    {
        # Uncertainties, other pictures and places of the camera.
        "uncertainty",
        "std",
        "stddeviation",
        "covariance",
        "rectificationmatrix",
        "rectification",
        "projectionmatrix",
        "r",
        "p",
        "rotationmatrix",
        "camrw2c",
        "camtw2c",
        "tcamimu",
        "tcncnm1",
        "timeshiftcamimu",
        "camoverlaps",
        "transformmatrix",
        "header",
        "extrinsics",
        "perviewreprojectionerrors",
        "extrinsicparameters",
        "imagepoints",
        "gridpoints",
        # Scales of depth and of the scene.
        "depthscale",
        "depthunitscalefactor",
        "integerdepthscale",
        "aabbscale",
        "appliedscale",
        "scenescale",
        # Of the calibration, not of the camera.
        "fixaspectratio",
        "aspectratio",
        "flags",
        "boardwidth",
        "boardheight",
        "squaresize",
        "markersize",
        "cameraangley",
        "orientationoverride",
        "lensposition",
    }
)
_SUSPICIOUS = re.compile(
    r"distort|^dist$|coef|^lens|fisheye|crop|^roi|region|offset|binn|^bin$|scal|skip|zoom|skew|^tau|^xi$|omega|^alpha$"
    r"|decimat|(?:sub|down|up)sampl|resiz|mirror|flip|radial|tangential|prism|rectif|^[kpsdb]\d+$|^kc$|brown|equidist|kannala|^aoi|^pad|^trim|shift"
)
_ONES = re.compile(r"binn|^bin$|scal|skip|zoom|decimat|sampl|resiz")
"""Words whose value 1 changes nothing."""
_TURNS = re.compile(r"rotat|^turn|orientation")


def plain_name(key: str) -> str:
    """A name without case and punctuation."""
    return re.sub(r"[^a-z0-9]", "", key.lower())


def is_suspicious(key: str, value: Any) -> bool:
    """Whether a name that is not known speaks of the lens, a crop, a scale or a turn, with a value that matters."""
    words = re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", key)
    words = [word.lower() for word in words] + [key.lower(), plain_name(key)]
    if value is None or value == "" or value is False or _is_zero(value):
        return False
    if any(_TURNS.search(word) for word in words):
        return isinstance(value, int | float | str)
    if not any(_SUSPICIOUS.search(word) for word in words):
        return False
    is_one = isinstance(value, int | float) and not isinstance(value, bool) and value == 1
    return not (is_one and any(_ONES.search(word) for word in words))


def _is_zero(value: Any) -> bool:
    """Whether a value is zero, or holds nothing else."""
    if isinstance(value, dict):
        return all(_is_zero(item) for item in value.values())
    if isinstance(value, list):
        return all(_is_zero(item) for item in value)
    return isinstance(value, int | float) and value == 0


def is_distortion(key: str) -> bool:
    """Whether a name is that of distortion terms."""
    return plain_name(key) in DIST | TERMS.keys()


def is_of_a_camera(key: str, value: Any) -> bool:
    """Whether a name outside a camera's map is one that belongs into it, with a value that matters."""
    name = plain_name(key)
    if name == "model":  # often that of the device
        return isinstance(value, str) and bool(re.search(r"fish|equi|kannala|fov|divis|rational", value, re.IGNORECASE))
    tables = (DIST, MODEL, FISHEYE_SWITCHES, SIZE, NUMBERS, TERMS, ("roi", "binningx", "binningy"))
    return any(name in table for table in tables) and value not in (None, "", False) and not _is_zero(value)
