"""Overlay: ghosts, edges, measured deviations, arrows and a status line, drawn on each frame."""

from arview.overlay.options import OverlayOptions
from arview.overlay.renderer import OverlayRenderer

__all__ = ["OverlayOptions", "OverlayRenderer"]
