"""Loading of part, guide views and inspection, and a first run of the tracker, before pages can take part."""

from __future__ import annotations

import logging
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np

from arview.cad import load_part
from arview.camera.read import guess_camera
from arview.camera.undistort import require_brown
from arview.core.progress import StepProgress
from arview.errors import ArviewError, MismatchError
from arview.guideviews import GuideViewOptions, load_guide_views
from arview.guideviews.cache import cached_guide_views
from arview.live.options import LiveOptions
from arview.live.stream.subject import Subject

logger = logging.getLogger("arview.live")


def load_subject(
    part_path: str,
    unit: str | None,
    views_path: str | None,
    options: LiveOptions,
    view_options: GuideViewOptions | None = None,
    progress: StepProgress | None = None,
) -> Subject:
    """Load the part, its guide views (from a file, from the cache, or rendered now), inspection and camera.

    Raises:
        InputError, MismatchError: a file cannot be used, or the files do not belong together.
    """
    part = load_part(part_path, unit)
    if views_path is not None:
        views = load_guide_views(Path(views_path), part.model)
    else:
        views = cached_guide_views(part.model, part.effective_view_range, view_options, progress=progress)
    subject = Subject(part, views, options)
    if options.is_phone:
        require_brown(subject.camera(options.width, options.height), "pictures of a phone")
    elif options.camera is not None:
        with suppress(MismatchError):  # the size of a station camera's pictures is only known from the first one
            subject.camera(options.width, options.height)
    return subject


def warm_up(subject: Subject) -> threading.Thread:
    """Track a picture of noise, in a thread, so that the kernels are compiled before the first phone joins."""

    def run() -> None:
        began_s = time.monotonic()
        try:
            session = subject.session(guess_camera(640, 480))
            rng = np.random.default_rng(0)
            session.process(rng.integers(0, 255, (480, 640, 3), dtype=np.uint8), 0, 0.0)
        except ArviewError as error:
            logger.warning("%s", error)
        logger.debug("tracker ready after %.1f s", time.monotonic() - began_s)

    thread = threading.Thread(target=run, name="arview-warm-up", daemon=True)
    thread.start()
    return thread
