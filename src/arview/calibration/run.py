"""Photos or a video of a board → camera, with its uncertainty and a verdict in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from arview.calibration.choose import ChoiceOptions, choose_views
from arview.calibration.solve import PARAMETERS, K, Solution, SolveOptions, solve
from arview.calibration.verdict import CalibrationVerdict, VerdictOptions, assess
from arview.calibration.views import BoardSightings, find_views
from arview.camera import Camera
from arview.camera.profiles import lens_record
from arview.core.progress import StepProgress
from arview.errors import InputError
from arview.fiducials.board import Board, spec_of
from arview.version import __version__


@dataclass(frozen=True)
class Calibration:
    """A calibration with all that is known of it: what was seen, the camera, and the verdict."""

    board: Board
    sightings: BoardSightings
    solution: Solution
    verdict: CalibrationVerdict
    rejected: dict[str, str]

    @property
    def camera(self) -> Camera:
        """Of the sensor's picture, before it is turned upright."""
        return self.solution.camera

    @property
    def lens(self) -> dict[str, Any]:
        """What tells the lens and its mode, for profiles."""
        return lens_record(self.sightings.exif, self.camera.width, self.camera.height)


def calibrate(
    sources: Sequence[str | Path],
    board: Board,
    choice: ChoiceOptions | None = None,
    solving: SolveOptions | None = None,
    limits: VerdictOptions | None = None,
    progress: StepProgress | None = None,
) -> Calibration:
    """Calibrate a camera from photos, or one video, of a ChArUco board.

    Args:
        sources: photo files, folders, globs; or one video.
        board: the board that is in them.
        choice: of views, where there are many.
        solving: what is left out.
        limits: of the verdict.
        progress: called with pictures looked at and in all.

    Raises:
        InputError: nothing readable, no board, too few views, or views that no camera explains.
    """
    sightings = find_views(sources, board, progress)
    least = (solving or SolveOptions()).min_views
    if len(sightings.views) < least:
        why = "; ".join(f"{name} {reason}" for name, reason in list(sightings.rejected.items())[:3])
        raise InputError(
            f"{sightings.label}: the board is seen in {len(sightings.views)} of {sightings.looked_at} pictures, at"
            f" least {least} are needed, 20 are good" + (f" ({why})" if why else "")
        )
    try:
        views, left_out = choose_views(sightings.views, sightings.width, sightings.height, choice)
        solution = solve(views, sightings.width, sightings.height, solving)
    except InputError as error:
        raise InputError(f"{sightings.label}: {error}") from error
    rejected = sightings.rejected | left_out | solution.rejected
    return Calibration(board, sightings, solution, assess(solution, limits), rejected)


def record_of(calibration: Calibration) -> dict[str, Any]:
    """What goes into the camera file beside the numbers: ``calibration`` and ``lens``. Infinite values are null."""
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
            "pictures": seen.looked_at,
            "views_found": len(seen.views),
            "views_used": len(solution.views),
            "corners_used": sum(len(view.ids) for view in solution.views),
            "rms_px": solution.rms_px,
            "parameters": list(PARAMETERS),
            "uncertainty_k": K,
            "uncertainty": {name: plain(K * std) for name, std in zip(PARAMETERS, solution.std, strict=True)},
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
