"""Guide views, made once for each model and range, and kept in the user's cache folder."""

from __future__ import annotations

import hashlib
from dataclasses import asdict
from functools import cache
from pathlib import Path

from arview.cad import Model, ViewRange
from arview.core.cache_folder import cache_folder
from arview.core.progress import StepProgress
from arview.errors import ArviewError
from arview.guideviews.views import GuideViewOptions, GuideViewSet, load_guide_views, make_guide_views
from arview.version import __version__


def cached_path(model: Model, view_range: ViewRange, options: GuideViewOptions) -> Path:
    """The file of the set of a model, range and options; each version of the code has files of its own."""
    key = repr((model.source_hash, asdict(view_range), asdict(options), __version__, _code_hash()))
    name = f"{model.source_hash[:12]}-{hashlib.sha256(key.encode()).hexdigest()[:16]}.gv"
    return cache_folder() / "guideviews" / name


def cached_guide_views(
    model: Model,
    view_range: ViewRange,
    options: GuideViewOptions | None = None,
    *,
    progress: StepProgress | None = None,
) -> GuideViewSet:
    """The set from the cache, or made now and stored there; see `make_guide_views` for arguments and errors.

    A damaged file is replaced; a cache that cannot be written is not used.
    """
    options = options or GuideViewOptions()
    path = cached_path(model, view_range, options)
    if path.is_file():
        try:
            return load_guide_views(path, model)
        except ArviewError:
            pass
    views = make_guide_views(model, view_range, options, progress=progress)
    try:
        views.save(path)
    except ArviewError:
        return views
    return load_guide_views(path, model)


@cache
def _code_hash() -> str:
    """Hash of the code that makes guide views, so that sets made by other code are not used."""
    here = Path(__file__).parent
    files = [*sorted(here.glob("*.py")), *sorted((here.parent / "rendering").glob("*.py"))]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
