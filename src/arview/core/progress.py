"""The types of functions that are told how far a piece of work has come."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

Progress: TypeAlias = Callable[[str, int, int], None]
"""Called as ``progress(stage, done, total)``: the name of the stage, the steps done and the steps of that stage.

A total of 0 means that the number of steps is not known.
"""

StepProgress: TypeAlias = Callable[[int, int], None]
"""Called as ``progress(done, total)`` by work that has one stage only. A total of 0 means that it is not known."""
