"""Options of a measurement, and the results of all methods for a component."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from arview.errors import InputError
from arview.measurement.types import Method, Move, NotMeasured
from arview.measurement.uncertainty.budget import UncertaintyOptions
from arview.measurement.uncertainty.combine import CombinedMove, combine
from arview.measurement.uncertainty.decision import DecisionOptions

METHODS: tuple[Method, ...] = ("sweep", "edges", "cloud")
"""All methods, in the order in which results are listed."""


@dataclass(frozen=True)
class MeasureOptions:
    """Options of a measurement and of its parts."""

    methods: tuple[Method, ...] = METHODS  # methods to use; the cloud only where there is one
    tolerance_mm: float | None = None  # for components without a tolerance in the part file; None: no verdict
    corrects_bias: bool = False  # decide on the most likely true distance instead of the measured one
    uses_inconsistent: bool = False  # continue though the reconstruction does not have the shape of the CAD
    maps_folder: Path | None = None  # where pictures and PLY of the distance map are written; None: nowhere
    uncertainty: UncertaintyOptions = field(default_factory=UncertaintyOptions)
    decision: DecisionOptions = field(default_factory=DecisionOptions)

    def __post_init__(self) -> None:
        unknown = [method for method in self.methods if method not in METHODS]
        if unknown or not self.methods:
            raise InputError(f"methods {', '.join(self.methods) or 'none'}: expected some of {', '.join(METHODS)}")
        if self.tolerance_mm is not None and not self.tolerance_mm > 0:
            raise InputError(f"tolerance {self.tolerance_mm} mm: expected more than 0")


@dataclass(frozen=True)
class ComponentMeasurement:
    """Results of all methods for a component, before alignment to the datums."""

    moves: tuple[Move, ...]
    failures: tuple[NotMeasured, ...]


def combined_of(measured: ComponentMeasurement) -> CombinedMove | None:
    """The combined move of sweep and edges, or of the cloud where neither of them could measure; None without any."""
    direct = [move for move in measured.moves if move.method != "cloud"]
    moves = direct or list(measured.moves)
    return combine(moves) if moves else None
