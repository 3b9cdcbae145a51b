"""Options of a tracking session."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from arview.detection import Detection, DetectorOptions
from arview.tracking.tracker_options import Matcher

TRACKED_QUALITY = 0.5
"""Quality needed to become ``tracked``."""
CRITICAL_QUALITY = 0.25
"""A tracked pose becomes ``critical`` only below this quality (hysteresis)."""
LOST_QUALITY = 0.1
"""A pose below this quality for ``LOST_FRAMES`` frames is given up."""


class Finder(Protocol):
    """Finds the part in a picture, in place of `Detector`."""

    def detect(self, image: NDArray[np.uint8], /) -> Sequence[Detection]:
        """Poses of the part in a picture (H,W,3) uint8 RGB of the session's camera, best first."""
        ...


@dataclass(frozen=True)
class SessionOptions:
    """Options of a session.

    Attributes:
        use_region: let the tracker use colours along the outline.
        use_edge: let the tracker use grey-level edges.
        use_texture: let the tracker use the part's own texture.
        use_recheck: run the detector's local search where a tracked pose is far from the predicted one.
        detector: options of the detector; None chooses them by the declared range.
        finder: asked for the part in place of the detector; what it finds is refined and judged as usual.
        matcher: asked in each frame of a tracked part for points of it, which support the pose as its texture does.
    """

    use_region: bool = True
    use_edge: bool = True
    use_texture: bool = True
    use_recheck: bool = True
    detector: DetectorOptions | None = None
    finder: Finder | None = None
    matcher: Matcher | None = None
