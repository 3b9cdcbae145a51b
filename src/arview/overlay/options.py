"""What the overlay shows, and its colours."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

from arview.errors import InputError
from arview.inspection import Verdict

Rgb = tuple[int, int, int]
EdgeMode = Literal["none", "visible", "all"]
Unit = Literal["mm", "inch"]

VERDICT_RGB: dict[Verdict, Rgb] = {
    Verdict.PASS: (52, 211, 122),
    Verdict.FAIL: (255, 72, 66),
    Verdict.UNDECIDED: (255, 176, 32),
    Verdict.NOT_MEASURED: (126, 156, 196),
}
VERDICT_WORD: dict[Verdict, str] = {
    Verdict.PASS: "PASS",
    Verdict.FAIL: "FAIL",
    Verdict.UNDECIDED: "UNDECIDED",
    Verdict.NOT_MEASURED: "NOT MEASURED",
}
NEUTRAL_RGB: Rgb = (70, 196, 255)
"""Ghost and edges while there is no inspection."""
CONTEXT_RGB: Rgb = (226, 232, 240)
"""Edges of components that the inspection does not mention."""
PANEL_RGB: Rgb = (16, 20, 27)
"""Background of labels and status line."""


@dataclass(frozen=True)
class OverlayOptions:
    """What is drawn and how.

    Raises:
        InputError: a value is outside its range.
    """

    show_ghost: bool = True  # translucent shaded components
    show_edges: EdgeMode = "visible"  # crease and silhouette edges; "all" adds hidden ones, dashed
    opacity: float = 0.42  # of the ghost, 0–1: the real part must stay readable through it
    show_labels: bool = True
    show_arrows: bool = True
    show_status: bool = True
    unit: Unit = "mm"  # of the numbers on labels
    decimals: int = 2  # of the numbers on labels, 0–4
    arrow_scale: float | None = None  # exaggeration of displacements; None: chosen from the largest one
    max_labels: int = 12  # more would hide the part; failures come first

    def __post_init__(self) -> None:
        if self.show_edges not in get_args(EdgeMode):
            raise InputError(f"overlay: show_edges is {self.show_edges!r}, expected none, visible or all")
        if self.unit not in get_args(Unit):
            raise InputError(f"overlay: unit is {self.unit!r}, expected mm or inch")
        if not 0.0 <= self.opacity <= 1.0:
            raise InputError(f"overlay: opacity is {self.opacity}, expected 0 to 1")
        if not 0 <= self.decimals <= 4:
            raise InputError(f"overlay: decimals is {self.decimals}, expected 0 to 4")
        if self.arrow_scale is not None and not (math.isfinite(self.arrow_scale) and self.arrow_scale > 0):
            raise InputError(f"overlay: arrow_scale is {self.arrow_scale}, expected a positive number")
        if self.max_labels < 0:
            raise InputError(f"overlay: max_labels is {self.max_labels}, expected 0 or more")
