"""From photos or a video of a board to a camera with its uncertainty and a verdict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from arview.calibration.board_view import BoardView
from arview.calibration.choose import ChoiceOptions, choose_views
from arview.calibration.lens_comparison import LensComparison, compare_lenses
from arview.calibration.plain_boards import with_centres
from arview.calibration.projection import CalibratedLens, lens_of
from arview.calibration.solve import MIN_VIEWS, K, Solution, solve
from arview.calibration.verdict import CalibrationVerdict, assess
from arview.calibration.views import BoardSightings, find_views
from arview.camera import Camera, lens_record
from arview.core.progress import StepProgress
from arview.errors import InputError
from arview.fiducials import Board, spec_of
from arview.version import __version__


@dataclass(frozen=True)
class Calibration:
    """A calibration.

    Attributes:
        board: the board in the pictures.
        sightings: what the pictures show.
        solution: the camera.
        verdict: its grade.
        rejected: why pictures are not used, by name.
        lenses: whether the other lens model explains the views better.
    """

    board: Board
    sightings: BoardSightings
    solution: Solution
    verdict: CalibrationVerdict
    rejected: dict[str, str]
    lenses: LensComparison

    @property
    def camera(self) -> Camera:
        """The camera of the sensor's picture, before it is rotated upright."""
        return self.solution.camera

    @property
    def lens(self) -> dict[str, Any]:
        """Record that identifies the lens and its mode, for profiles."""
        return lens_record(self.sightings.exif, self.camera.width, self.camera.height)


def calibrate(
    sources: Sequence[str | Path],
    board: Board,
    choice: ChoiceOptions | None = None,
    progress: StepProgress | None = None,
    lens: CalibratedLens = CalibratedLens.BROWN,
) -> Calibration:
    """Calibrate a camera from photos, or one video, of a ChArUco board, a checkerboard or a grid of circles.

    Args:
        sources: photo files, folders, globs; or one video.
        board: the board in them.
        choice: how views are chosen if there are many.
        progress: called with pictures done and in all.
        lens: model of the lens.

    Raises:
        InputError: nothing can be read, there is no board, there are too few views, or no camera explains them.
    """
    sightings = find_views(sources, board, progress)
    if len(sightings.views) < MIN_VIEWS:
        why = "; ".join(f"{name} {reason}" for name, reason in list(sightings.rejected.items())[:3])
        raise InputError(
            f"{sightings.label}: the board is seen in {len(sightings.views)} of {sightings.searched} pictures, at"
            f" least {MIN_VIEWS} are needed, 20 are good" + (f" ({why})" if why else "")
        )
    size = (sightings.width, sightings.height)
    views: Sequence[BoardView] = sightings.views
    try:
        views, left_out = choose_views(views, *size, choice, lens)
        solution = solve(views, *size, lens)
        if any(view.radius_mm > 0.0 for view in views):
            views = [with_centres(view, solution.camera) for view in views]
            solution = solve(views, *size, lens)
    except InputError as error:
        advice = compare_lenses(views[: ChoiceOptions.max_views], *size, lens).advice
        raise InputError(f"{sightings.label}: {error}{f'; {advice}' if advice else ''}") from error
    rejected = sightings.rejected | left_out | solution.rejected
    lenses = compare_lenses(views, *size, lens)
    verdict = assess(solution).with_lenses(lenses.advice)
    return Calibration(board, sightings, solution, verdict, rejected, lenses)


def record_of(calibration: Calibration) -> dict[str, Any]:
    """Contents of the camera file besides the intrinsics: ``calibration`` and ``lens``. Infinite values are null."""
    solution, verdict, seen = calibration.solution, calibration.verdict, calibration.sightings

    def plain(value: float) -> float | None:
        return float(value) if np.isfinite(value) else None

    return {
        "calibration": {
            "tool": f"arview {__version__}",
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
            "board": spec_of(calibration.board),
            "source": seen.label,
            "verdict": verdict.grade.value,
            "reasons": list(verdict.reasons),
            "advice": list(verdict.advice),
            "pictures": seen.searched,
            "views_found": len(seen.views),
            "views_used": len(solution.views),
            "corners_used": sum(len(view.ids) for view in solution.views),
            "rms_px": solution.rms_px,
            "lens": str(lens_of(solution.camera)),
            "parameters": list(solution.parameters),
            "uncertainty_k": K,
            "uncertainty": {name: plain(K * std) for name, std in zip(solution.parameters, solution.std, strict=True)},
            "covariance": [[plain(value) for value in row] for row in solution.covariance],
            "focal_uncertainty": plain(verdict.focal_u),
            "pixel_uncertainty_px": {"median": plain(verdict.pixel_u_px[0]), "worst": plain(verdict.pixel_u_px[1])},
            "coverage": verdict.coverage,
            "tilts_deg": dict(zip(("least", "median", "most"), verdict.tilts_deg, strict=True)),
            "distance_ratio": verdict.distance_ratio,
            "quarter_turns_clockwise": seen.quarter_turns_clockwise,
            "rejected": calibration.rejected,
        },
        "lens": calibration.lens,
    }
