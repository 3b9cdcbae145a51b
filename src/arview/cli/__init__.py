"""The command line: parse, call one function, print. Everything heavy is imported inside the commands."""

from arview.cli import (
    batch,
    calibrate,
    export,
    history,
    inspect,
    live,
    measure,
    reconstruct,
    report,
    study,
    tracking,
    verify,
)
from arview.cli.common import main

__all__ = [
    "batch",
    "calibrate",
    "export",
    "history",
    "inspect",
    "live",
    "main",
    "measure",
    "reconstruct",
    "report",
    "study",
    "tracking",
    "verify",
]
