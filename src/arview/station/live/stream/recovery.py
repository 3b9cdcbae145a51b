"""Recordings that a crash has cut off: what was written of them is made a video, and listed with the others."""

from __future__ import annotations

import json
import logging
import os
import re
import time
from collections.abc import Collection, Iterator
from contextlib import suppress
from pathlib import Path

import av

from arview.core.atomic import replacing, writing_process
from arview.video import CONTAINERS

logger = logging.getLogger("arview.station.live")

RECOVERED = "_recovered"
"""End of the name of a recovered recording, before its suffix."""
STALE_S = 600.0
"""An unfinished file that was not written to for so long is nobody's, even if its process number is taken again."""
_UNFINISHED = re.compile(r"\.(?P<name>.+)\.(?P<process>\d+)\.part$")


def recover_recordings(folder: Path, names: Collection[str] = (), running: Collection[Path] = ()) -> list[Path]:
    """Make videos of the recordings in a folder that a crash has cut off; returns them.

    Each becomes ``NAME_recovered.mp4`` with its poses in ``NAME_recovered.jsonl``, up to the last whole second that was
    written. A file of which nothing can be read stays where it is.

    Args:
        folder: of the recordings.
        names: names of videos other than ``live_…``, without suffix, that the program also writes there.
        running: videos that this process is recording.
    """
    recovered = []
    for part in _unfinished(folder, names, running):
        match = _UNFINISHED.match(part.name)
        assert match is not None
        target = _free_name(part.with_name(match["name"]))
        frames = recovered_frames(part, target)
        if not frames:
            logger.warning("%s was cut off before anything of it was written that can be read", match["name"])
            continue
        poses = part.with_name(f".{Path(match['name']).stem}.jsonl.{match['process']}.part")
        _recover_poses(poses, target.with_suffix(".jsonl"), frames)
        with suppress(OSError):
            part.unlink()
        logger.warning("%s was cut off and is recovered as %s", match["name"], target.name)
        recovered.append(target)
    return recovered


def recovered_frames(part: Path, target: Path) -> int:
    """Copy the whole packets of a video that was cut off into a new file; returns their number, 0 if there are none."""
    unfinished = target.with_name(f".{target.name}.recovering")
    count = 0
    try:
        with (
            av.open(str(part.absolute())) as source,
            av.open(
                str(unfinished.absolute()),
                "w",
                format=CONTAINERS[target.suffix.lower()],
                options={"movflags": "+faststart"},
            ) as copy,
        ):
            video = source.streams.video[0]
            stream = copy.add_stream_from_template(video)
            with suppress(av.FFmpegError):  # the cut
                for packet in source.demux(video):
                    if packet.dts is None or packet.is_corrupt:
                        continue
                    packet.stream = stream
                    copy.mux(packet)
                    count += 1
        if count:
            unfinished.replace(target)
    except (av.FFmpegError, OSError, IndexError, ValueError) as error:
        logger.debug("%s: %s", part, error)
        count = 0
    with suppress(OSError):
        unfinished.unlink(missing_ok=True)
    return count


def duration_s(path: Path) -> float | None:
    """Duration of a video by its index; None where it cannot be read."""
    try:
        with av.open(str(path.absolute())) as container:
            return None if container.duration is None else container.duration / av.time_base
    except (av.FFmpegError, OSError, ValueError):
        return None


def _unfinished(folder: Path, names: Collection[str], running: Collection[Path]) -> Iterator[Path]:
    """The unfinished videos in a folder that no running program writes."""
    busy = {path.absolute() for path in running}
    for part in sorted(folder.glob(".*.part")):
        match = _UNFINISHED.match(part.name)
        video = None if match is None else part.with_name(match["name"])
        if match is None or video is None or video.suffix.lower() not in CONTAINERS:
            continue
        if not video.name.startswith("live_") and not any(_is_named(video.stem, name) for name in names):
            continue
        is_own = int(match["process"]) == os.getpid() and video.absolute() in busy
        with suppress(OSError):
            is_stale = time.time() - part.stat().st_mtime > STALE_S
            if not is_own and (is_stale or writing_process(video) != int(match["process"])):
                yield part


def _is_named(stem: str, name: str) -> bool:
    """Whether a video is OUT or OUT-2, OUT-3, …"""
    return re.fullmatch(rf"{re.escape(name)}(-\d+)?", stem) is not None


def _free_name(video: Path) -> Path:
    for count in range(1, 1000):
        name = f"{video.stem}{RECOVERED}{'' if count == 1 else f'-{count}'}{video.suffix}"
        if not (target := video.with_name(name)).exists():
            return target
    return video.with_name(f"{video.stem}{RECOVERED}-{time.time_ns()}{video.suffix}")


def _recover_poses(part: Path, target: Path, frames: int) -> None:
    """The whole lines of a file of poses that belong to the frames of the video."""
    try:
        lines = part.read_bytes().split(b"\n")
        kept = []
        for line in lines[:-1]:
            with suppress(ValueError, KeyError, TypeError):
                if json.loads(line)["index"] < frames:
                    kept.append(line + b"\n")
        with replacing(target) as file:
            file.writelines(kept)
        part.unlink()
    except OSError as error:
        logger.warning("%s: the poses are not recovered (%s)", target.name, error.strerror or error)
