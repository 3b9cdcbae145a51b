"""Structure from motion: where each photo was taken from, and the intrinsics of its lens.

Two passes. The strongest features of every photo are matched by appearance and give the poses (COLMAP's incremental
mapper, Schönberger and Frahm 2016). With the poses known, all features are matched again along the epipolar lines,
which costs little and finds many more partners; the points are triangulated anew and everything is adjusted
together (Triggs et al. 2000).
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from arview.camera import Camera
from arview.core.progress import Progress
from arview.errors import CannotMeasureError
from arview.geometry import Array, invert, skew
from arview.reconstruction.adjustment.bundle import (
    adjust,
    adjust_with_centre,
    lens_terms,
    photos_of_two_lenses,
    with_own_lenses,
)
from arview.reconstruction.adjustment.equations import (
    LensTerms,
    with_covariance,
    with_lens_per_photo,
)
from arview.reconstruction.colmap import (
    CALIBRATED_MODEL,
    import_pycolmap,
    model_of_poses,
    sparse_model_of,
)
from arview.reconstruction.database import emptied, write_database, write_matches
from arview.reconstruction.features import FeatureOptions, Features, find_all_features
from arview.reconstruction.gpu.device import torch_device
from arview.reconstruction.groups import MIN_SHARED_POINTS, linked_groups
from arview.reconstruction.matching import Matches, epipolar_inliers, match_along_lines, match_descriptors
from arview.reconstruction.memory import SparseMemory, feature_prints
from arview.reconstruction.pairs import (
    KnownPairs,
    Pair,
    chosen_pairs,
    doubtful_pairs,
    pairs_in_common_view,
    write_pairs,
)
from arview.reconstruction.still import MAX_SHIFT_PX, moved_matches, still_features, still_remark, without
from arview.reconstruction.types import Photo, SparseModel
from arview.reconstruction.unplaced import unplaced_photos, why_nothing

MAX_EPIPOLAR_PX = 4.0
"""Distance from epipolar lines in the first pass, before the distortion is known."""
BAND_PX = 2.0
"""Half width of the band around epipolar lines in the second pass."""
MIN_MATCHES = 15
"""Pairs with fewer matches are due to chance."""
MAX_ERROR_PX = 2.0
"""Observations with larger errors are left out of the last adjustment."""
LAST_TOLERANCE = 1e-5
"""Relative decrease of the cost at which the last adjustment ends."""
MAPPING_TOLERANCES = {"ba_global_function_tolerance": 1e-4, "ba_local_function_tolerance": 1e-3}
"""Relative decrease of the cost at which the adjustments of the first pass end, whose poses only have to be good enough
to match along epipolar lines."""
TRIANGULATION_ROUNDS = 1
"""Adjustments of the points alone while they are triangulated; poses and points are adjusted together afterwards."""
MIN_ANGLE_DEG = 1.5
"""Angle between two rays to a point; smaller ones do not determine depth."""


@dataclass(frozen=True)
class SparseOptions:
    """Options of structure from motion."""

    features: FeatureOptions = field(default_factory=FeatureOptions)
    first_features: int = 2500  # per photo in the first pass; matching by appearance grows with the square
    seed: int = 0
    threads: int = 0  # 0: all cores
    device: str = "auto"  # of features and matching: CUDA where torch finds it; cpu, or a torch device


def reconstruct_sparse(
    photos: Sequence[Photo],
    folder: Path,
    options: SparseOptions | None = None,
    progress: Progress | None = None,
    known: KnownPairs | None = None,
    memory: SparseMemory | None = None,
) -> SparseModel:
    """Reconstruct poses and points of the photos; COLMAP's database and model are left in ``folder``.

    Args:
        photos: the photos.
        folder: where everything is left; ``pairs.json`` lists the pairs that were matched.
        options: see `SparseOptions`.
        progress: called with (what, done, total).
        known: pairs to be matched, or rough poses by which they are chosen.
        memory: features and matches that were found before, and those of this run.

    Raises:
        InputError: fewer than three photos can be placed together; the message gives the likely reason.
    """
    options = options or SparseOptions()
    tell = progress or (lambda stage, done, total: None)
    threads = options.threads or os.cpu_count() or 1
    folder.mkdir(parents=True, exist_ok=True)
    known, memory = known or KnownPairs(), memory or SparseMemory()
    features, remarks = moving_features(photos, options, threads, tell, memory)
    min_move_px = MAX_SHIFT_PX if remarks else 0.0
    tried, pairs = match_by_appearance(
        photos, features, options, threads=threads, tell=tell, min_move_px=min_move_px, known=known, memory=memory
    )
    write_pairs(folder / "pairs.json", photos, tried)
    database_path = folder / "database.db"
    write_database(database_path, photos, features, pairs, MIN_MATCHES, options.seed)
    models = _map(database_path, folder, options, len(photos), tell)
    if not models or max(model.num_reg_images() for model in models) < 3:
        raise CannotMeasureError("; ".join([why_nothing(photos, features, pairs), *remarks]))
    chosen = max(models, key=lambda model: (model.num_reg_images(), model.num_points3D()))
    matches = match_all_along_lines(chosen, photos, features, options, threads, tell, min_move_px)
    write_matches(database_path, matches)
    chosen, refines_centre = triangulate_and_adjust(chosen, database_path, folder, options, threads, tell)
    sparse, groups = _finished(chosen, refines_centre, photos, features, folder, threads, models)
    terms = lens_terms(chosen, sparse, refines_centre)
    mixed = photos_of_two_lenses(sparse, terms, photos)
    if mixed is not None:
        found = reconstruct_sparse(mixed[0], folder, options, progress, known, memory)
        return replace(found, remarks=(*found.remarks, mixed[1]))
    sparse = _lenses_of_their_own(sparse, terms, photos, features, folder, options, threads, tell)
    unplaced = unplaced_photos(photos, features, pairs, groups)
    return replace(sparse, unplaced=tuple(unplaced), groups=groups, remarks=(*remarks, *sparse.remarks))


def reconstruct_from_poses(
    posed: Sequence[tuple[Photo, Array]],
    folder: Path,
    options: SparseOptions | None = None,
    progress: Progress | None = None,
) -> SparseModel:
    """Points for photos whose poses are known, and all of them adjusted; otherwise as `reconstruct_sparse`.

    Features are matched along the epipolar lines of the given poses, so that poses wrong by more than a few pixels
    give no points.

    Args:
        posed: photos with their ``cam_from_scan`` (4,4).
        folder: where COLMAP's database and model are left.
        options: see `SparseOptions`.
        progress: called with (what, done, total).

    Raises:
        CannotMeasureError: the photos have nothing in common along these lines.
    """
    options = options or SparseOptions()
    tell = progress or (lambda stage, done, total: None)
    threads = options.threads or os.cpu_count() or 1
    folder.mkdir(parents=True, exist_ok=True)
    photos = [photo for photo, _ in posed]
    features, remarks = moving_features(photos, options, threads, tell, SparseMemory())
    database_path = folder / "database.db"
    write_database(database_path, photos, features, {}, MIN_MATCHES, options.seed)
    model = model_of_poses(posed)
    matches = match_all_along_lines(model, photos, features, options, threads, tell)
    write_matches(database_path, matches)
    try:
        model, refines_centre = triangulate_and_adjust(model, database_path, folder, options, threads, tell)
        sparse, groups = _finished(model, refines_centre, photos, features, folder, threads, [])
    except (CannotMeasureError, ValueError, RuntimeError) as error:
        raise CannotMeasureError(
            "the given poses do not fit the photos: features along their epipolar lines give no points; check that the "
            f"poses belong to these photos ({error})"
        ) from error
    unplaced = unplaced_photos(photos, features, matches, groups)
    return replace(sparse, unplaced=tuple(unplaced), groups=groups, remarks=tuple(remarks))


def _finished(
    model: Any,
    refines_centre: bool,
    photos: Sequence[Photo],
    features: Sequence[Features],
    folder: Path,
    threads: int,
    models: Sequence[Any],
) -> tuple[SparseModel, tuple[tuple[str, ...], ...]]:
    """The main group of an adjusted model, written to the folder, and the names of all groups."""
    sparse, split = main_group(model, refines_centre, photos, threads)
    color_points(model, features)
    model.write(str(emptied(folder / "model")))
    return sparse, _all_groups(sparse, split, models)


def _lenses_of_their_own(
    sparse: SparseModel,
    terms: LensTerms,
    photos: Sequence[Photo],
    features: Sequence[Features],
    folder: Path,
    options: SparseOptions,
    threads: int,
    tell: Progress,
) -> SparseModel:
    """The model with a lens for each photo, where lenses change from photo to photo; otherwise as it is.

    Features are matched and triangulated anew with these lenses, twice: the observations that agreed with a common lens
    would hold the lenses near it.
    """
    found = with_lens_per_photo(sparse, terms)
    if found is None:
        return sparse
    usual = {photo.name: photo.camera for photo in sparse.photos}
    given = {photo.name: index for index, photo in enumerate(photos)}
    places = [given[photo.name] for photo in sparse.photos]
    seen = [features[place] for place in places]
    for _ in range(2):
        posed = [
            (replace(photos[place], lens=one.name, camera=one.camera, is_calibrated=True), one.cam_from_scan)
            for place, one in zip(places, found.photos, strict=True)
        ]
        own = [photo for photo, _ in posed]
        path = folder / "database.db"
        write_database(path, own, seen, {}, MIN_MATCHES, options.seed)
        model = model_of_poses(posed)
        write_matches(path, match_all_along_lines(model, own, seen, options, threads, tell))
        model, _ = triangulate_and_adjust(model, path, folder, options, threads, tell, keeps_centre=True)
        found = with_own_lenses(model, own, usual)
    color_points(model, seen)
    model.write(str(emptied(folder / "model")))
    terms = lens_terms(model, found, False)
    return replace(with_covariance(found, terms), remarks=(_lens_remark(found),))


def _lens_remark(sparse: SparseModel) -> str:
    """What is said of lenses that change from photo to photo."""
    assert sparse.lens_stds is not None
    side = max(sparse.photos[0].camera.width, sparse.photos[0].camera.height)
    focal, centre = 100.0 * sparse.lens_stds[0], side * sparse.lens_stds[1]
    return (
        f"the lens changes from photo to photo (focal length by {focal:.2g} %, principal point by {centre:.2g} px; "
        "standard deviations), as autofocus and stabiliser do: each photo got a lens of its own, and U is larger; fix "
        "the focus and switch the stabiliser off where the camera lets you"
    )


def moving_features(
    photos: Sequence[Photo], options: SparseOptions, threads: int, tell: Progress, memory: SparseMemory
) -> tuple[list[Features], list[str]]:
    """Features of all photos without those that stand still in the picture, and what is said of these."""
    device = torch_device(options.device)
    features = find_all_features(
        photos,
        lambda photo: memory.features(photo, options.features, device),
        threads if device is None else 2,
        lambda i, n: tell("features", i, n),
    )
    still = still_features(features, threads)
    remark = still_remark(features, still)
    return [without(one, dropped) for one, dropped in zip(features, still, strict=True)], [remark] if remark else []


# --- first pass ------------------------------------------------------------------------------------------


def match_by_appearance(
    photos: Sequence[Photo],
    features: Sequence[Features],
    options: SparseOptions,
    threads: int,
    tell: Progress,
    min_move_px: float,
    known: KnownPairs,
    memory: SparseMemory,
) -> tuple[list[Pair], dict[Pair, Matches]]:
    """The pairs that were matched, and the matches of those that have enough of them near epipolar lines.

    Before a still background, matches that move by less than ``min_move_px`` are left out.
    """
    device, prints = torch_device(options.device), feature_prints(features)

    def match(pair: Pair) -> Matches:
        one, other = (features[index] for index in pair)
        count = options.first_features

        def find() -> Matches:
            matches = match_descriptors(one.descriptors[:count], other.descriptors[:count], device)
            matches = moved_matches(one, other, matches, min_move_px)
            return epipolar_inliers(one, other, matches, MAX_EPIPOLAR_PX)

        key = (prints[pair[0]], prints[pair[1]], count, MAX_EPIPOLAR_PX, min_move_px, device)
        return memory.matches(key, find)

    found: dict[Pair, Matches] = {}
    tried: list[Pair] = []

    def match_all(pairs: list[Pair]) -> None:
        for done, (pair, matches) in enumerate(zip(pairs, pool.map(match, pairs), strict=True)):
            if len(matches) >= MIN_MATCHES:
                found[pair] = matches
            tell("matching", done + 1, len(pairs))
        tried.extend(pairs)

    # One BLAS thread for each product of descriptors, because the products already run in parallel.
    with ThreadPoolExecutor(threads) as pool, threadpool_limits(1, "blas"):
        match_all(chosen_pairs(photos, features, known, pool))
        match_all(doubtful_pairs(photos, features, known, tried, list(found), pool))
    return sorted(tried), {pair: found[pair] for pair in sorted(found)}


def _map(path: Path, folder: Path, options: SparseOptions, photo_count: int, tell: Progress) -> list[Any]:
    """The reconstructions that COLMAP's incremental mapper finds."""
    pycolmap = import_pycolmap()
    # In one thread, because with several COLMAP starts from whichever good pair is found first, which varies between
    # runs. Threads would save no time here: the small adjustments run in one thread anyway.
    mapping = pycolmap.IncrementalPipelineOptions(
        random_seed=options.seed, min_model_size=3, extract_colors=False, num_threads=1, **MAPPING_TOLERANCES
    )
    with pycolmap.Database.open(str(path)) as database:
        cameras = database.read_all_cameras()
    mapping.constant_cameras = {camera.camera_id for camera in cameras if camera.model.name == CALIBRATED_MODEL}
    placed = itertools.count(3)
    tell("placing", 0, photo_count)
    models = pycolmap.incremental_mapping(
        str(path),
        str(folder),
        str(emptied(folder / "mapper")),
        mapping,
        initial_image_pair_callback=lambda: _tell_placed(tell, 2, photo_count),
        next_image_callback=lambda: _tell_placed(tell, min(next(placed), photo_count), photo_count),
    )
    return [models[key] for key in sorted(models)]


