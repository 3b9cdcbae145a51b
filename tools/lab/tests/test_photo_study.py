"""Study of the photos: which are chosen, what their measurement is compared with, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.typing import NDArray

import arview_lab.studies.photos as photo_study_module
from arview.cli import main
from arview.errors import CannotMeasureError, InputError
from arview.geometry import Array, exp_so3, rigid
from arview.measurement.folder import MetricReconstruction
from arview.reconstruction.scale.types import Consistency, ScaleEvidence, ScaleResult
from arview.reconstruction.types import PosedPhoto, SparseModel
from arview_lab.studies import photo_study
from arview_lab.studies.photos import LEVEL_DEG, SIDE_DEG, PhotoStudyOptions, directions_of, subsets_of
from helpers.photo_scene import CAMERA, photograph, ring, write_photos
from helpers.plate_scene import TRUTH, as_built, part

PHOTOS = 12


def around(azimuths_deg: Array, heights_deg: Array) -> Array:
    """(N,3) directions."""
    a, h = np.deg2rad(azimuths_deg), np.deg2rad(heights_deg)
    return np.stack([np.cos(a) * np.cos(h), np.sin(a) * np.cos(h), np.sin(h)], axis=1)


def least_angle_deg(directions: Array) -> float:
    cosines = directions @ directions.T - 2.0 * np.eye(len(directions))
    return float(np.rad2deg(np.arccos(cosines.max())))


def test_layouts_choose_what_they_say() -> None:
    rng = np.random.default_rng(3)
    directions = around(rng.uniform(-180, 180, 60), rng.choice([20.0, 45.0, 70.0], 60) + rng.normal(0, 2, 60))
    subsets = subsets_of(directions, PhotoStudyOptions((6, 8, 12), 3, 1))
    assert [len(one.photos) for one in subsets if one.layout == "all"] == [60]
    by_layout = {name: [one for one in subsets if one.layout == name] for name in {one.layout for one in subsets}}
    assert {len(one.photos) for one in by_layout["spread"]} == {6, 8, 12} and len(by_layout["spread"]) == 9
    for one, other in zip(by_layout["spread"], by_layout["random"], strict=True):
        assert len(set(one.photos)) == len(one.photos) == len(other.photos)
        assert least_angle_deg(directions[one.photos]) > least_angle_deg(directions[other.photos])
    assert by_layout["one side"] and by_layout["one height"]
    for one in by_layout["one side"]:
        azimuths = np.sort(np.rad2deg(np.arctan2(directions[one.photos, 1], directions[one.photos, 0])))
        widest_gap = np.diff(np.append(azimuths, azimuths[0] + 360.0)).max()
        assert 360.0 - widest_gap <= SIDE_DEG
    for one in by_layout["one height"]:
        assert np.ptp(np.rad2deg(np.arcsin(directions[one.photos, 2]))) <= LEVEL_DEG
    again = subsets_of(directions, PhotoStudyOptions((6, 8, 12), 3, 1))
    assert all(np.array_equal(a.photos, b.photos) for a, b in zip(subsets, again, strict=True))


def test_a_layout_that_the_photos_do_not_have_is_left_out() -> None:
    directions = around(np.arange(0.0, 360.0, 30.0), np.linspace(10.0, 80.0, 12))
    subsets = subsets_of(directions, PhotoStudyOptions((8, 40), 1))
    assert {(one.layout, len(one.photos)) for one in subsets} == {("all", 12), ("spread", 8), ("random", 8)}


@pytest.mark.parametrize(
    ("changes", "text"),
    [({"layouts": ("ring",)}, "layouts ring"), ({"numbers": (2, 8)}, "3 or more"), ({"runs": 0}, "runs 0")],
)
def test_wrong_options_are_named(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(InputError, match=text):
        PhotoStudyOptions(**changes)


def test_the_command_says_what_is_wrong(tmp_path: Path) -> None:
    for options, text in (
        (["--numbers", "six"], "--numbers 'six': expected whole numbers"),
        (["--layouts", "dome"], "layouts dome: expected some of spread"),
        ([], "no such folder"),
    ):
        line = ["study", "photos", str(tmp_path / "none"), "--part", "samples/plate/part.toml"]
        done = CliRunner().invoke(main, [*line, "-o", str(tmp_path / "o"), *options])
        assert done.exit_code == 64 and text in done.output and done.output.count("\n") == 1, done.output
    assert not (tmp_path / "o").exists()


@pytest.fixture(scope="module")
def reconstruction(tmp_path_factory: pytest.TempPathFactory) -> MetricReconstruction:
    """Photos of the part as built, with exact poses."""
    poses = ring(PHOTOS, distance_mm=420.0)
    paths = write_photos(tmp_path_factory.mktemp("photos"), [photograph(as_built(), pose, seed=4) for pose in poses])
    photos = tuple(PosedPhoto(path.name, path, CAMERA, pose) for path, pose in zip(paths, poses, strict=True))
    none, index = np.zeros(0), np.zeros(0, np.int32)
    colors: NDArray[np.uint8] = np.zeros((0, 3), np.uint8)
    sparse = SparseModel(photos, np.zeros((0, 3)), colors, none, index, index, np.zeros((0, 2)))
    evidence = (ScaleEvidence("board", 1.0, 5e-5, "a board"),)
    scale = ScaleResult(1.0, 5e-5, np.eye(4), None, evidence, (), "", Consistency(True, ""))
    return MetricReconstruction(sparse, scale, None)


@pytest.mark.slow
def test_subsets_are_compared_with_the_truth(
    reconstruction: MetricReconstruction, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = photo_study_module

    def alone(folder: Path, whole: SparseModel, photos: list[PosedPhoto]) -> SparseModel:
        if len(photos) == 4:
            raise CannotMeasureError("4 of the photos are not placed without the others")
        return replace(whole, photos=tuple(photos))

    truth = tmp_path / "truth.json"
    places, model = {}, part().model
    for name, (shift, turn_deg) in TRUTH.items():
        center = model.component(name).centroid_in_model
        turn = exp_so3(np.deg2rad(np.asarray(turn_deg, dtype=float)))
        places[name] = {"measured_from_nominal": rigid(turn, center + shift - turn @ center).tolist()}
    truth.write_text(json.dumps({"truth": places}))
    monkeypatch.setattr(module, "adjusted_alone", alone)
    monkeypatch.setattr(module, "read_folder", lambda *args, **options: reconstruction)
    monkeypatch.setattr(module, "load_part", lambda path: part())
    study = photo_study("out", "part", str(truth), options=PhotoStudyOptions((4, 6), 1, 0, ("spread",)))
    columns, rows = study.tables["photos"]
    found = [dict(zip(columns, row, strict=True)) for row in rows]
    assert [(row["layout"], row["photos"]) for row in found] == [("all", PHOTOS), ("spread", 4), ("spread", 6)]
    assert "not placed" in str(found[1]["note"]) and found[1]["components"] == 0
    for row in (found[0], found[2]):
        assert row["components"] == len(TRUTH) and 0.0 < float(str(row["median_mm"])) < 0.1
        assert float(str(row["median_mm"])) < float(str(row["p95_mm"])) < 0.2
        assert 0.03 < float(str(row["mean_u_mm"])) < 0.5 and float(str(row["within_u"])) >= 2.0 / 3.0
    own = photo_study("out", "part", options=PhotoStudyOptions((6,), 1, 0, ("spread",)))
    columns, rows = own.tables["photos_components"]
    apart = [dict(zip(columns, row, strict=True))["off_mm"] for row in rows]
    assert len(apart) >= len(TRUTH) and all(value == "" or 0.0 < float(str(value)) < 0.15 for value in apart)
    assert any("difference from all photos" in line for line in own.summary)
    assert directions_of(reconstruction, part()).shape == (PHOTOS, 3)
