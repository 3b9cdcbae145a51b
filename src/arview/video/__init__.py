"""Video in and out: frames from files, pictures, cameras and streams; annotated frames to H.264."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.video.color import rgb_from_video_frame as rgb_from_video_frame
    from arview.video.frame import Frame as Frame
    from arview.video.frame import Image as Image
    from arview.video.intrinsics import load_camera_of as load_camera_of
    from arview.video.intrinsics import load_square_camera as load_square_camera
    from arview.video.pictures import PictureSource as PictureSource
    from arview.video.pictures import sorted_naturally as sorted_naturally
    from arview.video.sinks import CONTAINERS as CONTAINERS
    from arview.video.sinks import VideoSink as VideoSink
    from arview.video.sinks import open_sink as open_sink
    from arview.video.source import FrameRange as FrameRange
    from arview.video.source import FrameSource as FrameSource
    from arview.video.sources import check_source as check_source
    from arview.video.sources import open_source as open_source

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "color": ("rgb_from_video_frame",),
        "frame": (
            "Frame",
            "Image",
        ),
        "intrinsics": (
            "load_camera_of",
            "load_square_camera",
        ),
        "pictures": (
            "PictureSource",
            "sorted_naturally",
        ),
        "sinks": (
            "CONTAINERS",
            "VideoSink",
            "open_sink",
        ),
        "source": (
            "FrameRange",
            "FrameSource",
        ),
        "sources": (
            "check_source",
            "open_source",
        ),
    },
)
