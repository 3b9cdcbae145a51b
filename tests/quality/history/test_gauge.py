"""Studies of the measurement: the example of AIAG's MSA manual, hand-worked designs, type 1 and VDA 5."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest

from arview.errors import InputError
from arview.quality.history import GaugeStudy, crossed, study_by_anova, study_by_ranges, type_one, vda5
from arview.quality.history.series import SeriesValue

AIAG = np.array([
    [[0.29, -0.56, 1.34, 0.47, -0.80, 0.02, 0.59, -0.31, 2.26, -1.36],
     [0.41, -0.68, 1.17, 0.50, -0.92, -0.11, 0.75, -0.20, 1.99, -1.25],
     [0.64, -0.58, 1.27, 0.64, -0.84, -0.21, 0.66, -0.17, 2.01, -1.31]],
    [[0.08, -0.47, 1.19, 0.01, -0.56, -0.20, 0.47, -0.63, 1.80, -1.68],
     [0.25, -1.22, 0.94, 1.03, -1.20, 0.22, 0.55, 0.08, 2.12, -1.62],
     [0.07, -0.68, 1.34, 0.20, -1.28, 0.06, 0.83, -0.34, 2.19, -1.50]],
    [[0.04, -1.38, 0.88, 0.14, -1.46, -0.29, 0.02, -0.46, 1.77, -1.49],
     [-0.11, -1.13, 1.09, 0.20, -1.07, -0.67, 0.01, -0.56, 1.45, -1.77],
     [-0.15, -0.96, 0.67, 0.11, -1.45, -0.49, 0.21, -0.49, 1.87, -2.16]],
]).transpose(2, 0, 1)  # fmt: skip
"""The study of the MSA manual (AIAG, 4th edition): 10 parts, 3 appraisers, 3 trials.

