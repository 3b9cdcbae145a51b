"""Verdict on a calibration, in words: coverage of the views, uncertainty, and what to do."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from arview.calibration.solve import K, Solution, picture_grid, pixel_uncertainty, seen_by_lens
from arview.geometry import Array


class Grade(StrEnum):
    """Grade of a calibration."""

    GOOD = "good"
    USABLE = "usable"
    NOT_ENOUGH = "not enough"


GOOD_FOCAL = 0.002
"""Relative U of the focal length: 0.2 % of the distance, 1 mm at arm's length."""
USABLE_FOCAL = 0.01
"""A guess from EXIF data is as good as more than this."""
GOOD_PIXEL = 5e-4
"""U of where a ray is seen, at the worst of 63 places: 1 px at 1080p."""
USABLE_PIXEL = 3e-3
"""Limit of usable for the same."""
USABLE_RMS = 1e-3
"""Residuals; above, the board is not flat, or is another one."""
GOOD_COVERAGE = 0.7
"""Share of the picture's cells with a corner of the board."""
USABLE_COVERAGE = 0.4
"""Limit of usable for the same."""
TILTED_DEG = 20.0
"""Views tilted by more than this determine the focal length."""
MIN_TILTED = 4
"""Number of such views, to at least two sides."""
GOOD_RANGE = 1.3
"""Distance of the farthest over the nearest board."""


@dataclass(frozen=True)
class CalibrationVerdict:
    """Verdict on a calibration.

    Attributes:
        grade: of the whole.
        focal_u: relative U of the focal length.
        centre_u_px: U of the principal point.
        pixel_u_px: U of where a ray is seen: median and maximum over the picture.
        coverage: share of the picture's 8×6 cells that contain a corner.
        cells: (6,8) number of corners in each cell, NaN where a fisheye sees nothing that is used.
        tilts_deg: smallest, median and largest angle between the board and the picture plane.
        distance_ratio: distance of the farthest over the nearest board.
        reasons: why it is not better.
        advice: what to do about it.
    """

    grade: Grade
    focal_u: float
    centre_u_px: float
    pixel_u_px: tuple[float, float]
    coverage: float
    cells: Array
    tilts_deg: tuple[float, float, float]
    distance_ratio: float
    reasons: tuple[str, ...]
    advice: tuple[str, ...]

    def with_lenses(self, advice: str) -> CalibrationVerdict:
        """The verdict with the advice to use another lens model, with which it is usable at best; as it is if empty."""
        if not advice:
            return self
        grade = Grade.USABLE if self.grade is Grade.GOOD else self.grade
        reasons = (*self.reasons, "another lens model explains the corners better")
        return replace(self, grade=grade, reasons=reasons, advice=(advice, *self.advice))


