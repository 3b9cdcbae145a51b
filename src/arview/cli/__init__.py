"""The command line: each command parses its options, calls one function of a library room and prints the result.

There is a file for each command. Heavy libraries are imported inside the commands, so that ``arview --help`` is quick.
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
    inspect,
    live,
    measure,
    reconstruct,
    report,
    verify,
    warmup,
)
from arview.cli.common import main
from arview.cli.exit_codes import ExitCode

__all__ = [
    "ExitCode",
    "annotate",
    "batch",
    "calibrate",
    "capture",
    "check",
    "export",
    "guideviews",
    "history",
    "inspect",
    "live",
    "main",
    "measure",
    "reconstruct",
    "report",
    "verify",
    "warmup",
]
