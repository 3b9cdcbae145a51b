"""Scale from coded targets of known size, and from known distances between cameras.

Markers and boards are found with OpenCV (Garrido-Jurado et al., "Automatic generation and detection of highly
reliable fiducial markers under occlusion", Pattern Recognition 2014); their corners are triangulated from all photos,
by least squares of the reprojection error through the lens (Hartley & Zisserman 2004), with the poses as they are.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.core.parallel import pool
from arview.geometry import Array
from arview.reconstruction.scale.edges import choose_steps, find_steps, linear_light
from arview.reconstruction.scale.similarity import fit_points
from arview.reconstruction.scale.specs import Board, Rig, ScaleBar, ScaleSources, Tags
from arview.reconstruction.scale.types import ScaleEvidence
from arview.reconstruction.types import PosedPhoto

Key = tuple[str, int, int]
"""A corner: what it is on (``board 0``, or a dictionary), its id there, and which corner of a tag."""
PRINT_STD = 2e-4
"""Relative standard deviation of the size of a printed target."""
LEAST_SIGMA_PX = 0.05
"""Corners are never taken to be better than this."""
MIN_ANGLE_DEG = 2.0
"""Corners seen under a smaller parallax have no place."""
TAG_EDGE_STD_PX = 0.1
"""All sides of tags may lie so far out or in together: an unknown tone curve. Chessboard corners and centres do not."""
SIDE_REACH_PX = 3.0
"""How far from where OpenCV sees it the side of a tag is looked for."""
OUTLIER = 4.0
"""Observations off by so many standard deviations are left out."""


@dataclass(frozen=True)
class Corners:
    """Triangulated corners: by key the place (3,) and covariance (3,3), unit of the reconstruction; and σ in px."""

    points: dict[Key, Array]
    covariances: dict[Key, Array]
    sigma_px: float


def find_corners(gray: NDArray[np.uint8], camera: Camera, sources: ScaleSources) -> dict[Key, Array]:
    """Corners (2,) px of all boards and tags that one photo (H,W) uint8 shows, integers at pixel centres."""
    import cv2

    found: dict[Key, Array] = {}
    light = linear_light(gray)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    taken: dict[str, set[int]] = defaultdict(set)
    for number, board in enumerate(sources.boards):
        drawn: Any = cv_board(board)
        taken[board.dictionary] |= {int(i) for i in drawn.getIds().ravel()}
        if board.is_charuco:
            charuco = cv2.aruco.CharucoDetector(drawn, detectorParams=parameters)
            corners, ids, _, _ = charuco.detectBoard(gray)
            for corner, index in zip(_flat(corners, 2), _flat(ids, 1), strict=True):
                found[f"board {number}", int(index[0]), 0] = corner
    bars = {bar.dictionary: {b.first for b in sources.bars} | {b.second for b in sources.bars} for bar in sources.bars}
    grids = {board.dictionary for board in sources.boards if not board.is_charuco}
    for name in sorted({tags.dictionary for tags in sources.tags} | bars.keys() | grids):
        detector = cv2.aruco.ArucoDetector(_dictionary(name), parameters)
        quads, ids, _ = detector.detectMarkers(gray)
        for quad, index in zip(quads, _flat(ids, 1), strict=True):
            for corner, place in enumerate(refined_quad(light, camera, _flat(quad, 2))):
                found[name, int(index[0]), corner] = place
    return found


def refined_quad(light: NDArray[np.float32], camera: Camera, quad: Array) -> Array:
    """Corners (4,2) of a tag where straight lines through its four sides meet, the lens taken into account.

    OpenCV's corner refinement is made for chessboards: at the lone corner of a tag it ends inside, by 0.1 to 0.3 px.
    """
    lines = []
    for a, b in zip(quad, np.roll(quad, -1, axis=0), strict=True):
        along = (b - a) / np.linalg.norm(b - a)
        normal = np.array([-along[1], along[0]])
        count = int(np.clip(np.linalg.norm(b - a) / 2.0, 8, 60))
        points = a + np.linspace(0.12, 0.88, count)[:, None] * (b - a)
        offsets, slopes, _ = find_steps(light, points, np.tile(normal, (count, 1)), SIDE_REACH_PX, 1.0, 1.0)
        offset, slope = choose_steps(offsets, slopes, 0.5 * SIDE_REACH_PX, 6.0)
        is_found = slope != 0.0
        is_found &= np.abs(offset - np.median(offset[is_found])) < 0.6 if is_found.any() else False
        if np.count_nonzero(is_found) < 6:
            return quad
        rays = camera.unproject(points[is_found] + offset[is_found, None] * normal)
        # The plane through the camera that the rays of a side lie in.
        lines.append(np.linalg.svd(rays)[2][2])
    corners = np.array([np.cross(lines[k - 1], lines[k]) for k in range(4)])
    with np.errstate(divide="ignore", invalid="ignore"):
        refined = camera.project(corners / corners[:, 2:])
    moved = np.linalg.norm(refined - quad, axis=1)
    return refined if np.all(moved < SIDE_REACH_PX) else quad


def scale_from_targets(
    photos: Sequence[PosedPhoto], read_gray: Callable[[PosedPhoto], NDArray[np.uint8]], sources: ScaleSources
) -> tuple[list[ScaleEvidence], list[str]]:
    """Evidence of the boards, tags and scale bars in view, and in words what was not found.

    Args:
        photos: placed photos.
        read_gray: the (H,W) uint8 picture of one, upright, of its camera's size.
        sources: what is known to be there.
    """
    if not (sources.boards or sources.tags or sources.bars):
        return [], []
    seen = list(pool().map(lambda photo: find_corners(read_gray(photo), photo.camera, sources), photos))
    corners = triangulate([p.camera for p in photos], [p.cam_from_scan for p in photos], seen)
    evidence: list[ScaleEvidence] = []
    missing: list[str] = []
    for number, board in enumerate(sources.boards):
        _add(evidence, missing, _board_evidence(board, number, corners), str(board))
    for tags in sources.tags:
        in_boards = {
            int(i) for b in sources.boards if b.dictionary == tags.dictionary for i in cv_board(b).getIds().ravel()
        }
        what = f"tags {tags.dictionary.removeprefix('DICT_')} of {tags.side_mm:g} mm"
        _add(evidence, missing, _tag_evidence(tags, in_boards, corners, _side_px(seen, tags), what), what)
    for bar in sources.bars:
        what = f"scale bar from tag {bar.first} to tag {bar.second}, {bar.length_mm:g} mm"
        _add(evidence, missing, _bar_evidence(bar, corners, what), what)
    return evidence, missing


def scale_from_rig(photos: Sequence[PosedPhoto], rig: Rig) -> tuple[list[ScaleEvidence], list[str]]:
    """Evidence of known places of, and distances between, the cameras; and in words what was missing."""
    centres = {photo.name: photo.centre_in_scan for photo in photos}
    evidence: list[ScaleEvidence] = []
    missing: list[str] = []
    if rig.centres_mm:
        common = [name for name in centres if name in rig.centres_mm]
        if len(common) < 3:
            missing.append(f"camera rig: {len(common)} of its photos were placed, three are needed")
        else:
            fit = fit_points(np.array([centres[n] for n in common]), np.array([rig.centres_mm[n] for n in common]))
            detail = f"camera rig: centres of {len(common)} cameras, {fit.rms_mm:.2f} mm rms"
            evidence.append(ScaleEvidence("rig", fit.similarity.scale, fit.scale_std, detail))
    known = [(a, b, mm) for a, b, mm in rig.distances_mm if a in centres and b in centres]
    if known:
        lengths = np.array([np.linalg.norm(centres[a] - centres[b]) for a, b, _ in known])
        mm = np.array([mm for _, _, mm in known])
        scale = float(lengths @ mm / (lengths @ lengths))
        left = mm - scale * lengths
        # With one distance its own error is not known: a thousandth is taken.
        std = float(np.sqrt(left @ left / (len(known) - 1) / (mm @ mm))) if len(known) > 1 else 1e-3
        detail = f"camera rig: {len(known)} distances between cameras, {np.sqrt(np.mean(left**2)):.2f} mm rms"
        evidence.append(ScaleEvidence("rig", scale, max(std, 1e-6), detail))
    elif rig.distances_mm:
        missing.append("camera rig: no distance between two photos that were placed")
    return evidence, missing


def triangulate(
    cameras: Sequence[Camera], cams_from_scan: Sequence[Array], seen: Sequence[dict[Key, Array]]
) -> Corners:
    """Places of corners that at least two photos show, refined together; outliers are left out."""
    keys = sorted({key for corners in seen for key in corners})
    index = {key: i for i, key in enumerate(keys)}
    views = [
        (camera, pose, np.array([index[k] for k in corners], dtype=np.intp), np.array(list(corners.values())))
        for camera, pose, corners in zip(cameras, cams_from_scan, seen, strict=True) if corners
    ]  # fmt: skip
    normal, right = np.zeros((len(keys), 3, 3)), np.zeros((len(keys), 3))
    directions: list[list[Array]] = [[] for _ in keys]
    for camera, pose, which, pixels in views:
        # Rays: the point nearest to all of them is the start.
        rays = camera.unproject(pixels) @ pose[:3, :3]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
        np.add.at(normal, which, across)
        np.add.at(right, which, across @ (-pose[:3, :3].T @ pose[:3, 3]))
        for i, ray in zip(which, rays, strict=True):
            directions[i].append(ray)
    good = np.array([len(d) >= 2 and _spread_deg(np.array(d)) > MIN_ANGLE_DEG for d in directions], dtype=bool)
    points = np.zeros((len(keys), 3))
    points[good] = np.linalg.solve(normal[good], right[good][:, :, None])[:, :, 0]
    sigma_px = np.inf
    for _ in range(8):
        normal, right = np.zeros((len(keys), 3, 3)), np.zeros((len(keys), 3))
        counts, errors = np.zeros(len(keys), dtype=int), []
        for camera, pose, which, pixels in views:
            in_cam = points[which] @ pose[:3, :3].T + pose[:3, 3]
            now = camera.project(in_cam)
            left = pixels - now
            size = np.linalg.norm(left, axis=1)
            keep = good[which] & (size < OUTLIER * sigma_px)
            errors.append(size[keep])
            delta = 1e-6 * in_cam[:, 2:]
            jacobian = np.stack([(camera.project(in_cam + delta * a) - now) / delta for a in pose[:3, :3].T], axis=2)
            # Huber's weights (1964), about the spread of the last round.
            weights = np.where(keep, np.minimum(1.0, 1.5 * sigma_px / np.maximum(size, 1e-12)), 0.0)
            weighted = np.nan_to_num(jacobian * weights[:, None, None])
            np.add.at(normal, which, np.einsum("nij,nik->njk", weighted, np.nan_to_num(jacobian)))
            np.add.at(right, which, np.einsum("nij,ni->nj", weighted, np.nan_to_num(left)))
            np.add.at(counts, which, keep)
        good &= counts >= 2
        if not good.any():
            break
        sizes = np.concatenate(errors)
        # The median length of a two-dimensional error is 1.1774 σ.
        sigma_px = max(LEAST_SIGMA_PX, float(np.median(sizes)) / 1.1774)
        points[good] += np.linalg.solve(normal[good], right[good][:, :, None])[:, :, 0]
    chosen = np.flatnonzero(good)
    covariances = {keys[i]: np.linalg.inv(normal[i]) * sigma_px**2 for i in chosen}
    return Corners({keys[i]: points[i] for i in chosen}, covariances, sigma_px)


def _board_evidence(board: Board, number: int, corners: Corners) -> ScaleEvidence | None:
    drawn = cv_board(board)
    on_board: dict[Key, Array] = {}
    if board.is_charuco:
        for index, place in enumerate(drawn.getChessboardCorners()):
            on_board[f"board {number}", index, 0] = np.asarray(place, dtype=np.float64)
    else:
        for marker, quad in zip(drawn.getIds().ravel(), drawn.getObjPoints(), strict=True):
            for corner, place in enumerate(quad):
                on_board[board.dictionary, int(marker), corner] = np.asarray(place, dtype=np.float64)
    common = [key for key in on_board if key in corners.points]
    if len(common) < 4:
        return None
    fit = fit_points(np.array([corners.points[k] for k in common]), np.array([on_board[k] for k in common]))
    detail = f"{board}: {len(common)} corners, {fit.rms_mm:.3f} mm rms, {corners.sigma_px:.2f} px"
    return ScaleEvidence("board", fit.similarity.scale, float(np.hypot(fit.scale_std, PRINT_STD)), detail)


def _side_px(seen: Sequence[dict[Key, Array]], tags: Tags) -> float:
    """Median side of a dictionary's tags in the photos."""
    sides = [
        float(np.linalg.norm(corners[key] - corners[(*key[:2], 1)]))
        for corners in seen for key in corners if key[0] == tags.dictionary and key[2] == 0
    ]  # fmt: skip
    return float(np.median(sides)) if sides else 1.0


