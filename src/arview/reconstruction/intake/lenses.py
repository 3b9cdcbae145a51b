"""The first camera of every photo, and which photos share it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from arview.camera import Camera, PhotoExif, brown_camera, focal_length_px, guess_camera, load_camera, profile_of_photo
from arview.errors import MismatchError

_FOCAL_ROUNDING_MM = 0.055  # focal lengths are written in tenths of a millimetre, or finer
_EQUIVALENT_ROUNDING_MM = 0.5  # the 35 mm equivalent is written in whole millimetres
_ZOOM_TOLERANCE = 0.01  # relative difference of digital zooms that count as equal
_FOCAL_DISAGREES = 0.15  # log ratio: EXIF focal lengths are right within a few per cent; more is another zoom


@dataclass(frozen=True)
class Lens:
    """One lens at one zoom and picture size, whose photos share their intrinsics.

    Portrait and landscape photos of one phone are two lenses here, because their upright pictures have different
    cameras; `share_lenses` joins them.

    Attributes:
        key: unique and readable ("iPhone 12 4.2 mm 4032×3024").
        camera: initial intrinsics, upright.
        is_calibrated: the camera is a calibration, which self-calibration must not change.
        focal_from: where the focal length came from, for messages.
    """

    key: str
    camera: Camera
    is_calibrated: bool
    focal_from: str


def lenses_of(exifs: Sequence[PhotoExif], camera: str | Path | None) -> tuple[list[Lens | MismatchError], list[str]]:
    """The lens of each photo, or why the given camera does not fit it; and warnings.

    Photos share a lens when make, model, focal lengths (within the rounding of EXIF), digital zoom, upright size and,
    where known, the serial number agree; without EXIF data, when their sizes agree. Calibrated lenses are also
    distinguished by orientation, because rotation moves the principal point. The focal length comes from ``camera``,
    else the 35 mm equivalent, else the focal length and the sensor's width, else it is 1.2 × the longer side.

    Args:
        exifs: of the photos.
        camera: camera file, ``profile`` or ``fov:DEG`` as for `load_camera`; None or ``exif`` to use EXIF data.

    Raises:
        InputError: the camera file cannot be used at all.
    """
    is_file = camera is not None and str(camera) != "exif" and not str(camera).startswith("fov:")
    firsts: list[PhotoExif] = []
    lenses: list[Lens | MismatchError] = []
    index_of_photo: list[int] = []
    warnings: list[str] = []
    for exif in exifs:
        index = next((i for i, first in enumerate(firsts) if _same_lens(exif, first, is_file)), len(firsts))
        if index == len(firsts):
            firsts.append(exif)
            try:
                lenses.append(_new_lens(exif, camera, is_file, [lens.key for lens in lenses if isinstance(lens, Lens)]))
            except MismatchError as error:
                lenses.append(error)
        index_of_photo.append(index)
    if is_file:
        warnings += [
            f"photos of {lens.key} are upright without an EXIF orientation; the calibration, rotated by 90°, is only "
            "their initial guess"
            if lens.camera.is_distorted
            else f"{lens.focal_from} has no terms for the distortion of the lens, so it is only an initial guess for "
            f"the photos of {lens.key}; calibrate the camera with `arview calibrate lens`"
            for lens in lenses
            if isinstance(lens, Lens) and not lens.is_calibrated
        ]
        warnings += [
            f"{lens.focal_from}: {lens.camera.doubt}" for lens in lenses if isinstance(lens, Lens) and lens.camera.doubt
        ]
        warnings += _drop_calibration_of_other_zooms(lenses, firsts)
    return [lenses[index] for index in index_of_photo], warnings


def _same_lens(a: PhotoExif, b: PhotoExif, turns_matter: bool) -> bool:
    """Whether two photos share a lens; ``turns_matter`` distinguishes orientations."""

    def close(x: float | None, y: float | None, tolerance: float) -> bool:
        return x is y if x is None or y is None else abs(x - y) <= tolerance + 1e-9

    return (
        a.upright_size == b.upright_size
        and (a.quarter_turns_clockwise == b.quarter_turns_clockwise or not turns_matter)
        and (a.make.lower(), a.model.lower()) == (b.make.lower(), b.model.lower())
        and (a.serial == b.serial or not a.serial or not b.serial)
        and close(a.focal_length_mm, b.focal_length_mm, _FOCAL_ROUNDING_MM)
        and close(a.focal_length_35mm_mm, b.focal_length_35mm_mm, _EQUIVALENT_ROUNDING_MM)
        and close(a.digital_zoom, b.digital_zoom, _ZOOM_TOLERANCE * a.digital_zoom)
    )


def _new_lens(exif: PhotoExif, camera: str | Path | None, is_file: bool, taken: Sequence[str]) -> Lens:
    """The lens of a photo that shares no earlier one. Raises MismatchError when the camera does not fit it."""
    width, height = exif.upright_size
    focal = f"{exif.focal_length_mm:.1f} mm" if exif.focal_length_mm else ""
    equivalent = f"({exif.focal_length_35mm_mm:g} mm equivalent)" if exif.focal_length_35mm_mm else ""
    name = " ".join(word for word in (exif.model or exif.make, focal, equivalent, f"{width}×{height}") if word)
    key = next(key for n in range(1, len(taken) + 2) if (key := name if n == 1 else f"{name} #{n}") not in taken)
    if camera is None or str(camera) == "exif":
        return _lens_from_exif(key, exif)
    if not is_file:
        return Lens(key, load_camera(camera, width, height), False, f"the given {camera}")
    if str(camera) == "profile":
        camera = profile_of_photo(exif)
    turns = exif.quarter_turns_clockwise
    try:
        found = load_camera(camera, width, height, quarter_turns_clockwise=turns)
        own = brown_camera(found) or found
        # Every lens distorts a little: without terms for it, the file is a guess and no calibration.
        return Lens(key, own, own.is_distorted, str(camera))
    except MismatchError:
        if turns % 2:
            raise
        # The pixels are upright without an EXIF orientation, so the direction of the camera's rotation is unknown: the
        # principal point may be mirrored, and the calibration is only an initial guess.
        turned = load_camera(camera, width, height, quarter_turns_clockwise=1)
        return Lens(key, brown_camera(turned) or turned, False, f"{camera}, rotated by 90°")


def _lens_from_exif(key: str, exif: PhotoExif) -> Lens:
    """A lens with the focal length of the EXIF data, or a guess."""
    width, height = exif.upright_size
    guess = guess_camera(width, height)
    focal_px = focal_length_px(exif, width, height)
    if focal_px is None:
        return Lens(key, guess, False, "a guess: 1.2 × the longer side")
    source = "the 35 mm equivalent" if exif.focal_length_35mm_mm else "the focal length and the sensor's width"
    return Lens(key, replace(guess, fx=focal_px, fy=focal_px), False, source)


def _drop_calibration_of_other_zooms(lenses: list[Lens | MismatchError], firsts: Sequence[PhotoExif]) -> list[str]:
    """Replace the calibration of lenses whose EXIF gives another zoom, if it fits other lenses; return warnings."""
    off = {}
    for index, (lens, exif) in enumerate(zip(lenses, firsts, strict=True)):
        focal_px = focal_length_px(exif, *exif.upright_size)
        if isinstance(lens, Lens) and focal_px is not None:
            off[index] = abs(math.log(focal_px / lens.camera.fx))
    warnings = []
    for index, disagreement in off.items():
        lens = lenses[index]
        if isinstance(lens, Lens) and disagreement > _FOCAL_DISAGREES >= min(off.values()):
            own = _lens_from_exif(lens.key, firsts[index])
            lenses[index] = own
            warnings.append(
                f"photos of {lens.key}: the focal length is {own.camera.fx:.0f} px in their EXIF data, but "
                f"{lens.camera.fx:.0f} px in the camera file, so the zoom differs; they are calibrated anew"
            )
        elif isinstance(lens, Lens) and disagreement > _FOCAL_DISAGREES:
            warnings.append(
                f"the camera file gives a focal length of {lens.camera.fx:.0f} px, the EXIF data of {lens.key} a "
                "different one; check that the camera file belongs to these photos"
            )
    return warnings
