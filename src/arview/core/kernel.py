"""`kernel`: the one decorator of all compiled functions.

Kernels are compiled by numba when first called, release the interpreter lock, and are kept in the user's cache folder
(see `kernel_cache`), so that a command compiles only what no earlier command did. `warm_up` compiles them all ahead.
"""

from __future__ import annotations

import atexit
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, overload

from numba import njit

from arview.core.kernel_cache import KernelCache
from arview.core.kernel_signatures import encode_signature

Function = TypeVar("Function", bound=Callable[..., Any])

RECORD_VARIABLE = "ARVIEW_RECORD_KERNELS"
"""Environment variable: folder into which each process writes the signatures with which it called kernels."""

_kernels: dict[str, Any] = {}


@overload
def kernel(function: Function) -> Function: ...


@overload
def kernel(
    *, fastmath: bool | set[str] = ..., numpy_errors: bool = ..., inline: bool = ...
) -> Callable[[Function], Function]: ...


def kernel(
    function: Function | None = None,
    *,
    fastmath: bool | set[str] = False,
    numpy_errors: bool = False,
    inline: bool = False,
) -> Function | Callable[[Function], Function]:
    """Compile a function with numba when it is first called, and keep the code in the user's cache folder.

    Args:
        function: with arrays, numbers, tuples and named tuples as arguments.
        fastmath: allow the compiler to reorder sums, or the LLVM flags that say what it may do.
        numpy_errors: division by zero gives inf or nan, as in numpy, instead of an exception.
        inline: copy the body into every kernel that calls it.
    """

    def compiled(function: Function) -> Function:
        # All flags are explicit: otherwise a kernel takes them over from whichever kernel calls it first.
        error_model = "numpy" if numpy_errors else "python"
        options: dict[str, Any] = {"nogil": True, "fastmath": fastmath, "error_model": error_model}
        if inline:
            options["inline"] = "always"
        dispatcher: Any = njit(**options)(function)
        dispatcher._cache = KernelCache(function, options)
        _kernels[f"{function.__module__}:{function.__qualname__}"] = dispatcher
        result: Function = dispatcher
        return result

    return compiled if function is None else compiled(function)


def all_kernels() -> dict[str, Any]:
    """Numba's dispatchers of the modules imported so far, by ``module:name``."""
    return dict(_kernels)


def record_signatures(folder: Path) -> None:
    """Write the signatures with which this process has called kernels to a file of its own in a folder."""
    called = {
        name: [encode_signature(signature) for signature in dispatcher.signatures]
        for name, dispatcher in sorted(_kernels.items())
        if dispatcher.signatures
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{os.getpid()}-{time.time_ns()}.json").write_text(json.dumps(called), encoding="utf-8")


if os.environ.get(RECORD_VARIABLE):
    atexit.register(record_signatures, Path(os.environ[RECORD_VARIABLE]))
