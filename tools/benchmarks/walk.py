"""A walk around a part: photos of a folder are fed to a job at the pace of a person, and the times are told.

    python tools/benchmarks/walk.py samples/plate/part.toml samples/plate/photos

prints the seconds from the last photo to the verdicts, the photo at which the first numbers came, and with
``--compare`` the differences to ``arview inspect`` with the recorded pairs and from the photos alone.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import resource
import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from arview.cad import load_part
from arview.inspection import Inspection, load_inspection
from arview.reconstruction.intake.reading import photo_paths
from arview.reconstruction.run import reconstruct
from arview.station.walk.job import JobFolder, start_worker
from arview.station.walk.merged import before_after
from arview.workflow.job import InspectJob
from arview.workflow.prepare import prepare
from arview.workflow.run import measured_in_photos


def main() -> None:
    """Read the arguments, walk, and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", type=Path)
    parser.add_argument("photos", type=Path)
    parser.add_argument("--pace", type=float, default=2.5, metavar="S", help="seconds between photos")
    parser.add_argument("--hints", type=Path, metavar="JSON", help="name of photo → cam_from_model (16 numbers)")
    parser.add_argument("--folder", type=Path, default=Path("/tmp/arview-walk"), help="of the job; emptied first")
    parser.add_argument("--compare", action="store_true", help="also measure the photos as arview inspect does")
    parser.add_argument("--recheck", metavar="NAMES", help="components to check again, with commas")
    parser.add_argument("--recheck-photos", type=Path, metavar="FOLDER",
                        help="photos of the re-check; default: every fourth of the photos")  # fmt: skip
    parser.add_argument("--no-cloud", action="store_true", help="end the worker when the verdicts are there")
    arguments = parser.parse_args()
    shutil.rmtree(arguments.folder, ignore_errors=True)
    part = load_part(arguments.part)
    job = JobFolder.create(arguments.folder, part, arguments.part, "walk")
    report = walk(job, arguments)
    if arguments.compare:
        report |= compared(job, arguments)
    if arguments.recheck:
        report["recheck"] = checked_again(job, arguments)
    print(json.dumps(report, indent=1))


def checked_again(job: JobFolder, arguments: argparse.Namespace) -> dict[str, Any]:
    """Seconds from the last photo of a re-check to its verdict, and the values before and after."""
    recheck = job.recheck(arguments.recheck.split(","))
    paths, _ = photo_paths(arguments.recheck_photos or arguments.photos)
    chosen = paths if arguments.recheck_photos else paths[1::4]
    with start_worker(recheck) as worker:
        while not _is_ready(recheck) and worker.poll() is None:
            time.sleep(0.1)
        for path in chosen:
            content = path.read_bytes()
            recheck.add_photo(content, hashlib.sha256(content).hexdigest(), "upload")
            time.sleep(arguments.pace)
        before_s, began = cpu_of(worker.pid), time.monotonic()
        recheck.end()
        while recheck.state().stage in ("collecting", "measuring") and worker.poll() is None:
            time.sleep(0.05)
        seconds, cpu_s = time.monotonic() - began, cpu_of(worker.pid) - before_s
    state = recheck.state()
    return {
        "photos": len(chosen), "last_photo_to_verdict_s": round(seconds, 2), "of_it_cpu_s": round(cpu_s, 2),
        "stage": state.stage, "text": state.text,
        "before_after_mm": {one.name: (one.before_mm, one.after_mm) for one in before_after(recheck)},
    }  # fmt: skip


def _is_ready(recheck: JobFolder) -> bool:
    """Whether the worker has read the first measurement."""
    state = recheck.state()
    return bool(state.updated) and state.text == "waiting for photos"


def walk(job: JobFolder, arguments: argparse.Namespace) -> dict[str, Any]:
    """Feed the photos and wait for the verdicts; times in seconds."""
    hints = json.loads(arguments.hints.read_text()) if arguments.hints else {}
    paths, _ = photo_paths(arguments.photos)
    first_numbers: int | None = None
    with start_worker(job) as worker:
        time.sleep(arguments.pace)
        for number, path in enumerate(paths, 1):
            due = time.monotonic() + arguments.pace
            content = path.read_bytes()
            pose = hints.get(path.name)
            hint = None if pose is None else {"cam_from_model": np.ravel(pose).tolist(), "quality": 1.0}
            job.add_photo(content, hashlib.sha256(content).hexdigest(), "upload", hint)
            if number == len(paths):
                break
            while time.monotonic() < due:
                if first_numbers is None and job.state().inspection is not None:
                    first_numbers = number
                time.sleep(0.05)
        before_s = cpu_of(worker.pid)
        began = time.monotonic()
        job.end()
        steps: dict[str, float] = {}
        while (state := job.state()).stage in ("collecting", "measuring") and worker.poll() is None:
            steps[state.step or "waiting"] = round(steps.get(state.step or "waiting", 0.0) + 0.05, 2)
            time.sleep(0.05)
        verdict_s, verdict_cpu_s = time.monotonic() - began, cpu_of(worker.pid) - before_s
        if arguments.no_cloud:
            worker.terminate()
        worker.wait()
    state = job.state()
    return {
        "photos": len(paths), "load": os.getloadavg()[0], "last_photo_to_verdicts_s": round(verdict_s, 2),
        "of_it_cpu_s": round(verdict_cpu_s, 2), "steps_s": steps, "first_numbers_at_photo": first_numbers,
        "first_s_in_state": state.seconds_after_last_photo, "stage": state.stage, "text": state.text,
        "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024),
    }  # fmt: skip


def compared(job: JobFolder, arguments: argparse.Namespace) -> dict[str, Any]:
    """Largest differences to ``arview inspect``: with the recorded pairs (mm), and from the photos alone (U)."""
    ours = load_inspection(job.path / "inspection.json")
    found: dict[str, Any] = {}
    for name, pairs in (("replay", str(job.path / "sparse" / "pairs.json")), ("alone", None)):
        folder = job.path / name
        prepared = prepare(
            InspectJob(str(arguments.part), str(job.path / "photos"), serial=job.serial, pairs=pairs), folder
        )
        options = replace(prepared.reconstruct, last_stage="scale")
        again = reconstruct(job.path / "photos", folder, prepared.part, None, options)
        other = measured_in_photos(again, prepared, lambda what, done, total: None)
        found[name] = difference(ours, other)
    return found


def difference(ours: Inspection, other: Inspection) -> dict[str, Any]:
    """Largest difference of displacements (mm) and of displacements relative to U, and verdicts that differ."""
    apart, relative, verdicts = [0.0], [0.0], []
    by_name = {one.name: one for one in other.components}
    for one in ours.components:
        same = by_name[one.name]
        for a, b in zip(one.displacement_mm, same.displacement_mm, strict=True):
            if (a is None) != (b is None):
                verdicts.append(f"{one.name}: measured by one only")
            elif a is not None and b is not None:
                apart.append(abs(a - b))
                relative.append(abs(a - b) / (same.uncertainty_mm or np.inf))
        if one.verdict is not same.verdict:
            verdicts.append(f"{one.name}: {one.verdict.value} and {same.verdict.value}")
    return {"mm": max(apart), "share_of_U": round(max(relative), 4), "verdicts_that_differ": verdicts}


def cpu_of(process: int) -> float:
    """Processor time of a process, s; 0 when it has ended."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rsplit(") ", 1)[1].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    main()
