"""Fitting the component network to examples."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.assembly.presence_net import GLOBALS, SIDE_PX, global_inputs
from arview.detection.scoring.crops import CROP_CHANNELS, RESPONSE_CHANNELS
from networks.net2net import torch_with_onnx
from networks.score_nets import Design, Shown, fit, fit_score_network, scored, together
from pose_verifier_fitting import network_input
from presence_net_examples import Looked
from profile_ranker_examples import read_examples

DESIGN = Design(
    "components",
    (CROP_CHANNELS + RESPONSE_CHANNELS, SIDE_PX, SIDE_PX),
    GLOBALS,
    (24, 24, 48, 48, 64, 64),
    deepened=(3, 5),
    rate=2e-3,
)
BATCH = 128
DECAY = 2e-2
SEEN_OF_EACH = 8
"""Components of a picture in which a network that is gone on with sees how it is to begin."""
HELD_OUT = 8
"""Every so manieth assembly is not fitted to, but for telling how well others are seen."""
FALSE_SHARES = (0.002, 0.005, 0.01, 0.03)
"""Shares of right components that are said to be wrong, to say the wrong ones that are for."""


def fit_components(folder: Path, epochs: int, is_anew: bool = True) -> None:
    """Fit the network to the looks in a folder, write components.onnx there, and say how well it does.

    Wrong and right ones count alike in all, so that the score is a log-likelihood ratio.

    Args:
        folder: with looks, see `collect_components`.
        epochs: how often each is looked at.
        is_anew: not going on from the network in use.

    Raises:
        InputError: no examples, or no torch or onnx.
    """
    torch = torch_with_onnx()
    fitted, left = read_examples(folder, "components_*.pkl", HELD_OUT)
    fit_score_network(
        DESIGN, folder, fitted, is_anew, _altered,
        lambda network, rate: _fit(network, fitted, epochs, rate, torch),
        lambda network: _report(network, left, torch),
        torch,
    )  # fmt: skip


def _fit(network: Any, examples: Sequence[Looked], epochs: int, rate: float, torch: Any) -> None:
    places = [(one, k) for one in examples for k in range(len(one.is_wrong))]
    share = float(np.mean([one.is_wrong[k] for one, k in places]))

    def shown(some: NDArray[np.intp], rng: np.random.Generator) -> Any:
        chosen = [places[i] for i in some]
        wrong = torch.tensor([float(one.is_wrong[index]) for one, index in chosen])
        return *together(_inputs(one, [index], rng) for one, index in chosen), wrong

    def loss_of(some: Any) -> Any:
        seen, both, wrong = some
        weight = torch.where(wrong > 0, 0.5 / share, 0.5 / (1.0 - share))
        found = scored(network, seen, both, torch)
        return torch.nn.functional.binary_cross_entropy_with_logits(found, wrong, weight)

    fit("components", network.parameters(), (len(places), BATCH, epochs), rate, DECAY, shown, loss_of, torch)


def _altered(one: Looked, rng: np.random.Generator) -> Shown:
    return _inputs(one, range(min(SEEN_OF_EACH, len(one.is_wrong))), rng)


def _inputs(one: Looked, index: Sequence[int], rng: np.random.Generator | None = None) -> Shown:
    """Looks as the network takes them; with random numbers altered."""
    shown, contrasts, explained = network_input(one, index, rng)
    sizes_px = [float(one.sizes_px[k]) for k in index]
    return shown, np.stack([global_inputs(*of) for of in zip(sizes_px, contrasts, explained, strict=True)])


def _report(network: Any, examples: Sequence[Looked], torch: Any) -> None:
    """Say how many wrong components score higher than all but a share of the right ones."""
    scores, wrong = [np.zeros(0)], [np.zeros(0, dtype=bool)]
    for one in examples:
        with torch.no_grad():
            scores.append(network(*map(torch.from_numpy, _inputs(one, range(len(one.is_wrong))))).numpy())
        wrong.append(one.is_wrong)
    score, is_wrong = np.concatenate(scores), np.concatenate(wrong)
    if is_wrong.all() or not is_wrong.any():
        return
    print(f"other assemblies: {is_wrong.sum()} wrong and {(~is_wrong).sum()} right components")
    for share in FALSE_SHARES:
        least = np.quantile(score[~is_wrong], 1.0 - share)
        print(f"  {np.mean(score[is_wrong] > least):.0%} of the wrong ones score above {1.0 - share:.1%} of the right")
