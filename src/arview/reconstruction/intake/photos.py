"""Intake of photo files: they become `Photo`s with a first camera each, and bad ones are rejected with a reason."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from arview.camera import PhotoExif
from arview.core.progress import StepProgress
from arview.errors import ArviewError, InputError, MismatchError
from arview.reconstruction.intake.checks import PhotoCheck, check_photo, same_views, thumbnail
from arview.reconstruction.intake.kept import kept
from arview.reconstruction.intake.lenses import Lens, lenses_of
from arview.reconstruction.intake.reading import RAW_SUFFIXES, Pixels, glance, photo_paths
from arview.reconstruction.types import Photo

BLURRED_PX = 2.0
"""Edge spread (Gaussian sigma) of a blurred photo; sharp ones have 0.3 to 1.2."""
BLURRED_RATIO = 1.8
"""Edge spread of a blurred photo relative to the median photo, to find one shaken photo among sharp ones."""
BLURRED_MIN_PX = 1.3
"""A photo below this is sharp enough, even if it is worse than the others."""
USELESS_PX = 3.5
"""Edge spread at which features can no longer be placed …."""
USELESS_RATIO = 3.0
"""… and, relative to the median photo, at which the photo is not missed."""
MIN_TEXTURED = 0.02
"""Share of tiles with edges; the outline of a plain part gives 0.1."""
CLIPPED = 0.4
"""Share of white pixels of an overexposed photo; a white background gives 0.3."""
CLIPPED_MORE = 0.2
"""Share of white pixels above the median photo's share from which a photo is overexposed."""
DARK_LEVEL = 50.0
"""Grey level that 95 % of a dark photo's pixels do not exceed."""
MIN_SIDE_PX = 320
"""Shorter side; smaller pictures are thumbnails and icons."""
MAX_ASPECT = 2.6
"""Longer over shorter side; more is a panorama, which no pinhole camera took."""

MIN_PHOTOS = 3  # the third photo is the first that can contradict the others
GOOD_NUMBER = "20 to 40 photos from all around the part, each sharing more than half of what it shows with the next"
_FEW_PHOTOS = 8  # with fewer, a warning is given
_NAMES_SHOWN = 5  # names listed in a message


@dataclass(frozen=True)
class Intake:
    """Result of the intake.

    Attributes:
        photos: usable ones, in natural order of their names.
        rejected: (name, reason) of the others.
        warnings: messages about photos that are usable but poor.
        checks: measures of every photo that could be read.
        lenses: of the usable photos, the one with most photos first.
    """

    photos: tuple[Photo, ...]
    rejected: tuple[tuple[str, str], ...]
    warnings: tuple[str, ...]
    checks: tuple[PhotoCheck, ...]
    lenses: tuple[Lens, ...]


@dataclass(frozen=True)
class ReadPhoto:
    """A photo that was read.

    Attributes:
        name: of the photo.
        path: of its file.
        exif: its EXIF data.
        check: its measures.
        thumbnail: reduced grey picture.
    """

    name: str
    path: Path
    exif: PhotoExif
    check: PhotoCheck
    thumbnail: Pixels


def intake_photos(
    source: str | Path | Sequence[str | Path],
    camera: str | Path | None = None,
    progress: StepProgress | None = None,
) -> Intake:
    """Read and check the photos of a folder.

    Rejected, with a reason, are files that cannot be read, thumbnails, panoramas, photos without texture, duplicates,
    photos too blurred for use, and those that the camera file does not fit. Photos that are merely poor are kept with a
    warning. Photos of something else are only found later, when photos are matched.

    Args:
        source: folder, glob, or list of photo files; other files in a folder are ignored.
        camera: camera file, ``fov:DEG`` or, as None, ``exif``; see `lenses_of`.
        progress: called with the number of photos done and in all.

    Raises:
        InputError: there are no photos, fewer than three are usable, most have no texture, or the camera file is
            unusable.
        MismatchError: the camera file fits none of the photos.
    """
    paths, names = photo_paths(source)
    with ThreadPoolExecutor(max(1, min(4, os.cpu_count() or 1))) as pool:
        seen: list[ReadPhoto] = []
        rejected: dict[str, str] = {}
        for done, (name, result) in enumerate(zip(names, pool.map(read_and_check, paths, names), strict=True), 1):
            if isinstance(result, ReadPhoto):
                seen.append(result)
            else:
                rejected[name] = result
            if progress:
                progress(done, len(paths))
    label = str(source) if isinstance(source, str | Path) else f"{len(paths)} files"
    return assess(label, seen, rejected, camera)


