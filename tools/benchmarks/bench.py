#!/usr/bin/env python
"""Measure the speed of arview on this machine: medians over the recorded sequences, as a table and as JSON."""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import subprocess
import tempfile
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from arview.cad import default_view_range
from arview.detection import Detector
from arview.errors import ArviewError
from arview.guideviews import GuideViewOptions, load_guide_views, make_guide_views
from arview.tracking import SessionOptions
from arview_lab.evaluation import Scene, evaluate_scene, scene_guide_views
from recordings import ROOT, SAMPLE, sample_command, scenes, skip, table
from rows import watched
from suites.cloud_cost import cloud_costs
from suites.lenses import lens_errors
from suites.live_latency import live_latencies
from suites.registration import MEASURED, REFERENCE, registrations
from suites.scaling import COST_RUNS, Cost, plot, slope

TableRow = tuple[str, str, str]
CLOUD_POINTS = (1_000_000, 20_000_000)
OUT = ROOT / "out"
MODALITIES = {"region+edge": SessionOptions(use_texture=False), "all three": SessionOptions()}
DETECTED_FRAMES = 12


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, help="write the figures to this file too")
    parser.add_argument(
        "--only",
        choices=["guideviews", "track", "detect", "annotate", "register", "clouds", "costs", "lenses", "live"],
        help="only this section",
    )
    chosen = parser.parse_args()
    found: dict[str, Scene] = {} if chosen.only in ("register", "clouds", "costs", "lenses") else scenes()
    sections = {
        "guideviews": lambda: bench_guide_views(found),
        "track": lambda: bench_tracking(found),
        "detect": lambda: bench_detection(found),
        "annotate": bench_annotate,
        "register": bench_registration,
        "clouds": bench_clouds,
        "costs": bench_costs,
        "lenses": bench_lenses,
        "live": bench_live,
    }
    machine = f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}"
    figures: dict[str, Any] = {"machine": machine}
    rows: list[TableRow] = []
    for name, section in sections.items():
        if chosen.only in (None, name):
            figures[name], more = section()
            rows += more
    print(f"{machine}\n")
    print(table(("measure", "on", "figure"), rows))
    if chosen.json:
        chosen.json.parent.mkdir(parents=True, exist_ok=True)
        chosen.json.write_text(json.dumps(figures, indent=1) + "\n")
        print(f"\nwrote {chosen.json}")


def bench_guide_views(found: dict[str, Scene]) -> tuple[dict[str, Any], list[TableRow]]:
    """Guide views of the part with the most triangles, by each renderer: seconds, size, and time to load."""
    if not found:
        return {}, []
    part = max((scene.part for scene in found.values()), key=lambda part: len(part.model.mesh[1]))
    model, view_range = part.model, default_view_range(part.model)
    on = f"{part.name}, {len(model.mesh[1]):,} triangles"
    figures: dict[str, Any] = {}
    rows = []
    for renderer in ("zbuffer", "pyrender"):
        try:
            make_guide_views(model, view_range, GuideViewOptions(subdivisions=1, renderer=renderer))  # warm-up
            began = time.perf_counter()
            views = make_guide_views(model, view_range, GuideViewOptions(renderer=renderer))
        except ArviewError as error:
            skip(f"guide views with {renderer}", str(error))
            continue
        seconds = time.perf_counter() - began
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "set"
            views.save(path)
            size_mb = path.stat().st_size / 1e6
            load_s = []
            for _ in range(5):
                began = time.perf_counter()
                load_guide_views(path, model)
                load_s.append(time.perf_counter() - began)
        figures[renderer] = {
            "views": len(views), "seconds": seconds, "size_mb": size_mb, "load_s": float(np.median(load_s)),
        }  # fmt: skip
        figure = f"{seconds:.1f} s, {size_mb:.1f} MB, load {1000 * np.median(load_s):.0f} ms"
        rows.append((f"{len(views)} guide views, {renderer}", on, figure))
    return figures, rows


def bench_tracking(found: dict[str, Scene]) -> tuple[dict[str, Any], list[TableRow]]:
    """Milliseconds for each tracked frame."""
    figures: dict[str, Any] = {}
    rows = []
    for label, options in MODALITIES.items():
        for name, scene in found.items():
            spread = evaluate_scene(scene, "truth", options).summary.track_ms
            if spread is not None:
                figures.setdefault(label, {})[name] = {"median_ms": spread.median, "p95_ms": spread.p95}
                rows.append((f"track, {label}", name, f"median {spread.median:.2f} ms, p95 {spread.p95:.2f} ms"))
    return figures, rows


