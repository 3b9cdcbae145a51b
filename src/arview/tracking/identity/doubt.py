"""DoubtExamination: whether a specimen found elsewhere is the followed one that was moved, or another one.

The last picture before the gap tells whether a part was already seen at that place, this picture whether two are in
view, and the next frames whether the old place still shows one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.core.messages import sentence
from arview.geometry import Array
from arview.tracking.identity.followed_place import FollowedPlace, KeptView, Placement
from arview.tracking.identity.part_outline import PartOutline
from arview.tracking.identity.specimen_search import SpecimenSearch

WATCH_S = 0.75
"""Time for which the old place is watched before a part that was found elsewhere has its labels back."""
WATCH_EVERY_S = 0.25
"""Time between two checks of the old place."""
MIN_ROOM = 0.7
"""Share of the part's box that must lie in the picture for its place to count as seen."""
RETURN_EVERY_S = 0.35
"""Time between two checks whether the followed part is seen at its old place again."""

ANOTHER_IN_VIEW = sentence("identity.another")
MOVED = sentence("identity.moved")


@dataclass
class Doubt:
    """An open question whether the tracked specimen is the followed one.

    Attributes:
        since_s: time stamp of the frame in which it arose.
        next_check_s: time stamp from which the old place is checked again.
        stage: checks done: 0 none, 1 the picture before, 2 this picture.
        reason: what is known against it; empty while it is checked.
        has_seen_place: whether the place of the tracked specimen was in the picture before and showed none.
        is_placed: whether the background said where the followed specimen should be.
        is_settled: whether the tracked specimen is the followed one.
    """

    since_s: float
    next_check_s: float
    stage: int = 0
    reason: str = ""
    has_seen_place: bool = False
    is_placed: bool = False
    is_settled: bool = False


class DoubtExamination:
    """Settles doubts by looking for other specimens of the part.

    Args:
        outline: of the part.
        place: of the followed specimen.
        search: for other specimens.
    """

    def __init__(self, outline: PartOutline, place: FollowedPlace, search: SpecimenSearch) -> None:
        self._outline, self._place, self._search = outline, place, search
        self._others_before: tuple[KeptView, list[Array]] | None = None

    def examine(
        self,
        image: NDArray[np.uint8],
        pose: Array,
        is_sure: bool,
        doubt: Doubt,
        time_s: float,
        others: tuple[Array, ...],
    ) -> Array | None:
        """One step to settle a doubt; a pose (4,4) where the followed specimen is seen instead, or None.

        Args:
            image: (H,W,3) uint8 RGB.
            pose: (4,4) of the tracked specimen.
            is_sure: whether the picture supports it clearly.
            doubt: in which the result is noted.
            time_s: time stamp of the frame.
            others: poses (4,4) of specimens that are tracked beside it.
        """
        place = self._place
        is_on_way = not doubt.reason and place.is_on_way(pose)
        if is_sure and (place.compared(pose) is Placement.SAME or is_on_way):
            doubt.is_settled = True
        kept = place.kept
        if doubt.is_settled or not is_sure or kept is None:
            return None
        if not doubt.reason and doubt.stage < 2:
            self._search_once(image, pose, kept, doubt, others)
            if doubt.stage < 2 and not doubt.is_placed and not doubt.reason:
                # Without the background the two pictures say all that can be known: both are looked at now.
                self._search_once(image, pose, kept, doubt, others)
            if doubt.is_placed or doubt.reason:
                return None
        if place.background.homography is not None and time_s >= doubt.next_check_s:
            doubt.next_check_s = time_s + (RETURN_EVERY_S if doubt.reason else WATCH_EVERY_S)
            seen = self._seen_at_old_place(image, pose, kept, place.background.homography)
            if seen is not None:
                doubt.reason = ANOTHER_IN_VIEW
                return seen if place.compared(seen) is Placement.SAME else None
        if not doubt.reason:
            _conclude(doubt, time_s)
        return None

    def _search_once(
        self, image: NDArray[np.uint8], pose: Array, kept: KeptView, doubt: Doubt, others: tuple[Array, ...]
    ) -> None:
        """Look for another specimen in the picture before the gap, and the next time in the present one."""
        background = self._place.background
        if doubt.stage == 0:
            doubt.is_placed = background.homography is not None and background.is_chained
            is_other = self._is_other_before(pose, kept, doubt, others)
        else:
            is_other = self._is_any_new(self._search.others(image, pose), others)
        doubt.stage += 1
        if is_other:
            doubt.reason = ANOTHER_IN_VIEW

    def _is_other_before(self, pose: Array, kept: KeptView, doubt: Doubt, others: tuple[Array, ...]) -> bool:
        """Whether the last picture of the followed specimen shows another one too."""
        homography = self._place.background.homography
        back = np.linalg.inv(np.eye(3) if homography is None else homography)
        there = self._outline.moved(pose, np.asarray(back, dtype=np.float64))
        if self._outline.is_in_picture(self._outline.place(there), MIN_ROOM):
            seen = self._search.at_place(kept.image, there, is_turned=True)
            if seen is not None and self._is_apart(seen, kept.cam_from_model):
                return self._is_kept_right(kept)
            doubt.has_seen_place = True
        if doubt.is_placed:
            return False
        if self._others_before is None or self._others_before[0] is not kept:
            self._others_before = kept, self._search.others(kept.image, kept.cam_from_model)
        # A specimen that was tracked beside it and still is, is not this one.
        tracked = kept.others if len(others) >= len(kept.others) else ()
        return self._is_any_new(self._others_before[1], tracked) and self._is_kept_right(kept)

    def _is_any_new(self, found: list[Array], tracked: tuple[Array, ...]) -> bool:
        """Whether any pose (4,4) found is none of those of specimens that are tracked."""
        return any(all(self._is_apart(pose, other) for other in tracked) for pose in found)

    def _is_kept_right(self, kept: KeptView) -> bool:
        """Whether the followed specimen is really there in its last picture; a wrong pose is no specimen."""
        return self._place.is_certain or self._search.at_place(kept.image, kept.cam_from_model) is not None

    def _seen_at_old_place(
        self, image: NDArray[np.uint8], pose: Array, kept: KeptView, homography: Array
    ) -> Array | None:
        """The pose (4,4) of a specimen where the background says that the followed one was; None without one."""
        guess = self._outline.moved(kept.cam_from_model, homography)
        if not self._outline.is_in_picture(self._outline.place(guess), MIN_ROOM):
            return None
        seen = self._search.at_place(image, guess)
        return seen if seen is not None and self._is_apart(seen, pose) else None

    def _is_apart(self, a: Array, b: Array) -> bool:
        """Whether two poses (4,4) of one picture are those of different specimens."""
        return self._search.is_apart(self._outline.place(a), self._outline.place(b))


def _conclude(doubt: Doubt, time_s: float) -> None:
    """Settle a doubt when all checks are done: no other specimen was seen, before or now."""
    if not doubt.is_placed:
        # Nothing is known of the scene, and only one part was in view before and is in view now.
        doubt.is_settled = True
    elif not doubt.has_seen_place:
        doubt.reason = MOVED
    elif time_s - doubt.since_s >= WATCH_S:
        doubt.is_settled = True
