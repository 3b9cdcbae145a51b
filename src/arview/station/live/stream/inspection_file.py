"""An ``inspection.json`` that may change while the server runs: the last valid one is kept and faults are reported."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from arview import overlay
from arview.cad import Model
from arview.core.messages import sentence
from arview.errors import ArviewError, MismatchError
from arview.inspection import Inspection, load_inspection
from arview.station.live.stream.notices import Notice, without_folder

_State = tuple[int, int, int] | None
CLOCK_SLACK_S = 300.0
"""Difference of two machines' clocks that nobody is told of."""


class InspectionFile:
    """The inspection that is shown, and the notices about it.

    Args:
        path: the file; it must be valid when the server starts.
        model: the model that the inspection must belong to.
        serial: serial number of the part at the station; None: any.
        max_age_s: age above which a notice calls the inspection old; None: never.

    Attributes:
        inspection: the last valid inspection.

    Raises:
        InputError, MismatchError: the file cannot be read or belongs to another model.
    """

    def __init__(self, path: Path, model: Model, serial: str | None, max_age_s: float | None) -> None:
        self.path, self._model = path, model
        self._serial, self._max_age_s = serial, max_age_s
        self._read_state = self._file_state()
        self.inspection: Inspection = load_inspection(path, model)
        self._fault: Notice | None = None
        self._unreadable_state: _State = None

    def reload(self) -> bool:
        """Read the file if it has changed; returns whether another inspection is shown now.

        A file that cannot be read is reported at the second attempt only, because it may be in the middle of a write.
        """
        state = self._file_state()
        if state == self._read_state:
            return False
        try:
            inspection = load_inspection(self.path, self._model)
        except ArviewError as error:
            if state == self._unreadable_state:
                code = "inspection_model" if isinstance(error, MismatchError) else "inspection_unreadable"
                self._fault = Notice(
                    code, "error", f"{without_folder(str(error), self.path)}; the last valid one is shown"
                )
                self._read_state = state
            self._unreadable_state = state
            return False
        self._read_state, self._unreadable_state, self._fault = state, None, None
        is_new = inspection != self.inspection
        self.inspection = inspection
        return is_new

    def notices(self, now: datetime | None = None) -> list[Notice]:
        """The notices about the inspection at this time (default: now)."""
        notices = [self._fault] if self._fault else []
        notices += age_notices(self.inspection, self._max_age_s, now)
        measured = self.inspection.serial
        if self._serial and measured != self._serial:
            key, given = ("serial", {"serial": measured}) if measured else ("no_serial", {})
            text = sentence(f"told.inspection_{key}", own=self._serial, **given)
            notices.append(Notice("inspection_serial", "error", text))
        return notices

    def _file_state(self) -> _State:
        """Modification time, size and inode, which change whenever the file does; None when there is no file."""
        try:
            stat = self.path.stat()
        except OSError:
            return None
        return stat.st_mtime_ns, stat.st_size, stat.st_ino


def age_notices(inspection: Inspection, max_age_s: float | None, now: datetime | None = None) -> list[Notice]:
    """The notices about the age of an inspection at this time (default: now): too old, or from the future."""
    age_s = inspection.age_s(now or datetime.now(UTC))
    if age_s < -CLOCK_SLACK_S:
        text = sentence("told.future", lead=_lead_text(-age_s))
        return [Notice("inspection_future", "warning", text)]
    if max_age_s is not None and age_s > max_age_s:
        return [Notice("inspection_old", "warning", sentence("told.old", age=overlay.age_text(age_s)))]
    return []


def _lead_text(lead_s: float) -> str:
    """How far a time lies ahead."""
    for unit, length_s in (("d", 86400.0), ("h", 3600.0)):
        if lead_s >= 2 * length_s:
            return f"{lead_s / length_s:.0f} {unit}"
    return f"{lead_s / 60.0:.0f} min"