def _tell_placed(tell: Progress, count: int, photo_count: int) -> None:
    """Tell from inside COLMAP's code, which must not be left by an exception: the next step outside it stops."""
    with suppress(KeyboardInterrupt):
        tell("placing", count, photo_count)


# --- second pass -----------------------------------------------------------------------------------------


def match_all_along_lines(
    model: Any,
    photos: Sequence[Photo],
    features: Sequence[Features],
    options: SparseOptions,
    threads: int,
    tell: Progress,
    min_move_px: float = 0.0,
    memory: SparseMemory | None = None,
) -> dict[Pair, Matches]:
    """All features of placed photos matched again, now that the relative poses are known."""
    memory = memory or SparseMemory()
    prints = feature_prints(features)
    cameras, poses = cameras_and_poses(model, photos)
    rays = {
        index: np.ascontiguousarray(camera.unproject(features[index].points_px)[:, :2])
        for index, camera in cameras.items()
    }

    device = torch_device(options.device)

    def match(pair: Pair) -> Matches:
        i, j = pair
        second_from_first = poses[j] @ invert(poses[i])
        essential = skew(second_from_first[:3, 3]) @ second_from_first[:3, :3]
        focal = 0.5 * (cameras[i].fx + cameras[j].fx)
        pair_of = (features[i], features[j])

        def find() -> Matches:
            matches = match_along_lines((rays[i], rays[j]), focal, pair_of, essential, BAND_PX, device)
            return moved_matches(*pair_of, matches, min_move_px)

        lenses = tuple((c.fx, c.fy, c.cx, c.cy, *c.dist.tolist()) for c in (cameras[i], cameras[j]))
        key = (prints[i], prints[j], essential.tobytes(), lenses, BAND_PX, min_move_px, device)
        return memory.matches(key, find)

    chosen = pairs_in_common_view(poses)
    found: dict[Pair, Matches] = {}
    with ThreadPoolExecutor(threads) as pool:
        for done, (pair, matches) in enumerate(zip(chosen, pool.map(match, chosen), strict=True)):
            found[pair] = matches
            tell("matching again", done + 1, len(chosen))
    return found


