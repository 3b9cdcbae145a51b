"""Deinterlacing: whole frames from frames whose two fields were taken at different times."""

from __future__ import annotations

from collections import deque
from fractions import Fraction
from typing import Generic, TypeVar

from av.error import BlockingIOError as NotReadyError
from av.error import EOFError as EndOfStreamError
from av.error import FFmpegError
from av.filter import Graph
from av.video.frame import VideoFrame

Tag = TypeVar("Tag")

FILTER = "bwdif"
"""Motion-adaptive deinterlacer of FFmpeg: w3fdif where the picture moves, both fields where it does not."""
ARGUMENTS = "mode=send_frame:parity=auto:deint=interlaced"
"""A frame for a frame, in the order of fields that each declares; frames declared progressive are left alone."""


class Deinterlacer(Generic[Tag]):
    """Passes frames through until one declares itself interlaced; from then on all go through the filter.

    The filter needs the following frame, so that frames come out one later. Each keeps the tag that it came with, for
    example its index and time.

    Attributes:
        is_active: an interlaced frame has come.
    """

    def __init__(self) -> None:
        self.is_active = False
        self._graph: Graph | None = None
        self._kind: tuple[int, int, str] | None = None
        self._tags: deque[Tag] = deque()
        self._pushed = 0
        self._unfit: set[tuple[int, int, str]] = set()  # too small, or of a format that the filter does not take

    def push(self, frame: VideoFrame, tag: Tag) -> list[tuple[Tag, VideoFrame]]:
        """Add a frame; returns those that are ready, in order."""
        kind = (frame.width, frame.height, frame.format.name)
        ready = self.flush() if self._graph is not None and kind != self._kind else []
        if self._graph is None:
            if not frame.interlaced_frame or kind in self._unfit:
                return [*ready, (tag, frame)]
            try:
                self._graph, self._kind = _filter_graph(frame), kind
            except (FFmpegError, ValueError):
                self._unfit.add(kind)
                return [*ready, (tag, frame)]
            self.is_active = True
        # The filter counts in stamps of its own, because those of the file may be missing or not increase.
        frame.pts, frame.time_base = self._pushed, Fraction(1, 1000)
        self._pushed += 1
        self._tags.append(tag)
        self._graph.vpush(frame)
        return [*ready, *self._pulled()]

    def flush(self) -> list[tuple[Tag, VideoFrame]]:
        """The frames that the filter still holds; it is ready for another stream then."""
        if self._graph is None:
            return []
        self._graph.vpush(None)
        ready = self._pulled()
        self._graph = self._kind = None
        self._tags.clear()
        return ready

    def _pulled(self) -> list[tuple[Tag, VideoFrame]]:
        """Frames that the filter has finished."""
        assert self._graph is not None
        ready = []
        while self._tags:
            try:
                frame = self._graph.vpull()
            except (NotReadyError, EndOfStreamError):
                break
            ready.append((self._tags.popleft(), frame))
        return ready


def _filter_graph(frame: VideoFrame) -> Graph:
    """Source, deinterlacer and sink for frames like one."""
    graph = Graph()
    graph.threads = 1
    source = graph.add_buffer(width=frame.width, height=frame.height, format=frame.format, time_base=Fraction(1, 1000))
    graph.link_nodes(source, graph.add(FILTER, ARGUMENTS), graph.add("buffersink")).configure()
    return graph
