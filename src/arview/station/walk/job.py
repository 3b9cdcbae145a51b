"""The folder of a job: what was photographed of one specimen, and how far its measurement is.

| file | content |
|---|---|
| ``job.json`` | part, serial, camera; of a re-check also its first measurement and the components |
| ``photos/`` | the photos as they were received |
| ``photos.jsonl`` | a line for each photo, for one taken back, for the end of the walk and its reopening; append-only |
| ``taken_back/`` | photos that were taken back, which count no more |
| ``state.json`` | `WalkState`, written by the worker |
| ``part/`` | the part file, its CAD and what they name, as they were when the job began |
| ``rough/inspection.json`` | provisional numbers of the first photos |
| ``recheck/NN/`` | jobs of single components measured again |
| all else | what ``arview inspect`` writes |

A photo counts when its line is on the disk, and a line is written after the photo itself: whatever was confirmed
survives a crash or a power cut. A line that was cut off by one is set aside and told.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from arview.cad import Model, Part
from arview.core.atomic import replacing
from arview.core.durable import append_durably, replace_durably, set_aside
from arview.errors import InputError, OutputError
from arview.inspection import Inspection, load_inspection
from arview.quality import decisions
from arview.station.walk.frozen_part import freeze_part
from arview.station.walk.records import (
    PhotoOrigin,
    StoredPhoto,
    WalkState,
    checked_hint,
    checked_time,
    parse_line,
    photo_of_line,
    suffix_of,
    utc_now,
)

FORMAT, VERSION = "arview job", 1
_MAX_SERIAL = 100
_UNSAFE = re.compile(r"[^A-Za-z0-9.-]+")


@dataclass(frozen=True)
class JobFolder:
    """A job in its folder.

    Attributes:
        path: of the folder.
        document: content of ``job.json``.
    """

    path: Path
    document: Mapping[str, Any]

    @staticmethod
    def create(jobs: Path, part: Part, part_path: str | Path, serial: str, camera: str | None = None) -> JobFolder:
        """Make the folder of a new job.

        Args:
            jobs: folder of all jobs; made when missing.
            part: the part.
            part_path: its file.
            serial: serial number of the specimen.
            camera: calibrated camera of the photos, or ``fov:DEG``; None: from their EXIF data.

        Raises:
            InputError: there is no serial number, or it is too long.
            OutputError: the folder cannot be made.
        """
        serial = serial.strip()
        if not serial or len(serial) > _MAX_SERIAL or not serial.isprintable():
            raise InputError(f"a job needs a serial number of 1 to {_MAX_SERIAL} characters")
        now = datetime.now(UTC)
        name = f"{_safe(part.name)}_{_safe(serial)}_{now:%Y%m%dT%H%M%S}"
        folder, job_id = _new_folder(Path(jobs), name)
        document = {
            "format": FORMAT,
            "version": VERSION,
            "id": job_id,
            "part": str(Path(part_path).resolve()),
            "frozen_part": freeze_part(Path(part_path), folder),
            "part_name": part.name,
            "model_hash": part.model.source_hash,
            "serial": serial,
            "created": now.isoformat(),
            "camera": camera,
            "parent": None,
            "components": None,
        }
        return _written(folder, document)

    @staticmethod
    def open(path: str | Path) -> JobFolder:
        """The job in a folder. Raises InputError when there is none, or one of a newer version."""
        path = Path(path)
        try:
            document = json.loads((path / "job.json").read_text(encoding="utf-8"))
        except OSError as error:
            raise InputError(f"{path}: is no job folder (job.json: {error.strerror or error})") from error
        except ValueError as error:
            raise InputError(f"{path / 'job.json'}: is damaged ({error})") from error
        if not isinstance(document, dict) or document.get("format") != FORMAT:
            raise InputError(f"{path}: is no job folder; give one that a walk has made")
        if document.get("version") != VERSION:
            raise InputError(f"{path}: is a job of version {document.get('version')}; this arview reads {VERSION}")
        texts = ("id", "part", "part_name", "model_hash", "serial", "created")
        wrong = [key for key in texts if not isinstance(document.get(key), str)]
        if wrong:
            raise InputError(f"{path / 'job.json'}: {', '.join(wrong)}: expected a text")
        return JobFolder(path, document)

    @property
    def id(self) -> str:
        """Name of the job, unique at its station: that of its folder, so that a copy is a job of its own."""
        first = self.parent
        return self.path.resolve().name if first is None else f"{first.id}_r{self.path.name}"

    @property
    def part_file(self) -> Path:
        """The part file as it was when the job began; of a job of an older version the file itself."""
        frozen = self.document.get("frozen_part")
        return Path(str(self.document["part"])) if frozen is None else (self.parent or self).path / str(frozen)

    @property
    def serial(self) -> str:
        """Serial number of the specimen."""
        return str(self.document["serial"])

    @property
    def components(self) -> tuple[str, ...] | None:
        """Components that a re-check measures again; None for a first measurement."""
        given = self.document.get("components")
        return None if given is None else tuple(given)

    @property
    def parent(self) -> JobFolder | None:
        """The first measurement of a re-check; None for a first measurement."""
        return JobFolder.open(self.path.parent.parent) if self.document.get("parent") else None

    # --- photos ------------------------------------------------------------------------------------------

    def add_photo(
        self,
        content: bytes,
        sha256: str,
        source: PhotoOrigin = "upload",
        hint: Mapping[str, Any] | None = None,
        taken: str | datetime | None = None,
    ) -> str:
        """Store a photo; it is on the disk when this returns.

        Args:
            content: of its file.
            sha256: of the content, hexadecimal.
            source: how it was taken.
            hint: see `StoredPhoto`.
            taken: when; None: now.

        Returns:
            The name of the photo; the same content twice has the name of the first.

        Raises:
            InputError: the content does not have this hash or is no photo, the hint is none, or the walk has ended.
            OutputError: the disk is full or the folder cannot be written to.
        """
        sha256 = sha256.lower()
        if hashlib.sha256(content).hexdigest() != sha256:
            raise InputError("the photo does not have the hash that was sent with it; send it again")
        suffix = suffix_of(content)
        hint, taken = checked_hint(hint), checked_time(taken)
        with self._exclusive():
            log = _read_log(self.path / "photos.jsonl")
            for photo in log.photos:
                if photo.sha256 == sha256:
                    return photo.name
            if log.is_ended:
                raise InputError(f"job {self.id}: its walk has ended; reopen it to add photos")
            name = f"{log.lines + 1:04d}{suffix}"
            photo = photo_of_line(
                {"name": name, "sha256": sha256, "bytes": len(content), "taken": taken, "source": source, "hint": hint}
            )
            try:
                replace_durably(self.path / "photos" / name, content)
            except OSError as error:
                raise _cannot_write(self.path, error) from error
            self._append(vars(photo), log)
        return name

    def take_back(self, name: str, why: str = "unwanted") -> None:
        """Take a photo back: it is moved to ``taken_back/`` and counts no more.

        Args:
            name: of the photo.
            why: a word for the log, such as ``blurred``.

        Raises:
            InputError: there is no such photo, or the walk has ended.
            OutputError: the folder cannot be written to.
        """
        with self._exclusive():
            log = _read_log(self.path / "photos.jsonl")
            if log.is_ended or name not in {photo.name for photo in log.photos}:
                raise InputError(f"job {self.id}: {name} is no photo that can be taken back; reopen a walk that ended")
            self._append({"taken_back": name, "why": why, "time": utc_now()}, log)
            (self.path / "taken_back").mkdir(exist_ok=True)
            (self.path / "photos" / name).replace(self.path / "taken_back" / name)

    def photos(self) -> tuple[StoredPhoto, ...]:
        """All photos that were confirmed and not taken back, in the order in which they came."""
        return _read_log(self.path / "photos.jsonl").photos

    def remove_unconfirmed(self) -> None:
        """Remove files of photos that were never confirmed, because a crash came before their line was written."""
        with self._exclusive():
            kept = {photo.name for photo in self.photos()}
            for path in (self.path / "photos").iterdir():
                if path.name not in kept:
                    path.unlink(missing_ok=True)

    def faults(self) -> tuple[str, ...]:
        """What is wrong with the list of photos: lines that were cut off or damaged."""
        return _read_log(self.path / "photos.jsonl").faults

    @property
    def is_ended(self) -> bool:
        """Whether no more photos come."""
        return _read_log(self.path / "photos.jsonl").is_ended

    @property
    def ended(self) -> datetime | None:
        """When the walk ended; None while it has not."""
        return _read_log(self.path / "photos.jsonl").ended

    def end(self) -> None:
        """No more photos come. Ending twice is no error."""
        self._mark("end", lambda log: not log.is_ended)

    def reopen(self) -> None:
        """More photos come after all. Raises InputError when the job is signed."""
        if self.is_signed:
            raise InputError(f"job {self.id}: is signed, and stays as it is; start a new inspection of {self.serial}")
        self._mark("reopened", lambda log: log.is_ended)

    def _mark(self, what: str, is_wanted: Any) -> None:
        with self._exclusive():
            log = _read_log(self.path / "photos.jsonl")
            if is_wanted(log):
                self._append({what: utc_now()}, log)

    def _append(self, document: Mapping[str, Any], log: _Log) -> None:
        """Append a line; a torn line at the end of the file is moved to ``photos.torn`` first."""
        path = self.path / "photos.jsonl"
        line = (json.dumps(document, ensure_ascii=False, allow_nan=False) + "\n").encode()
        try:
            if log.torn:
                set_aside(self.path / "photos.torn", log.torn)
                os.truncate(path, log.size - len(log.torn))
            size = log.size - len(log.torn)
            with path.open("ab", buffering=0) as file:
                append_durably(file, size, line)
        except OSError as error:
            raise _cannot_write(self.path, error) from error

    @contextmanager
    def _exclusive(self) -> Iterator[None]:
        """One writer at a time, of all threads and processes."""
        try:
            file = (self.path / ".photos.lock").open("w")
        except OSError as error:
            raise _cannot_write(self.path, error) from error
        with _WRITERS, file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield

    @property
    def is_signed(self) -> bool:
        """Whether somebody has signed what was measured: nothing of it is changed any more.

        The log is that of the first measurement; of its signatures those count for a re-check that came after its end.
        """
        return any(
            entry.kind == "signature" and (self.components is None or bool(self.ended and entry.time >= self.ended))
            for entry in decisions.log_of(self.path).entries()
        )

    # --- state and results -------------------------------------------------------------------------------

    def state(self) -> WalkState:
        """How far the measurement is; ``collecting`` before the worker has said anything."""
        try:
            document = json.loads((self.path / "state.json").read_text(encoding="utf-8"))
            return WalkState.of_document(document)
        except FileNotFoundError:
            return WalkState(photos=len(self.photos()))
        except (OSError, ValueError, InputError):
            return WalkState(photos=len(self.photos()), text="state.json is damaged; the worker writes it anew")

    def write_state(self, state: WalkState) -> None:
        """Replace the state. Raises OutputError."""
        content = json.dumps(replace(state, updated=utc_now()).document(), ensure_ascii=False, indent=1) + "\n"
        try:
            with replacing(self.path / "state.json") as file:
                file.write(content.encode())
        except OSError as error:
            raise _cannot_write(self.path, error) from error

    def inspection(self, model: Model | None = None) -> Inspection | None:
        """The newest inspection, or None while there is none.

        Raises:
            InputError: its file is damaged.
            MismatchError: it belongs to another model.
        """
        path = self.inspection_path
        return None if path is None else load_inspection(path, model)

    @property
    def inspection_path(self) -> Path | None:
        """File of the newest inspection: the final one, else the rough one, else None."""
        places = (self.path / "inspection.json", self.path / "rough" / "inspection.json")
        return next((path for path in places if path.is_file()), None)

    # --- re-checks ---------------------------------------------------------------------------------------

    def recheck(self, components: Sequence[str]) -> JobFolder:
        """Make the job of a re-check of some components; that of a re-check belongs to the first measurement.

        Raises:
            InputError: no component is named, one is unknown, or the first measurement is not finished.
            OutputError: the folder cannot be made.
        """
        first = self.parent or self
        path = first.path / "inspection.json"
        if first.state().stage != "done" or not path.is_file():
            raise InputError(f"job {first.id}: is not measured yet, so nothing of it can be checked again")
        names = [one.name for one in load_inspection(path).components]
        unknown = [name for name in components if name not in names]
        if unknown or not components:
            raise InputError(f"check again: {', '.join(unknown) or 'no component'}; known are {', '.join(names)}")
        folder, number = _new_folder(first.path / "recheck", "")
        document = dict(first.document) | {
            "id": f"{first.id}_r{number}",
            "created": utc_now(),
            "parent": first.id,
            "components": [name for name in names if name in components],
        }
        return _written(folder, document)

    def rechecks(self) -> list[JobFolder]:
        """The re-checks of a first measurement, oldest first."""
        return _jobs_below(self.path / "recheck")


def jobs_in(folder: str | Path) -> list[JobFolder]:
    """All jobs in a folder, oldest first, each followed by its re-checks; what is no job is skipped."""
    first = sorted(_jobs_below(Path(folder)), key=lambda one: (str(one.document["created"]), one.id))
    return [one for job in first for one in (job, *job.rechecks())]


def start_worker(
    job: JobFolder, scheduler: str | None = None, resources: Mapping[str, float] | None = None
) -> subprocess.Popen[bytes]:
    """Start the process that measures a job, here or on a Dask cluster; it ends by itself when the job is done.

    What it prints goes to ``worker.log`` in the job's folder. A second one for the same job ends at once.

    Raises:
        OutputError: the folder cannot be written to, or the process cannot be started.
    """
    cluster = [json.dumps({"scheduler": scheduler, "resources": dict(resources or {})})] if scheduler else []
    try:
        with (job.path / "worker.log").open("ab") as log:
            return subprocess.Popen(
                [sys.executable, "-m", "arview.station.walk", str(job.path), *cluster],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
    except OSError as error:
        raise _cannot_write(job.path, error) from error


# --- files -----------------------------------------------------------------------------------------------

_WRITERS = threading.Lock()
"""Threads of one process wait here; a lock of a file is between processes."""


@dataclass(frozen=True)
class _Log:
    """Content of ``photos.jsonl``: photos, time of the end, number of lines, and what is wrong with it."""

    photos: tuple[StoredPhoto, ...] = ()
    is_ended: bool = False
    ended: datetime | None = None
    lines: int = 0
    size: int = 0
    torn: bytes = b""
    faults: tuple[str, ...] = ()


def _read_log(path: Path) -> _Log:
    """The list of photos. A last line without its end was never confirmed, and is no photo."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return _Log()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    *lines, torn = content.split(b"\n")
    photos: list[StoredPhoto] = []
    faults: list[str] = []
    ended: datetime | None = None
    for number, line in enumerate(lines, 1):
        document = parse_line(line)
        if isinstance(document, dict) and ("end" in document or "reopened" in document):
            ended = _time_of(document["end"]) if "end" in document else None
            continue
        if isinstance(document, dict) and "taken_back" in document:
            photos = [photo for photo in photos if photo.name != document["taken_back"]]
            continue
        try:
            photos.append(photo_of_line(document))
        except InputError:
            faults.append(f"{path.name}: line {number} is damaged; its photo is not used")
    if torn:
        faults.append(f"{path.name}: the last line was cut off; its photo was not confirmed and is not used")
    return _Log(tuple(photos), ended is not None, ended, len(lines), len(content), torn, tuple(faults))


