"""Uploads of photos in pieces: each continues where it stopped, also after a restart of the server.

An upload is two files in the job's folder ``uploads``: ``NAME.json`` says what is to come, ``NAME.part`` holds what has
arrived. Its size is the only truth about how far the upload is. The name is made from the hash of the photo, so that a
page that lost an answer finds its upload by asking again, and a photo that is stored answers under the same name. A
photo counts when the job has stored it; only then is its upload removed and the page told its name.
"""

from __future__ import annotations

import errno
import hashlib
import io
import json
import logging
import os
import re
import shutil
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from arview.camera import check_jpeg_scans
from arview.core.atomic import write_file
from arview.errors import InputError, OutputError
from arview.quality import decisions
from arview.station import walk
from arview.station.live.options import JobOptions
from arview.station.live.security.refusals import Refusal

MAX_PHOTOS = 400
"""Photos of one inspection."""
MAX_OPEN_UPLOADS = 64
"""Uploads of one inspection that are begun and not complete."""
PHOTO_BYTES = 60_000_000
"""Largest size of one photo, bytes."""
PHOTO_PIXELS = 120_000_000
"""Largest size of one photo, pixels."""
QUOTA_BYTES = 200_000_000_000
"""Largest size of the folder of all inspections, bytes."""
UPLOAD_DAYS = 7.0
"""An upload that is not continued for so long is dropped."""

logger = logging.getLogger("arview.station.live")

MEDIA_TYPES = ("image/jpeg", "image/png", "image/heic", "image/heif")
"""Kinds of photos that are accepted."""
Purpose = Literal["measure", "decide"]
"""What a photo is for: it is measured, or it shows what a person decides."""
MIN_SIDE_PX = 64
MAX_ASPECT = 4.0
MAX_EMPTY_SPREAD = 4
"""Grey levels between the darkest and the brightest place of a picture that shows nothing."""
_SHA256 = re.compile(r"[0-9a-f]{64}")
_NAME = re.compile(r"[0-9a-f]{32}")
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@dataclass(frozen=True)
class Upload:
    """An upload that is not complete.

    Attributes:
        name: in URLs; the first half of the hash, for a decision that of a hash of it.
        bytes: size of the whole photo.
        sha256: hash of the whole photo, hexadecimal.
        source, hint, taken: see `StoredPhoto`.
        offset: bytes that have arrived.
        purpose: what the photo is for.
    """

    name: str
    bytes: int
    sha256: str
    source: walk.PhotoOrigin
    hint: Mapping[str, Any] | None
    taken: str
    offset: int = 0
    purpose: Purpose = "measure"


