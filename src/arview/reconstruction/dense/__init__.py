"""Dense reconstruction of posed photos: multi-view PatchMatch in the part's region, refinement and fusion.

views → depth maps (kernels, patchmatch, polish) → fusion
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from arview.core.progress import Progress
from arview.errors import InputError
from arview.reconstruction.dense.depth import depth_maps
from arview.reconstruction.dense.files import read_ply, write_map, write_maps, write_ply
from arview.reconstruction.dense.fusion import fuse
from arview.reconstruction.dense.options import MIN_VIEWS, DenseOptions
from arview.reconstruction.dense.views import Cad, DenseView, choose_sources, make_view
from arview.reconstruction.types import DenseCloud, SparseModel

__all__ = [
    "Cad",
    "DenseOptions",
    "read_ply",
    "reconstruct_dense",
    "write_map",
    "write_maps",
    "write_ply",
]


def reconstruct_dense(
    sparse: SparseModel,
    options: DenseOptions | None = None,
    cad: Cad | None = None,
    folder: Path | None = None,
    progress: Progress | None = None,
) -> DenseCloud:
    """Reconstruct the dense cloud of posed photos, in the frame and unit of ``sparse``.

    Args:
        sparse: poses with distorted cameras, points and observations; in mm when ``cad`` is given.
        options: see `DenseOptions`.
        cad: the part's model and its approximate pose. It limits the work to the part's region and provides start
            values; the photos alone decide where the surface is.
        folder: depth and normal maps of each photo are written below it in COLMAP's format.
        progress: called with a stage's name, photos done and photos in all.

    Returns:
        The cloud, empty where the photos show no texture. The same input and seed give the same cloud.

    Raises:
        InputError: fewer than ``options.min_views`` photos have sources, or a photo cannot be read.
        OutputError: the folder cannot be written to.
    """
    from arview.reconstruction.intake import read_photo

    options = options or DenseOptions()
    progress = progress or (lambda name, done, total: None)
    threads = options.threads or max(1, min(8, os.cpu_count() or 1))
    sources = choose_sources(sparse)
    with ThreadPoolExecutor(threads) as pool:
        made = pool.map(
            lambda i: make_view(sparse, i, sources[i], cad, options, lambda photo: read_photo(photo.path)),
            [i for i in range(len(sparse.photos)) if sources[i]],
        )
        views = _linked([view for view in made if view is not None])
    if len(views) < MIN_VIEWS:
        raise InputError(
            f"dense: only {len(views)} photos see enough of the same surface from useful angles, "
            f"expected {MIN_VIEWS}; take more photos all around, 10 to 20 degrees apart"
        )
    maps = depth_maps(views, sparse, cad, options, threads, progress)
    if folder is not None:
        for view, depth_map in zip(views, maps, strict=True):
            write_maps(folder, view.name, depth_map)
    return fuse(maps, [view.color for view in views], threads, progress)


def _linked(views: list[DenseView]) -> list[DenseView]:
    """The views that have sources among themselves, with these as indices into the list."""
    while True:
        place = {view.index: i for i, view in enumerate(views)}
        linked = [view for view in views if any(k in place for k in view.sources)]
        if len(linked) == len(views):
            return [replace(view, sources=tuple(place[k] for k in view.sources if k in place)) for view in views]
        views = linked
