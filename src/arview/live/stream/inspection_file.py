"""inspection.json as it changes while the server runs: the last good one is kept, and what is wrong is said."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from arview.cad.model import Model
from arview.errors import ArviewError, MismatchError
from arview.inspection import Inspection, load_inspection
from arview.live.stream.notices import Notice, without_folder
from arview.overlay.status import age_text

_State = tuple[int, int, int] | None


class InspectionFile:
    """The inspection that is shown, and what is to be said of it.

    Args:
        path: of the file; it must be good when the server starts.
        model: that the inspection must belong to.
        serial: of the specimen at hand; None: any.
        max_age_s: an older inspection is called old; None: never.

    Raises:
        InputError, MismatchError: the file cannot be read or belongs to another model.
    """

    def __init__(self, path: Path, model: Model, serial: str | None, max_age_s: float | None) -> None:
        self.path, self._model = path, model
        self._serial, self._max_age_s = serial, max_age_s
        self._seen = self._file_state()
        self.inspection: Inspection = load_inspection(path, model)
        self._trouble: Notice | None = None
        self._doubted: _State = None

    def reload(self) -> bool:
        """Look whether the file has changed, and read it if so; True when another inspection is shown now.

        A file that cannot be read is looked at once more before it is complained of: it may be being written.
        """
        state = self._file_state()
        if state == self._seen:
            return False
        try:
            inspection = load_inspection(self.path, self._model)
        except ArviewError as error:
            if state == self._doubted:
                code = "inspection_model" if isinstance(error, MismatchError) else "inspection_unreadable"
                self._trouble = Notice(
                    code, "error", f"{without_folder(str(error), self.path)}; the last good one stays"
                )
                self._seen = state
            self._doubted = state
            return False
        self._seen, self._doubted, self._trouble = state, None, None
        is_new = inspection != self.inspection
        self.inspection = inspection
        return is_new

    def notices(self, now: datetime | None = None) -> list[Notice]:
        """What is to be said of the inspection at this moment."""
        said = [self._trouble] if self._trouble else []
        age_s = self.inspection.age_s(now or datetime.now(UTC))
        if self._max_age_s is not None and age_s > self._max_age_s:
            said.append(Notice("inspection_old", "warning", f"measured {age_text(age_s)}: measure again"))
        measured = self.inspection.serial
        if self._serial and measured != self._serial:
            other = f"of {measured}" if measured else "without a serial number"
            said.append(Notice("inspection_serial", "error", f"the inspection is {other}, this part is {self._serial}"))
        return said

    def _file_state(self) -> _State:
        """Changes whenever the file does."""
        try:
            stat = self.path.stat()
        except OSError:
            return None
        return stat.st_mtime_ns, stat.st_size, stat.st_ino
