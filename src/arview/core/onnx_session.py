"""The package's convolutional networks, as ONNX Runtime runs them: in half the time that `cv2.dnn` takes."""

from __future__ import annotations

from functools import lru_cache
from importlib.resources import files
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.parallel import thread_count

if TYPE_CHECKING:
    import onnxruntime


class Network:
    """A network of the package by the name of its file. All of one name are one, and threads may share it."""

    def __init__(self, name: str) -> None:
        self._session = _session(name)

    def __call__(self, **shown: NDArray[np.float32] | NDArray[np.int64]) -> NDArray[np.float32]:
        """The answer to what it is shown, by the names of its inputs."""
        return np.asarray(self._session.run(None, shown)[0])


@lru_cache
def _session(name: str) -> onnxruntime.InferenceSession:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = thread_count()
    # Threads that wait by counting would take the cores from the searches' kernels.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    model = files("arview.weights").joinpath(name).read_bytes()
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])


def extended(image: NDArray[np.uint8], cell_px: int) -> NDArray[np.uint8]:
    """A picture (H,W,3) with its last rows and columns repeated until its sides are multiples of a cell's."""
    height, width = image.shape[:2]
    return np.asarray(
        cv2.copyMakeBorder(image, 0, -height % cell_px, 0, -width % cell_px, cv2.BORDER_REPLICATE), dtype=np.uint8
    )
