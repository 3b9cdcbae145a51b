"""Measuring while photos arrive, and again after a component was put right, against the truth of rendered photos."""

from __future__ import annotations

import hashlib
import signal
import subprocess
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from arview.cad import load_part
from arview.errors import InputError
from arview.geometry import Array
from arview.inspection import CharacteristicResult, Inspection, Verdict, load_inspection, save_inspection
from arview.station.walk.job import JobFolder, start_worker
from arview.station.walk.merged import before_after, merged
from helpers.walk_bench import AGAIN, PART, POSES, WRONG_MM, part_model, photo, write_part


class Station:
    """A part on a bench, of which block_2 stands wrong until it is put right."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        write_part(folder)
        self.wrong = [photo(pose, False) for pose in POSES]

    def job(self, serial: str) -> JobFolder:
        part = load_part(self.folder / "part.toml")
        return JobFolder.create(self.folder / "jobs", part, self.folder / "part.toml", serial)


def add(job: JobFolder, content: bytes, pose: Array | None = None) -> None:
    hint = None if pose is None else {"cam_from_model": pose.ravel().tolist()}
    job.add_photo(content, hashlib.sha256(content).hexdigest(), "still", hint)


def wait(worker: subprocess.Popen[bytes], job: JobFolder, stages: tuple[str, ...] = ("done", "failed")) -> None:
    ends = time.monotonic() + 900.0
    while job.state().stage not in stages and worker.poll() is None and time.monotonic() < ends:
        time.sleep(0.1)


def stop(worker: subprocess.Popen[bytes]) -> float:
    """End a worker by SIGTERM; returns the seconds that it took."""
    began = time.monotonic()
    worker.terminate()
    worker.wait(30.0)
    return time.monotonic() - began


def numbers(inspection: Inspection | None) -> dict[str, tuple[float | None, ...]]:
    assert inspection is not None
    return {one.name: one.displacement_mm for one in inspection.components}


@pytest.fixture(scope="module")
def station(tmp_path_factory: pytest.TempPathFactory) -> Station:
    return Station(tmp_path_factory.mktemp("station"))


@pytest.fixture(scope="module")
def measured(station: Station) -> JobFolder:
    """A job whose photos came with rough poses, measured up to the verdict."""
    job = station.job("A-1")
    with start_worker(job) as worker:
        for picture, pose in zip(station.wrong, POSES, strict=True):
            add(job, picture, pose)
        job.end()
        wait(worker, job)
        assert job.state().stage == "done", (job.path / "worker.log").read_text() + job.state().text
        stop(worker)
    return job


@pytest.mark.slow
def test_the_verdict_comes_before_the_cloud(measured: JobFolder, station: Station) -> None:
    state = measured.state()
    assert (state.stage, state.inspection, state.is_rough) == ("done", "inspection.json", False)
    assert state.placed == state.photos == len(POSES) and state.cloud == "running"
    assert state.seconds_after_last_photo is not None and not (measured.path / "cloud.ply").exists()
    found = measured.inspection(load_part(station.folder / "part.toml").model)
    assert found is not None and found.serial == "A-1"
    by_name = {one.name: one for one in found.components}
    wrong = by_name["block_2"]
    assert wrong.verdict is Verdict.FAIL and wrong.uncertainty_mm is not None
    error = np.array(wrong.displacement_mm, dtype=float) - WRONG_MM
    assert np.linalg.norm(error) < min(0.3, 2.0 * wrong.uncertainty_mm), error
    assert [by_name[f"block_{i}"].verdict for i in (1, 3, 4)] == [Verdict.PASS] * 3
    assert (measured.path / "sparse" / "pairs.json").is_file()


@pytest.mark.slow
def test_a_component_put_right_is_checked_again(measured: JobFolder, station: Station) -> None:
    model = load_part(station.folder / "part.toml").model
    recheck = measured.recheck(["block_2"])
    with start_worker(recheck) as worker:
        for pose in AGAIN:
            add(recheck, photo(pose, True))
        recheck.end()
        wait(worker, recheck)
        assert worker.wait(600.0) == 0
    state = recheck.state()
    assert (state.stage, state.cloud) == ("done", "done"), state.text
    found = recheck.inspection(model)
    assert found is not None and found.serial == "A-1"
    by_name = {one.name: one for one in found.components}
    right = by_name["block_2"]
    # With so few small photos the two methods may contradict each other, which leaves the verdict open.
    assert right.verdict in (Verdict.PASS, Verdict.UNDECIDED)
    assert right.distance_mm is not None and right.uncertainty_mm is not None
    assert right.distance_mm < min(0.4, 2.0 * right.uncertainty_mm)
    assert right.details is not None and right.details.photos is not None
    assert 3 <= right.details.photos <= len(AGAIN)
    others = [one for name, one in by_name.items() if name != "block_2"]
    assert len(others) == 3 and {one.verdict for one in others} == {Verdict.NOT_MEASURED}
    (change,) = before_after(recheck, model)
    assert change.name == "block_2" and change.before_mm is not None and change.after_mm is not None
    assert abs(change.before_mm - np.linalg.norm(WRONG_MM)) < 0.3 and change.after_mm < 0.4
    assert (change.verdict_before, change.verdict_after) == (Verdict.FAIL, right.verdict)
    path = measured.path / "inspection.json"
    before = path.read_bytes()
    gap = CharacteristicResult(
        "gap", "gap", ("left", "right"), Verdict.PASS, value_mm=1.0, uncertainty_mm=0.1, limits_mm=(0.5, None),
        components=("block_2", "block_3"),
    )  # fmt: skip
    first = load_inspection(path)
    save_inspection(replace(first, characteristics=(gap, replace(gap, name="other", components=("block_1",)))), path)
    now = merged(measured, model)
    path.write_bytes(before)
    assert now is not None
    stale, other = now.inspection.characteristics
    assert stale.verdict is Verdict.NOT_MEASURED and stale.value_mm is None and "checked again" in stale.reason
    assert other.verdict is Verdict.PASS
    assert {one.verdict for one in now.inspection.components} == {Verdict.PASS, right.verdict}
    assert now.origins["block_2"] == recheck.id and now.origins["block_1"] == measured.id


@pytest.mark.slow
def test_photos_of_something_else_are_not_a_recheck(measured: JobFolder) -> None:
    recheck = measured.recheck(["block_2"])
    rng = np.random.default_rng(1)
    with start_worker(recheck) as worker:
        for _ in range(4):
            coarse = rng.uniform(0, 255, (60, 80, 3)).astype(np.uint8)
            picture = cv2.resize(coarse, (640, 480), interpolation=cv2.INTER_CUBIC)
            add(recheck, cv2.imencode(".png", picture)[1].tobytes())
        recheck.end()
        wait(worker, recheck)
        assert worker.wait(60.0) == 3
    assert recheck.state().stage == "failed" and "could be placed" in recheck.state().text
    assert recheck.inspection() is None


@pytest.mark.slow
def test_a_killed_worker_continues_to_the_same_numbers(measured: JobFolder, station: Station) -> None:
    job = station.job("A-2")
    half = len(POSES) // 2
    with start_worker(job) as worker:
        for picture, pose in zip(station.wrong[:half], POSES[:half], strict=True):
            add(job, picture, pose)
        ends = time.monotonic() + 120.0
        while not any((job.path / "features").glob("*")) and time.monotonic() < ends:
            time.sleep(0.05)
        worker.send_signal(signal.SIGKILL)
    for picture, pose in zip(station.wrong[half:], POSES[half:], strict=True):
        add(job, picture, pose)
    job.end()
    killed = []
    for step in ("matching", "components"):
        with start_worker(job) as worker:
            ends = time.monotonic() + 300.0
            while job.state().step != step and worker.poll() is None and time.monotonic() < ends:
                time.sleep(0.002)
            killed.append((step, job.state().step, job.state().stage))
            worker.send_signal(signal.SIGKILL)
    assert [one for one, found, _ in killed if one == found], killed
    with start_worker(job) as worker:
        wait(worker, job)
        assert job.state().stage == "done", job.state().text
        assert stop(worker) < 5.0
    assert len(job.photos()) == len(POSES)
    ours, others = numbers(job.inspection()), numbers(measured.inspection())
    for name, value in ours.items():
        assert value == pytest.approx(others[name], abs=1e-3), name


@pytest.mark.slow
def test_a_job_that_cannot_be_measured_says_why(station: Station) -> None:
    job = station.job("A-3")
    job.end()
    with start_worker(job) as worker:
        assert worker.wait(120.0) == 3
    assert job.state().stage == "failed" and "without a photo" in job.state().text
    # The part is that of the beginning; only who changes the copy in the job's folder changes the part.
    job.part_file.write_text(PART.replace('unit = "mm"', 'unit = "cm"'), encoding="utf-8")
    job.reopen()
    add(job, station.wrong[0])
    job.end()
    with start_worker(job) as worker:
        assert worker.wait(120.0) == 3
    assert "has changed since" in job.state().text


def test_the_base_is_not_checked_again() -> None:
    from arview.cad.part import ComponentSettings, Part
    from arview.measurement.again import check_not_datums

    part = Part("bench", Path("part.toml"), Path("part.obj"), part_model(), (ComponentSettings("plate", "base"),))
    check_not_datums(part, ["block_1"])
    with pytest.raises(InputError, match="carries the datums"):
        check_not_datums(part, ["plate"])
