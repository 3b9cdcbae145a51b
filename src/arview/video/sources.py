"""open_source: the FrameSource of a file, folder, camera or address."""

from __future__ import annotations

import glob
import re
from pathlib import Path

from arview.core.checks import PATH, check_type
from arview.core.plug_ins import find_plug_ins, load_plug_in
from arview.errors import InputError, without_credentials
from arview.video.files import VideoFileSource
from arview.video.live import CameraGrabber, LiveSource, UrlGrabber
from arview.video.pictures import (
    SUFFIXES,
    PictureSource,
    is_film,
    is_printf_pattern,
    paths_of_pattern,
    picture_paths,
    pictures_among,
)
from arview.video.source import FrameRange, FrameSource

_CAMERA_INDEX = re.compile(r"(?:/dev/video)?([0-9]{1,3})")
PLUG_INS = "arview.sources"
"""Entry points of other packages, named by the scheme of the addresses that each opens."""
_URL = re.compile(r"[a-zA-Z][a-zA-Z0-9+.-]+://")


def open_source(
    spec: str | Path,
    *,
    start: int | None = None,
    end: int | None = None,
    stride: int = 1,
    fps: float = 30.0,
    open_timeout_s: float = 10.0,
    read_timeout_s: float = 5.0,
) -> FrameSource:
    """Open a source of frames: video file, picture, folder, glob or pattern of pictures, camera index or URL.

    Args:
        spec: path, glob ("shots/*.png"), pattern ("frame_%04d.png"), camera index ("0"), URL ("rtsp://…"), or an
            address of another package's sources ("SCHEME:…").
        start: index of the first wanted frame in the source, of numbered pictures the number; None is 0.
        end: index of the first frame that is not wanted any more; None is the end of the source.
        stride: interval between wanted frames.
        fps: frames per second from which the time stamps of pictures are made.
        open_timeout_s: longest wait for the first frame of a camera or URL.
        read_timeout_s: longest wait for the next frame of a camera or URL before its iteration ends.

    Raises:
        InputError: the source does not exist or cannot be read.
    """
    check_type(spec, PATH, "open_source: spec")
    wanted, text = FrameRange(start or 0, end, stride), str(spec)
    if not 0 < fps < float("inf"):
        raise InputError(f"fps {fps}: expected a positive number of frames per second")
    path = Path(text.removeprefix("file://"))
    scheme, _, address = text.partition(":")
    if address and (entry := find_plug_ins(PLUG_INS).get(scheme)) is not None:
        source = load_plug_in(entry)(address, wanted)
        if not isinstance(source, FrameSource):
            raise InputError(f"{text}: {entry.value} made no source of frames")
        return source
    if _URL.match(text) and not text.startswith("file://"):
        return LiveSource(
            without_credentials(text),
            lambda: UrlGrabber(text, open_timeout_s, read_timeout_s),
            wanted,
            open_timeout_s,
            read_timeout_s,
        )
    camera = _CAMERA_INDEX.fullmatch(text)
    if camera and (text.startswith("/dev/") or not path.exists()):
        index = int(camera.group(1))
        return LiveSource(f"camera {index}", lambda: CameraGrabber(index), wanted, open_timeout_s, read_timeout_s)
    if path.is_dir():
        pictures = picture_paths(path)
        if not pictures:
            raise InputError(f"{path}: the folder contains no pictures ({_suffixes()}); give another folder or file")
        return PictureSource(text, pictures, wanted, fps)
    if path.exists():
        if path.suffix.lower() in SUFFIXES and not is_film(path):
            return PictureSource(text, [path], wanted, fps)
        return VideoFileSource(path, wanted)
    if is_printf_pattern(text):
        return PictureSource(text, paths_of_pattern(text), wanted, fps)
    if glob.has_magic(text):
        found = (Path(match) for match in glob.glob(text, recursive=True))  # noqa: PTH207 - absolute patterns too
        pictures = pictures_among(found)
        if not pictures:
            raise InputError(f"{text}: no picture ({_suffixes()}) matches; check the pattern")
        return PictureSource(text, pictures, wanted, fps)
    raise InputError(
        f"{text}: no such file or folder; give a video, a folder or glob of pictures, a camera index or a URL"
    )


def check_source(spec: str | Path) -> None:
    """Check that a file, folder or glob can be read; a camera or address need not be available yet.

    Raises:
        InputError: as in `open_source`.
    """
    text = str(spec)
    is_url = _URL.match(text) and not text.startswith("file://")
    is_camera = _CAMERA_INDEX.fullmatch(text) and (text.startswith("/dev/") or not Path(text).exists())
    if not (is_url or is_camera):
        open_source(spec).close()


def _suffixes() -> str:
    return ", ".join(sorted(suffix.removeprefix(".") for suffix in SUFFIXES))
