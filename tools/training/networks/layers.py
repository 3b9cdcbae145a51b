"""Layers that the fitted networks of convolutions are made of, and how networks of pictures are written."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from arview.core.atomic import replacing


def normalised(before: int, after: int, size: int, step: int, torch: Any) -> list[Any]:
    """A convolution and its normalisation."""
    nn = torch.nn
    return [nn.Conv2d(before, after, size, step, size // 2, bias=False), nn.BatchNorm2d(after)]


def halving(before: int, widths: Sequence[int], deepened: Collection[int], torch: Any) -> list[Any]:
    """Convolutions of some widths, every other of which halves the picture; a residual block follows those deepened."""
    layers: list[Any] = []
    for k, width in enumerate(widths):
        layers += [*normalised(before, width, 5 if k == 0 else 3, 2 - k % 2, torch), torch.nn.ReLU()]
        if k in deepened:
            layers.append(residual(width, torch))
        before = width
    return layers


def residual(width: int, torch: Any) -> Any:
    """A residual block (He et al., "Deep residual learning", CVPR 2016) that begins by changing nothing."""
    nn = torch.nn

    class _Residual(nn.Module):  # type: ignore[misc, name-defined]
        begins_idle = True

        def __init__(self) -> None:
            super().__init__()
            one, other = (normalised(width, width, 3, 1, torch) for _ in range(2))
            self.change = nn.Sequential(*one, nn.ReLU(), *other)
            nn.init.zeros_(self.change[-1].weight)

        def forward(self, before: Any) -> Any:
            return torch.relu(before + self.change(before))

    return _Residual()


def write_picture_network(network: Any, path: Path, answer: str, torch: Any) -> None:
    """Write a network that takes pictures (1,3,H,W) of any size, and answers at half of it."""
    sizes = {"picture": {2: "rows", 3: "columns"}, answer: {2: "half_rows", 3: "half_columns"}}
    write_network(network, path, {"picture": torch.zeros(1, 3, 480, 640)}, answer, sizes, torch)


def write_network(
    network: Any, path: Path, shown: dict[str, Any], answer: str, varying: dict[str, dict[int, str]], torch: Any
) -> None:
    """Write a network as ONNX, see `exported`, and say so."""
    write(exported(network, shown, answer, varying, torch), path)


def write(model: bytes, path: Path) -> None:
    """Write a network in ONNX, and say so."""
    with replacing(path) as file:
        file.write(model)
    print(f"wrote {path}")


def exported(network: Any, shown: dict[str, Any], answer: str, varying: dict[str, dict[int, str]], torch: Any) -> bytes:
    """A network in ONNX.

    Args:
        network: the one.
        shown: an example of each of its inputs by name, in order.
        answer: name of its output.
        varying: names of those dimensions of inputs and output that may be others than in the example.
        torch: the module.
    """
    file = BytesIO()
    torch.onnx.export(
        network, tuple(shown.values()), file, input_names=list(shown), output_names=[answer],
        dynamic_axes=varying, dynamo=False,
    )  # fmt: skip
    return file.getvalue()


def halfway(begun: bytes, fitted: bytes) -> bytes:
    """The mean of what a network began as and of the fitted one, both `exported`."""
    import onnx

    mean = onnx.load_from_string(fitted)
    first = {one.name: onnx.numpy_helper.to_array(one) for one in onnx.load_from_string(begun).graph.initializer}
    for one in mean.graph.initializer:
        last = onnx.numpy_helper.to_array(one)
        if np.issubdtype(last.dtype, np.floating):
            one.CopyFrom(onnx.numpy_helper.from_array((0.5 * (first[one.name] + last)).astype(last.dtype), one.name))
    return bytes(mean.SerializeToString())
