"""Assets that the pages of arview share: three.js in one file and a font (see ``tools/vendor-web``)."""

from __future__ import annotations

from importlib import resources


def three_js() -> str:
    """three.js and OrbitControls, minified, as a classic script that defines the global ``THREE``; MIT licence."""
    return (resources.files("arview.web") / "three.min.js").read_text(encoding="utf-8")


def font(name: str) -> bytes:
    """Inter as WOFF2, SIL Open Font Licence: ``inter-400`` and ``inter-600`` (Latin), ``inter-greek-400``."""
    return (resources.files("arview.web") / f"{name}.woff2").read_bytes()
