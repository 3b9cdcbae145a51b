"""The whole inspection on the page: photos, verdict, rework, check again, decisions, signature, report.

Small: a part with four blocks, and the session is told where the camera is. `make demo-live` does the same with the
sample's photos and the tracker.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arview.camera.read import save_camera
from arview.station.live.options import JobOptions
from arview.station.live.server.loading import load_subjects
from arview.station.live.stream.subjects import Subjects
from helpers import live_browser
from helpers.inspection_loop import Inspector, Stop, WalkSession, camera_script
from helpers.live_client import running
from helpers.live_sample import options
from helpers.page import WATCH, opened
from helpers.photo_scene import CAMERA, ring
from helpers.walk_bench import AGAIN, COMPONENT, WRONG_MM, photo, write_part

BY = "M. Lang"
SERIAL = "PL-0417"
PHONE = {"width": 390, "height": 844}
pytestmark = pytest.mark.slow


def test_whole_inspection(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = [Stop(photo(pose, False, ".jpg"), pose) for pose in ring(9, distance_mm=460.0)]
    second = [Stop(photo(pose, True, ".jpg"), pose) for pose in AGAIN]
    walk, wrong_mm = [*first, *second], float(np.linalg.norm(WRONG_MM))

    def session(subjects: Subjects, camera: Any) -> Any:
        return WalkSession(walk, [one.name for one in subjects[0].part.model.components], camera)

    monkeypatch.setattr(Subjects, "session", session)
    camera_file = tmp_path / "camera.json"
    save_camera(CAMERA, camera_file)
    chosen = options(
        inspection=None, clients=1, camera=str(camera_file), width=640, height=480,
        jobs=JobOptions(folder=tmp_path / "jobs"),
    )  # fmt: skip
    script = WATCH + camera_script(is_numbered=True)

    subjects = load_subjects([str(write_part(tmp_path))], None, None, chosen)
    with (
        live_browser.browser(None) as chromium,
        running(chosen, lambda: subjects) as server,
        opened(chromium, server, script, PHONE) as page,
    ):
        inspector = Inspector(page, walk, lambda step, seconds: print(f"{step}: {seconds:.1f} s"))
        inspector.start(SERIAL)
        inspector.photograph(range(len(first)), "photos")
        assert inspector.by_hand <= 2, "guided capture takes the photos by itself"
        job = inspector.measure("last photo to the verdicts")
        found = {one["name"]: one for one in job["inspection"]["components"]}
        assert job["inspection"]["verdict"] == "fail" and found[COMPONENT]["verdict"] == "fail"
        assert found[COMPONENT]["distance_mm"] == pytest.approx(wrong_mm, abs=0.3)
        assert len(found) == 4

        again = inspector.check_again(COMPONENT, range(len(first), len(walk)), BY)
        (row,) = [one for one in again["before_after"] if one["name"] == COMPONENT]
        assert row["before_mm"] == pytest.approx(wrong_mm, abs=0.3) and row["verdict_before"] == "fail"
        assert row["after_mm"] < 0.4 and row["verdict_after"] == "pass"
        inspector.page.locator("#job .primary", has_text="Result").click()
        for name in (name for name, one in found.items() if one["verdict"] == "fail"):
            is_ok = name == COMPONENT
            inspector.decide(name, is_ok, "Reworked and checked again" if is_ok else "Not reworked", BY)
        inspector.sign(BY)
        report = inspector.report(BY)
        job = inspector.job()
    assert BY in report and "Reworked and checked again" in report
    assert job["signed"]["by"] == BY
    _check_folder(tmp_path / "jobs" / job["id"], [one.jpeg for one in first])


def _check_folder(folder: Path, taken: list[bytes]) -> None:
    """The photos in the job's folder are those that the camera gave, and its record holds the signature."""
    kept = {hashlib.sha256(path.read_bytes()).hexdigest() for path in (folder / "photos").iterdir()}
    assert kept == {hashlib.sha256(content).hexdigest() for content in taken}
    entries = [json.loads(line) for line in (folder / "decisions.jsonl").read_text().splitlines()]
    assert entries[-1]["kind"] == "signature" and entries[-1]["by"] == BY
