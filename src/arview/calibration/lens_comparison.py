"""Whether another lens model explains the views of a board better than the one that was calibrated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from arview.calibration.board_view import BoardView
from arview.calibration.projection import CalibratedLens
from arview.calibration.solve import adjust
from arview.errors import InputError

PERCENTILE = 90.0
"""Percentile of the residuals' lengths that is compared: high, because a wrong model shows at the rim of the picture,
and below 100, because single corners are wrong."""
MIN_RESIDUAL_PX = 0.25
"""Smaller residuals are those of the corners, whatever the model."""
MIN_RATIO = 1.4
"""Residuals of the model in use over those of the other one from which the other one is recommended."""


@dataclass(frozen=True)
class LensComparison:
    """Residuals, px, of all views with the lens model in use and with the other one; infinite where one fails."""

    used: CalibratedLens
    used_px: float
    other: CalibratedLens
    other_px: float
    is_other_better: bool

    @property
    def advice(self) -> str:
        """What to do, empty where the model in use is the better one."""
        if not self.is_other_better:
            return ""
        return (
            f"calibrate with --lens {self.other}: of 10 corners 9 fit it to {self.other_px:.2g} px, and {self.used} to "
            f"{self.used_px:.2g} px only"
        )


def compare_lenses(
    views: Sequence[BoardView],
    width: int,
    height: int,
    used: CalibratedLens,
) -> LensComparison:
    """Compare the lens model in use with the other one, on all views and without leaving out corners.

    Args:
        views: of the board, before any was rejected.
        width, height: of the sensor's picture, px.
        used: model that is calibrated.
    """
    other = CalibratedLens.BROWN if used is CalibratedLens.FISHEYE else CalibratedLens.FISHEYE
    used_px = _residual_px(views, width, height, used)
    # The other model is fitted only where the one in use leaves something to explain.
    other_px = used_px
    if used_px > MIN_RESIDUAL_PX:
        other_px = _residual_px(views, width, height, other)
    return LensComparison(used, used_px, other, other_px, used_px > MIN_RATIO * other_px)


def _residual_px(views: Sequence[BoardView], width: int, height: int, lens: CalibratedLens) -> float:
    try:
        solution = adjust(views, width, height, None, lens)
    except InputError:
        return float("inf")
    lengths = np.linalg.norm(np.concatenate(solution.residuals), axis=1)
    return float(np.percentile(lengths, PERCENTILE))
