"""Training of the pair comparator."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.detection.scoring.pair_comparator import PAIR_CHANNELS, PAIR_SIDE_PX
from networks.layers import convolution_and_norm, onnx_model, strided_convolutions, write_model
from networks.net2net import torch_with_onnx
from networks.score_nets import train
from pair_examples import NearSymmetricPoses
from pose_verifier_fitting import network_input
from profile_ranker_examples import read_examples

WIDTHS, PAIR_WIDTHS = (16, 24, 32, 32), (32, 48, 48)
"""Channels of the convolutions for each pose, every other of stride 2, and of those for the pair."""
LAST_WIDTH, DROPOUT = 32, 0.2
PICTURES, POSES = 6, 5
"""Pictures of a batch and poses of each, of which at most half are right."""
RATE, DECAY = 2e-3, 2e-2
HELD_OUT = 8
"""One solid in this many is held out for the report."""
SURFACE = slice(6, 10)
"""Channels with the normal and the depth of the surface."""
MIN_DIFFERENCE = (0.2, 0.2, 0.2, 0.03)
"""Differences of normal and depth below which two poses agree at a pixel; at twice as much they fully differ."""
PAIR_WEIGHTS = (0.0, 0.2, 0.4, 0.8, 1e3)
"""Weights of the network beside the logits of the single poses, for the report."""


def fit_pair_comparator(folder: Path, epochs: int) -> None:
    """Train the network on the near-symmetric poses in a folder, write pair_comparator.onnx, and report its quality.

    Args:
        folder: with near-symmetric poses, see `collect_pairs`; the network is written there.
        epochs: passes over the pictures.

    Raises:
        InputError: no examples, or no torch or onnx.
    """
    torch = torch_with_onnx()
    fitted, held_out = read_examples(folder, "pairs_*.pkl", HELD_OUT)
    torch.manual_seed(0)
    network = make_pair_comparator(torch).train().to(memory_format=torch.channels_last)

    def batch_of(some: NDArray[np.intp], rng: np.random.Generator) -> Any:
        inputs, rights, wrongs, count = [], [], [], 0
        for example in (fitted[i] for i in some):
            index = _chosen(example, rng)
            inputs.append(network_input(example, index.tolist(), rng)[0])
            right = example.is_right[index]
            pairs = [(count + a, count + b) for a in np.flatnonzero(right) for b in np.flatnonzero(~right)]
            rights += [a for a, _ in pairs]
            wrongs += [b for _, b in pairs]
            count += len(index)
        maps = torch.from_numpy(np.concatenate(inputs)).contiguous(memory_format=torch.channels_last)
        return maps, torch.tensor(rights), torch.tensor(wrongs)

    def loss_of(some: Any) -> Any:
        with torch.autocast("cpu", torch.bfloat16):
            leads = network(*some).float()
        return torch.nn.functional.softplus(-leads).mean()

    train(
        "pair comparator", network.parameters(), (len(fitted), PICTURES, epochs), RATE, DECAY, batch_of, loss_of, torch
    )
    network.eval()
    _report(network, held_out, torch)
    example = {
        "seen": torch.zeros(3, PAIR_CHANNELS, PAIR_SIDE_PX, PAIR_SIDE_PX),
        "one": torch.tensor([0, 1]),
        "other": torch.tensor([2, 2]),
    }
    varying = {"seen": {0: "poses"}, **{name: {0: "pairs"} for name in ("one", "other", "lead")}}
    write_model(onnx_model(network, example, "lead", varying, torch), folder / "pair_comparator.onnx")


def make_pair_comparator(torch: Any) -> Any:
    """A network from inputs (N,C,S,S) of poses and pairs of their indices (P,) to log odds for the first of each."""
    nn = torch.nn

    class _PairComparator(nn.Module):  # type: ignore[name-defined]
        def __init__(self) -> None:
            super().__init__()
            self.alone = nn.Sequential(*strided_convolutions(PAIR_CHANNELS, WIDTHS, (), torch))
            self.register_buffer("min_difference", torch.tensor(MIN_DIFFERENCE).reshape(4, 1, 1))
            first, second, third = PAIR_WIDTHS
            self.paired = nn.Sequential(
                *convolution_and_norm(2 * WIDTHS[-1], first, 1, 1, torch), nn.ReLU(),
                *convolution_and_norm(first, second, 3, 2, torch), nn.ReLU(),
                *convolution_and_norm(second, third, 3, 1, torch), nn.ReLU(),
            )  # fmt: skip
            self.head = nn.Sequential(
                nn.Linear(2 * third + 1, LAST_WIDTH), nn.ReLU(), nn.Dropout(DROPOUT), nn.Linear(LAST_WIDTH, 1)
            )

        def forward(self, inputs: Any, one: Any, other: Any) -> Any:
            features, surface = self.alone(inputs), inputs[:, SURFACE]
            difference = (surface[one] - surface[other]).abs() / self.min_difference
            difference = (difference.amax(1, keepdim=True) - 1.0).clamp(0.0, 1.0)
            difference = nn.functional.max_pool2d(difference, 8)
            # Both orders in one batch: with the right pose always first, batch normalisation would reveal the label.
            a, b, difference = torch.cat([one, other]), torch.cat([other, one]), torch.cat([difference, difference])
            hidden = self.paired(torch.cat([features[a], features[b]], 1)) * difference
            count = difference.sum((2, 3))
            pooled = [hidden.sum((2, 3)) / (count + 1.0), hidden.amax((2, 3)), (count + 1.0).log() / 4.0]
            preference = self.head(torch.cat(pooled, 1))[:, 0]
            forth, back = preference.chunk(2)
            return forth - back

    return _PairComparator()


def _chosen(example: NearSymmetricPoses, rng: np.random.Generator) -> NDArray[np.intp]:
    """Indices of some poses of a picture, right and wrong ones."""
    right, wrong = (rng.permutation(np.flatnonzero(group)) for group in (example.is_right, ~example.is_right))
    right = right[: POSES // 2]
    return np.concatenate([right, wrong[: POSES - len(right)]])


def _report(network: Any, examples: Sequence[NearSymmetricPoses], torch: Any) -> None:
    """Print how many pairs are ordered right, and how often a right pose is first in its picture."""
    matrices = []
    for example in examples:
        count = len(example.logits)
        one, other = np.triu_indices(count, 1)
        leads = np.zeros((count, count))
        with torch.no_grad():
            inputs = network_input(example, range(count), None)[0]
            leads[one, other] = network(*map(torch.from_numpy, (inputs, one, other))).numpy()
        matrices.append((leads - leads.T, example.logits[:, None] - example.logits, example.is_right))
    pairs = np.concatenate([found[right][:, ~right].ravel() for found, _, right in matrices])
    print(f"other solids: {np.mean(pairs > 0):.1%} of {len(pairs)} pairs, loss {np.logaddexp(0.0, -pairs).mean():.3f}")
    for weight in PAIR_WEIGHTS:
        first = sum(bool(right[np.argmax((found + weight * lead).sum(axis=1))]) for found, lead, right in matrices)
        print(f"  weight of the pairs {weight}: a right pose first in {first} of {len(matrices)} pictures")
