"""Removal of sensor noise from images before the part is searched in them.

Refinement and evidence measure single pixels: in strong noise right poses score no better than wrong ones, and plain
smoothing costs as much of the edges as of the noise. A small convolutional network predicts the noise, which is then
subtracted: Zhang et al., "Beyond a Gaussian Denoiser" (IEEE TIP 2017), on half-resolution planes as in their FFDNet
(IEEE TIP 2018). It sharpens lens blur slightly, too. The noise level is estimated first (Immerkær, "Fast Noise Variance
Estimation", CVIU 1996, here with the median); images with little noise are returned as they are.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.onnx_session import padded_to_multiple
from arview.weights import load_network

CELL_PX = 8
"""The network takes images whose sides are multiples of this."""
INPUT_MEAN, INPUT_SCALE = 128.0, 64.0
"""Grey level subtracted from the network's input, and the grey levels that input and output are divided by."""


MIN_NOISE = 5.0
"""Noise level in grey levels below which images are returned as they are."""
BAND_ROWS = 512
"""Height of the bands in which an image is denoised, which bounds the memory."""
OVERLAP_ROWS = 48
"""Rows added above and below a band; no smaller than the network's receptive field."""


def noise_level(image: NDArray[np.uint8], stride: int = 3) -> float:
    """Standard deviation of the noise of an image (H,W,3) in grey levels of its green channel.

    Dark and saturated pixels are left out. Noise that a codec or a camera has smoothed is underestimated.

    Args:
        image: RGB.
        stride: spacing of the sampled rows and columns.
    """
    laplacian = np.outer([1, -2, 1], [1, -2, 1]).astype(np.float32)
    green = image[..., 1].copy()
    sampled = np.s_[1::stride, 1::stride]
    differences, values = cv2.filter2D(green, cv2.CV_16S, laplacian)[sampled], green[sampled]
    magnitudes = np.abs(differences[(values > 2) & (values < 253)])
    if not len(magnitudes):
        return 0.0
    # The median of |x| of a standard normal x is 0.6745; the filter multiplies the deviation of noise by 6.
    return float(np.median(magnitudes)) / 0.6745 / 6.0


class Denoiser:
    """The denoising network; threads may share it."""

    def __init__(self) -> None:
        self._network = load_network("denoiser.onnx")

    def denoise(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """An RGB image (H,W,3) without its noise; the same array if there is little noise."""
        if noise_level(image) < MIN_NOISE:
            return image
        height, width = image.shape[:2]
        clean = np.empty_like(image)
        for top in range(0, height, BAND_ROWS):
            bottom = min(top + BAND_ROWS, height)
            first, last = max(0, top - OVERLAP_ROWS), min(height, bottom + OVERLAP_ROWS)
            band = padded_to_multiple(image[first:last], CELL_PX)
            # OpenCV rounds and clips to 0–255.
            denoised = cv2.subtract(band, self._noise(band), dtype=cv2.CV_8U)
            clean[top:bottom] = denoised[top - first : bottom - first, :width]
        return clean

    def _noise(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Predicted noise (H,W,3) in grey levels; sides of the image are multiples of `CELL_PX`."""
        mean = (INPUT_MEAN,) * 3
        predicted = self._network(picture=cv2.dnn.blobFromImage(image, 1.0 / INPUT_SCALE, mean=mean))[0]
        # Each place predicts four pixels: 3 colours × 2 rows × 2 columns.
        rows, columns = predicted.shape[1:]
        shuffled = predicted.reshape(3, 2, 2, rows, columns).transpose(3, 1, 4, 2, 0).reshape(image.shape)
        return np.asarray(-INPUT_SCALE * shuffled, dtype=np.float32)
