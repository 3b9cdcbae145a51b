"""Rendered cells of fixed cameras: displacements, U, knocked cameras, and the time of a cycle, against truth.

The cameras are placed by a board as a user would do it. As the bound of the geometry stands the error that a noise of
0.1 px at four edges of a component would give: pixel size times 0.1 / sqrt(cameras).
"""

from __future__ import annotations

import resource
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from arview.calibration import rig_from_board
from arview.inspection import Verdict
from arview.station.rig import Cell, RigCameras, read_station
from helpers.rig_cell import (
    BOARD,
    CAMERA,
    board_shots,
    cell,
    names_of,
    true_mm,
    write_pictures,
    write_station,
)
from rows import ResultRow, watched

CELLS = ((16, 4, 11), (30, 4, 12), (45, 8, 13), (60, 8, 14))
"""Components, cameras and seed of each."""
TURNS_DEG = ((0.1, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0, 0.0, 0.1), (0.07, -0.07, 0.0))
"""Rotations of one camera about its own axes, a cycle each."""
MEDIAN_MM = 0.025


def rig_rows(details: dict[str, Any]) -> list[ResultRow]:
    """Rows of each cell, and of all."""
    rows: list[ResultRow] = []
    held: list[bool] = []
    for count, cameras, seed in watched(CELLS, "cells"):
        scene = cell(count, cameras, seed)
        names = names_of(scene)
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            path = write_station(folder, scene)
            rig_from_board(board_shots(folder / "board", scene, 6), dict.fromkeys(names, CAMERA), BOARD).save(
                folder / "rig.json"
            )
            write_pictures(folder, scene, 0)
            write_pictures(folder, scene, 1)
            for number, turn_deg in enumerate(TURNS_DEG):
                write_pictures(folder, scene, 2 + number, {number % cameras: np.deg2rad(turn_deg)})
            measuring = Cell(setup := read_station(path))
            cycles, seconds, cpu_s = [], [], []
            with RigCameras(setup.cameras) as sources:
                for _ in range(2 + len(TURNS_DEG)):
                    began, cpu = time.monotonic(), time.process_time()
                    cycles.append(measuring.cycle(sources))
                    seconds.append(time.monotonic() - began)
                    cpu_s.append(time.process_time() - cpu)
        errors, wrong, missing = [], 0, 0
        for one in cycles[1].inspection.components:
            if one.distance_mm is None or one.uncertainty_mm is None:
                missing += 1
                continue
            true = true_mm(scene, one.name)
            errors.append(abs(one.distance_mm - true))
            held.append(errors[-1] <= one.uncertainty_mm)
            wrong += one.verdict is (Verdict.FAIL if true <= 0.6 else Verdict.PASS)
        named = sum(tuple(cycle.faults) == (names[number % cameras],) for number, cycle in enumerate(cycles[2:]))
        bound_um = 1000 * 430.0 / CAMERA.fx * 0.1 / np.sqrt(cameras)
        on = f"{count} components, {cameras} cameras of 2 Mpx"
        text = f"median {1000 * np.median(errors):.1f}, 95 % {1000 * np.quantile(errors, 0.95):.1f} um"
        text += f" (geometry {bound_um:.0f}), {missing} not measured, {wrong} wrong"
        is_good = float(np.median(errors)) <= MEDIAN_MM and not missing and not wrong
        rows.append(ResultRow("rig: displacement", on, text, "median <= 25 um", is_good))
        text = f"{named} of {len(TURNS_DEG)}; none else: {not cycles[0].faults and not cycles[1].faults}"
        is_good = named == len(TURNS_DEG) and not cycles[0].faults and not cycles[1].faults
        rows.append(ResultRow("rig: turned by 0.1°, named", on, text, "all", is_good))
        target_s = 4.0 if count <= 16 else 10.0
        text = f"{seconds[1]:.1f} s ({cpu_s[1]:.1f} CPU-s); the first {seconds[0]:.1f} s"
        rows.append(ResultRow("rig: trigger to verdict", on, text, f"<= {target_s:.0f} s", seconds[1] <= target_s))
        details[f"rig {count} {cameras}"] = {"errors_mm": errors, "seconds": seconds, "cpu_s": cpu_s}
    share = float(np.mean(held))
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    rows.append(ResultRow("rig: within U", f"{len(held)} components", f"{100 * share:.1f} %", "93-97 %", share >= 0.93))
    return [*rows, ResultRow("rig: memory", "all cells", f"{peak_mb:.0f} MB", "<= 1500 MB", peak_mb <= 1500)]