class Uploads:
    """The uploads of one job; safe to use from several threads.

    Args:
        job: the job.
        options: bounds on photos and uploads.
        space: bytes that may still be written to the folder of the jobs.
    """

    def __init__(self, job: walk.JobFolder, options: JobOptions, space: PhotoSpace) -> None:
        self._job, self._options, self._space = job, options, space
        self._folder = job.path / "uploads"
        self._lock = threading.Lock()

    def begin(self, request: Mapping[str, Any]) -> Upload | str:
        """Begin an upload, or find the one of the same photo; returns the photo's name if it is stored.

        Raises:
            Refusal: a value is wrong, the photo is too large, there are too many, or the disk is full.
        """
        wanted = self._checked(request)
        with self._lock:
            if (name := self._stored(wanted.name)) is not None:
                return name
            if (known := self._read(wanted.name)) is not None:
                return known
            if self._count(wanted.purpose) >= MAX_PHOTOS:
                raise Refusal(429, "too_many", f"this inspection has {MAX_PHOTOS} photos already")
            if len(self._names()) >= MAX_OPEN_UPLOADS:
                raise Refusal(429, "too_many", "too many uploads are not complete", {"Retry-After": "5"})
            self._space.check(wanted.bytes)
            document = {
                "bytes": wanted.bytes,
                "sha256": wanted.sha256,
                "source": wanted.source,
                "hint": wanted.hint,
                "taken": wanted.taken,
                "purpose": wanted.purpose,
            }
            try:
                write_file(self._folder / f"{wanted.name}.json", json.dumps(document).encode(), makes_folder=True)
            except OutputError as error:
                raise _not_stored(error) from error
            return self._known(wanted.name)

    def state(self, name: str) -> Upload | str:
        """How far an upload is, or the name of the photo that it has become.

        Raises:
            Refusal: there is no such upload.
        """
        with self._lock:
            return self._stored(name) or self._known(name)

    def add(self, name: str, offset: int, piece: bytes) -> Upload | str:
        """Add a piece; returns how far the upload is, or the name of the photo when it is stored durably.

        Raises:
            Refusal: the piece does not begin where the last one ended, is too long, the disk is full, or the complete
                photo is not the one that was announced (then the upload is dropped).
        """
        with self._lock:
            if (upload := self._read(name)) is None:
                return self._stored(name) or self._known(name)
            if offset != upload.offset:
                details = {"offset": upload.offset}
                raise Refusal(409, "bad_offset", "the upload continues at another place", details=details)
            if offset + len(piece) > upload.bytes:
                raise Refusal(413, "too_large", f"the photo was announced with {upload.bytes} bytes")
            if piece:
                self._space.take(len(piece))
                self._append(upload, piece)
            if offset + len(piece) < upload.bytes:
                return self._known(name)
            return self._complete(upload)

    def listed(self) -> list[Upload]:
        """The uploads that are not complete."""
        with self._lock:
            return [upload for name in self._names() if (upload := self._read(name)) is not None]

    def drop_old(self) -> None:
        """Remove uploads that were not continued for long, and what is left of stored ones."""
        before = time.time() - 86400.0 * UPLOAD_DAYS
        with self._lock:
            for name in self._names():
                upload = self._read(name)
                paths = [self._folder / f"{name}.json", self._folder / f"{name}.part"]
                touched = [path.stat().st_mtime for path in paths if path.exists()]
                if upload is None or self._stored(name) is not None or max(touched, default=0.0) < before:
                    self._drop(name)
            known = {f"{name}{suffix}" for name in self._names() for suffix in (".json", ".part")}
            with suppress(OSError):
                for path in [path for path in self._folder.iterdir() if path.name not in known]:
                    path.unlink(missing_ok=True)

    def _checked(self, request: Mapping[str, Any]) -> Upload:
        size, sha256, source = request.get("bytes"), request.get("sha256"), request.get("source", "upload")
        if request.get("media_type", "image/jpeg") not in MEDIA_TYPES:
            raise Refusal(415, "bad_type", f"expected a photo: {', '.join(MEDIA_TYPES)}")
        if type(size) is not int or size < 1:
            raise Refusal(400, "bad_request", "bytes: expected the size of the photo")
        if size > PHOTO_BYTES:
            raise Refusal(413, "too_large", f"the photo has more than {PHOTO_BYTES / 1e6:.0f} MB")
        if not isinstance(sha256, str) or _SHA256.fullmatch(sha256) is None:
            raise Refusal(400, "bad_request", "sha256: expected 64 hexadecimal digits in lower case")
        if source not in get_args(walk.PhotoOrigin):
            raise Refusal(400, "bad_request", f"source: expected one of {', '.join(get_args(walk.PhotoOrigin))}")
        purpose = request.get("purpose", "measure")
        if purpose not in get_args(Purpose):
            raise Refusal(400, "bad_request", f"purpose: expected one of {', '.join(get_args(Purpose))}")
        hint = request.get("hint")
        if hint is not None and not isinstance(hint, dict):
            raise Refusal(400, "bad_request", "hint: expected an object")
        try:
            return Upload(
                _name_of(sha256, purpose),
                size,
                sha256,
                source,
                walk.checked_hint(hint),
                walk.checked_time(request.get("taken")),
                purpose=purpose,
            )
        except InputError as error:
            raise Refusal(400, "bad_request", str(error)) from error

    def _stored(self, name: str) -> str | None:
        """Name of the photo that an upload has become, or None."""
        for photo in self._job.photos():
            if _name_of(photo.sha256, "measure") == name:
                return photo.name
        for attached in decisions.attached_photos(record_folder(self._job)):
            if _name_of(Path(attached).stem, "decide") == name:
                return attached
        return None

    def _count(self, purpose: Purpose) -> int:
        return len(self._job.photos() if purpose == "measure" else decisions.attached_photos(record_folder(self._job)))

    def _known(self, name: str) -> Upload:
        upload = self._read(name)
        if upload is None:
            raise Refusal(404, "no_such_upload", "there is no such upload; begin it again")
        return upload

    def _read(self, name: str) -> Upload | None:
        """An upload by its files; None where there is none, or its announcement is damaged."""
        if _NAME.fullmatch(name) is None:
            return None
        try:
            document = json.loads((self._folder / f"{name}.json").read_text(encoding="utf-8"))
            upload = self._checked(document)
        except (OSError, ValueError, AttributeError, Refusal):
            return None
        with suppress(OSError):
            arrived = (self._folder / f"{name}.part").stat().st_size
            return Upload(**{**vars(upload), "offset": min(arrived, upload.bytes)})
        return upload

    def _names(self) -> list[str]:
        return sorted(path.stem for path in self._folder.glob("*.json") if _NAME.fullmatch(path.stem))

    def _append(self, upload: Upload, piece: bytes) -> None:
        """Write a piece at the end; what does not fit whole is taken back."""
        path = self._folder / f"{upload.name}.part"
        try:
            handle = os.open(path, os.O_WRONLY | os.O_CREAT, 0o644)
            try:
                os.lseek(handle, upload.offset, os.SEEK_SET)
                rest = memoryview(piece)
                while rest:
                    rest = rest[os.write(handle, rest) :]
            except OSError:
                with suppress(OSError):
                    os.ftruncate(handle, upload.offset)
                raise
            finally:
                os.close(handle)
        except OSError as error:
            raise _not_stored(error) from error

    def _complete(self, upload: Upload) -> str:
        """Check a photo that has arrived whole, and store it in the job."""
        try:
            content = (self._folder / f"{upload.name}.part").read_bytes()
        except OSError as error:
            raise _not_stored(error) from error
        if hashlib.sha256(content).hexdigest() != upload.sha256:
            self._drop(upload.name)
            raise Refusal(422, "bad_hash", "the photo arrived damaged; send it again")
        try:
            check_photo(content, PHOTO_PIXELS)
        except InputError as error:
            self._drop(upload.name)
            raise Refusal(422, "bad_photo", str(error)) from error
        if upload.purpose == "decide":
            photo = store_attachment(self._job, content)
        else:
            photo = store_photo(self._job, content, upload.sha256, upload.source, upload.hint, upload.taken)
        self._drop(upload.name)
        return photo

    def _drop(self, name: str) -> None:
        for suffix in (".part", ".json"):
            with suppress(OSError):
                (self._folder / f"{name}{suffix}").unlink(missing_ok=True)


