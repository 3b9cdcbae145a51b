"""Open3D, imported when it is first needed: it takes a second, and needs libraries of the system."""

from __future__ import annotations

from typing import Any

from arview.errors import InputError


def load_open3d() -> Any:
    """The module ``open3d``. Raises InputError when it, or a library that it needs, is missing."""
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise InputError(f"Open3D cannot be loaded ({error}); run tools/setup as root") from error
    return open3d
