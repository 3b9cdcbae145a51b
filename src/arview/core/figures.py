"""Matplotlib figures in one style, for reports and charts, without a change to matplotlib's global state."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from arview.core.extras import load

INK, MUTED, GRID = "#1c2430", "#5b6675", "#dfe4ea"
_STYLE: dict[str, Any] = {
    "svg.hashsalt": "arview",
    "font.family": "sans-serif",
    "font.sans-serif": ["Inter", "DejaVu Sans"],
    "font.size": 9.5,
    "text.color": INK,
    "axes.edgecolor": "#9aa5b1",
    "axes.labelcolor": MUTED,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.7,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
}


@contextmanager
def figure(
    height_in: float, width_in: float = 6.0, has_grid: bool = True, text_as_paths: bool = False, **options: Any
) -> Iterator[tuple[Any, Any]]:
    """Make a figure and its axes, to be saved before the block ends.

    Args:
        height_in, width_in: size in inches; a page may scale the figure.
        has_grid: draw a grid behind the data.
        text_as_paths: draw the text of an SVG as paths, which look the same
            everywhere; else it takes the font of the page.
        options: passed to ``Figure.subplots``.
    """
    logging.getLogger("matplotlib.font_manager").setLevel(logging.ERROR)  # Inter belongs to the page
    mpl = load("a figure", "matplotlib")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    settings: Any = _STYLE | {"axes.grid": has_grid, "svg.fonttype": "path" if text_as_paths else "none"}
    with mpl.rc_context(settings):
        made = Figure(figsize=(width_in, height_in), layout="constrained")
        FigureCanvasAgg(made)
        yield made, made.subplots(**options)
