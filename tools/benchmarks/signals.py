#!/usr/bin/env python
"""Signals at random moments over commands: none may end with signal 11, and no output may be left half written."""

from __future__ import annotations

import argparse
import json
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import av

from arview.errors import ArviewError
from arview.guideviews import load_guide_views
from arview.inspection import load_inspection

ROOT = Path(__file__).resolve().parents[2]
BRACKET, PLATE = ROOT / "samples" / "bracket_plate", ROOT / "samples" / "plate"
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
INTERRUPTED, FINISHED = 130, (0, 1, 2, 3)
BEFORE_IT_BEGAN = tuple(-number for number in SIGNALS)
"""Codes of a program that ends at once, while it is still being imported."""


def annotate(folder: Path) -> list[str]:
    """A film, annotated, with poses."""
    camera = str(BRACKET / "camera.json")
    files = ["-o", str(folder / "a.mp4"), "--poses", str(folder / "p.jsonl")]
    return ["annotate", str(BRACKET / "clip.mp4"), "--part", str(BRACKET / "part.toml"), "--camera", camera, *files]


def inspect(folder: Path) -> list[str]:
    """Photos, measured; the folder continues where the run before stopped."""
    inputs = ["--part", str(PLATE / "part.toml"), "--photos", str(PLATE / "photos"), "--no-pdf"]
    return ["inspect", *inputs, "-o", str(folder.parent / "kept_inspection")]


def capture(folder: Path) -> list[str]:
    """Photos out of a film."""
    camera = str(BRACKET / "camera.json")
    part = ["--part", str(BRACKET / "part.toml"), "--camera", camera]
    return ["capture", str(BRACKET / "clip.mp4"), *part, "-o", str(folder / "photos")]


def batch(folder: Path) -> list[str]:
    """Two inspections by workers."""
    job = f'[[job]]\nserial = "{{}}"\nphotos = "{PLATE / "photos"}"\n'
    head = f'out = "{folder.parent / "kept_batch"}"\n[defaults]\npart = "{PLATE / "part.toml"}"\nmakes_pdf = false\n'
    (folder / "jobs.toml").write_text(head + job.format("A") + job.format("B"))
    return ["batch", str(folder / "jobs.toml"), "--workers", "1"]


def guideviews(folder: Path) -> list[str]:
    """Guide views of a part, into a file."""
    return ["guideviews", str(BRACKET / "part.toml"), "-o", str(folder / "b.gv"), "--spacing", "8"]


COMMANDS: dict[str, tuple[Callable[[Path], list[str]], float]] = {
    "annotate": (annotate, 30.0),
    "inspect": (inspect, 60.0),
    "capture": (capture, 30.0),
    "batch": (batch, 60.0),
    "guideviews": (guideviews, 20.0),
}
"""Commands, and the longest time until the signal, s."""


def faults(folder: Path, code: int) -> list[str]:
    """What is wrong with the files of a run."""
    found = [f"left {path.name}" for path in folder.rglob("*") if path.suffix in (".part", ".tmp")]
    for film in folder.rglob("*.mp4"):
        try:
            with av.open(str(film)) as opened:
                frames = sum(1 for _ in opened.decode(video=0))
        except (av.FFmpegError, OSError) as error:
            found.append(f"{film.name}: {error}")
            continue
        poses = film.with_name("p.jsonl")
        lines = poses.read_text().splitlines() if poses.is_file() else []
        if len([json.loads(line) for line in lines]) != frames:
            found.append(f"{frames} frames, {len(lines)} poses")
    checks: dict[str, Callable[[Path], object]] = {"inspection.json": load_inspection, "b.gv": load_guide_views}
    for name, check in checks.items():
        for path in folder.rglob(name):
            try:
                check(path)
            except ArviewError as error:
                found.append(f"{path.name}: {error}")
    if code not in (INTERRUPTED, *FINISHED, *BEFORE_IT_BEGAN):
        found.append(f"exit code {code}")
    return found


def main() -> None:
    """Run the commands, send the signals, and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200, help="signals to send (default 200)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=sorted(COMMANDS), help="this command alone")
    arguments = parser.parse_args()
    rng = random.Random(arguments.seed)
    names = [arguments.only] if arguments.only else list(COMMANDS)
    table: Counter[tuple[str, str]] = Counter()
    slowest_s = dict.fromkeys(names, 0.0)
    bad: list[tuple[int, str, list[str], list[str]]] = []
    with tempfile.TemporaryDirectory() as base:
        for number in range(arguments.count):
            name = names[number % len(names)]
            folder = Path(base) / f"run_{number}"
            folder.mkdir()
            make, longest_s = COMMANDS[name]
            process = subprocess.Popen(
                [sys.executable, "-m", "arview.cli", *make(folder)],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
            )
            try:
                process.wait(rng.uniform(0.0, longest_s))
            except subprocess.TimeoutExpired:
                process.send_signal(rng.choice(SIGNALS))
            began_s = time.monotonic()
            try:
                error = process.communicate(timeout=120)[1]
            except subprocess.TimeoutExpired:
                process.kill()
                error = process.communicate()[1] + " did not end in 120 s"
            slowest_s[name] = max(slowest_s[name], time.monotonic() - began_s)
            code = process.returncode
            wrong = faults(folder, code)
            kind = "interrupted" if code == INTERRUPTED else "finished" if code in FINISHED else f"code {code}"
            table[name, kind] += 1
            if wrong:
                bad.append((number, name, wrong, error.strip().splitlines()[-1:] if error else []))
                print(number, name, wrong, error.strip()[-300:], flush=True)
            shutil.rmtree(folder)
        for kept in Path(base).glob("kept_*"):
            bad += [(-1, kept.name, [one], []) for one in faults(kept, 0)]
    for (name, kind), count in sorted(table.items()):
        print(f"{name:12} {kind:12} {count:4}   slowest end {slowest_s[name]:.1f} s")
    print(f"{arguments.count} signals, {len(bad)} with faults")
    raise SystemExit(1 if bad else 0)


if __name__ == "__main__":
    main()
