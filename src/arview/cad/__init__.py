"""CAD in: models of named components, part files, ranges of viewpoints, fitness for tracking."""

from arview.cad.load import load_model
from arview.cad.model import Component, Model, make_model
from arview.cad.view_range import ViewRange

__all__ = ["Component", "Model", "ViewRange", "load_model", "make_model"]
