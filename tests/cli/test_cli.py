"""The command line: every bad input gives one line and exit code 2, files are finished, help is quick."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner, Result

import arview.guideviews.cache
import arview.tracking
from arview.cad import load_part
from arview.cad.viewpoint import viewpoint
from arview.cli import ExitCode, main
from arview.geometry import look_at
from arview.inspection import Inspection, Provenance, save_inspection
from arview.pose import Pose, TrackingState
from arview.version import __version__
from helpers.cad_files import box
from helpers.fake_session import POSE, FakeSession
from helpers.paths import TESTS
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


def write_stl(path: Path, scale: float = 1.0, nan: bool = False) -> Path:
    vertices, faces = box((10.0, 20.0, 0.0), (50.0, 40.0, 10.0))
    vertices = vertices * scale
    if nan:
        vertices[3, 1] = np.nan
    lines = ["solid brick"]
    for face in faces:
        rows = [f"vertex {x} {y} {z}" for x, y, z in vertices[face]]
        lines += ["facet normal 0 0 0", "outer loop", *rows, "endloop", "endfacet"]
    path.write_text("\n".join([*lines, "endsolid brick"]) + "\n")
    return path


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def room(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a part, a clip and a camera, as the current folder."""
    write_stl(tmp_path / "brick.stl")
    (tmp_path / "part.toml").write_text(PART)
    write_clip(tmp_path / "clip.mp4", [numbered(k) for k in range(12)])
    camera = {
        "width": 160,
        "height": 120,
        "fx": 200.0,
        "fy": 200.0,
        "cx": 79.5,
        "cy": 59.5,
        "dist": [0.0] * 5,
    }
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    monkeypatch.chdir(tmp_path)
    # Guide views are kept away from the user's; compiled kernels stay where they are found.
    monkeypatch.setattr(arview.guideviews.cache, "cache_folder", lambda: cache)
    monkeypatch.setattr(arview.tracking, "TrackingSession", FakeSession)
    return tmp_path


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


ANNOTATE = ("--part", "part.toml", "--camera", "camera.json", "--renderer", "zbuffer")


def refused(result: Result, *words: str) -> None:
    """One line on stderr that holds the words, exit code 2, nothing on stdout."""
    assert result.exit_code == 64, result.output
    assert result.stdout == ""
    lines = result.stderr.splitlines()
    assert len(lines) == 1, result.stderr
    assert lines[0].startswith("arview: error: ")
    for word in words:
        assert word in lines[0]


# --- What works -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_annotate_writes_video_and_poses(room: Path) -> None:
    result = run("annotate", "clip.mp4", *ANNOTATE, "-o", "out.mp4", "--poses", "poses.jsonl")
    assert result.exit_code == 0, result.output
    assert (room / "out.mp4").stat().st_size > 1000
    lines = (room / "poses.jsonl").read_text().splitlines()
    assert len(lines) == 12
    np.testing.assert_allclose(json.loads(lines[0])["cam_from_model"], POSE)
    assert "12 frames" in result.stdout and "12 tracked" in result.stdout
    assert result.stderr == ""


@pytest.mark.slow
def test_annotate_names_the_output_and_the_guessed_camera(room: Path) -> None:
    result = run("annotate", "clip.mp4", "--part", "part.toml", "--renderer", "zbuffer")
    assert result.exit_code == 0, result.output
    assert (room / "clip_annotated.mp4").is_file()
    assert "writing clip_annotated.mp4" in result.stderr
    assert "GUESSING a focal length of 192 px" in result.stderr


@pytest.mark.slow
def test_a_guess_that_cannot_be_improved_stays_one(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ARVIEW_PROFILES", str(room / "profiles"))
    options = ("--part", "part.toml", "--renderer", "zbuffer", "--poses", "poses.jsonl", "--save-profile", "phone")
    result = run("annotate", "clip.mp4", *options)
    assert result.exit_code == 0, result.output
    assert "not determined by these views: the guess of 192 px is kept" in result.stderr
    assert "profile phone was not written" in result.stderr and not (room / "profiles").exists()
    lines = [json.loads(line) for line in (room / "poses.jsonl").read_text().splitlines()]
    assert len(lines) == 12 and all(line["camera"]["fx"] == 192.0 for line in lines)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--camera", "fov:60", "--save-profile", "phone"), "leave out --camera"),
        (("--save-profile", "../phone"), "profile '../phone'"),
    ],
)
def test_a_profile_is_kept_of_an_estimate_only(room: Path, options: tuple[str, ...], words: str) -> None:
    for command in (("annotate", "clip.mp4"), ("live",)):
        result = run(*command, "--part", "part.toml", *options)
        assert result.exit_code == ExitCode.BAD_INPUT and words in result.stderr


