"""Kernels compiled ahead: the recorded signatures are those of the kernels, and nothing is left to compile."""

from __future__ import annotations

import importlib
import inspect
import json
import subprocess
import sys
from pathlib import Path

import pytest

from arview.core.kernel import all_kernels
from arview.core.kernel_cache import kernel_folder
from arview.core.kernel_signatures import decode_type, merge_records, recorded_signatures
from arview.core.warm_up import compile_kernels, warm_up
from helpers.paths import SAMPLES


def test_recorded_signatures_fit_their_kernels() -> None:
    recorded = recorded_signatures()
    assert len(recorded) > 80
    for name, signatures in recorded.items():
        importlib.import_module(name.split(":")[0])
        parameters = inspect.signature(all_kernels()[name].py_func).parameters
        assert signatures
        for signature in signatures:
            types = [decode_type(part) for part in signature]
            required = sum(p.default is inspect.Parameter.empty for p in parameters.values())
            assert required <= len(types) <= len(parameters), name


def test_an_unknown_kernel_is_an_error() -> None:
    with pytest.raises(KeyError):
        compile_kernels({"arview.core.kernel:nothing": []})


def test_records_are_merged_each_signature_once(tmp_path: Path) -> None:
    one, other = ["float64"], ["int64"]
    (tmp_path / "1.json").write_text(json.dumps({"arview.a:f": [one], "elsewhere:g": [one]}))
    (tmp_path / "2.json").write_text(json.dumps({"arview.a:f": [other, one], "arview.b:h": [one]}))
    assert merge_records(tmp_path) == {"arview.a:f": [one, other], "arview.b:h": [one]}


@pytest.mark.slow
def test_after_a_warm_up_no_command_compiles(tmp_path: Path) -> None:
    told = []
    warm_up(lambda done, total: told.append((done, total)))
    assert told[-1] == (len(recorded_signatures()), len(recorded_signatures()))
    assert warm_up() == 0
    before = {path.name for path in kernel_folder().glob("*.nbc")}
    sample = SAMPLES / "bracket_plate"
    program = [sys.executable, "-m", "arview", "annotate", str(sample / "clip.mp4"), "--end", "12"]
    program += ["--part", str(sample / "part.toml"), "--camera", str(sample / "camera.json")]
    program += ["--inspection", str(sample / "inspection.json"), "-o", str(tmp_path / "out.mp4")]
    subprocess.run(program, check=True, capture_output=True)
    assert len(before) > 100
    assert {path.name for path in kernel_folder().glob("*.nbc")} == before
