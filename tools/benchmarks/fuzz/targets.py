"""All targets, and the loop that lets Hypothesis make inputs for one of them."""

from __future__ import annotations

import logging
import shutil
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from command_lines import fuzz_command_line
from guard import Fault, guarded
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from mutations import CHANGES, changed
from readers import READERS
from requests_to_app import fuzz_requests
from requests_to_studio import fuzz_studio
from seeds import make_seeds
from written_poses import fuzz_poses

ROUND = 200


def fuzz_reader(name: str, folder: Path) -> tuple[Callable[[Any], None], st.SearchStrategy[Any]]:
    """The attempt on a reader and the strategy of its argument."""
    home = folder / name / "seeds"
    read, paths = READERS[name], make_seeds(home, name)[name]
    for path in paths:
        read(path, home)  # valid files are read, and inner loops compiled, before anything is measured
    log = folder / name / "native.txt"

    def attempt(argument: tuple[int, list[Any], bool]) -> None:
        number, changes, inside = argument
        path = paths[number % len(paths)]
        current = home / f"current_{path.name}" if name != "camera" else folder / name / path.name
        if name == "positions":
            current = folder / name / path.name
        current.write_bytes(changed(path.read_bytes(), changes, inside))
        with guarded(path.name, log):
            read(current, home)

    return attempt, st.tuples(st.integers(0, 100), CHANGES, st.booleans())


SURFACES = {
    "http": fuzz_requests,
    "studio": fuzz_studio,
    "commands": fuzz_command_line,
    "poses": fuzz_poses,
}
TARGETS = (*READERS, *SURFACES)
COSTLY = {"step": 8, "studio": 2, "commands": 2, "exports": 2}
"""Targets of which only one of so many inputs is tried where a number of inputs is given."""


def fuzz(name: str, number: int, examples: int | None, seconds: float, folder: Path) -> dict[str, Any]:
    """Fuzz one target; returns the number of inputs and the faults as (signature, text), one for each cause."""
    warnings.simplefilter("ignore")
    logging.disable(logging.CRITICAL)
    (folder / name).mkdir(parents=True, exist_ok=True)
    attempt, strategy = SURFACES[name](folder) if name in SURFACES else fuzz_reader(name, folder)
    examples = None if examples is None else max(1, examples // COSTLY.get(name, 1))
    ends_s, inputs, rounds = time.monotonic() + seconds, 0, 0
    faults: dict[str, str] = {}
    while time.monotonic() < ends_s and (examples is None or inputs < examples):

        @seed(1000 * number + rounds)
        @settings(
            max_examples=min(ROUND, examples or ROUND),
            database=None,
            deadline=None,
            phases=(Phase.generate, Phase.shrink),
            suppress_health_check=list(HealthCheck),
            report_multiple_bugs=False,
            print_blob=False,
        )
        @given(strategy)
        def one_round(argument: Any) -> None:
            nonlocal inputs
            if time.monotonic() > ends_s:
                return
            inputs += 1
            try:
                attempt(argument)
            except Fault as fault:
                if fault.signature not in faults:
                    raise

        try:
            one_round()
        except Fault as fault:
            faults[fault.signature] = fault.text
            kept = folder / "faults" / f"{name}-{len(faults)}-{number}"
            kept.mkdir(parents=True, exist_ok=True)
            (kept / "fault.txt").write_text(
                f"{fault.signature}\n{fault.text}\n{fault.__notes__ if hasattr(fault, '__notes__') else ''}\n"
            )
            for path in [*(folder / name).glob("*"), *(folder / name).glob("seeds/current*")]:
                if path.is_file():
                    with suppress(OSError):
                        shutil.copy(path, kept)
        rounds += 1
    return {"inputs": inputs, "faults": sorted(faults.items())}
