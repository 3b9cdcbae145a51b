"""All that runs on a GPU, or could: results beside those of the processor's own code, and times, in under ten minutes.

    python tools/benchmarks/gpu [--only renderers,features,matching,dense] [--json out/gpu.json]

Renderers are timed in any case. Features, matching and the dense search need torch and kornia (the extra gpu): they run
on torch for the processor, and on CUDA where there is one. A result outside its bounds ends with exit code 1.
Times on the processor are of its own clock, which other programs on the machine disturb little; those on CUDA are wall
times of both, after a first run.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import platform
import sys
import time
from dataclasses import asdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(ROOT / "tests"), str(HERE.parent)]

from gpu.clock import Row
from gpu.comparisons import dense_rows, feature_rows, matching_rows
from gpu.drawing import renderer_rows

SECTIONS = {"renderers": renderer_rows, "features": feature_rows, "matching": matching_rows, "dense": dense_rows}


def machine() -> list[str]:
    """What the machine has, a line each."""
    from arview.errors import MissingDependencyError
    from arview.rendering.pyrender_renderer import gl_name, probe_gpu
    from arview.rendering.renderers import choose_renderer

    try:
        drawn_by = gl_name()
    except MissingDependencyError as error:
        drawn_by = f"none ({error})"
    lines = [
        f"processor: {os.cpu_count()} cores, {platform.machine()}, load {os.getloadavg()[0]:.1f}",
        f"OpenGL: {drawn_by}; probe: {probe_gpu()[1]}; auto takes {choose_renderer().name}",
    ]
    if any(importlib.util.find_spec(name) is None for name in ("torch", "kornia")):
        return [*lines, "torch, kornia: not installed; only renderers are compared"]
    import kornia
    import torch

    cuda = torch.cuda.get_device_name() if torch.cuda.is_available() else "no CUDA"
    return [*lines, f"torch {torch.__version__}, kornia {kornia.__version__}, {cuda}"]


def devices() -> list[str]:
    """Torch devices to compare with the processor's own code; ``cpu:0`` is torch on the processor."""
    if any(importlib.util.find_spec(name) is None for name in ("torch", "kornia")):
        return []
    import torch

    return ["cpu:0", "cuda"] if torch.cuda.is_available() else ["cpu:0"]


def table(rows: list[Row]) -> str:
    """The rows in Markdown."""
    lines = [
        "| what | on | beside it | time of the processor's own code | time | ratio | result beside it |",
        "|" + "---|" * 7,
    ]
    for row in rows:
        lines.append(
            f"| {row.what} | {row.subject} | {row.device} | {row.own_s:.3g} s | {row.other_s:.3g} s | "
            f"{row.other_s / row.own_s:.2g} | {row.result}{'' if row.is_within else ' **outside its bounds**'} |"
        )
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default=",".join(SECTIONS), help="sections, separated by commas")
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    options = parser.parse_args()
    chosen = options.only.split(",")
    if unknown := sorted(set(chosen) - set(SECTIONS)):
        parser.error(f"--only: no section {', '.join(unknown)}; there are {', '.join(SECTIONS)}")
    began_s = time.perf_counter()
    for line in machine():
        print(line, flush=True)
    rows: list[Row] = []
    for name in chosen:
        rows += SECTIONS[name](devices())
        print(f"{name}: {time.perf_counter() - began_s:.0f} s", file=sys.stderr, flush=True)
    print(table(rows))
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps({"machine": machine(), "rows": [asdict(row) for row in rows]}, indent=1))
    return 0 if all(row.is_within for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
