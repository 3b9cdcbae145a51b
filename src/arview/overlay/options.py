"""Options and colours of the overlay."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

from arview.core.messages import sentence
from arview.errors import InputError
from arview.inspection import Verdict

Rgb = tuple[int, int, int]
EdgeMode = Literal["none", "visible", "all"]
Unit = Literal["mm", "inch"]

VERDICT_RGB: dict[Verdict, Rgb] = {
    Verdict.PASS: (52, 211, 122),
    Verdict.FAIL: (255, 72, 66),
    Verdict.UNDECIDED: (255, 176, 32),
    Verdict.MEASURED: (96, 175, 255),
    Verdict.NOT_MEASURED: (126, 156, 196),
}
VERDICT_WORD: dict[Verdict, str] = {
    Verdict.PASS: sentence("verdict.pass"),
    Verdict.FAIL: sentence("verdict.fail"),
    Verdict.UNDECIDED: sentence("verdict.undecided"),
    Verdict.MEASURED: sentence("verdict.measured"),
    Verdict.NOT_MEASURED: sentence("verdict.not_measured"),
}
NEUTRAL_RGB: Rgb = (70, 196, 255)
"""Colour of ghost and edges without an inspection."""
CONTEXT_RGB: Rgb = (226, 232, 240)
"""Colour of the edges of components that are not in the inspection."""
PANEL_RGB: Rgb = (16, 20, 27)
"""Background of labels and of the status line."""


UNIT: Unit = "mm"
"""Unit of the numbers on labels."""
DECIMALS = 2
"""Decimals of the numbers on labels, 0–4."""


@dataclass(frozen=True)
class OverlayOptions:
    """What is drawn, and how.

    Attributes:
        show_ghost: draw the components translucent and shaded.
        show_edges: crease and silhouette edges: ``none``, ``visible`` ones, or ``all`` with hidden ones dashed.
        opacity: of the ghost, 0–1; the real part must stay recognisable through it.
        show_labels: draw a label for each component.
        show_status: draw the status line.
        show_evidence: draw components by what the pictures say of them, see `arview.pose.Presence`; without it all are
            drawn as measured, for pictures that document a measurement.
        show_occlusion: leave ghost and edges out where something is before the part, see `arview.overlay.occluders`.
        show_legend: explain the kinds of evidence that are in the picture.
        arrow_scale: exaggeration of displacements; None: chosen from the largest one.
        max_labels: more would hide the part; failures come first, and those without a label are marked by an arrow.
        text_px: size of the text on labels; None: in proportion to the height of the picture.
        max_age_days: labels of an older inspection are dimmed and tell its age; None: of any age.

    Raises:
        InputError: a value is outside its range.
    """

    show_ghost: bool = True
    show_edges: EdgeMode = "visible"
    opacity: float = 0.42
    show_labels: bool = True
    show_status: bool = True
    show_evidence: bool = True
    show_occlusion: bool = True
    show_legend: bool = True
    arrow_scale: float | None = None
    max_labels: int = 12
    text_px: int | None = None
    max_age_days: float | None = None

    def __post_init__(self) -> None:
        if self.show_edges not in get_args(EdgeMode):
            raise InputError(f"overlay: show_edges is {self.show_edges!r}, expected none, visible or all")
        if not 0.0 <= self.opacity <= 1.0:
            raise InputError(f"overlay: opacity is {self.opacity}, expected 0 to 1")
        if self.arrow_scale is not None and not (math.isfinite(self.arrow_scale) and self.arrow_scale > 0):
            raise InputError(f"overlay: arrow_scale is {self.arrow_scale}, expected a positive number")
        if self.max_labels < 0:
            raise InputError(f"overlay: max_labels is {self.max_labels}, expected 0 or more")
        if self.max_age_days is not None and not self.max_age_days > 0:
            raise InputError(f"overlay: max_age_days is {self.max_age_days}, expected a positive number or None")
