"""Training of the networks that score inputs: pose verifier, contour verifier and presence net."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from networks.layers import mean_weights, onnx_model, strided_convolutions, write_model
from networks.net2net import CONTINUED_RATE_SHARE, as_input_error, packaged_weights, widen_from
from networks.prefetch import prefetched

LAST_WIDTH, DROPOUT = 48, 0.2
"""Width of the last hidden layer, and the share of its units that are dropped in training."""
Example = TypeVar("Example")
NetworkInputs = tuple[NDArray[np.float32], NDArray[np.float32]]
"""Maps (N,C,H,W) of some inputs, and scalars (N,G) beside them."""
INITIAL_EXAMPLES = 60
"""Examples from which the normalisations of continued training are initialised."""


@dataclass(frozen=True)
class ScoreNetDesign:
    """Architecture of a network that scores inputs.

    Attributes:
        name: of its file, without the suffix.
        shape: (channels, rows, columns) of the maps.
        scalars: number of scalars beside the maps.
        widths: channels of the convolutions.
        deepened: indices of the convolutions that a residual block follows.
        rate: learning rate from scratch.
    """

    name: str
    shape: tuple[int, int, int]
    scalars: int
    widths: tuple[int, ...]
    deepened: tuple[int, ...]
    rate: float


def train_score_net(
    design: ScoreNetDesign,
    folder: Path,
    fitted: Sequence[Example],
    from_scratch: bool,
    augmented: Callable[[Example, np.random.Generator], NetworkInputs],
    fit_at: Callable[[Any, float], None],
    report: Callable[[Any], None],
    torch: Any,
) -> None:
    """Train a network, report its quality, and write it to a folder.

    After continued training the means of the initial and the trained weights are written: it sees fewer examples than
    the training before, and the network would forget some of the others (Wortsman et al., "Robust fine-tuning of
    zero-shot models", CVPR 2022).

    Args:
        design: architecture of the network.
        folder: where the network is written.
        fitted: training examples.
        from_scratch: False continues from the network in the package.
        augmented: augmented network inputs of an example.
        fit_at: trains a network at a learning rate.
        report: prints the quality of the trained network, before weights are averaged.
        torch: the module.

    Raises:
        InputError: training is continued, and the network in the package has another architecture.
    """
    torch.manual_seed(0)
    network = make_score_net(torch, design.shape[0], design.scalars, design.widths, design.deepened)
    initial = None
    if not from_scratch:
        rng = np.random.default_rng(0)
        some = [augmented(fitted[i], rng)[0] for i in rng.integers(len(fitted), size=INITIAL_EXAMPLES)]
        continue_from(network, packaged_weights(f"{design.name}.onnx"), np.concatenate(some), torch)
        initial = _onnx_model(network, design, torch)
    network.train().to("cuda" if torch.cuda.is_available() else "cpu", memory_format=torch.channels_last)
    fit_at(network, design.rate if from_scratch else CONTINUED_RATE_SHARE * design.rate)
    network.to("cpu").eval()
    report(network)
    ended = _onnx_model(network, design, torch)
    write_model(ended if initial is None else mean_weights(initial, ended), folder / f"{design.name}.onnx")


def concatenated(inputs: Iterable[NetworkInputs]) -> NetworkInputs:
    """The inputs of several examples as one batch."""
    maps, scalars = map(np.concatenate, zip(*inputs, strict=True))
    return maps, scalars


def make_score_net(
    torch: Any, channels: int, scalars: int, widths: tuple[int, ...], deepened: Collection[int] = ()
) -> Any:
    """A convolutional network that scores maps and scalars; every other convolution has stride 2.

    Args:
        torch: the module.
        channels: of the maps.
        scalars: number of scalars beside the maps.
        widths: channels of the convolutions.
        deepened: indices of the convolutions that a residual block follows.
    """
    nn = torch.nn

    class _Network(nn.Module):  # type: ignore[name-defined]
        def __init__(self) -> None:
            super().__init__()
            self.convolutions = nn.Sequential(*strided_convolutions(channels, widths, deepened, torch))
            self.head = nn.Sequential(
                nn.Linear(2 * widths[-1] + scalars, LAST_WIDTH),
                nn.ReLU(),
                nn.Dropout(DROPOUT),
                nn.Linear(LAST_WIDTH, 1),
            )

        def forward(self, maps: Any, scalars: Any) -> Any:
            hidden = self.convolutions(maps)
            return self.head(torch.cat([hidden.mean((2, 3)), hidden.amax((2, 3)), scalars], 1))[:, 0]

    return _Network()


def train(
    name: str,
    weights: Iterable[Any],
    steps: tuple[int, int, int],
    rate: float,
    decay: float,
    batch_of: Callable[[NDArray[np.intp], np.random.Generator], Any],
    loss_of: Callable[[Any], Any],
    torch: Any,
) -> None:
    """Minimise a loss over weights, and print its mean after each epoch.

    Args:
        name: of the network, for the printed lines.
        weights: of the network, and other trained parameters.
        steps: number of examples, batch size, and epochs.
        rate, decay: largest learning rate of the one-cycle schedule, and weight decay.
        batch_of: the batch of some examples, by their indices, with random numbers for augmentation; called in a
            thread or process during an earlier step, so that it holds no tensors.
        loss_of: the loss of a batch.
        torch: the module.
    """
    count, batch, epochs = steps
    weights = list(weights)
    optimiser = torch.optim.AdamW(weights, rate, weight_decay=decay)
    each = max(1, count // batch)
    total = epochs * each
    rising = max(0.05, 2.0 / total)  # torch divides by zero for a single step
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=total, pct_start=min(rising, 1.0))
    rng = np.random.default_rng([0, 0])
    orders = [rng.permutation(count) for _ in range(epochs)]

    def made(step: int) -> Any:
        epoch, k = divmod(step, each)
        return batch_of(orders[epoch][k * batch : (k + 1) * batch], np.random.default_rng([0, 1, step]))

    batches = prefetched(made, total)
    for epoch in range(epochs):
        losses = []
        for one in islice(batches, each):
            loss = loss_of(one)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            losses.append(loss.item())
        print(f"{name}, epoch {epoch + 1} of {epochs}: loss {np.mean(losses):.3f}", flush=True)


def half_precision_scores(network: Any, maps: NDArray[np.float32], scalars: NDArray[np.float32], torch: Any) -> Any:
    """Scores (N,) of inputs in training, computed in half precision where the network is."""
    device = next(network.parameters()).device
    with torch.autocast(device.type, torch.bfloat16):
        shown = torch.from_numpy(maps).to(device).contiguous(memory_format=torch.channels_last)
        scores = network(shown, torch.from_numpy(scalars).to(device))
    return scores.float().cpu()


def ranking_loss(scores: Any, truth: Sequence[Any], listwise_weight: float, torch: Any) -> Any:
    """Loss of scores (N,): classification over all pictures, and listwise ranking inside each.

    Args:
        scores: of the poses of some pictures, one picture after the other.
        truth: for each picture, which of its poses are right (bool).
        listwise_weight: of the ranking loss of each picture.
        torch: the module.
    """
    loss = torch.nn.functional.binary_cross_entropy_with_logits(scores, torch.cat(list(truth)).float())
    for some, right in zip(scores.split([len(part) for part in truth]), truth, strict=True):
        if right.any():
            loss = loss + listwise_weight * (some.logsumexp(0) - some[right].logsumexp(0))
    return loss


def continue_from(network: Any, path: Path, maps: NDArray[np.float32], torch: Any) -> None:
    """Initialise a network to compute what a written, perhaps narrower network computes, see `widen_from`.

    Args:
        network: from `make_score_net`.
        path: of the written network.
        maps: (N,C,S,S) training inputs.
        torch: the module.

    Raises:
        InputError: the written network has other inputs, is wider, or has other blocks.
    """
    layers = widen_from(network, path, lambda: network.convolutions(torch.from_numpy(maps)), torch)
    with as_input_error(path), torch.no_grad():
        (weight, bias), (last_weight, last_bias) = layers["Gemm"]
        first, last = network.head[0], network.head[3]
        old = layers["Conv"][-1][0].shape[0]
        wide = (first.in_features - (weight.shape[1] - 2 * old)) // 2
        # Means and maxima of the channels, then the scalars.
        first.weight.zero_()
        first.weight[:, :old] = weight[:, :old]
        first.weight[:, wide : wide + old] = weight[:, old : 2 * old]
        first.weight[:, 2 * wide :] = weight[:, 2 * old :]
        first.bias.copy_(bias)
        last.weight.copy_(last_weight)
        last.bias.copy_(last_bias)


def _onnx_model(network: Any, design: ScoreNetDesign, torch: Any) -> bytes:
    """The ONNX model of a network, for batches of any size."""
    inputs = {"seen": torch.zeros(2, *design.shape), "both": torch.zeros(2, design.scalars)}
    varying = {name: {0: "poses"} for name in (*inputs, "score")}
    return onnx_model(network.eval(), inputs, "score", varying, torch)
