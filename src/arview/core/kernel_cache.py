"""Cache of compiled kernels in the user's cache folder, never stale.

Numba's own cache looks only at the file of the function itself, so a kernel keeps the old code of another one that it
calls. Here the key of a kernel is a hash of its byte code, of the constants it reads and, recursively, of the kernels
it calls. A comment, a docstring or a moved line does not change the key.
"""

from __future__ import annotations

import fcntl
import hashlib
import pickle
import time
import types as python_types
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numba
import numpy as np
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile, NullCache
from numba.core.registry import CPUDispatcher

from arview.core.cache_folder import cache_folder

MAX_UNUSED_DAYS = 30.0
"""Compiled code that has not been used for longer is deleted by `prune_kernels`."""
_FORMAT = "2"
"""Of the files, see `_DigestImpl`."""
_OPTIONS = "kernel_options"
"""Attribute of a kernel's function that holds its compiler options as text."""


class KernelCache:
    """A kernel's cache, opened when the kernel is first called: only then are all kernels that it calls defined."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self._function = function
        function.__dict__[_OPTIONS] = _plain(options)
        self._opened: Any = None

    @property
    def _cache(self) -> Any:
        if self._opened is None:
            try:
                kernel_folder().mkdir(parents=True, exist_ok=True)
                self._opened = _DigestCache(self._function)
            except OSError:
                self._opened = NullCache()
        return self._opened

    def __getattr__(self, name: str) -> Any:
        return getattr(self._cache, name)

    def save_overload(self, signature: Any, data: Any) -> None:
        """Write compiled code; a full or read-only disk only means that it is compiled again next time."""
        try:
            with _locked(kernel_folder() / ".lock"):
                self._cache.save_overload(signature, data)
        except OSError:
            pass


class _DigestLocator:
    """Numba's interface to where a function's compiled code lies and under which key."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._digest = kernel_digest(function)

    @classmethod
    def from_function(cls, function: Callable[..., Any], _file: str) -> _DigestLocator:
        return cls(function)

    def ensure_cache_path(self) -> None:
        kernel_folder().mkdir(parents=True, exist_ok=True)

    def get_cache_path(self) -> str:
        return str(kernel_folder())

    def get_source_stamp(self) -> str:
        return self._digest

    def get_disambiguator(self) -> str:
        return self._digest[:20]


class _DigestImpl(CompileResultCacheImpl):
    """What is stored of a kernel: its machine code, and LLVM's code for other kernels that are compiled with it.

    Numba reads the latter whenever it loads a kernel, which takes longer than all else. Here it is read when another
    kernel is compiled; the names that it defines are stored beside it.
    """

    _locator_classes = (_DigestLocator,)

    def reduce(self, data: Any) -> Any:
        library, *others = super().reduce(data)
        name, kind, code = library
        if kind == "object":
            module = llvm.parse_bitcode(code[1])
            defined = [one.name for one in (*module.functions, *module.global_variables) if not one.is_declaration]
            code = (*code, defined)
        return (name, kind, code), *others

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        (name, kind, code), *others = payload
        if kind != "object":
            return super().rebuild(target_context, payload)
        machine_code, bitcode, defined = code
        target_context.codegen()._engine._defined_symbols.update(defined)
        result = super().rebuild(target_context, ((name, kind, (machine_code, _empty_bitcode())), *others))
        result.library._get_module_for_linking = lru_cache(maxsize=1)(lambda: llvm.parse_bitcode(bitcode))
        return result


@lru_cache(maxsize=1)
def _empty_bitcode() -> bytes:
    return bytes(llvm.parse_assembly("").as_bitcode())


class _CacheFile(IndexDataCacheFile):
    """Numba's file of a kernel's signatures and machine code.

    A signature may name a named tuple that was renamed or moved since: such a file counts as empty.
    """

    def _load_index(self) -> Any:
        try:
            return super()._load_index()
        except (AttributeError, ImportError, EOFError, pickle.UnpicklingError):
            return {}


class _DigestCache(FunctionCache):
    _impl_class = _DigestImpl

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file = _CacheFile(self._cache_path, self._impl.filename_base, self._impl.locator.get_source_stamp())


def kernel_folder() -> Path:
    """Where compiled kernels lie."""
    return cache_folder() / "kernels"


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold a lock file: an index is read, extended and written by one process at a time."""
    with path.open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def kernel_digest(function: Callable[..., Any]) -> str:
    """Hash of all that a kernel's machine code depends on: its byte code, constants, callees, numba's version."""
    parts = [_FORMAT, numba.__version__, np.__version__]
    _describe(function, parts, set())
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def count_callees(function: Callable[..., Any]) -> int:
    """Number of functions that a kernel calls, and that these call."""
    seen: set[str] = set()
    _describe(function, [], seen)
    return len(seen) - 1


def _describe(function: Any, parts: list[str], seen: set[str]) -> None:
    name = f"{function.__module__}:{function.__qualname__}"
    parts += [name, function.__dict__.get(_OPTIONS, "")]
    if name in seen:
        return
    seen.add(name)
    names: list[str] = []
    _describe_code(function.__code__, function.__doc__, parts, names)
    for cell_name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        parts.append(cell_name)
        _describe_value(cell.cell_contents, parts, seen)
    for used in sorted(set(names)):
        if used in function.__globals__:
            parts.append(used)
            _describe_value(function.__globals__[used], parts, seen)


def _describe_code(code: python_types.CodeType, doc: str | None, parts: list[str], names: list[str]) -> None:
    names += code.co_names
    parts += [code.co_code.hex(), repr(code.co_names), repr(code.co_varnames), str(code.co_flags)]
    for constant in code.co_consts:
        if isinstance(constant, python_types.CodeType):
            _describe_code(constant, None, parts, names)
        elif doc is None or constant != doc:
            parts.append(_plain(constant))


def _plain(value: Any) -> str:
    """The same text in every process: sets in order."""
    if isinstance(value, dict):
        return repr([(key, _plain(value[key])) for key in sorted(value)])
    return repr(sorted(value, key=repr)) if isinstance(value, (set, frozenset)) else repr(value)


def _describe_value(value: Any, parts: list[str], seen: set[str]) -> None:
    if isinstance(value, CPUDispatcher):
        _describe(value.py_func, parts, seen)
    elif isinstance(value, python_types.FunctionType):
        _describe(value, parts, seen)
    elif isinstance(value, np.ndarray):
        parts.append(f"{value.dtype} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}")
    elif isinstance(value, type):
        parts.append(f"{value.__module__}.{value.__qualname__} {getattr(value, '_fields', '')}")
    elif isinstance(value, python_types.ModuleType):
        parts.append(value.__name__)
    elif isinstance(value, tuple):
        parts.append(type(value).__qualname__)
        for item in value:
            _describe_value(item, parts, seen)
    elif isinstance(value, (set, frozenset)):
        parts.append(_plain(value))
    elif isinstance(value, (bool, int, float, complex, str, np.generic)):
        parts.append(f"{type(value).__name__} {value!r}")
    else:
        parts.append(type(value).__qualname__)


def prune_kernels() -> None:
    """Delete compiled code that has not been used for `MAX_UNUSED_DAYS`."""
    oldest = time.time() - MAX_UNUSED_DAYS * 86400.0
    for path in kernel_folder().glob("*.nb[ic]"):
        try:
            if max(path.stat().st_atime, path.stat().st_mtime) < oldest:
                path.unlink()
        except OSError:
            continue
