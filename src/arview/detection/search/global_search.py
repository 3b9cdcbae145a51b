"""The first search of the detector: where in the picture might which view of the part be, over the whole range?

Templates (`templates`) give thousands of rough matches. In clutter the right one is seldom among the first hundred of
them, but often among the first five thousand; and once each is improved as an outline in the picture
(`search_outlines`, some 30 µs), on maps of a finer and finer scale, it comes to the front: the larger the part in the
picture, the fewer wrong poses fit by chance. This is what makes clutter tractable on a CPU; own here, measured on
semi-synthetic sequences. What their responses leave open, the `judge` decides.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.cad.view_range import ViewRange
from arview.camera import Camera
from arview.core.parallel import pool
from arview.detection.features.image_pyramid import (
    STEPS_PER_OCTAVE,
    ImagePyramid,
    step_for,
)
from arview.detection.scoring.profile_ranker import ProfileRanker
from arview.detection.search.pattern_search import search_outlines
from arview.detection.search.template_bank import (
    GROUPS,
    decimate,
    make_bank,
    make_outlines,
    match_templates,
    outlines_around,
    select_distinct,
)
from arview.geometry import Array, rigid, turns_to_rays
from arview.guideviews import GuideViewSet
from arview.refinement.view_model import PartView

POINTS = 64
"""Points of an outline, a multiple of `FIRST_POINTS`, see `sector_order`."""
GRID_PX = 4
"""Places that templates are matched at are so far apart."""
LARGEST_SCALE = 1.5
"""The picture is not enlarged more than this."""
LOWEST_SCORE = 0.3
"""Template matches below this are noise."""
RESPONSE_WORTH = 20.0
"""A mean response of 1 more is worth as much of what the judge says: it knows gradients only. In 96 pictures of random
solids a right start is first in 55 with it, in 47 without."""
NEARER, FARTHER = 0.85, 1.18
"""Poses are looked for so far beyond the declared distances, as shares of them."""
CELL_PX, CELL_ROLL = 4.0, 0.33
"""Of matches whose place and roll (rad) fall in one cell, of one scale and group of views, the best is enough."""
DOMAIN_DIRECTION = np.array([0.36, 0.48, 0.8])
"""On no axis or plane that a part's symmetries are likely to have."""
WANTED_MARGIN_DEG = 14.0
"""Near the border the templates on both sides matter: 192 of 200 frames of the recorded cube, 189 with 9 (193 with all
directions)."""
ALIKE = 5
"""So many matches are there for one that is left then."""


@dataclass(frozen=True)
class RefinementStep:
    """A round in which matches are improved as outlines on larger maps.

    Attributes:
        steps_up: maps so many scale steps larger than those before.
        roll_step_rad, stretch_step: first steps of the roll and, as a share, of the size.
        is_fine: with the nearest other directions, not those further away.
    """

    steps_up: int
    roll_step_rad: float
    stretch_step: float
    is_fine: bool


REFINEMENT_STEPS = (
    RefinementStep(2, 0.16, 0.07, False),
    RefinementStep(2, 0.16, 0.07, False),
    RefinementStep(2, 0.08, 0.04, True),
)
"""From half diameters of 20 px by 28 and 40 to 57."""
GROWTH_ROUNDS, SHIFT_PX = 2, 2
"""Over all steps; places are tried so far away."""


@dataclass(frozen=True)
class SearchBudget:
    """How far a search goes.

    Attributes:
        matches: of templates that are improved as outlines.
        improved: of these, how many are improved in the last round too.
        looked_at: of these, how many are judged.
        starts: of these, how many poses are searched around.
        kept: hypotheses left after each level of that search.
        scale_step: templates are matched at one of so many scales.
        is_trimmed: a quarter of the outline does not count, that of which the least is seen.
        use_edge_net: what the line network sees counts until poses are judged, as much as gradients do.
    """

    matches: int
    improved: int
    looked_at: int
    starts: int
    kept: tuple[int, ...]
    scale_step: int
    is_trimmed: bool
    use_edge_net: bool = True


QUICK = SearchBudget(400, 200, 100, 16, (6, 4), 2, False)
WIDE = SearchBudget(2500, 1400, 700, 160, (60, 20), 1, True)
"""For clutter, in which thousands of wrong matches come before the right one, and for what is partly hidden: of three
parts behind things, 75 frames, a right pose is among the likely ones in 64 if a quarter is spared, in 55 if not."""
GRADIENTS_ONLY = replace(WIDE, is_trimmed=False, use_edge_net=False)
UNTRIMMED = replace(WIDE, is_trimmed=False)
"""For what these miss: what is in plain sight but of little contrast, and what the line network does not know. Of the
52 of 600 semi-synthetic frames in which the two before find nothing, the part is found in 10 with these, and in none at
a wrong pose; of 1,001 pictures without the part 3 instead of 4 are taken for it, for a wrong pose has more rivals."""


