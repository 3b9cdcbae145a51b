"""Fitted numbers: networks, ranker layers and regression weights, with a manifest that says where each comes from.

`manifest.json` lists for every file its sha256, inputs, training command, the commit that last changed its bytes, and
the metrics known of it. Networks are ONNX files, layers of small rankers NumPy archives, and regression weights JSON
files of named groups.
"""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np

from arview.core.onnx_session import Network

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

    from numpy.typing import NDArray


def weights_file(name: str) -> Traversable:
    """The file of a name, such as ``pose_verifier.onnx``, inside this package."""
    return files("arview.weights").joinpath(name)


@cache
def load_network(name: str) -> Network:
    """The network stored in an ONNX file; all callers share one session, which is safe across threads.

    Args:
        name: file name, such as ``pose_verifier.onnx``.
    """
    return Network(weights_file(name).read_bytes())


def load_arrays(name: str) -> dict[str, NDArray[Any]]:
    """The arrays stored in a NumPy archive, by their names.

    Args:
        name: file name, such as ``profile_ranker.npz``.
    """
    with weights_file(name).open("rb") as file, np.load(file) as stored:
        return {key: np.ascontiguousarray(stored[key]) for key in stored.files}


def load_weights(name: str) -> dict[str, dict[str, float]]:
    """Regression weights by group and name, read anew on every call.

    Args:
        name: file name without its ending, such as ``pose_confidence`` for ``pose_confidence.json``.
    """
    groups: dict[str, dict[str, float]] = json.loads(weights_file(f"{name}.json").read_text(encoding="utf-8"))
    return groups


def manifest() -> dict[str, dict[str, Any]]:
    """The entries of ``manifest.json`` by file name."""
    entries: dict[str, dict[str, Any]] = json.loads(weights_file("manifest.json").read_text(encoding="utf-8"))
    return entries
