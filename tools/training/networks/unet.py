"""Networks that see a picture level by level, each half as large as that before, and come up again to the first."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


def pyramid(torch: Any, first: Any, down: Sequence[Any], narrow: Sequence[Any], up: Sequence[Any], last: Any) -> Any:
    """A network of modules in the manner of a U-Net (Ronneberger et al., MICCAI 2015), levels added.

    Args:
        torch: the module.
        first: makes the first level of a picture; last: tells of it what is wanted.
        down: make each level of that before.
        narrow: make what each of these saw as narrow as the level before.
        up: see both together.
    """
    nn = torch.nn

    class _Pyramid(nn.Module):  # type: ignore[misc, name-defined]
        def __init__(self) -> None:
            super().__init__()
            self.first, self.last = first, last
            self.down, self.narrow, self.up = (nn.ModuleList(modules) for modules in (down, narrow, up))

        def forward(self, shown: Any) -> Any:
            levels = [self.first(shown)]
            for level in self.down:
                levels.append(level(levels[-1]))
            seen = levels.pop()
            for level, narrow, up in zip(reversed(levels), reversed(self.narrow), reversed(self.up), strict=True):
                seen = up(level + nn.functional.interpolate(narrow(seen), scale_factor=2, mode="nearest"))
            return self.last(seen)

    return _Pyramid()
