"""Is the part turned? Poses in which its base looks the same, so that the components would be elsewhere.

Where many components are absent, a pose that is turned by a symmetry of the base is found as well as the right one, and
all components then look absent. Which of them it is, is said by components that are seen in one of the poses where no
component of their shape belongs in the other, and by what breaks the symmetry of the base. Absent components say
nothing: any number may be absent. Two that change places say nothing either: each pose explains what is seen.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from arview.cad import Component, sample_surface
from arview.geometry import Array, apply, exp_so3, rigid

MAX_SAMPLES = 3000
"""Samples of the surface of the base."""
SAME_SHARE = 0.015
"""Distance in diameters of the base up to which a turned sample lies on its surface."""
MIN_SAME = 0.9
"""Share of the samples of the base that must lie on its surface when it is turned."""
ROUGH_STEP = 12
ROUGH_MARGIN = 0.15
"""Every ``ROUGH_STEP``-th sample is tried first; this smaller a share of these may lie on the surface."""
EXACT_SHARE = 0.003
"""Distance in diameters of the base up to which all its corners, turned, lie on corners if the symmetry is exact."""
BASE_WEIGHT = 30.0
"""Log odds per share of the base's edge points that are found."""
MAX_ADDED = 4.0
"""Bound on what one observation adds."""
AS_BEFORE = 6.0
"""Log odds for the pose in which the part lies as it did before it was lost for a moment."""
BETTER = 5.5
"""Summed log odds from which on a turned pose is better."""
WORSE = -3.5
"""Summed log odds below which a turned pose is ruled out."""


class TurnEvidence(NamedTuple):
    """What a picture shows at a pose.

    Attributes:
        seen: (C,) log odds for each component by its edges, at least 0; 0 for the base.
        base: share of the base's edge points that are found.
    """

    seen: Array
    base: float


