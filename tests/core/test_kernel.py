"""Compiled kernels: a cache that is never stale, and signatures as plain values."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numba import typeof

from arview.core.kernel import kernel
from arview.core.kernel_signatures import decode_type, encode_signature, encode_type

CALLEE = """
from arview.core.kernel import kernel

FACTOR = {factor}

@kernel{options}
def scaled(x):
    {comment}
    return FACTOR * x + {offset}
"""
CALLER = """
from arview.core.kernel import kernel
from callee import scaled

@kernel
def total(values):
    result = 0.0
    for value in values:
        result += scaled(value)
    return result
"""
PROGRAM = """
import numpy as np
from caller import total
print(total(np.array([1.0, 2.0])), sum(total.stats.cache_hits.values()))
"""


class Pair(NamedTuple):
    """A table of two columns."""

    points: np.ndarray
    count: int


def run(folder: Path, hash_seed: int = 0, **callee: object) -> tuple[float, int]:
    """What a process says that calls a kernel with a callee: the result, and how often the cache was hit.

    The order of a set of words in a process is by its hash seed.
    """
    text = CALLEE.format(**{"factor": 2.0, "offset": 0.0, "options": "", "comment": '"""Doubled."""'} | callee)
    (folder / "callee.py").write_text(text)
    (folder / "caller.py").write_text(CALLER)
    environment = {**os.environ, "ARVIEW_CACHE": str(folder / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}
    environment["PYTHONHASHSEED"] = str(hash_seed)
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], cwd=folder, env=environment, capture_output=True, text=True, check=True
    )
    result, hits = done.stdout.split()
    return float(result), int(hits)


@pytest.mark.slow
def test_a_changed_callee_or_constant_is_compiled_anew_and_words_are_not(tmp_path: Path) -> None:
    assert run(tmp_path) == (6.0, 0)
    # A docstring and a moved line leave the code as it is.
    assert run(tmp_path, comment='"""Twice the value."""\n') == (6.0, 1)
    assert run(tmp_path, offset=1.0) == (8.0, 0)
    assert run(tmp_path, factor=3.0) == (9.0, 0)
    assert run(tmp_path, options="(numpy_errors=True)") == (6.0, 0)
    # Earlier versions are kept: two checkouts share one cache.
    assert run(tmp_path, factor=3.0) == (9.0, 1)


@pytest.mark.slow
def test_flags_of_the_compiler_have_one_key_in_every_process(tmp_path: Path) -> None:
    options = '(fastmath={"reassoc", "contract", "arcp", "nsz"})'
    assert run(tmp_path, options=options) == (6.0, 0)
    assert [run(tmp_path, seed, options=options) for seed in (1, 2)] == [(6.0, 1)] * 2


@pytest.mark.slow
def test_a_cache_that_cannot_be_written_is_done_without(tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("a file where the folder should be")
    assert run(tmp_path) == (6.0, 0)


@pytest.mark.slow
def test_a_cached_signature_of_a_renamed_named_tuple_is_compiled_anew(tmp_path: Path) -> None:
    program = """
from typing import NamedTuple
from arview.core.kernel import kernel

class {name}(NamedTuple):
    first: float
    second: float

@kernel
def total(pair):
    return pair.first + pair.second

print(total({name}(1.0, 2.0)), sum(total.stats.cache_hits.values()))
"""
    environment = {**os.environ, "ARVIEW_CACHE": str(tmp_path / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}
    said = []
    for name in ("Two", "Both", "Both"):
        (tmp_path / "pairs.py").write_text(program.format(name=name))
        command = [sys.executable, "-c", "import pairs"]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
        said.append(done.stdout.split())
    assert said == [["3.0", "0"], ["3.0", "0"], ["3.0", "1"]]


def test_signatures_survive_json() -> None:
    values = (
        np.zeros((2, 3), np.float32),
        np.zeros((2, 3), np.uint8)[:, ::2],
        Pair(np.zeros(4), 3),
        (1.0, 2.0),
        (np.zeros(2), 1),
        True,
        np.float32(1.0),
        None,
    )
    signature = tuple(map(typeof, values))
    assert tuple(map(decode_type, encode_signature(signature))) == signature


def test_a_type_without_a_plain_form_is_refused() -> None:
    with pytest.raises(TypeError, match="no plain form"):
        encode_type(typeof([1, 2]))


def test_a_kernel_keeps_the_docstring_of_its_function() -> None:
    @kernel
    def doubled(x: float) -> float:
        """Twice the value."""
        return 2.0 * x

    assert doubled(2.0) == 4.0
    assert doubled.__doc__ == "Twice the value."
