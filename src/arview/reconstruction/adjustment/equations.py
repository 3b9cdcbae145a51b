"""Adjustment of poses, points and lenses together: its normal equations, their covariance, and a lens for each photo.

The points are eliminated (Schur complement; Triggs et al., "Bundle adjustment — a modern synthesis", 2000, section 6),
which leaves equations in the photos' unknowns alone. COLMAP adjusts first; what is computed here starts at its result.

A phone refocuses and stabilises each picture, so that its principal distance and point change from photo to photo. Such
changes are unknowns of each photo, held by their usual size, which follows from the data (variance components).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.core.kernel import kernel
from arview.geometry import Array, apply, exp_se3
from arview.reconstruction.adjustment.covariance import (
    LOSS_PX,
    free_frame_projection,
    gauge_of,
    noise_variance_of,
    reprojection_residuals,
)
from arview.reconstruction.types import PosedPhoto, SparseModel

ZOOM_STD, MIN_ZOOM, MIN_GROUP = 0.3, 0.08, 3
"""Relative differences of focal lengths between lenses of one phone: expected, and least; and photos of each."""
LENS_STD = np.array([0.003, 0.004, 0.004])
"""Usual change of a phone's lens: of its focal length, and of its principal point by the longer side of the picture."""
MIN_LENS_STD = np.array([1e-3, 1e-3, 1e-3])
"""Smaller changes from photo to photo are what errors of the features look like."""
CORRELATED = 2.0
"""Errors of lenses by those that independent errors of features give, as measured where lenses were known."""
LENS_TRACK = 3
"""Photos that show a point by which lenses are found; a wrong match of two agrees with any lens it was found with."""
POINT_ROUNDS = 3
"""Rounds in which the points of short tracks follow the lenses that the others gave."""
MAX_LENS_STEP = 0.03
"""Largest change of a lens in a round; more is another lens."""
ROUNDS = 25
"""Most rounds of an adjustment, each with new weights …."""
TOLERANCE = 5e-5
"""… and the change of a lens in one of them at which it ends."""
UNKNOWNS = 9
"""Of a photo: twist, relative change of the focal length, shift of the principal point by the longer side."""


@dataclass(frozen=True)
class LensTerms:
    """Which terms of the lenses are common unknowns.

    Attributes:
        lens: (M,) number of each photo's lens; −1 for a calibrated one.
        has_centre: whether the principal point is one of its unknowns, beside focal length, k1 and k2.
    """

    lens: NDArray[np.int64]
    has_centre: bool


class PointRows(NamedTuple):
    """Equations of the observations, by which the points follow the other unknowns.

    Attributes:
        point: (K,) index of the point.
        by_point, by_photo, columns: (K,2,3) and (K,2,C) weighed derivatives, the second by the unknowns (K,C).
        weighed: (K,2) residuals.
        inverse: (N,3,3) inverse information of each point.
    """

    point: NDArray[np.int32]
    by_point: Array
    by_photo: Array
    columns: NDArray[np.int64]
    weighed: Array
    inverse: Array

    def shifts(self, step: Array) -> Array:
        """(N,3) shifts of the points after a step (U,) of the other unknowns."""
        left = self.weighed - np.einsum("kpc,kc->kp", self.by_photo, step[self.columns])
        pulls = np.einsum("kpi,kp->ki", self.by_point, left)
        count = len(self.inverse)
        total = np.stack([np.bincount(self.point, pulls[:, axis], count) for axis in range(3)], axis=1)
        return np.einsum("nij,nj->ni", self.inverse, total)


@dataclass(frozen=True)
class NormalEquations:
    """Equations of an adjustment with its points eliminated.

    Attributes:
        matrix: (U,U) of the unknowns: `UNKNOWNS` of each photo, then those of each common lens.
        right: (U,).
        rows: by which the points follow.
    """

    matrix: Array
    right: Array
    rows: PointRows


