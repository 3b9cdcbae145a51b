"""Convolutional networks run by ONNX Runtime on the CPU."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.parallel import thread_count

if TYPE_CHECKING:
    import onnxruntime


class Network:
    """A network as an ONNX Runtime session; threads may share it.

    Args:
        model: bytes of the ONNX file, see `arview.weights.load_network`.
    """

    def __init__(self, model: bytes) -> None:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = thread_count()
        # Spinning threads would take the cores from the kernels of the searches.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        self._session: onnxruntime.InferenceSession = onnxruntime.InferenceSession(
            model, options, providers=["CPUExecutionProvider"]
        )

    def __call__(self, **inputs: NDArray[np.float32] | NDArray[np.int64]) -> NDArray[np.float32]:
        """The first output for inputs given by their names."""
        return np.asarray(self._session.run(None, inputs)[0])

    @property
    def inputs(self) -> dict[str, list[int | str]]:
        """Shape of each input by its name; a dimension of free size is a string."""
        return {one.name: one.shape for one in self._session.get_inputs()}


def padded_to_multiple(image: NDArray[np.uint8], cell_px: int) -> NDArray[np.uint8]:
    """An image (H,W,3) with its last rows and columns repeated until both sides are multiples of ``cell_px``."""
    height, width = image.shape[:2]
    return np.asarray(
        cv2.copyMakeBorder(image, 0, -height % cell_px, 0, -width % cell_px, cv2.BORDER_REPLICATE), dtype=np.uint8
    )