class PhotoSpace:
    """Room for photos: the free disk and the quota of the folder of the jobs; safe to use from several threads.

    Args:
        options: folder and limits.
    """

    REFRESH_S = 60.0
    """Time between two measurements of the folder; meanwhile what is written is added."""

    def __init__(self, options: JobOptions) -> None:
        self._options = options
        self._lock = threading.Lock()
        self._used, self._measured_s = 0, -1e9

    def take(self, size: int) -> None:
        """Use so many bytes. Raises Refusal as `check`."""
        self.check(size)
        with self._lock:
            self._used += size

    def check(self, size: int) -> None:
        """Check that there is room for so many bytes.

        Raises:
            Refusal: 507, there is not so much room.
        """
        options = self._options
        with self._lock:
            if time.monotonic() - self._measured_s > self.REFRESH_S:
                self._used, self._measured_s = folder_bytes(options.folder), time.monotonic()
            if self._used + size > QUOTA_BYTES:
                raise Refusal(507, "disk_full", "the inspections fill their quota at the station; move some")
            if free_bytes(options.folder) - size < options.min_free_bytes:
                raise Refusal(507, "disk_full", "the disk of the station is almost full; free some space")


def store_photo(
    job: walk.JobFolder,
    content: bytes,
    sha256: str,
    source: walk.PhotoOrigin,
    hint: Mapping[str, Any] | None,
    taken: str | None = None,
) -> str:
    """Store a photo in a job, durably; returns its name. After the end of a walk it is reopened for this photo.

    Raises:
        Refusal: the photo cannot be used, or the disk is full.
    """
    try:
        if not job.is_ended:
            return job.add_photo(content, sha256, source, hint, taken)
        job.reopen()
        try:
            return job.add_photo(content, sha256, source, hint, taken)
        finally:
            job.end()
    except InputError as error:
        raise Refusal(422, "bad_photo", str(error)) from error
    except (OutputError, OSError) as error:
        raise _not_stored(error) from error


