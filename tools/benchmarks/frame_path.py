#!/usr/bin/env python
"""The ways of a tracked frame, a searched frame and photos through arview: calls to the inner kernel, files entered."""

from __future__ import annotations

import argparse
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

import arview
from arview.cad import load_part
from arview.camera.read import load_camera
from arview.errors import ArviewError
from arview.guideviews.cache import cached_guide_views
from arview.pose import TrackingState
from arview.refinement import kernels, refiner
from arview.tracking import TrackingSession
from arview.video import open_source
from recordings import SAMPLE

DESCRIPTION = """\
Print the ways of a tracked frame and of a searched frame of the sample clip through arview, and with --photos that of
the sample photos through `reconstruct`: the files of arview whose functions run, and of the tracked frame the chain of
calls from TrackingSession.process to the inner kernel (refinement.kernels.run_stages). Of several tracked frames the
one that enters most files is shown. Of the functions compiled by numba only the inner kernel is seen."""

ROOT = Path(arview.__file__).resolve().parent
PLATE = SAMPLE.parent / "plate"
WARM_UP_FRAMES, FOLLOWED_FRAMES = 12, 12
"""Frames of the sample clip that are tracked before any is followed, and those that are followed."""


@dataclass(frozen=True)
class FramePath:
    """The way of one frame.

    Attributes:
        chain: functions from `TrackingSession.process` to the inner kernel, both included, on the shortest way.
        files: files of arview, relative to it, whose functions ran.
    """

    chain: tuple[str, ...]
    files: tuple[str, ...]

    @property
    def folders(self) -> tuple[str, ...]:
        """Folders of these files; "." is arview itself."""
        return tuple(sorted({Path(file).parent.as_posix() for file in self.files}))

    @property
    def calls(self) -> int:
        """Number of calls from `TrackingSession.process` to the inner kernel."""
        return len(self.chain) - 1


@contextmanager
def files_entered() -> Iterator[set[str]]:
    """Collect the files of arview, relative to it, whose functions are called meanwhile, in all new threads too."""
    seen: set[str] = set()
    found: set[str] = set()

    def enter(frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            seen.add(frame.f_code.co_filename)

    threading.setprofile(enter)
    sys.setprofile(enter)
    try:
        yield found
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
        paths = [Path(name) for name in seen]
        found |= {path.relative_to(ROOT).as_posix() for path in paths if path.is_relative_to(ROOT)}


def frame_path(session: TrackingSession, image: NDArray[np.uint8], index: int) -> FramePath:
    """Follow a frame (H,W,3) uint8 RGB through a session that tracks the part.

    Raises:
        ArviewError: the part is not tracked, or its pose is not refined in this frame.
    """
    if session.specimens[0].state is not TrackingState.TRACKED:
        raise ArviewError(f"the part is {session.specimens[0].state}, not tracked, before the frame that is followed")
    chains: list[tuple[str, ...]] = []
    run_stages = kernels.run_stages

    def refine(*arguments: Any) -> Any:
        names = ["run_stages"]
        caller = sys._getframe().f_back
        while caller is not None and names[-1] != "TrackingSession.process":
            names.append(caller.f_code.co_qualname)
            caller = caller.f_back
        if names[-1] == "TrackingSession.process":
            chains.append(tuple(reversed(names)))
        return run_stages(*arguments)

    with patch.object(refiner, "run_stages", refine), files_entered() as files:
        session.process(image, index, index / 30.0)
    if not chains:
        raise ArviewError("the inner kernel was not called in the frame that is followed")
    return FramePath(min(chains, key=len), tuple(sorted(files)))


def sample_session() -> TrackingSession:
    """A session for the part of the sample clip."""
    part = load_part(SAMPLE / "part.toml")
    camera = load_camera(SAMPLE / "camera.json")
    return TrackingSession.of(cached_guide_views(part.model, part.effective_view_range), camera, part.model)


def tracked_frame() -> FramePath:
    """The way of a tracked frame of the sample clip: of those followed, the one that enters most files."""
    session = sample_session()
    paths: list[FramePath] = []
    with open_source(str(SAMPLE / "clip.mp4")) as source:
        for index, frame in enumerate(source):
            if index < WARM_UP_FRAMES:
                session.process(frame.image, index, frame.time_s)
            else:
                paths.append(frame_path(session, frame.image, index))
            if len(paths) == FOLLOWED_FRAMES:
                break
    return max(paths, key=lambda path: (len(path.files), path.calls))


def searched_frame() -> tuple[str, ...]:
    """Files that a frame enters in which the part is searched and nothing is found; the detector was made before."""
    session = sample_session()
    with open_source(str(SAMPLE / "clip.mp4")) as source:
        grey = np.full_like(next(iter(source)).image, 128)
    session.process(grey, 0, 0.0)
    with files_entered() as files:
        session.process(np.roll(grey, 1) + np.uint8(1), 1, 1.0 / 30.0)
    return tuple(sorted(files))


def photos(folder: Path) -> tuple[str, ...]:
    """Files that the photos of the sample plate enter in `reconstruct`, into a new folder."""
    part = load_part(PLATE / "part.toml")
    with files_entered() as files:
        arview.reconstruct(PLATE / "photos", folder, part=part)
    return tuple(sorted(files))


def main() -> None:
    parser = argparse.ArgumentParser(description=DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", action="store_true", help="reconstruct the sample plate too: minutes")
    chosen = parser.parse_args()
    path = tracked_frame()
    print(f"{path.calls} calls: {' -> '.join(path.chain)}")
    rows = {"a tracked frame": path.files, "a searched frame": searched_frame()}
    if chosen.photos:
        with TemporaryDirectory() as folder:
            rows["photos"] = photos(Path(folder) / "out")
    for name, files in rows.items():
        folders = {Path(file).parent for file in files}
        print(f"{name}: {len(files)} files in {len(folders)} folders: {', '.join(files)}")


if __name__ == "__main__":
    main()
