"""Disambiguation: which of several near-symmetric poses at one place is right, and which remain as alternatives.

Their outlines are nearly the same, so that the ranking of the search says little. They are compared in pairs by the
pair comparator, by the edges that only one of both poses has, and by their log odds.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import combinations

import numpy as np

from arview.core.parallel import pool
from arview.detection.features.image_pyramid import ImagePyramid
from arview.detection.scoring.pair_comparator import PairComparator
from arview.detection.search.hypothesis import Hypothesis
from arview.detection.search.local_search import DISTINCT_DEG, LocalSearch
from arview.detection.symmetry import RotationalSymmetries, edge_margin, rotations_about
from arview.geometry import Array, rigid

PLACE_SHARE = 0.25
"""Distance in diameters within which hypotheses are at the same place."""
SAME_DEG = 20.0
"""Rotation within which two hypotheses are one, badly refined."""
MAX_HYPOTHESES = 12
"""Best hypotheses that are compared."""
MIN_LEAD = 3.4
"""Lead in log odds above which the best hypothesis is right without a comparison."""
MIN_MARGIN = 2.0
"""Margin of evidence above which a hypothesis is right rather than another; below it, the other is an alternative."""
LOGIT_WEIGHT = 0.2
"""Weight of the difference in log odds beside the pair comparator and the edges."""
SWEEP_STEP_DEG = 5
"""Step of the rotation sweep about the axes of nearly round parts."""
MAX_SWEEP_STARTS = 6
"""Best angles of the sweep that are refined."""


def turned(b_from_a: Array, turns: Iterable[Array]) -> list[Array]:
    """A pose (4,4) after each of some turns (3,3) of ``a`` about its origin."""
    return [rigid(b_from_a[:3, :3] @ turn, b_from_a[:3, 3]) for turn in turns]


def is_rotated_by(a: Hypothesis, b: Hypothesis, rotations: Array, angle_deg: float) -> bool:
    """Whether one of some rotations (N,3,3) of the part maps hypothesis b to within an angle of a."""
    cosine = 0.5 * (np.einsum("ij,nij->n", a.cam_from_body[:3, :3], b.cam_from_body[:3, :3] @ rotations) - 1.0)
    return bool(np.any(cosine > np.cos(np.deg2rad(angle_deg))))


class Disambiguator:
    """Disambiguation of the poses of one part.

    Args:
        local: local search of the part.
        symmetries: of the part.
    """

    def __init__(self, local: LocalSearch, symmetries: RotationalSymmetries) -> None:
        self.symmetries = symmetries
        self.exact_rotations = np.concatenate([np.eye(3)[None], symmetries.exact])
        self.all_rotations = np.concatenate([self.exact_rotations, symmetries.near])
        self._local = local
        self._pair_comparator = PairComparator(local.refiner.part)

    def choose(
        self, pyramid: ImagePyramid, best: Hypothesis, others: list[Hypothesis]
    ) -> tuple[Hypothesis, list[Hypothesis]]:
        """The best-supported pose among the near-symmetric ones of a hypothesis, and the alternatives to it.

        A pose from which no margin of evidence separates the best one is an alternative, unless an exact symmetry makes
        both the same.

        Args:
            pyramid: of the image.
            best: verified hypothesis.
            others: verified hypotheses of the same image.
        """
        hypotheses = self._near_symmetric(pyramid, best, others)
        if len(hypotheses) == 1:
            return hypotheses[0], []
        margins = self.evidence_margins(pyramid, hypotheses)
        # The leader has the largest margin over its strongest competitor.
        leader = int(np.argmax((margins + np.diag(np.full(len(hypotheses), np.inf))).min(axis=1)))
        best = hypotheses[leader]
        close = [h for k, h in enumerate(hypotheses) if k != leader and margins[leader, k] < MIN_MARGIN]
        others = [h for h in close if not is_rotated_by(h, best, self.exact_rotations, SAME_DEG)]
        return best, [*others, *self._close_counterparts(pyramid, best, others)]

    def _close_counterparts(self, pyramid: ImagePyramid, best: Hypothesis, known: list[Hypothesis]) -> list[Hypothesis]:
        """Near-symmetric poses, as the symmetries give them, from which no margin separates a pose; without known ones.

        Refined by themselves, such poses may end a few degrees off, and then lose for that reason alone.
        """
        local = self._local
        evaluated = local.evaluate(pyramid, turned(best.cam_from_body, self.symmetries.near))
        counterparts = [
            other
            for other in local.verify(pyramid, evaluated)
            if not any(is_rotated_by(other, h, self.exact_rotations, SAME_DEG) for h in known)
        ]
        margins = self.evidence_margins(pyramid, [best, *counterparts])[0, 1:]
        return [other for other, margin in zip(counterparts, margins, strict=True) if margin < MIN_MARGIN]

    def counterparts(self, pyramid: ImagePyramid, hypothesis: Hypothesis) -> list[Hypothesis]:
        """The near-symmetric poses of a hypothesis, refined and verified."""
        starts = turned(hypothesis.cam_from_body, self.symmetries.near)
        return self._local.verify(pyramid, self._local.refine_fine(pyramid, starts))

    def _near_symmetric(self, pyramid: ImagePyramid, best: Hypothesis, others: list[Hypothesis]) -> list[Hypothesis]:
        """The best hypothesis at a place, and those near-symmetric to it that are not clearly worse."""
        local = self._local
        pose = best.cam_from_body
        starts = turned(pose, self.symmetries.near) + self.rotation_sweep(pyramid, pose)
        reach_mm = PLACE_SHARE * local.views.diameter_mm
        nearby = [h for h in others if np.linalg.norm(h.cam_from_body[:3, 3] - pose[:3, 3]) < reach_mm]
        distinct_deg = DISTINCT_DEG
        hypotheses = local.deduplicate(
            [best, *local.verify(pyramid, local.refine_fine(pyramid, starts)), *nearby], distinct_deg
        )
        first = hypotheses[0]
        likely = [h for h in hypotheses[1:] if h.logit_without_contour > first.logit_without_contour - MIN_LEAD]
        similar = [h for h in likely if self._is_near_symmetric(h, first) or self._shares_axis(h, first)]
        return [first, *similar][:MAX_HYPOTHESES]

    def rotation_sweep(self, pyramid: ImagePyramid, pose: Array) -> list[Array]:
        """A pose (4,4) rotated about each axis of a nearly round part to the angles at which its edges are supported.

        The outline of such a part fits at any angle; the few small edges that break the symmetry do not guide a search.
        """
        picture = self._local.work_picture(pyramid, pose)
        refiner = self._local.refiner.with_camera(picture.camera)

        def mean_support(swept: Array) -> float:
            support = refiner.edge_steps(picture.gray, swept).support
            return float(support.mean()) if len(support) else 0.0

        starts = []
        for axis in self.symmetries.axes:
            poses = turned(pose, rotations_about(axis, range(0, 360, SWEEP_STEP_DEG)))
            support = np.array(list(pool().map(mean_support, poses)))
            peaks = np.flatnonzero((support >= np.roll(support, 1)) & (support > np.roll(support, -1)))
            starts += [poses[k] for k in peaks[np.argsort(-support[peaks], kind="stable")][:MAX_SWEEP_STARTS]]
        return starts

    def evidence_margins(self, pyramid: ImagePyramid, hypotheses: list[Hypothesis]) -> Array:
        """Margins of evidence (N,N) for each of some hypotheses over each other one."""
        picture = self._local.work_picture(pyramid, hypotheses[0].cam_from_body)
        refiner = self._local.refiner.with_camera(picture.camera)
        logits = np.array([h.logit_without_contour for h in hypotheses])
        margins = self._pair_comparator.log_odds(pyramid, [h.cam_from_body for h in hypotheses])
        margins += LOGIT_WEIGHT * (logits[:, None] - logits)
        steps = list(pool().map(lambda h: refiner.edge_steps(picture.gray, h.cam_from_body), hypotheses))
        for a, b in combinations(range(len(hypotheses)), 2):
            by_edges = edge_margin(steps[a], steps[b])
            margins[a, b] += by_edges
            margins[b, a] -= by_edges
        return margins

    def _is_near_symmetric(self, a: Hypothesis, b: Hypothesis) -> bool:
        """Whether a near symmetry maps one pose to the other, and no exact one does."""
        same_deg = SAME_DEG
        is_same = is_rotated_by(a, b, self.exact_rotations, same_deg)
        return not is_same and is_rotated_by(a, b, self.all_rotations, same_deg)

    def _shares_axis(self, a: Hypothesis, b: Hypothesis) -> bool:
        """Whether two poses differ by a rotation about an axis about which the part is nearly round."""
        axes = self.symmetries.axes
        cosines = np.sum((axes @ a.cam_from_body[:3, :3].T) * (axes @ b.cam_from_body[:3, :3].T), axis=1)
        return bool(np.any(cosines > np.cos(np.deg2rad(SAME_DEG))))
