"""Overlay: what is drawn on each frame: CAD ghosts, edges, measured deviations, arrows and a status line."""

from arview.overlay.options import OverlayOptions
from arview.overlay.renderer import OverlayRenderer

__all__ = ["OverlayOptions", "OverlayRenderer"]
