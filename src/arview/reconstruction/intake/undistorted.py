"""Photos of lenses that reconstruction does not know, as photos of a pinhole camera."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from arview.camera import FrameView, UndistortOptions
from arview.core.atomic import write_file
from arview.core.progress import StepProgress
from arview.reconstruction.intake.masks import read_mask
from arview.reconstruction.intake.photos import Intake
from arview.reconstruction.intake.reading import read_photo
from arview.reconstruction.types import Photo

UNDISTORT = UndistortOptions(max_growth=1.5, min_scale=0.5)
"""Photos are large already, so that they grow less than frames."""


def undistort_photos(intake: Intake, folder: Path, progress: StepProgress | None = None) -> Intake:
    """The intake with undistorted copies of those photos whose lens Brown's terms do not describe.

    Args:
        intake: of the photos.
        folder: where the copies are written, as upright PNG; made when there are any.
        progress: called with the number of photos done and in all.

    Raises:
        OutputError: a copy cannot be written.
    """
    views: dict[str, FrameView] = {}
    photos = []
    for index, photo in enumerate(intake.photos):
        if photo.camera.lens is not None:
            if photo.lens not in views:
                views[photo.lens] = FrameView(photo.camera, UNDISTORT)
            photo = _copied(photo, views[photo.lens], folder / f"{index:04d}.png", index)
        photos.append(photo)
        if progress and views:
            progress(index + 1, len(intake.photos))
    return replace(intake, photos=tuple(photos)) if views else intake


def _copied(photo: Photo, view: FrameView, path: Path, index: int) -> Photo:
    camera = view.tracked_camera
    if not view.is_resampling:
        return replace(photo, camera=camera)
    picture = view.picture(read_photo(photo.path), index)
    _, png = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    write_file(path, png.tobytes(), makes_folder=True)
    mask = None if photo.mask is None else _copied_mask(photo, view, path.with_suffix(".mask.png"))
    return replace(photo, path=path, width=camera.width, height=camera.height, camera=camera, mask=mask)


def _copied_mask(photo: Photo, view: FrameView, path: Path) -> Path:
    """The photo's mask, undistorted like the photo."""
    mask = read_mask(photo)
    assert mask is not None
    grey = view.picture(np.repeat(np.where(mask, 255, 0).astype(np.uint8)[..., None], 3, axis=2), -1)
    cv2.imwrite(str(path), np.where(grey[..., 0] > 127, 255, 0).astype(np.uint8))
    return path
