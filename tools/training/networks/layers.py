"""Layers of the convolutional networks, and how networks are written as ONNX."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from arview.core.atomic import replacing


def convolution_and_norm(before: int, after: int, size: int, step: int, torch: Any) -> list[Any]:
    """A convolution without a bias, and its batch normalisation.

    Args:
        before, after: numbers of channels.
        size, step: of the kernel, and its stride.
        torch: the module.
    """
    nn = torch.nn
    return [nn.Conv2d(before, after, size, step, size // 2, bias=False), nn.BatchNorm2d(after)]


def strided_convolutions(before: int, widths: Sequence[int], deepened: Collection[int], torch: Any) -> list[Any]:
    """Convolutions with ReLU, every other of which has stride 2.

    Args:
        before: channels of the input.
        widths: channels of the convolutions.
        deepened: indices of the convolutions that a residual block follows.
        torch: the module.
    """
    layers: list[Any] = []
    for k, width in enumerate(widths):
        layers += [*convolution_and_norm(before, width, 5 if k == 0 else 3, 2 - k % 2, torch), torch.nn.ReLU()]
        if k in deepened:
            layers.append(residual_block(width, torch))
        before = width
    return layers


def residual_block(width: int, torch: Any) -> Any:
    """A residual block (He et al., "Deep residual learning", CVPR 2016), initialised to the identity."""
    nn = torch.nn

    class _Residual(nn.Module):  # type: ignore[name-defined]
        is_identity_at_first = True

        def __init__(self) -> None:
            super().__init__()
            one, other = (convolution_and_norm(width, width, 3, 1, torch) for _ in range(2))
            self.change = nn.Sequential(*one, nn.ReLU(), *other)
            nn.init.zeros_(self.change[-1].weight)

        def forward(self, before: Any) -> Any:
            return torch.relu(before + self.change(before))

    return _Residual()


def write_image_network(network: Any, path: Path, output: str, torch: Any) -> None:
    """Write a network from images (1,3,H,W) of any size to maps of half the size, as ONNX."""
    sizes = {"picture": {2: "rows", 3: "columns"}, output: {2: "half_rows", 3: "half_columns"}}
    write_network(network, path, {"picture": torch.zeros(1, 3, 480, 640)}, output, sizes, torch)


def write_network(
    network: Any, path: Path, inputs: dict[str, Any], output: str, varying: dict[str, dict[int, str]], torch: Any
) -> None:
    """Write a network as ONNX, see `onnx_model`, and print its path."""
    write_model(onnx_model(network, inputs, output, varying, torch), path)


def write_model(model: bytes, path: Path) -> None:
    """Write an ONNX model, and print its path."""
    with replacing(path) as file:
        file.write(model)
    print(f"wrote {path}")


def onnx_model(
    network: Any, inputs: dict[str, Any], output: str, varying: dict[str, dict[int, str]], torch: Any
) -> bytes:
    """A network as an ONNX model.

    Args:
        network: of torch.
        inputs: an example of each input by name, in order.
        output: name of the output.
        varying: names of the dimensions, by input or output, that may differ from those of the example.
        torch: the module.
    """
    file = BytesIO()
    torch.onnx.export(
        network, tuple(inputs.values()), file, input_names=list(inputs), output_names=[output],
        dynamic_axes=varying, dynamo=False,
    )  # fmt: skip
    return file.getvalue()


def mean_weights(initial: bytes, fitted: bytes) -> bytes:
    """The model whose weights are the means of those of two ONNX models of the same network."""
    import onnx

    mean = onnx.load_from_string(fitted)
    first = {one.name: onnx.numpy_helper.to_array(one) for one in onnx.load_from_string(initial).graph.initializer}
    for one in mean.graph.initializer:
        last = onnx.numpy_helper.to_array(one)
        if np.issubdtype(last.dtype, np.floating):
            one.CopyFrom(onnx.numpy_helper.from_array((0.5 * (first[one.name] + last)).astype(last.dtype), one.name))
    return bytes(mean.SerializeToString())
