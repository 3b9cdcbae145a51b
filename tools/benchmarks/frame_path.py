#!/usr/bin/env python
"""The way of one tracked frame through arview: calls down to the inner kernel, and folders entered."""

from __future__ import annotations

import argparse
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
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
Print the way of one tracked frame of the sample clip through arview: the chain of calls from TrackingSession.process
to the inner kernel (refinement.kernels.run_stages), and the folders of arview whose functions run. Of several frames
the one that enters most folders is shown. Of the functions compiled by numba only the inner kernel is seen."""

ROOT = Path(arview.__file__).resolve().parent
WARM_UP_FRAMES, FOLLOWED_FRAMES = 12, 12
"""Frames of the sample clip that are tracked before any is followed, and those that are followed."""


@dataclass(frozen=True)
class FramePath:
    """The way of one frame.

    Attributes:
        chain: functions from `TrackingSession.process` to the inner kernel, both included, on the shortest way.
        folders: folders of arview, relative to it, whose functions ran; "." is arview itself.
    """

    chain: tuple[str, ...]
    folders: tuple[str, ...]

    @property
    def calls(self) -> int:
        """Number of calls from `TrackingSession.process` to the inner kernel."""
        return len(self.chain) - 1


def frame_path(session: TrackingSession, image: NDArray[np.uint8], index: int) -> FramePath:
    """Follow a frame (H,W,3) uint8 RGB through a session that tracks the part.

    Raises:
        ArviewError: the part is not tracked, or its pose is not refined in this frame.
    """
    if session.specimens[0].state is not TrackingState.TRACKED:
        raise ArviewError(f"the part is {session.specimens[0].state}, not tracked, before the frame that is followed")
    entered: set[Path] = set()
    chains: list[tuple[str, ...]] = []
    run_stages = kernels.run_stages

    def enter(frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            entered.add(Path(frame.f_code.co_filename))

    def refine(*arguments: Any) -> Any:
        names = ["run_stages"]
        caller = sys._getframe().f_back
        while caller is not None and names[-1] != "TrackingSession.process":
            names.append(caller.f_code.co_qualname)
            caller = caller.f_back
        if names[-1] == "TrackingSession.process":
            chains.append(tuple(reversed(names)))
        return run_stages(*arguments)

    with patch.object(refiner, "run_stages", refine):
        threading.setprofile(enter)
        sys.setprofile(enter)
        try:
            session.process(image, index, index / 30.0)
        finally:
            sys.setprofile(None)
            threading.setprofile(None)
    if not chains:
        raise ArviewError("the inner kernel was not called in the frame that is followed")
    folders = {path.parent.relative_to(ROOT).as_posix() for path in entered if path.is_relative_to(ROOT)}
    return FramePath(min(chains, key=len), tuple(sorted(folders)))


def sample_frame_path() -> FramePath:
    """The way of a frame of the sample clip: of those followed, the one that enters most folders."""
    part = load_part(SAMPLE / "part.toml")
    camera = load_camera(SAMPLE / "camera.json")
    session = TrackingSession.of(cached_guide_views(part.model, part.effective_view_range), camera, part.model)
    paths: list[FramePath] = []
    with open_source(str(SAMPLE / "clip.mp4")) as source:
        for index, frame in enumerate(source):
            if index < WARM_UP_FRAMES:
                session.process(frame.image, index, frame.time_s)
            else:
                paths.append(frame_path(session, frame.image, index))
            if len(paths) == FOLLOWED_FRAMES:
                break
    return max(paths, key=lambda path: (len(path.folders), path.calls))


def main() -> None:
    argparse.ArgumentParser(description=DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    path = sample_frame_path()
    print(f"{path.calls} calls: {' -> '.join(path.chain)}")
    print(f"{len(path.folders)} folders: {', '.join(path.folders)}")


if __name__ == "__main__":
    main()
