"""Networks that are gone on with: a new one, as wide as the written one or wider, begins by doing what that does."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Any

from arview.errors import InputError

GONE_ON = 0.5
"""Share of the rate for a network that is gone on with."""
NEW_GAIN = 0.5
"""Of channels that the network gone on with has not: they begin this much weaker than the others."""

Layers = dict[str, list[list[Any]]]
"""Weights and biases of a written network by the kind of its layers, in the order in which they are run."""


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


@contextmanager
def beginning_as(path: Path) -> Iterator[None]:
    """While a network takes over what a written one does: an InputError where that is wider or of another kind."""
    try:
        yield
    except (RuntimeError, ValueError) as error:
        raise InputError(f"{path}: not a narrower network of this kind ({error})") from error


def _written_layers(path: Path, torch: Any) -> Layers:
    """Of a network written as ONNX: convolutions (with their normalisations in them) and full layers."""
    import onnx

    graph = onnx.load(path).graph
    stored = {one.name: torch.tensor(onnx.numpy_helper.to_array(one)) for one in graph.initializer}
    return {
        kind: [[stored[name] for name in node.input[1:]] for node in graph.node if node.op_type == kind]
        for kind in ("Conv", "Gemm")
    }


def _convolutions(network: Any, torch: Any) -> tuple[list[Any], set[Any]]:
    """The convolutions of a network, and which of them are in blocks that begin by changing nothing."""
    kind = torch.nn.Conv2d
    idle = {
        layer
        for block in network.modules()
        if getattr(block, "begins_idle", False)
        for layer in block.modules()
        if isinstance(layer, kind)
    }
    return [layer for layer in network.modules() if isinstance(layer, kind)], idle


def begin_as(network: Any, path: Path, show: Callable[[], Any], torch: Any) -> Layers:
    """Make the convolutions of a network do what those of a written one do that is as wide or narrower.

    Channels that the written ones have not are there, but nothing listens to them yet, as in Chen et al., "Net2Net"
    (ICLR 2016). Residual blocks, if it has none, change nothing yet. Normalisations, which the written ones have in
    their convolutions, begin anew with what is seen.

    Args:
        network: whose convolutions are each followed by their normalisation in one Sequential, if they have any.
        path: of the written one.
        show: runs the network on what it is shown in fitting.
        torch: the module.

    Returns:
        the written one's layers.

    Raises:
        InputError: it is wider, shown something else, or has more or fewer convolutions.
    """
    nn = torch.nn
    layers = _written_layers(path, torch)
    chains = [list(module) for module in network.modules() if isinstance(module, nn.Sequential)]
    norms = {a: b for chain in chains for a, b in pairwise(chain) if isinstance(b, nn.BatchNorm2d)}
    left = list(layers["Conv"])
    convolutions, idle = _convolutions(network, torch)
    if len(left) == len(convolutions) - len(idle):
        convolutions = [layer for layer in convolutions if layer not in idle]

    def take_over(layer: Any, _: Any) -> None:
        if not left:
            raise ValueError("more convolutions than are written")
        weight, bias = left[0]
        old, shown = weight.shape[:2]
        layer.weight[:old, shown:] = 0.0
        layer.weight[:old, :shown] = weight
        if layer not in norms:
            layer.bias[:old] = bias

    def normalise(layer: Any, _: Any, found: Any) -> None:
        _, bias = left.pop(0)
        if layer not in norms:
            return
        norm, old = norms[layer], len(bias)
        mean, variance = found.mean((0, 2, 3)), found.var((0, 2, 3))
        norm.running_mean.copy_(mean)
        norm.running_var.copy_(variance)
        norm.weight.fill_(NEW_GAIN)
        norm.weight[:old] = (variance[:old] + norm.eps).sqrt()
        norm.bias.zero_()
        norm.bias[:old] = bias + mean[:old]

    hooks = []
    for layer in convolutions:
        hooks += [layer.register_forward_pre_hook(take_over), layer.register_forward_hook(normalise)]
    network.eval()
    try:
        with beginning_as(path), torch.no_grad():
            show()
            if left:
                raise ValueError(f"{len(left)} convolutions less than are written")
    finally:
        for hook in hooks:
            hook.remove()
    network.train()
    return layers
