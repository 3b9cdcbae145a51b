"""The lens that a file means: its model by any of the names in use, and its terms, as a list or one by one."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from enum import StrEnum

from arview.camera.lens import TERM_NAMES, LensDistortion, LensModel
from arview.errors import InputError

SUPPORTED = (
    "pinhole, Brown (plumb_bob, radtan, brown_conrady, inverse_brown_conrady), rational_polynomial, fisheye "
    "(equidistant), thin_prism_fisheye, fov, division"
)
"""Lens models for messages, by their common names."""


class _Kind(StrEnum):
    """What a model's name says of the terms."""

    ANY = "any"  # pinhole: the terms, if any, are OpenCV's
    NONE = "none"
    BROWN = "brown"
    OPENCV = "opencv"  # as many terms as there are
    SKEWED_BROWN = "skewed brown"  # Brown but for the tangential terms
    INVERSE_BROWN = "inverse brown"
    FISHEYE = "fisheye"
    FOV = "fov"
    DIVISION = "division"
    THIN_PRISM_FISHEYE = "fisheye with thin prism"


_KINDS = {
    _Kind.ANY: ("", "pinhole", "simplepinhole", "perspective", "opencv", "fullopencv", "standard", "rectified"),
    _Kind.NONE: ("none", "nodistortion"),
    _Kind.BROWN: (
        "plumbbob",
        "radtan",
        "radialtangential",
        "brownconrady",
        "brown",
        "simpleradial",
        "radial",
        "pinholeradtan",
    ),
    _Kind.OPENCV: ("rationalpolynomial", "rational", "thinprism"),
    _Kind.SKEWED_BROWN: ("modifiedbrownconrady",),
    _Kind.INVERSE_BROWN: ("inversebrownconrady", "inversebrown"),
    _Kind.THIN_PRISM_FISHEYE: ("thinprismfisheye",),
    _Kind.FISHEYE: (
        "equidistant",
        "equi",
        "fisheye",
        "opencvfisheye",
        "kannalabrandt",
        "kannalabrandt4",
        "kannalabrandt8",
        "kb4",
        "simplefisheye",
        "simpleradialfisheye",
        "radialfisheye",
        "pinholeequi",
    ),
    _Kind.FOV: ("fov", "ftheta", "pinholefov"),
    _Kind.DIVISION: ("division", "simpledivision"),
}
_KIND_OF_NAME = {name: kind for kind, names in _KINDS.items() for name in names}
_LENS_OF_KIND = {
    _Kind.FISHEYE: LensModel.FISHEYE,
    _Kind.FOV: LensModel.FOV,
    _Kind.DIVISION: LensModel.DIVISION,
    _Kind.THIN_PRISM_FISHEYE: LensModel.THIN_PRISM_FISHEYE,
    _Kind.INVERSE_BROWN: LensModel.INVERSE_BROWN,
}
_OPENCV_COUNTS = (0, 1, 2, 4, 5, 8, 12, 14)
"""Lengths of a list of OpenCV's terms; the last two of 14 tilt the sensor."""
_BROWN_TERMS = 5


def lens_from_terms(
    models: Sequence[str], listed: Sequence[float] | None, named: Mapping[str, float]
) -> tuple[tuple[float, ...], LensDistortion | None]:
    """Brown's five terms, or the lens, see `simplest`.

    Args:
        models: names of the model that the file gives, for example ``pinhole`` and ``equidistant``.
        listed: terms as a list, or None.
        named: terms one by one, for example ``k1``.

    Raises:
        InputError: a model that is not supported, models that contradict each other, or terms the model does not have.
    """
    kind, name = _kind_of(models)
    model = _LENS_OF_KIND.get(kind, LensModel.RATIONAL)
    if kind is _Kind.ANY and {"k3", "k4"} & {key for key in named if named[key]} and not {"p1", "p2"} & set(named):
        raise InputError("k3 or k4 without p1 and p2: fisheye or Brown? Name the lens model (camera_model)")
    if model is not LensModel.RATIONAL and not listed and not named:
        raise InputError(f"no distortion terms for lens model {name}; add {' '.join(TERM_NAMES[model])}")
    terms = _from_names(named, model, name) if named else None
    if listed is not None:
        from_list = _from_list(listed, kind, model, name)
        if terms is not None and _padded(terms, 12) != _padded(from_list, 12):
            raise InputError("two sets of distortion terms that differ, as a list and one by one; keep one of them")
        terms = from_list
    terms = terms or ()
    _check_kind(kind, terms, name)
    return simplest(LensDistortion(model, tuple(terms)))


