"""Training of the networks of the profile ranker."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from arview.core.atomic import replacing
from arview.detection.scoring.profile_ranker import (
    FEATURES,
    IS_SEEN,
    OUTLINE_LINES,
    RANKER_SCALARS,
    STRETCHES,
    RankerLayers,
    ranker_layers,
)
from arview.errors import InputError
from networks.net2net import CONTINUED_RATE_SHARE
from profile_ranker_examples import PoseGroup, read_examples

WIDTH, LAST_WIDTH = 16, 32
"""Widths of the layers for each profile, and of the layer for all together."""
BATCH, BATCH_WITHOUT = 12, 8
"""Pictures with and without the solid in a batch."""
RATE, DECAY, DROPOUT = 4e-3, 2e-2, 0.1
CALIBRATION_WEIGHT, CALIBRATED_POSES = 0.5, 3
"""Weight of the classification across pictures, beside the ranking inside each, and poses of each that take part."""
HELD_OUT = 10
"""One solid in this many is held out for the report."""


def fit_profile_ranker(folder: Path, epochs: int, from_scratch: bool = True) -> None:
    """Train all networks on the examples in a folder, write profile_ranker.npz there, and report their quality.

    Args:
        folder: with pose groups, see `collect_pose_examples`.
        epochs: passes over the pictures.
        from_scratch: False continues from the networks in the package.

    Raises:
        InputError: no examples, or no torch.
    """
    try:
        import torch
    except ImportError as error:
        raise InputError("fit.py: torch is not installed; pip install torch") from error
    fitted, left = read_examples(folder, "groups_*.pkl", HELD_OUT)
    torch.manual_seed(0)
    stored: dict[str, Any] = {}
    for stage, names in (("rough", ("rough",)), ("refined", ("fine", "close"))):
        networks = {name: _network(torch) if from_scratch else _from_package(name, torch) for name in names}
        rate = RATE if from_scratch else CONTINUED_RATE_SHARE * RATE
        fitted_groups, left_groups = ([g for g in groups if g.stage == stage] for groups in (fitted, left))
        weight = _fit(networks, fitted_groups, left_groups, epochs, rate, torch)
        print(f"{stage}: weight of the evidence {weight:.2f}")
        for name, network in networks.items():
            for field, layer in zip(RankerLayers._fields[::2], network.layers(), strict=True):
                stored[f"{name}_{field}"] = layer.weight.detach().numpy().T.copy()
                stored[f"{name}_{field}_bias"] = layer.bias.detach().numpy().copy()
    with replacing(folder / "profile_ranker.npz") as file:
        np.savez_compressed(file, **stored)
    print(f"wrote {folder / 'profile_ranker.npz'}")


def _fit(
    networks: dict[str, Any],
    fitted: Sequence[PoseGroup],
    left: Sequence[PoseGroup],
    epochs: int,
    rate: float,
    torch: Any,
) -> float:
    """Train networks whose scores are added, and return the weight of the evidence beside them."""
    with_solid = [g for g in fitted if g.is_right.any()]
    without = [g for g in fitted if not g.is_right.any()]
    weight, bias = (torch.nn.Parameter(torch.tensor(value)) for value in (0.7, -3.0))
    parameters = [weight, bias, *(p for network in networks.values() for p in network.parameters())]
    optimiser = torch.optim.AdamW(parameters, rate / 2, weight_decay=DECAY)
    steps = max(1, len(with_solid) // BATCH)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=epochs * steps)
    rng = np.random.default_rng(0)

    def scores(group: PoseGroup) -> Any:
        total = weight * torch.from_numpy(group.logits)
        for name, network in networks.items():
            total = total + network(torch.from_numpy(group.edges[name]) / 255.0, torch.from_numpy(group.scalars[name]))
        return total

    def calibration(scored: Any, group: PoseGroup) -> Any:
        best = scored.detach().topk(min(CALIBRATED_POSES, len(scored))).indices
        truth = torch.from_numpy(group.is_right[best.numpy()].astype(np.float32))
        return torch.nn.functional.binary_cross_entropy_with_logits(scored[best] + bias, truth)

    for epoch in range(epochs):
        order, losses = rng.permutation(len(with_solid)), []
        for k in range(steps):
            loss = torch.zeros(())
            for i in order[k * BATCH : (k + 1) * BATCH]:
                scored = scores(with_solid[i])
                right = torch.from_numpy(with_solid[i].is_right)
                loss = loss + (scored.logsumexp(0) - scored[right].logsumexp(0)) / BATCH
                loss = loss + CALIBRATION_WEIGHT / BATCH * calibration(scored, with_solid[i])
            for i in rng.integers(len(without), size=BATCH_WITHOUT if without else 0):
                loss = loss + CALIBRATION_WEIGHT / BATCH * calibration(scores(without[i]), without[i])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            losses.append(loss.item())
        print(f"{', '.join(networks)}, epoch {epoch + 1} of {epochs}: loss {np.mean(losses):.3f}", flush=True)
    for network in networks.values():
        network.eval()
    held_out = [g for g in left if g.is_right.any()]
    with torch.no_grad():
        first = sum(bool(g.is_right[int(scores(g).argmax())]) for g in held_out)
    by_evidence = sum(bool(g.is_right[int(g.logits.argmax())]) for g in held_out)
    others = f"{len(held_out)} pictures of {len({g.solid for g in left})} other solids"
    print(f"{others}: a right pose first in {first}, by the evidence alone in {by_evidence}")
    return float(weight.detach())


def _from_package(name: str, torch: Any) -> Any:
    """A network with the weights in the package."""
    network = _network(torch)
    stored = ranker_layers(name)
    with torch.no_grad():
        for layer, weight, bias in zip(network.layers(), stored[::2], stored[1::2], strict=True):
            layer.weight.copy_(torch.from_numpy(weight.T.copy()))
            layer.bias.copy_(torch.from_numpy(bias.copy()))
    return network


def _network(torch: Any) -> Any:
    """The network of `arview.detection.scoring.profile_ranker` in torch."""
    nn = torch.nn

    class _Network(nn.Module):  # type: ignore[name-defined]
        def __init__(self) -> None:
            super().__init__()
            self.first, self.second = nn.Linear(FEATURES, WIDTH), nn.Linear(WIDTH, WIDTH)
            self.third, self.last = nn.Linear(3 * WIDTH + RANKER_SCALARS, LAST_WIDTH), nn.Linear(LAST_WIDTH, 1)
            self.dropout = nn.Dropout(DROPOUT)

        def layers(self) -> tuple[Any, ...]:
            return self.first, self.second, self.third, self.last

        def forward(self, lines: Any, both: Any) -> Any:
            seen = lines[..., IS_SEEN : IS_SEEN + 1]
            hidden = torch.relu(self.second(torch.relu(self.first(lines)))) * seen
            outline, counts = hidden[:, :OUTLINE_LINES], seen[:, :OUTLINE_LINES]
            inner = hidden[:, OUTLINE_LINES:].sum(1) / (seen[:, OUTLINE_LINES:].sum(1) + 1.0)
            stretches = outline.unflatten(1, (STRETCHES, -1)).sum(2) / (
                counts.unflatten(1, (STRETCHES, -1)).sum(2) + 0.5
            )
            pooled = [outline.sum(1) / (counts.sum(1) + 1.0), inner, stretches.min(1).values, both]
            return self.last(torch.relu(self.third(self.dropout(torch.cat(pooled, 1)))))[:, 0]

    return _Network()