class Turn(NamedTuple):
    """A rotation after which the base looks the same.

    Attributes:
        model_from_model: (4,4) from the turned pose, on the model's side: ``cam_from_model @ model_from_model``.
        counterparts: (C,) the component at whose place each component is in the turned pose, and that has its shape;
            -1 where there is none.
        is_exact: nothing of the base breaks the symmetry, so that its edges cannot tell.
    """

    model_from_model: Array
    counterparts: NDArray[np.int64]
    is_exact: bool

    def unmatched(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """(C,) components whose sight says that the part is not turned, and whose sight in the turned pose says so.

        A component that is seen is, in the turned pose, seen at another place. If one of its shape belongs there, both
        poses explain the picture.
        """
        is_counterpart = np.zeros(len(self.counterparts), dtype=bool)
        is_counterpart[self.counterparts[self.counterparts >= 0]] = True
        return ~is_counterpart, self.counterparts < 0


class TurnedPoses:
    """Compares a tracked pose with those in which the base looks the same.

    Args:
        components: of the part.
        base: index of the one that carries the others.
        like: another of the same part, whose turns are shared.
    """

    def __init__(
        self,
        components: Sequence[Component],
        base: int,
        like: TurnedPoses | None = None,
    ) -> None:
        self._components, self._base = components, base
        self._like = like
        self._excluded: set[int] = set()
        self._sums: list[float] = []

    @cached_property
    def turns(self) -> list[Turn]:
        """All turns; few parts need them."""
        if self._like is not None:
            return self._like.turns
        return base_turns(self._components, self._base)

    @property
    def better(self) -> Turn | None:
        """The turn from the tracked pose to one that is clearly better; None: none is."""
        best = int(np.argmax(self._sums)) if self._sums else 0
        is_better = bool(self._sums) and self._sums[best] > BETTER
        return self.turns[best] if is_better else None

    def open_turns(self, is_present: NDArray[np.bool_]) -> list[Turn]:
        """The turns that nothing has excluded.

        Args:
            is_present: (C,) components seen at their nominal placements in the tracked pose; a turn in which one of
                them would be where no component of its shape belongs is excluded.
        """
        is_seen = is_present & (np.arange(len(is_present)) != self._base)
        return [
            turn
            for k, turn in enumerate(self.turns)
            if k not in self._excluded and not np.any(is_seen & turn.unmatched()[0])
        ]

    def index_of(self, turn: Turn) -> int:
        """Index of one of the turns; -1 for another."""
        return next((k for k, one in enumerate(self.turns) if one is turn), -1)

    def ruled_out(self, is_present: NDArray[np.bool_]) -> frozenset[int]:
        """Indices of the turns that are not open, see `open_turns`."""
        is_open = {self.index_of(turn) for turn in self.open_turns(is_present)}
        return frozenset(range(len(self.turns))) - is_open

    @property
    def excluded(self) -> frozenset[int]:
        """Indices of the turns that pictures have excluded."""
        return frozenset(self._excluded)

    def exclude(self, turns: frozenset[int]) -> None:
        """Exclude turns by their indices: it is known that the part is not turned so."""
        self._excluded |= turns

    def reset(self) -> None:
        """Forget all comparisons."""
        self._excluded, self._sums = set(), []

    def compare(self, cam_from_model: Array, evidence_at: Callable[[Array], TurnEvidence]) -> None:
        """Compare the poses in one picture, and exclude those that are clearly worse.

        Args:
            cam_from_model: (4,4) the tracked pose.
            evidence_at: the evidence for a pose in the picture.
        """
        self._sums = self._sums or [0.0] * len(self.turns)
        if len(self._excluded) == len(self.turns):
            return
        here = evidence_at(cam_from_model)
        for k, turn in enumerate(self.turns):
            if k in self._excluded:
                continue
            there = evidence_at(cam_from_model @ turn.model_from_model)
            self._sums[k] += float(np.clip(self._gain(turn, here, there), -MAX_ADDED, MAX_ADDED))
            if self._sums[k] <= WORSE:
                self._excluded.add(k)

    def best(
        self,
        cam_from_model: Array,
        evidence_at: Callable[[Array], TurnEvidence],
        is_as_before: Callable[[Array], bool] = lambda pose: False,
    ) -> Array:
        """The best (4,4) of a pose and those turned from it, by one picture.

        Args:
            cam_from_model: (4,4).
            evidence_at: see `compare`.
            is_as_before: whether the part lies as it did before it was lost for a moment.
        """
        if not self.turns:
            return cam_from_model
        here = evidence_at(cam_from_model)
        poses = [cam_from_model @ turn.model_from_model for turn in self.turns]
        gains = [self._gain(turn, here, evidence_at(pose)) for turn, pose in zip(self.turns, poses, strict=True)]
        known = AS_BEFORE * np.array([is_as_before(pose) for pose in (cam_from_model, *poses)])
        totals = np.array([0.0, *gains]) + known
        return (cam_from_model, *poses)[int(np.argmax(totals))]

    def _gain(self, turn: Turn, here: TurnEvidence, there: TurnEvidence) -> float:
        """Log odds of a turned pose to the tracked one by what is seen in both."""
        is_against, is_for = turn.unmatched()
        gain = float(there.seen[is_for].sum() - here.seen[is_against].sum())
        return gain if turn.is_exact else gain + BASE_WEIGHT * (there.base - here.base)


def base_turns(components: Sequence[Component], base: int) -> list[Turn]:
    """Rotations by 90° and 180° after which most of the base's surface lies on itself, and what else they move."""
    carrier = components[base]
    diameter_mm = float(np.linalg.norm(np.ptp(carrier.bounds_in_model, axis=0)))
    points = sample_surface(carrier, 0.01 * diameter_mm, MAX_SAMPLES).points
    center = carrier.bounds_in_model.mean(axis=0)
    tree, corners = cKDTree(points), cKDTree(carrier.vertices_in_model)
    near_mm = max(SAME_SHARE * diameter_mm, 2.0 * float(np.median(tree.query(points, k=2)[0][:, 1])))
    principal = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    surfaces = _Surfaces(components, 0.5 * near_mm, MAX_SAMPLES)
    found: list[Turn] = []
    for axis in (*np.eye(3), *principal):
        for quarter in (2, 1, 3):
            rotation = exp_so3(0.5 * np.pi * quarter * axis)
            if any(np.trace(rotation.T @ other.model_from_model[:3, :3]) > 2.9 for other in found):
                continue
            turned = rigid(rotation, center - rotation @ center)
            # Some of the samples show soon that most turns are none.
            if _same_share(tree, apply(turned, points[::ROUGH_STEP]), near_mm) < MIN_SAME - ROUGH_MARGIN:
                continue
            if _same_share(tree, apply(turned, points), near_mm) < MIN_SAME:
                continue
            off_mm = float(corners.query(apply(turned, carrier.vertices_in_model))[0].max())
            counterparts = surfaces.counterparts(turned, near_mm, MIN_SAME)
            found.append(Turn(turned, counterparts, off_mm < EXACT_SHARE * diameter_mm))
    return found


def _same_share(tree: cKDTree, points: Array, near_mm: float) -> float:
    """Share of points (N,3) that are near those of a tree."""
    return float(np.mean(tree.query(points)[0] < near_mm))


class _Surfaces:
    """Samples of the surfaces of components, taken when first needed, at most ``max_samples`` of each."""

    def __init__(self, components: Sequence[Component], spacing_mm: float, max_samples: int) -> None:
        self._components, self._spacing_mm, self._max_samples = components, spacing_mm, max_samples
        self._known: dict[int, tuple[Array, cKDTree]] = {}

    def counterparts(self, turned: Array, near_mm: float, min_same: float) -> NDArray[np.int64]:
        """(C,) index of the component on whose surface each one lies after a turn (4,4), or -1."""
        found = np.full(len(self._components), -1)
        boxes = np.array([one.bounds_in_model for one in self._components])
        for c, one in enumerate(self._components):
            moved = apply(turned, one.vertices_in_model)
            box = np.stack([moved.min(axis=0), moved.max(axis=0)])
            for d in np.flatnonzero(np.abs(boxes - box).max(axis=(1, 2)) < near_mm):
                if _same_share(self._of(int(d))[1], apply(turned, self._of(c)[0]), near_mm) >= min_same:
                    found[c] = d
        return found

    def _of(self, index: int) -> tuple[Array, cKDTree]:
        if index not in self._known:
            points = sample_surface(self._components[index], self._spacing_mm, self._max_samples).points
            self._known[index] = points, cKDTree(points)
        return self._known[index]
