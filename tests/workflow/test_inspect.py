"""`arview inspect`: exit codes, reuse of finished stages, and no results of other inputs in the folder."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

import arview.measurement
import arview.reconstruction
import arview.workflow.run
from arview.cli import ExitCode, main
from arview.cli.exit_codes import exit_code_of
from arview.core.stage_cache import Stages, content_key
from arview.errors import InputError, MismatchError, MissingDependencyError, OutputError
from arview.inspection import Inspection, Verdict, load_inspection
from arview.quality.history import HistoryStore
from arview.reconstruction.intake import Intake
from arview.reconstruction.run import Reconstruction
from arview.workflow import InspectJob, inspect_prepared
from arview.workflow.lock import exclusive_access
from arview.workflow.prepare import prepare
from arview.workflow.progress import STEPS, ProgressEstimate, ProgressEstimator, time_text
from helpers.cad_files import write_bench
from helpers.inspections import deviation, inspection, not_measured
from helpers.video_files import numbered, write_clip

PART = '[part]\nname = "bench"\ncad = "bench.obj"\nunit = "mm"\n[components.plate]\nrole = "base"\n'
ALL = ["reconstruct", "measure", "cloud", "measure"]
"""The verdict by photos comes before the cloud."""


class Bench:
    """A folder with inputs, and fakes of the stages that take minutes."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch) -> None:
        self.folder, self.did = folder, []
        self.moved: tuple[float | None, ...] = (0.1, 0.0, 0.0)
        self.is_measured, self.is_foreign = True, False
        self.fails: dict[str, BaseException] = {}
        write_bench(folder)
        (folder / "part.toml").write_text(PART)
        (folder / "photos").mkdir()
        for i in range(4):
            (folder / "photos" / f"{i}.jpg").write_bytes(bytes([i]) * 100)
        patch.setattr(arview.reconstruction, "reconstruct", self.reconstruct)
        patch.setattr(arview.measurement, "measure", self.measure)
        patch.setattr(arview.measurement, "read_folder", lambda folder, with_cloud=True: None)
        patch.setattr(arview.workflow.run, "with_halves", lambda found, *others: found)
        patch.setattr(arview.workflow.run, "make_film", self.film)

    def at(self, what: str) -> None:
        if what in self.fails:
            raise self.fails[what]
        self.did.append(what)

    def reconstruct(
        self, source: str, folder: Path, part: Any, camera: Any, options: Any, progress: Any, memory: Any = None
    ) -> Any:
        stages = Stages(folder)
        key = content_key(sorted(Path(source).iterdir()) if Path(source).is_dir() else [Path(source)])
        seconds = {"photos": 0.1}
        if not stages.is_finished("scale", key) or options.starts_over:
            self.at("reconstruct")
            stages.restart("dense")
            stages.finish("scale", key)
            seconds |= {"sparse": 1.0, "scale": 0.5}
        if options.last_stage == "dense" and not stages.is_finished("dense", key):
            self.at("cloud")
            progress("fusion", 1, 1)
            stages.finish("dense", key)
            seconds |= {"dense": 2.0}
        intake = Intake((), (("3.jpg", "is blurred"),), ("the photos are few",), (), ())
        return Reconstruction(folder, intake, None, None, None, None, None, seconds)

    def measure(self, reconstruction: Any, part: Any, options: Any, progress: Any, known: Any) -> Inspection:
        self.at("measure")
        center = np.array([30.0, 27.5, 12.5])
        one = deviation("block", self.moved, center) if self.is_measured else not_measured("block", center)
        return inspection(part.model, (one,), serial=part.serial or "", foreign=self.is_foreign)

    def film(self, video: str, part: Any, camera: Any, found: Any, film: Path, poses: Path, progress: Any) -> str:
        self.at("film")
        film.write_bytes(b"film of " + str(found.components[0].distance_mm).encode())
        poses.write_text("{}\n")
        return "the part followed in 5 of 5 frames"

    def inspect(self, *options: str) -> Result:
        self.did.clear()
        arguments = ["inspect", "--part", str(self.folder / "part.toml"), "--no-pdf", "-o", str(self.folder / "out")]
        if "--photos" not in options and "--video" not in options:
            arguments += ["--photos", str(self.folder / "photos")]
        return CliRunner().invoke(main, [*arguments, *options])


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(tmp_path, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "code", "word"),
    [
        ({}, 0, "PASS"),
        ({"moved": (2.0, 0.0, 0.0)}, 1, "FAIL"),
        ({"moved": (0.48, 0.0, 0.0)}, 2, "UNDECIDED"),
        ({"moved": (0.1, None, 0.0)}, 2, "UNDECIDED"),
        ({"is_foreign": True}, 2, "UNDECIDED"),
        ({"moved": (2.0, 0.0, 0.0), "is_foreign": True}, 1, "FAIL"),
        ({"is_measured": False}, 3, "NOT MEASURED"),
    ],
)
def test_the_exit_code_is_the_verdict(bench: Bench, change: dict[str, Any], code: int, word: str) -> None:
    vars(bench).update(change)
    found = bench.inspect("--serial", "SN-9")
    assert found.exit_code == code, found.output
    assert found.stdout.strip().splitlines()[-1].startswith(f"bench SN-9: {word}; 1 component")
    assert "warning: the photos are few" in found.stderr
    out = bench.folder / "out"
    assert load_inspection(out / "inspection.json").serial == "SN-9" and (out / "report.html").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("stage", "error", "code", "words"),
    [
        (
            "reconstruct",
            InputError("photos: only 2 of 24 fit together; take more"),
            3,
            "could not measure: photos: only",
        ),
        ("measure", InputError("the shape is not that of the CAD"), 3, "could not measure: the shape"),
        ("reconstruct", OutputError("out: the disk is full"), 64, "error: out: the disk is full"),
        ("measure", MissingDependencyError("torch is missing: pip install torch"), 64, "error: torch"),
        ("measure", ZeroDivisionError("division by zero"), 70, "internal error: ZeroDivisionError"),
        ("reconstruct", KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_without_a_verdict_there_is_a_code_of_its_own(
    bench: Bench, stage: str, error: BaseException, code: int, words: str
) -> None:
    bench.fails[stage] = error
    found = bench.inspect()
    assert found.exit_code == code and words in found.stderr and len(found.stderr.strip().splitlines()) == 1
    assert not (bench.folder / "out" / "inspection.json").exists()


@pytest.mark.parametrize(
    "options",
    [
        ["--photos", "nowhere"],
        ["--part", "nowhere.toml"],
        ["--camera", "nowhere.json"],
        ["--video-camera", "fov:60"],
        ["--scale-file", "nowhere.toml"],
        ["--tolerance", "-1"],
        ["--nonsense"],
        ["--video", "nowhere.mp4"],
        ["-o", "part.toml"],
        ["--store", "mysql://nowhere/x"],
    ],
)
def test_bad_input_is_said_before_the_work(bench: Bench, monkeypatch: pytest.MonkeyPatch, options: list[str]) -> None:
    monkeypatch.chdir(bench.folder)
    found = bench.inspect(*options)
    assert found.exit_code == 64 and not bench.did and "Traceback" not in found.output
    assert "internal" not in found.stderr and found.stderr.strip()


@pytest.mark.slow
def test_what_is_finished_is_kept(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    assert bench.inspect().exit_code == 0 and bench.did == ALL
    out = bench.folder / "out"
    before = {name: (out / name).read_bytes() for name in ("inspection.json", "report.html")}
    assert bench.inspect().exit_code == 0 and bench.did == []
    elsewhere = bench.folder / "copy"
    shutil.copytree(bench.folder / "photos", elsewhere)
    monkeypatch.chdir(bench.folder)
    assert bench.inspect("--photos", "copy").exit_code == 0 and bench.did == []
    assert {name: (out / name).read_bytes() for name in before} == before
    # A file that was touched or lost is made again, and nothing else; another tolerance repeats the measurement.
    (out / "report.html").unlink()
    assert bench.inspect().exit_code == 0 and bench.did == [] and (out / "report.html").is_file()
    (out / "inspection.json").write_text(before["inspection.json"].decode().replace('"pass"', '"fail"'))
    assert bench.inspect().exit_code == 0 and bench.did == ["measure"]
    assert bench.inspect("--tolerance", "0.3").exit_code == 0 and bench.did == ["measure", "measure"]
    assert bench.inspect("--tolerance", "0.3", "--force").exit_code == 0 and bench.did == ALL


@pytest.mark.slow
def test_the_verdict_is_said_before_the_cloud_and_without_one(bench: Bench) -> None:
    found = bench.inspect()
    assert "by the photos: PASS; 1 component" in found.stderr
    bench.fails["cloud"] = InputError("the cloud is empty")
    assert bench.inspect("--force").exit_code == 3
    assert bench.inspect("--no-cloud").exit_code == 0 and bench.did == ["measure", "measure"]
    assert (bench.folder / "out" / "report.html").is_file()


@pytest.mark.slow
def test_nothing_is_left_of_other_inputs(bench: Bench) -> None:
    assert bench.inspect().exit_code == 0
    (bench.folder / "photos" / "2.jpg").write_bytes(b"another photo")
    bench.fails["reconstruct"] = InputError("the photos do not fit together")
    assert bench.inspect().exit_code == 3
    out = bench.folder / "out"
    assert not (out / "inspection.json").exists() and not (out / "report.html").exists()
    assert load_inspection(out / "earlier" / "01" / "inspection.json").components[0].distance_mm == 0.1
    assert (out / "earlier" / "01" / "report.html").is_file()  # set aside, not lost
    bench.fails = {"measure": KeyboardInterrupt()}
    assert bench.inspect().exit_code == 130 and bench.did == ["reconstruct"]
    bench.fails.clear()
    assert bench.inspect().exit_code == 0 and bench.did == ["measure", "cloud", "measure"]


@pytest.mark.slow
def test_the_film_goes_with_the_measurement(bench: Bench) -> None:
    clip = write_clip(bench.folder / "clip.mp4", [numbered(index) for index in range(5)])
    photos = ["--photos", str(bench.folder / "photos")]
    found = bench.inspect(*photos, "--video", str(clip))
    assert found.exit_code == 0 and bench.did == [*ALL, "film"]
    assert "followed in 5 of 5" in found.stdout and "camera is guessed" in found.stderr
    film = bench.folder / "out" / "annotated.mp4"
    assert film.read_bytes() == b"film of 0.1"
    assert bench.inspect(*photos, "--video", str(clip)).exit_code == 0 and bench.did == []
    bench.moved = (0.2, 0.0, 0.0)
    assert bench.inspect(*photos, "--video", str(clip), "--tolerance", "3").exit_code == 0
    assert bench.did == ["measure", "measure", "film"] and film.read_bytes() == b"film of 0.2"
    bench.fails["film"] = InputError("clip.mp4: damaged at 2 s")
    found = bench.inspect(*photos, "--video", str(clip), "--video-camera", "fov:60", "--tolerance", "3")
    assert found.exit_code == 0 and "no film: clip.mp4: damaged" in found.stderr and not film.exists()
    bench.fails.clear()
    assert bench.inspect("--video", str(clip)).exit_code == 0 and bench.did == [*ALL, "film"]


def test_a_verdict_that_stands_is_not_made_anew_by_other_inputs(bench: Bench) -> None:
    out = bench.folder / "out"
    assert bench.inspect().exit_code == 0
    before = (out / "inspection.json").read_bytes()
    job = InspectJob(str(bench.folder / "part.toml"), str(bench.folder / "photos"), makes_pdf=False)
    bench.did.clear()
    inspect_prepared(prepare(job, out), out, is_settled=True)
    assert bench.did == [] and (out / "inspection.json").read_bytes() == before
    (bench.folder / "part.toml").write_text(PART + "[components.block]\nposition_tolerance_mm = 0.01\n")
    with pytest.raises(MismatchError, match="changed since the verdict"):
        inspect_prepared(prepare(job, out), out, is_settled=True)
    assert bench.did == [] and (out / "inspection.json").read_bytes() == before and (out / "report.html").is_file()


def test_two_do_not_work_in_one_folder(bench: Bench) -> None:
    with exclusive_access(bench.folder / "out", ".lock", waits=False):
        found = bench.inspect()
    assert found.exit_code == 64 and "another arview process is using this folder" in found.stderr and not bench.did
    assert bench.inspect().exit_code == 0


@pytest.mark.slow
def test_the_result_is_put_into_the_store(bench: Bench) -> None:
    store = bench.folder / "plates.sqlite"
    for count in (1, 1):
        assert bench.inspect("--serial", "SN-1", "--store", str(store), "--station", "cell-3").exit_code == 0
        with HistoryStore(store) as opened:
            listed = opened.listed()
        assert [(one.serial, one.station, one.verdict) for one in listed] == [("SN-1", "cell-3", "pass")] * count


def test_a_pdf_that_cannot_be_made_is_a_warning(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def absent() -> None:
        raise MissingDependencyError("the PDF needs the Pango libraries: apt-get install libpango-1.0-0")

    monkeypatch.setattr("arview.report.make._weasyprint", absent)
    arguments = ["inspect", "--part", str(bench.folder), "--photos", str(bench.folder / "photos"), "-o"]
    found = CliRunner().invoke(main, [*arguments, str(bench.folder / "out")])
    assert found.exit_code == 0 and "warning: no PDF: the PDF needs the Pango" in found.stderr
    assert (bench.folder / "out" / "report.html").is_file() and not (bench.folder / "out" / "report.pdf").exists()
    record = json.loads((bench.folder / "out" / "stages.json").read_text())
    assert "measure" in record and "report" not in record  # it is tried again when the libraries are there


def _clock(**options: Any) -> tuple[ProgressEstimator, list[ProgressEstimate], Callable[[float], None]]:
    now = [0.0]
    moments: list[ProgressEstimate] = []
    clock = ProgressEstimator(moments.append, now=lambda: now[0], **options)
    return clock, moments, lambda seconds: now.__setitem__(0, now[0] + seconds)


@pytest.mark.parametrize("speed", [1.0, 4.0])
def test_the_clock_tells_the_time_left(speed: float) -> None:
    clock, moments, wait = _clock()
    total = speed * sum(cost for _, cost in STEPS)
    told = 0
    for name, cost in STEPS:
        names = [f"{name} {i} of 4" for i in (1, 2, 3, 4)] if name == "depth maps" else [name]
        for each in names:
            clock.update(each, 0, 10)
            for done in range(1, 11):
                wait(speed * cost / 10 / len(names))
                clock.update(each, done, 10)
                now = moments[-1]
                if now.left_s is not None:
                    told += 1
                    assert now.passed_s + now.left_s == pytest.approx(total, rel=1e-6)
    assert told > 20
    assert moments[-1].share == pytest.approx(1.0) and moments[-1].left_s == pytest.approx(0.0, abs=1e-6)
    shares = [one.share for one in moments]
    assert shares == sorted(shares)


def test_steps_that_are_passed_over_count_for_nothing() -> None:
    clock, moments, wait = _clock(has_film=False, has_pdf=False, has_video_frames=False)
    clock.update("photos", 24, 24)
    wait(5.0)
    clock.update("components", 8, 16)  # the reconstruction was there
    costs = dict(STEPS)
    ahead = sum(cost for name, cost in STEPS[[name for name, _ in STEPS].index("components"):]
                if name not in ("film", "PDF"))  # fmt: skip
    expected = (costs["photos"] + 0.5 * costs["components"]) / (costs["photos"] + ahead)
    assert moments[-1].share == pytest.approx(expected)
    clock.update("something new", 1, 2)
    assert moments[-1].share == pytest.approx(expected) and moments[-1].step == "something new"
    assert (
        time_text(ProgressEstimate("x", 0.5, 65.4, 124.6)) == "1:05, 2:05 left"
        and time_text(ProgressEstimate("x", 0, 0, None)) == "0:00"
    )


def test_every_verdict_has_a_code() -> None:
    assert [exit_code_of(verdict.value) for verdict in sorted(Verdict, key=lambda one: exit_code_of(one.value))] == [
        ExitCode.DONE,
        ExitCode.DONE,  # measured, without a tolerance
        ExitCode.FAIL,
        ExitCode.UNDECIDED,
        ExitCode.CANNOT_MEASURE,
    ]
