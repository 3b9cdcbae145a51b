"""The user's cache folder: guide views and compiled kernels that can be made again at any time."""

from __future__ import annotations

import os
from pathlib import Path


def cache_folder() -> Path:
    """``$ARVIEW_CACHE``, or ``arview`` in ``$XDG_CACHE_HOME`` or ``~/.cache``."""
    own = os.environ.get("ARVIEW_CACHE")
    if own:
        return Path(own)
    shared = os.environ.get("XDG_CACHE_HOME")
    return (Path(shared) if shared else Path.home() / ".cache") / "arview"
