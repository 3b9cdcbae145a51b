"""The command annotate on films and pictures of unusual kinds, and how it ends when nothing is found."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner, Result

import arview.guideviews.cache
import arview.tracking
from arview.camera import Camera
from arview.camera.read import save_camera
from arview.cli import ExitCode, main
from arview.core.atomic import unfinished_path, writing_process
from arview.pose import Pose, TrackingState
from arview.video import open_source
from helpers.fake_session import FakeSession
from helpers.film_kinds import write_film
from helpers.video_files import numbered, write_clip

PART = """
[part]
name = "brick"
cad = "brick.stl"
unit = "mm"
[view_range]
distance_mm = [300.0, 500.0]
elevation_deg = [30.0, 60.0]
azimuth_deg = [-20.0, 20.0]
"""
PART_OPTIONS = ("--part", "part.toml", "--renderer", "zbuffer", "--poses", "poses.jsonl")
ANNOTATE = (*PART_OPTIONS, "--camera", "camera.json")

pytestmark = pytest.mark.slow


class Never(FakeSession):
    """Does not find the part in any frame."""

    def process(self, image: object, index: int, time_s: float) -> tuple[Pose, ...]:
        """A frame without a pose."""
        return (Pose(None, None, 0.0, TrackingState.SEARCHING, time_s, index, 1.0, "too dark", ()),)


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def room(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a part and a camera, as the current folder."""
    trimesh.creation.box((40.0, 20.0, 10.0)).export(tmp_path / "brick.stl")
    (tmp_path / "part.toml").write_text(PART)
    save_camera(Camera(160, 120, 200.0, 200.0, 79.5, 59.5), tmp_path / "camera.json")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(arview.guideviews.cache, "cache_folder", lambda: cache)
    monkeypatch.setattr(arview.tracking, "TrackingSession", FakeSession)
    return tmp_path


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def lines_of(room: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in (room / "poses.jsonl").read_text().splitlines()]


def test_seconds_count_from_the_first_frame(room: Path) -> None:
    """--start 1s --end 2s of a film whose clock starts at 582 s is its second second."""
    write_film(room / "cam582.ts", [numbered(k % 20) for k in range(90)], first_s=582.0)
    result = run("annotate", "cam582.ts", *ANNOTATE, "--start", "1s", "--end", "2s", "-o", "out.mp4")
    assert result.exit_code == ExitCode.DONE, result.output
    lines = lines_of(room)
    assert [line["index"] for line in lines] == list(range(30, 60))
    np.testing.assert_allclose([line["time_s"] for line in lines], np.arange(30, 60) / 30, atol=1e-4)
    assert len(list(open_source(room / "out.mp4"))) == 30


def test_pictures_keep_number_time_and_name(room: Path) -> None:
    import cv2

    for k in (3, 4, 9):
        cv2.imwrite(f"frame_{k:04d}.png", numbered(k))
    result = run("annotate", "frame_%04d.png", *ANNOTATE, "--fps", "10")
    assert result.exit_code == ExitCode.DONE, result.output
    kept = [(line["index"], line["file"], round(float(str(line["time_s"])), 6)) for line in lines_of(room)]
    assert kept == [(3, "frame_0003.png", 0.0), (4, "frame_0004.png", 0.1), (9, "frame_0009.png", 0.6)]
    result = run("annotate", "none_%04d.png", *ANNOTATE)
    assert result.exit_code == ExitCode.BAD_INPUT and result.stderr.count("\n") == 1
    assert "no file in" in result.stderr and "fits the pattern" in result.stderr


def test_anamorphic_film_with_a_camera_of_its_stored_frames(room: Path) -> None:
    from fractions import Fraction

    write_film(room / "film.mp4", [numbered(k) for k in range(6)], pixel_aspect=Fraction(4, 3))
    save_camera(Camera(160, 120, 150.0, 200.0, 79.5, 59.5), room / "camera.json")
    result = run("annotate", "film.mp4", *ANNOTATE, "-o", "out.mp4")
    assert result.exit_code == ExitCode.DONE, result.output
    written = open_source(room / "out.mp4")
    assert (written.width, written.height) == (214, 120)  # 213 px, and one for the encoder


def test_a_part_found_in_no_frame(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_clip(room / "clip.mp4", [numbered(k) for k in range(6)])
    monkeypatch.setattr(arview.tracking, "TrackingSession", Never)
    result = run("annotate", "clip.mp4", *ANNOTATE)
    assert result.exit_code == ExitCode.CANNOT_MEASURE, result.output
    assert "6 searching" in result.stdout and "likely cause" not in result.output
    result = run("annotate", "clip.mp4", *PART_OPTIONS)
    assert result.exit_code == ExitCode.CANNOT_MEASURE, result.output
    assert "a likely cause: the camera was guessed, with a focal length of 192 px" in result.stdout


def test_changes_of_size_are_said(room: Path) -> None:
    first = write_film(room / "first.h264", [numbered(k) for k in range(6)])
    second = write_film(room / "second.h264", [numbered(k, 80, 60) for k in range(6)])
    (room / "change.h264").write_bytes(first.read_bytes() + second.read_bytes())
    result = run("annotate", "change.h264", *ANNOTATE)
    assert result.exit_code == ExitCode.DONE, result.output
    assert len(lines_of(room)) == 12 and "broken" not in result.stdout
    assert "note: the size changes from 160×120 to 80×60 px at frame 6" in result.stderr


@pytest.mark.skipif(os.name == "nt", reason="processes are not looked up on Windows")
def test_a_file_that_another_run_is_writing(room: Path) -> None:
    write_clip(room / "clip.mp4", [numbered(k) for k in range(6)])
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as other:
        part = unfinished_path(room / "poses.jsonl", other.pid)
        part.write_text("")
        assert writing_process(room / "poses.jsonl") == other.pid and writing_process(room / "other.jsonl") is None
        result = run("annotate", "clip.mp4", *ANNOTATE)
        assert result.exit_code == ExitCode.BAD_INPUT and result.stderr.count("\n") == 1
        assert f"poses.jsonl: process {other.pid} is writing it" in result.stderr
        assert not (room / "poses.jsonl").exists()
    result = run("annotate", "clip.mp4", *ANNOTATE)  # what a run left behind that has ended does no harm
    assert result.exit_code == ExitCode.DONE, result.output
