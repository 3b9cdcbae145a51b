"""What arview's pages share: three.js in one file, read from the package (see ``tools/vendor-three``)."""

from __future__ import annotations

from importlib import resources


def three_js() -> str:
    """three.js and OrbitControls, minified, as a classic script that defines the global ``THREE``; MIT licence."""
    return (resources.files("arview.web") / "three.min.js").read_text(encoding="utf-8")