def _tag_evidence(tags: Tags, in_boards: set[int], corners: Corners, side_px: float, what: str) -> ScaleEvidence | None:
    half = 0.5 * tags.side_mm
    square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
    ids = sorted({key[1] for key in corners.points if key[0] == tags.dictionary} - in_boards)
    fits = []
    for index in ids:
        keys = [(tags.dictionary, index, corner) for corner in range(4)]
        if (not tags.ids or index in tags.ids) and all(key in corners.points for key in keys):
            fits.append(fit_points(np.array([corners.points[key] for key in keys]), square))
    if not fits:
        return None
    # Tags are of one size: the median is not led astray by one that was taken for another.
    logs = np.log([fit.similarity.scale for fit in fits])
    middle = float(np.median(logs))
    from_residuals = float(np.median([fit.scale_std for fit in fits]))
    scatter = max(1.4826 * float(np.median(np.abs(logs - middle))), from_residuals)
    from_curve = 2.0 * TAG_EDGE_STD_PX / side_px
    std = float(np.linalg.norm([1.2533 * scatter / np.sqrt(len(fits)), from_curve, PRINT_STD]))
    rms_mm = float(np.sqrt(np.mean([fit.rms_mm**2 for fit in fits])))
    detail = f"{what}: {len(fits)} of them, {rms_mm:.3f} mm rms, {corners.sigma_px:.2f} px"
    return ScaleEvidence("tag", float(np.exp(middle)), std, detail)


