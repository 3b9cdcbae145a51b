#!/usr/bin/env python
"""Compare the speed of two source trees of arview, run alternately on this machine."""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from options import positive
from recordings import SAMPLE, sample_command, scenes, table
from rows import watched

DESCRIPTION = """\
Compare the speed of two source trees of arview, run alternately on this machine, which should be idle.

  git worktree add ../before v0.1
  ab.py ../before .                      ten rounds of all measures
  ab.py ../before . --only track --rounds 20

Each round runs A, B and A once more, each in a process of its own and in an order that rotates, after one run of each
that is not measured: it compiles what is not compiled yet, and makes guide views."""

EPILOG = f"""\
measures:
  track     ms a frame of the recorded sequences, from truth; geometric mean of the medians of the sequences
  detect    ms a frame of the same, without any hint
  annotate  ms a frame of the clip in {SAMPLE.name}, end to end, by `arview annotate`

B/A is the ratio of the medians over all rounds; A/A the ratio of the medians of the two runs of A, which says how far
from 1 a ratio is by chance; spread is the range of the middle half of the runs of A, as a share of their median.
A and B are checkouts; $ARVIEW_DATA is the folder of the recorded sequences.

exit code: 0 no ratio above --max-ratio, 1 some are, 2 bad input, 70 a measurement failed"""

MEASURES = ("track", "detect", "annotate")
DETECTED_FRAMES = 12
"""Of each sequence."""
EXIT_SLOWER, EXIT_INPUT, EXIT_FAILED = 1, 2, 70


def main() -> int:
    if sys.argv[1:2] == ["--child"]:
        use_own_evaluation()
        print(json.dumps({"ms": CHILDREN[sys.argv[2]](), "arview": arview_folder()}))
        return 0
    chosen = parser().parse_args()
    try:
        trees = {name: source_of(folder) for name, folder in (("A", chosen.a), ("B", chosen.b))}
        figures = {measure: compared(measure, trees, chosen.rounds) for measure in MEASURES if measure in chosen.only}
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_INPUT
    except RuntimeError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_FAILED
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    print(table(("measure", "A ms", "B ms", "B/A", "A/A", "spread of A"), [row(*item) for item in figures.items()]))
    if chosen.json:
        chosen.json.parent.mkdir(parents=True, exist_ok=True)
        chosen.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
        print(f"\nwrote {chosen.json}")
    return EXIT_SLOWER if any(ratios(runs)["B/A"] > chosen.max_ratio for runs in figures.values()) else 0


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(
        description=DESCRIPTION, epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    made.add_argument("a", type=Path, metavar="A", help="checkout of arview to compare with")
    made.add_argument("b", type=Path, metavar="B", help="checkout of arview that is compared")
    made.add_argument("--rounds", type=positive, default=10, metavar="N", help="default: 10")
    made.add_argument("--only", type=names_of_measures, default=MEASURES, help=f"of {','.join(MEASURES)}; default: all")
    made.add_argument("--max-ratio", type=float, default=1.03, metavar="R", help="of B/A; default: 1.03")
    made.add_argument("--json", type=Path, metavar="FILE", help="write the figures of all runs to this file")
    return made


def names_of_measures(text: str) -> tuple[str, ...]:
    names = tuple(text.split(","))
    unknown = [name for name in names if name not in MEASURES]
    if unknown:
        raise argparse.ArgumentTypeError(f"{', '.join(unknown)}: unknown; give some of {','.join(MEASURES)}")
    return names


def source_of(folder: Path) -> Path:
    """The folder that is put on the Python path for a checkout."""
    source = folder.resolve() / "src"
    if not (source / "arview" / "__init__.py").is_file():
        raise ValueError(f"{folder}: no checkout of arview; there is no {source / 'arview'}")
    return source


def compared(measure: str, trees: dict[str, Path], rounds: int) -> dict[str, list[float]]:
    """Milliseconds of each run of A, of B, and of A the second time ("A2")."""
    sources = {"A": trees["A"], "B": trees["B"], "A2": trees["A"]}
    for name in ("A", "B"):
        run(measure, trees[name])
    runs: dict[str, list[float]] = {name: [] for name in sources}
    names = list(sources)
    for number in watched(range(rounds), measure):
        first = number % len(names)
        for name in (*names[first:], *names[:first]):
            runs[name].append(run(measure, sources[name]))
    return runs


def run(measure: str, source: Path) -> float:
    """One run of a measure with a source tree, in a process of its own; milliseconds.

    Raises:
        RuntimeError: it failed, or imported another arview.
    """
    laboratory = source.parent / "tools" / "lab"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(source), str(laboratory)])}
    command = [sys.executable, str(Path(__file__).resolve()), "--child", measure]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{measure} with {source}: exit code {done.returncode}: {done.stderr.strip()[-2000:]}")
    answer = json.loads(done.stdout.splitlines()[-1])
    if not Path(answer["arview"]).is_relative_to(source):
        raise RuntimeError(f"{measure}: arview was imported from {answer['arview']}, expected {source}")
    return float(answer["ms"])


