"""The append-only log of decisions: JSON lines, each with the SHA-256 of the line before, and a file with its end.

A hash chain (Haber and Stornetta 1991) shows that a line was changed, removed or put between others. The end of the
chain is in a file of its own, so that lines removed at the end are found too. Neither stops someone who writes both
files anew: the results store (`arview history`) keeps a copy that can be compared.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any

from arview.core.durable import append_durably, replace_durably, set_aside
from arview.errors import InputError, OutputError
from arview.quality.decisions.entry import FIRST, Decision, checked_name, checked_text, entry_of, line_of


@dataclass(frozen=True)
class LogContent:
    """What a log holds.

    Attributes:
        entries: that can be read, in their order.
        faults: a sentence for each line that was changed, removed or cannot be read.
        torn: the last line if its writing was cut off; empty otherwise.
        notices: sentences about lines that were or will be set aside; not a fault.
    """

    entries: tuple[Decision, ...] = ()
    faults: tuple[str, ...] = ()
    torn: bytes = b""
    notices: tuple[str, ...] = ()


acting_device: ContextVar[str] = ContextVar("acting_device", default="")
"""The paired device for which this thread or task works."""


class DecisionLog:
    """The decisions, ticks and signatures of one inspection or job.

    Several processes and threads may use one file: each addition takes the lock of the file, reads what others added,
    and returns when the entry is on the disk.

    Args:
        path: of the log, ``decisions.jsonl``. It is made by the first addition.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)

    @property
    def end_path(self) -> Path:
        """File with the number and the hash of the last entry."""
        return self.path.with_suffix(".end.json")

    @property
    def torn_path(self) -> Path:
        """File with lines that were cut off by a crash."""
        return self.path.with_suffix(".torn.jsonl")

    def decide(
        self,
        component: str,
        is_ok: bool,
        reason: str,
        note: str = "",
        by: str = "",
        photo: str | None = None,
        inspection_sha256: str = "",
    ) -> Decision:
        """Add a decision about a component: whether it is taken as it is, why, and by whom.

        Raises:
            InputError: a text is missing, too long or of another type; a component is not taken without a reason; or
                the log was changed.
            OutputError: the log cannot be written.
        """
        if type(is_ok) is not bool:
            raise InputError("is_ok: expected true or false")
        entry = Decision(
            number=0,
            kind="decision",
            time=_now(),
            by=checked_name(by, "by"),
            component=checked_name(component, "component"),
            is_ok=is_ok,
            reason=checked_text(reason, "reason", required=not is_ok),
            note=checked_text(note, "note"),
            photo=None if photo is None else checked_name(photo, "photo"),
            inspection_sha256=_checked_hash(inspection_sha256),
        )
        return self._append(entry)

    def tick(self, component: str, step: int, is_done: bool, by: str) -> Decision:
        """Add the tick of a step of the rework of a component, or take it away.

        Raises:
            InputError: as `decide`; or the step is no index.
            OutputError: the log cannot be written.
        """
        if type(step) is not int or not 0 <= step < 1000:
            raise InputError("step: expected the index of a step, from 0")
        if type(is_done) is not bool:
            raise InputError("is_done: expected true or false")
        entry = Decision(
            number=0,
            kind="tick",
            time=_now(),
            by=checked_name(by, "by"),
            component=checked_name(component, "component"),
            step=step,
            is_done=is_done,
        )
        return self._append(entry)

    def sign(self, by: str, note: str = "", inspection_sha256: str = "", rechecks: Sequence[str] = ()) -> Decision:
        """Add a signature.

        Args:
            by: who signs.
            note: free text.
            inspection_sha256: fingerprint of the values that are signed, see `values_fingerprint`.
            rechecks: those of the checks of reworked components that belong to it, in their order.

        Raises:
            InputError: as `decide`; or there is no fingerprint.
            OutputError: the log cannot be written.
        """
        if not inspection_sha256:
            raise InputError("sign: the fingerprint of the inspection is missing")
        entry = Decision(
            number=0,
            kind="signature",
            time=_now(),
            by=checked_name(by, "by"),
            note=checked_text(note, "note"),
            inspection_sha256=_checked_hash(inspection_sha256),
            rechecks=tuple(_checked_hash(one) for one in rechecks),
        )
        return self._append(entry)

    def entries(self) -> tuple[Decision, ...]:
        """All entries that can be read, in their order; see `faults` for whether they can be relied upon."""
        return self.content().entries

    def faults(self) -> tuple[str, ...]:
        """A sentence for each line that was changed or removed after it was written; none for a log as it was."""
        return self.content().faults

    def latest(self) -> dict[str, Decision]:
        """The latest decision about each component, by its name."""
        return {one.component: one for one in self.entries() if one.kind == "decision"}

    def ticks(self) -> dict[str, dict[int, bool]]:
        """Whether the steps of each component that were ticked are done."""
        found: dict[str, dict[int, bool]] = {}
        for one in self.entries():
            if one.kind == "tick" and one.step is not None:
                found.setdefault(one.component, {})[one.step] = bool(one.is_done)
        return found

    def signature(self, inspection_sha256: str | None = None) -> Decision | None:
        """The last signature if it holds: no decision follows it, and it is of the values of this fingerprint.

        Args:
            inspection_sha256: fingerprint of the values as they are now; None leaves that unchecked.
        """
        content = self.content()
        last = None
        for one in content.entries:
            if one.kind == "signature":
                last = one
            elif one.kind == "decision":
                last = None
        if last is None or content.faults:
            return None
        return last if inspection_sha256 in (None, last.inspection_sha256) else None

    def content(self) -> LogContent:
        """Everything that the log holds, with its faults.

        Raises:
            InputError: the log cannot be read.
        """
        if not self.path.exists():
            end = self._read_end()
            if end is None:
                return LogContent()
            return LogContent(faults=(f"{self.path.name}: the file with {_entries(end[0])} was removed",))
        try:
            with self.path.open("rb") as file, _locked(file, fcntl.LOCK_SH):
                return self._parsed(file.read())
        except OSError as error:
            raise InputError(f"{self.path}: cannot be read ({error.strerror or error})") from error

    # ---- inside

    def _append(self, entry: Decision) -> Decision:
        """Add an entry behind the last one, under the lock; a torn line is set aside first."""
        try:
            with self.path.open("a+b", buffering=0) as file, _locked(file, fcntl.LOCK_EX):
                file.seek(0)
                data = file.read()
                content = self._parsed(data)
                if content.faults:
                    raise InputError(
                        f"{self.path}: {'; '.join(content.faults)}. Nothing is added to a log that was changed: keep it"
                        " and move it away to begin a new one"
                    )
                last = content.entries[-1] if content.entries else None
                made = replace(
                    entry,
                    number=1 if last is None else last.number + 1,
                    previous=FIRST if last is None else last.sha256,
                    device=acting_device.get(),
                )
                line = line_of(made)
                made = replace(made, sha256=_sha256(line))
                if content.torn:
                    set_aside(self.torn_path, content.torn)
                    data = data.removesuffix(content.torn)
                    file.truncate(len(data))
                # A last line that is whole but for its end gets it.
                append_durably(file, len(data), (b"\n" if data and not data.endswith(b"\n") else b"") + line + b"\n")
                self._write_end(made)
        except OSError as error:
            raise OutputError(f"{self.path}: the entry was not kept ({error.strerror or error})") from error
        return made

    def _parsed(self, data: bytes) -> LogContent:
        """The entries of the file's bytes and what is wrong with them."""
        name = self.path.name
        lines = data.split(b"\n")
        rest = lines.pop()
        entries: list[Decision] = []
        faults: list[str] = []
        notices = list(self._set_aside_before())
        before: str | None = FIRST  # None after a line that cannot be read, which is a fault already
        expected = 1
        for number, line in enumerate(lines, 1):
            try:
                entry = entry_of(line, _sha256(line))
            except (ValueError, KeyError, RecursionError) as error:
                faults.append(f"{name}: line {number} cannot be read ({_short(error)}): it was changed")
                before, expected = None, expected + 1
                continue
            faults += self._chain_fault(number, entry, expected, before)
            entries.append(entry)
            before, expected = entry.sha256, entry.number + 1
        torn = b""
        if rest:
            try:
                entry = entry_of(rest, _sha256(rest))
                if entry.previous != before:
                    raise ValueError("not the next line")
                entries.append(entry)
            except (ValueError, KeyError, RecursionError):
                torn = rest
                notices.append(
                    f"{name}: the writing of line {len(lines) + 1} was cut off ({len(rest)} bytes): it was never"
                    f" confirmed; the next entry moves it to {self.torn_path.name}"
                )
        if not faults:
            faults += self._end_fault(entries)
        return LogContent(tuple(entries), tuple(faults), torn, tuple(notices))

    def _chain_fault(self, number: int, entry: Decision, expected: int, before: str | None) -> list[str]:
        """What is wrong between an entry and the line before it, whose hash is ``before``."""
        name = self.path.name
        if before is None or (entry.previous == before and entry.number == expected):
            return []
        if entry.previous == before:
            return [f"{name}: line {number} says that it is entry {entry.number}, not {expected}: it was changed"]
        if entry.number > expected:
            gone = entry.number - expected
            return [f"{name}: {_entries(gone)} before line {number} {'were' if gone > 1 else 'was'} removed"]
        if number == 1:
            return [f"{name}: line 1 was changed: it does not begin the log"]
        return [f"{name}: line {number - 1} was changed: line {number} names another hash for it"]

    def _end_fault(self, entries: list[Decision]) -> list[str]:
        """What the file with the end of the log says against its last lines."""
        end = self._read_end()
        if end is None:
            if len(entries) > 1:
                return [f"{self.end_path.name}: is missing or cannot be read: removed last lines would not be found"]
            return []
        number, digest = end
        if number > len(entries):
            gone = number - len(entries)
            return [f"{self.path.name}: the last {_entries(gone)} {'were' if gone > 1 else 'was'} removed"]
        if entries[number - 1].sha256 != digest:
            return [f"{self.path.name}: line {number} was changed: {self.end_path.name} names another hash for it"]
        return []

    def _read_end(self) -> tuple[int, str] | None:
        try:
            document: Any = json.loads(self.end_path.read_bytes())
            number, digest = document["entry"], document["sha256"]
        except (OSError, ValueError, TypeError, KeyError):
            return None
        return (number, digest) if type(number) is int and number > 0 and isinstance(digest, str) else None

    def _write_end(self, last: Decision) -> None:
        document = {"entry": last.number, "sha256": last.sha256}
        replace_durably(self.end_path, json.dumps(document).encode() + b"\n")

    def _set_aside_before(self) -> Iterator[str]:
        if self.torn_path.exists():
            yield f"{self.torn_path.name} holds a line that a crash cut off; it was never confirmed"


@contextmanager
def _locked(file: IO[bytes], kind: int) -> Iterator[None]:
    """Hold the lock of an open file; a process that dies gives it back."""
    fcntl.flock(file, kind)
    try:
        yield
    finally:
        fcntl.flock(file, fcntl.LOCK_UN)


def _now() -> datetime:
    """The time to the millisecond, as the log keeps it."""
    now = datetime.now(UTC)
    return now.replace(microsecond=now.microsecond // 1000 * 1000)


def _checked_hash(value: object) -> str:
    if not isinstance(value, str) or (value and (len(value) != 64 or set(value) - set("0123456789abcdef"))):
        raise InputError("inspection_sha256: expected the SHA-256 of an inspection, 64 hexadecimal digits")
    return value


def _sha256(line: bytes) -> str:
    return hashlib.sha256(line).hexdigest()


def _entries(count: int) -> str:
    return "1 entry" if count == 1 else f"{count} entries"


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:60]