def _bar_evidence(bar: ScaleBar, corners: Corners, what: str) -> ScaleEvidence | None:
    middles, covariance = [], np.zeros((3, 3))
    for index in (bar.first, bar.second):
        keys = [(bar.dictionary, index, corner) for corner in range(4)]
        if not all(key in corners.points for key in keys):
            return None
        middles.append(np.mean([corners.points[key] for key in keys], axis=0))
        covariance += sum(corners.covariances[key] for key in keys) / 16.0
    between = middles[1] - middles[0]
    length = float(np.linalg.norm(between))
    along = between / length
    std = float(np.hypot(np.sqrt(along @ covariance @ along) / length, bar.std_mm / bar.length_mm))
    return ScaleEvidence("scale_bar", bar.length_mm / length, std, f"{what} ± {bar.std_mm:g} mm")


def _add(evidence: list[ScaleEvidence], missing: list[str], found: ScaleEvidence | None, what: str) -> None:
    if found is None:
        missing.append(f"{what}: not seen from two sides in the photos")
    else:
        evidence.append(found)


def cv_board(board: Board) -> Any:
    """The board as OpenCV has it, in mm."""
    import cv2

    size = (board.columns, board.rows)
    if board.is_charuco:
        return cv2.aruco.CharucoBoard(size, board.cell_mm, board.marker_mm, _dictionary(board.dictionary))
    return cv2.aruco.GridBoard(size, board.marker_mm, board.cell_mm - board.marker_mm, _dictionary(board.dictionary))


def _dictionary(name: str) -> Any:
    import cv2

    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def _flat(values: Any, columns: int) -> Array:
    """OpenCV's result as (N,columns), (0,columns) when it is None."""
    return np.asarray([] if values is None else values, dtype=np.float64).reshape(-1, columns)


def _spread_deg(rays: Array) -> float:
    """Largest angle between the first and another of some unit rays (N,3)."""
    return float(np.rad2deg(np.arccos(np.clip((rays @ rays[0]).min(), -1.0, 1.0))))
