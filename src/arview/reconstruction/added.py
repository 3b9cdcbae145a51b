"""Photos added to a reconstruction, after a component of what they show was moved.

The new photos are placed by what stayed where it was: features of the earlier photos on the moved components are left
out, so that no match joins the component's old place to its new one. Everything else is as in `reconstruct_sparse`: all
features are matched along the epipolar lines, and all photos are adjusted together.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

from arview.camera import Camera
from arview.core.progress import Progress
from arview.errors import CannotMeasureError
from arview.geometry import Array, rigid
from arview.reconstruction.adjustment.bundle import lens_terms, with_own_lenses
from arview.reconstruction.adjustment.equations import usual_lenses, with_covariance
from arview.reconstruction.colmap import import_pycolmap, model_of_poses
from arview.reconstruction.database import emptied, write_database, write_matches
from arview.reconstruction.features import Features
from arview.reconstruction.gpu.device import torch_device
from arview.reconstruction.halves import onto
from arview.reconstruction.matching import match_descriptors
from arview.reconstruction.memory import SparseMemory, feature_prints
from arview.reconstruction.pairs import promising_pairs
from arview.reconstruction.sparse import (
    MIN_MATCHES,
    SparseOptions,
    color_points,
    main_group,
    match_all_along_lines,
    moving_features,
    triangulate_and_adjust,
)
from arview.reconstruction.types import Photo, SparseModel

Hidden = Callable[[int, NDArray[np.float32]], NDArray[np.bool_]]
"""Of an earlier photo, by its index, and pixels (N,2): which of them (N,) show what was moved."""


MIN_INLIERS = 25
"""Matched points that agree on a new photo's pose."""
MAX_ERROR_PX = 4.0
"""Largest error of a point that agrees on a new photo's pose."""
MIN_PLACED = 3
"""New photos that must be placed; a point needs two, and the third can contradict them."""
MAX_HINT_ANGLE_DEG = 45.0
"""Largest angle between the rough poses of a new and an earlier photo that are matched."""


@dataclass(frozen=True)
class AddedOptions:
    """Options of placing photos in a reconstruction."""

    sparse: SparseOptions = field(default_factory=SparseOptions)


