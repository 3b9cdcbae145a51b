"""Which torch device the option ``--device`` means, and what is said when it fails."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from arview.core.extras import is_installed, require
from arview.errors import InputError

_PACKAGES = ("torch", "kornia")


def torch_device(device: str) -> str | None:
    """The torch device that ``device`` means, or None for the processor's own code.

    Args:
        device: ``auto`` (CUDA if torch finds it), ``cpu``, or a torch device such as ``cuda`` or ``cuda:1``.

    Raises:
        InputError: torch cannot use the device.
        MissingDependencyError: torch or kornia is not installed.
    """
    if device == "cpu" or (device == "auto" and not all(map(is_installed, _PACKAGES))):
        return None
    require(f"--device {device}", *_PACKAGES)
    import torch

    if device == "auto":
        return "cuda" if torch.cuda.is_available() else None
    try:
        torch.zeros(1, device=device).cpu()
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"device {device}: torch cannot use it ({reason}); use --device auto or cpu") from None
    return device


@contextmanager
def device_memory(device: str) -> Iterator[None]:
    """Work on a device without gradients; too little memory there becomes an InputError."""
    import torch

    try:
        with torch.no_grad():
            yield
    except torch.OutOfMemoryError:
        raise InputError(
            f"device {device}: too little memory; end other programs that use it, or use --device cpu"
        ) from None
