"""Bundle adjustment of COLMAP's models: common lenses, principal points that are significant, a lens for each photo."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from arview.camera import Camera
from arview.reconstruction.adjustment.covariance import LOSS_PX, noise_variance_of
from arview.reconstruction.adjustment.equations import LensTerms, focal_groups, with_lens_per_photo
from arview.reconstruction.colmap import CALIBRATED_MODEL, import_pycolmap, sparse_model_of, update_model
from arview.reconstruction.groups import named
from arview.reconstruction.types import Photo, SparseModel

MIN_CENTRE_MOVE = 0.001
"""Moves of the principal point, as a share of the longer side; smaller ones are not significant …."""
MAX_CENTRE_MOVE = 0.05
"""… and larger ones mean that the views do not determine it."""
MIXED_PX = 0.3
"""Noise of the features above which photos of two lenses may have been taken for one; good photos have 0.2."""
ZOOM_WORD = ", zoom "
"""In the name of a lens that was told from another one by its focal length."""


def adjust(model: Any, threads: int, refines_centre: bool, iterations: int = 25, tolerance: float = 1e-7) -> None:
    """Bundle adjustment in place: poses, points, and the intrinsics of lenses that are not calibrated.

    It ends after ``iterations``, or when the cost decreases by less than the share ``tolerance`` in one.
    """
    pycolmap = import_pycolmap()
    options = pycolmap.BundleAdjustmentOptions(print_summary=False, refine_principal_point=refines_centre)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = LOSS_PX
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.max_num_iterations = iterations
    options.ceres.solver_options.function_tolerance = tolerance
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    for camera in model.cameras.values():
        if not _is_refined(camera):
            config.set_constant_cam_intrinsics(camera.camera_id)
    pycolmap.create_default_ceres_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()


def adjust_with_centre(model: Any, threads: int) -> bool:
    """Adjust everything including the principal points, and restore those that moved less than their uncertainty.

    Returns whether the principal points are to be refined from here on. Correlated errors of features move a principal
    point by half a pixel on good photos, and the focal length with it, so a small move is not significant.
    """
    before = {key: np.array(camera.params[1:3]) for key, camera in model.cameras.items() if _is_refined(camera)}
    adjust(model, threads, refines_centre=True, iterations=12)
    moved = [float(np.abs(model.cameras[key].params[1:3] - centre).max()) for key, centre in before.items()]
    sizes = [max(model.cameras[key].width, model.cameras[key].height) for key in before]
    if any(MIN_CENTRE_MOVE < move / size < MAX_CENTRE_MOVE for move, size in zip(moved, sizes, strict=True)):
        return True
    for key, centre in before.items():
        model.cameras[key].params = np.concatenate(
            [model.cameras[key].params[:1], centre, model.cameras[key].params[3:]]
        )
    return False


def lens_terms(model: Any, sparse: SparseModel, refines_centre: bool) -> LensTerms:
    """Which terms of the lenses of ``sparse``, a model of COLMAP's, are common unknowns."""
    camera_of = {image.name: model.cameras[image.camera_id] for image in model.images.values()}
    cameras = [camera_of[photo.name] for photo in sparse.photos]
    refined = sorted({camera.camera_id for camera in cameras if _is_refined(camera)})
    numbers = [refined.index(camera.camera_id) if _is_refined(camera) else -1 for camera in cameras]
    return LensTerms(np.array(numbers, dtype=np.int64), refines_centre)


def with_own_lenses(model: Any, photos: Sequence[Photo], usual: Mapping[str, Camera]) -> SparseModel:
    """A model of COLMAP's with a lens for each photo, adjusted with all of them; also in place.

    Args:
        model: whose photos have a camera each.
        photos: of it.
        usual: the lens around which each one changes, by the name of the photo.
    """
    start = sparse_model_of(model, photos)
    cameras = [usual[photo.name] for photo in start.photos]
    sparse = with_lens_per_photo(start, lens_terms(model, start, False), cameras) or start
    update_model(model, sparse)
    return sparse


def _is_refined(camera: Any) -> bool:
    return bool(camera.model.name != CALIBRATED_MODEL)


def photos_of_two_lenses(
    sparse: SparseModel, terms: LensTerms, photos: Sequence[Photo]
) -> tuple[list[Photo], str] | None:
    """The photos with two lenses where they were taken to be of one, and what is said of that; None where it is one."""
    if noise_variance_of(sparse) < MIXED_PX**2 or any(ZOOM_WORD in photo.lens for photo in photos):
        return None
    found = focal_groups(sparse, terms)
    if found is None:
        return None
    groups, focals = found
    group_of = {photo.name: one for photo, one in zip(sparse.photos, groups, strict=True)}
    most = int(2 * sum(groups) > len(groups))  # for photos that were not placed
    split = []
    for photo in photos:
        group = group_of.get(photo.name, most)
        camera = replace(photo.camera, fx=focals[group], fy=focals[group])
        split.append(replace(photo, lens=f"{photo.lens}{ZOOM_WORD}{group + 1}", camera=camera))
    listed = [named([name for name, one in group_of.items() if one == group], 4) for group in (0, 1)]
    return split, (
        f"the photos are of two lenses or zooms: about {focals[0]:.0f} px ({listed[0]}) and {focals[1]:.0f} px "
        f"({listed[1]}); each is calibrated by itself, which is less certain: take all photos with one lens"
    )
