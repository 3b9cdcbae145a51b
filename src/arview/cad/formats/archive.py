"""STEP files that are packed by gzip or zip, as CATIA, NX and Creo write them (.stpz), and people send them."""

from __future__ import annotations

import gzip
import io
import zipfile
import zlib
from pathlib import Path

from arview.cad.formats.raw import short_list
from arview.errors import InputError

STEP_SUFFIXES = (".step", ".stp", ".p21")
_MAX_BYTES = 500_000_000
_MAX_RATIO, _RATIO_FROM_BYTES = 100, 20_000_000
"""Largest ratio of compression, where more bytes than some are unpacked: STEP reaches 20."""
_BROKEN = (OSError, EOFError, ValueError, RuntimeError, NotImplementedError, zlib.error, zipfile.BadZipFile)


def unpacked(path: Path) -> bytes:
    """The content of a STEP file, and that of the only one in an archive, whatever the name of the archive is.

    Raises:
        InputError: an archive that is broken, holds no STEP file or several, or unpacks to much more than a model.
    """
    data = path.read_bytes()
    limit = min(_MAX_BYTES, max(_RATIO_FROM_BYTES, _MAX_RATIO * len(data)))
    try:
        content = _content(data, limit + 1, path)
    except _BROKEN as error:
        raise InputError(f"{path}: this archive cannot be unpacked ({error}); give the STEP file itself") from error
    if len(content) > max(limit, len(data)):
        raise InputError(f"{path}: {len(data) / 1e6:.1f} MB that unpack to more than {limit / 1e6:.0f} MB are no model")
    return content


def _content(data: bytes, limit: int, path: Path) -> bytes:
    """The first bytes of what is packed in a file; all of a file that is no archive."""
    if data.startswith(b"\x1f\x8b"):
        names, content = [path.stem], gzip.GzipFile(fileobj=io.BytesIO(data)).read(limit)
    elif data.startswith((b"PK\x03\x04", b"PK\x05\x06")):
        archive = zipfile.ZipFile(io.BytesIO(data))
        files = [name for name in archive.namelist() if not name.endswith("/") and not name.startswith("__MACOSX/")]
        names = [name for name in files if name.lower().endswith(STEP_SUFFIXES)] or files
        content = archive.open(names[0]).read(limit) if len(names) == 1 else b""
    else:
        return data
    if b"ISO-10303-21" not in content[:4096]:
        told = short_list(names) or "no file"
        raise InputError(
            f"{path}: holds {told}; only an archive of one STEP file is read: unpack it and give the model"
        )
    return content