def assess(label: str, seen: Sequence[ReadPhoto], rejected: dict[str, str], camera: str | Path | None) -> Intake:
    """Intake of photos that have been read; ``rejected`` holds reasons found so far. Raises as `intake_photos` does."""
    rejected = dict(rejected)
    total = len(seen) + len(rejected)
    for photo in seen:
        reason = _unusable(photo)
        if reason:
            rejected[photo.name] = reason
    _check_texture(label, seen)
    usable = [photo for photo in seen if photo.name not in rejected]
    rejected |= _duplicates(usable)
    usable = [photo for photo in usable if photo.name not in rejected]
    rejected |= _too_blurred(usable)
    usable = [photo for photo in usable if photo.name not in rejected]
    warnings = _exposure_warnings(usable) + _blur_warnings(usable)

    lenses, lens_warnings = lenses_of([photo.exif for photo in usable], camera)
    warnings += lens_warnings
    photos = []
    for photo, lens in zip(usable, lenses, strict=True):
        if isinstance(lens, Lens):
            width, height = photo.exif.upright_size
            photos.append(Photo(photo.name, photo.path, width, height, lens.key, lens.camera, lens.is_calibrated))
        else:
            rejected[photo.name] = str(lens)
    misfits = [lens for lens in lenses if isinstance(lens, MismatchError)]
    if misfits and not photos:
        raise misfits[0]
    _check_number(label, photos, rejected, total)
    used = {photo.lens for photo in photos}
    by_key = {lens.key: lens for lens in lenses if isinstance(lens, Lens) and lens.key in used}
    counts = {key: sum(photo.lens == key for photo in photos) for key in by_key}
    warnings += _number_warnings(photos, counts)
    return Intake(
        photos=tuple(photos),
        rejected=tuple(rejected.items()),
        warnings=tuple(warnings),
        checks=tuple(photo.check for photo in seen),
        lenses=tuple(sorted(by_key.values(), key=lambda lens: -counts[lens.key])),
    )


def read_and_check(path: Path, name: str) -> ReadPhoto | str:
    """The photo as far as the checks need it, or why it cannot be read."""
    return kept(f"check {name}", path, lambda: _read_and_check(path, name))


def _read_and_check(path: Path, name: str) -> ReadPhoto | str:
    if path.suffix.lower() in RAW_SUFFIXES:
        return "is a raw photo; develop it to JPEG, with the same settings for all"
    try:
        seen = glance(path.read_bytes())
    except OSError as error:
        return f"cannot be read: {error.strerror or error}"
    except ArviewError as error:
        return str(error)
    return ReadPhoto(name, path, seen.exif, check_photo(name, seen.gray), thumbnail(seen.gray))


def _unusable(photo: ReadPhoto) -> str:
    """Why a photo is unusable whatever the others are like; empty if it is usable."""
    width, height = photo.exif.upright_size
    check = photo.check
    if min(width, height) < MIN_SIDE_PX:
        return f"has only {width}×{height} px; give the photo itself, not a thumbnail"
    if max(width, height) > MAX_ASPECT * min(width, height):
        return f"is a panorama ({width}×{height} px), which a single camera position cannot show; give plain photos"
    if check.textured >= MIN_TEXTURED:
        return ""
    if check.level_95 < DARK_LEVEL:
        return "is black or nearly black; take it again with more light"
    if check.clipped > CLIPPED:
        return "is overexposed to white; take it again with less light"
    return "shows no texture: a plain surface, or wholly out of focus"


def _check_texture(label: str, seen: Sequence[ReadPhoto]) -> None:
    """Raise InputError when more than half of the photos have no texture."""
    plain = [photo.name for photo in seen if photo.check.textured < MIN_TEXTURED]
    if plain and 2 * len(plain) > len(seen):
        raise InputError(
            f"{label}: {len(plain)} of {len(seen)} photos show no texture at all ({_listed(plain)}), so there is "
            "nothing to match; bring the part itself into view, in focus, on a patterned surface such as newspaper"
        )