def bench_detection(found: dict[str, Scene]) -> tuple[dict[str, Any], list[TableRow]]:
    """Milliseconds to detect the part in a frame, without a prior."""
    figures: dict[str, Any] = {}
    rows = []
    for name, scene in found.items():
        detector = Detector(scene_guide_views(scene), scene.camera)
        frames = scene.frames[:: max(1, len(scene.frames) // DETECTED_FRAMES)]
        images = [scene.image(frame) for frame in frames]
        detector.detect(images[0])  # warm-up
        ms = []
        for image in images:
            began = time.perf_counter()
            detector.detect(image)
            ms.append(1000.0 * (time.perf_counter() - began))
        median, slowest = float(np.median(ms)), max(ms)
        figures[name] = {"median_ms": median, "max_ms": slowest, "frames": len(ms)}
        rows.append(("detect", name, f"median {median:.0f} ms, max {slowest:.0f} ms"))
    return figures, rows


def bench_annotate() -> tuple[dict[str, Any], list[TableRow]]:
    """Frames per second of the sample clip, end to end, and peak memory for half of it and for all of it."""
    if not (SAMPLE / "clip.mp4").is_file():
        skip("annotate", f"{SAMPLE / 'clip.mp4'} is not here")
        return {}, []
    figures: dict[str, Any] = {}
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        run_measured(sample_command(Path(folder), "--end", "20"))  # guide views and compiled code are kept
        for label, options in (("first half", ("--end", "150")), ("whole clip", ())):
            text, peak_mb = run_measured(sample_command(Path(folder), *options))
            match = re.search(r"([0-9.]+) fps end to end", text)
            if match is None:
                raise SystemExit(f"annotate printed no frame rate: {text}")
            figures[label] = {"fps": float(match[1]), "peak_mb": peak_mb}
            rows.append((f"annotate, {label}", SAMPLE.name, f"{match[1]} fps, peak memory {peak_mb:.0f} MB"))
    return figures, rows


def bench_clouds() -> tuple[dict[str, Any], list[TableRow]]:
    """CPU time, peak memory and errors of `arview measure --cloud`, by number of points and format."""
    figures: dict[str, Any] = {}
    rows: list[TableRow] = []
    with tempfile.TemporaryDirectory() as folder:
        for one in cloud_costs(Path(folder), CLOUD_POINTS):
            figures[f"{one.kind}, {one.points}"] = asdict(one)
            figure = (
                f"{one.cpu_s:.0f} CPU-s, peak memory {one.peak_mb:.0f} MB; {one.within} of {one.measured} within U, at"
                f" most {1000 * one.worst_mm:.1f} um off, mean U {one.mean_u_mm:.3f} mm"
            )
            rows.append(("measure --cloud", f"sample plate, {one.points:,} points, {one.kind.upper()}", figure))
    return figures, rows


def bench_costs() -> tuple[dict[str, Any], list[TableRow]]:
    """CPU time of each step and peak memory by what grows, and the slope of their sum in a log-log plot."""
    figures: dict[str, Any] = {}
    rows: list[TableRow] = []
    grown: dict[str, dict[int, Cost]] = {}
    for what, (run, sizes, result) in COST_RUNS.items():
        costs = grown[what] = {size: run(size) for size in watched(sizes, what)}
        for size, cost in costs.items():
            figures[f"{size} {what}"] = asdict(cost)
            steps = ", ".join(f"{name} {seconds:.2f}" for name, seconds in cost.seconds.items())
            figure = f"{sum(cost.seconds.values()):.1f} CPU-s ({steps}), {cost.peak_mb:.0f} MB; {cost.good} {result}"
            rows.append(("cost", f"{size:,} {what}", figure))
        totals = [sum(cost.seconds.values()) for cost in costs.values()]
        rows.append(("growth", what, f"slope {slope(sizes, totals):.2f}"))
    plot(grown, OUT / "growth.svg")
    return figures, rows


def bench_lenses() -> tuple[dict[str, Any], list[TableRow]]:
    """Largest errors of the lens models, px, over a picture of 1280×720."""
    figures: dict[str, Any] = {}
    rows: list[TableRow] = []
    for name, library, forth, back, tracked in lens_errors():
        figures[name] = {"reference": library, "projection_px": forth, "way_back_px": back, "resampling_px": tracked}
        text = f"{forth:.1e} px from {library}, {back:.1e} px there and back, resampled {tracked:.3f} px off"
        rows.append((f"lens, {name}", "1280×720", text))
    return figures, rows


def bench_registration() -> tuple[dict[str, Any], list[TableRow]]:
    """CPU seconds and error of registering a post that was moved by 1 mm, without noise."""
    figures, rows = {}, []
    for name, cpu_s, error_um in registrations():
        figures[name] = {"cpu_s": cpu_s, "error_um": error_um}
        rows.append((f"register, {name}", f"{MEASURED} of {REFERENCE} points", f"{cpu_s:.2f} CPU-s, {error_um:.3f} um"))
    return figures, rows


def bench_live() -> tuple[dict[str, Any], list[TableRow]]:
    """Latency of the live server and from camera to screen, in Chromium on this machine, which should be idle."""
    figures, rows = {}, []
    for name, measured in live_latencies():
        figures[name] = measured
        server, glass = measured["server_ms"], measured["glass_to_glass_ms"]
        shown = (
            f"{measured['frames_per_s']:.1f} fps; added by the server p50 {server['p50']:.0f} ms (<= 40), p95"
            f" {server['p95']:.0f} ms (<= 80); glass to glass p50 {glass['p50']:.0f} ms (<= 150),"
            f" p95 {glass['p95']:.0f} ms"
        )
        rows.append((f"live, {name}", f"{SAMPLE.name}, 640x480 at 30 fps", shown))
    return figures, rows


def run_measured(command: list[str]) -> tuple[str, float]:
    """The output of a command, and its peak memory in MB; ends this program when the command fails."""
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    text = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{' '.join(command)} ended with code {process.returncode}")
    return text, usage.ru_maxrss / 1024.0


if __name__ == "__main__":
    main()
