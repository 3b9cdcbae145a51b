"""What a real camera does to a picture: blur, a rolling shutter, exposure, white balance, noise, sharpening, codec."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from fractions import Fraction

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from arview.errors import OutputError
from arview.geometry import Array, apply, exp_se3, invert, log_se3
from arview.video import Image
from arview_lab.semisynthetic.sequence import SequenceFrame
from arview_lab.semisynthetic.trajectory import smooth_noise

FRAME_RATE = 30
STEPS = 33
"""Moments at which the pose is tabulated over the time in which a frame is read."""
ROW_ITERATIONS = 4
"""Times that the row in which a moving vertex lands is refined."""


@dataclass(frozen=True)
class CameraEffects:
    """A camera's faults. Lengths in px are those of a picture of 512 rows and grow with the number of rows.

    Attributes:
        shutter: share of the time between frames in which each row is exposed: motion blur.
        readout: share of the time between frames that passes from the first row's exposure to the last's; the pose is
            that of the middle row.
        lens_px: standard deviation of the blur of the lens in focus.
        defocus_px: smallest and largest radius of the blur disc of the part, which changes smoothly.
        behind_px: further radius of the blur disc of the background.
        light_ev: standard deviation of the scene's brightness, in f-stops.
        exposure_lag: frames that automatic exposure needs to follow; 0: exposure is fixed.
        white_balance: standard deviation of the gains of red and blue.
        read_noise, shot_noise: standard deviation in grey levels in the dark, and added at full scale.
        sharpening: amount of the unsharp mask of the camera's processor.
        mbit_per_s: bit rate of H.264; 0: no codec.
    """

    shutter: float = 0.0
    readout: float = 0.0
    lens_px: float = 0.6
    defocus_px: tuple[float, float] = (0.0, 0.0)
    behind_px: float = 0.0
    light_ev: float = 0.0
    exposure_lag: float = 0.0
    white_balance: float = 0.0
    read_noise: float = 2.0
    shot_noise: float = 0.0
    sharpening: float = 0.0
    mbit_per_s: float = 0.0


class Motion:
    """Poses around the middle of a frame's exposure, along the motion between its neighbours.

    Args:
        poses: (N,4,4) ``cam_from_model`` at the middle of each frame.
        number: of the frame.
    """

    def __init__(self, poses: Array, number: int) -> None:
        before, after = max(number - 1, 0), min(number + 1, len(poses) - 1)
        self._pose = poses[number]
        self._twist = log_se3(invert(poses[before]) @ poses[after]) / max(after - before, 1)

    def at(self, time: float) -> Array:
        """``cam_from_model`` (4,4) at a time in frames, 0 at the middle."""
        return np.asarray(self._pose @ exp_se3(time * self._twist))

    def points(self, vertices: Array, time: float, readout: float, row_of: Array, height: int) -> Array:
        """Vertices (V,3) in the camera frame, each at the time at which the row where it is seen is exposed.

        Args:
            vertices: (V,3) in the model.
            time: of the middle row, in frames.
            readout: see `CameraEffects`.
            row_of: (fy, cy) of the camera, px.
            height: rows of the picture.
        """
        if readout <= 0.0:
            return apply(self.at(time), vertices)
        half = 1.5 * readout
        times = np.linspace(time - half, time + half, STEPS)
        table = np.stack([apply(self.at(t), vertices) for t in times])
        fy, cy = row_of
        everyone = np.arange(len(vertices))
        place = np.full(len(vertices), 0.5 * (STEPS - 1))
        for _ in range(ROW_ITERATIONS):
            low = np.minimum(place.astype(int), STEPS - 2)
            share = (place - low)[:, None]
            points = (1.0 - share) * table[low, everyone] + share * table[low + 1, everyone]
            row = fy * points[:, 1] / np.maximum(points[:, 2], 1.0) + cy
            late = readout * (row - 0.5 * (height - 1)) / height
            place = np.clip((late + half) / (2.0 * half) * (STEPS - 1), 0.0, STEPS - 1.0)
        return np.asarray(points)


def disc_blurred(
    image: NDArray[np.float32], radius_px: float, sigma_px: float, border: int = cv2.BORDER_CONSTANT
) -> NDArray[np.float32]:
    """An image (H,W,C) blurred by a disc, as out of focus, and by a Gaussian; black outside unless said otherwise."""
    if radius_px >= 0.4:
        reach = int(np.ceil(radius_px + 1.0))
        v, u = np.mgrid[-reach : reach + 1, -reach : reach + 1]
        disc = np.clip(radius_px + 0.5 - np.hypot(u, v), 0.0, 1.0)
        image = cv2.filter2D(image, -1, disc / disc.sum(), borderType=border)
    if sigma_px > 0.0:
        image = cv2.GaussianBlur(image, (0, 0), sigma_px, borderType=border)
    return np.asarray(image)


class Sensor:
    """Turns the light of successive frames into pictures.

    Args:
        effects: of the camera.
        count: number of frames.
        scale: rows of the picture over 512.
        rng: of drift and noise.
    """

    def __init__(self, effects: CameraEffects, count: int, scale: float, rng: np.random.Generator) -> None:
        self._effects, self._scale, self._rng = effects, scale, rng
        drift = smooth_noise(count, 4, 16.0, rng)
        self._light = 2.0 ** (effects.light_ev * drift[:, 0])
        self._balance = 1.0 + effects.white_balance * drift[:, 1:3]
        self._gain = 0.0
        low, high = effects.defocus_px
        self.defocus_px = scale * (0.5 * (low + high) + 0.5 * (high - low) * np.tanh(1.5 * drift[:, 3]))

    def expose(self, light: NDArray[np.float32], number: int) -> Image:
        """Picture (H,W,3) of a frame whose light is in grey levels."""
        e = self._effects
        arriving = light * np.float32(self._light[number])
        if e.exposure_lag > 0.0:
            wanted = 112.0 / max(float(arriving.mean()), 8.0)
            step = 1.0 if self._gain == 0.0 else 1.0 / e.exposure_lag
            self._gain = float(np.clip((self._gain or wanted) * (wanted / (self._gain or wanted)) ** step, 0.4, 3.0))
            arriving = arriving * np.float32(self._gain)
        if e.white_balance > 0.0:
            red, blue = self._balance[number]
            arriving = arriving * np.array([red, 1.0, blue], np.float32)
        if e.exposure_lag > 0.0:
            # Bright light rolls off instead of being cut.
            over = np.maximum(arriving - 200.0, 0.0)
            arriving = np.minimum(arriving, 200.0) + 55.0 * (1.0 - np.exp(-over / 55.0))
        gain = max(self._gain, 1.0)
        deviation = np.sqrt((e.read_noise * gain) ** 2 + e.shot_noise**2 * np.clip(arriving, 0, None) / 255.0 * gain)
        picture = arriving + deviation * self._rng.standard_normal(arriving.shape, dtype=np.float32)
        if e.sharpening > 0.0:
            soft = cv2.GaussianBlur(picture, (0, 0), 1.1 * self._scale)
            picture = picture + e.sharpening * (picture - soft)
        return np.clip(np.round(picture), 0, 255).astype(np.uint8)


def through_codec(frames: Iterable[SequenceFrame], mbit_per_s: float) -> Iterator[SequenceFrame]:
    """The frames as they come out of an H.264 encoder of a bit rate and a decoder, each with its own truth.

    The encoder works as in a phone: without B-frames, an intra frame once a second, and one frame at a time.

    Raises:
        OutputError: the decoder gives other frames than went in.
    """
    waiting: deque[SequenceFrame] = deque()
    codec = _Codec(mbit_per_s)
    for number, frame in enumerate(frames):
        waiting.append(frame)
        for image in codec.pass_through(frame.image, number):
            yield replace(waiting.popleft(), image=image)
    for image in codec.flush():
        yield replace(waiting.popleft(), image=image)
    if waiting:
        raise OutputError(f"H.264: {len(waiting)} of the frames did not come out of the decoder; update PyAV")


class _Codec:
    """An H.264 encoder and decoder in one thread each, so that the pictures are always the same."""

    def __init__(self, mbit_per_s: float) -> None:
        self._rate = round(1e6 * mbit_per_s)
        self._encoder: av.VideoCodecContext | None = None
        self._decoder = av.CodecContext.create("h264", "r")
        self._decoder.thread_count = 1
        self._next = 0

    def pass_through(self, image: Image, number: int) -> list[Image]:
        """Pictures that the decoder gives after another one was encoded."""
        if self._encoder is None:
            self._encoder = self._open(image)
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24").reformat(format="yuv420p")
        frame.pts, frame.time_base = number, Fraction(1, FRAME_RATE)
        return self._decoded(self._encoder.encode(frame))

    def flush(self) -> list[Image]:
        """Pictures still inside."""
        if self._encoder is None:
            return []
        images = self._decoded(self._encoder.encode(None))
        return images + self._pictures(self._decoder.decode(None))

    def _open(self, image: Image) -> av.VideoCodecContext:
        encoder = av.CodecContext.create("libx264", "w")
        assert isinstance(encoder, av.VideoCodecContext)
        encoder.height, encoder.width = image.shape[:2]
        encoder.pix_fmt, encoder.bit_rate, encoder.gop_size = "yuv420p", self._rate, FRAME_RATE
        encoder.framerate, encoder.time_base = Fraction(FRAME_RATE), Fraction(1, FRAME_RATE)
        encoder.thread_count = 1
        encoder.options = {
            "preset": "veryfast", "tune": "zerolatency", "maxrate": str(self._rate), "bufsize": str(self._rate // 2),
        }  # fmt: skip
        return encoder

    def _decoded(self, packets: list[av.Packet]) -> list[Image]:
        return [image for packet in packets for image in self._pictures(self._decoder.decode(packet))]

    def _pictures(self, frames: list[av.VideoFrame]) -> list[Image]:
        images = []
        for frame in frames:
            if frame.pts is not None and frame.pts != self._next:
                raise OutputError(f"H.264: frame {self._next} came out of the decoder as {frame.pts}; update PyAV")
            self._next += 1
            images.append(np.ascontiguousarray(frame.to_ndarray(format="rgb24")))
        return images
