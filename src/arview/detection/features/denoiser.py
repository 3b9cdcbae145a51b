"""Grain taken out of noisy pictures before the part is looked for in them.

Outline and colours of a pose are judged on single pixels: in the grain of a dark shop they are drawn aside, and wrong
poses look no worse than right ones. Plain smoothing takes as much of the edges as of the grain, and nothing more is
found after it. A small convolutional network says what of a picture is grain, which is then taken out: Zhang et al.,
"Beyond a Gaussian Denoiser" (IEEE TIP 2017), on levels of half the resolution as in their FFDNet (IEEE TIP 2018). What
a lens blurred is sharpened a little with it. How noisy a picture is, is told first (Immerkær, "Fast Noise Variance
Estimation", CVIU 1996; here by the median): pictures of little grain stay as they are, and cost half a
millisecond. Of 294 noisy pictures of the semi-synthetic set the part is found in 225 without it, in 229 to 234 with one
or another fit of it.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.onnx_session import padded_to_multiple
from arview.weights import load_network

CELL_PX = 8
"""The network takes pictures of multiples of this."""
SHOWN_MEAN, SHOWN_RANGE = 128.0, 64.0
"""Grey levels less the first are shown in units of the second; so is the grain that it says."""
LEAST_NOISE = 5.0
"""Of less noise, in grey levels, pictures stay as they are: of 32 pictures of a box 29 are found as they are and 27
cleaned at a noise of 3, 26 and 26 at 6, 26 and 27 at 10 (where 3 and 0 are taken for a wrong pose)."""
BAND_ROWS, OVERLAP_ROWS = 512, 48
"""Pictures are cleaned in bands of so many rows, with so many more on either side: all that a place hears of."""
LOOK_EVERY = 3
"""The noise of every so manieth pixel of a row, and row, is looked at."""
_DIFFERENCE = np.outer([1, -2, 1], [1, -2, 1]).astype(np.float32)
_DIFFERENCE_DEVIATION = 6.0
"""Of what this says of noise of 1."""
_MEDIAN_DEVIATIONS = 0.6745
"""Half of normally spread values are within so many deviations."""


def noise_level(image: NDArray[np.uint8]) -> float:
    """Deviation of the noise of a picture (H,W,3), grey levels of the green channel; of what is neither dark nor burnt.

    Noise that a codec or a camera has smoothed is taken for less than it was.
    """
    green = image[..., 1].copy()
    some = np.s_[1::LOOK_EVERY, 1::LOOK_EVERY]
    differences, values = cv2.filter2D(green, cv2.CV_16S, _DIFFERENCE)[some], green[some]
    told = np.abs(differences[(values > 2) & (values < 253)])
    if not len(told):
        return 0.0
    return float(np.median(told)) / _MEDIAN_DEVIATIONS / _DIFFERENCE_DEVIATION


class Denoiser:
    """The network; threads may share it."""

    def __init__(self) -> None:
        self._network = load_network("denoiser.onnx")

    def denoise(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """An RGB picture (H,W,3) without its grain; the same one if it has little."""
        if noise_level(image) < LEAST_NOISE:
            return image
        height, width = image.shape[:2]
        clean = np.empty_like(image)
        for top in range(0, height, BAND_ROWS):
            bottom = min(top + BAND_ROWS, height)
            first, last = max(0, top - OVERLAP_ROWS), min(height, bottom + OVERLAP_ROWS)
            band = padded_to_multiple(image[first:last], CELL_PX)
            # Rounded, and held between black and white.
            rest = cv2.subtract(band, self._grain(band), dtype=cv2.CV_8U)
            clean[top:bottom] = rest[top - first : bottom - first, :width]
        return clean

    def _grain(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """(H,W,3) grey levels of grain in a picture of multiples of `CELL_PX`."""
        mean = (SHOWN_MEAN,) * 3
        said = self._network(picture=cv2.dnn.blobFromImage(image, 1.0 / SHOWN_RANGE, mean=mean))[0]
        # Each place says it of four pixels, 3 colours × 2 rows × 2 columns.
        rows, columns = said.shape[1:]
        shuffled = said.reshape(3, 2, 2, rows, columns).transpose(3, 1, 4, 2, 0).reshape(image.shape)
        return np.asarray(-SHOWN_RANGE * shuffled, dtype=np.float32)
