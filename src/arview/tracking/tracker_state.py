"""State of the tracker: what it keeps between frames, and one frame while it is tracked."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.geometry import Array
from arview.refinement import (
    Appearance,
    PoseEvidence,
    PoseScores,
    Pyramid,
    RefinementPyramid,
    Stage,
    TextureMatches,
    median_brightness_ratio,
    value_bins,
)
from arview.tracking.motion import MotionModel

EXPOSURE_GRID_PX = 16
"""Distance of the pixels from which a change of exposure is measured."""
EXPOSURE_DECAY = 0.9
"""Exponent by which the estimated exposure fades, because the histograms follow slow changes."""
EXPOSURE_LIMITS = (0.2, 5.0)
"""Smallest and largest exposure relative to the first frame."""


@dataclass
class TrackerState:
    """What the tracker keeps between frames.

    Attributes:
        cam_from_body: (4,4) pose in the last frame.
        velocity: (6,) twist (rad, mm) expected until the next frame.
        usual_score, usual_fine_score: running means of the scores in the working and in the finest picture.
        appearance: colours of part and background.
        exposure: brightness relative to the frame in which colours were first learned.
        sparse_gray: (rows,columns) brightness of the last frame on a coarse grid.
        edge_support: running mean of the support of the outline by edges.
        uses_edges: whether edges are used in the next frame, see `Tracker`.
        best_contour_support: best recent support of the outline.
        is_started: whether a frame has been tracked since the start.
        frames: tracked since the start.
        futile: frame in which no other schedule gained anything, and the score there; None: there was none.
        spread_px: standard deviation of the blur of the part's edges, px of the frame; 0 where it is not known.
        motion: how far poses usually are from the predicted ones.
        unknown_twist: (6,) twist on the right of the pose, a turn about an axis of the part of which frames tell
            nothing at present; None: there is none.
    """

    cam_from_body: Array
    velocity: Array = field(default_factory=lambda: np.zeros(6))
    usual_score: float = 0.0
    usual_fine_score: float = 0.0
    appearance: Appearance = field(default_factory=Appearance)
    exposure: float = 1.0
    sparse_gray: NDArray[np.float64] | None = None
    edge_support: float = 0.0
    uses_edges: bool = True
    best_contour_support: float = 0.0
    is_started: bool = False
    frames: int = 0
    futile: tuple[int, float] | None = None
    spread_px: float = 0.0
    motion: MotionModel = field(default_factory=MotionModel)
    unknown_twist: Array | None = None

    def follow_exposure(self, gray: NDArray[np.uint8]) -> None:
        """Compensate the colours for a change of exposure since the last frame.

        The change is the median ratio of the grey levels (H,W) on a coarse grid.
        """
        step = EXPOSURE_GRID_PX
        if self.sparse_gray is None:
            self.sparse_gray = np.zeros((gray.shape[0] // step, gray.shape[1] // step))
        ratio = median_brightness_ratio(gray, self.sparse_gray, step)
        if ratio != 1.0 or self.exposure != 1.0:
            low, high = EXPOSURE_LIMITS
            self.exposure = min(max(self.exposure**EXPOSURE_DECAY * ratio, low), high)
            self.appearance.bin_of = value_bins(self.exposure)

    def is_futile(self, score: float, frames: int, share: float) -> bool:
        """Whether no other schedule gained anything a few frames ago, and the score is hardly lower now."""
        return self.futile is not None and self.frames - self.futile[0] <= frames and score >= share * self.futile[1]


class RefinedPose(NamedTuple):
    """A pose of one frame after refinement.

    Attributes:
        cam_from_body: (4,4) pose.
        information: (6,6) of the twist on its right.
        scores: how well the frame supports it.
        matches: texture used; None without.
    """

    cam_from_body: Array
    information: Array
    scores: PoseScores
    matches: TextureMatches | None

    @property
    def evidence(self) -> PoseEvidence:
        """Evidence of the working picture for it."""
        return self.scores.evidence


class Proposal(NamedTuple):
    """A pose to be refined, and what it must gain to be selected.

    Attributes:
        cam_from_body: (4,4) start.
        stages: schedule of its refinement; empty: the start is refined by shading.
        matches: texture used in addition to colours and edges.
        min_gain: by how much its score must exceed that of the best pose so far.
        motion_penalty: score that a squared motion distance of 1 costs.
        is_final: keep the start as the pose and use the stages only for its information.
        first_level: number of the picture in which the schedule is run; finer ones follow. Negative: from the finest.
    """

    cam_from_body: Array
    stages: tuple[Stage, ...]
    matches: TextureMatches | None = None
    min_gain: float = 0.0
    motion_penalty: float = 0.0
    is_final: bool = False
    first_level: int = 0


@dataclass
class FrameContext:
    """One frame while it is tracked.

    Attributes:
        image: (H,W,3) uint8 RGB.
        levels: the frame at the scales at which poses are refined and judged.
        predicted: (4,4) pose predicted from the motion so far.
        start: (4,4) the predicted pose, aligned with the texture found.
        pyramid: image pyramid of the grey picture; None without texture.
        matches: texture found; None where it is too little.
        found_share: share of the expected texture that was found.
        best: the best pose so far; None before the first one.
        is_rechecked: whether the recheck was asked for.
        prior: (4,4) pose that is known from elsewhere; None without one.
    """

    image: NDArray[np.uint8]
    levels: RefinementPyramid
    predicted: Array
    start: Array
    pyramid: Pyramid | None = None
    matches: TextureMatches | None = None
    found_share: float = 0.0
    best: RefinedPose | None = None
    is_rechecked: bool = False
    prior: Array | None = None

    @property
    def found(self) -> RefinedPose:
        """The best pose so far, which exists after the first proposal."""
        assert self.best is not None
        return self.best
