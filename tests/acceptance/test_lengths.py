"""Acceptance test with lengths: errors, limits and the check of U, on positions with known errors."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.stats import binom

from arview.acceptance.conformity import UncertaintyCheck, parse_limit, record_of, verify
from arview.acceptance.lengths import (
    KnownLength,
    Mark,
    MeasuredMarks,
    read_known,
    read_measured,
)
from arview.acceptance.plot import draw
from arview.cli import ExitCode, main
from arview.errors import InputError
from arview.geometry import apply, exp_so3, rigid
from arview.inspection import ComponentDeviation, Details, Inspection, Provenance, Verdict, save_inspection

RNG_PLACES = np.random.default_rng(7).uniform(-150.0, 150.0, (16, 3))
NAMES = [f"post_{k}" for k in range(16)]


def measured(
    rng: np.random.Generator, std_mm: float, stated_mm: float | None = None, scale: float = 0.0
) -> MeasuredMarks:
    """Positions with errors of a given size and a stated uncertainty."""
    stated = std_mm if stated_mm is None else stated_mm
    marks = {
        name: Mark((1.0 + scale) * place + rng.normal(0.0, std_mm, 3), stated**2 * np.eye(3))
        for name, place in zip(NAMES, RNG_PLACES, strict=True)
    }
    return MeasuredMarks("points", marks, {}, 0.0, {})


KNOWN = [
    KnownLength(a, b, float(np.linalg.norm(RNG_PLACES[i] - RNG_PLACES[j])))
    for (i, a), (j, b) in combinations(enumerate(NAMES), 2)
]
APART = KNOWN[:0] + [
    KnownLength(NAMES[k], NAMES[k + 1], float(np.linalg.norm(RNG_PLACES[k] - RNG_PLACES[k + 1])))
    for k in range(0, 16, 2)
]
"""Lengths without common marks."""


def test_errors_and_limits() -> None:
    places = {"a": [0.0, 0, 0], "b": [100.059, 0, 0], "c": [0, 200.0, 0]}
    points = MeasuredMarks("p", {k: Mark(np.array(v), 0.02**2 * np.eye(3)) for k, v in places.items()}, {}, 0.0, {})
    known = [KnownLength("a", "b", 100.0, 0.02), KnownLength("a", "c", 200.12, 0.01), KnownLength("a", "d", 5.0)]
    test = verify(points, known, "k", parse_limit("0.05 + L/5000"))
    first, second = test.lengths
    assert first.error_mm == pytest.approx(0.059)
    assert first.limit_mm == pytest.approx(0.07)
    assert first.verdict is Verdict.UNDECIDED  # 0.059 ± 0.02 about 0.07
    assert first.uncertainty_mm == pytest.approx(2 * np.sqrt(2) * 0.02)
    assert first.is_within_u is True  # within 0.0566 and 0.02 together
    assert second.error_mm == pytest.approx(-0.12)
    assert second.limit_mm == pytest.approx(0.05 + 200.12 / 5000)
    assert second.verdict is Verdict.FAIL
    assert second.is_within_u is False
    assert test.left_out == {"a to d": "d is not in p"}
    assert test.largest is second
    assert test.verdict is Verdict.FAIL
    assert parse_limit("0.05+L/1000<=0.2").at(1000.0) == 0.2
    assert verify(points, known[:1], "k", parse_limit("0.1")).verdict is Verdict.PASS


@pytest.mark.parametrize("text", ["", "-1", "L", "0", "0.1+L/0", "0.1+L*2", "nan", "0.1<=0"])
def test_limits_that_are_none(text: str) -> None:
    with pytest.raises(InputError, match="maximum permissible error"):
        parse_limit(text)


def test_lengths_without_common_marks_are_binomial() -> None:
    test = verify(measured(np.random.default_rng(0), 0.02), APART, "k")
    assert not test.is_shared
    assert test.expected == tuple(int(v) for v in binom.interval(0.95, 8, 0.9545))


@pytest.mark.slow
def test_a_correct_u_is_accepted_and_others_are_rejected() -> None:
    """25 tests of 120 lengths: a correct U is hardly ever rejected, half of it nearly always."""
    wrong = {"honest": 0, "half": 0, "scale": 0}
    wide = 0
    for seed in range(25):
        rng = np.random.default_rng(seed)
        wrong["honest"] += verify(measured(rng, 0.02), KNOWN, "k").u_held is UncertaintyCheck.NOT_HELD
        wrong["half"] += verify(measured(rng, 0.02, stated_mm=0.01), KNOWN, "k").u_held is UncertaintyCheck.NOT_HELD
        wrong["scale"] += verify(measured(rng, 0.02, scale=5e-4), KNOWN, "k").u_held is UncertaintyCheck.NOT_HELD
        wide += verify(measured(rng, 0.02, stated_mm=0.06), KNOWN, "k").u_held is UncertaintyCheck.WIDE
    assert wrong["honest"] <= 4  # 2.5 % are expected
    assert wrong["half"] >= 22
    assert wrong["scale"] >= 17
    assert wide == 25


def test_shared_marks_widen_the_range() -> None:
    test = verify(measured(np.random.default_rng(0), 0.02), KNOWN, "k")
    low, _ = binom.interval(0.95, len(KNOWN), 0.9545)
    assert test.is_shared
    assert test.expected[0] < low
    known_scale = replace(measured(np.random.default_rng(0), 0.02, scale=5e-4), scale_std=5e-4)
    assert verify(known_scale, KNOWN, "k").u_held is not UncertaintyCheck.NOT_HELD


# --- files -----------------------------------------------------------------------------------------------


def inspection_and_truth(folder: Path, std_mm: float = 0.02, off_mm: float = 0.0) -> tuple[Path, Path]:
    """An inspection of components that were moved and rotated, and its truth."""
    rng = np.random.default_rng(3)
    truth, components = {}, []
    for k, (name, center) in enumerate(zip(NAMES, RNG_PLACES, strict=True)):
        turn = exp_so3(rng.normal(0.0, 0.01, 3))
        move = rigid(turn, center - turn @ center + rng.normal(0.0, 1.0, 3))
        truth[name] = {"measured_from_nominal": move.tolist()}
        shift = apply(move, center) - center + rng.normal(0.0, std_mm, 3) + (off_mm if k == 3 else 0.0)
        seen = (True,) * 6 if k != 5 else (True, True, True, True, True, False)
        displacement = tuple(float(v) if ok else None for v, ok in zip(shift, seen[3:], strict=True))
        covariance = tuple(map(tuple, np.diag([1e-6] * 3 + [std_mm**2] * 3).tolist()))
        distance = float(np.linalg.norm([v for v in displacement if v is not None]))
        components.append(ComponentDeviation(
            name, displacement, distance, seen, 2 * std_mm, None, Verdict.UNDECIDED,
            details=Details(tuple(center.tolist()), covariance=covariance),
        ))  # fmt: skip
    inspection = Inspection("plate", "7", "0" * 64, datetime.now(UTC), tuple(components), Provenance("t", "1", "m"))
    save_inspection(inspection, folder / "inspection.json")
    (folder / "truth.json").write_text(json.dumps({"part": "plate", "truth": truth}))
    return folder / "inspection.json", folder / "truth.json"


def test_an_inspection_against_its_truth(tmp_path: Path) -> None:
    path, truth = inspection_and_truth(tmp_path)
    places = read_measured(tmp_path)  # the folder it is in
    assert len(places.marks) == 15
    assert "undetermined" in places.absent["post_5"]
    known = read_known(truth, places)
    assert len(known) == 105
    test = verify(places, known, str(truth), parse_limit("0.15"))
    assert test.verdict is Verdict.PASS
    assert 0.7 < (test.ratio or 0.0) < 1.3
    assert abs(test.largest.error_mm) < 0.12
    assert draw(test)[:4] == b"\x89PNG"
    record = json.loads(json.dumps(record_of(test), allow_nan=False))
    assert record["of"] == 105
    assert record["lengths"][0]["error_mm"] == pytest.approx(test.lengths[0].error_mm)
    assert read_measured(path).marks.keys() == places.marks.keys()


def run(*arguments: object) -> tuple[int, str]:
    done = CliRunner().invoke(main, ["verify", *map(str, arguments)])
    return done.exit_code, done.output


def test_the_command(tmp_path: Path) -> None:
    path, truth = inspection_and_truth(tmp_path)
    code, said = run(path, truth, "--mpe", "0.15", "-o", tmp_path / "v.json", "--plot", tmp_path / "v.svg")
    assert code == 0, said
    assert "largest error" in said
    assert "of 105 errors are within it" in said
    assert json.loads((tmp_path / "v.json").read_text())["verdict"] == "pass"
    assert (tmp_path / "v.svg").read_bytes().startswith(b"<?xml")
    (tmp_path / "off").mkdir()
    off, truth = inspection_and_truth(tmp_path / "off", off_mm=0.3)
    code, said = run(off, truth, "--mpe", "0.15")
    assert code == ExitCode.FAIL
    assert "verdict: fail" in said
    code, said = run(off, truth)  # without a limit U is judged
    assert "not stated" not in said
    toml = tmp_path / "bar.toml"
    toml.write_text('name = "bar 7"\n[[length]]\nbetween = ["a", "b"]\nmm = 100.0\nU_mm = 0.03\n')
    points = tmp_path / "points.csv"
    points.write_text("name,x,y,z\na,0,0,0\nb,100.09,0,0\n")
    assert run(points, toml, "--mpe", "0.1")[0] == ExitCode.UNDECIDED  # 0.09 ± 0.03
    assert run(points, toml, "--mpe", "0.2")[0] == 0
    assert run(points, toml)[0] == ExitCode.UNDECIDED  # neither limit nor U
    lengths = tmp_path / "lengths.csv"
    lengths.write_text("from,to,mm,U_mm\nb,a,100.0,\n")
    code, said = run(points, lengths, "--mpe", "0.05", "--all")
    assert code == ExitCode.FAIL
    assert "VDI/VDE 2634 part 1 asks for 35 lengths" in said


@pytest.mark.parametrize(
    ("points", "known", "expected"),
    [
        ("name,x,y,z\na,0,0,0\n", None, "a length needs two"),
        ("name,x,y\na,0,0\n", None, "column 'z' is missing"),
        (";name,x,y,z\na,0,0,0\n", None, "is missing"),
        ("name,x,y,z\na,0,0,0\na,1,0,0\n", None, "line 3: the name 'a' is not unique"),
        ("name,x,y,z\na,0,nan,0\nb,1,0,0\n", None, "line 2: y = 'nan'"),
        (None, "[[length]]\nbetween = ['a', 'a']\nmm = 5\n", "expected two different marks"),
        (None, "[[length]]\nbetween = ['a', 'b']\nmm = -5\n", "mm = -5"),
        (None, "[[length]]\nbetween = ['a', 'b']\nmm = 5\nU = 1\n", "unknown key 'U'"),
        (None, "[[length]]\nbetween = ['x', 'y']\nmm = 5\n", "none of its 1 lengths was measured"),
        (None, "name = 'empty'\n", "contains no length"),
        (None, "[[length]\n", "neither TOML nor JSON"),
        (None, '{"K": 1}', "has no 'truth'"),
    ],
)
def test_bad_files_are_one_line(points: str | None, known: str | None, expected: str, tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text(points or "name,x,y,z,U_mm\na,0,0,0,0.01\nb,5,0,0,0.01\n")
    (tmp_path / "k.toml").write_text(known or "[[length]]\nbetween = ['a', 'b']\nmm = 5\n")
    code, said = run(tmp_path / "p.csv", tmp_path / "k.toml")
    assert code == ExitCode.BAD_INPUT
    assert expected in said
    assert len(said.strip().splitlines()) == 1
