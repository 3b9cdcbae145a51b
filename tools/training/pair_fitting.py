"""Fitting the network that tells twins apart to examples."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.detection.scoring.pair_comparator import PAIR_CHANNELS, PAIR_SIDE_PX
from networks.layers import exported, halving, normalised, write
from networks.net2net import torch_with_onnx
from networks.score_nets import fit
from pair_examples import Twins
from pose_verifier_fitting import network_input
from profile_ranker_examples import read_examples

WIDTHS, PAIR_WIDTHS = (16, 24, 32, 32), (32, 48, 48)
"""Of the convolutions that see one pose, every other halving the picture, and of those that see two at once."""
LAST_WIDTH, DROPPED = 32, 0.2
PICTURES, POSES = 6, 5
"""A step looks at so many poses of so many pictures, at most half of them right."""
RATE, DECAY = 2e-3, 2e-2
HELD_OUT = 8
"""Every so manieth solid is not fitted to, but for telling how well others are told apart."""
SURFACE = slice(6, 10)
"""Channels with the surface's normal and depth."""
LEAST_APART = (0.2, 0.2, 0.2, 0.03)
"""Where these of two poses differ by less they show the same; by twice as much, they differ altogether."""
LEADS = (0.0, 0.2, 0.4, 0.8, 1e3)
"""Weights of what verifier and others say of each pose beside what the network says of two."""


def fit_twins(folder: Path, epochs: int) -> None:
    """Fit the network to the twins in a folder, write twins.onnx there, and say how well it does.

    Args:
        folder: with twins, see `collect_twins`.
        epochs: how often each picture is looked at.

    Raises:
        InputError: no examples, or no torch or onnx.
    """
    torch = torch_with_onnx()
    fitted, left = read_examples(folder, "twins_*.pkl", HELD_OUT)
    torch.manual_seed(0)
    network = twin_network(torch).train().to(memory_format=torch.channels_last)

    def shown(some: NDArray[np.intp], rng: np.random.Generator) -> Any:
        seen, rights, wrongs, count = [], [], [], 0
        for twins in (fitted[i] for i in some):
            index = _chosen(twins, rng)
            seen.append(network_input(twins, index, rng)[0])
            right = twins.is_right[index]
            pairs = [(count + a, count + b) for a in np.flatnonzero(right) for b in np.flatnonzero(~right)]
            rights += [a for a, _ in pairs]
            wrongs += [b for _, b in pairs]
            count += len(index)
        looks = torch.from_numpy(np.concatenate(seen)).contiguous(memory_format=torch.channels_last)
        return looks, torch.tensor(rights), torch.tensor(wrongs)

    def loss_of(some: Any) -> Any:
        with torch.autocast("cpu", torch.bfloat16):
            leads = network(*some).float()
        return torch.nn.functional.softplus(-leads).mean()

    fit("twins", network.parameters(), (len(fitted), PICTURES, epochs), RATE, DECAY, shown, loss_of, torch)
    network.eval()
    _report(network, left, torch)
    example = {
        "seen": torch.zeros(3, PAIR_CHANNELS, PAIR_SIDE_PX, PAIR_SIDE_PX),
        "one": torch.tensor([0, 1]),
        "other": torch.tensor([2, 2]),
    }
    varying = {"seen": {0: "poses"}, **{name: {0: "pairs"} for name in ("one", "other", "lead")}}
    write(exported(network, example, "lead", varying, torch), folder / "twins.onnx")


def twin_network(torch: Any) -> Any:
    """A network that is shown poses (N,PAIR_CHANNELS,S,S), and says of pairs of them (P,) how likely it is the one."""
    nn = torch.nn

    class _TwinNetwork(nn.Module):  # type: ignore[misc, name-defined]
        def __init__(self) -> None:
            super().__init__()
            self.alone = nn.Sequential(*halving(PAIR_CHANNELS, WIDTHS, (), torch))
            self.register_buffer("least_apart", torch.tensor(LEAST_APART).reshape(4, 1, 1))
            first, second, third = PAIR_WIDTHS
            self.paired = nn.Sequential(
                *normalised(2 * WIDTHS[-1], first, 1, 1, torch), nn.ReLU(),
                *normalised(first, second, 3, 2, torch), nn.ReLU(),
                *normalised(second, third, 3, 1, torch), nn.ReLU(),
            )  # fmt: skip
            self.together = nn.Sequential(
                nn.Linear(2 * third + 1, LAST_WIDTH), nn.ReLU(), nn.Dropout(DROPPED), nn.Linear(LAST_WIDTH, 1)
            )

        def forward(self, seen: Any, one: Any, other: Any) -> Any:
            features, surface = self.alone(seen), seen[:, SURFACE]
            apart = (surface[one] - surface[other]).abs() / self.least_apart
            apart = (apart.amax(1, keepdim=True) - 1.0).clamp(0.0, 1.0)
            apart = nn.functional.max_pool2d(apart, 8)
            # All at once, both ways round: of pairs that are all right before wrong normalisation alone would tell.
            a, b, apart = torch.cat([one, other]), torch.cat([other, one]), torch.cat([apart, apart])
            hidden = self.paired(torch.cat([features[a], features[b]], 1)) * apart
            count = apart.sum((2, 3))
            pooled = [hidden.sum((2, 3)) / (count + 1.0), hidden.amax((2, 3)), (count + 1.0).log() / 4.0]
            worth = self.together(torch.cat(pooled, 1))[:, 0]
            forth, back = worth.chunk(2)
            return forth - back

    return _TwinNetwork()


def _chosen(twins: Twins, rng: np.random.Generator) -> NDArray[np.intp]:
    """Some poses of a picture, right and wrong."""
    right, wrong = (rng.permutation(np.flatnonzero(group)) for group in (twins.is_right, ~twins.is_right))
    right = right[: POSES // 2]
    return np.concatenate([right, wrong[: POSES - len(right)]])


def _report(network: Any, examples: Sequence[Twins], torch: Any) -> None:
    """Say in how many pictures a right pose is ahead of all others."""
    matrices = []
    for twins in examples:
        count = len(twins.logits)
        one, other = np.triu_indices(count, 1)
        leads = np.zeros((count, count))
        with torch.no_grad():
            seen = network_input(twins, range(count), None)[0]
            leads[one, other] = network(*map(torch.from_numpy, (seen, one, other))).numpy()
        matrices.append((leads - leads.T, twins.logits[:, None] - twins.logits, twins.is_right))
    pairs = np.concatenate([found[right][:, ~right].ravel() for found, _, right in matrices])
    print(f"other solids: {np.mean(pairs > 0):.1%} of {len(pairs)} pairs, loss {np.logaddexp(0.0, -pairs).mean():.3f}")
    for weight in LEADS:
        first = sum(bool(right[np.argmax((found + weight * lead).sum(axis=1))]) for found, lead, right in matrices)
        print(f"  leads count {weight}: a right pose first in {first} of {len(matrices)} pictures")
