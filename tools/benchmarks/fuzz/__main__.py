"""Fuzzing: damaged files, requests and command lines, made from valid ones by Hypothesis, against all readers.

    python tools/benchmarks/fuzz --minutes 60

Each target runs in a process of its own, or some together, which saves the start of each. Properties: no traceback but
errors of one line, no hang (10 s of the processor), no memory above 1 GB, and no answer that differs from a plain
reader's where there is one. Faults are printed, one for each cause, and their inputs kept. The exit code is 1 when
there was one.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[3]
HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(ROOT / "tests"), str(HERE)]

SLICE_S = 20.0
MIN_SLICE_S = 3.0
DEADLINE_S = 900.0


def worker(options: argparse.Namespace) -> None:
    """Fuzz a target, or several one after the other, in this process; prints a JSON line with inputs and faults."""
    from targets import fuzz

    for name in options.worker.split(","):
        found = fuzz(name, options.seed, options.examples, options.seconds, options.folder)
        print(json.dumps({"name": name, **found}), flush=True)


def run_worker(
    names: Sequence[str], seed: int, examples: int | None, seconds: float, folder: Path
) -> dict[str, dict[str, Any]]:
    """Run `worker` for some targets as a process; a crash of it is a fault, too, of the target that it was at."""
    command = [sys.executable, str(HERE), "--worker", ",".join(names), "--seed", str(seed), "--seconds", str(seconds)]
    command += ["--folder", str(folder), *(["--examples", str(examples)] if examples else [])]
    ended, printed, last = "", "", ""
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=seconds + DEADLINE_S, check=False
        )
        printed, last = done.stdout, (done.stderr.strip().splitlines() or [""])[-1]
        if done.returncode:
            ended = f"process ended with {done.returncode}"
    except subprocess.TimeoutExpired as error:
        printed, ended = (error.stdout or b"").decode(errors="replace"), "process hangs"
    found = {row["name"]: row for row in map(json.loads, printed.strip().splitlines())}
    if ended or len(found) < len(names):
        name = next((name for name in names if name not in found), names[-1])
        kept = folder / f"crash-{name}-{seed}"
        for path in (folder / name).glob("current*"):
            kept.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, kept)
        found[name] = {"inputs": 0, "faults": [[f"{name} {ended}", f"seed {seed} {last} (input in {kept})"]]}
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, help="how long, over all targets")
    parser.add_argument("--examples", type=int, help="inputs of each target instead of a time")
    parser.add_argument("--parallel", type=int, default=1, help="targets at a time")
    parser.add_argument("--together", type=int, default=1, help="targets that share a process, one after the other")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="*", help="targets; default: all")
    parser.add_argument("--folder", type=Path, help="where inputs of faults are kept; default: a new temporary folder")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    parser.add_argument("--seconds", type=float, default=DEADLINE_S, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        worker(options)
        return 0
    from targets import TARGETS

    names = options.only or list(TARGETS)
    folder = options.folder or Path(tempfile.mkdtemp(prefix="arview-fuzz-"))
    minutes = options.minutes or 1e6
    ends_s = time.monotonic() + 60.0 * minutes
    slice_s = DEADLINE_S if options.examples else min(SLICE_S, 30.0 * minutes * options.parallel / len(names))
    inputs = dict.fromkeys(names, 0)
    faults: dict[str, str] = {}

    def run_some(chosen: Sequence[str], seed: int) -> None:
        if seed > options.seed and time.monotonic() > ends_s:  # in the first round every target is run
            return
        for name, found in run_worker(chosen, seed, options.examples, max(MIN_SLICE_S, slice_s), folder).items():
            inputs[name] += found["inputs"]
            for signature, text in found["faults"]:
                if signature not in faults:
                    faults[signature] = text
                    print(f"fault: {signature}: {text}", flush=True)

    groups = [names[k : k + options.together] for k in range(0, len(names), options.together)]
    seed = options.seed
    with ThreadPoolExecutor(options.parallel) as pool:
        while seed == options.seed or (time.monotonic() < ends_s and not options.examples):
            list(pool.map(partial(run_some, seed=seed), groups))
            seed += 1
            print(f"{sum(inputs.values())} inputs, {len(faults)} faults", flush=True)
    print(f"{len(names)} targets: " + ", ".join(f"{name} {count}" for name, count in inputs.items()))
    print(f"{sum(inputs.values())} inputs, {len(faults)} faults" + (f"; inputs in {folder}" if faults else ""))
    return 1 if faults or not all(inputs.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
