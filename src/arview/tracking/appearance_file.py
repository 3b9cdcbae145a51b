"""File format of remembered views: a compressed npz archive of rotations, crops and masks, with metadata in JSON."""

from __future__ import annotations

import json
import zipfile
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
        with np.load(path, allow_pickle=False) as file:
            meta = dict(json.loads(str(file["meta"])))
            saved = SavedViews(*(np.array(file[name]) for name in SavedViews._fields))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (ValueError, KeyError, EOFError, TypeError, zipfile.BadZipFile) as error:
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


def _is(array: NDArray[Any], shape: tuple[int, ...], kind: type) -> bool:
    """Whether an array has a shape and type."""
    return array.shape == shape and array.dtype == kind