class EarlierPhotos:
    """The photos of a reconstruction, made ready for others to be added.

    Args:
        whole: the reconstruction, in its scan frame.
        photos: those of its intake, with their lenses.
        hides: tells what was moved in each photo of ``whole.photos``.
        options: see `AddedOptions`.
        memory: features and matches that were found before.
    """

    def __init__(
        self, whole: SparseModel, photos: Sequence[Photo], hides: Hidden, options: AddedOptions, memory: SparseMemory
    ) -> None:
        self.whole, self.options, self.memory = whole, options, memory
        self.threads = options.sparse.threads or os.cpu_count() or 1
        given = {photo.name: photo for photo in photos}
        self.usual = None if whole.lens_stds is None else usual_lenses(whole.photos)
        known = self.usual or {one.name: one.camera for one in whole.photos}
        self.lenses = {given[name].lens: camera for name, camera in known.items()}
        self.photos = [self._with_lens(given[one.name], one.camera) for one in whole.photos]
        found, _ = moving_features(self.photos, options.sparse, self.threads, _nothing, memory)
        self.features = [
            one.taken(~hides(index, one.points_px)) if len(one) else one for index, one in enumerate(found)
        ]
        self.points = [self._points_of(index) for index in range(len(self.photos))]
        self.posed = [(photo, one.cam_from_scan) for photo, one in zip(self.photos, whole.photos, strict=True)]
        # The matches of these pairs are found now and remembered, because nobody waits yet.
        match_all_along_lines(
            model_of_poses(self.posed),
            self.photos,
            self.features,
            options.sparse,
            self.threads,
            _nothing,
            memory=memory,
        )

    def _with_lens(self, photo: Photo, camera: Camera) -> Photo:
        """The photo with a known camera; with a lens of its own where lenses change from photo to photo."""
        if self.usual is None:
            return replace(photo, camera=camera)
        return replace(photo, camera=camera, lens=photo.name, is_calibrated=True)

    def _points_of(self, index: int) -> NDArray[np.int64]:
        """(N,) the point of ``whole`` that each feature of a photo belongs to, or −1."""
        seen = self.whole.observed_photo == index
        found = np.full(len(self.features[index]), -1, dtype=np.int64)
        if seen.any() and len(found):
            distance, nearest = cKDTree(self.whole.observed_px[seen]).query(self.features[index].points_px)
            close = distance < 0.05
            found[close] = self.whole.observed_point[seen][nearest[close]]
        return found

    def match(
        self, photos: Sequence[Photo], features: Sequence[Features], poses: Mapping[str, Array]
    ) -> list[tuple[Array, Array]]:
        """For each new photo, points (N,3) in the scan frame and the pixels (N,2) at which it shows them.

        Args:
            photos: new ones.
            features: of them.
            poses: rough ``cam_from_scan`` of new photos, as far as they are known; only the rotation is used.
        """
        count, sparse = len(self.photos), self.options.sparse
        everything = [*self.features, *features]
        limit = np.cos(np.deg2rad(MAX_HINT_ANGLE_DEG))
        pairs = [(i, count + j) for j in range(len(photos)) for i in range(count)]
        hinted = {count + j: poses[photo.name][2, :3] for j, photo in enumerate(photos) if photo.name in poses}
        prints, device = feature_prints(everything), torch_device(sparse.device)

        def find(pair: tuple[int, int]) -> NDArray[np.uint32]:
            one, other = (everything[index].descriptors[: sparse.first_features] for index in pair)
            key = ("added", prints[pair[0]], prints[pair[1]], sparse.first_features, device)
            return self.memory.matches(key, lambda: match_descriptors(one, other, device))

        with ThreadPoolExecutor(self.threads) as pool, threadpool_limits(1, "blas"):
            promising = set(promising_pairs(everything, [p for p in pairs if p[1] not in hinted], pool))
            near = {(i, j) for i, j in pairs if j in hinted and self.posed[i][1][2, :3] @ hinted[j] > limit}
            chosen = sorted(promising | near)
            matches = dict(zip(chosen, pool.map(find, chosen), strict=True))
        found = []
        for j, one in enumerate(features):
            points, pixels = [], []
            for i in range(count):
                rows = matches.get((i, count + j))
                if rows is not None and len(rows):
                    known = self.points[i][rows[:, 0]] >= 0
                    points.append(self.points[i][rows[known, 0]])
                    pixels.append(one.points_px[rows[known, 1]])
            which = np.concatenate(points) if points else np.zeros(0, dtype=np.int64)
            found.append(
                (
                    self.whole.points_in_scan[which],
                    np.concatenate(pixels).astype(np.float64) if pixels else np.zeros((0, 2)),
                )
            )
        return found

    def add(
        self, photos: Sequence[Photo], poses: Mapping[str, Array], folder: Path, progress: Progress | None = None
    ) -> SparseModel:
        """The reconstruction of the earlier photos and the new ones, in the frame and unit of the earlier one.

        Args:
            photos: new ones; a lens of the earlier photos keeps what was found out about it.
            poses: rough ``cam_from_scan`` of new photos, as far as they are known; only the rotation is used.
            folder: where COLMAP's database and model are left.
            progress: called with (what, done, total).

        Raises:
            CannotMeasureError: too few of the new photos can be placed.
        """
        tell = progress or _nothing
        sparse, pycolmap = self.options.sparse, import_pycolmap()
        folder.mkdir(parents=True, exist_ok=True)
        device = torch_device(sparse.device)
        features = [self.memory.features(photo, sparse.features, device) for photo in photos]
        photos = [self._with_lens(photo, self.lenses.get(photo.lens, photo.camera)) for photo in photos]
        tell("matching", 0, 1)
        placed, left_out, kept = [], [], []
        for photo, one, (points, pixels) in zip(photos, features, self.match(photos, features, poses), strict=True):
            pose = place_photo(photo, points, pixels)
            if pose is None:
                left_out.append((photo.name, "shows too little of what the earlier photos show"))
            else:
                placed.append((photo, pose))
                kept.append(one)
        if len(placed) < MIN_PLACED:
            raise CannotMeasureError(
                f"only {len(placed)} of {len(photos)} new photos could be placed among the earlier ones; take "
                f"{MIN_PLACED} or more that also show what is around the component"
            )
        joint = [photo for photo, _ in [*self.posed, *placed]]
        everything = [*self.features, *kept]
        model = model_of_poses([*self.posed, *placed])
        path = folder / "database.db"
        write_database(path, joint, everything, {}, MIN_MATCHES, sparse.seed)
        write_matches(
            path,
            match_all_along_lines(model, joint, everything, sparse, self.threads, tell, memory=self.memory),
        )
        model, _ = triangulate_and_adjust(model, path, folder, sparse, self.threads, tell, keeps_centre=True)
        found, split = main_group(model, False, joint, self.threads)
        if self.usual is not None:
            usual = {photo.name: photo.camera for photo in photos} | self.usual
            own = with_own_lenses(model, joint, usual)
            found = with_covariance(own, lens_terms(model, own, False))
        color_points(model, everything)
        scale, motion = onto(found, self.whole)
        model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(motion[:3, :3]), motion[:3, 3]))
        model.write(str(emptied(folder / "model")))
        left_out += [(name, "is not placed relative to the others") for names in split for name in names]
        return replace(found.transformed(scale, motion), unplaced=tuple(left_out))


def place_photo(photo: Photo, points: Array, pixels: Array) -> Array | None:
    """``cam_from_scan`` (4,4) of a photo that shows known points (N,3) at pixels (N,2); None if too few agree.

    RANSAC over minimal sets, refined on all that agree (Lepetit 2009, EPnP; Levenberg-Marquardt).
    """
    if len(points) < MIN_INLIERS:
        return None
    rays = photo.camera.unproject(pixels)[:, :2]
    is_good, turn, shift, agree = cv2.solvePnPRansac(
        points,
        rays,
        np.eye(3),
        None,
        iterationsCount=3000,
        reprojectionError=MAX_ERROR_PX / photo.camera.fx,
        confidence=0.9999,
        flags=cv2.SOLVEPNP_EPNP,
    )
    if not is_good or agree is None or len(agree) < MIN_INLIERS:
        return None
    some = agree.ravel()
    turn, shift = cv2.solvePnPRefineLM(points[some], rays[some], np.eye(3), np.zeros(0), turn, shift)
    return rigid(np.asarray(cv2.Rodrigues(turn)[0]), shift.ravel())


def _nothing(what: str, done: int, total: int) -> None:
    """Progress that nobody waits for."""
