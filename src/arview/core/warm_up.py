"""Compilation of all kernels in advance, on all cores, so that no command has to compile later.

``kernel_signatures.json`` lists the argument types with which arview's commands and tests call each kernel. It is
made by `kernel_signatures` from a run that records them.
"""

from __future__ import annotations

import importlib
import os
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from typing import Any

from arview.core.kernel import all_kernels
from arview.core.kernel_cache import prune_kernels
from arview.core.kernel_signatures import decode_type, recorded_signatures
from arview.core.progress import StepProgress


def warm_up(progress: StepProgress | None = None, processes: int | None = None) -> int:
    """Compile every kernel for all recorded signatures into the user's cache folder.

    Args:
        progress: called with (kernels done, kernels in all).
        processes: number of processes; None means one per core.

    Returns:
        Number of signatures compiled; the others were in the cache.
    """
    prune_kernels()
    jobs = recorded_signatures()
    compiled = 0
    done = 0
    with ProcessPoolExecutor(processes or os.cpu_count() or 1, get_context("spawn")) as pool:
        futures = [pool.submit(compile_kernels, {name: signatures}) for name, signatures in jobs.items()]
        for future in as_completed(futures):
            compiled += future.result()
            done += 1
            if progress is not None:
                progress(done, len(jobs))
    return compiled


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