@dataclass(frozen=True)
class PoseCandidate:
    """A hypothesis: score for comparing, and the pose it stands for, about the model's centre."""

    score: float
    cam_from_body: Array


@dataclass(frozen=True)
class TemplateMatches:
    """TemplateMatches of outlines in the picture.

    Attributes:
        keys: (M,) by which they compare.
        steps: (M,) scales, in steps.
        views: (M,) of the outlines; rolls: (M,) rad.
        radii_px: (M,) half diameters; places: (M,2) px of the part's centre, both at that scale.
    """

    keys: Array
    steps: NDArray[np.int64]
    views: NDArray[np.int32]
    rolls: Array
    radii_px: Array
    places: Array

    def best(self, most: int) -> TemplateMatches:
        """The best, best first."""
        return self.of(np.argsort(-self.keys, kind="stable")[:most])

    def of(self, index: NDArray[np.intp]) -> TemplateMatches:
        """Some of them."""
        return TemplateMatches(*(getattr(self, field.name)[index] for field in fields(self)))


class CandidatePoses(NamedTuple):
    """Poses (N,4,4) about the model's centre, best first by ``responses`` (N,) 0–1 and the ``lines`` (N,) they show."""

    poses: Array
    lines: Array
    responses: Array


NO_CANDIDATES = CandidatePoses(np.empty((0, 4, 4)), np.empty(0), np.empty(0))


def _joined(parts: list[TemplateMatches]) -> TemplateMatches:
    return TemplateMatches(
        *(np.concatenate([getattr(p, field.name) for p in parts]) for field in fields(TemplateMatches))
    )


def in_fundamental_domain(directions: Array, turns: Array, view_range: ViewRange) -> NDArray[np.bool_]:
    """Which of the directions (V,3) to the camera to look for: of those that turns make the same, one and a margin.

    The part of the sphere nearer to one fixed direction than to its images under the turns; images outside the
    declared range do not count, nor does any symmetry where not all rolls are declared.
    """
    wanted = np.ones(len(directions), dtype=np.bool_)
    low, high = view_range.roll_deg
    if high - low < 360.0:
        return wanted
    for turn in turns:
        across = turn @ DOMAIN_DIRECTION - DOMAIN_DIRECTION
        is_farther = directions @ across > np.sin(np.deg2rad(WANTED_MARGIN_DEG)) * np.linalg.norm(across)
        wanted &= ~(is_farther & view_range.contains_direction(directions @ turn))
    return wanted


def reach_mm(view_range: ViewRange) -> tuple[float, float]:
    """The distances in which poses are looked for: those declared and a little more."""
    low, high = view_range.distance_mm
    return NEARER * low, FARTHER * high


def weighed(scores: Array, lines: Array) -> Array:
    """Scores by which poses of different views compare: one that shows few distinct lines often fits by chance."""
    return np.asarray(scores * lines**0.25)