def simplest(lens: LensDistortion) -> tuple[tuple[float, ...], LensDistortion | None]:
    """Brown's five terms and no lens where the lens is of that kind, else no terms and the lens."""
    none = (0.0,) * _BROWN_TERMS
    if lens.model is LensModel.RATIONAL:
        return (none, lens) if any(lens.terms[_BROWN_TERMS:]) else (lens.terms[:_BROWN_TERMS], None)
    if lens.model is LensModel.THIN_PRISM_FISHEYE and not any(lens.terms[i] for i in (2, 3, 6, 7)):
        return none, LensDistortion(LensModel.FISHEYE, tuple(lens.terms[i] for i in (0, 1, 4, 5)))
    if lens.model in (LensModel.FOV, LensModel.DIVISION, LensModel.INVERSE_BROWN) and not any(lens.terms):
        return none, None
    return none, lens


def _kind_of(models: Sequence[str]) -> tuple[_Kind, str]:
    """The kind that the names of a model say, and the name that says it."""
    kinds: dict[_Kind, str] = {}
    for name in models:
        plain = re.sub(r"[^a-z0-9]", "", name.lower())
        plain = plain.removeprefix("rs2").removeprefix("distortion")
        kind = _KIND_OF_NAME.get(plain)
        if kind is None:
            raise InputError(f"lens model '{name[:40]}' is not supported; expected {SUPPORTED}")
        kinds.setdefault(kind, name)
    stated = {kind: name for kind, name in kinds.items() if kind is not _Kind.ANY}
    if len(stated) > 1:
        raise InputError(f"lens models that contradict each other: {', '.join(stated.values())}; keep one of them")
    return next(iter(stated.items()), (_Kind.ANY, next(iter(kinds.values()), "")))


def _from_names(named: Mapping[str, float], model: LensModel, name: str) -> tuple[float, ...]:
    names = TERM_NAMES[model]
    for key, value in named.items():
        if key not in names and value != 0.0:
            of = f" of lens model {name or 'OpenCV'}"
            raise InputError(f"{key} is {value:g}, which is not a term{of} ({' '.join(names)}); correct the file")
    return tuple(named.get(key, 0.0) for key in names)


def _from_list(listed: Sequence[float], kind: _Kind, model: LensModel, name: str) -> tuple[float, ...]:
    count = len(TERM_NAMES[model])
    if model is LensModel.RATIONAL and len(listed) not in _OPENCV_COUNTS and any(listed):
        raise InputError(f"{len(listed)} distortion terms; expected 4, 5, 8 or 12, as OpenCV has them")
    if any(listed[count:]):
        what = "a tilted sensor" if model is LensModel.RATIONAL else f"lens model {name} with more than {count} terms"
        raise InputError(f"{len(listed)} distortion terms: {what} is not supported; calibrate without")
    if kind is _Kind.BROWN and any(listed[_BROWN_TERMS:]):
        raise InputError(
            f"{len(listed)} distortion terms, but {name} has only k1 k2 p1 p2 k3; is it another lens model?"
        )
    return tuple(listed[:count])


def _check_kind(kind: _Kind, terms: Sequence[float], name: str) -> None:
    """Raise InputError for terms that a model does not have, or has in another sense than OpenCV."""
    if kind is _Kind.NONE and any(terms):
        raise InputError(f"lens model {name}, but distortion terms that are not zero; correct one of them")
    if kind is _Kind.BROWN and any(terms[_BROWN_TERMS:]):
        raise InputError(f"{name} has only k1 k2 p1 p2 k3, but the file gives further terms; is it another lens model?")
    if kind is _Kind.SKEWED_BROWN and any(terms[2:4]):
        raise InputError(f"lens model {name} with tangential terms is not supported; calibrate with OpenCV")


def _padded(terms: Sequence[float], count: int) -> tuple[float, ...]:
    return tuple(terms) + (0.0,) * (count - len(terms))