def _duplicates(photos: Sequence[ReadPhoto]) -> dict[str, str]:
    """Of photos of the same view, all but the largest and sharpest, each with the reason."""

    def rank(index: int) -> tuple[int, float, int]:
        check = photos[index].check
        size = photos[index].exif.width * photos[index].exif.height
        return -size, check.blur_px if np.isfinite(check.blur_px) else np.inf, index

    dropped: dict[str, str] = {}
    for pair in same_views([photo.thumbnail for photo in photos]):
        best, other = (photos[index].name for index in sorted(pair, key=rank))
        if best not in dropped and other not in dropped:
            dropped[other] = f"shows the same view as {best}; it adds nothing"
    return dropped


def _too_blurred(photos: Sequence[ReadPhoto]) -> dict[str, str]:
    """Photos that are too blurred to be used, with the reason."""
    limit = max(USELESS_PX, USELESS_RATIO * _usual_blur(photos))
    reason = "is too blurred to be used (shaken or out of focus); take it again"
    return {photo.name: reason for photo in photos if photo.check.blur_px > limit}


def _blur_warnings(photos: Sequence[ReadPhoto]) -> list[str]:
    """Warning about blurred photos."""
    worse = max(BLURRED_RATIO * _usual_blur(photos), BLURRED_MIN_PX)
    limit = min(worse, BLURRED_PX)
    # Edges of white areas look soft, so overexposed photos are not checked.
    blurred = [p.name for p in photos if p.check.blur_px > limit and p.check.clipped <= CLIPPED]
    if not blurred:
        return []
    advice = "focus on the part, hold the camera still and give it more light"
    return [f"{_counted(blurred, len(photos), 'blurred')}, out of focus or shaken: {advice}"]


def _usual_blur(photos: Sequence[ReadPhoto]) -> float:
    """Blur of a sharp photo in px, the lowest quarter, so that half of them may be blurred; 0 if none has edges."""
    blurs = [photo.check.blur_px for photo in photos if np.isfinite(photo.check.blur_px)]
    return float(np.quantile(blurs, 0.25)) if blurs else 0.0


def _exposure_warnings(photos: Sequence[ReadPhoto]) -> list[str]:
    """Warnings about overexposed and dark photos."""
    usual = float(np.median([photo.check.clipped for photo in photos])) if photos else 0.0
    limit = min(CLIPPED, usual + CLIPPED_MORE)
    bright = [photo.name for photo in photos if photo.check.clipped > limit]
    dark = [photo.name for photo in photos if photo.check.level_95 < DARK_LEVEL]
    warnings = []
    if bright:
        warnings.append(f"{_counted(bright, len(photos), 'overexposed')}: white areas cannot be measured; expose less")
    if dark:
        warnings.append(f"{_counted(dark, len(photos), 'very dark')}: give the part more light")
    return warnings


def _check_number(label: str, photos: Sequence[Photo], rejected: dict[str, str], total: int) -> None:
    """Raise InputError, with the reasons for rejections, when fewer than MIN_PHOTOS are usable."""
    if len(photos) >= MIN_PHOTOS:
        return
    usable = f"only {len(photos)}" if photos else "none"
    reasons = "; ".join(f"{name} {reason}" for name, reason in list(rejected.items())[:_NAMES_SHOWN])
    more = f"; and {len(rejected) - _NAMES_SHOWN} more" if len(rejected) > _NAMES_SHOWN else ""
    why = f" ({reasons}{more})" if rejected else ""
    raise InputError(
        f"{label}: {usable} of {total} photos can be used{why}; take at least {MIN_PHOTOS}, better {GOOD_NUMBER}"
    )


def _number_warnings(photos: Sequence[Photo], counts: dict[str, int]) -> list[str]:
    """Warnings about too few photos, in all or of one lens."""
    warnings = []
    if len(photos) < _FEW_PHOTOS:
        warnings.append(f"only {len(photos)} photos: the result will have gaps; take {GOOD_NUMBER}")
    for key, count in counts.items():
        if count < MIN_PHOTOS and count < len(photos):
            names = _listed([photo.name for photo in photos if photo.lens == key])
            warnings.append(
                f"{names} differs from the other photos in camera, zoom or size ({key}); with so few photos of it, its "
                "focal length is uncertain; use one camera without zoom, and photos that are not cropped"
            )
    return warnings


def _counted(names: Sequence[str], total: int, state: str) -> str:
    return f"{len(names)} of {total} photos {'is' if len(names) == 1 else 'are'} {state} ({_listed(names)})"


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - _NAMES_SHOWN} more" if len(names) > _NAMES_SHOWN else ""
    return ", ".join(names[:_NAMES_SHOWN]) + more