def cameras_and_poses(model: Any, photos: Sequence[Photo]) -> tuple[dict[int, Camera], dict[int, Array]]:
    """Camera and ``cam_from_scan`` of each placed photo, by its index."""
    sparse = sparse_model_of(model, photos)
    place = {photo.name: index for index, photo in enumerate(photos)}
    cameras = {place[photo.name]: photo.camera for photo in sparse.photos}
    return cameras, {place[photo.name]: photo.cam_from_scan for photo in sparse.photos}


def triangulate_and_adjust(
    model: Any,
    path: Path,
    folder: Path,
    options: SparseOptions,
    threads: int,
    tell: Progress,
    keeps_centre: bool = False,
) -> tuple[Any, bool]:
    """Points triangulated from all matches; then poses, points and intrinsics adjusted together.

    ``keeps_centre`` leaves principal points as an earlier adjustment has found them. Returns the model and whether its
    principal points were adjusted.
    """
    pycolmap = import_pycolmap()
    tell("adjusting", 0, 3)
    triangulation = pycolmap.IncrementalPipelineOptions(random_seed=options.seed, num_threads=threads)
    triangulation.triangulation.ignore_two_view_tracks = False
    triangulation.ba_global_max_refinements = TRIANGULATION_ROUNDS
    model = pycolmap.triangulate_points(
        model, str(path), str(folder), str(emptied(folder / "triangulated")), True, triangulation
    )
    tell("adjusting", 1, 3)
    refines_centre = False
    if keeps_centre:
        adjust(model, threads, refines_centre=False, iterations=5)
    else:
        refines_centre = adjust_with_centre(model, threads)
    tell("adjusting", 2, 3)
    pycolmap.ObservationManager(model).filter_all_points3D(MAX_ERROR_PX, MIN_ANGLE_DEG)
    adjust(model, threads, refines_centre=refines_centre, tolerance=LAST_TOLERANCE)
    tell("adjusting", 3, 3)
    return model, refines_centre


