#!/usr/bin/env python
"""What happens to a job in the middle of its measurement: nothing is lost, no result changed.

A part of four blocks is photographed (rendered) and measured once undisturbed. Then it is measured again for each event
at each stage: the worker is killed or ended, the program updated, the tolerance edited, the CAD moved, the folder
copied, the disk full. In the end each job must have all photos, and the numbers of the undisturbed one.
"""

from __future__ import annotations

import argparse
import hashlib
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))
from arview.cad import load_part
from arview.quality import decisions
from arview.station.walk.job import JobFolder, jobs_in
from helpers.walk_bench import PART, POSES, photo, write_part

STAGES = ("collecting", "features", "photos", "matching", "placing", "scale", "components", "done", "cloud", "signed")
"""Moments of a measurement: a step of ``state.json``, or a state."""
NEWER = (
    "import sys, runpy, arview.version as v; v.__version__ = '99.0'; sys.argv = ['walk', sys.argv[1]]; "
    "runpy.run_module('arview.station.walk', run_name='__main__')"
)
TOLERANCE_MM = 0.01
SAME_MM = 2e-3


def start(job: JobFolder, newer: bool = False, file_bytes: int | None = None) -> subprocess.Popen[bytes]:
    """The worker of a job: of a newer program, or one that cannot write files beyond a size."""
    command = [sys.executable, *(("-c", NEWER) if newer else ("-m", "arview.station.walk")), str(job.path)]
    limit = None if file_bytes is None else lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes, file_bytes))
    with (job.path / "worker.log").open("ab") as log:
        return subprocess.Popen(command, stdout=log, stderr=log, preexec_fn=limit)


def has_reached(job: JobFolder, stage: str) -> bool:
    """Whether a measurement is at a stage, or beyond it."""
    state = job.state()
    if stage == "collecting":
        return True
    if stage == "features":
        return any((job.path / "features").glob("*"))
    if stage in ("done", "signed"):
        return state.stage == "done"
    if stage == "cloud":
        return state.stage == "done" and state.cloud == "running" and state.step != ""
    return state.step == stage or state.stage in ("done", "failed")


def wait(worker: subprocess.Popen[bytes], is_there: Callable[[], bool], longest_s: float = 600.0) -> None:
    """Wait for a moment of a worker, or for its end."""
    ends_s = time.monotonic() + longest_s
    while not is_there() and worker.poll() is None and time.monotonic() < ends_s:
        time.sleep(0.005)


def numbers(job: JobFolder) -> dict[str, np.ndarray]:
    """The displacements and the tolerance of each component."""
    found = job.inspection()
    assert found is not None, job.state().text
    return {
        one.name: np.array([*one.displacement_mm, one.tolerance_mm], dtype=float)
        for one in found.components
        if one.distance_mm is not None
    }


def end_worker(worker: subprocess.Popen[bytes], number: signal.Signals) -> None:
    """Send a signal, and wait for the end."""
    worker.send_signal(number)
    worker.wait(60.0)


def disturbed(event: str, folder: Path, job: JobFolder, worker: subprocess.Popen[bytes]) -> list[JobFolder]:
    """Let an event happen; returns the jobs whose results are checked."""
    end_worker(worker, signal.SIGTERM if event == "SIGTERM" else signal.SIGKILL)
    if event == "edited":
        (folder / "part.toml").write_text(PART.replace("mm = 1.5", f"mm = {TOLERANCE_MM}"))
    elif event == "moved":
        for path in folder.glob("*.obj"):
            path.rename(folder / "elsewhere")
    elif event == "copied":
        shutil.copytree(job.path, job.path.with_name(f"{job.path.name}_copy"))
        return [job, JobFolder.open(job.path.with_name(f"{job.path.name}_copy"))]
    elif event == "full disk":
        start(job, file_bytes=4096).wait(300.0)
        if job.state().stage == "failed":
            job.write_state(type(job.state())(photos=len(job.photos())))
    return [job]


def check(event: str, stage: str, pictures: list[bytes], expected: dict[str, np.ndarray]) -> list[str]:
    """Measure a job with an event at a stage; returns what is wrong."""
    with tempfile.TemporaryDirectory() as base:
        folder = Path(base)
        write_part(folder)
        part = load_part(folder / "part.toml")
        job = JobFolder.create(folder / "jobs", part, folder / "part.toml", f"{event} {stage}")
        for content, pose in zip(pictures, POSES, strict=True):
            hint = {"cam_from_model": pose.ravel().tolist()}
            job.add_photo(content, hashlib.sha256(content).hexdigest(), "still", hint)
        if stage != "collecting":
            job.end()
        worker = start(job)
        wait(worker, lambda: has_reached(job, stage))
        before = (job.path / "inspection.json").read_bytes() if stage in ("done", "signed") else None
        if stage == "signed":
            decisions.sign_inspection(job.path, "Ada", "as a concession")
        found = []
        for one in disturbed(event, folder, job, worker):
            one.end()
            last = start(one, newer=event == "update")
            wait(last, lambda one=one: one.state().stage in ("done", "failed"))  # type: ignore[misc]
            if stage not in ("done", "signed", "cloud"):
                end_worker(last, signal.SIGTERM)
            else:
                last.wait(600.0)
            state = one.state()
            if state.stage != "done":
                found.append(f"{one.id}: {state.stage}: {state.text}")
                continue
            if len(one.photos()) != len(pictures):
                found.append(f"{one.id}: {len(one.photos())} photos")
            if before is not None and stage == "signed" and (one.path / "inspection.json").read_bytes() != before:
                found.append(f"{one.id}: the signed inspection was changed")
            ours = numbers(one)
            apart = [n for n in expected if n not in ours or np.nanmax(np.abs(ours[n] - expected[n])) > SAME_MM]
            if apart and stage not in ("cloud",):
                found.append(f"{one.id}: other numbers of {', '.join(apart)}")
        if event == "copied" and len(jobs_in(folder / "jobs")) != 2:
            found.append("the copy is not listed")
        return found


def main() -> None:
    """Measure, disturb, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    events = ("kill -9", "SIGTERM", "update", "edited", "moved", "copied", "full disk")
    parser.add_argument("--event", choices=events, help="this event alone")
    parser.add_argument("--stage", choices=STAGES, help="this stage alone")
    arguments = parser.parse_args()
    pictures = [photo(pose, False) for pose in POSES]
    with tempfile.TemporaryDirectory() as base:
        write_part(Path(base))
        part = load_part(Path(base) / "part.toml")
        job = JobFolder.create(Path(base) / "jobs", part, Path(base) / "part.toml", "undisturbed")
        for content, pose in zip(pictures, POSES, strict=True):
            hint = {"cam_from_model": pose.ravel().tolist()}
            job.add_photo(content, hashlib.sha256(content).hexdigest(), "still", hint)
        job.end()
        worker = start(job)
        wait(worker, lambda: job.state().stage in ("done", "failed"))
        expected = numbers(job)
        worker.terminate()
        worker.wait()
    faults = 0
    for event in [arguments.event] if arguments.event else events:
        for stage in [arguments.stage] if arguments.stage else STAGES:
            wrong = check(event, stage, pictures, expected)
            faults += len(wrong)
            print(f"{event:10} {stage:10} {'; '.join(wrong) or 'ok'}", flush=True)
    raise SystemExit(1 if faults else 0)


if __name__ == "__main__":
    main()
