"""Compilation of all kernels in advance, on all cores, so that no command has to compile later.

``kernel_signatures.json`` lists the argument types with which arview's commands and tests call each kernel. It is
made by `kernel_signatures` from a run that records them.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from typing import Any

from arview.core.kernel import all_kernels
from arview.core.kernel_cache import count_callees, prune_kernels
from arview.core.kernel_signatures import decode_type, recorded_signatures
from arview.core.progress import StepProgress


def warm_up(progress: StepProgress | None = None, processes: int | None = None, without: Sequence[str] = ()) -> int:
    """Compile every kernel for all recorded signatures into the user's cache folder.

    Args:
        progress: called with (kernels done, kernels in all).
        processes: number of processes; None means one per core.
        without: rooms or modules whose kernels are left out, as ``refinement.modalities.shading``.

    Returns:
        Number of signatures compiled; the others were in the cache.
    """
    prune_kernels()
    left_out = tuple(f"arview.{name}" for name in without)
    recorded = {
        name: signatures
        for name, signatures in recorded_signatures().items()
        if not any(name.startswith((f"{one}.", f"{one}:")) for one in left_out)
    }
    compiled = 0
    done = 0
    with ProcessPoolExecutor(processes or os.cpu_count() or 1, get_context("spawn")) as pool:
        futures = {pool.submit(compile_kernels, job): len(job) for job in _jobs(recorded)}
        for future in as_completed(futures):
            compiled += future.result()
            done += futures[future]
            if progress is not None:
                progress(done, len(recorded))
    return compiled


def _jobs(recorded: dict[str, list[Any]]) -> list[dict[str, list[Any]]]:
    """The kernels by module, those first that call the fewest others.

    A kernel's callees are compiled with it unless they are in the cache: without this order, processes would compile
    the same callees at the same time.
    """
    jobs: dict[str, dict[str, list[Any]]] = {}
    for name, signatures in recorded.items():
        module = name.split(":")[0]
        importlib.import_module(module)
        jobs.setdefault(module, {})[name] = signatures
    kernels = all_kernels()
    calls = {module: max(count_callees(kernels[name].py_func) for name in job) for module, job in jobs.items()}
    return [jobs[module] for module in sorted(jobs, key=lambda module: calls[module])]


def compile_kernels(signatures_of: dict[str, list[Any]]) -> int:
    """Compile kernels, given as ``module:name``, and return how many signatures were not in the cache.

    Raises:
        KeyError: no such kernel.
    """
    compiled = 0
    for name, signatures in signatures_of.items():
        importlib.import_module(name.split(":")[0])
        dispatcher = all_kernels()[name]
        for signature in signatures:
            dispatcher.compile(tuple(decode_type(part) for part in signature))
        compiled += sum(dispatcher.stats.cache_misses.values())
    return compiled
