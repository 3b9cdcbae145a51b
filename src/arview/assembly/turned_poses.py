"""Is the part turned? Poses in which its base looks the same, so that the components would be elsewhere.

Where many components are absent, a pose that is turned by a symmetry of the base is found as well as the right one, and
all components then look absent. Which of them it is, is said by components that are seen in one of the poses, and by
what breaks the symmetry of the base. Absent components say nothing: any number may be absent.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from arview.cad.model import Component
from arview.cad.samples import sample_surface
from arview.geometry import Array, exp_so3, rigid


@dataclass(frozen=True)
class TurnedPoseOptions:
    """Which poses are alternatives, and when one is better.

    Attributes:
        max_samples: samples of the surface of the base.
        same_share: distance in diameters of the base up to which a turned sample lies on its surface.
        min_same: share of the samples that must.
        base_weight: log odds per share of the base's edge points that are found.
        max_added: bound on what one observation adds.
        better: summed log odds from which on a turned pose is better.
        worse: summed log odds below which it is none.
    """

    max_samples: int = 3000
    same_share: float = 0.015
    min_same: float = 0.9
    base_weight: float = 30.0
    max_added: float = 4.0
    better: float = 6.0
    worse: float = -3.5


class TurnEvidence(NamedTuple):
    """Log odds by the components that are seen at a pose, and the share of the base's edge points that are found."""

    components: float
    base: float


class TurnedPoses:
    """Compares a tracked pose with those in which the base looks the same.

    Args:
        base: the component that carries the others.
        options: see `TurnedPoseOptions`.
    """

    def __init__(self, base: Component, options: TurnedPoseOptions | None = None) -> None:
        self._options, self._base = options or TurnedPoseOptions(), base
        self.reset()

    @cached_property
    def _all(self) -> list[Array]:
        """All turns; few parts need them."""
        return base_symmetries(self._base, self._options)

    @property
    def is_open(self) -> bool:
        """Whether a turned pose may be the right one."""
        return bool(self._turns)

    @property
    def better(self) -> Array | None:
        """(4,4) from the tracked pose, on the model's side, to a turned one that is clearly better; None: none is."""
        best = int(np.argmax(self._sums)) if self._sums else 0
        return self._turns[best] if self._sums and self._sums[best] > self._options.better else None

    def poses(self, cam_from_model: Array) -> tuple[Array, ...]:
        """The poses (4,4) that fit as well as the tracked one, as far as was seen."""
        return tuple(cam_from_model @ turn for turn in self._turns)

    def reset(self) -> None:
        """Forget all comparisons."""
        self._turns: list[Array] = []
        self._sums: list[float] = []
        self._is_compared = False

    def compare(self, cam_from_model: Array, evidence_at: Callable[[Array], TurnEvidence]) -> None:
        """Compare the poses in one picture, and drop those that are clearly worse.

        Args:
            cam_from_model: (4,4) the tracked pose.
            evidence_at: the evidence for a pose in the picture.
        """
        if not self._is_compared:
            self._turns, self._sums, self._is_compared = list(self._all), [0.0] * len(self._all), True
        if not self._turns:
            return
        o = self._options
        here = evidence_at(cam_from_model)
        kept = []
        for turn, total in zip(self._turns, self._sums, strict=True):
            there = evidence_at(cam_from_model @ turn)
            added = there.components - here.components + o.base_weight * (there.base - here.base)
            total += float(np.clip(added, -o.max_added, o.max_added))
            if total > o.worse:
                kept.append((turn, total))
        self._turns, self._sums = [turn for turn, _ in kept], [total for _, total in kept]


def base_symmetries(base: Component, options: TurnedPoseOptions | None = None) -> list[Array]:
    """Rotations (4,4) in the model frame, by 90° and 180°, after which most of a component's surface lies on itself."""
    o = options or TurnedPoseOptions()
    diameter_mm = float(np.linalg.norm(np.ptp(base.bounds_in_model, axis=0)))
    points = sample_surface(base, 0.01 * diameter_mm, o.max_samples).points
    center = 0.5 * (points.min(axis=0) + points.max(axis=0))
    tree = cKDTree(points - center)
    spacing_mm = 2.0 * float(np.median(tree.query(points - center, k=2)[0][:, 1]))
    principal = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    found: list[Array] = []
    for axes in (np.eye(3), principal):
        for axis in axes:
            for quarter in (2, 1, 3):
                rotation = exp_so3(0.5 * np.pi * quarter * axis)
                if any(np.trace(rotation.T @ other[:3, :3]) > 2.9 for other in found):
                    continue
                distance = tree.query((points - center) @ rotation.T)[0]
                if np.mean(distance < max(o.same_share * diameter_mm, spacing_mm)) >= o.min_same:
                    found.append(rigid(rotation, center - rotation @ center))
    return found
