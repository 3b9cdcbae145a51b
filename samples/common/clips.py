"""Clips: their frames as pictures in a folder, and the MP4 video of these."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np


def render(folder: Path, indices: Iterable[int], camera: Callable[[], Callable[[int], np.ndarray]]) -> None:
    """Render the missing frames of a folder; ``camera()``, called only if needed, returns the function of one frame."""
    import cv2

    folder.mkdir(parents=True, exist_ok=True)
    missing = [index for index in indices if not (folder / f"{index:06d}.png").exists()]
    if not missing:
        return
    take = camera()
    for index in missing:
        begin = time.process_time()
        # Written under another name first, so that an interrupted run leaves no incomplete picture.
        part = folder / f"{index:06d}.part.png"
        cv2.imwrite(str(part), take(index))
        part.replace(folder / f"{index:06d}.png")
        print(f"frame {index}: {time.process_time() - begin:.1f} CPU-s", flush=True)


def encode(frames: Path, target: Path, count: int, fps: int, size: tuple[int, int], crf: int) -> None:
    """Write the pictures 000000.png, 000001.png, … of a folder, (width, height) px each, as H.264 in BT.709."""
    import av
    import cv2

    with av.open(str(target), "w", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream("libx264", rate=fps)
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        stream.options = {"crf": str(crf), "preset": "slow"}
        context = stream.codec_context
        context.color_range, context.colorspace = 1, 1
        context.color_primaries, context.color_trc = 1, 1
        for index in range(count):
            picture = cv2.imread(str(frames / f"{index:06d}.png"))
            if picture is None:
                raise SystemExit(f"frame {index} is missing in {frames}; run: generate.py clip --work {frames}")
            frame = av.VideoFrame.from_ndarray(picture, format="bgr24")
            frame = frame.reformat(format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG")
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    print(f"{target}: {target.stat().st_size / 1e6:.2f} MB")
