"""Training of the presence net."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.assembly.presence_net import GLOBALS, SIDE_PX, global_inputs
from arview.detection.scoring.crops import CROP_CHANNELS, RESPONSE_CHANNELS
from networks.net2net import torch_with_onnx
from networks.score_nets import (
    NetworkInputs,
    ScoreNetDesign,
    concatenated,
    half_precision_scores,
    train,
    train_score_net,
)
from pose_verifier_fitting import network_input
from presence_net_examples import ComponentCrops
from profile_ranker_examples import read_examples

DESIGN = ScoreNetDesign(
    "presence_net",
    (CROP_CHANNELS + RESPONSE_CHANNELS, SIDE_PX, SIDE_PX),
    GLOBALS,
    (24, 24, 48, 48, 64, 64),
    deepened=(3, 5),
    rate=2e-3,
)
BATCH = 128
DECAY = 2e-2
INITIAL_COMPONENTS = 8
"""Components of a picture from which continued training is initialised."""
HELD_OUT = 8
"""One assembly in this many is held out for the report."""
FALSE_POSITIVE_RATES = (0.002, 0.005, 0.01, 0.03)
"""False positive rates for which the report states recall: the share of right components called wrong."""


def fit_presence_net(folder: Path, epochs: int, from_scratch: bool = True) -> None:
    """Train the network on the crops in a folder, write presence_net.onnx there, and report its quality.

    Right and wrong components have the same total weight, so that the score is a log likelihood ratio.

    Args:
        folder: with crops, see `collect_components`.
        epochs: passes over the crops.
        from_scratch: False continues from the network in the package.

    Raises:
        InputError: no examples, or no torch or onnx.
    """
    torch = torch_with_onnx()
    fitted, held_out = read_examples(folder, "components_*.pkl", HELD_OUT)
    train_score_net(
        DESIGN, folder, fitted, from_scratch, _augmented_inputs,
        lambda network, rate: _fit(network, fitted, epochs, rate, torch),
        lambda network: _report(network, held_out, torch),
        torch,
    )  # fmt: skip


def _fit(network: Any, examples: Sequence[ComponentCrops], epochs: int, rate: float, torch: Any) -> None:
    places = [(example, k) for example in examples for k in range(len(example.is_wrong))]
    share = float(np.mean([example.is_wrong[k] for example, k in places]))

    def batch_of(some: NDArray[np.intp], rng: np.random.Generator) -> Any:
        chosen = [places[i] for i in some]
        wrong = np.array([float(example.is_wrong[index]) for example, index in chosen], dtype=np.float32)
        return *concatenated(_inputs(example, [index], rng) for example, index in chosen), wrong

    def loss_of(some: Any) -> Any:
        maps, scalars, is_wrong = some
        scores = half_precision_scores(network, maps, scalars, torch)
        wrong = torch.from_numpy(is_wrong)
        weight = torch.where(wrong > 0, 0.5 / share, 0.5 / (1.0 - share))
        return torch.nn.functional.binary_cross_entropy_with_logits(scores, wrong, weight)

    train("presence net", network.parameters(), (len(places), BATCH, epochs), rate, DECAY, batch_of, loss_of, torch)


def _augmented_inputs(example: ComponentCrops, rng: np.random.Generator) -> NetworkInputs:
    return _inputs(example, range(min(INITIAL_COMPONENTS, len(example.is_wrong))), rng)


def _inputs(example: ComponentCrops, index: Sequence[int], rng: np.random.Generator | None = None) -> NetworkInputs:
    """Network inputs of some crops of a picture, augmented if ``rng`` is given."""
    maps, contrasts, explained = network_input(example, index, rng)
    sizes_px = [float(example.sizes_px[k]) for k in index]
    return maps, np.stack([global_inputs(*of) for of in zip(sizes_px, contrasts, explained, strict=True)])


def _report(network: Any, examples: Sequence[ComponentCrops], torch: Any) -> None:
    """Print the share of wrong components found at some false positive rates."""
    scores, wrong = [np.zeros(0)], [np.zeros(0, dtype=bool)]
    for example in examples:
        with torch.no_grad():
            scores.append(network(*map(torch.from_numpy, _inputs(example, range(len(example.is_wrong))))).numpy())
        wrong.append(example.is_wrong)
    score, is_wrong = np.concatenate(scores), np.concatenate(wrong)
    if is_wrong.all() or not is_wrong.any():
        return
    print(f"other assemblies: {is_wrong.sum()} wrong and {(~is_wrong).sum()} right components")
    for share in FALSE_POSITIVE_RATES:
        threshold = np.quantile(score[~is_wrong], 1.0 - share)
        print(
            f"  {np.mean(score[is_wrong] > threshold):.0%} of the wrong ones score above {1.0 - share:.1%} of the right"
        )