def ratios(runs: dict[str, list[float]]) -> dict[str, float]:
    """Medians of A and B, their ratio, that of the two runs of A, and the spread of A."""
    both = np.array(runs["A"] + runs["A2"])
    low, median, high = np.quantile(both, [0.25, 0.5, 0.75])
    of_b = float(np.median(runs["B"]))
    return {
        "A": float(median),
        "B": of_b,
        "B/A": of_b / float(median),
        "A/A": float(np.median(runs["A2"]) / np.median(runs["A"])),
        "spread": float((high - low) / median),
    }


def row(measure: str, runs: dict[str, list[float]]) -> tuple[str, ...]:
    found = ratios(runs)
    ms = (f"{found['A']:.2f}", f"{found['B']:.2f}")
    return (measure, *ms, f"{found['B/A']:.3f}", f"{found['A/A']:.3f}", f"{100 * found['spread']:.1f} %")


# --- In the measuring process: must run with trees from before and after the rooms were named anew --------------


def arview_folder() -> str:
    import arview

    return str(Path(arview.__file__).resolve().parent)


def use_own_evaluation() -> None:
    """Trees from before `tools/lab` have the evaluation in arview itself: take it from there."""
    if importlib.util.find_spec("arview.evaluation") is not None:
        sys.modules["arview_lab.evaluation"] = importlib.import_module("arview.evaluation")


def track_ms() -> float:
    from arview_lab.evaluation import evaluate_scene

    spreads = [evaluate_scene(scene, "truth").summary.track_ms for scene in sequences()]
    return geometric_mean([spread.median for spread in spreads if spread is not None])


def detect_ms() -> float:
    from arview_lab.evaluation import scene_guide_views

    detector_class = import_detector()
    medians = []
    for scene in sequences():
        detector = detector_class(views=scene_guide_views(scene), camera=scene.camera)
        frames = scene.frames[:: max(1, len(scene.frames) // DETECTED_FRAMES)]
        images = [scene.image(frame) for frame in frames]
        detector.detect(images[0])  # loads compiled code and networks
        ms = []
        for image in images:
            began = time.perf_counter()
            detector.detect(image)
            ms.append(1e3 * (time.perf_counter() - began))
        medians.append(float(np.median(ms)))
    return geometric_mean(medians)


def import_detector() -> Any:
    try:
        from arview.detection import Detector
    except ImportError:  # trees from before detection had a room of its own
        from arview.tracking import Detector  # type: ignore[no-redef]
    return Detector


def annotate_ms() -> float:
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(sample_command(Path(folder)), capture_output=True, text=True, check=True)
    match = re.search(r"([0-9.]+) fps end to end", done.stdout + done.stderr)
    if match is None:
        raise SystemExit(f"annotate said no frame rate: {done.stdout}{done.stderr}")
    return 1e3 / float(match[1])


def sequences() -> list[Any]:
    found = list(scenes().values())
    if not found:
        raise SystemExit("no recorded sequence is here; set ARVIEW_DATA to the folder that holds sequences/")
    return found


def geometric_mean(values: list[float]) -> float:
    return float(np.exp(np.mean(np.log(values))))


CHILDREN: dict[str, Callable[[], float]] = {"track": track_ms, "detect": detect_ms, "annotate": annotate_ms}

if __name__ == "__main__":
    sys.exit(main())