def lens_slopes(camera: Camera, in_cam: Array, pixels: Array) -> Array:
    """(N,2,5) derivatives of pixels (N,2) by relative focal length, principal point by the longer side, k1 and k2."""
    side = float(max(camera.width, camera.height))
    slopes = np.zeros((len(in_cam), 2, 5))
    slopes[:, :, 0] = pixels - (camera.cx, camera.cy)
    slopes[:, 0, 1] = slopes[:, 1, 2] = side
    ideal = in_cam[:, :2] / in_cam[:, 2:]
    square = np.sum(ideal**2, axis=1, keepdims=True)
    slopes[:, :, 3] = ideal * square * (camera.fx, camera.fy)
    slopes[:, :, 4] = slopes[:, :, 3] * square
    return slopes


def normal_equations(sparse: SparseModel, terms: LensTerms) -> NormalEquations:
    """The equations of all observations, weighed by Cauchy's loss; for observations with 1 px of noise."""
    count, photos = len(sparse.points_in_scan), len(sparse.photos)
    residuals = reprojection_residuals(sparse)
    roots = 1.0 / np.sqrt(1.0 + np.sum(residuals**2, axis=1) / LOSS_PX**2)
    is_seen = np.isfinite(roots)  # others have their points behind the camera
    roots, residuals = np.where(is_seen, roots, 0.0), np.where(is_seen[:, None], residuals, 0.0)
    common = int(terms.lens.max(initial=-1)) + 1
    width = UNKNOWNS * photos + 5 * common
    by_point = np.zeros((len(residuals), 2, 3))
    by_photo = np.zeros((len(residuals), 2, UNKNOWNS))
    by_lens = np.zeros((len(residuals), 2, 5))
    for index, photo in enumerate(sparse.photos):
        of = np.flatnonzero(is_seen & (sparse.observed_photo == index))
        in_cam = apply(photo.cam_from_scan, sparse.points_in_scan[sparse.observed_point[of]])
        by_cam = photo.camera.slopes(in_cam)
        root = roots[of, None, None]
        lens = root * lens_slopes(photo.camera, in_cam, photo.camera.project(in_cam))
        twist = root * np.concatenate([np.cross(in_cam[:, None], by_cam), by_cam], axis=2)
        by_point[of] = root * (by_cam @ photo.cam_from_scan[:3, :3])
        by_photo[of] = np.concatenate([twist, lens[:, :, :3]], axis=2)
        if terms.lens[index] >= 0:
            by_lens[of] = lens
            by_lens[of, :, 1:3] *= terms.has_centre
    columns = UNKNOWNS * sparse.observed_photo[:, None].astype(np.int64) + np.arange(UNKNOWNS)
    own = UNKNOWNS * photos + 5 * np.maximum(terms.lens[sparse.observed_photo], 0)[:, None] + np.arange(5)
    if common:
        columns, by_photo = np.concatenate([columns, own], axis=1), np.concatenate([by_photo, by_lens], axis=2)
    weighed = roots[:, None] * residuals
    order = np.argsort(sparse.observed_point, kind="stable")
    starts = np.searchsorted(sparse.observed_point[order], np.arange(count + 1))
    inverse: Array = np.asarray(np.linalg.pinv(_point_blocks(order, starts, by_point), hermitian=True), np.float64)
    matrix, right = _without_points(order, starts, by_point, by_photo, columns, weighed, inverse, width)
    rows = PointRows(sparse.observed_point, by_point, by_photo, columns, weighed, inverse)
    return NormalEquations(matrix, right, rows)


