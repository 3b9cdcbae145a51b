"""Two interleaved halves of the photos, each adjusted alone, for a measurement that is repeated.

Photos of a real part have no truth. Two halves of a set that are adjusted apart share neither a photo nor an error of
its pose, and their lenses are calibrated apart too. They share the features, the matches (an observation of a point is
that of the whole set), the start of the adjustment and the rough frame.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from arview.core.fits import fit_similarity
from arview.errors import CannotMeasureError
from arview.geometry import Array
from arview.reconstruction.adjustment.bundle import adjust, adjust_with_centre, lens_terms, with_own_lenses
from arview.reconstruction.adjustment.equations import usual_lenses, with_covariance
from arview.reconstruction.colmap import import_pycolmap, read_reconstruction, sparse_model_of
from arview.reconstruction.groups import MIN_SHARED_POINTS, linked_groups
from arview.reconstruction.sparse import MAX_ERROR_PX, MIN_ANGLE_DEG, SparseOptions
from arview.reconstruction.types import Photo, PosedPhoto, SparseModel

MIN_PHOTOS = 16
"""Placed photos that can be halved; fewer than eight in a half leave gaps that the whole set does not have."""


@dataclass(frozen=True)
class HalvesOptions:
    """How the halves of a set are adjusted."""

    sparse: SparseOptions = field(default_factory=SparseOptions)


def halves_of(folder: Path, sparse: SparseModel, options: HalvesOptions | None = None) -> tuple[SparseModel, ...]:
    """The even and the odd photos of a model, in the order in which they were taken, in frame and unit of ``sparse``.

    Args:
        folder: of the whole model in COLMAP's format, in any unit.
        sparse: the whole model.
        options: see `HalvesOptions`.

    Raises:
        CannotMeasureError: there are too few photos, or those of a half are not placed without the others.
    """
    options = options or HalvesOptions()
    if len(sparse.photos) < MIN_PHOTOS:
        raise CannotMeasureError(f"{len(sparse.photos)} photos are too few to be halved ({MIN_PHOTOS} needed)")
    return tuple(adjusted_alone(folder, sparse, sparse.photos[first::2], options.sparse) for first in (0, 1))


def adjusted_alone(
    folder: Path, whole: SparseModel, photos: Sequence[PosedPhoto], options: SparseOptions | None = None
) -> SparseModel:
    """The model of some of the photos, adjusted without the others, in frame and unit of the whole one.

    Args:
        folder: of the whole model in COLMAP's format, in any unit.
        whole: the whole model.
        photos: some of its photos.
        options: of the adjustment.

    Raises:
        CannotMeasureError: they are not placed without the others.
    """
    options = options or SparseOptions()
    named = f"{len(photos)} of the photos ({', '.join(photo.name for photo in photos[:2])}, …)"
    pycolmap = import_pycolmap()
    model = read_reconstruction(folder)
    names = {photo.name for photo in photos}
    for image_id in list(model.reg_image_ids()):
        if model.images[image_id].name not in names:
            model.deregister_frame(model.images[image_id].frame_id)
    model.tear_down()
    listed = [_listed(photo) for photo in photos]
    threads = options.threads or os.cpu_count() or 1
    refines_centre = adjust_with_centre(model, threads)
    pycolmap.ObservationManager(model).filter_all_points3D(MAX_ERROR_PX, MIN_ANGLE_DEG)
    if len(model.points3D) < MIN_SHARED_POINTS:
        raise CannotMeasureError(f"{named} share too few points")
    adjust(model, threads, refines_centre=refines_centre)
    sparse = sparse_model_of(model, listed)
    if whole.lens_stds is not None:
        sparse = with_own_lenses(model, listed, usual_lenses(whole.photos))
    sparse = with_covariance(sparse, lens_terms(model, sparse, refines_centre))
    if len(linked_groups(sparse)) > 1:
        raise CannotMeasureError(f"{named} are not placed without the others")
    return sparse.transformed(*onto(sparse, whole))


def _listed(photo: PosedPhoto) -> Photo:
    """A placed photo as a photo of intake; its camera is that of the model."""
    return Photo(photo.name, photo.path, photo.camera.width, photo.camera.height, "", photo.camera, mask=photo.mask)


def onto(sparse: SparseModel, whole: SparseModel) -> tuple[float, Array]:
    """Scale and rigid motion (4,4) that bring a model onto another one, by the centres of the photos of both."""
    target = {photo.name: photo.centre_in_scan for photo in whole.photos}
    common = [photo for photo in sparse.photos if photo.name in target]
    ours = np.array([photo.centre_in_scan for photo in common])
    theirs = np.array([target[photo.name] for photo in common])
    return fit_similarity(ours, theirs)
