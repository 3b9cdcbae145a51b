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
    name, content = path.stem, data
    try:
        if data.startswith(b"\x1f\x8b"):
            with gzip.open(io.BytesIO(data)) as file:
                content = file.read(limit + 1)
        elif data.startswith((b"PK\x03\x04", b"PK\x05\x06")):
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                name = _model_in(archive, path)
                with archive.open(name) as file:
                    content = file.read(limit + 1)
    except _BROKEN as error:
        raise InputError(f"{path}: this archive cannot be unpacked ({error}); give the STEP file itself") from error
    if len(content) > max(limit, len(data)):
        raise InputError(f"{path}: {len(data) / 1e6:.1f} MB that unpack to more than {limit / 1e6:.0f} MB are no model")
    if content is not data and b"ISO-10303-21" not in content[:4096]:
        raise InputError(f"{path}: holds {name}; of packed files only STEP is read: unpack it and give the model")
    return content


def _model_in(archive: zipfile.ZipFile, path: Path) -> str:
    """The name of the only STEP file in an archive, or of its only file."""
    names = [n for n in archive.namelist() if not n.endswith("/") and not n.startswith("__MACOSX/")]
    models = [n for n in names if n.lower().endswith(STEP_SUFFIXES)] or names
    if len(models) != 1:
        told = short_list(models) or "no file"
        raise InputError(f"{path}: one STEP file is expected in it, it holds {told}; unpack it and give one model")
    return models[0]
