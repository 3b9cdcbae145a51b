"""Video in and out: frames from files, pictures, cameras and streams; annotated frames to H.264."""

from arview.video.frame import Frame, Image
from arview.video.sinks import VideoSink
from arview.video.source import FrameRange, FrameSource
from arview.video.sources import open_source

__all__ = ["Frame", "FrameRange", "FrameSource", "Image", "VideoSink", "open_source"]
