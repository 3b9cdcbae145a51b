"""Batches: dead workers, resumed jobs, and results equal to those of serial runs."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import sys
import time
from pathlib import Path

import cloudpickle
import numpy as np
import pytest
from click.testing import CliRunner

from arview.cli import main
from arview.errors import InputError
from arview.inspection import Inspection, Provenance, load_inspection, save_inspection
from arview.quality.batch.jobs_file import JOBS_FILE_EXAMPLE, BatchJob, load_jobs
from arview.quality.batch.run import BatchOptions, JobResult, Work, run_batch, run_job
from arview.workflow.job import InspectJob
from helpers.inspections import CREATED, deviation

pytest.importorskip("distributed")
cloudpickle.register_pickle_by_value(sys.modules[__name__])


def key(job: InspectJob, folder: Path) -> str:
    return hashlib.sha256(Path(job.photos or "").read_bytes() + repr(job.tolerance_mm).encode()).hexdigest()


def measure_mean(job: InspectJob, folder: Path) -> tuple[str, str]:
    """A small measurement: the mean of noisy points; each attempt adds a line beside the input."""
    path = Path(job.photos or "")
    with path.with_suffix(".tries").open("a") as file:
        file.write(f"{os.getpid()}\n")
    order = path.with_suffix(".die")
    if order.exists():
        order.unlink()
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.15)
    moved = np.load(path).mean(axis=0)
    component = deviation("block", tuple(float(v) for v in moved), np.zeros(3), job.tolerance_mm)
    inspection = Inspection("bench", job.serial or "", "0" * 64, CREATED, (component,), Provenance("test", "1", "mean"))
    save_inspection(inspection, folder / "inspection.json")
    return component.verdict.value, f"{moved[0]:.3f}"


LIGHT = Work(key, measure_mean, ("inspection.json",))
TWO = BatchOptions(workers=2, memory_limit="2GB", retries=1)


def batch(folder: Path, out: str, count: int = 12) -> list[BatchJob]:
    folder.mkdir(exist_ok=True)
    jobs = []
    for i in range(count):
        path = folder / f"P-{i:02d}.npy"
        if not path.exists():
            rng = np.random.default_rng(i)
            np.save(path, rng.normal((0.1 * i, 0.0, 0.0), 0.05, (500, 3)))
        job = InspectJob("part.toml", str(path), serial=path.stem, tolerance_mm=0.5)
        jobs.append(BatchJob(path.stem, job, f"{out}/{path.stem}"))
    return jobs


def tries(folder: Path) -> dict[str, list[str]]:
    return {path.stem: path.read_text().split() for path in sorted(folder.glob("*.tries"))}


@pytest.mark.slow
def test_a_killed_worker_loses_nothing(tmp_path: Path) -> None:
    serial = [run_job(one, LIGHT) for one in batch(tmp_path / "in", str(tmp_path / "serial"))]
    assert [one.verdict for one in serial] == ["pass"] * 5 + ["undecided"] + ["fail"] * 6
    for path in (tmp_path / "in").glob("*.tries"):
        path.unlink()
    jobs = batch(tmp_path / "in", str(tmp_path / "batch"))
    (tmp_path / "in" / "P-06.die").touch()
    seen: list[JobResult] = []
    found = run_batch(jobs, TWO, LIGHT, progress=seen.append)
    assert [(one.name, one.verdict, one.text) for one in found] == [(o.name, o.verdict, o.text) for o in serial]
    assert sorted(one.name for one in seen) == [one.name for one in jobs]
    for one in jobs:
        path = Path("serial") / one.name / "inspection.json"
        assert (tmp_path / path).read_bytes() == (Path(one.out) / "inspection.json").read_bytes()
        assert load_inspection(Path(one.out) / "inspection.json").serial == one.name
    tried = tries(tmp_path / "in")
    assert len(tried["P-06"]) == 2 and tried["P-06"][0] != tried["P-06"][1]
    # Only the job that ran on the dead worker was done again; those it had finished are read, not repeated.
    assert all(len(pids) == 1 for name, pids in tried.items() if name != "P-06")
    assert len({pid for pids in tried.values() for pid in pids}) >= 2
    again = run_batch(jobs, TWO, LIGHT)
    assert all(one.is_kept for one in again) and tries(tmp_path / "in") == tried
    assert [(one.name, one.inspection_sha256) for one in again] == [(one.name, one.inspection_sha256) for one in found]


@pytest.mark.slow
def test_what_kills_every_worker_stops_only_itself(tmp_path: Path) -> None:
    def deadly(job: InspectJob, folder: Path) -> tuple[str, str]:
        if job.serial == "P-01":
            os.kill(os.getpid(), signal.SIGKILL)
        return measure_mean(job, folder)

    found = run_batch(batch(tmp_path / "in", str(tmp_path / "out"), 3), TWO, Work(key, deadly, LIGHT.files))
    assert [one.verdict for one in found] == ["pass", "error", "pass"]
    assert "2 workers died" in found[1].text and not (tmp_path / "out" / "P-01" / "result.json").exists()


def test_done_again_only_where_something_changed(tmp_path: Path) -> None:
    jobs = batch(tmp_path / "in", str(tmp_path / "out"), 3)
    for one in jobs:
        assert not run_job(one, LIGHT).is_kept
    assert all(run_job(one, LIGHT).is_kept for one in jobs)
    np.save(tmp_path / "in" / "P-00.npy", np.full((5, 3), 2.0))
    (tmp_path / "out" / "P-01" / "inspection.json").write_text("{}")
    (tmp_path / "out" / "P-02" / "result.json").write_text("half a fi")
    again = [run_job(one, LIGHT) for one in jobs]
    assert [one.is_kept for one in again] == [False, False, False]
    assert [one.verdict for one in again] == ["fail", "pass", "pass"]


def test_results_on_shared_storage(tmp_path: Path) -> None:
    place = f"file://{tmp_path}/bucket"
    inputs = batch(tmp_path / "in", place, 2)
    jobs = [BatchJob(o.name, InspectJob(**{**vars(o.job), "photos": f"file://{o.job.photos}"}), o.out) for o in inputs]
    first = [run_job(one, LIGHT) for one in jobs]
    assert [one.verdict for one in first] == ["pass", "pass"]
    for one in jobs:
        folder = tmp_path / "bucket" / one.name
        assert sorted(path.name for path in folder.iterdir()) == ["inspection.json", "result.json"]
        assert json.loads((folder / "result.json").read_text())["files"] == ["inspection.json"]
    assert all(run_job(one, LIGHT).is_kept for one in jobs)
    gone = BatchJob("x", InspectJob("part.toml", f"file://{tmp_path}/none.npy"), f"{place}/x")
    assert run_job(gone, LIGHT) == JobResult("x", "error", f"file://{tmp_path}/none.npy: no such file or folder",
                                               f"{place}/x")  # fmt: skip


def test_the_example_is_a_file_of_jobs(tmp_path: Path) -> None:
    path = tmp_path / "jobs.toml"
    path.write_text(JOBS_FILE_EXAMPLE)
    first, second = load_jobs(path)
    assert (first.name, second.name) == ("PL-0417", "PL-0418_repeat")
    assert first.job.part == str(tmp_path / "part.toml") and first.out == str(tmp_path / "results" / "PL-0417")
    assert second.job.video == str(tmp_path / "films" / "PL-0418.mp4") and second.job.serial == "PL-0418"


def test_masks_and_poses_are_found_beside_the_file(tmp_path: Path) -> None:
    path = tmp_path / "jobs.toml"
    job = 'serial = "a"\npart = "p"\nphotos = "i"\nmasks = "m"\nsparse = "s3://poses/a"\ncompares_halves = false'
    path.write_text(f'out = "o"\n[[job]]\n{job}')
    found = load_jobs(path)[0].job
    assert (found.masks, found.sparse) == (str(tmp_path / "m"), "s3://poses/a")
    assert not found.compares_halves
    for text, masks in (("auto", "auto"), ("./auto", str(tmp_path / "auto"))):
        path.write_text(f'out = "o"\n[[job]]\n{job.replace("masks = " + chr(34) + "m", "masks = " + chr(34) + text)}')
        assert load_jobs(path)[0].job.masks == masks


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("out = 1", "out: expected the folder or URL"),
        ('out = "o"', "at least one"),
        ('out = "o"\n[[job]]\nserial = "a"\nphotos = "p"', "job 1: part: is missing"),
        ('out = "o"\n[[job]]\nserial = "a"\npart = "p"', "job 1: give photos"),
        ('out = "o"\n[[job]]\nserial = "../a"\npart = "p"\nphotos = "p"', "name '../a'"),
        ('out = "o"\n[[job]]\nserial = "a"\npart = "p"\nphotos = "p"\n[[job]]\nserial = "a"\npart = "p"\nphotos = "p"',
         "job 2: 'a' occurs twice"),
        ('out = "o"\n[[job]]\nserial = "a"\npart = "p"\nphotos = "p"\ntolerance = 1', "unknown tolerance"),
        ('out = "o"\n[[job]]\nserial = "a"\npart = "p"\nphotos = "p"\ntolerance_mm = "1"', "tolerance_mm: '1'"),
        ("out = ", "not valid TOML"),
    ],
)  # fmt: skip
def test_bad_jobs_are_named(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "jobs.toml"
    path.write_text(text)
    with pytest.raises(InputError) as error:
        load_jobs(path)
    assert words in str(error.value) and "\n" not in str(error.value)


def test_a_scheduler_that_is_not_there(tmp_path: Path) -> None:
    path = tmp_path / "jobs.toml"
    path.write_text('out = "o"\n[[job]]\nserial = "a"\npart = "p"\nphotos = "p"')
    found = CliRunner().invoke(main, ["batch", str(path), "--scheduler", "tcp://127.0.0.1:9", "--connect-s", "1"])
    assert found.exit_code == 64 and "no Dask scheduler answers" in found.stderr