def test_annotate_takes_a_part_of_the_frames_and_a_first_pose(room: Path) -> None:
    first = look_at([300.0, 0.0, 300.0], [30.0, 30.0, 5.0], [0.0, 0.0, 1.0])
    (room / "pose.json").write_text(json.dumps({"cam_from_model": first.tolist()}))
    options = (
        "--init",
        "pose.json",
        "--poses",
        "poses.jsonl",
        "--stride",
        "2",
        "--modalities",
        "edge,region",
    )
    result = run("annotate", "clip.mp4", *ANNOTATE, *options, "--start", "3", "--end", "9")
    assert result.exit_code == 0, result.output
    lines = [json.loads(line) for line in (room / "poses.jsonl").read_text().splitlines()]
    assert [line["index"] for line in lines] == [3, 5, 7]
    np.testing.assert_allclose(lines[0]["cam_from_model"], first, atol=1e-9)
    assert not list(room.glob("*.mp4.part")) and not (room / "clip_annotated.mp4").exists()
    result = run("annotate", "clip.mp4", *ANNOTATE, *options, "--start", "0.1s", "--end", "0.3s")
    assert result.exit_code == 0, result.output
    lines = [json.loads(line) for line in (room / "poses.jsonl").read_text().splitlines()]
    assert [line["index"] for line in lines] == [4, 6, 8]


