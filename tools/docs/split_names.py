"""Names described together in docstrings, like ``width, height: …``, as rows of their own in the site's tables."""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension

TOGETHER = re.compile(r"^( +)(\w+(?:, \w+)+): (.*(?:\n\1 +.*)*)", re.MULTILINE)


class SplitNames(Extension):
    """Repeats the description for each name."""

    def on_object(self, *, obj: Any, **_: Any) -> None:
        """Change the docstring of a class or function before it is read."""
        if obj.docstring is not None:
            obj.docstring.value = split_names(obj.docstring.value)


def split_names(text: str) -> str:
    """The docstring with an entry for each name."""
    return TOGETHER.sub(lambda found: "\n".join(f"{found[1]}{name}: {found[3]}" for name in found[2].split(", ")), text)