Data and results are those that W. McNeese prints from the manual ("Three Methods to Analyze Gage R&R Studies", SPC for
Excel, February 2015), read in public test suites that quote them; two of these agree on every value.
"""


def shares(study: GaugeStudy) -> dict[str, str]:
    return {name: f"{100.0 * std / study.rows['total TV']:.2f}" for name, std in study.rows.items()}


def test_the_example_of_the_msa_manual_by_ranges() -> None:
    study = study_by_ranges(AIAG)
    assert study.shape == (10, 3, 3)
    assert f"{np.ptp(AIAG, axis=2).mean():.3f} {np.ptp(AIAG.mean(axis=(0, 2))):.3f}" == "0.342 0.445"
    printed = {"repeatability EV": "0.202", "reproducibility AV": "0.230", "GRR": "0.306", "parts PV": "1.104",
               "total TV": "1.146"}  # fmt: skip
    assert {name: f"{study.rows[name]:.3f}" for name in printed} == printed
    percent = {"repeatability EV": "17.61", "reproducibility AV": "20.04", "GRR": "26.68", "parts PV": "96.37"}
    assert {name: shares(study)[name] for name in percent} == percent
    assert study.categories == 5


def test_the_example_of_the_msa_manual_by_anova() -> None:
    """Variances 0.0400, 0.0515, 0.0914 and 1.086; the interaction is not significant and pooled."""
    study = study_by_anova(AIAG)
    rows = {name: std**2 for name, std in study.rows.items()}
    assert f"{rows['repeatability EV']:.4f} {rows['reproducibility AV']:.4f}" == "0.0400 0.0515"
    assert rows["GRR"] == pytest.approx(0.0914, abs=6e-5)
    assert f"{rows['parts PV']:.3f} {rows['total TV']:.3f}" == "1.086 1.178"
    assert (rows["interaction INT"], study.categories) == (0.0, 4)
    assert study.interaction_p == pytest.approx(0.974, abs=1e-3)
    percent = {"repeatability EV": "18.42", "reproducibility AV": "20.90", "GRR": "27.86", "parts PV": "96.04"}
    assert {name: shares(study)[name] for name in percent} == percent


def test_an_interaction_by_hand() -> None:
    """Parts 10, 20, 30; appraisers 0, 5, -5; an interaction of ± 4 whose rows and columns are zero; trials ± 1.

    Mean squares: parts 2·3·200 / 2 = 600, appraisers 2·3·50 / 2 = 150, interaction 2·96 / 4 = 48, error 18 / 9 = 2.
    """
    mixed = np.array([[4.0, -4.0, 0.0], [-4.0, 0.0, 4.0], [0.0, 4.0, -4.0]])
    cells = np.array([10.0, 20.0, 30.0])[:, None] + np.array([0.0, 5.0, -5.0])[None, :] + mixed
    study = study_by_anova(np.stack([cells - 1.0, cells + 1.0], axis=2))
    assert study.repeatability**2 == pytest.approx(2.0)
    assert study.interaction**2 == pytest.approx((48.0 - 2.0) / 2.0)
    assert study.appraisers**2 == pytest.approx((150.0 - 48.0) / 6.0)
    assert study.parts**2 == pytest.approx((600.0 - 48.0) / 6.0)
    assert study.rows["GRR"] ** 2 == pytest.approx(42.0)
    assert study.categories == 2  # 1.41 √(92 / 42) = 2.09
    assert study.interaction_p is not None and study.interaction_p < 0.01


def test_one_station() -> None:
    """Two parts at 0 and 10, two trials ± 1: error 2, parts (100 - 2) / 2 = 49; nothing is known of other stations."""
    study = study_by_anova(np.array([[[-1.0, 1.0]], [[9.0, 11.0]]]))
    assert (study.repeatability**2, study.appraisers, study.interaction_p) == (pytest.approx(2.0), 0.0, None)
    assert study.parts**2 == pytest.approx(49.0)
    ranges = study_by_ranges(np.array([[[-1.0, 1.0]], [[9.0, 11.0]]]))
    assert ranges.repeatability == pytest.approx(2.0 / 1.12838, abs=1e-5)
    assert ranges.parts == pytest.approx(10.0 / np.sqrt(2.0), abs=1e-4)  # K3 = 0.7071
    exact = study_by_anova(np.array([[[1.0, 1.0], [1.0, 1.0]], [[2.0, 2.0], [2.0, 2.0]]]))
    assert exact.rows["GRR"] == 0.0 and exact.categories > 1000


def test_the_cells_of_a_study() -> None:
    when = datetime(2026, 3, 1, tzinfo=UTC)

    def value(number: float, serial: str, station: str) -> SeriesValue:
        return SeriesValue(0, serial, station, when, number, None)

    values = [value(part + 0.1 * trial, f"S{part}", station)
              for part in range(3) for station in "AB" for trial in range(2 + (part == 0))]  # fmt: skip
    values += [value(9.0, "S9", "A"), value(9.0, "", "A")]  # not by both stations, and without a serial
    taken, left_out = crossed(values)
    assert taken.shape == (3, 2, 2)
    assert taken[0].tolist() == [[0.0, 0.1], [0.0, 0.1]]
    assert left_out == ["2 serials and 4 measurements, which not every cell has"]
    with pytest.raises(InputError, match=r"every station \(A, B\) measured twice, there is 1"):
        crossed([one for one in values if one.serial in ("S0", "S9")])
    with pytest.raises(InputError, match=r"\(none\) measured twice, there are none"):
        crossed([])


def test_type_1_and_vda_5_by_hand() -> None:
    """Values 0.99 and 1.01 by turns, reference 0.995, tolerance 1: bias 0.005, s = 0.01 √(20 / 19)."""
    std = 0.01 * np.sqrt(20 / 19)
    first = type_one([0.99, 1.01] * 10, 0.995, 1.0)
    assert (first.count, first.bias, first.std) == (20, pytest.approx(0.005), pytest.approx(std))
    assert first.cg == pytest.approx(0.2 / (6.0 * std))  # 3.249
    assert first.cgk == pytest.approx((0.1 - 0.005) / (3.0 * std))
    study = GaugeStudy("ANOVA", (10, 3, 3), repeatability=0.03, appraisers=0.04, interaction=0.0, parts=1.0)
    found = vda5(study, first, calibration=0.012)
    fixed = 0.006**2 + 0.005**2 / 3.0
    assert found["MS"] == pytest.approx(2.0 * np.sqrt(fixed + std**2))
    assert found["MP"] == pytest.approx(2.0 * np.sqrt(fixed + 0.03**2 + 0.04**2))
    assert vda5(study, None) == {"MP": pytest.approx(0.1)}
    with pytest.raises(InputError, match="needs 10 values that are not all equal, there are 9"):
        type_one([1.0] * 9, 1.0, 1.0)
