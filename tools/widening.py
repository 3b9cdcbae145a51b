"""Networks that are gone on with: a new one, as wide as the written one or wider, begins by doing what that does."""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Any

from arview.errors import InputError

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


def written_layers(path: Path, torch: Any) -> Layers:
    """Of a network written as ONNX: convolutions (with their normalisations in them) and full layers."""
    import onnx

    graph = onnx.load(path).graph
    stored = {one.name: torch.tensor(onnx.numpy_helper.to_array(one)) for one in graph.initializer}
    return {
        kind: [[stored[name] for name in node.input[1:]] for node in graph.node if node.op_type == kind]
        for kind in ("Conv", "Gemm")
    }


def begin_as(network: Any, convolutions: list[list[Any]], show: Callable[[], Any], torch: Any) -> None:
    """Make the convolutions of a network do what written ones do that are as wide or narrower.

    Channels that the written ones have not are there, but nothing listens to them yet, as in Chen et al., "Net2Net"
    (ICLR 2016). Normalisations, which the written ones have in their convolutions, begin anew with what is seen.

    Args:
        network: whose convolutions are each followed by their normalisation in one Sequential, if they have any.
        convolutions: weight and bias of each in the order in which they are run, see `written_layers`.
        show: runs the network on what it is shown in fitting.
        torch: the module.

    Raises:
        RuntimeError: a written one is wider or shown something else; ValueError: there are more or fewer.
    """
    nn = torch.nn
    chains = [list(module) for module in network.modules() if isinstance(module, nn.Sequential)]
    norms = {a: b for chain in chains for a, b in pairwise(chain) if isinstance(b, nn.BatchNorm2d)}
    left = list(convolutions)

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
    for module in network.modules():
        if isinstance(module, nn.Conv2d):
            hooks += [module.register_forward_pre_hook(take_over), module.register_forward_hook(normalise)]
    network.eval()
    try:
        with torch.no_grad():
            show()
    finally:
        for hook in hooks:
            hook.remove()
    if left:
        raise ValueError(f"{len(left)} convolutions less than are written")


def begin_as_in_use(network: Any, name: str, show: Callable[[], Any], torch: Any) -> None:
    """The same for a network of convolutions only, as the package's of some name; it is ready to be fitted then.

    Raises:
        InputError: that one is wider, or of another kind.
    """
    path = in_use(name)
    try:
        begin_as(network, written_layers(path, torch)["Conv"], show, torch)
    except (RuntimeError, ValueError) as error:
        raise InputError(f"{path}: not a narrower network of this kind ({error})") from error
    network.train()
