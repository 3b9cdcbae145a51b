"""The camera from views of a board, without outliers, and its covariance.

Intrinsics and poses are adjusted together (Zhang 2000, A flexible new technique for camera calibration), by OpenCV for
a lens with Brown's terms, by `arview.calibration.fisheye` for a fisheye; views and corners with outlying residuals are
removed, round by round. The covariance is that of the adjustment with the poses eliminated, but not smaller than the
scatter from view to view (the sandwich estimate of Huber 1967, clustered by view): errors of the corners of one picture
are correlated by blur, motion and a board that is not quite flat.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from arview.calibration.board_view import MIN_CORNERS, BoardView
from arview.calibration.fisheye import adjust_fisheye
from arview.calibration.projection import PARAMETERS_OF, CalibratedLens, lens_of, project
from arview.camera import MAX_HALF_ANGLE_DEG, Camera
from arview.core.fits import without_span
from arview.errors import InputError
from arview.geometry import Array, rigid

K = 2.0
"""Coverage factor of every U in this room: 95 % of a normal distribution."""


MIN_VIEWS = 5
"""With fewer, poses and nine intrinsics are hardly checked."""
VIEW_OUTLIER = 2.5
"""Multiple of the median view's rms above which a view is blurred or bent."""
VIEW_FLOOR_PX = 0.15
"""Views whose rms is below this are kept, however well the others fit."""
CORNER_OUTLIER = 4.5
"""Robust standard deviations above which a corner is wrong; 1 in 25,000 normal errors is larger."""
ROUNDS = 12
"""Rounds of solving and rejecting; wrong corners are removed a few at a time."""


@dataclass(frozen=True)
class Solution:
    """A calibrated camera.

    Attributes:
        camera: of the sensor's picture.
        covariance: (P,P) of `parameters`; infinite where the views do not determine them.
        views: those that were used, without rejected corners.
        cams_from_board: (V,4,4) their poses, mm.
        residuals: (N,2) px of each view, found minus projected.
        rms_px: of all residuals, per coordinate.
        rejected: why a view was rejected, by its name.
        corners_left_out: number of rejected corners in views that were kept.
    """

    camera: Camera
    covariance: Array
    views: tuple[BoardView, ...]
    cams_from_board: Array
    residuals: tuple[Array, ...]
    rms_px: float
    rejected: dict[str, str]
    corners_left_out: int

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the P intrinsics, in the order of the covariance."""
        return PARAMETERS_OF[lens_of(self.camera)]

    @property
    def std(self) -> Array:
        """(P,) standard uncertainty of `parameters`."""
        return np.sqrt(np.diag(self.covariance))


def solve(
    views: Sequence[BoardView],
    width: int,
    height: int,
    lens: CalibratedLens = CalibratedLens.BROWN,
) -> Solution:
    """Calibrate the camera that took the views.

    Args:
        views: of the board.
        width, height: of the sensor's picture, px.
        lens: model of the lens.

    Raises:
        InputError: too few views fit together, or the adjustment fails; the message says what to do.
    """
    kept, rejected = list(views), dict[str, str]()
    before = sum(len(view.ids) for view in kept)
    solution: Solution | None = None
    for _ in range(ROUNDS):
        if len(kept) < MIN_VIEWS:
            raise InputError(
                f"only {len(kept)} of {len(views)} views of the board fit together; at least {MIN_VIEWS} are"
                " needed, 20 are good: hold the board flat and still, in focus, and take it from many sides"
            )
        solution = adjust(kept, width, height, None if solution is None else solution.camera, lens)
        trimmed = [_trimmed(view, r) for view, r in zip(kept, solution.residuals, strict=True)]
        # A wrong corner distorts its view's pose, so views are only rejected once no corner is.
        unchanged = {view.name for view, less in zip(kept, trimmed, strict=True) if len(view.ids) == len(less.ids)}
        bad = _bad_views(solution, unchanged)
        rejected |= bad
        if not bad and len(unchanged) == len(kept):
            break
        kept = [view for view in trimmed if view.name not in bad and len(view.ids) >= MIN_CORNERS]
    if solution is None:
        raise InputError("no views of the board")
    gone = {view.name for view in views} - {view.name for view in solution.views} - set(rejected)
    rejected |= dict.fromkeys(gone, "most of its corners do not fit")
    lost = before - sum(len(v.ids) for v in views if v.name in rejected) - sum(len(v.ids) for v in solution.views)
    return replace(solution, rejected=rejected, corners_left_out=lost)


def information(view: BoardView, camera: Camera, cam_from_board: Array) -> tuple[Array, Array]:
    """Information (P,P) on the intrinsics of a view's corners at 1 px, its pose unknown, and their Jacobian (N·2,P)."""
    _, intrinsics, pose = project(view.points_in_board, camera, cam_from_board)
    # Changes that a change of the pose explains as well carry no information on the camera.
    left = without_span(pose, intrinsics)
    return left.T @ left, left