def main_group(
    model: Any, refines_centre: bool, photos: Sequence[Photo], threads: int
) -> tuple[SparseModel, list[list[str]]]:
    """The photos that are placed relative to each other, adjusted alone; and the names of the other groups.

    The mapper places photos by the first pass's matches; where few of them join two groups, the second pass may find
    none, and then nothing holds the groups together.
    """
    split: list[list[str]] = []
    while True:
        sparse = sparse_model_of(model, photos)
        if len(sparse.points_in_scan) < MIN_SHARED_POINTS:
            raise CannotMeasureError(
                f"photos: the {len(sparse.photos)} that could be placed share no point seen from two sides; take more, "
                "10 to 20 degrees apart, moving the camera sideways rather than turning it"
            )
        sparse = with_covariance(sparse, lens_terms(model, sparse, refines_centre))
        kept, *others = linked_groups(sparse)
        if len(kept) < 3:
            raise CannotMeasureError(
                f"photos: no three of the {len(sparse.photos)} share enough points to be placed relative to each "
                "other; take more, 10 to 20 degrees apart"
            )
        if not others:
            return sparse, split
        split += [[sparse.photos[i].name for i in members] for members in others]
        dropped = {name for names in split for name in names}
        for image_id in list(model.reg_image_ids()):
            if model.images[image_id].name in dropped:
                model.deregister_frame(model.images[image_id].frame_id)
        model.tear_down()  # without it, frames that have no pose stay
        adjust(model, threads, refines_centre=False)
        refines_centre = False


def _all_groups(sparse: SparseModel, split: list[list[str]], models: Sequence[Any]) -> tuple[tuple[str, ...], ...]:
    """Names of the photos of each group, the used one first: of the model that was split, and the mapper's others."""
    groups = [tuple(photo.name for photo in sparse.photos), *(tuple(names) for names in split)]
    known = {name for group in groups for name in group}
    for model in sorted(models, key=lambda one: -one.num_reg_images()):
        rest = tuple(sorted(_names(model) - known))
        if len(rest) > 1:
            groups.append(rest)
            known |= set(rest)
    return tuple(groups)


def color_points(model: Any, features: Sequence[Features]) -> None:
    """Give every point the colour of the place where it was first seen."""
    for point in model.points3D.values():
        first = point.track.elements[0]
        point.color = features[first.image_id - 1].colors[first.point2D_idx]


def _names(model: Any) -> set[str]:
    return {model.images[image_id].name for image_id in model.reg_image_ids()}
