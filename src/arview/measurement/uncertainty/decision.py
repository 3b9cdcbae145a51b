"""The decision rule: pass, fail or undecided for a distance with its uncertainty (ISO 14253-1)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from arview.errors import InputError
from arview.inspection import Verdict


@dataclass(frozen=True)
class DecisionOptions:
    """Options of the decision rule."""

    guard: float = 1.0  # share of U kept from the limit on both sides; 1 is ISO 14253-1's default, 0 simple acceptance

    def __post_init__(self) -> None:
        if not 0.0 <= self.guard <= 3.0:
            raise InputError(f"guard factor {self.guard}: expected a number from 0 to 3")


def decide(value: float | None, uncertainty: float | None, tolerance: float | None, guard: float = 1.0) -> Verdict:
    """Verdict on a value with its expanded uncertainty U, all in the unit of the tolerance.

    It passes if ``value + guard · U`` is within the tolerance, fails if ``value − guard · U`` is not, and is undecided
    in between. Without a tolerance it is only measured, and without a value not measured.
    """
    if value is None or uncertainty is None:
        return Verdict.NOT_MEASURED
    if tolerance is None:
        return Verdict.MEASURED
    if value + guard * uncertainty <= tolerance:
        return Verdict.PASS
    return Verdict.FAIL if value - guard * uncertainty > tolerance else Verdict.UNDECIDED


def worst(verdicts: Iterable[Verdict]) -> Verdict:
    """Verdict on a component with several characteristics: fail if one fails, else undecided if one is undecided."""
    order = (Verdict.MEASURED, Verdict.PASS, Verdict.NOT_MEASURED, Verdict.UNDECIDED, Verdict.FAIL)
    return max(verdicts, key=order.index, default=Verdict.NOT_MEASURED)


def zone_diameter_mm(distance_mm: float) -> float:
    """Diameter of the smallest position tolerance zone (ISO 1101) that holds a component at this distance."""
    return 2.0 * distance_mm
