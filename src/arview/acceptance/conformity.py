"""Conformity of measured lengths: errors against the maximum permissible error and against the stated uncertainty."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from arview.acceptance.lengths import K, KnownLength, MeasuredMarks, covariance_of_lengths
from arview.core.fits import covariance_root
from arview.errors import InputError
from arview.inspection import Verdict
from arview.measurement import decide

FULL_TEST = 35
"""Number of lengths that VDI/VDE 2634 part 1 requires: seven measuring lines with five lengths each."""
COVERAGE = 0.9545
"""Coverage of U with k = 2 for normally distributed errors."""


MAX_DRAWS = 1000
"""Simulated tests for the range of the number of errors within U."""
MIN_DRAWS = 200
"""Fewest simulated tests, however many lengths there are."""
MAX_VALUES = 500_000
"""Simulated errors in all, which bounds the draws for many lengths."""
INTERVAL = 0.95
"""Share of the simulated tests that the range of the number of errors within U holds."""
QUANTILES = (0.025, 0.975)
"""Ends of that range in the simulation."""
WIDE_RATIO = 0.5
"""Ratio of rms error to standard uncertainty below which U is called wide."""


@dataclass(frozen=True)
class PermissibleError:
    """The maximum permissible error E = A + L/K, at most B, in mm, as VDI/VDE 2634 part 1 states it.

    Attributes:
        constant_mm: A.
        per_length: 1/K.
        max_mm: B.
    """

    constant_mm: float
    per_length: float = 0.0
    max_mm: float = float("inf")

    def at(self, length_mm: float) -> float:
        """The limit for a length, mm."""
        return min(self.constant_mm + self.per_length * length_mm, self.max_mm)

    def __str__(self) -> str:
        text = f"{self.constant_mm:g}" + (f" + L/{1.0 / self.per_length:g}" if self.per_length else "")
        return text + (f" ≤ {self.max_mm:g}" if np.isfinite(self.max_mm) else "") + " mm"


class UncertaintyCheck(StrEnum):
    """Result of the comparison of the errors with the stated U."""

    HELD = "held"
    WIDE = "held, rather wide"
    NOT_HELD = "not held"
    NOT_STATED = "not stated"


@dataclass(frozen=True)
class LengthResult:
    """The result for one length.

    Attributes:
        known: calibrated length.
        measured_mm, error_mm: measured length, and measured minus known length.
        uncertainty_mm: U (k = 2) of the measured length; None when not stated.
        limit_mm: maximum permissible error; None when none is given.
        verdict: verdict after ISO 14253-1 with the U of the known length.
        is_within_u: whether the error is within the combined U of both lengths; None when U is not stated.
    """

    known: KnownLength
    measured_mm: float
    error_mm: float
    uncertainty_mm: float | None
    limit_mm: float | None
    verdict: Verdict
    is_within_u: bool | None


@dataclass(frozen=True)
class Verification:
    """The result of an acceptance test.

    Attributes:
        measured, reference: labels of the measured and the known lengths.
        limit: maximum permissible error, or None.
        lengths: results in the order of the known lengths.
        left_out: reasons why lengths were not measured, by length.
        within: number of lengths whose error is within U.
        expected: range that holds 95 % of such numbers if U is correct.
        is_shared: whether lengths share marks, so that the range is simulated; else it is binomial.
        ratio: rms of error over standard uncertainty, 1 if U is correct; None when U is not stated.
        u_held: whether the stated U held.
        verdict: overall verdict.
    """

    measured: str
    reference: str
    limit: PermissibleError | None
    lengths: tuple[LengthResult, ...]
    left_out: dict[str, str]
    within: int
    expected: tuple[int, int]
    is_shared: bool
    ratio: float | None
    u_held: UncertaintyCheck
    verdict: Verdict

    @property
    def largest(self) -> LengthResult:
        """The length with the largest error, relative to its limit if there is one."""
        return max(self.lengths, key=lambda one: abs(one.error_mm) / (one.limit_mm or 1.0))


def parse_limit(text: str) -> PermissibleError:
    """Parse a limit of the form ``A``, ``A+L/K`` or ``A+L/K<=B`` in mm, e.g. ``0.05+L/10000``.

    Raises:
        InputError: the text has another form, or the limit is zero.
    """
    number = r"(\d+(?:\.\d*)?|\.\d+)"
    match = re.fullmatch(rf"{number}(?:\+L/{number})?(?:<={number})?", text.replace(" ", ""), re.IGNORECASE)
    if match is None:
        raise InputError(f"maximum permissible error {text!r}: expected A, A+L/K or A+L/K<=B in mm, e.g. 0.05+L/10000")
    constant, per, highest = (None if value is None else float(value) for value in match.groups())
    if per == 0.0 or (not constant and not per) or highest == 0.0:
        raise InputError(f"maximum permissible error {text!r}: must be greater than zero")
    return PermissibleError(
        constant or 0.0, 0.0 if per is None else 1.0 / per, float("inf") if highest is None else highest
    )


def verify(
    measured: MeasuredMarks,
    known: Sequence[KnownLength],
    reference: str,
    limit: PermissibleError | None = None,
) -> Verification:
    """Compare measured with known lengths.

    Args:
        measured: measured positions of marks.
        known: known lengths between them; those whose marks were not measured are listed with the reason.
        reference: label of the known lengths.
        limit: maximum permissible error; without it only U is checked.

    Raises:
        InputError: none of the lengths was measured.
    """
    used, left_out = [], {}
    for one in known:
        absent = [name for name in (one.first, one.second) if name not in measured.marks]
        if absent:
            reason = measured.absent.get(absent[0], f"is not in {measured.label}")
            left_out[f"{one.first} to {one.second}"] = f"{absent[0]} {reason}"
        else:
            used.append(one)
    if not used:
        name, reason = next(iter(left_out.items()))
        raise InputError(f"{reference}: none of its {len(known)} lengths was measured ({name}: {reason})")
    covariance = covariance_of_lengths(measured, [(one.first, one.second) for one in used])
    results = [
        _result(measured, one, None if covariance is None else float(np.sqrt(covariance[k, k])), limit)
        for k, one in enumerate(used)
    ]
    within = sum(one.is_within_u is True for one in results)
    marks = [name for one in used for name in (one.first, one.second)]
    is_shared = len(set(marks)) < len(marks) or measured.scale_std > 0.0
    expected, ratio, held = (0, len(used)), None, UncertaintyCheck.NOT_STATED
    if covariance is not None:
        total = covariance + np.diag([(one.uncertainty_mm / K) ** 2 for one in used])
        expected = _expected(total, is_shared)
        ratio = float(np.sqrt(np.mean([one.error_mm**2 for one in results] / np.maximum(np.diag(total), 1e-18))))
        held = (
            UncertaintyCheck.NOT_HELD
            if within < expected[0]
            else UncertaintyCheck.WIDE
            if ratio < WIDE_RATIO
            else UncertaintyCheck.HELD
        )
    verdict = _verdict([one.verdict for one in results], held, limit is not None)
    return Verification(
        measured.label,
        reference,
        limit,
        lengths=tuple(results),
        left_out=left_out,
        within=within,
        expected=expected,
        is_shared=is_shared,
        ratio=ratio,
        u_held=held,
        verdict=verdict,
    )


def record_of(test: Verification) -> dict[str, Any]:
    """The test as a JSON document."""
    largest = test.largest
    return {
        "kind": "arview-verify",
        "version": 1,
        "measured": test.measured,
        "reference": test.reference,
        "limit": None if test.limit is None else str(test.limit),
        "verdict": test.verdict.value,
        "largest_error_mm": largest.error_mm,
        "largest_error_between": [largest.known.first, largest.known.second],
        "u_held": test.u_held.value,
        "within_u": test.within,
        "of": len(test.lengths),
        "expected_within_u": list(test.expected),
        "expected_from": "simulation" if test.is_shared else "binomial",
        "rms_error_over_standard_uncertainty": test.ratio,
        "coverage_factor": K,
        "lengths": [
            {
                "between": [one.known.first, one.known.second],
                "known_mm": one.known.mm,
                "known_U_mm": one.known.uncertainty_mm,
                "measured_mm": one.measured_mm,
                "U_mm": one.uncertainty_mm,
                "error_mm": one.error_mm,
                "limit_mm": one.limit_mm,
                "verdict": one.verdict.value,
                "within_u": one.is_within_u,
            }
            for one in test.lengths
        ],
        "left_out": test.left_out,
    }


def _result(
    measured: MeasuredMarks, known: KnownLength, std_mm: float | None, limit: PermissibleError | None
) -> LengthResult:
    between = measured.marks[known.second].place - measured.marks[known.first].place
    length = float(np.linalg.norm(between))
    error = length - known.mm
    allowed = None if limit is None else limit.at(known.mm)
    verdict = decide(abs(error), known.uncertainty_mm, allowed)
    within = None if std_mm is None else bool(abs(error) <= np.hypot(K * std_mm, known.uncertainty_mm))
    return LengthResult(known, length, error, None if std_mm is None else K * std_mm, allowed, verdict, within)


def _expected(covariance: Any, is_shared: bool) -> tuple[int, int]:
    """Range that holds 95 % of the numbers of errors within U if U is correct."""
    from scipy.stats import binom

    count = len(covariance)
    if not is_shared:
        low, high = binom.interval(INTERVAL, count, COVERAGE)
        return int(low), int(high)
    draws = min(MAX_DRAWS, max(MIN_DRAWS, MAX_VALUES // count))
    noise = np.random.default_rng(0).standard_normal((draws, count))
    errors = noise @ covariance_root(covariance).T
    counts = np.sum(np.abs(errors) <= K * np.sqrt(np.diag(covariance)), axis=1)
    low, high = np.quantile(counts, QUANTILES, method="inverted_cdf")
    return int(low), int(high)


def _verdict(verdicts: Sequence[Verdict], held: UncertaintyCheck, has_limit: bool) -> Verdict:
    if held is UncertaintyCheck.NOT_HELD or Verdict.FAIL in verdicts:
        return Verdict.FAIL
    if (not has_limit and held is UncertaintyCheck.NOT_STATED) or (has_limit and Verdict.UNDECIDED in verdicts):
        return Verdict.UNDECIDED
    return Verdict.PASS
