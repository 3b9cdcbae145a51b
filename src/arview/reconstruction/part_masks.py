"""Masks that are made of the part itself: where they come from, and how the photos are placed with them.

Poses come from whatever most features belong to. A background that stands still beside the part helps them, and is
kept: the silhouettes then limit the dense cloud only. Where the background moves against the part, the photos are
not placed, or placed such that the part contradicts the poses. They are then placed again by the part's pixels alone.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

from arview.core.progress import Progress
from arview.errors import CannotMeasureError, OutputError
from arview.reconstruction.types import Photo, SparseModel

AUTO = "auto"
"""What ``--masks`` is given instead of a folder to have the masks made."""


@dataclass(frozen=True)
class PartMasks:
    """Masks of photos.

    Attributes:
        masks: file of the mask of each masked photo, by the name of the photo; empty if there are none.
        detail: which photos and which of their pixels are used; or why there are no masks.
    """

    detail: str
    masks: Mapping[str, Path] = field(default_factory=dict)


class Silhouettes(Protocol):
    """Makes masks from the outline of the part. It lives in a room that knows CAD, rendering and detection."""

    def key(self) -> str:
        """What the masks depend on beside the photos, as a hash."""

    def at_poses(self, sparse: SparseModel, folder: Path, tell: Progress) -> PartMasks:
        """Masks for the cloud, with the part found at the poses of the photos; none if it contradicts them.

        They reach so far beyond the part that displaced components are inside.
        """

    def in_photos(self, photos: Sequence[Photo], folder: Path, tell: Progress) -> PartMasks:
        """Masks for placing the photos in which the part is found, each by itself, without poses.

        They leave out as much of the background as they can.
        """


MIN_PLACED = 0.7
"""Share of the photos; with fewer, the background may hold the others back."""
MIN_FOUND = 3
"""Photos in which the part was found; fewer cannot be placed together."""


def placed_with_silhouettes(
    photos: Sequence[Photo],
    folder: Path,
    masks_folder: Path,
    silhouettes: Silhouettes,
    place: Callable[[Sequence[Photo], Path], SparseModel],
    tell: Progress,
    can_place_again: bool = True,
) -> SparseModel:
    """The placed photos with masks of the part; or without masks where the part is not found, with a remark.

    Args:
        photos: without masks.
        folder: of the files of the sparse model.
        masks_folder: where the masks are written.
        silhouettes: makes the masks.
        place: places photos and leaves files in a folder; raises CannotMeasureError.
        tell: called with (what, done, total).
        can_place_again: False where the poses were given.

    Raises:
        CannotMeasureError: the photos cannot be placed, neither whole nor by the part.
    """
    whole: SparseModel | CannotMeasureError
    try:
        whole = place(photos, folder)
    except CannotMeasureError as error:
        if not can_place_again:
            raise
        whole = error
    reason = "the whole photos could not be placed"
    if isinstance(whole, SparseModel):
        found = silhouettes.at_poses(whole, masks_folder, tell)
        count = len(whole.photos)
        is_enough = count >= MIN_PLACED * len(photos)
        if found.masks and (is_enough or not can_place_again):
            return _with_remark(
                with_masks_of(whole, found.masks),
                f"masks from the CAD's silhouette: the cloud comes from {found.detail}; the camera poses come from the "
                "whole photos",
            )
        reason = f"only {count} of {len(photos)} photos were placed whole" if found.masks else found.detail
        if not can_place_again:
            return _with_remark(whole, _not_made(reason))
    return _placed_by_part(
        photos,
        folder,
        masks_folder,
        silhouettes=silhouettes,
        place=place,
        tell=tell,
        whole=whole,
        reason=reason,
    )


def _placed_by_part(
    photos: Sequence[Photo],
    folder: Path,
    masks_folder: Path,
    silhouettes: Silhouettes,
    place: Callable[[Sequence[Photo], Path], SparseModel],
    tell: Progress,
    whole: SparseModel | CannotMeasureError,
    reason: str,
) -> SparseModel:
    """The photos placed by the pixels of the part alone; as they were placed before where that places no more."""
    found = silhouettes.in_photos(photos, masks_folder, tell)
    masked = [replace(photo, mask=found.masks[photo.name]) for photo in photos if photo.name in found.masks]
    problem = f"the part was found in {len(masked)} photos by itself" if masked else found.detail
    if len(masked) >= MIN_FOUND:
        try:
            sparse = _placed_apart(masked, folder, place, len(whole.photos) if isinstance(whole, SparseModel) else 0)
        except CannotMeasureError as error:
            problem = f"the part was found in {len(masked)} photos, which could not be placed by it alone: {error}"
        else:
            left_out = [
                (one.name, "the part was not found in it, so that it has no silhouette (--masks auto)")
                for one in photos
                if one.name not in found.masks
            ]
            sparse = replace(sparse, unplaced=(*sparse.unplaced, *left_out))
            remark = f"masks from the CAD's silhouette: placed by the part alone, because {reason}; from {found.detail}"
            wide = silhouettes.at_poses(sparse, masks_folder, tell)
            remark += f"; the cloud comes from {wide.detail}" if wide.masks else ""
            return _with_remark(with_masks_of(_unmasked(sparse), wide.masks), remark)
    if isinstance(whole, CannotMeasureError):
        raise CannotMeasureError(f"{whole}; --masks auto does not help: {problem}") from whole
    return _with_remark(whole, _not_made(f"{reason}; {problem}"))


def _placed_apart(
    photos: Sequence[Photo], folder: Path, place: Callable[[Sequence[Photo], Path], SparseModel], min_photos: int
) -> SparseModel:
    """The photos placed in a folder of their own, which then takes the place of ``folder``.

    Raises:
        CannotMeasureError: they cannot be placed, or fewer than ``min_photos``; ``folder`` is then as it was.
    """
    apart = folder.with_name(f"{folder.name}_by_part")
    shutil.rmtree(apart, ignore_errors=True)
    try:
        sparse = place(photos, apart)
        if len(sparse.photos) < min_photos:
            raise CannotMeasureError(f"only {len(sparse.photos)} photos")
        shutil.rmtree(folder, ignore_errors=True)
        apart.replace(folder)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written to ({error.strerror or error})") from error
    finally:
        shutil.rmtree(apart, ignore_errors=True)
    return sparse


def with_masks_of(sparse: SparseModel, masks: Mapping[str, Path]) -> SparseModel:
    """The model with the masks of its photos, by their names; other photos keep theirs."""
    return replace(
        sparse, photos=tuple(replace(photo, mask=masks.get(photo.name, photo.mask)) for photo in sparse.photos)
    )


def _unmasked(sparse: SparseModel) -> SparseModel:
    return replace(sparse, photos=tuple(replace(photo, mask=None) for photo in sparse.photos))


def _not_made(reason: str) -> str:
    return f"no masks from the CAD's silhouette, the photos are used whole: {reason}"


def _with_remark(sparse: SparseModel, remark: str) -> SparseModel:
    return replace(sparse, remarks=(*sparse.remarks, remark))