def _time_of(text: Any) -> datetime:
    try:
        time = datetime.fromisoformat(str(text))
    except ValueError:
        return datetime.now(UTC)
    return time if time.tzinfo is not None else time.replace(tzinfo=UTC)


def _safe(text: str) -> str:
    """A text for a file name: letters, digits, dots and hyphens."""
    return _UNSAFE.sub("-", text).strip(".-")[:40] or "x"


def _new_folder(parent: Path, name: str) -> tuple[Path, str]:
    """A new folder of this name, or of this name with a number; without a name, the next number."""
    try:
        parent.mkdir(parents=True, exist_ok=True)
        for number in range(1, 10000):
            wanted = f"{number:02d}" if not name else name if number == 1 else f"{name}-{number}"
            try:
                (parent / wanted).mkdir()
                return parent / wanted, wanted
            except FileExistsError:
                continue
    except OSError as error:
        raise _cannot_write(parent, error) from error
    raise OutputError(f"{parent}: holds too many jobs")


def _written(folder: Path, document: dict[str, Any]) -> JobFolder:
    """The job of a new folder. ``job.json`` comes last, so that a folder without it is no job."""
    try:
        (folder / "photos").mkdir()
        replace_durably(folder / "job.json", (json.dumps(document, ensure_ascii=False, indent=1) + "\n").encode())
    except OSError as error:
        raise _cannot_write(folder, error) from error
    return JobFolder(folder, document)


def _jobs_below(folder: Path) -> list[JobFolder]:
    found = []
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        try:
            found.append(JobFolder.open(path))
        except InputError:
            continue
    return found


def _cannot_write(path: Path, error: OSError) -> OutputError:
    return OutputError(f"{path}: cannot be written to ({error.strerror or error})")
