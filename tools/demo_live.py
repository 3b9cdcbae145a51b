#!/usr/bin/env python
"""The whole inspection on the page, unattended: photos, verdict, rework, check again, decisions, signature, report.

`arview live` runs as always, with its tracker and its workers. A browser without a window opens its page; its camera
shows the 24 photos of the sample plate one after another, and after the rework six photos of the plate with link_1 put
right. Prints how long each step took; the job, the report and pictures of the screen stay in the output folder.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tools" / "benchmarks")]  # what the tests drive a browser with

from helpers import live_browser
from helpers.inspection_loop import COMPONENT, PLATE, Inspector, camera_script, first_walk, second_walk
from live_server import live_server

PHONE = {"width": 390, "height": 844}
BY = "M. Lang"


def main() -> int:
    """Run the inspection; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, default=ROOT / "out" / "demo-live", help="output folder")
    parser.add_argument("--serial", default="PL-0417")
    parser.add_argument("--patience", type=float, default=8.0, help="seconds at a place before the shutter is pressed")
    arguments = parser.parse_args()
    if live_browser.CHROMIUM is None:
        print("demo-live: Chromium is not installed: apt-get install chromium", file=sys.stderr)
        return 1
    out: Path = arguments.out
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    os.environ["XDG_STATE_HOME"] = os.environ["XDG_DATA_HOME"] = str(out / "state")  # paired browsers, not the user's
    begun_s = time.monotonic()
    with (
        live_browser.browser(None) as chromium,
        live_server(["--http", "--port", 0, "--part", PLATE / "part.toml", "--camera", PLATE / "camera.json",
                     "--size", "640x480", "--jobs", out / "jobs"]) as (_, link),
    ):  # fmt: skip
        run(chromium, link, out, arguments.serial, arguments.patience)
    say("all", time.monotonic() - begun_s)
    print(f"look at {out}/report.html and {out}/*.png; the job is in {out}/jobs")
    return 0


def run(chromium: Any, link: str, out: Path, serial: str, patience_s: float) -> None:
    """Inspect the plate on the page behind a link."""
    first, second = first_walk(), second_walk()
    context = chromium.new_context(viewport=PHONE, device_scale_factor=2)
    page = context.new_page()
    page.add_init_script(camera_script(is_numbered=False))
    inspector = Inspector(page, [*first, *second], say, patience_s, limit_s=900.0)

    def picture(name: str) -> None:
        page.wait_for_timeout(500)
        page.screenshot(path=out / f"{name}.png")

    page.goto(link)
    inspector.start(serial)
    inspector.photograph(range(len(first)), "24 photos")
    picture("1_photos")
    job = inspector.measure("last photo to all verdicts")
    picture("2_verdict")
    print(f"  {inspector.by_hand} of the photos that were wanted were taken by the shutter")
    print(f"  {job['inspection']['sentence']}")
    numbers = range(len(first), len(first) + len(second))
    again = inspector.check_again(COMPONENT, numbers, BY)
    row = next(one for one in again["before_after"] if one["name"] == COMPONENT)
    picture("3_checked_again")
    print(f"  {COMPONENT}: {row['before_mm']:.2f} mm before, {row['after_mm']:.2f} mm after, {row['verdict_after']}")
    page.locator("#job .primary").click()
    for one in job["inspection"]["components"]:
        if one["verdict"] != "pass":
            is_ok = one["name"] == COMPONENT
            inspector.decide(one["name"], is_ok, "Reworked and checked again" if is_ok else "Not reworked yet", BY)
    inspector.sign(BY)
    picture("4_signed")
    (out / "report.html").write_text(inspector.report(BY), encoding="utf-8")
    context.close()


def say(step: str, seconds: float) -> None:
    """Print the wall time of a step."""
    print(f"{seconds:8.1f} s  {step}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
