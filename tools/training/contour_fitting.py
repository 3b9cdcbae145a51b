"""Fitting the network that looks at strips to examples.

It is fitted to tell right poses by what it sees alone, and at once to say what is missing beside all that is known: by
the second alone it learned little, for the rest tells most. On 204 solids 14 epochs are enough: 11 more tell other
solids' poses better and those of the recordings, of real materials, worse.
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
from contour_examples import Stripped
from networks.net2net import torch_with_onnx
from networks.score_nets import Design, Shown, fit, fit_score_network, scored, telling_loss, together
from profile_ranker_examples import read_examples

DESIGN = Design("strips", (CHANNELS, ROWS, COLUMNS), CONTOUR_SCALARS, (24, 24, 48, 48, 64), deepened=(3,), rate=2e-3)
PICTURES, POSES = 8, 12
"""A step looks at so many poses of so many pictures."""
LISTWISE_WEIGHT = 0.5
"""Beside telling right from wrong in all pictures, the right pose of each is to be told from its others."""
OTHERS = (1.0, *confidence_weights().verified[:3])
"""What else is known counts so at first: the network is to say what is missing."""
DECAY = 2e-2
UNSURE = 0.3
"""Share of pictures in which the line network sees less, and as many in which it sees less of solids."""
HELD_OUT = 8
"""Every so manieth solid is not fitted to, but for telling how well others are told."""
FALSE_SHARES = (0.0, 0.01, 0.02, 0.05)
"""Shares of false alarms to say the found ones for."""


def fit_strips(folder: Path, epochs: int, is_anew: bool = True) -> None:
    """Fit the network to the strips in a folder, write strips.onnx there, and say how well it does.

    Args:
        folder: with strips, see `collect_strips`.
        epochs: how often each picture is looked at.
        is_anew: not going on from the network in use.

    Raises:
        InputError: no examples, or no torch or onnx.
    """
    torch = torch_with_onnx()
    examples, left = read_examples(folder, "strips_*.pkl", HELD_OUT)
    fitted = [one for one in examples if one.is_told.any()]
    fit_score_network(
        DESIGN, folder, fitted, is_anew, _altered,
        lambda network, rate: _fit(network, fitted, epochs, rate, torch),
        lambda network: _report(network, left, torch),
        torch,
    )  # fmt: skip


def _fit(network: Any, examples: Sequence[Stripped], epochs: int, rate: float, torch: Any) -> None:
    others = torch.nn.Linear(len(OTHERS), 1)
    with torch.no_grad():
        others.weight.copy_(torch.tensor([OTHERS]))
        others.bias.zero_()

    def shown_of(some: NDArray[np.intp], rng: np.random.Generator) -> Any:
        chosen = [(examples[i], _chosen(examples[i], rng)) for i in some]
        known = torch.from_numpy(np.concatenate([one.known[index] for one, index in chosen]).astype(np.float32))
        truth = [torch.from_numpy(one.is_right[index]) for one, index in chosen]
        return *together(_inputs(one, index, rng) for one, index in chosen), known, truth

    def loss_of(some: Any) -> Any:
        seen, told, known, truth = some
        alone = scored(network, seen, told, torch)
        beside = alone + others(known)[:, 0]
        return sum(telling_loss(scores, truth, LISTWISE_WEIGHT / PICTURES, torch) for scores in (alone, beside))

    weights = [*network.parameters(), *others.parameters()]
    fit("strips", weights, (len(examples), PICTURES, epochs), rate, DECAY, shown_of, loss_of, torch)


def _altered(one: Stripped, rng: np.random.Generator) -> Shown:
    return _inputs(one, _chosen(one, rng), rng)


def _chosen(one: Stripped, rng: np.random.Generator) -> list[int]:
    """Some poses of a picture of which it is known whether they are right."""
    index = np.flatnonzero(one.is_told)
    return sorted(rng.permutation(index)[:POSES].tolist())


def _inputs(one: Stripped, index: Sequence[int], rng: np.random.Generator | None = None) -> Shown:
    """Poses of a picture as the network takes them; with random numbers altered."""
    strips = one.strips[list(index)]
    if rng is not None:
        strips = altered(strips, rng)
    seen, told = zip(
        *(network_input(raw, float(one.radii_px[k])) for raw, k in zip(strips, index, strict=True)), strict=True
    )
    return np.stack(seen), np.stack(told)


def altered(strips: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """The strips (N,RAW,ROWS,COLUMNS) of one picture turned round, recoloured, blurred, noisier, or hidden in part."""
    strips = strips.copy()
    outline, inner = strips[:, :, :OUTLINE_ROWS], strips[:, :, OUTLINE_ROWS:]
    for block in (outline, inner):
        if rng.random() < 0.5:
            block[:] = block[:, :, ::-1].copy()
    outline[:] = np.roll(outline, rng.integers(OUTLINE_ROWS), axis=2)
    # Which side of a design edge is which is arbitrary.
    if rng.random() < 0.5:
        inner[:] = inner[..., ::-1].copy()
    strips[:, :3] = strips[:, rng.permutation(3)]
    inside = strips[:, 3:4] > 0
    colours = strips[:, :3].astype(np.float32)
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
        # Samples lie twice as close as pixels: their noise is smooth.
        noise = rng.standard_normal(colours.shape, dtype=np.float32)
        noise[..., 1:] = 0.7 * (noise[..., 1:] + noise[..., :-1])
        colours += rng.uniform(0.0, 8.0) * noise
    if rng.random() < 0.3:
        first, count = rng.integers(OUTLINE_ROWS), rng.integers(6, 36)
        rows = (first + np.arange(count)) % OUTLINE_ROWS
        colours[:, :, rows] = rng.uniform(0.0, 255.0, (1, 3, 1, 1))
        strips[:, 4:7, rows] = 0
    strips[:, :3] = np.where(inside, np.clip(np.round(colours), 0.0, 255.0), 0.0).astype(np.uint8)
    for channels in (slice(4, 7), slice(6, 7)):
        if rng.random() < UNSURE:
            strips[:, channels] = (strips[:, channels] * rng.uniform(0.0, 1.0)).astype(np.uint8)
    return strips


def _report(network: Any, examples: Sequence[Stripped], torch: Any) -> None:
    """Say in how many pictures a right pose is first, and ahead of those of pictures without the solid."""
    for weight in (0.0, 0.5, 1.0, 1.5):
        with_it, without, first, first_of = [], [], 0, 0
        for one in examples:
            found = np.flatnonzero(one.is_told & ~one.is_given)
            if not len(found):
                continue
            scores = one.known[found] @ np.array(OTHERS)
            if weight:
                with torch.no_grad():
                    scores += weight * network(*map(torch.from_numpy, _inputs(one, found.tolist()))).numpy()
            right = one.is_right[found]
            if not one.has_part:
                without.append(scores.max())
            elif right.any():
                with_it.append(scores[right].max())
                first += bool(right[np.argmax(scores)])
                first_of += 1
        print(f"other solids, strips count {weight}: a right pose first in {first} of {first_of} pictures")
        highest = np.sort(without)[::-1]
        for share in FALSE_SHARES if len(highest) else ():
            told = np.mean(np.array(with_it) > highest[int(share * len(highest))])
            print(f"  {told:.1%} found with {share:.0%} false alarms, of {len(highest)} without it")
