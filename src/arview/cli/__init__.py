"""The command line: parse, call one function, print. Everything heavy is imported inside the commands."""

from arview.cli import measure, reconstruct, study, tracking
from arview.cli.common import main

__all__ = ["main", "measure", "reconstruct", "study", "tracking"]
