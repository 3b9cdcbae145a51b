"""The command line: each command parses its options, calls one function of a library room and prints the result.

There is a file for each command; other packages add commands of their own (docs/reference/plug-ins.md). Heavy libraries
are imported inside the commands, so that ``arview --help`` is quick.
"""

from arview.cli import (
    annotate,
    batch,
    calibrate,
    capture,
    check,
    export,
    guideviews,
    history,
    history_statistics,
    inspect,
    live,
    measure,
    reconstruct,
    report,
    station,
    verify,
    warmup,
)
from arview.cli.common import Command, Group, main
from arview.cli.exit_codes import ExitCode

__all__ = [
    "Command",
    "ExitCode",
    "Group",
    "annotate",
    "batch",
    "calibrate",
    "capture",
    "check",
    "export",
    "guideviews",
    "history",
    "history_statistics",
    "inspect",
    "live",
    "main",
    "measure",
    "reconstruct",
    "report",
    "station",
    "verify",
    "warmup",
]
