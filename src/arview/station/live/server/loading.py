"""Loading of parts, guide views and inspections, and a first run of the tracker, before pages can take part."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from arview import guideviews, tracking
from arview.cad import Part, load_part
from arview.camera import guess_camera, require_brown
from arview.core.progress import StepProgress
from arview.errors import ArviewError, InputError, MismatchError
from arview.station.live.options import LiveOptions
from arview.station.live.stream.subject import Subject
from arview.station.live.stream.subjects import Subjects

logger = logging.getLogger("arview.station.live")


def load_subjects(
    part_paths: Sequence[str],
    unit: str | None,
    views_path: str | None,
    options: LiveOptions,
    view_options: guideviews.GuideViewOptions | None = None,
    progress: StepProgress | None = None,
    instances: int = 1,
) -> Subjects:
    """Load the parts, their guide views (from a file, from the cache, or rendered now), inspections and the camera.

    Args:
        part_paths: part files or CAD files, one for each part.
        unit: of CAD files without one.
        views_path: file of the guide views of the only part; None: those of the cache.
        options: options of the server; its inspections belong to the specimens in their order.
        view_options: of guide views that are rendered.
        progress: called with (views done, views in all).
        instances: specimens of each part.

    Raises:
        InputError, MismatchError: a file cannot be used, the files do not belong together, or there are more
            inspections than specimens.
    """
    parts = [part for path in part_paths for part in [load_part(path, unit)] * instances]
    paths = [path for path in part_paths for _ in range(instances)]
    inspections = [*options.inspections, *[None] * (len(parts) - len(options.inspections))]
    if len(inspections) > len(parts):
        raise InputError(
            f"{len(inspections)} inspections for {len(parts)} specimen{'s' if len(parts) > 1 else ''}: give one for "
            f"each part, or with several instances one for each specimen"
        )
    names = tracking.specimen_names([part.name for part in parts]) if len(parts) > 1 else [""]
    views: dict[str, guideviews.GuideViewSet] = {}

    def views_of(part: Part) -> guideviews.GuideViewSet:
        model = part.model.source_hash
        if model not in views:
            views[model] = (
                guideviews.cached_guide_views(part.model, part.effective_view_range, view_options, progress=progress)
                if views_path is None
                else guideviews.load_guide_views(Path(views_path), part.model)
            )
        return views[model]

    subjects = Subjects(
        [
            Subject(part, views_of(part), options, name, inspection, path)
            for part, name, inspection, path in zip(parts, names, inspections, paths, strict=True)
        ]
    )
    if options.is_phone:
        require_brown(subjects.camera(options.width, options.height), "pictures of a phone")
    elif options.camera is not None:
        with suppress(MismatchError):  # the size of a station camera's pictures is only known from the first one
            subjects.camera(options.width, options.height)
    return subjects


def warm_up(subjects: Subjects) -> threading.Thread:
    """Track a picture of noise, in a thread, so that the kernels are compiled before the first phone joins."""

    def run() -> None:
        began_s = time.monotonic()
        try:
            session = subjects.session(guess_camera(640, 480))
            rng = np.random.default_rng(0)
            session.process(rng.integers(0, 255, (480, 640, 3), dtype=np.uint8), 0, 0.0)
        except ArviewError as error:
            logger.warning("%s", error)
        logger.debug("tracker ready after %.1f s", time.monotonic() - began_s)

    thread = threading.Thread(target=run, name="arview-warm-up", daemon=True)
    thread.start()
    return thread
