"""Networks in the manner of a U-Net."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


def unet(torch: Any, first: Any, down: Sequence[Any], narrow: Sequence[Any], up: Sequence[Any], last: Any) -> Any:
    """A U-Net (Ronneberger et al., MICCAI 2015) of given modules, whose levels are added instead of concatenated.

    Args:
        torch: the module.
        first: from the input to the first level.
        down: from each level to the next, of half the size.
        narrow: from the channels of each level after the first to those of the level before.
        up: applied to each level after the next one has been added, the first level first.
        last: from the first level to the output.
    """
    nn = torch.nn

    class _UNet(nn.Module):  # type: ignore[name-defined]
        def __init__(self) -> None:
            super().__init__()
            self.first, self.last = first, last
            self.down, self.narrow, self.up = (nn.ModuleList(modules) for modules in (down, narrow, up))

        def forward(self, image: Any) -> Any:
            levels = [self.first(image)]
            for level in self.down:
                levels.append(level(levels[-1]))
            features = levels.pop()
            for level, narrow, up in zip(reversed(levels), reversed(self.narrow), reversed(self.up), strict=True):
                features = up(level + nn.functional.interpolate(narrow(features), scale_factor=2, mode="nearest"))
            return self.last(features)

    return _UNet()
