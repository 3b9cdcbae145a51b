"""The manifest of the fitted weights: complete, with the right checksums and inputs."""

from __future__ import annotations

import hashlib
from importlib.resources import files

import pytest

from arview.weights import load_arrays, load_network, load_weights, manifest

FIELDS = {"sha256", "inputs", "training", "commit", "metrics", "notes"}
STORED = sorted(
    path.name for path in files("arview.weights").iterdir() if path.name.endswith((".onnx", ".npz", ".json"))
)


def test_every_file_is_in_the_manifest_and_vice_versa() -> None:
    assert len(STORED) > 1
    assert sorted([*manifest(), "manifest.json"]) == STORED


@pytest.mark.parametrize("name", sorted(manifest()))
def test_a_file_has_the_bytes_that_the_manifest_says(name: str) -> None:
    entry = manifest()[name]
    assert set(entry) == FIELDS
    assert all(entry[field] for field in FIELDS)
    stored = files("arview.weights").joinpath(name).read_bytes()
    assert hashlib.sha256(stored).hexdigest() == entry["sha256"]


@pytest.mark.parametrize("name", [name for name in sorted(manifest()) if name.endswith(".onnx")])
def test_the_inputs_of_a_network_are_those_of_the_manifest(name: str) -> None:
    assert load_network(name).inputs == manifest()[name]["inputs"]


def test_stored_arrays_and_regression_weights_are_those_of_the_manifest() -> None:
    arrays = load_arrays("profile_ranker.npz")
    assert {key: list(array.shape) for key, array in arrays.items()} == manifest()["profile_ranker.npz"]["inputs"]
    for name in ("pose_confidence", "component_log_odds", "tracked_pose"):
        groups = load_weights(name)
        assert {key: list(group) for key, group in groups.items()} == manifest()[f"{name}.json"]["inputs"]
