"""Paired devices: each browser that scanned the code has a token of its own, which stays valid over restarts.

The file holds hashes of the tokens only: who reads it cannot use them. Tokens are random numbers of 192 bits, so a
plain SHA-256 is enough; salts and slow hashes protect passwords that can be guessed.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import logging
import secrets
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from arview.errors import InputError, OutputError
from arview.station.live.security.certificates import data_folder, write_private

logger = logging.getLogger("arview.station.live")

_FORMAT, _VERSION = "arview devices", 1
_SYSTEMS = (
    ("iPhone", "iPhone"),
    ("iPad", "iPad"),
    ("Android", "Android"),
    ("Windows", "Windows"),
    ("CrOS", "Chromebook"),
    ("Macintosh", "Mac"),
    ("Linux", "Linux"),
)
_BROWSERS = (
    ("Edg", "Edge"),
    ("SamsungBrowser", "Samsung"),
    ("FxiOS", "Firefox"),
    ("Firefox", "Firefox"),
    ("CriOS", "Chrome"),
    ("Chrome", "Chrome"),
    ("Safari", "Safari"),
)
"""Words in the header ``User-Agent``, the more special ones first, and what devices are called for them."""


MAX_DEVICES = 64
"""Paired devices; one more takes the place of the one that was not used for the longest time."""
UNUSED_DAYS = 180.0
"""A device that is not used for so long is forgotten."""
JUMP = timedelta(days=7)
"""After so long without any device the station was off, or its clock was put forward: neither counts as not used."""
SAVE_INTERVAL_S = 600.0
"""Times of last use are written at most once in this time."""


@dataclass(frozen=True)
class PairedDevice:
    """A device, or rather a browser on it.

    Attributes:
        name: by which it is listed and revoked.
        token_hash: SHA-256 of its token, hexadecimal.
        created, last_used: when it was paired and when it last asked for something, UTC.
    """

    name: str
    token_hash: str
    created: datetime
    last_used: datetime


class Devices:
    """The paired devices; safe to use from several threads, and from several processes that share the file.

    Args:
        path: of their file, readable by this user only; None: they are forgotten at the end of the run.
    """

    def __init__(self, path: Path | None = None) -> None:
        self._path = path
        self._lock = threading.RLock()
        self._devices: dict[str, PairedDevice] = {}
        self._read_state: tuple[int, int, int] | None = None
        self._saved = datetime.now(UTC)
        self._read()

    def pair(self, user_agent: str) -> tuple[str, str]:
        """Pair a new device; returns its name and its token. It is named after its system and browser."""
        token, now = secrets.token_urlsafe(24), datetime.now(UTC)
        with self._changing():
            taken = {device.name for device in self._devices.values()}
            base = device_name(user_agent)
            names = (base if count == 1 else f"{base} {count}" for count in range(1, len(taken) + 2))
            name = next(one for one in names if one not in taken)
            while len(self._devices) >= MAX_DEVICES:
                oldest = min(self._devices.values(), key=lambda device: device.last_used)
                logger.warning("%s is no longer paired: there are too many devices", oldest.name)
                del self._devices[oldest.token_hash]
            device = PairedDevice(name, _hash(token), now, now)
            self._devices[device.token_hash] = device
        logger.info("paired %s", name)
        return name, token

    def find(self, token: str) -> str | None:
        """Name of the device of a token, whose use is noted; None where there is none. Each is compared in full."""
        hashed, found = _hash(token), None
        with self._lock:
            for device in self._devices.values():
                if hmac.compare_digest(device.token_hash, hashed):
                    found = device
            if found is None:
                return None
            now = datetime.now(UTC)
            gap = now - max(device.last_used for device in self._devices.values())
            if gap > JUMP:
                self._devices = {key: replace(one, last_used=one.last_used + gap) for key, one in self._devices.items()}
            self._devices[found.token_hash] = replace(found, last_used=now)
            return found.name

    def has(self, name: str) -> bool:
        """Whether a device of that name is paired."""
        with self._lock:
            return any(device.name == name for device in self._devices.values())

    def listed(self) -> tuple[PairedDevice, ...]:
        """All devices, the one that was used last first."""
        with self._lock:
            return tuple(sorted(self._devices.values(), key=lambda device: device.last_used, reverse=True))

    def revoke(self, name: str) -> bool:
        """Forget a device; returns whether there was one of that name."""
        with self._changing():
            found = [device.token_hash for device in self._devices.values() if device.name == name]
            for token_hash in found:
                del self._devices[token_hash]
        return bool(found)

    def refresh(self) -> None:
        """Read what other processes have changed, and write the times of last use once in a while."""
        with self._lock:
            if self._path is None:
                return
            if self._state() != self._read_state:
                self._read()
            is_due = datetime.now(UTC) - self._saved > timedelta(seconds=SAVE_INTERVAL_S)
        if is_due:
            self.save()

    def save(self) -> None:
        """Write the times of last use."""
        with self._changing():
            pass

    @contextmanager
    def _changing(self) -> Iterator[None]:
        """Change the devices in the file: read it again, change, write, while no other process does."""
        with self._lock:
            if self._path is None:
                yield
                self._forget_unused()
                return
            with suppress(OSError):
                self._path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            with _exclusive(self._path.with_name(f".{self._path.name}.lock")):
                self._read()
                yield
                self._forget_unused()
                self._write()

    def _forget_unused(self) -> None:
        before = datetime.now(UTC) - timedelta(days=UNUSED_DAYS)
        self._devices = {key: device for key, device in self._devices.items() if device.last_used >= before}

    def _read(self) -> None:
        """Take the devices of the file, with the later of the times of last use."""
        if self._path is None:
            return
        state = self._state()
        devices: dict[str, PairedDevice] = {}
        try:
            found = read_devices(self._path)
        except InputError as error:
            aside = self._path.with_name(f"{self._path.name}.damaged")
            with suppress(OSError):
                self._path.replace(aside)
            logger.warning("%s; it is kept as %s, and devices have to be paired again", error, aside.name)
            found, state = (), None
        for one in found:
            if (known := self._devices.get(one.token_hash)) is not None:
                one = replace(one, last_used=max(one.last_used, known.last_used))
            devices[one.token_hash] = one
        self._devices = devices
        self._read_state = state

    def _write(self) -> None:
        assert self._path is not None
        devices = [
            {
                "name": one.name,
                "sha256": one.token_hash,
                "created": one.created.isoformat(),
                "last_used": one.last_used.isoformat(),
            }
            for one in self._devices.values()
        ]
        document = {"format": _FORMAT, "version": _VERSION, "devices": devices}
        self._saved = datetime.now(UTC)
        try:
            write_private(self._path, (json.dumps(document, indent=1, ensure_ascii=False) + "\n").encode())
        except OSError as error:
            logger.warning("%s", OutputError(f"{self._path}: cannot be written ({error.strerror or error})"))
        self._read_state = self._state()

    def _state(self) -> tuple[int, int, int] | None:
        """Modification time, size and inode of the file; None when there is none."""
        if self._path is None:
            return None
        try:
            stat = self._path.stat()
        except OSError:
            return None
        return stat.st_mtime_ns, stat.st_size, stat.st_ino


def devices_path() -> Path:
    """The file of the paired devices of this user."""
    return data_folder() / "devices.json"


def read_devices(path: Path) -> tuple[PairedDevice, ...]:
    """The devices of a file; none where there is no file.

    Raises:
        InputError: the file cannot be read.
    """
    try:
        document: Any = json.loads(path.read_text(encoding="utf-8"))
        if document["format"] != _FORMAT or document["version"] != _VERSION:
            raise InputError(f"{path}: is no list of devices that this version of arview can read")
        devices = tuple(
            PairedDevice(str(one["name"]), str(one["sha256"]), _time(one["created"]), _time(one["last_used"]))
            for one in document["devices"]
        )
    except FileNotFoundError:
        return ()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: is damaged ({type(error).__name__})") from error
    with suppress(OSError):
        path.chmod(0o600)
    return devices


def device_name(user_agent: str) -> str:
    """What a device is called after its header ``User-Agent``: system and browser."""
    system = next((name for word, name in _SYSTEMS if word in user_agent), "Device")
    browser = next((name for word, name in _BROWSERS if word in user_agent), "")
    return f"{system} {browser}".strip()


def _time(text: Any) -> datetime:
    time = datetime.fromisoformat(str(text))
    return time if time.tzinfo is not None else time.replace(tzinfo=UTC)


def _hash(token: str) -> str:
    return hashlib.sha256(token.encode("utf-8", "replace")).hexdigest()


@contextmanager
def _exclusive(path: Path) -> Iterator[None]:
    """Hold the lock of a file while other processes wait; without one where the system or the folder has none."""
    try:
        import fcntl
    except ImportError:  # Windows
        yield
        return
    try:
        file = path.open("w")
    except OSError:
        yield
        return
    with file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
