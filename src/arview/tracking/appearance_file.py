"""File format of remembered views: a compressed npz archive of rotations, crops and masks, with metadata in JSON."""

from __future__ import annotations

import io
import json
import math
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.core.atomic import replacing
from arview.errors import InputError, MismatchError, OutputError
from arview.geometry import Array
from arview.guideviews import GuideViewSet
from arview.tracking.search.view_crops import CHANNELS, CROP_PX

FORMAT_VERSION = 1
MAX_BYTES = 400_000_000
"""Bytes of the arrays of a file, unpacked; more are not read, so that a damaged file cannot fill the memory."""


class SavedViews(NamedTuple):
    """Contents of a file.

    Attributes:
        rotations: (N,3,3) rotations from the model, as if the part were on the optical axis.
        pictures: (N,CROP_PX,CROP_PX,3) uint8 RGB.
        masks: (N,CROP_PX,CROP_PX) uint8, 255 on the part.
    """

    rotations: Array
    pictures: NDArray[np.uint8]
    masks: NDArray[np.uint8]


def save_views(path: Path, saved: SavedViews, views: GuideViewSet) -> None:
    """Write remembered views of the part of some guide views, atomically.

    Raises:
        OutputError: the file cannot be written.
    """
    meta = {"format_version": FORMAT_VERSION, "model_name": views.model_name, "model_hash": views.model_hash}
    try:
        with replacing(path) as file:
            np.savez_compressed(file, meta=np.array(json.dumps(meta)), **saved._asdict())
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error


def load_views(path: Path, views: GuideViewSet) -> SavedViews:
    """Read remembered views of the part of some guide views.

    Raises:
        InputError: the file is missing, damaged, of another kind or of another format version.
        MismatchError: the views are of another model.
    """
    meta, saved = _read(path)
    if meta.get("format_version") != FORMAT_VERSION:
        raise InputError(
            f"{path}: learned views of format {meta.get('format_version')}, this arview reads {FORMAT_VERSION}; "
            "delete the file to learn anew"
        )
    if meta.get("model_hash") != views.model_hash:
        raise MismatchError(
            f"{path}: learned views of model {meta.get('model_name')!r} ({str(meta.get('model_hash'))[:12]}), but "
            f"the part is {views.model_name!r} ({views.model_hash[:12]}); give another file"
        )
    return saved


def _read(path: Path) -> tuple[dict[str, Any], SavedViews]:
    """Metadata and checked arrays of a file. Raises InputError."""
    damaged = f"{path}: the learned views are damaged; delete the file to learn anew"
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(member.file_size for member in archive.infolist()) > MAX_BYTES:
                raise InputError(damaged)
            meta = dict(json.loads(str(_member(archive, "meta"))))
            saved = SavedViews(*(_member(archive, name) for name in SavedViews._fields))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except _DAMAGES as error:
        raise InputError(damaged) from error
    count = len(saved.rotations) if saved.rotations.ndim else -1
    is_valid = (
        _is(saved.rotations, (count, 3, 3), np.float64)
        and _is(saved.pictures, (count, CROP_PX, CROP_PX, CHANNELS), np.uint8)
        and _is(saved.masks, (count, CROP_PX, CROP_PX), np.uint8)
    )
    if not is_valid:
        raise InputError(damaged)
    products = saved.rotations @ saved.rotations.transpose(0, 2, 1)
    if not np.allclose(products, np.eye(3), atol=1e-6):
        raise InputError(damaged)
    return meta, saved


_DAMAGES = (
    ValueError,
    KeyError,
    TypeError,
    EOFError,
    OverflowError,
    RuntimeError,
    SyntaxError,
    zipfile.BadZipFile,
    zlib.error,
    tokenize.TokenError,
)
"""What the readers of ZIP archives, of headers of arrays and of JSON raise for damaged files."""


def _member(archive: zipfile.ZipFile, name: str) -> NDArray[Any]:
    """An array of an npz archive. No memory is taken on the word of its header. Raises one of ``_DAMAGES``."""
    data = archive.read(f"{name}.npy")
    stream = io.BytesIO(data)
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError("version")
    shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    if dtype.hasobject or is_fortran:
        raise ValueError("objects or columns first")
    return np.frombuffer(data, dtype, math.prod(shape), stream.tell()).reshape(shape).copy()


def _is(array: NDArray[Any], shape: tuple[int, ...], kind: type) -> bool:
    """Whether an array has a shape and type."""
    return array.shape == shape and array.dtype == kind
