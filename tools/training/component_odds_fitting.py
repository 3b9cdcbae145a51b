"""Fitting of the log odds of components: a multinomial logistic model with a ridge penalty."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from arview.assembly.log_odds import FEATURES, PlaceOdds
from arview.core.atomic import replacing
from arview.errors import InputError
from arview.geometry import Array
from arview.weights import weights_file
from component_odds_examples import ABSENT, OCCLUDED, PRESENT, ComponentOdds, read_component_odds

RIDGE = 0.0003
"""Penalty on the weights, relative to the mean log likelihood."""
CLASS_WEIGHTS = (0.43, 0.43, 0.14)
"""Prior probabilities of a present, an absent and an occluded component."""
FOLDS = 5
"""Of the cross-validation, over assemblies."""
MIN_ASSEMBLIES = 20
"""Smallest number of assemblies to fit to."""


def fit_component_odds(folder: Path) -> None:
    """Fit the weights, print how well they separate assemblies that they were not fitted to, and write them.

    Raises:
        InputError: too few examples.
    """
    examples = read_component_odds(folder)
    if len(examples) < MIN_ASSEMBLIES:
        raise InputError(
            f"{folder}: {len(examples)} assemblies, {MIN_ASSEMBLIES} are needed; run: fit.py component-odds-examples"
        )
    for line in _report(examples):
        print(line)
    features, classes = _joined(examples)
    weights = _fitted(features, classes)
    path = Path(str(weights_file("component_log_odds.json")))
    content = json.loads(path.read_text(encoding="utf-8"))
    content.pop("fusion", None)
    for name, row in zip(("place_absent", "place_present"), weights, strict=True):
        content[name] = dict(zip(FEATURES, np.round(row, 3).tolist(), strict=True))
    with replacing(path) as file:
        file.write((json.dumps(content, indent=2) + "\n").encode())
    print(f"wrote {path}")


def _joined(examples: list[ComponentOdds]) -> tuple[Array, NDArray[np.int64]]:
    return np.concatenate([one.features for one in examples]), np.concatenate([one.classes for one in examples])


def _fitted(features: Array, classes: NDArray[np.int64]) -> Array:
    """Weights (2,F) of "absent" and of "present" relative to "occluded"."""
    weight = np.array(CLASS_WEIGHTS)[classes] / np.maximum(np.bincount(classes, minlength=3), 1)[classes]
    scale = np.sqrt(np.mean(features**2, axis=0)) + 1e-6
    scaled = features / scale
    is_class = np.stack([classes == ABSENT, classes == PRESENT, classes == OCCLUDED], axis=1)

    def loss(flat: Array) -> tuple[float, Array]:
        rows = flat.reshape(2, -1)
        logits = np.column_stack([scaled @ rows.T, np.zeros(len(scaled))])
        logits -= logits.max(axis=1, keepdims=True)
        probability = np.exp(logits)
        probability /= probability.sum(axis=1, keepdims=True)
        value = -float(np.sum(weight * np.log(np.maximum(probability[is_class], 1e-300))))
        slope = (weight[:, None] * (probability - is_class))[:, :2].T @ scaled
        return value + RIDGE * float(flat @ flat), slope.ravel() + 2.0 * RIDGE * flat

    found = minimize(loss, np.zeros(2 * features.shape[1]), jac=True, method="L-BFGS-B", options={"maxiter": 2000})
    return np.asarray(found.x.reshape(2, -1) / scale)


def _report(examples: list[ComponentOdds]) -> list[str]:
    """Cross-validated: numbers, and how often places are told apart."""
    order = np.random.default_rng(0).permutation(len(examples))
    odds, classes = [], []
    for fold in range(FOLDS):
        held = [examples[k] for k in order[fold::FOLDS]]
        fitted = [examples[k] for k in order if k not in order[fold::FOLDS]]
        weights = _fitted(*_joined(fitted))
        features, kinds = _joined(held)
        odds.append(PlaceOdds(features @ weights[0], features @ weights[1]).log_odds)
        classes.append(kinds)
    scores, kinds = np.concatenate(odds), np.concatenate(classes)
    lines = [f"{len(examples)} assemblies; present, absent, occluded: {np.bincount(kinds, minlength=3).tolist()}"]
    for limit in (1.0, 1.8, 3.0):
        above = [100.0 * np.mean(scores[kinds == kind] > limit) for kind in (PRESENT, ABSENT, OCCLUDED)]
        below = [100.0 * np.mean(scores[kinds == kind] < -limit) for kind in (PRESENT, ABSENT, OCCLUDED)]
        lines.append(
            f"log odds > {limit}: {above[0]:.2f} % of the present, {above[1]:.1f} % of the absent, {above[2]:.1f} % of "
            f"the occluded; < -{limit}: {below[0]:.1f}, {below[1]:.2f}, {below[2]:.1f} %"
        )
    return lines
