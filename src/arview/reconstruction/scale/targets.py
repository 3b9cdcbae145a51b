"""Scale from coded targets of known size, and from known positions of, or distances between, the cameras.

Corners of boards and tags, also of layouts (`scale.layout`), are found in every photo (`fiducials.targets`) and
triangulated with the poses of the reconstruction; their known distances then give millimetres per unit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from arview.core.fits import robust_sigma
from arview.core.parallel import pool
from arview.fiducials import Board, CornerKey, Tags, cv_board, find_corners
from arview.geometry import Array
from arview.reconstruction.scale.layout import scale_from_layout
from arview.reconstruction.scale.similarity import fit_points
from arview.reconstruction.scale.specs import Rig, ScaleBar, ScaleSources
from arview.reconstruction.scale.triangulation import TriangulatedCorners, triangulate_corners
from arview.reconstruction.scale.types import ScaleEvidence
from arview.reconstruction.types import PosedPhoto

PRINT_STD = 2e-4
"""Relative standard deviation of the size of a printed target."""
TAG_EDGE_STD_PX = 0.1
"""Standard deviation of a common shift of all sides of tags, outwards or inwards, by the unknown tone curve. Chessboard
corners and the centres of tags are not affected."""
MIN_BOARD_CORNERS = 4
"""Corners that a board needs for its scale."""
SINGLE_DISTANCE_STD = 1e-3
"""Relative standard deviation of one distance between cameras; the residuals of several show it, that of one does
not."""
MIN_RIG_STD = 1e-6
"""Lower bound of the relative standard deviation from distances between cameras."""


def scale_from_targets(
    photos: Sequence[PosedPhoto],
    read_gray: Callable[[PosedPhoto], NDArray[np.uint8]],
    sources: ScaleSources,
) -> tuple[list[ScaleEvidence], list[str]]:
    """Scale evidence of the boards, tags, layouts and scale bars in view, and messages about those not found.

    Args:
        photos: placed photos.
        read_gray: returns the upright (H,W) uint8 picture of a photo, of the size of its camera.
        sources: the targets that may be in view.
    """
    if not (sources.boards or sources.tags or sources.bars or sources.layouts):
        return [], []
    dictionaries = {tags.dictionary for tags in sources.tags} | {bar.dictionary for bar in sources.bars}
    dictionaries |= {layout.dictionary for layout in sources.layouts}

    def find(photo: PosedPhoto) -> dict[CornerKey, Array]:
        return find_corners(read_gray(photo), photo.camera, sources.boards, dictionaries)

    found = list(pool().map(find, photos))
    corners = triangulate_corners([p.camera for p in photos], [p.cam_from_scan for p in photos], found)
    evidence: list[ScaleEvidence] = []
    missing: list[str] = []
    for layout in sources.layouts:
        side_px = _side_px(found, layout.dictionary)
        known, why = scale_from_layout(layout, corners, TAG_EDGE_STD_PX / side_px)
        evidence += [known] if known else []
        missing += [why] if why else []
    for number, board in enumerate(sources.boards):
        _add(evidence, missing, _board_evidence(board, number, corners), str(board))
    for tags in sources.tags:
        in_boards = {
            int(i) for b in sources.boards if b.dictionary == tags.dictionary for i in cv_board(b).getIds().ravel()
        }
        what = f"tags {tags.dictionary.removeprefix('DICT_')} of {tags.side_mm:g} mm"
        _add(evidence, missing, _tag_evidence(tags, in_boards, corners, _side_px(found, tags.dictionary), what), what)
    for bar in sources.bars:
        what = f"scale bar from tag {bar.first} to tag {bar.second}, {bar.length_mm:g} mm"
        _add(evidence, missing, _bar_evidence(bar, corners, what), what)
    return evidence, missing


def scale_from_rig(photos: Sequence[PosedPhoto], rig: Rig) -> tuple[list[ScaleEvidence], list[str]]:
    """Scale evidence of known camera positions and distances, and messages about what was missing.

    Args:
        photos: placed photos.
        rig: what is known about their cameras.
    """
    centres = {photo.name: photo.centre_in_scan for photo in photos}
    evidence: list[ScaleEvidence] = []
    missing: list[str] = []
    if rig.centres_mm:
        common = [name for name in centres if name in rig.centres_mm]
        if len(common) < 3:
            missing.append(f"camera rig: {len(common)} of its photos were placed; at least three are needed")
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
        std = float(np.sqrt(left @ left / (len(known) - 1) / (mm @ mm))) if len(known) > 1 else SINGLE_DISTANCE_STD
        detail = f"camera rig: {len(known)} distances between cameras, {np.sqrt(np.mean(left**2)):.2f} mm rms"
        evidence.append(ScaleEvidence("rig", scale, max(std, MIN_RIG_STD), detail))
    elif rig.distances_mm:
        missing.append("camera rig: no distance is between two photos that were placed")
    return evidence, missing


def _board_evidence(board: Board, number: int, corners: TriangulatedCorners) -> ScaleEvidence | None:
    """Scale of a similarity from the triangulated corners of a board to their places on it."""
    drawn = cv_board(board)
    on_board: dict[CornerKey, Array] = {}
    if board.is_charuco:
        for index, place in enumerate(drawn.getChessboardCorners()):
            on_board[f"board {number}", index, 0] = np.asarray(place, dtype=np.float64)
    else:
        for marker, quad in zip(drawn.getIds().ravel(), drawn.getObjPoints(), strict=True):
            for corner, place in enumerate(quad):
                on_board[board.dictionary, int(marker), corner] = np.asarray(place, dtype=np.float64)
    common = [key for key in on_board if key in corners.points]
    if len(common) < MIN_BOARD_CORNERS:
        return None
    fit = fit_points(np.array([corners.points[k] for k in common]), np.array([on_board[k] for k in common]))
    detail = f"{board}: {len(common)} corners, {fit.rms_mm:.3f} mm rms, {corners.sigma_px:.2f} px"
    return ScaleEvidence("board", fit.similarity.scale, float(np.hypot(fit.scale_std, PRINT_STD)), detail)


def _side_px(corners_by_photo: Sequence[dict[CornerKey, Array]], dictionary: str) -> float:
    """Median side length, in the photos, of the tags of a dictionary."""
    sides = [
        float(np.linalg.norm(corners[key] - corners[(*key[:2], 1)]))
        for corners in corners_by_photo
        for key in corners
        if key[0] == dictionary and key[2] == 0
    ]
    return float(np.median(sides)) if sides else 1.0


def _tag_evidence(
    tags: Tags, in_boards: set[int], corners: TriangulatedCorners, side_px: float, what: str
) -> ScaleEvidence | None:
    """Median scale of the tags of one size; tags that belong to a board are excluded."""
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
    # All tags have one size, so the median is robust against a tag that was misread.
    logs = np.log([fit.similarity.scale for fit in fits])
    middle = float(np.median(logs))
    from_residuals = float(np.median([fit.scale_std for fit in fits]))
    scatter = max(robust_sigma(logs - middle), from_residuals)
    from_tone_curve = 2.0 * TAG_EDGE_STD_PX / side_px
    std = float(np.linalg.norm([1.2533 * scatter / np.sqrt(len(fits)), from_tone_curve, PRINT_STD]))
    rms_mm = float(np.sqrt(np.mean([fit.rms_mm**2 for fit in fits])))
    detail = f"{what}: {len(fits)} of them, {rms_mm:.3f} mm rms, {corners.sigma_px:.2f} px"
    return ScaleEvidence("tag", float(np.exp(middle)), std, detail)


def _bar_evidence(bar: ScaleBar, corners: TriangulatedCorners, what: str) -> ScaleEvidence | None:
    """Scale from the distance between the centres of the two tags of a scale bar."""
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