@kernel
def _point_blocks(
    order: NDArray[np.int64], starts: NDArray[np.int64], by_point: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(N,3,3) information of each point by its observations, which begin at its place in ``starts`` (N+1,)."""
    blocks = np.zeros((len(starts) - 1, 3, 3))
    for n in range(len(blocks)):
        for at in range(starts[n], starts[n + 1]):
            rows = by_point[order[at]]
            for i in range(3):
                for j in range(3):
                    blocks[n, i, j] += rows[0, i] * rows[0, j] + rows[1, i] * rows[1, j]
    return blocks


@kernel
def _without_points(
    order: NDArray[np.int64],
    starts: NDArray[np.int64],
    by_point: NDArray[np.float64],
    by_photo: NDArray[np.float64],
    columns: NDArray[np.int64],
    weighed: NDArray[np.float64],
    inverse: NDArray[np.float64],
    width: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Matrix (U,U) and right side (U,) of the other unknowns, with the points eliminated (Schur complement)."""
    matrix, lower, right = np.zeros((width, width)), np.zeros((width, width)), np.zeros(width)
    size = by_photo.shape[2]
    longest = 0
    for n in range(len(inverse)):
        longest = max(longest, starts[n + 1] - starts[n])
    mixed, solved = np.zeros((longest, 3, size)), np.zeros((longest, 3, size))
    for n in range(len(inverse)):
        first, end = starts[n], starts[n + 1]
        pull = np.zeros(3)
        for at in range(first, end):
            rows, point, left = by_photo[order[at]], by_point[order[at]], weighed[order[at]]
            k = at - first
            for i in range(3):
                pull[i] += point[0, i] * left[0] + point[1, i] * left[1]
                for c in range(size):
                    mixed[k, i, c] = point[0, i] * rows[0, c] + point[1, i] * rows[1, c]
            for i in range(3):
                for c in range(size):
                    solved[k, i, c] = (
                        inverse[n, i, 0] * mixed[k, 0, c]
                        + inverse[n, i, 1] * mixed[k, 1, c]
                        + inverse[n, i, 2] * mixed[k, 2, c]
                    )
        for at in range(first, end):
            rows, left, own = by_photo[order[at]], weighed[order[at]], columns[order[at]]
            k = at - first
            for a in range(size):
                right[own[a]] += rows[0, a] * left[0] + rows[1, a] * left[1]
                for i in range(3):
                    right[own[a]] -= solved[k, i, a] * pull[i]
                for b in range(size):
                    matrix[own[a], own[b]] += rows[0, a] * rows[0, b] + rows[1, a] * rows[1, b]
            for other in range(first, at + 1):
                h, theirs = other - first, columns[order[other]]
                target = matrix if other == at else lower
                for a in range(size):
                    x, y, z = mixed[k, 0, a], mixed[k, 1, a], mixed[k, 2, a]
                    for b in range(size):
                        target[own[a], theirs[b]] -= x * solved[h, 0, b] + y * solved[h, 1, b] + z * solved[h, 2, b]
    return matrix + lower + lower.T, right


def with_covariance(sparse: SparseModel, terms: LensTerms) -> SparseModel:
    """The model with the covariance of its poses, and of lenses that change; without, where photos leave it open.

    The inverse of the information is that of observations with 1 px of noise. It is scaled by the noise that the
    residuals show, and transformed to the frame in which the cameras together vary least (S-transformation, Baarda
    1973), so that no camera seems more accurate because it was fixed.
    """
    stds, photos = sparse.lens_stds, len(sparse.photos)
    used = sparse if stds is None else of_long_tracks(sparse)
    equations = normal_equations(used, terms)
    variance = noise_variance_of(used)
    own = UNKNOWNS * np.arange(photos)[:, None] + np.arange(6, UNKNOWNS)
    if stds is None:
        equations.matrix[own] = equations.matrix[:, own.ravel()] = 0.0
        equations.matrix[own, own] = 1.0
    else:
        equations.matrix[own, own] += variance / np.maximum(stds, MIN_LENS_STD) ** 2
        variance *= CORRELATED**2
    inverse = _inverse(used, equations.matrix)
    if inverse is None:
        return replace(sparse, pose_covariance=None, lens_covariance=None)
    twists = np.delete(np.arange(UNKNOWNS * photos).reshape(photos, UNKNOWNS), np.s_[6:], axis=1).ravel()
    effect = np.eye(UNKNOWNS * photos, len(inverse))
    effect[np.ix_(twists, twists)] = free_frame_projection(used)
    joint = np.asarray(variance * effect @ inverse @ effect.T)
    poses = np.ascontiguousarray(joint[np.ix_(twists, twists)])
    return replace(sparse, pose_covariance=poses, lens_covariance=None if stds is None else joint)


def _inverse(sparse: SparseModel, matrix: Array) -> Array | None:
    """(U,U) inverse of normal equations in which motions of the whole frame are held by equations of their own."""
    moves, _ = gauge_of(sparse)
    gauge = np.zeros((len(matrix), 7))
    gauge[: UNKNOWNS * len(sparse.photos)].reshape(-1, UNKNOWNS, 7)[:, :6] = moves.reshape(-1, 6, 7)
    diagonal = np.diag(matrix)
    is_unknown = diagonal > 0.0  # a common lens may keep its principal point
    scale = np.where(is_unknown, 1.0 / np.sqrt(np.where(is_unknown, diagonal, 1.0)), 0.0)
    held = gauge / np.where(is_unknown, scale, 1.0)[:, None]
    held /= np.linalg.norm(held, axis=0)
    normal = matrix * np.outer(scale, scale) + held @ held.T + np.diag(1.0 * ~is_unknown)
    try:
        inverse = np.linalg.inv(normal) * np.outer(scale, scale)
    except np.linalg.LinAlgError:
        return None
    return inverse if np.isfinite(inverse).all() else None


def with_lens_per_photo(
    sparse: SparseModel, terms: LensTerms, usual: Sequence[Camera] | None = None, focal_std: float = float(LENS_STD[0])
) -> SparseModel | None:
    """The model adjusted with a lens for each photo; None where the lenses do not change from photo to photo.

    Args:
        sparse: adjusted with common lenses, or with a lens for each photo before.
        terms: the unknowns of the common ones.
        usual: the lenses around which those of the photos are known to change; default: those of ``sparse``.
        focal_std: expected relative change of the focal length.
    """
    photos, whole = len(sparse.photos), sparse
    sparse = of_long_tracks(sparse)
    stds = np.array([focal_std, *LENS_STD[1:]])
    cameras = [photo.camera for photo in sparse.photos]
    changes = np.array([_change(one, other) for one, other in zip(cameras, usual or cameras, strict=True)])
    own = UNKNOWNS * np.arange(photos)[:, None] + np.arange(6, UNKNOWNS)
    for _ in range(ROUNDS):
        equations = normal_equations(sparse, terms)
        variance = noise_variance_of(sparse)
        held = variance / stds**2
        equations.matrix[own, own] += held
        equations.right[own] -= held * changes
        inverse = _inverse(sparse, equations.matrix)
        if inverse is None:
            return None
        step = inverse @ equations.right
        if np.abs(step[own]).max() > max(MAX_LENS_STEP, focal_std):
            return None
        sparse, changes = _moved(sparse, terms, equations, step), changes + step[own]
        # Variance components: expectation and maximisation, both directions of the principal point alike.
        squares = np.mean(changes**2 + variance * np.diag(inverse)[own], axis=0)
        stds = np.sqrt(np.array([squares[0], *2 * [0.5 * (squares[1] + squares[2])]]))
        if usual is None and np.all(stds < MIN_LENS_STD):
            return None
        if np.abs(step[own]).max() < TOLERANCE:
            break
    whole = replace(whole, photos=sparse.photos)
    for _ in range(POINT_ROUNDS):
        equations = normal_equations(whole, terms)
        whole = _moved(whole, terms, equations, np.zeros(len(equations.right)))
    return whole


def of_long_tracks(sparse: SparseModel) -> SparseModel:
    """The model with those points alone that `LENS_TRACK` photos or more show."""
    is_long = np.bincount(sparse.observed_point, minlength=len(sparse.points_in_scan)) >= LENS_TRACK
    of = is_long[sparse.observed_point]
    return replace(
        sparse,
        points_in_scan=sparse.points_in_scan[is_long],
        colors=sparse.colors[is_long],
        point_errors_px=sparse.point_errors_px[is_long],
        observed_point=(np.cumsum(is_long, dtype=np.int32) - 1)[sparse.observed_point[of]],
        observed_photo=sparse.observed_photo[of],
        observed_px=sparse.observed_px[of],
    )


def focal_groups(sparse: SparseModel, terms: LensTerms) -> tuple[list[int], tuple[float, float]] | None:
    """0 or 1 for each photo by the focal length with which it was taken, and the two, px; None where it is one.

    Photos of two lenses or zooms that are adjusted as one are told by focal lengths of their own, which then lie in two
    groups far apart.
    """
    if len(sparse.photos) < 2 * MIN_GROUP or (terms.lens < 0).any():
        return None
    found = with_lens_per_photo(sparse, terms, focal_std=ZOOM_STD)
    if found is None:
        return None
    focals = np.log([photo.camera.fx for photo in found.photos])
    order = np.sort(focals)
    at = int(np.argmax(np.diff(order)))
    gap, groups = float(order[at + 1] - order[at]), (order[: at + 1], order[at + 1 :])
    if gap < MIN_ZOOM or min(map(len, groups)) < MIN_GROUP or max(map(np.ptp, groups)) > 0.5 * gap:
        return None
    wide, long = (float(np.exp(np.median(group))) for group in groups)
    return [int(focal > order[at]) for focal in focals], (wide, long)


def _change(camera: Camera, usual: Camera) -> tuple[float, float, float]:
    """Relative change of the focal length, and shift of the principal point by the longer side."""
    side = max(camera.width, camera.height)
    return camera.fx / usual.fx - 1.0, (camera.cx - usual.cx) / side, (camera.cy - usual.cy) / side


def mean_lens(cameras: Sequence[Camera]) -> Camera:
    """The lens in the middle of several that differ in focal length and principal point alone."""
    focal, *centre = np.mean([_change(one, cameras[0]) for one in cameras], axis=0)
    return _changed(cameras[0], focal, centre)


def usual_lenses(photos: Sequence[PosedPhoto]) -> dict[str, Camera]:
    """For each photo, by its name, the lens in the middle of those of its size and distortion: of one lens."""
    kinds = {one.name: (one.camera.width, one.camera.height, *one.camera.dist) for one in photos}
    of_kind = {kind: [one.camera for one in photos if kinds[one.name] == kind] for kind in kinds.values()}
    return {name: mean_lens(of_kind[kind]) for name, kind in kinds.items()}


def _changed(camera: Camera, focal: float, centre: Sequence[float]) -> Camera:
    """The camera after a change as `_change` has it."""
    side = max(camera.width, camera.height)
    fx, fy = camera.fx * (1.0 + focal), camera.fy * (1.0 + focal)
    return replace(camera, fx=fx, fy=fy, cx=camera.cx + side * centre[0], cy=camera.cy + side * centre[1])


def _moved(sparse: SparseModel, terms: LensTerms, equations: NormalEquations, step: Array) -> SparseModel:
    """The model after a step (U,) of its unknowns."""
    size = UNKNOWNS * len(sparse.photos)
    of_lens = step[size:].reshape(-1, 5)
    photos = []
    for photo, own, lens in zip(sparse.photos, step[:size].reshape(-1, UNKNOWNS), terms.lens, strict=True):
        common = of_lens[lens] if lens >= 0 else np.zeros(5)
        focal, *centre = own[6:] + common[:3]
        dist = photo.camera.dist + np.array([common[3], common[4], 0.0, 0.0, 0.0])
        camera = _changed(replace(photo.camera, dist=dist), focal, centre)
        photos.append(replace(photo, camera=camera, cam_from_scan=exp_se3(own[:6]) @ photo.cam_from_scan))
    return replace(sparse, photos=tuple(photos), points_in_scan=sparse.points_in_scan + equations.rows.shifts(step))
