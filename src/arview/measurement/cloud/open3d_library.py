"""Open3D, imported when it is first needed: it takes a second, and needs libraries of the system."""

from __future__ import annotations

from typing import Any

from arview.core.extras import load


def load_open3d() -> Any:
    """The module ``open3d``. Raises MissingDependencyError when it, or a library that it needs, is missing."""
    return load("a cloud of another program", "open3d")
