"""The pictures of a cell: one of each camera at a time, averaged over a burst."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.atomic import write_file
from arview.errors import InputError
from arview.station.rig.station_file import RigCamera
from arview.video import Frame, FrameSource, open_source

_OLD_FRAMES = 1
"""Frames of a live source that may have been taken before they were asked for."""


class RigCameras:
    """The open cameras of a cell, as a context manager.

    Raises:
        InputError: a source cannot be opened, or its pictures have another size than its camera file.
    """

    def __init__(self, cameras: Sequence[RigCamera]) -> None:
        self.cameras = tuple(cameras)
        self._pool = ThreadPoolExecutor(len(self.cameras), "arview-rig")
        self._sources: list[FrameSource] = []
        try:
            for one in self.cameras:
                source = open_source(one.source)
                self._sources.append(source)
                if (source.width, source.height) != (one.camera.width, one.camera.height):
                    raise InputError(
                        f"camera {one.name}: {one.source} gives {source.width}×{source.height} px, its camera file is"
                        f" for {one.camera.width}×{one.camera.height}; calibrate the lens at the size that is used"
                    )
        except BaseException:
            self.close()
            raise
        self._frames: list[Iterator[Frame]] = [iter(source) for source in self._sources]

    @property
    def is_live(self) -> bool:
        """Whether pictures come in real time, not from files."""
        return any(source.is_live for source in self._sources)

    def take(self) -> dict[str, NDArray[np.uint8] | None]:
        """One picture (H,W,3) uint8 RGB of each camera, all at the same time; None where a source gives none."""
        pictures = self._pool.map(self._burst, range(len(self.cameras)))
        return {one.name: picture for one, picture in zip(self.cameras, pictures, strict=True)}

    def save(self, folder: Path) -> tuple[dict[str, Path], dict[str, str]]:
        """Take pictures and write them; returns the file of each camera, and why others have none."""
        folder.mkdir(parents=True, exist_ok=True)
        files: dict[str, Path] = {}
        missing: dict[str, str] = {}

        def write(name: str, picture: NDArray[np.uint8]) -> Path:
            path = folder / f"{name}.png"
            _, content = cv2.imencode(
                ".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, 1]
            )
            write_file(path, content.tobytes())
            return path

        jobs = {}
        for (name, picture), source in zip(self.take().items(), self._sources, strict=True):
            if picture is None:
                missing[name] = source.ended_reason or "its source has no more pictures"
            else:
                jobs[name] = self._pool.submit(write, name, picture)
        for name, job in jobs.items():
            files[name] = job.result()
        return files, missing

    def close(self) -> None:
        """Close all sources."""
        for source in self._sources:
            source.close()
        self._pool.shutdown(wait=False, cancel_futures=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _burst(self, index: int) -> NDArray[np.uint8] | None:
        """The mean of the next frames of one camera."""
        frames, camera = self._frames[index], self.cameras[index]
        for _ in range(_OLD_FRAMES if self._sources[index].is_live else 0):
            next(frames, None)
        taken = [frame.image for frame in (next(frames, None) for _ in range(camera.burst)) if frame is not None]
        if len(taken) < 2:
            return taken[0] if taken else None
        return np.asarray(np.rint(np.mean(taken, axis=0, dtype=np.float32)), dtype=np.uint8)
