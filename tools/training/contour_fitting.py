"""Training of the contour verifier.

Two losses are added: that of the scores of the network alone, and that of their sum with the weighted scores that are
known before. By the second alone the network learns little, since the known scores explain most labels.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.detection.confidence import confidence_weights
from arview.detection.scoring.contour_verifier import (
    CHANNELS,
    COLUMNS,
    CONTOUR_SCALARS,
    OUTLINE_ROWS,
    ROWS,
    network_input,
)
from contour_examples import ContourProfiles
from networks.net2net import torch_with_onnx
from networks.score_nets import (
    NetworkInputs,
    ScoreNetDesign,
    concatenated,
    half_precision_scores,
    ranking_loss,
    train,
    train_score_net,
)
from profile_ranker_examples import read_examples

DESIGN = ScoreNetDesign(
    "contour_verifier", (CHANNELS, ROWS, COLUMNS), CONTOUR_SCALARS, (24, 24, 48, 48, 64), deepened=(3,), rate=2e-3
)
PICTURES, POSES = 8, 12
"""Pictures of a batch, and poses of each."""
LISTWISE_WEIGHT = 0.5
"""Weight of the ranking inside each picture, beside the classification over all pictures."""
INITIAL_WEIGHTS = (1.0, *confidence_weights().verified[:3])
"""Initial weights of the known scores, to which the network adds."""
DECAY = 2e-2
WEAKENED_SHARE = 0.3
"""Share of the pictures with weakened edge-response maps, and with a weakened map of the solids alone."""
HELD_OUT = 8
"""One solid in this many is held out for the report."""
FALSE_ALARM_RATES = (0.0, 0.01, 0.02, 0.05)
"""Rates of false alarms for which the report states detections."""


def fit_contour_verifier(folder: Path, epochs: int, from_scratch: bool = True) -> None:
    """Train the network on the contour profiles in a folder, write contour_verifier.onnx there, and report its quality.

    Args:
        folder: with contour profiles, see `collect_contours`.
        epochs: passes over the pictures.
        from_scratch: False continues from the network in the package.

    Raises:
        InputError: no examples, or no torch or onnx.
    """
    torch = torch_with_onnx()
    examples, held_out = read_examples(folder, "contours_*.pkl", HELD_OUT)
    fitted = [example for example in examples if example.is_known.any()]
    train_score_net(
        DESIGN, folder, fitted, from_scratch, _augmented_inputs,
        lambda network, rate: _fit(network, fitted, epochs, rate, torch),
        lambda network: _report(network, held_out, torch),
        torch,
    )  # fmt: skip


def _fit(network: Any, examples: Sequence[ContourProfiles], epochs: int, rate: float, torch: Any) -> None:
    others = torch.nn.Linear(len(INITIAL_WEIGHTS), 1)
    with torch.no_grad():
        others.weight.copy_(torch.tensor([INITIAL_WEIGHTS]))
        others.bias.zero_()

    def batch_of(some: NDArray[np.intp], rng: np.random.Generator) -> Any:
        chosen = [(examples[i], _chosen(examples[i], rng)) for i in some]
        known = torch.from_numpy(np.concatenate([example.known[index] for example, index in chosen]).astype(np.float32))
        truth = [torch.from_numpy(example.is_right[index]) for example, index in chosen]
        return *concatenated(_inputs(example, index, rng) for example, index in chosen), known, truth

    def loss_of(some: Any) -> Any:
        maps, scalars, known, truth = some
        alone = half_precision_scores(network, maps, scalars, torch)
        beside = alone + others(known)[:, 0]
        return sum(ranking_loss(scores, truth, LISTWISE_WEIGHT / PICTURES, torch) for scores in (alone, beside))

    weights = [*network.parameters(), *others.parameters()]
    train("contour verifier", weights, (len(examples), PICTURES, epochs), rate, DECAY, batch_of, loss_of, torch)


def _augmented_inputs(example: ContourProfiles, rng: np.random.Generator) -> NetworkInputs:
    return _inputs(example, _chosen(example, rng), rng)


def _chosen(example: ContourProfiles, rng: np.random.Generator) -> list[int]:
    """Indices of some poses of a picture whose labels are known."""
    index = np.flatnonzero(example.is_known)
    return sorted(rng.permutation(index)[:POSES].tolist())


def _inputs(example: ContourProfiles, index: Sequence[int], rng: np.random.Generator | None = None) -> NetworkInputs:
    """Network inputs of some poses of a picture, augmented if ``rng`` is given."""
    profiles = example.profiles[list(index)]
    if rng is not None:
        profiles = augmented(profiles, rng)
    maps, scalars = zip(
        *(network_input(raw, float(example.radii_px[k])) for raw, k in zip(profiles, index, strict=True)), strict=True
    )
    return np.stack(maps), np.stack(scalars)


def augmented(profiles: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Contour profiles (N,RAW,ROWS,COLUMNS) after random flips, changes of colour, blur, noise and occlusion."""
    profiles = profiles.copy()
    outline, inner = profiles[:, :, :OUTLINE_ROWS], profiles[:, :, OUTLINE_ROWS:]
    for block in (outline, inner):
        if rng.random() < 0.5:
            block[:] = block[:, :, ::-1].copy()
    outline[:] = np.roll(outline, rng.integers(OUTLINE_ROWS), axis=2)
    # The two sides of a design edge are interchangeable.
    if rng.random() < 0.5:
        inner[:] = inner[..., ::-1].copy()
    profiles[:, :3] = profiles[:, rng.permutation(3)]
    inside = profiles[:, 3:4] > 0
    colours = profiles[:, :3].astype(np.float32)
    if rng.random() < 0.25:
        colours += rng.uniform(0.5, 1.0) * (colours.mean(axis=1, keepdims=True) - colours)
    if rng.random() < 0.3:
        colours = (colours - 128.0) * rng.uniform(0.4, 1.3) + 128.0 + rng.uniform(-30.0, 30.0)
    if rng.random() < 0.25:
        width = rng.uniform(0.5, 2.0)
        for planes in colours:
            for plane in planes:
                plane[:] = cv2.GaussianBlur(np.ascontiguousarray(plane), (9, 1), width)
    if rng.random() < 0.4:
        # Two samples per pixel: their noise is correlated.
        noise = rng.standard_normal(colours.shape, dtype=np.float32)
        noise[..., 1:] = 0.7 * (noise[..., 1:] + noise[..., :-1])
        colours += rng.uniform(0.0, 8.0) * noise
    if rng.random() < 0.3:
        first, count = rng.integers(OUTLINE_ROWS), rng.integers(6, 36)
        rows = (first + np.arange(count)) % OUTLINE_ROWS
        colours[:, :, rows] = rng.uniform(0.0, 255.0, (1, 3, 1, 1))
        profiles[:, 4:7, rows] = 0
    profiles[:, :3] = np.where(inside, np.clip(np.round(colours), 0.0, 255.0), 0.0).astype(np.uint8)
    for channels in (slice(4, 7), slice(6, 7)):
        if rng.random() < WEAKENED_SHARE:
            profiles[:, channels] = (profiles[:, channels] * rng.uniform(0.0, 1.0)).astype(np.uint8)
    return profiles


