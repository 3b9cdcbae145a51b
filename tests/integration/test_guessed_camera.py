"""A film without a camera file: its focal length is estimated by `arview annotate` and kept as a profile."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from click.testing import CliRunner

from arview.cli import main
from helpers.paths import SAMPLES


@pytest.mark.slow
def test_the_focal_length_of_a_film_is_estimated_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ARVIEW_PROFILES", str(tmp_path / "profiles"))
    sample = SAMPLES / "bracket_plate"
    options = (
        "--part",
        str(sample / "part.toml"),
        "--poses",
        str(tmp_path / "poses.jsonl"),
        "--end",
        "200",
        "--stride",
        "4",
    )
    result = CliRunner().invoke(main, ["annotate", str(sample / "clip.mp4"), *options, "--save-profile", "film"])
    assert result.exit_code == 0, result.output
    found = re.search(r"focal length estimated: (\d+) ± (\d+) px \(guessed 1536\)", result.stderr)
    assert found is not None, result.stderr
    focal_px, expanded_px = float(found[1]), float(found[2])
    truth_px = json.loads((sample / "camera.json").read_text())["fx"]
    assert abs(focal_px - truth_px) <= expanded_px < 0.05 * truth_px
    profile = json.loads((tmp_path / "profiles" / "film.json").read_text())
    assert profile["fx"] == pytest.approx(focal_px, abs=0.5)
    assert profile["calibration"]["uncertainty"]["fx"] == pytest.approx(expanded_px, abs=0.5)
    again = CliRunner().invoke(
        main, ["annotate", str(sample / "clip.mp4"), *options[:-4], "--end", "3", "--camera", "profile:film"]
    )
    assert again.exit_code == 0 and again.stderr == ""
    lines = [json.loads(line) for line in (tmp_path / "poses.jsonl").read_text().splitlines()]
    assert "camera" not in lines[0]