def pixel_uncertainty(solution: Solution, pixels: Array) -> Array:
    """(N,) expanded uncertainty, px with k = 2 in the worst direction, of where a ray is seen, at pixels (N,2).

    The part that a rotation of the camera explains over these pixels is removed, because no application notices it.
    NaN where a fisheye sees nothing within the angle that the engine uses, see `seen_by_lens`.
    """
    with np.errstate(all="ignore"):  # strong distortion may give no ray for pixels far from all corners
        rays = solution.camera.unproject(pixels)
        seen = seen_by_lens(solution.camera, rays)
        if not seen.any():
            return np.full(len(pixels), np.inf)
        _, intrinsics, pose = project(rays[seen], solution.camera, np.eye(4))
    if not all(np.isfinite(one).all() for one in (solution.covariance, intrinsics, pose)):
        return np.full(len(pixels), np.inf)
    blocks = without_span(pose[:, :3], intrinsics).reshape(-1, 2, intrinsics.shape[1])
    covariance = np.einsum("nij,jk,nlk->nil", blocks, solution.covariance, blocks)
    uncertainty = np.full(len(pixels), np.nan)
    uncertainty[seen] = K * np.sqrt(np.maximum(np.linalg.eigvalsh(covariance)[:, -1], 0.0))
    return uncertainty


def seen_by_lens(camera: Camera, rays: Array) -> NDArray[np.bool_]:
    """(N,) whether rays (N,3) are judged: all of a Brown lens, of a fisheye those that `Undistorter` shows."""
    if lens_of(camera) is CalibratedLens.BROWN:
        return np.ones(len(rays), dtype=bool)
    slope = float(np.tan(np.deg2rad(MAX_HALF_ANGLE_DEG)))
    with np.errstate(invalid="ignore"):
        return np.asarray(np.hypot(rays[:, 0], rays[:, 1]) <= slope)


def picture_grid(width: int, height: int, columns: int = 9, rows: int = 7) -> Array:
    """(columns·rows,2) pixels from corner to corner of the picture, row by row."""
    u, v = np.meshgrid(np.linspace(0, width - 1, columns), np.linspace(0, height - 1, rows))
    return np.stack([u.ravel(), v.ravel()], axis=1)


# --- adjustment ----------------------------------------------------------------------------------------------


def adjust(views: Sequence[BoardView], width: int, height: int, start: Camera | None, lens: CalibratedLens) -> Solution:
    """One adjustment of intrinsics and poses, without any rejection.

    Args:
        views: of the board.
        width, height: of the sensor's picture, px.
        start: a camera near the solution, or None.
        lens: model of the lens.

    Raises:
        InputError: no camera explains the views.
    """
    solver = adjust_fisheye if lens is CalibratedLens.FISHEYE else _adjust_brown
    try:
        found, poses = solver(views, width, height, start)
    except InputError as error:
        raise InputError(
            "no camera explains the views of the board; tilt it by 20° to 45° to all sides, take it from near and"
            " far, and check that --board is the one in the pictures"
        ) from error
    residuals = [
        view.pixels - project(view.points_in_board, found, pose)[0] for view, pose in zip(views, poses, strict=True)
    ]
    covariance = _covariance(views, found, poses, residuals)
    rms = float(np.sqrt(np.mean(np.concatenate(residuals) ** 2)))
    return Solution(
        found,
        covariance,
        tuple(views),
        cams_from_board=poses,
        residuals=tuple(residuals),
        rms_px=rms,
        rejected={},
        corners_left_out=0,
    )


