"""What tests of jobs need: photos, a worker that measures nothing but says what it is told, uploads in pieces."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from arview.station.live.options import JobOptions
from arview.station.live.stream.frames import to_jpeg
from arview.station.walk.job import JobFolder
from arview.station.walk.records import WalkState
from helpers.live_client import Http
from helpers.live_sample import INSPECTION

POSE = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 300.0, 0.0, 0.0, 0.0, 1.0]


def photo(number: int, side_px: int = 400) -> bytes:
    """A photo of noise, another one for each number; about 0.2 MB at 400 px."""
    rng = np.random.default_rng(number)
    return to_jpeg(rng.integers(0, 255, (side_px, side_px + 80, 3), dtype=np.uint8), 95)


def about(content: bytes, **more: Any) -> dict[str, Any]:
    """The announcement of an upload."""
    described = {
        "bytes": len(content),
        "sha256": hashlib.sha256(content).hexdigest(),
        "source": "still",
        "taken": "2026-11-27T08:00:00Z",
        "hint": {"cam_from_model": POSE, "camera": None, "quality": 0.8},
        "media_type": "image/jpeg",
    }
    return {**described, **more}


def piece(page: Http, job: str, upload: str, offset: int, content: bytes) -> tuple[int, Any]:
    """Send a piece; returns status and answer."""
    status, _, answer = page.ask("PATCH", f"/api/jobs/{job}/uploads/{upload}?offset={offset}", content)
    return status, json.loads(answer)


def send(page: Http, job: str, content: bytes, size: int = 100_000, **more: Any) -> str:
    """Upload a photo in pieces; returns its name."""
    status, answer = page.json("POST", f"/api/jobs/{job}/uploads", about(content, **more))
    if status == 200:
        return str(answer["photo"])
    assert status == 201, answer
    upload, offset = answer["upload"], answer["offset"]
    while True:
        status, answer = piece(page, job, upload, offset, content[offset : offset + size])
        assert status == 200, answer
        if "photo" in answer:
            return str(answer["photo"])
        offset = answer["offset"]


def quiet_worker(job: JobFolder) -> subprocess.Popen[bytes]:
    """A worker that does nothing until it is ended."""
    code = "import time, sys\nwhile True: time.sleep(0.1)"
    return subprocess.Popen([sys.executable, "-c", code, str(job.path)], stdin=subprocess.DEVNULL)


def measured(job: JobFolder, created: str | None = None, serial: str | None = None, **changed_mm: float) -> None:
    """Finish a job with the inspection of the sample, as its worker would have; some distances may be others."""
    document = json.loads(INSPECTION.read_text())
    document["serial"] = serial or job.serial
    if created is not None:
        document["created"] = created
    for one in document["components"]:
        if one["name"] in changed_mm:
            _change(one, changed_mm[one["name"]])
    if job.components is not None:
        document["components"] = [one for one in document["components"] if one["name"] in job.components]
    (job.path / "inspection.json").write_text(json.dumps(document))
    count = len(job.photos())
    job.write_state(WalkState("done", "measured", count, count, cloud="done", inspection="inspection.json"))


def _change(component: dict[str, Any], distance_mm: float) -> None:
    """Move a component along the first axis that is determined."""
    axes = component["observable"][3:]
    first = axes.index(True)
    component["displacement_mm"] = [distance_mm if k == first else 0.0 if axes[k] else None for k in range(3)]
    component["distance_mm"] = distance_mm
    tolerance, uncertainty = component.get("tolerance_mm"), component["uncertainty_mm"] or 0.0
    is_good = tolerance is None or distance_mm + uncertainty <= tolerance
    component["verdict"] = "measured" if tolerance is None else "pass" if is_good else "fail"


def rough(job: JobFolder, names: list[str]) -> None:
    """First numbers of some components of a job."""
    document = json.loads(INSPECTION.read_text())
    document["serial"] = job.serial
    document["components"] = [one for one in document["components"] if one["name"] in names]
    (job.path / "rough").mkdir(exist_ok=True)
    (job.path / "rough" / "inspection.json").write_text(json.dumps(document))
    job.write_state(WalkState("measuring", "first numbers", 10, 10, is_rough=True, inspection="rough/inspection.json"))


def job_options(folder: Path, **more: Any) -> JobOptions:
    """Options of jobs in a folder, with room whatever the disk of the machine has."""
    return JobOptions(**{"folder": folder / "jobs", "min_free_bytes": 0, **more})


def copied_jobs(folder: Path, target: Path) -> Path:
    """A copy of a folder of jobs, as another server would find it."""
    shutil.copytree(folder, target)
    return target
