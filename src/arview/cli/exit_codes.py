"""The exit codes of all commands, in one table."""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from arview.annotation import AnnotateSummary


class ExitCode(IntEnum):
    """How a command ended.

    0 to 3 are results. Errors lie above them: 64 and 70 are EX_USAGE and EX_SOFTWARE of ``sysexits.h``; 130 and 141
    are what a shell reports for SIGINT and SIGPIPE (128 plus the number of the signal).
    """

    DONE = 0
    FAIL = 1
    UNDECIDED = 2
    CANNOT_MEASURE = 3
    BAD_INPUT = 64
    BUG = 70
    INTERRUPTED = 130
    CLOSED_PIPE = 141

    @property
    def meaning(self) -> str:
        """One phrase for the help texts and the documentation."""
        return _MEANINGS[self]


_MEANINGS = {
    ExitCode.DONE: "done, or everything passes",
    ExitCode.FAIL: "a check fails",
    ExitCode.UNDECIDED: "nothing fails, but something is undecided",
    ExitCode.CANNOT_MEASURE: "the input can be read but not measured",
    ExitCode.BAD_INPUT: "bad input or usage, or no output can be written",
    ExitCode.BUG: "a bug in arview",
    ExitCode.INTERRUPTED: "interrupted",
    ExitCode.CLOSED_PIPE: "the reader of the output closed the pipe",
}
_ERRORS = (ExitCode.BAD_INPUT, ExitCode.BUG, ExitCode.INTERRUPTED)
_VERDICTS = {
    "pass": ExitCode.DONE,
    "fail": ExitCode.FAIL,
    "measured": ExitCode.DONE,
    "undecided": ExitCode.UNDECIDED,
    "not_measured": ExitCode.CANNOT_MEASURE,
    "error": ExitCode.CANNOT_MEASURE,
}


def exit_code_of(verdict: str) -> ExitCode:
    """Exit code of a verdict: ``pass``, ``fail``, ``undecided``, ``measured``, ``not_measured`` or ``error``."""
    return _VERDICTS[verdict]


def help_rows(results: dict[ExitCode, str] | None = None) -> list[tuple[str, str]]:
    """Rows of the table of exit codes in a command's help: the code, or several, and what they mean.

    Args:
        results: what the results of this command mean; those not named are left out, except 0. Errors may be named
            too, to say more of them; the others share a row.
    """
    meanings = {ExitCode.DONE: "done"} | (results or {})
    others = [code for code in _ERRORS if code not in meanings]
    rows = [(str(int(code)), meanings[code]) for code in sorted(meanings)]
    return [*rows, (", ".join(str(int(code)) for code in others), "; ".join(code.meaning for code in others))]


def group_rows() -> list[tuple[str, str]]:
    """Rows of the table of exit codes in the help of a group of commands: results share one row, errors another."""
    results = [code for code in ExitCode if code < ExitCode.BAD_INPUT]
    meanings = {ExitCode.DONE: "; ".join(code.meaning for code in results)}
    (_, told), errors = help_rows(meanings)
    return [(", ".join(str(int(code)) for code in results), told), errors]


def finding_exit_code(summary: AnnotateSummary) -> ExitCode:
    """Exit code by whether each specimen was found in at least one frame."""
    from arview.pose import TrackingState

    found = (TrackingState.TRACKED, TrackingState.CRITICAL)
    is_found = all(any(one.states.get(state) for state in found) for one in summary.specimens.values())
    return ExitCode.DONE if is_found else ExitCode.CANNOT_MEASURE


def presence_exit_code(summary: AnnotateSummary) -> ExitCode:
    """Exit code by the presence of all components of all specimens at the end of a run."""
    from arview.pose import Completeness

    found = {one.completeness for one in summary.specimens.values()}
    if Completeness.INCOMPLETE in found:
        return ExitCode.FAIL
    if not found or found == {None}:
        return ExitCode.CANNOT_MEASURE
    return ExitCode.DONE if found == {Completeness.COMPLETE} else ExitCode.UNDECIDED