def _report(network: Any, examples: Sequence[ContourProfiles], torch: Any) -> None:
    """Print how often a right pose is first in its picture, and detections at some rates of false alarms."""
    for weight in (0.0, 0.5, 1.0, 1.5):
        scores_with, scores_without, ranked_first, ranked = [], [], 0, 0
        for example in examples:
            found = np.flatnonzero(example.is_known & ~example.is_from_truth)
            if not len(found):
                continue
            scores = example.known[found] @ np.array(INITIAL_WEIGHTS)
            if weight:
                with torch.no_grad():
                    scores += weight * network(*map(torch.from_numpy, _inputs(example, found.tolist()))).numpy()
            right = example.is_right[found]
            if not example.has_part:
                scores_without.append(scores.max())
            elif right.any():
                scores_with.append(scores[right].max())
                ranked_first += bool(right[np.argmax(scores)])
                ranked += 1
        print(
            f"other solids, weight of the network {weight}: a right pose first in {ranked_first} of {ranked} pictures"
        )
        highest = np.sort(scores_without)[::-1]
        for share in FALSE_ALARM_RATES if len(highest) else ():
            found = np.mean(np.array(scores_with) > highest[int(share * len(highest))])
            print(f"  {found:.1%} found with {share:.0%} false alarms, of {len(highest)} without it")
