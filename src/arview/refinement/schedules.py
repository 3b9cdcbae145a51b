"""Schedules: the stages through which a pose is refined, coarse to fine, for each kind of start."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.geometry import Array


@dataclass(frozen=True)
class Stage:
    """One stage of the refinement: measurements at one scale and the pose updates made with them.

    Attributes:
        region_scale: pixels per segment of the lines across the outline (SRT3D).
        edge_reach: samples to either side of an edge within which steps are found.
        edge_step_px: distance between these samples.
        edge_spread_px: expected distance of the pose from the edges; steps farther away count less.
        updates: updates of the pose with the same measurements.
        region_gain: weight of colours, as a factor of the refiner's.
        stride: every n-th point is measured, with n times the weight.
    """

    region_scale: int
    edge_reach: int
    edge_step_px: float
    edge_spread_px: float
    updates: int = 2
    region_gain: float = 1.0
    stride: int = 1

    def widened(self, factor: float) -> Stage:
        """The same stage for a part that is larger in the picture by a factor; the finest stages do not change."""
        if self.region_scale <= 1 or factor == 1.0:
            return self
        return replace(
            self,
            region_scale=round(self.region_scale * factor),
            edge_step_px=self.edge_step_px * factor,
            edge_spread_px=self.edge_spread_px * factor,
        )


class StageTable(NamedTuple):
    """Stages in the form of the kernels: a column (S,) for each attribute of `Stage`."""

    region_scale: NDArray[np.int64]
    edge_reach: NDArray[np.int64]
    edge_step_px: Array
    edge_spread_px: Array
    updates: NDArray[np.int64]
    region_gain: Array
    stride: NDArray[np.int64]


@lru_cache(maxsize=64)
def stage_table(stages: tuple[Stage, ...]) -> StageTable:
    """The columns of some stages."""
    return StageTable(
        region_scale=np.array([stage.region_scale for stage in stages], dtype=np.int64),
        edge_reach=np.array([stage.edge_reach for stage in stages], dtype=np.int64),
        edge_step_px=np.array([stage.edge_step_px for stage in stages], dtype=np.float64),
        edge_spread_px=np.array([stage.edge_spread_px for stage in stages], dtype=np.float64),
        updates=np.array([stage.updates for stage in stages], dtype=np.int64),
        region_gain=np.array([stage.region_gain for stage in stages], dtype=np.float64),
        stride=np.array([stage.stride for stage in stages], dtype=np.int64),
    )


TRACK_STAGES = (
    Stage(region_scale=4, edge_reach=12, edge_step_px=1.0, edge_spread_px=5.0, region_gain=0.5, stride=2),
    Stage(region_scale=2, edge_reach=8, edge_step_px=1.0, edge_spread_px=3.0, region_gain=0.2, stride=2),
    Stage(region_scale=1, edge_reach=6, edge_step_px=1.0, edge_spread_px=1.5, region_gain=0.1),
    Stage(region_scale=1, edge_reach=5, edge_step_px=1.0, edge_spread_px=1.0, region_gain=0.1),
)
"""Coarse to fine, for a usual frame. Colours help to find the outline; edges then locate it precisely."""
NEAR_STAGES = (
    Stage(region_scale=2, edge_reach=12, edge_step_px=1.5, edge_spread_px=3.0, region_gain=0.0),
    Stage(region_scale=2, edge_reach=10, edge_step_px=1.0, edge_spread_px=2.5, region_gain=0.0),
    Stage(region_scale=1, edge_reach=8, edge_step_px=1.0, edge_spread_px=2.0, region_gain=0.0),
    Stage(region_scale=1, edge_reach=6, edge_step_px=1.0, edge_spread_px=1.5, region_gain=0.0),
    Stage(region_scale=1, edge_reach=5, edge_step_px=1.0, edge_spread_px=1.0, region_gain=0.0),
)
"""Near edges without colours, which mislead where something hides a part of the outline or looks like the part."""
SEARCH_STAGES = (
    Stage(region_scale=2, edge_reach=12, edge_step_px=1.5, edge_spread_px=5.0),
    Stage(region_scale=2, edge_reach=10, edge_step_px=1.0, edge_spread_px=4.0),
    Stage(region_scale=1, edge_reach=8, edge_step_px=1.0, edge_spread_px=2.5),
    Stage(region_scale=1, edge_reach=6, edge_step_px=1.0, edge_spread_px=1.5),
    Stage(region_scale=1, edge_reach=5, edge_step_px=1.0, edge_spread_px=1.0),
)
"""Edges and colours, for a pose found by a search, which is off by some pixels."""
LAST_STAGES = 2 * tuple(replace(stage, region_gain=0.05) for stage in TRACK_STAGES[2:])
"""For a pose that is nearly right: coarse stages could lead it away, to an edge beside the outline. The second round is
for poses that have not settled after the first, see `SETTLED_PX`."""


def _color_led(gain: float) -> tuple[Stage, ...]:
    """Coarse stages in which colours outweigh edges."""
    return (
        Stage(region_scale=6, edge_reach=12, edge_step_px=2.0, edge_spread_px=8.0, region_gain=gain, stride=2),
        Stage(region_scale=4, edge_reach=12, edge_step_px=1.0, edge_spread_px=5.0, region_gain=gain, stride=2),
        Stage(region_scale=2, edge_reach=8, edge_step_px=1.0, edge_spread_px=3.0, region_gain=gain, stride=2),
    )


FAR_STAGES = (
    _color_led(5.0) + TRACK_STAGES,
    (
        Stage(region_scale=6, edge_reach=12, edge_step_px=2.0, edge_spread_px=10.0, stride=2),
        Stage(region_scale=4, edge_reach=12, edge_step_px=2.0, edge_spread_px=7.0, stride=2),
        Stage(region_scale=4, edge_reach=12, edge_step_px=1.5, edge_spread_px=5.0, stride=2),
        Stage(region_scale=3, edge_reach=10, edge_step_px=1.0, edge_spread_px=3.5, stride=2),
        *TRACK_STAGES,
    ),
    _color_led(20.0) + NEAR_STAGES,
)
"""For a part that moved far. The usual stages lock on to the next of many parallel edges; the outline as the colours
show it leads past these edges."""
