"""Capability of the measurement itself: crossed studies (AIAG MSA-4), type-1 studies, and the figures of VDA 5."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from arview.errors import InputError
from arview.geometry import Array
from arview.quality.history.series import SeriesValue
from arview.quality.history.statistics import range_factors

POOLING_LEVEL = 0.25
"""The interaction is pooled with the repeatability if its F-test is less significant; high, not to miss any."""
MIN_TYPE1_VALUES = 10
"""Measurements of a reference part needed for a type-1 study; 25 and more are usual."""


@dataclass(frozen=True)
class GaugeStudy:
    """Standard deviations of a crossed study, in the unit of the values, and what follows from them.

    Attributes:
        method: ``ANOVA`` or ``ranges``.
        shape: number of parts, appraisers and trials.
        repeatability: EV, of the same appraiser with the same part.
        appraisers: AV, of the means of the appraisers.
        interaction: of appraisers with parts; 0 if it is pooled with the repeatability, or by ranges.
        parts: PV, of the parts.
        interaction_p: probability of such an interaction by chance; None if it cannot be known.
    """

    method: str
    shape: tuple[int, int, int]
    repeatability: float
    appraisers: float
    interaction: float
    parts: float
    interaction_p: float | None = None

    @property
    def rows(self) -> dict[str, float]:
        """Standard deviations by the names of MSA-4."""
        gauge = float(np.hypot(self.repeatability, np.hypot(self.appraisers, self.interaction)))
        return {
            "repeatability EV": self.repeatability,
            "reproducibility AV": self.appraisers,
            "interaction INT": self.interaction,
            "GRR": gauge,
            "parts PV": self.parts,
            "total TV": float(np.hypot(gauge, self.parts)),
        }

    @property
    def categories(self) -> int:
        """Number of distinct categories ndc: 1.41 PV / GRR, rounded down, at least 1."""
        gauge = self.rows["GRR"]
        return max(1, int(1.41 * self.parts / gauge)) if gauge > 0.0 else 1_000_000


def crossed(values: Sequence[SeriesValue]) -> tuple[Array, list[str]]:
    """Repeated measurements as an array (parts, appraisers, trials), and what was left out of it.

    A part is a serial, an appraiser a station, and trials are in the order of measurement. Parts that a station did not
    measure repeatedly are left out, and of every cell the measurements beyond the number that all cells have.

    Raises:
        InputError: there are not two parts that each station measured twice.
    """
    cells: dict[tuple[str, str], list[float]] = {}
    for value in values:
        cells.setdefault((value.serial, value.station), []).append(value.value)
    stations, serials = (sorted({key[place] for key in cells}) for place in (1, 0))
    whole = [s for s in serials if s and all(len(cells.get((s, station), ())) >= 2 for station in stations)]
    if len(whole) < 2:
        raise InputError(
            f"a study needs two serials that every station ({', '.join(stations) or 'none'}) measured twice,"
            f" there {'is 1' if whole else 'are none'}"
        )
    trials = min(len(cells[serial, station]) for serial in whole for station in stations)
    taken = np.array([[cells[serial, station][:trials] for station in stations] for serial in whole])
    rest, beyond = len(serials) - len(whole), len(values) - taken.size
    return taken, [f"{rest} serials and {beyond} measurements, which not every cell has"] if beyond else []


def study_by_anova(measured: ArrayLike) -> GaugeStudy:
    """A crossed study by the analysis of variance with two random factors (MSA-4, III.B).

    Args:
        measured: (parts, appraisers, trials) values; with one appraiser there is no reproducibility.
    """
    from scipy import stats

    x = np.asarray(measured, dtype=np.float64)
    parts, appraisers, trials = x.shape
    cells, mean = x.mean(axis=2), x.mean()
    by_part, by_appraiser = cells.mean(axis=1), cells.mean(axis=0)
    squares = trials * float(np.sum((cells - by_part[:, None] - by_appraiser + mean) ** 2))
    error = float(np.sum((x - cells[:, :, None]) ** 2))
    free, error_free = (parts - 1) * (appraisers - 1), parts * appraisers * (trials - 1)
    variance = error / error_free
    crossed_variance, chance = variance, None
    if free:
        crossed_variance = squares / free
        chance = float(stats.f.sf(crossed_variance / variance, free, error_free)) if variance > 0.0 else 0.0
        if chance > POOLING_LEVEL:
            crossed_variance = variance = (squares + error) / (free + error_free)

    def component(square: float, repeats: int) -> float:
        return float(np.sqrt(max(0.0, square - crossed_variance) / repeats))

    part_square = appraisers * trials * float(by_part.var(ddof=1))
    appraiser_square = parts * trials * float(by_appraiser.var(ddof=1)) if appraisers > 1 else 0.0
    return GaugeStudy(
        method="ANOVA",
        shape=(parts, appraisers, trials),
        repeatability=float(np.sqrt(variance)),
        appraisers=component(appraiser_square, parts * trials),
        interaction=float(np.sqrt(max(0.0, crossed_variance - variance) / trials)),
        parts=component(part_square, appraisers * trials),
        interaction_p=chance,
    )


def study_by_ranges(measured: ArrayLike) -> GaugeStudy:
    """A crossed study by averages and ranges (MSA-4, III.B), which has no interaction.

    Args:
        measured: (parts, appraisers, trials) values; with one appraiser there is no reproducibility.
    """
    x = np.asarray(measured, dtype=np.float64)
    parts, appraisers, trials = x.shape
    repeatability = float(np.ptp(x, axis=2).mean()) / range_factors(trials)[0]
    # d2* of a single range: the root of d2² + d3².
    between = float(np.ptp(x.mean(axis=(0, 2)))) / np.hypot(*range_factors(appraisers)) if appraisers > 1 else 0.0
    return GaugeStudy(
        method="ranges",
        shape=(parts, appraisers, trials),
        repeatability=repeatability,
        appraisers=float(np.sqrt(max(0.0, between**2 - repeatability**2 / (parts * trials)))),
        interaction=0.0,
        parts=float(np.ptp(x.mean(axis=(1, 2))) / np.hypot(*range_factors(parts))),
    )


@dataclass(frozen=True)
class TypeOneStudy:
    """Repeated measurements of a reference part: bias, repeatability, Cg and Cgk (20 % of the tolerance over 6 s)."""

    count: int
    bias: float
    std: float
    cg: float
    cgk: float


def type_one(values: Sequence[float], reference: float, tolerance: float) -> TypeOneStudy:
    """A type-1 study.

    Args:
        values: measured values of the reference part.
        reference: its calibrated value.
        tolerance: width of the tolerance.

    Raises:
        InputError: there are fewer than 10 values, or all are equal.
    """
    x = np.asarray(values, dtype=np.float64)
    std = float(x.std(ddof=1)) if len(x) >= MIN_TYPE1_VALUES else 0.0
    if std <= 0.0:
        raise InputError(f"a type-1 study needs {MIN_TYPE1_VALUES} values that are not all equal, there are {len(x)}")
    bias = float(x.mean()) - reference
    return TypeOneStudy(len(x), bias, std, 0.2 * tolerance / (6.0 * std), (0.1 * tolerance - abs(bias)) / (3.0 * std))


def vda5(study: GaugeStudy, type_one: TypeOneStudy | None, calibration: float = 0.0) -> dict[str, float]:
    """Expanded uncertainties (k = 2) of VDA 5 in the unit of the values: U_MP of the process, U_MS of the system.

    U_MS is of calibration, repeatability at the reference and bias (as a rectangular distribution), and needs a type-1
    study. U_MP takes the larger repeatability of both studies, and the appraisers and their interaction.

    Args:
        study: by ANOVA.
        type_one: of the same quantity; None without one.
        calibration: expanded uncertainty (k = 2) of the reference.
    """
    fixed = (calibration / 2.0) ** 2 + (0.0 if type_one is None else type_one.bias**2 / 3.0)
    at_reference = 0.0 if type_one is None else type_one.std**2
    repeated = max(at_reference, study.repeatability**2)
    found = {"MP": 2.0 * float(np.sqrt(fixed + repeated + study.appraisers**2 + study.interaction**2))}
    return found if type_one is None else {"MS": 2.0 * float(np.sqrt(fixed + at_reference)), **found}
