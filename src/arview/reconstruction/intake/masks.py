"""Masks of photos: which pixels belong to the part, and not to a background that moves against it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.errors import InputError
from arview.reconstruction.intake.photos import Intake
from arview.reconstruction.types import Photo

_MAX_STRETCH = 0.02
"""Relative difference of aspect ratio up to which a mask of another size is scaled to its photo."""


def with_masks(intake: Intake, folder: str | Path) -> Intake:
    """The intake with the mask of each photo that has one.

    Masks follow COLMAP's convention: the mask of ``a/img.jpg`` is ``a/img.jpg.png`` below the folder, black where
    nothing is to be used. ``a/img.png`` is taken too. They are of the size of the upright photo, or scaled to it.

    Raises:
        InputError: there is no such folder, no photo has a mask, or a mask cannot be read or has another shape.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give the folder of the masks")
    photos = [replace(photo, mask=_mask_path(folder, photo.name)) for photo in intake.photos]
    masked = [photo for photo in photos if photo.mask is not None]
    if not masked:
        name = photos[0].name
        raise InputError(f"{folder}: no mask belongs to a photo; the mask of {name} must be named {name}.png")
    for photo in masked:
        read_mask(photo)
    missing = len(photos) - len(masked)
    warnings = (f"{missing} of {len(photos)} photos have no mask in {folder}; they are used whole",) if missing else ()
    return replace(intake, photos=tuple(photos), warnings=(*intake.warnings, *warnings))


def _mask_path(folder: Path, name: str) -> Path | None:
    candidates = (folder / f"{name}.png", (folder / name).with_suffix(".png"))
    return next((path for path in candidates if path.is_file()), None)


def read_mask(photo: Photo) -> NDArray[np.bool_] | None:
    """(H,W) True where the photo may be used; None if it has no mask.

    Raises:
        InputError: the mask cannot be read, has another shape than the photo, or leaves nothing.
    """
    if photo.mask is None:
        return None
    return mask_of(photo.mask, photo.width, photo.height)


def mask_of(path: Path, width: int, height: int) -> NDArray[np.bool_]:
    """(H,W) mask in a file for a photo of some size. Raises InputError as `read_mask` does."""
    data = np.fromfile(path, np.uint8) if path.is_file() else np.zeros(0, np.uint8)
    grey = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if len(data) else None
    if grey is None:
        raise InputError(f"{path}: is not a picture; masks are PNG files, black where nothing is to be used")
    rows, columns = grey.shape
    if abs(np.log((columns / rows) / (width / height))) > _MAX_STRETCH:
        raise InputError(
            f"{path}: the mask has {columns}×{rows} px, its photo {width}×{height}; a mask must be upright and of the "
            "photo's shape"
        )
    if (columns, rows) != (width, height):
        grey = cv2.resize(grey, (width, height), interpolation=cv2.INTER_NEAREST)
    mask = np.asarray(grey > 0)
    if not mask.any():
        raise InputError(f"{path}: the mask is black everywhere, so that nothing of the photo is left")
    return mask