@pytest.mark.slow
def test_annotate_aligns_with_a_guide_view(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (room / "part.toml").read_text()
    (room / "part.toml").write_text(text + "[guides.start]\nazimuth_deg = 5.0\nelevation_deg = 40.0\n")
    guides: list[Any] = []

    class Waiting(FakeSession):
        """Waits for the part, in the dark now and then."""

        def __init__(self, parts: Any, *arguments: Any, **others: Any) -> None:
            guides.append(parts[0].guide_cam_from_model)
            super().__init__(parts, *arguments, **others)

        def process(self, image: object, index: int, time_s: float) -> tuple[Pose, ...]:
            reason = "too dark" if index % 3 == 0 else f"only {index} % of the outline found"
            return (Pose(None, None, 0.0, TrackingState.SEARCHING, time_s, index, 1.0, reason, (), guides[-1]),)

    monkeypatch.setattr(arview.tracking, "TrackingSession", Waiting)
    for name, azimuth_deg, elevation_deg in (("start", 5.0, 40.0), ("az-10_el50_d400", -10.0, 50.0)):
        result = run("annotate", "clip.mp4", *ANNOTATE, "--init", f"guide:{name}", "-o", "out.mp4")
        assert result.exit_code == ExitCode.CANNOT_MEASURE, result.output
        found = viewpoint(guides[-1], [30.0, 30.0, 5.0])
        assert (found.azimuth_deg, found.elevation_deg) == pytest.approx((azimuth_deg, elevation_deg))
        assert "searching 12 frames: only 1 to 11 % of the outline found (8), too dark (4)" in result.stdout
    for name, word in (("strat", "did you mean 'start'"), ("front", "outside the declared range")):
        refused(run("annotate", "clip.mp4", *ANNOTATE, "--init", f"guide:{name}", "--poses", "p.jsonl"), name, word)


@pytest.mark.slow
def test_guideviews_are_written_and_used(room: Path) -> None:
    options = ("--renderer", "zbuffer", "--component", "brick", "--preview", "sheet.png")
    result = run("guideviews", "part.toml", "-o", "set.bin", *options)
    assert result.exit_code == 0, result.output
    assert "views of" in result.stdout and " s, " in result.stdout and " MB" in result.stdout
    assert (room / "sheet.png").read_bytes().startswith(b"\x89PNG")
    assert "insufficient: " in result.stdout  # a lone plain block
    assert run("guideviews", "part.toml", "-o", "set.bin", "--renderer", "zbuffer").exit_code == 0
    result = run("annotate", "clip.mp4", *ANNOTATE, "--guideviews", "set.bin", "--poses", "poses.jsonl")
    assert result.exit_code == 0, result.output


@pytest.mark.slow
def test_guide_views_are_kept_and_damaged_ones_made_anew(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arview.guideviews.cache, "cache_folder", lambda: room / "cache")
    arguments = ("annotate", "clip.mp4", *ANNOTATE, "--poses", "poses.jsonl")
    assert run(*arguments).exit_code == 0
    (kept,) = (room / "cache" / "guideviews").iterdir()
    made = kept.stat().st_mtime_ns
    assert run(*arguments).exit_code == 0
    assert kept.stat().st_mtime_ns == made
    kept.write_bytes(kept.read_bytes()[:1000])
    assert run(*arguments).exit_code == 0
    assert kept.stat().st_size > 1000
    monkeypatch.setattr(arview.guideviews.cache, "cache_folder", lambda: room / "part.toml" / "cache")
    assert run(*arguments).exit_code == 0


def test_check_prints_the_part_and_a_part_file_that_can_be_read(room: Path) -> None:
    result = run("check", "part.toml", "--camera", "fov:60")
    assert result.exit_code == 0, result.output
    assert "brick" in result.stdout
    example = run("check", "--example")
    assert example.exit_code == 0 and "view_range" in tomllib.loads(example.stdout)


# --- Bad input ------------------------------------------------------------------------------------------


def test_bad_videos(room: Path) -> None:
    whole = (room / "clip.mp4").read_bytes()
    (room / "cut.mp4").write_bytes(whole[: len(whole) // 2])
    (room / "empty.mp4").write_bytes(b"")
    (room / "text.mp4").write_text("this is not a video\n" * 50)
    (room / "folder").mkdir()
    for source, word in (
        ("cut.mp4", "cut-short"),
        ("empty.mp4", "0 bytes"),
        ("text.mp4", "text file"),
        ("none.mp4", "no such file"),
        ("folder", "no pictures"),
    ):
        refused(run("annotate", source, *ANNOTATE, "-o", "out.mp4"), source, word)
    assert not (room / "out.mp4").exists()


def test_bad_cameras(room: Path) -> None:
    good = json.loads((room / "camera.json").read_text())
    cameras = {
        "wide.json": ({**good, "width": 1920, "height": 1080, "cx": 959.5, "cy": 539.5}, "160×120"),
        "nan.json": ({**good, "fx": float("nan")}, "NaN"),
    }
    for name, (content, word) in cameras.items():
        (room / name).write_text(json.dumps(content))
        arguments = ("--part", "part.toml", "--camera", name, "--poses", "poses.jsonl")
        refused(run("annotate", "clip.mp4", *arguments), name, word)
    refused(run("annotate", "clip.mp4", "--part", "part.toml", "--camera", "fov:900", "--poses", "p.jsonl"))


def test_bad_cad_and_parts(room: Path) -> None:
    write_stl(room / "nan.stl", nan=True)
    write_stl(room / "metres.stl", scale=1e-3)
    refused(run("check", "nan.stl", "--unit", "mm"), "nan.stl", "NaN")
    refused(run("check", "brick.stl"), "unit")
    refused(run("check", "none.step"), "no such file")
    (room / "wrong.toml").write_text(PART + '[components.post_9]\nrole = "inspect"\n')
    refused(run("check", "wrong.toml"), "post_9", "brick")
    refused(run("guideviews", "part.toml", "-o", "set.bin", "--component", "post_9"), "post_9", "brick")
    (room / "part_m.toml").write_text(PART.replace("brick.stl", "metres.stl").replace('unit = "mm"', ""))
    refused(run("check", "part_m.toml"), "which unit", "--unit m")


def test_cad_in_metres_read_as_mm_is_questioned(room: Path) -> None:
    vertices, faces = box((0.010, 0.020, 0.0), (0.050, 0.040, 0.010))
    # glTF says metres; a file whose numbers are a thousandth of that is too small to be a part.
    trimesh.Trimesh(vertices * 1e-3, faces).export(room / "tiny.glb")
    refused(run("check", "tiny.glb"), "is it really", "--unit")


@pytest.mark.slow
def test_guide_views_of_another_model(room: Path) -> None:
    write_stl(room / "other.stl", scale=1.1)
    (room / "other.toml").write_text(PART.replace("brick.stl", "other.stl"))
    assert run("guideviews", "other.toml", "-o", "o.bin", "--renderer", "zbuffer").exit_code == 0
    result = run("annotate", "clip.mp4", *ANNOTATE, "--guideviews", "o.bin", "--poses", "poses.jsonl")
    refused(result, "o.bin", "other", "brick")
    refused(run("annotate", "clip.mp4", *ANNOTATE, "--guideviews", "camera.json", "--poses", "p.jsonl"))


def test_inspection_of_another_model_or_version(room: Path) -> None:
    model = load_part("part.toml").model
    provenance = Provenance("test", "0", "by hand")
    made = Inspection("brick", "1", model.source_hash, datetime(2026, 1, 1, tzinfo=UTC), (), provenance)
    save_inspection(made, room / "good.json")
    text = (room / "good.json").read_text()
    (room / "other.json").write_text(text.replace(model.source_hash, "0" * 64))
    (room / "newer.json").write_text(text.replace('"1.3"', '"9.0"'))
    arguments = ("annotate", "clip.mp4", *ANNOTATE, "--poses", "poses.jsonl", "--inspection")
    assert run(*arguments, "good.json").exit_code == 0
    refused(run(*arguments, "other.json"), "other.json", "another model")
    refused(run(*arguments, "newer.json"), "newer.json", "newer arview")


def test_bad_first_poses(room: Path) -> None:
    bad: dict[str, tuple[str, str]] = {
        "text.json": ("{", "not valid JSON"),
        "list.json": ("[]", "cam_from_model"),
        "scaled.json": (json.dumps({"cam_from_model": (2 * np.eye(4)).tolist()}), "last row"),
        "short.json": (json.dumps({"cam_from_model": [[1, 0], [0, 1]]}), "4×4"),
    }
    for name, (text, word) in bad.items():
        (room / name).write_text(text)
        refused(run("annotate", "clip.mp4", *ANNOTATE, "--init", name, "--poses", "p.jsonl"), name, word)
    refused(run("annotate", "clip.mp4", *ANNOTATE, "--init", "none.json", "--poses", "p.jsonl"), "none.json")


def test_outputs_that_cannot_be(room: Path) -> None:
    below_a_file = "camera.json/out.mp4"
    refused(run("annotate", "clip.mp4", *ANNOTATE, "-o", below_a_file), below_a_file)
    refused(run("annotate", "clip.mp4", *ANNOTATE, "--poses", "camera.json/p.jsonl"), "no folder")
    refused(run("annotate", "clip.mp4", *ANNOTATE, "-o", "none/out.mp4"), "no folder")
    refused(run("annotate", "clip.mp4", *ANNOTATE, "-o", "out.avi"), ".mp4")
    refused(run("guideviews", "part.toml", "-o", "camera.json/set.bin"), "no folder")
    refused(run("guideviews", "part.toml", "-o", "set.bin", "--preview", "sheet.bmp"), ".png")


def test_inputs_are_never_overwritten(room: Path) -> None:
    before = (room / "clip.mp4").read_bytes()
    (room / "link.mp4").symlink_to("clip.mp4")
    for output in ("clip.mp4", "./clip.mp4", "link.mp4"):
        refused(run("annotate", "clip.mp4", *ANNOTATE, "-o", output), "overwrite")
    refused(run("annotate", "clip.mp4", *ANNOTATE, "--poses", "camera.json"), "overwrite")
    refused(run("guideviews", "part.toml", "-o", "brick.stl"), "overwrite")
    assert (room / "clip.mp4").read_bytes() == before


@pytest.mark.parametrize(
    "option",
    [
        "--start=x",
        "--end=-1",
        "--stride=0",
        "--modalities=edge,colour",
        "--opacity=2",
        "--serial-at=5",
        "--serial-at=1s:4,5",
    ],
)
def test_bad_options(room: Path, option: str) -> None:
    result = run("annotate", "clip.mp4", *ANNOTATE, option)
    assert result.exit_code == 64
    assert result.stderr.splitlines()[-1].startswith("Error: Invalid value")


def test_empty_ranges(room: Path) -> None:
    arguments = ("annotate", "clip.mp4", *ANNOTATE, "--poses", "poses.jsonl")
    refused(run(*arguments, "--start", "9", "--end", "4"), "no frame is left")
    refused(run(*arguments, "--start", "900"), "past the last")
    refused(run(*arguments, "--start", "90s"), "no frame in the wanted range")
    assert not (room / "poses.jsonl").exists()


def test_unexpected_errors_are_one_line(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def explode(self: FakeSession, image: object, index: int, time_s: float) -> tuple[Pose, ...]:
        raise ZeroDivisionError("by nothing")

    monkeypatch.setattr(FakeSession, "process", explode)
    arguments = ("annotate", "clip.mp4", *ANNOTATE, "-o", "out.mp4")
    result = run(*arguments)
    assert result.exit_code == ExitCode.BUG
    (line,) = result.stderr.splitlines()
    assert "ZeroDivisionError" in line and "please report" in line
    assert not (room / "out.mp4").exists()
    monkeypatch.setenv("ARVIEW_DEBUG", "1")
    assert "Traceback" in run(*arguments).stderr


# --- In a process of its own ----------------------------------------------------------------------------

WITH_FAKE = """
import sys
import tomllib
sys.path.insert(0, {tests!r})
import arview.tracking
from helpers.fake_session import FakeSession
arview.tracking.TrackingSession = FakeSession
from arview.cli import main
main()
"""


def start(room: Path, *arguments: str, **environment: str) -> subprocess.Popen[str]:
    code = WITH_FAKE.format(tests=str(TESTS))
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        cwd=room,
        env={**os.environ, **environment},
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        # A test run in the background of a shell script has Ctrl-C ignored, and would pass it on.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


@pytest.mark.slow
def test_ctrl_c_finishes_the_files(room: Path) -> None:
    arguments = ("clip.mp4", *ANNOTATE, "-o", "out.mp4", "--poses", "poses.jsonl")
    process = start(room, "annotate", *arguments, FAKE_SESSION_S="0.3")
    waited = time.monotonic()
    while not list(room.glob(".poses.jsonl*")) and time.monotonic() - waited < 40:
        time.sleep(0.05)
    time.sleep(1.0)
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=40)
    assert process.returncode == 130, stderr
    assert stderr.strip() == "arview: interrupted"
    frames = len((room / "poses.jsonl").read_text().splitlines())
    assert 1 <= frames < 12 and f"{frames} frames" in stdout
    assert run("annotate", "out.mp4", *ANNOTATE, "--poses", "again.jsonl").exit_code == 0
    assert len((room / "again.jsonl").read_text().splitlines()) == frames
    assert not list(room.glob(".*"))


@pytest.fixture
def small_disk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("disk")
    mount = shutil.which("mount")
    options = ["-t", "tmpfs", "-o", "size=64k", "tmpfs", str(folder)]
    if mount is None or subprocess.run([mount, *options], capture_output=True).returncode != 0:
        pytest.skip("no small tmpfs can be mounted here")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


@pytest.mark.slow
def test_full_disk_is_one_line(room: Path, small_disk: Path) -> None:
    rng = np.random.default_rng(1)
    noise = [rng.integers(0, 255, (120, 160, 3), dtype=np.uint8) for _ in range(60)]
    write_clip(room / "noise.mp4", noise)
    refused(run("annotate", "noise.mp4", *ANNOTATE, "-o", small_disk / "out.mp4"), "disk is full")
    assert list(small_disk.iterdir()) == []
    result = run("guideviews", "part.toml", "-o", small_disk / "set.bin", "--renderer", "zbuffer")
    refused(result, "set.bin", "No space left")
    assert list(small_disk.iterdir()) == []


@pytest.mark.slow
def test_program_prints_one_line_and_no_traceback(room: Path) -> None:
    program = [sys.executable, "-m", "arview.cli"]
    done = subprocess.run([*program, "check", "none.step"], capture_output=True, text=True, cwd=room)
    assert done.returncode == 64
    assert done.stderr.startswith("arview: error: none.step") and done.stderr.count("\n") == 1
    done = subprocess.run([*program, "--version"], capture_output=True, text=True, cwd=room)
    assert __version__ in done.stdout


def test_import_and_help_are_light() -> None:
    code = (
        "import sys, arview, arview.cli\n"
        "from click.testing import CliRunner\n"
        "assert CliRunner().invoke(arview.cli.main, ['annotate', '--help']).exit_code == 0\n"
        "print('heavy:', sorted({'numpy', 'numba', 'cv2', 'av', 'scipy', 'trimesh'} & set(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, timeout=60, capture_output=True, text=True)
    assert done.stdout == "heavy: []\n"


def test_a_file_is_no_folder_of_jobs(room: Path) -> None:
    (room / "jobs").write_text("mine")
    result = run("live", "--part", "part.toml", "--jobs", "jobs")
    assert result.exit_code == ExitCode.BAD_INPUT and "'jobs' is a file" in result.stderr
