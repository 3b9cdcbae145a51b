"""Fitting the networks of the judge to examples."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
from networks.net2net import GONE_ON
from profile_ranker_examples import Group, read_examples

WIDTH, LAST_WIDTH = 16, 32
"""Of the layers for each line, and of that for all together."""
BATCH, WITHOUT_BATCH = 12, 8
"""Pictures with and without the solid that a step looks at."""
RATE, DECAY, DROPPED = 4e-3, 2e-2, 0.1
CALIBRATION_WEIGHT, CALIBRATED = 0.5, 3
"""Refined poses are to be told across pictures too: the best few of each are classified as well."""
HELD_OUT = 10
"""Every so manieth solid is not fitted to, but for telling how well others are judged."""


def fit_networks(folder: Path, epochs: int, is_anew: bool = True) -> None:
    """Fit all networks to the examples in a folder, write judge.npz there, and say how well they do.

    ``is_anew``: not going on from those in use.

    Raises:
        InputError: no examples, or no torch.
    """
    try:
        import torch
    except ImportError as error:
        raise InputError("fit_judge: torch is not installed; pip install torch") from error
    fitted, left = read_examples(folder, "solid_*.pkl", HELD_OUT)
    torch.manual_seed(0)
    stored: dict[str, NDArray[np.float32]] = {}
    for stage, names in (("rough", ("rough",)), ("refined", ("fine", "close"))):
        networks = {name: _network(torch) if is_anew else _as_in_use(name, torch) for name in names}
        rate = RATE if is_anew else GONE_ON * RATE
        of_stage = ([g for g in groups if g.stage == stage] for groups in (fitted, left))
        weight = _fit(networks, *of_stage, epochs, rate, torch)
        print(f"{stage}: weight of the hand-made evidence {weight:.2f}")
        for name, network in networks.items():
            for field, layer in zip(RankerLayers._fields[::2], network.layers(), strict=True):
                stored[f"{name}_{field}"] = layer.weight.detach().numpy().T.copy()
                stored[f"{name}_{field}_bias"] = layer.bias.detach().numpy().copy()
    with replacing(folder / "judge.npz") as file:
        np.savez_compressed(file, **stored)
    print(f"wrote {folder / 'judge.npz'}")


def _fit(
    networks: dict[str, Any], fitted: Sequence[Group], left: Sequence[Group], epochs: int, rate: float, torch: Any
) -> float:
    """Fit networks whose scores are added; the weight of the hand-made evidence beside them."""
    shown = [g for g in fitted if g.is_right.any()]
    without = [g for g in fitted if not g.is_right.any()]
    weight, bias = (torch.nn.Parameter(torch.tensor(value)) for value in (0.7, -3.0))
    parameters = [weight, bias, *(p for network in networks.values() for p in network.parameters())]
    optimiser = torch.optim.AdamW(parameters, rate / 2, weight_decay=DECAY)
    steps = max(1, len(shown) // BATCH)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=epochs * steps)
    rng = np.random.default_rng(0)

    def scores(group: Group) -> Any:
        total = weight * torch.from_numpy(group.logits)
        for name, network in networks.items():
            total = total + network(torch.from_numpy(group.lines[name]) / 255.0, torch.from_numpy(group.both[name]))
        return total

    def calibration(found: Any, group: Group) -> Any:
        best = found.detach().topk(min(CALIBRATED, len(found))).indices
        truth = torch.from_numpy(group.is_right[best.numpy()].astype(np.float32))
        return torch.nn.functional.binary_cross_entropy_with_logits(found[best] + bias, truth)

    for epoch in range(epochs):
        order, losses = rng.permutation(len(shown)), []
        for k in range(steps):
            loss = torch.zeros(())
            for i in order[k * BATCH : (k + 1) * BATCH]:
                found = scores(shown[i])
                right = torch.from_numpy(shown[i].is_right)
                loss = loss + (found.logsumexp(0) - found[right].logsumexp(0)) / BATCH
                loss = loss + CALIBRATION_WEIGHT / BATCH * calibration(found, shown[i])
            for i in rng.integers(len(without), size=WITHOUT_BATCH if without else 0):
                loss = loss + CALIBRATION_WEIGHT / BATCH * calibration(scores(without[i]), without[i])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            losses.append(loss.item())
        print(f"{', '.join(networks)}, epoch {epoch + 1} of {epochs}: loss {np.mean(losses):.3f}", flush=True)
    for network in networks.values():
        network.eval()
    told = [g for g in left if g.is_right.any()]
    with torch.no_grad():
        first = sum(bool(g.is_right[int(scores(g).argmax())]) for g in told)
    by_hand = sum(bool(g.is_right[int(g.logits.argmax())]) for g in told)
    others = f"{len(told)} pictures of {len({g.solid for g in left})} other solids"
    print(f"{others}: a right pose first in {first}, by hand in {by_hand}")
    return float(weight.detach())


def _as_in_use(name: str, torch: Any) -> Any:
    """One of the networks as it is in use."""
    network = _network(torch)
    stored = ranker_layers(name)
    with torch.no_grad():
        for layer, weight, bias in zip(network.layers(), stored[::2], stored[1::2], strict=True):
            layer.weight.copy_(torch.from_numpy(weight.T.copy()))
            layer.bias.copy_(torch.from_numpy(bias.copy()))
    return network


def _network(torch: Any) -> Any:
    """The network of `arview.detection.scoring.profile_ranker` as torch fits it."""
    nn = torch.nn

    class _Network(nn.Module):  # type: ignore[misc, name-defined]
        def __init__(self) -> None:
            super().__init__()
            self.first, self.second = nn.Linear(FEATURES, WIDTH), nn.Linear(WIDTH, WIDTH)
            self.third, self.last = nn.Linear(3 * WIDTH + RANKER_SCALARS, LAST_WIDTH), nn.Linear(LAST_WIDTH, 1)
            self.dropout = nn.Dropout(DROPPED)

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
