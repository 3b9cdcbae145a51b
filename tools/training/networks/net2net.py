"""Continued training: a network, perhaps a wider one, is initialised to compute what a written network computes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

from arview.errors import InputError
from arview.weights import weights_file

CONTINUED_RATE_SHARE = 0.5
"""Learning rate of continued training, as a share of that from scratch."""
NEW_CHANNEL_GAIN = 0.5
"""Gain of channels that the written network does not have: they begin weaker than the others."""

Layers = dict[str, list[list[Any]]]
"""Weights and biases of an ONNX network by the type of its layers, in the order of execution."""


def torch_with_onnx() -> Any:
    """Import torch, and check that onnx, with which it writes networks, is there.

    Raises:
        InputError: one of them is not installed.
    """
    try:
        import onnx  # noqa: F401  torch writes with it
        import torch
    except ImportError as error:
        raise InputError(f"fit.py: {error.name} is not installed; pip install torch onnx") from error
    return torch


def packaged_weights(name: str) -> Path:
    """The file of a network in the package, which continued training begins from."""
    return Path(str(weights_file(name)))


@contextmanager
def as_input_error(path: Path) -> Iterator[None]:
    """Raise InputError where the layers of a written network do not fit into another network."""
    try:
        yield
    except (RuntimeError, ValueError) as error:
        raise InputError(f"{path}: not a narrower network of this kind ({error})") from error


def _onnx_layers(path: Path, torch: Any) -> Layers:
    """The convolutions, with their normalisations folded in, and the fully connected layers of an ONNX network."""
    import onnx

    graph = onnx.load(path).graph
    stored = {one.name: torch.tensor(onnx.numpy_helper.to_array(one)) for one in graph.initializer}
    return {
        kind: [[stored[name] for name in node.input[1:]] for node in graph.node if node.op_type == kind]
        for kind in ("Conv", "Gemm")
    }


def _convolutions(network: Any, torch: Any) -> tuple[list[Any], set[Any]]:
    """The convolutions of a network, and those of them that are in blocks initialised to the identity."""
    kind = torch.nn.Conv2d
    in_identity = {
        layer
        for block in network.modules()
        if getattr(block, "is_identity_at_first", False)
        for layer in block.modules()
        if isinstance(layer, kind)
    }
    return [layer for layer in network.modules() if isinstance(layer, kind)], in_identity


def widen_from(network: Any, path: Path, show: Callable[[], Any], torch: Any) -> Layers:
    """Initialise the convolutions of a network to compute what those of a written, perhaps narrower network compute.

    Added channels have weights, but the layers after them ignore them at first, as in Chen et al., "Net2Net" (ICLR
    2016). Added residual blocks are the identity at first. Batch normalisations, which are folded into the written
    convolutions, are initialised from the statistics of training inputs.

    Args:
        network: in which each convolution that is normalised is followed by its normalisation in one Sequential.
        path: of the written network.
        show: runs the network on training inputs.
        torch: the module.

    Returns:
        the layers of the written network.

    Raises:
        InputError: the written network is wider, has other inputs, or has more or fewer convolutions.
    """
    nn = torch.nn
    layers = _onnx_layers(path, torch)
    chains = [list(module) for module in network.modules() if isinstance(module, nn.Sequential)]
    norms = {a: b for chain in chains for a, b in pairwise(chain) if isinstance(b, nn.BatchNorm2d)}
    remaining = list(layers["Conv"])
    convolutions, in_identity = _convolutions(network, torch)
    if len(remaining) == len(convolutions) - len(in_identity):
        convolutions = [layer for layer in convolutions if layer not in in_identity]

    def copy_weights(layer: Any, _: Any) -> None:
        if not remaining:
            raise ValueError("more convolutions than the written network has")
        weight, bias = remaining[0]
        old, inputs = weight.shape[:2]
        layer.weight[:old, inputs:] = 0.0
        layer.weight[:old, :inputs] = weight
        if layer not in norms:
            layer.bias[:old] = bias

    def set_normalisation(layer: Any, _: Any, output: Any) -> None:
        _, bias = remaining.pop(0)
        if layer not in norms:
            return
        norm, old = norms[layer], len(bias)
        mean, variance = output.mean((0, 2, 3)), output.var((0, 2, 3))
        norm.running_mean.copy_(mean)
        norm.running_var.copy_(variance)
        norm.weight.fill_(NEW_CHANNEL_GAIN)
        norm.weight[:old] = (variance[:old] + norm.eps).sqrt()
        norm.bias.zero_()
        norm.bias[:old] = bias + mean[:old]

    hooks = []
    for layer in convolutions:
        hooks += [layer.register_forward_pre_hook(copy_weights), layer.register_forward_hook(set_normalisation)]
    network.eval()
    try:
        with as_input_error(path), torch.no_grad():
            show()
            if remaining:
                raise ValueError(f"{len(remaining)} convolutions fewer than the written network has")
    finally:
        for hook in hooks:
            hook.remove()
    network.train()
    return layers
