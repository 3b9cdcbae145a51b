"""Networks that score a look, of verifier, strips and components: how they are made, gone on with, and written."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from networks.layers import exported, halfway, halving, write
from networks.net2net import GONE_ON, begin_as, beginning_as, in_use
from networks.prefetch import made_ahead

LAST_WIDTH, DROPPED = 48, 0.2
Example = TypeVar("Example")
Shown = tuple[NDArray[np.float32], NDArray[np.float32]]
"""Looks (N,C,H,W), and what else the network is told of them (N,G)."""
BEGUN = 60
"""In so many examples a network that is gone on with sees how it is to begin."""


@dataclass(frozen=True)
class Design:
    """What a network that scores looks is like.

    Attributes:
        name: of its file, less the suffix.
        shape: (channels, rows, columns) of a look.
        told: what else it is told of one.
        widths: of its convolutions; a residual block follows those in ``deepened``.
        rate: at which it is fitted anew.
    """

    name: str
    shape: tuple[int, int, int]
    told: int
    widths: tuple[int, ...]
    deepened: tuple[int, ...]
    rate: float


def fit_score_network(
    design: Design,
    folder: Path,
    fitted: Sequence[Example],
    is_anew: bool,
    altered: Callable[[Example, np.random.Generator], Shown],
    fit_at: Callable[[Any, float], None],
    report: Callable[[Any], None],
    torch: Any,
) -> None:
    """Fit a network, say how well it does, and write it to a folder.

    One that is gone on with is written halfway between where it began and where the fit ended: what is gone on with is
    fitted to fewer examples than before, and forgets some of the others, real ones among them (Wortsman et al., "Robust
    fine-tuning of zero-shot models", CVPR 2022).

    Args:
        design: of the network.
        folder: to write it to.
        fitted: examples.
        is_anew: not going on from the network in use.
        altered: what networks are shown of an example in fitting.
        fit_at: fits a network at a rate.
        report: says how well it does; of one that is gone on with, at the fit's end.
        torch: the module.

    Raises:
        InputError: not anew, and the network in use is of another kind.
    """
    torch.manual_seed(0)
    network = score_network(torch, design.shape[0], design.told, design.widths, design.deepened)
    begun = None
    if not is_anew:
        rng = np.random.default_rng(0)
        some = [altered(fitted[i], rng)[0] for i in rng.integers(len(fitted), size=BEGUN)]
        go_on_from(network, in_use(f"{design.name}.onnx"), np.concatenate(some), torch)
        begun = _exported(network, design, torch)
    network.train().to(memory_format=torch.channels_last)
    fit_at(network, design.rate if is_anew else GONE_ON * design.rate)
    network.eval()
    report(network)
    ended = _exported(network, design, torch)
    write(ended if begun is None else halfway(begun, ended), folder / f"{design.name}.onnx")


def together(looks: Iterable[Shown]) -> Shown:
    """What a network is shown of some examples, as one."""
    seen, told = map(np.concatenate, zip(*looks, strict=True))
    return seen, told


def score_network(torch: Any, channels: int, told: int, widths: tuple[int, ...], deepened: Collection[int] = ()) -> Any:
    """A network shown so many channels and told of so many things; every other convolution halves the picture.

    Args:
        torch: the module.
        channels, told: of a look.
        widths: of the convolutions.
        deepened: a residual block follows these of them.
    """
    nn = torch.nn

    class _Network(nn.Module):  # type: ignore[misc, name-defined]
        def __init__(self) -> None:
            super().__init__()
            self.convolutions = nn.Sequential(*halving(channels, widths, deepened, torch))
            self.together = nn.Sequential(
                nn.Linear(2 * widths[-1] + told, LAST_WIDTH), nn.ReLU(), nn.Dropout(DROPPED), nn.Linear(LAST_WIDTH, 1)
            )

        def forward(self, seen: Any, both: Any) -> Any:
            hidden = self.convolutions(seen)
            return self.together(torch.cat([hidden.mean((2, 3)), hidden.amax((2, 3)), both], 1))[:, 0]

    return _Network()


def fit(
    name: str,
    weights: Iterable[Any],
    steps: tuple[int, int, int],
    rate: float,
    decay: float,
    shown: Callable[[NDArray[np.intp], np.random.Generator], Any],
    loss_of: Callable[[Any], Any],
    torch: Any,
) -> None:
    """Bring a loss down by weights, and say after each epoch how far.

    Args:
        name: to say of what.
        weights: of the network, and of what else is fitted.
        steps: examples, how many of them a step takes, and how often each is taken.
        rate, decay: the highest rate, reached soon and gone at the end; of the weights.
        shown: what of some examples, by their numbers, is looked at, with random numbers to alter it by; made while
            the step before is taken.
        loss_of: of that.
        torch: the module.
    """
    count, at_once, epochs = steps
    weights = list(weights)
    optimiser = torch.optim.AdamW(weights, rate, weight_decay=decay)
    each = max(1, count // at_once)
    total = epochs * each
    rising = max(0.05, 2.0 / total)  # of one step alone torch divides by zero
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=total, pct_start=min(rising, 1.0))
    rng, altering = (np.random.default_rng([0, k]) for k in range(2))
    orders = [rng.permutation(count) for _ in range(epochs)]

    def made(step: int) -> Any:
        epoch, k = divmod(step, each)
        return shown(orders[epoch][k * at_once : (k + 1) * at_once], altering)

    following = made_ahead(made, total)
    for epoch in range(epochs):
        losses = []
        for some in islice(following, each):
            loss = loss_of(some)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            losses.append(loss.item())
        print(f"{name}, epoch {epoch + 1} of {epochs}: loss {np.mean(losses):.3f}", flush=True)


def scored(network: Any, seen: NDArray[np.float32], told: NDArray[np.float32], torch: Any) -> Any:
    """Scores (N,) of looks while a network is fitted, in half precision."""
    with torch.autocast("cpu", torch.bfloat16):
        found = network(torch.from_numpy(seen).contiguous(memory_format=torch.channels_last), torch.from_numpy(told))
    return found.float()


def telling_loss(scores: Any, truth: Sequence[Any], listwise_weight: float, torch: Any) -> Any:
    """Loss of scores (N,) for telling right from wrong in all pictures, and the right one of each from its others.

    Args:
        scores: of the poses of some pictures, one after the other.
        truth: of each picture which of its poses (bool) are right.
        listwise_weight: of the latter beside the former, for each picture.
        torch: the module.
    """
    loss = torch.nn.functional.binary_cross_entropy_with_logits(scores, torch.cat(list(truth)).float())
    for some, right in zip(scores.split([len(part) for part in truth]), truth, strict=True):
        if right.any():
            loss = loss + listwise_weight * (some.logsumexp(0) - some[right].logsumexp(0))
    return loss


def go_on_from(network: Any, path: Path, seen: NDArray[np.float32], torch: Any) -> None:
    """Make a network do what a written one does that is as wide or narrower, see `begin_as`.

    Args:
        network: from `score_network`.
        path: of the written one.
        seen: (N,C,S,S) what networks are shown in fitting.
        torch: the module.

    Raises:
        InputError: the written one is shown something else, is wider, or has other blocks.
    """
    layers = begin_as(network, path, lambda: network.convolutions(torch.from_numpy(seen)), torch)
    with beginning_as(path), torch.no_grad():
        (weight, bias), (last_weight, last_bias) = layers["Gemm"]
        first, last = network.together[0], network.together[3]
        old = layers["Conv"][-1][0].shape[0]
        wide = (first.in_features - (weight.shape[1] - 2 * old)) // 2
        # Means, maxima, and what the network is told.
        first.weight.zero_()
        first.weight[:, :old] = weight[:, :old]
        first.weight[:, wide : wide + old] = weight[:, old : 2 * old]
        first.weight[:, 2 * wide :] = weight[:, 2 * old :]
        first.bias.copy_(bias)
        last.weight.copy_(last_weight)
        last.bias.copy_(last_bias)


def _exported(network: Any, design: Design, torch: Any) -> bytes:
    """A network that is shown any number of looks at once, in ONNX."""
    shown = {"seen": torch.zeros(2, *design.shape), "both": torch.zeros(2, design.told)}
    varying = {name: {0: "poses"} for name in (*shown, "score")}
    return exported(network.eval(), shown, "score", varying, torch)