class GlobalSearch:
    """The first search for one part with one camera.

    Args:
        views: of the part, for the declared range.
        part: the same for the kernels.
        camera: of the pictures.
        radius_px: half the part's diameter in the templates.
        roll_step_deg: spacing of the templates.
        subdivisions: icosahedron level of the template directions (2: 162, about 17° apart).
        turns: (N,3,3) of the part onto itself: of views that these make the same one is looked for.

    Raises:
        InputError: no view shows an outline.
    """

    def __init__(
        self,
        views: GuideViewSet,
        part: PartView,
        camera: Camera,
        radius_px: float,
        roll_step_deg: float,
        subdivisions: int,
        turns: Array,
    ) -> None:
        self.camera = camera
        self._radius_px = radius_px
        self._diameter_mm = views.diameter_mm
        self._focal_px = 0.5 * (camera.fx + camera.fy)
        self._part = part
        self._ranker = ProfileRanker(part)
        self.outlines = make_outlines(views, part.model_from_body, POINTS)
        # Scale steps of the templates, large distances (large pictures) first.
        low, high = views.view_range.distance_mm
        self._reach_mm = reach_mm(views.view_range)
        near, far = self.step_at(low), self.step_at(high)
        top = int(np.floor(STEPS_PER_OCTAVE * np.log2(LARGEST_SCALE)))
        self._steps = [s for s in range(int(np.floor(far + 0.4)), int(np.ceil(near - 0.4)) - 1, -1) if s <= top]
        chosen = outlines_around(views, self.outlines, subdivisions)
        chosen = chosen[in_fundamental_domain(-self.outlines.rotations[chosen, 2], turns, views.view_range)]
        self._groups = len(np.unique(self.outlines.groups[chosen]))
        rolls = np.deg2rad(views.view_range.rolls_deg(roll_step_deg))
        focals_px = {step: self._focal_px * 2.0 ** (step / STEPS_PER_OCTAVE) for step in self._steps}
        self.banks = {
            step: make_bank(self.outlines, chosen, rolls, radius_px, radius_px / focal_px)
            for step, focal_px in focals_px.items()
        }

    def step_at(self, distance_mm: float) -> float:
        """Scale step at which the part at a distance has the size of the templates."""
        return step_for(self._focal_px * 0.5 * self._diameter_mm / distance_mm, self._radius_px)

    def starts(self, picture: ImagePyramid, effort: SearchBudget = QUICK) -> list[PoseCandidate]:
        """Poses for the best matches over the whole range, apart from each other, best first."""
        return self.rank(picture, self.candidates(picture, effort), effort)

    def _are_in_reach(self, distances_mm: Array) -> NDArray[np.bool_]:
        low, high = self._reach_mm
        return np.asarray((low <= distances_mm) & (distances_mm <= high))

    def rank(self, picture: ImagePyramid, likely: CandidatePoses, effort: SearchBudget = QUICK) -> list[PoseCandidate]:
        """The starts among likely poses, best first."""
        scores = self._ranker.scores(picture, likely.poses, likely.lines) + RESPONSE_WORTH * likely.responses
        best = np.argsort(-scores, kind="stable")[: effort.starts]
        return [PoseCandidate(float(scores[k]), likely.poses[k]) for k in best]

    def candidates(self, picture: ImagePyramid, effort: SearchBudget = QUICK) -> CandidatePoses:
        """Poses for the best matches by their responses."""
        scales = self._steps[:: effort.scale_step]
        if not effort.use_edge_net:
            picture = picture.without_edge_net
        picture.make_maps(scales)
        phases = list(pool().map(lambda step: decimate(picture.maps(step)[0], GRID_PX), scales))
        count = len(next(iter(self.banks.values())).bins)
        halves = [0, count // 2, count]
        votes = {step: np.zeros((GROUPS, 1024), dtype=np.int64) for step in scales}
        # Of each group of views at each scale as many; most that are found are alike.
        kept = ALIKE * -(-effort.matches // (self._groups * len(scales)))
        levels = list(zip(scales, phases, strict=True))
        jobs = [(*level, first, last) for level in levels for first, last in pairwise(halves)]
        found = pool().map(lambda job: self._match(votes[job[0]], kept, effort.is_trimmed, picture, *job), jobs)
        raw = [m for m in found if m is not None]
        if not raw:
            return NO_CANDIDATES
        matches = self._distinct(_joined(raw), effort.matches)
        if not len(matches.keys):
            return NO_CANDIDATES
        for growth in REFINEMENT_STEPS[:-1]:
            matches = self._improved(picture, matches, growth, effort.is_trimmed)
        matches = self._improved(picture, matches.best(effort.improved), REFINEMENT_STEPS[-1], effort.is_trimmed)
        if not len(matches.keys):
            return NO_CANDIDATES
        matches = self._best_apart(matches, 6.0, 0.15, 1.06, effort.looked_at)
        poses = np.stack([rigid(r, p) for r, p in zip(*self._posed(matches), strict=True)])
        lines = self.outlines.lines[matches.views]
        return CandidatePoses(poses, lines, matches.keys / weighed(np.ones(len(lines)), lines))

    def _match(
        self,
        votes: NDArray[np.int64],
        kept: int,
        is_trimmed: bool,
        picture: ImagePyramid,
        step: int,
        phases: NDArray[np.uint8],
        first: int,
        last: int,
    ) -> TemplateMatches | None:
        """The matches of some templates at one scale."""
        bank = self.banks[step]
        maps, _ = picture.maps(step)
        if min(maps.shape[1:]) < 24 + 2 * picture.pad_px:
            return None
        keys, templates, places = match_templates(
            phases, bank.offsets, bank.bins, bank.gains, bank.groups, first, last, kept, LOWEST_SCORE, votes, is_trimmed
        )
        return TemplateMatches(
            keys, np.full(len(keys), step), bank.views[templates], bank.rolls[templates],
            np.full(len(keys), self._radius_px), places + bank.origins[templates] - picture.pad_px,
        )  # fmt: skip

    def _posed(self, matches: TemplateMatches) -> tuple[Array, Array]:
        """Rotations (M,3,3) and positions (M,3) mm of the part's centre."""
        scales = 2.0 ** (matches.steps / STEPS_PER_OCTAVE)
        rays = self.camera.unproject((matches.places + 0.5) / scales[:, None] - 0.5)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        distances_mm = self._distances_mm(matches)
        c, s, zero = np.cos(matches.rolls), np.sin(matches.rolls), np.zeros(len(matches.rolls))
        turns = np.stack([c, -s, zero, s, c, zero, zero, zero, zero + 1.0], axis=1).reshape(-1, 3, 3)
        rotations = turns @ self.outlines.rotations[matches.views]
        return turns_to_rays(rays) @ rotations, rays * distances_mm[:, None]

    def _distances_mm(self, matches: TemplateMatches) -> Array:
        """(M,) of the part's centre."""
        scales = 2.0 ** (matches.steps / STEPS_PER_OCTAVE)
        return np.asarray(self._focal_px * 0.5 * self._diameter_mm * scales / matches.radii_px)

    def _best_apart(
        self, matches: TemplateMatches, reach_px: float, angle_rad: float, ratio: float, most: int
    ) -> TemplateMatches:
        """The best, none near a better one."""
        matches = matches.of(np.argsort(-matches.keys, kind="stable"))
        rotations, positions = self._posed(matches)
        # Pixels of the templates' scale: as many times further off as the part is larger than there.
        reach = np.full(len(positions), reach_px / self._radius_px) * 0.5 * self._diameter_mm
        return matches.of(
            select_distinct(rotations, positions, reach / positions[:, 2], np.cos(angle_rad), ratio, most)
        )

    def _distinct(self, matches: TemplateMatches, most: int) -> TemplateMatches:
        """The best, one for each cell of places, scales and rotations.

        The best of each group of views at each scale come first, then all second best, and so on.
        """
        matches = matches.best(len(matches.keys))
        cells = np.floor(matches.places / CELL_PX).astype(np.int64) + 4096
        rolls = np.floor(matches.rolls / CELL_ROLL).astype(np.int64) + 64
        groups = self.outlines.groups[matches.views].astype(np.int64) * 128 + matches.steps + 64
        _, first = np.unique(((groups * 8192 + cells[:, 0]) * 8192 + cells[:, 1]) * 128 + rolls, return_index=True)
        first.sort()
        by_group = np.argsort(groups[first], kind="stable")
        _, starts, counts = np.unique(groups[first][by_group], return_index=True, return_counts=True)
        rank = np.empty(len(first), dtype=np.int64)
        rank[by_group] = np.arange(len(first)) - np.repeat(starts, counts)
        return matches.of(first[np.argsort(rank, kind="stable")[:most]])

    def _improved(
        self, picture: ImagePyramid, matches: TemplateMatches, growth: RefinementStep, is_trimmed: bool
    ) -> TemplateMatches:
        """The matches improved each by itself, on larger maps; those that leave the declared distances are dropped."""
        if not len(matches.keys):
            return matches
        shapes = self.outlines
        around = shapes.near if growth.is_fine else shapes.far
        jobs = []
        for step in np.unique(matches.steps):
            group = np.flatnonzero(matches.steps == step)
            jobs += [(min(0, step + growth.steps_up), part) for part in np.array_split(group, 2)]
        picture.make_maps([step for step, _ in jobs])

        def improve(job: tuple[int, NDArray[np.intp]]) -> TemplateMatches:
            step, index = job
            some = matches.of(index)
            focal_px = self._focal_px * 2.0 ** (step / STEPS_PER_OCTAVE)
            scale = 2.0 ** ((step - some.steps) / STEPS_PER_OCTAVE)
            maps, _ = picture.maps(step)
            places = (some.places + 0.5) * scale[:, None] - 0.5 + picture.pad_px
            scores, views, rolls, radii, places = search_outlines(
                maps, shapes.points, shapes.angles, around.views, around.turns, some.views, some.rolls,
                some.radii_px * scale, places, focal_px, growth.roll_step_rad, growth.stretch_step, GROWTH_ROUNDS,
                SHIFT_PX, SHIFT_PX, is_trimmed,
            )  # fmt: skip
            keys = weighed(scores, shapes.lines[views])
            improved = TemplateMatches(keys, np.full(len(keys), step), views, rolls, radii, places - picture.pad_px)
            return improved.of(np.flatnonzero(self._are_in_reach(self._distances_mm(improved))))

        return _joined(list(pool().map(improve, jobs)))
