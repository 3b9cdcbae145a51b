"""The compiled loop of ``color.tone_map``; a module of its own, so that numba is loaded only for HDR clips."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel


@kernel(fastmath=True)
def apply_tables(
    signal: NDArray[np.uint16],
    light_of_signal: NDArray[np.float32],
    matrix: NDArray[np.float32],
    code_of_light: NDArray[np.uint8],
    image: NDArray[np.uint8],
) -> None:
    """Write ``code_of_light[matrix @ light_of_signal[signal]]`` per pixel of (H,W,3) into ``image``.

    ``signal`` has 16 bits, of which the upper 12 index ``light_of_signal``; ``matrix`` (3,3) is scaled to the length of
    ``code_of_light``.
    """
    last = code_of_light.shape[0] - 1
    for row in range(signal.shape[0]):
        for column in range(signal.shape[1]):
            red = light_of_signal[signal[row, column, 0] >> 4]
            green = light_of_signal[signal[row, column, 1] >> 4]
            blue = light_of_signal[signal[row, column, 2] >> 4]
            for channel in range(3):
                light = matrix[channel, 0] * red + matrix[channel, 1] * green + matrix[channel, 2] * blue
                image[row, column, channel] = code_of_light[min(max(int(light + 0.5), 0), last)]
