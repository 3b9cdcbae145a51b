"""Networks that score a look, of the verifier and of components: how they are made, gone on with, and written."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.atomic import replacing
from arview.errors import InputError

LAST_WIDTH, DROPPED = 48, 0.2
NEW_GAIN = 0.5
"""Of channels that the network gone on with has not: they begin this much weaker than the others."""


def torch_with_onnx() -> Any:
    """The module, or an InputError that says what to install."""
    try:
        import onnx  # noqa: F401  torch writes with it
        import torch
    except ImportError as error:
        raise InputError(f"fit_judge: {error.name} is not installed; pip install torch onnx") from error
    return torch


def in_use(name: str) -> Path:
    """Of a network of the package."""
    return Path(str(files("arview.tracking").joinpath(name)))


def score_network(torch: Any, channels: int, told: int, widths: tuple[int, ...]) -> Any:
    """A network shown so many channels and told of so many things; every other convolution halves the picture."""
    nn = torch.nn

    class _Network(nn.Module):  # type: ignore[misc, name-defined]
        def __init__(self) -> None:
            super().__init__()
            layers: list[Any] = []
            before = channels
            for k, width in enumerate(widths):
                size = 5 if k == 0 else 3
                layers += [
                    nn.Conv2d(before, width, size, 2 - k % 2, size // 2, bias=False),
                    nn.BatchNorm2d(width),
                    nn.ReLU(),
                ]
                before = width
            self.convolutions = nn.Sequential(*layers)
            self.together = nn.Sequential(
                nn.Linear(2 * before + told, LAST_WIDTH), nn.ReLU(), nn.Dropout(DROPPED), nn.Linear(LAST_WIDTH, 1)
            )

        def forward(self, seen: Any, both: Any) -> Any:
            hidden = self.convolutions(seen)
            return self.together(torch.cat([hidden.mean((2, 3)), hidden.amax((2, 3)), both], 1))[:, 0]

    return _Network()


def go_on_from(network: Any, path: Path, seen: NDArray[np.float32], torch: Any) -> None:
    """Make a network do what a written one does that is as wide or narrower.

    Channels that the written one has not are there, but nothing listens to them yet, as in Chen et al., "Net2Net" (ICLR
    2016). A written one has its normalisations in its convolutions: they begin anew with what is seen.

    Args:
        network: from `score_network`.
        path: of the one written by `write_network`.
        seen: (N,C,S,S) what networks are shown in fitting.

    Raises:
        InputError: the written one is shown something else, or is wider.
    """
    import onnx

    graph = onnx.load(path).graph
    stored = {one.name: torch.tensor(onnx.numpy_helper.to_array(one)) for one in graph.initializer}
    layers = {
        kind: [[stored[name] for name in node.input[1:]] for node in graph.node if node.op_type == kind]
        for kind in ("Conv", "Gemm")
    }
    with torch.no_grad():
        hidden = torch.from_numpy(seen)
        try:
            made = list(network.convolutions)
            for conv, norm, (weight, bias) in zip(made[::3], made[1::3], layers["Conv"], strict=True):
                old, shown = weight.shape[:2]
                conv.weight[:old, shown:] = 0.0
                conv.weight[:old, :shown] = weight
                found = conv(hidden)
                mean, variance = found.mean((0, 2, 3)), found.var((0, 2, 3))
                norm.running_mean.copy_(mean)
                norm.running_var.copy_(variance)
                norm.weight.fill_(NEW_GAIN)
                norm.weight[:old] = (variance[:old] + norm.eps).sqrt()
                norm.bias.zero_()
                norm.bias[:old] = bias + mean[:old]
                hidden = torch.relu(norm.eval()(found))
            (weight, bias), (last_weight, last_bias) = layers["Gemm"]
            first, last = network.together[0], network.together[3]
            wide = conv.out_channels
            # Means, maxima, and what the network is told.
            first.weight.zero_()
            first.weight[:, :old] = weight[:, :old]
            first.weight[:, wide : wide + old] = weight[:, old : 2 * old]
            first.weight[:, 2 * wide :] = weight[:, 2 * old :]
            first.bias.copy_(bias)
            last.weight.copy_(last_weight)
            last.bias.copy_(last_bias)
        except (RuntimeError, ValueError) as error:
            raise InputError(f"{path}: not a narrower network of this kind ({error})") from error


def write_network(network: Any, path: Path, shape: tuple[int, int], told: int, torch: Any) -> None:
    """Write a network that is shown so many channels of so large a side as `cv2.dnn` reads it."""
    channels, side = shape
    with replacing(path) as file:
        torch.onnx.export(
            network, (torch.zeros(2, channels, side, side), torch.zeros(2, told)), file,
            input_names=["seen", "both"], output_names=["score"], dynamo=False,
            dynamic_axes={"seen": {0: "poses"}, "both": {0: "poses"}, "score": {0: "poses"}},
        )  # fmt: skip
    print(f"wrote {path}")