def _adjust_brown(views: Sequence[BoardView], width: int, height: int, start: Camera | None) -> tuple[Camera, Array]:
    """The camera with Brown's terms and the poses (V,4,4), by OpenCV."""
    import cv2

    objects = [view.points_in_board.astype(np.float32)[:, None] for view in views]
    images = [view.pixels.astype(np.float32)[:, None] for view in views]
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-10)
    matrix, dist = (None, None) if start is None else (start.matrix, start.dist.copy())
    flags = 0 if start is None else cv2.CALIB_USE_INTRINSIC_GUESS
    try:
        _, k, d, turns, shifts = cv2.calibrateCamera(
            objects, images, (width, height), matrix, dist, flags=flags, criteria=criteria
        )
        fx, fy, cx, cy = (float(k[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
        found = Camera(width, height, fx, fy, cx, cy, np.ravel(d)[:5])
    except (cv2.error, ValueError) as error:
        raise InputError("OpenCV finds no camera") from error
    poses = np.array(
        [
            rigid(cv2.Rodrigues(np.asarray(turn))[0], np.asarray(shift).ravel())
            for turn, shift in zip(turns, shifts, strict=True)
        ]
    )
    return found, poses


def _covariance(views: Sequence[BoardView], camera: Camera, poses: Array, residuals: Sequence[Array]) -> Array:
    """(P,P) covariance: for each parameter the larger of the adjustment's and of the scatter between views."""
    size = len(PARAMETERS_OF[lens_of(camera)])
    total, scatter, squares = np.zeros((size, size)), np.zeros((size, size)), 0.0
    for view, pose, residual in zip(views, poses, residuals, strict=True):
        one, jacobian = information(view, camera, pose)
        score = jacobian.T @ residual.ravel()
        total += one
        scatter += np.outer(score, score)
        squares += float(np.sum(residual**2))
    count = 2 * sum(len(view.ids) for view in views)
    freedom = count - 6 * len(views) - size
    unit = np.sqrt(np.maximum(np.diag(total), 1e-30))
    values, vectors = np.linalg.eigh(total / np.outer(unit, unit))
    if freedom <= 0 or values[0] < 1e-12:
        return np.full((size, size), np.inf)
    inverse = (vectors / values) @ vectors.T / np.outer(unit, unit)
    own = inverse * squares / freedom
    # Correction for the degrees of freedom, as in HC1 of MacKinnon and White (1985).
    between = inverse @ scatter @ inverse * len(views) / max(1.0, len(views) - size / 2.0)
    grow = np.sqrt(np.maximum(1.0, np.diag(between) / np.diag(own)))
    return np.asarray(own * np.outer(grow, grow))


def _bad_views(solution: Solution, unchanged: set[str]) -> dict[str, str]:
    """Views that fit much worse than the others, at most a third of them at once, the worst first."""
    rms = np.array([np.sqrt(np.mean(residual**2)) for residual in solution.residuals])
    # A robust size, because single wrong corners are rejected by themselves.
    size = np.array([np.median(np.abs(residual)) / 0.6745 for residual in solution.residuals])
    usual = float(np.median(size))
    limit = max(VIEW_OUTLIER * usual, VIEW_FLOOR_PX)
    bad = [int(i) for i in np.argsort(-size) if size[i] > limit and solution.views[i].name in unchanged]
    bad = bad[: max(1, len(rms) // 3)]
    return {
        solution.views[i].name: f"does not fit the others ({rms[i]:.2f} px, the others {usual:.2f} px)" for i in bad
    }


def _trimmed(view: BoardView, residual: Array) -> BoardView:
    """The view without corners whose residuals are outliers."""
    length = np.linalg.norm(residual, axis=1)
    # The median length of a two-dimensional normal error is 1.1774 σ.
    keep = length < CORNER_OUTLIER * max(float(np.median(length)) / 1.1774, 0.02)
    if keep.all():
        return view
    return replace(view, ids=view.ids[keep], points_in_board=view.points_in_board[keep], pixels=view.pixels[keep])