def store_attachment(job: walk.JobFolder, content: bytes) -> str:
    """Store a photo that was taken for a decision, durably; returns its name. It is not measured.

    Raises:
        Refusal: the photo cannot be used, or the disk is full.
    """
    try:
        return decisions.attach_photo(record_folder(job), content)
    except InputError as error:
        raise Refusal(422, "bad_photo", str(error)) from error
    except OutputError as error:
        raise _not_stored(error) from error


def record_folder(job: walk.JobFolder) -> Path:
    """The folder of the record that a job belongs to: of a re-check that of the first measurement."""
    return (job.parent or job).path


def _name_of(sha256: str, purpose: Purpose) -> str:
    """The name of an upload: one photo may be measured and be shown with a decision too."""
    return sha256[:32] if purpose == "measure" else hashlib.sha256(f"decide {sha256}".encode()).hexdigest()[:32]


def check_photo(content: bytes, max_pixels: int) -> None:
    """Check that a JPEG or PNG is one: its header before anything decodes it, then that all of it is there.

    Raises:
        InputError: it is damaged, cut off, of one colour, a strip, too small or too large.
    """
    if content[4:8] == b"ftyp":  # HEIC is checked by who reads it
        return
    from PIL import Image as Pillow

    try:
        with Pillow.open(io.BytesIO(content), formats=["JPEG", "PNG"]) as header:
            (width, height), kind = header.size, header.format
    except (OSError, ValueError, SyntaxError, Pillow.DecompressionBombError) as error:
        raise InputError("this is no photo that can be read") from error
    is_strip = max(width, height) > MAX_ASPECT * min(width, height)
    if is_strip or min(width, height) < MIN_SIDE_PX or width * height > max_pixels:
        raise InputError(
            f"the photo is {width}×{height} px; expected up to {max_pixels / 1e6:.0f} megapixels, no strip"
        )
    if kind == "JPEG":
        check_jpeg_scans(content)
    try:
        with Pillow.open(io.BytesIO(content), formats=["JPEG", "PNG"]) as picture:
            picture.draft("L", (width // 8, height // 8))
            levels = np.flatnonzero(picture.convert("L").histogram())
    except (OSError, ValueError, SyntaxError) as error:
        raise InputError("the photo is cut off or damaged; take it again") from error
    if np.ptp(levels) <= MAX_EMPTY_SPREAD:
        raise InputError("the photo shows nothing: all of it is of one colour; was the lens covered?")


def free_bytes(folder: Path) -> int:
    """Free space of the disk on which a folder is, or would be made."""
    place = folder.absolute()
    while not place.exists() and place != place.parent:
        place = place.parent
    return shutil.disk_usage(place).free


def folder_bytes(folder: Path) -> int:
    """Size of all files below a folder."""
    total, pending = 0, [str(folder)]
    while pending:
        with suppress(OSError), os.scandir(pending.pop()) as entries:
            for entry in entries:
                with suppress(OSError):
                    if entry.is_dir(follow_symlinks=False):
                        pending.append(entry.path)
                    else:
                        total += entry.stat(follow_symlinks=False).st_size
    return total


def _not_stored(error: Exception) -> Refusal:
    """The answer when a photo could not be written."""
    cause = error if isinstance(error, OSError) else error.__cause__
    if isinstance(cause, OSError) and cause.errno in _FULL:
        return Refusal(507, "disk_full", "the disk of the station is full; free some space and send the photo again")
    logger.error("a photo could not be stored: %s", error)
    return Refusal(507, "disk_full", "the photo cannot be stored at the station; see its terminal")
