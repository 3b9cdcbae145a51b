"""The studies run, are the same with the same seed, write their files, and reach their figures on few points."""

import csv

import numpy as np
import pytest
from click.testing import CliRunner

from arview.cli import main
from arview.errors import OutputError
from arview_lab.chart import Chart, save_picture, stack
from arview_lab.studies import (
    density_study,
    displacement_study,
    minima_study,
    noise_study,
    registration_study,
    rice_study,
    sampling_study,
    threshold_study,
    write_study,
)


def table(study, name=None):
    columns, rows = study.tables[name or study.name]
    return [dict(zip(columns, row, strict=True)) for row in rows]


@pytest.mark.slow
def test_displacement_study():
    study = displacement_study(is_quick=True)
    rows = table(study)
    assert len(rows) == 18
    assert all(abs(row["mean_estimate_mm"] - row["true_mm"]) < 0.01 for row in rows)
    curve = table(study, "displacement_cost")
    lowest = min(curve, key=lambda row: row["rms_mm"])
    assert abs(lowest["shift_mm"]) < 0.03
    assert study.picture.shape == (1800, 960, 3)


@pytest.mark.slow
def test_noise_study_is_unbiased_and_repeatable():
    study, again = noise_study(is_quick=True), noise_study(is_quick=True)
    assert study.tables == again.tables
    rows = table(study)
    assert len(rows) > 1
    for row in rows:
        # 2,000 points scatter by some 35 um per mm of noise; of six runs the mean, four times over.
        assert abs(row["bias_um"]) < 4.0 * 35.0 * row["sigma_mm"] / np.sqrt(6.0) + 0.1, row
        assert row["std_um"] <= 60.0 * row["sigma_mm"] + 0.1, row
    assert noise_study(is_quick=True, seed=1).tables != study.tables


def test_rice_study():
    rows = table(rice_study(is_quick=True))
    assert len(rows) > 1
    for row in rows:
        assert row["mean_mm"] == pytest.approx(row["rice_mean_mm"], abs=0.02)
        assert abs(row["estimated_offset_mm"] - row["offset_mm"]) < 0.03
        assert row["mean_mm"] > row["offset_mm"]


def test_density_study():
    rows = table(density_study(is_quick=True, rows="bc"))
    assert {row["method"] for row in rows} == {"exact", "plane", "point"}
    for row in rows:
        assert row["cpu_s"] > 0
        if row["method"] == "exact":
            assert row["largest_error_um"] < 0.01
        assert row["largest_error_um"] < 150.0
    by_method = {row["method"]: row["mean_error_um"] for row in rows if row["row"] == "b"}
    assert by_method["exact"] < by_method["plane"] < by_method["point"]


@pytest.mark.slow
def test_threshold_study():
    rows = table(threshold_study(is_quick=True))
    exact = [row for row in rows if row["method"] == "exact surface" and row["threshold"] <= 1e-3]
    assert len(exact) > 1
    assert all(row["mean_error_plane_um"] < 0.01 for row in exact)
    same = {row["threshold"]: row for row in rows if row["method"].endswith("same points")}
    assert abs(same[1e-4]["bias_along_um"]) < 0.2
    assert same[1e-1]["mean_error_plane_um"] > same[1e-4]["mean_error_plane_um"]
    assert same[1e-1]["iterations"] < same[1e-5]["iterations"]


def test_command_writes_csv_and_picture(tmp_path):
    done = CliRunner().invoke(main, ["study", "rice", "--quick", "-o", str(tmp_path / "s")])
    assert done.exit_code == 0, done.output
    assert "by Rice" in done.output
    with (tmp_path / "s" / "rice.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["offset_mm"] for row in rows] == ["0", "1"]
    assert (tmp_path / "s" / "rice.png").read_bytes()[:4] == b"\x89PNG"
    refused = CliRunner().invoke(main, ["study", "rice", "--quick", "-o", str(tmp_path / "s" / "rice.csv")])
    assert refused.exit_code == 64
    assert "is a file; give a folder" in refused.output
    wrong = CliRunner().invoke(main, ["study", "density", "--rows", "ax", "-o", str(tmp_path / "s")])
    assert wrong.exit_code == 64
    assert "expected letters of abcd" in wrong.output


def test_a_folder_that_cannot_be_written_is_said(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        write_study(rice_study(is_quick=True), blocked / "sub")
    with pytest.raises(OutputError, match="cannot be written"):
        save_picture(np.zeros((4, 4, 3), np.uint8), tmp_path / "none" / "p.png")


def test_charts_put_values_where_they_belong():
    chart = Chart("t", "x", "y")
    chart.add([0.0, 1.0, 2.0], [0.0, 10.0, 0.0])
    image = chart.draw(400, 300)
    blue = np.argwhere((image == (31, 119, 180)).all(axis=2))
    top = blue[blue[:, 0] < blue[:, 0].min() + 6]
    assert abs(top[:, 1].mean() - 0.5 * (95 + 375)) < 4
    assert stack([image, image]).shape == (600, 400, 3)
    empty = Chart("t", "x", "y", True, True)
    empty.add([1.0, 10.0], [0.0, np.nan])
    assert empty.draw().shape == (600, 960, 3)


@pytest.mark.slow
def test_registration_study_has_every_way_on_the_same_clouds():
    study = registration_study(is_quick=True)
    rows = table(study)
    assert {row["way"].split(",")[0] for row in rows} == {"exact surface", "point to point", "point to plane"}
    exact = next(row for row in rows if row["way"] == "exact surface" and row["noise_mm"] == 0.0)
    assert exact["largest_error_um"] < 0.1
    for row in rows:
        if row["noise_mm"] == 0.4:
            assert 1.0 < row["mean_error_um"] < 120.0, row


@pytest.mark.slow
def test_sampling_study_by_information_beats_chance():
    rows = {(row["method"], row["kept"]): row for row in table(sampling_study(is_quick=True))}
    assert len(rows) == 10
    assert rows["by information", 100]["rms_up_um"] < rows["random", 100]["rms_up_um"]


@pytest.mark.slow
def test_minima_study_finds_the_grooves():
    study = minima_study(is_quick=True)
    rows = table(study)
    assert {row["post"] for row in rows} == {"round", "hexagonal", "stepped", "grooved"}
    assert all(0.0 <= row["found"] <= 1.0 for row in rows)
    near = [row["found"] for row in rows if row["displacement_mm"] == 1.0 and row["way"] == "several starts"]
    assert len(near) == 8 and np.mean(near) > 0.7