def assess(solution: Solution) -> CalibrationVerdict:
    """Compare a calibration with the limits, and say what to do if it is not good."""
    camera = solution.camera
    diagonal = float(np.hypot(camera.width, camera.height))
    std = dict(zip(solution.parameters, solution.std, strict=True))
    focal_u = K * float(max(std["fx"] / camera.fx, std["fy"] / camera.fy))
    centre_u = K * float(max(std["cx"], std["cy"]))
    pixel_u = pixel_uncertainty(solution, picture_grid(camera.width, camera.height))
    cells = _cells(solution)
    coverage = float(np.mean(cells[~np.isnan(cells)] > 0))
    tilts, sides, distances = _attitudes(solution, TILTED_DEG)
    ratio = float(distances.max() / distances.min())
    worst = float(np.nanmax(pixel_u))

    grades = [
        _grade(focal_u, GOOD_FOCAL, USABLE_FOCAL),
        _grade(worst / diagonal, GOOD_PIXEL, USABLE_PIXEL),
        _grade(solution.rms_px / diagonal, 0.5 * USABLE_RMS, USABLE_RMS),
        _grade(-coverage, -GOOD_COVERAGE, -USABLE_COVERAGE),
    ]
    reasons = [
        f"the focal length is known to ± {100 * focal_u:.2f} % only"
        if np.isfinite(focal_u)
        else "the views do not determine the focal length",
        f"a ray at the worst place of the picture is known to ± {worst:.2f} px only"
        if np.isfinite(worst)
        else "the views do not determine where rays are seen",
        f"the corners scatter by {solution.rms_px:.2f} px",
        f"corners of the board were seen in only {100 * coverage:.0f} % of the picture",
    ]
    why = [reason for reason, grade in zip(reasons, grades, strict=True) if grade is not Grade.GOOD]
    order = list(Grade)
    grade = max(grades, key=order.index)
    advice: list[str] = []
    if grade is not Grade.GOOD:
        tilted = int(np.sum(tilts >= TILTED_DEG))
        focal_is_poor = grades[0] is not Grade.GOOD
        if focal_is_poor and (tilted < MIN_TILTED or sides < 2):
            advice.append("tilt the board more, by 30° to 45°, to the left, the right, upwards and downwards")
        if grades[3] is not Grade.GOOD or (grades[1] is not Grade.GOOD and not focal_is_poor):
            missing = _empty_corners(cells)
            where = f": none was seen in the {', '.join(missing)}" if missing else ""
            advice.append(f"bring the board to the corners and edges of the picture{where}")
        if focal_is_poor and ratio < GOOD_RANGE:
            advice.append("take it from nearer and from farther: once filling the picture, once half of it")
        if len(solution.views) < 15:
            advice.append(f"take more views: {len(solution.views)} were used, 20 to 40 are good")
        if grades[2] is not Grade.GOOD:
            advice.append(
                "glue the board on something flat (glass, aluminium), hold still, use more light, and lock the focus"
            )
        if not advice:
            advice.append("take more views, tilted to all sides, with the board filling the picture")
    return CalibrationVerdict(
        grade,
        focal_u,
        centre_u,
        pixel_u_px=(float(np.nanmedian(pixel_u)), worst),
        coverage=coverage,
        cells=cells,
        tilts_deg=(float(tilts.min()), float(np.median(tilts)), float(tilts.max())),
        distance_ratio=ratio,
        reasons=tuple(why),
        advice=tuple(advice),
    )


def _grade(value: float, good: float, usable: float) -> Grade:
    """Grade of a value against two limits; smaller is better."""
    if value <= good:
        return Grade.GOOD
    return Grade.USABLE if value <= usable else Grade.NOT_ENOUGH


def _cells(solution: Solution) -> Array:
    """Number of corners in each of 8×6 cells of the picture; NaN where the lens shows nothing that is judged."""
    pixels = np.concatenate([view.pixels for view in solution.views])
    camera = solution.camera
    sides = (-0.5, camera.height - 0.5), (-0.5, camera.width - 0.5)
    upright = camera.height > camera.width
    shape = (8, 6) if upright else (6, 8)
    cells, rows, columns = np.histogram2d(pixels[:, 1], pixels[:, 0], bins=shape, range=sides)
    u, v = np.meshgrid(0.5 * (columns[1:] + columns[:-1]), 0.5 * (rows[1:] + rows[:-1]))
    with np.errstate(all="ignore"):
        rays = camera.unproject(np.stack([u.ravel(), v.ravel()], axis=-1))
    cells[(cells == 0) & ~seen_by_lens(camera, rays).reshape(shape)] = np.nan
    return np.asarray(cells)


def _attitudes(solution: Solution, tilted_deg: float) -> tuple[Array, int, Array]:
    """Tilt of each view in degrees, number of sides (of four) to which tilted views lean, and distances in mm."""
    middles = np.array(
        [
            pose[:3, :3] @ view.points_in_board.mean(axis=0) + pose[:3, 3]
            for view, pose in zip(solution.views, solution.cams_from_board, strict=True)
        ]
    )
    normals = solution.cams_from_board[:, :3, 2]
    # A board parallel to the picture plane does not determine the focal length, wherever it is seen.
    tilts = np.degrees(np.arccos(np.clip(np.abs(normals[:, 2]), 0.0, 1.0)))
    sides = np.floor(np.arctan2(normals[:, 1], normals[:, 0]) / (np.pi / 2))
    return tilts, len(set(sides[tilts >= tilted_deg])), np.linalg.norm(middles, axis=1)


def _empty_corners(cells: Array) -> list[str]:
    """Names of the picture's corners without a corner of the board."""
    names = {
        "upper left": (0, 0),
        "upper right": (0, -1),
        "lower left": (-1, 0),
        "lower right": (-1, -1),
    }
    return [name for name, place in names.items() if cells[place] == 0]
