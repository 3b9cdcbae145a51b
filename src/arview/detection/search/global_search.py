"""Global search: rough poses of the part anywhere in an image, over the whole declared range.

Template matching gives thousands of rough matches. In clutter the right one is seldom among the first hundred of them,
but often among the first five thousand. Each match is therefore improved as an outline in the image, on maps of growing
resolution; there it rises to the front, because the larger the part in the image, the fewer wrong poses fit by chance.
This keeps search in clutter affordable on a CPU. A profile ranker orders what remains.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.core.parallel import pool
from arview.detection.features.image_pyramid import (
    STEPS_PER_OCTAVE,
    ImagePyramid,
    step_for,
)
from arview.detection.scoring.profile_ranker import ProfileRanker
from arview.detection.search.nms import select_distinct
from arview.detection.search.pattern_search import search_outlines
from arview.detection.search.template_bank import (
    GROUPS,
    in_fundamental_domain,
    make_bank,
    make_outlines,
    outlines_near_icosphere,
)
from arview.detection.search.template_matching import TYPICAL_SHARE, decimate, decimate_with_border, match_templates
from arview.geometry import Array, rigid, turns_to_rays
from arview.guideviews import GuideViewSet
from arview.refinement import PartView


@dataclass(frozen=True)
class RefinementStep:
    """One round in which matches are improved as outlines on larger maps.

    Attributes:
        scale_steps: scale steps by which the maps are larger than those before.
        roll_step_rad: step of the roll.
        stretch_step: step of the size as a share of it.
        is_fine: try the nearest neighbouring views, not the far ones.
    """

    scale_steps: int
    roll_step_rad: float
    stretch_step: float
    is_fine: bool


GRID_PX = 4
"""Spacing of the places at which templates are matched."""
MAX_SCALE = 1.5
"""Largest factor by which the image is enlarged for near distances."""
MIN_SCORE = 0.3
"""Mean response below which template matches are noise."""
CELL_PX = 4.0
CELL_ROLL_RAD = 0.33
"""Size in place and roll of the cells of which only the best match is kept."""
MATCHES_PER_KEPT = 5
"""Matches gathered per match kept after duplicates are removed."""
STEPS: tuple[RefinementStep, ...] = (
    RefinementStep(scale_steps=2, roll_step_rad=0.16, stretch_step=0.07, is_fine=False),
    RefinementStep(scale_steps=2, roll_step_rad=0.16, stretch_step=0.07, is_fine=False),
    RefinementStep(scale_steps=2, roll_step_rad=0.08, stretch_step=0.04, is_fine=True),
)
"""Rounds of improvement, from half diameters of 20 px over 28 and 40 to 57 px."""
ROUNDS = 2
"""Maximum number of passes over all changes of view, roll and size in one round of improvement."""
SHIFT_PX = 2
"""Range and step of the shifts tried with each change."""
DISTINCT_PX = 6.0
DISTINCT_RAD = 0.15
DISTINCT_RATIO = 1.06
"""Offset at the scale of the templates, rotation and distance ratio within which improved matches are duplicates."""
RESPONSE_WEIGHT = 20.0
"""Weight of the mean response beside the profile score when candidates are ranked."""
MAX_OCTAVES = 2.6
"""A wider range of sizes is searched in two parts, so that the usual sizes take no longer."""
CORE_FILL = (0.18, 0.85)
"""The part's diameter in the picture, as shares of its longer side, in the search for usual sizes."""
CUT_FILL = 0.7
"""The part's diameter, as a share of the picture's shorter side, from which it is also searched where the picture's
border cuts it."""
CUT_MARGIN = 0.4
"""Distance that templates of cut parts may reach out of the response maps, as a share of ``radius_px``."""
MIN_MAP_PX = 16
"""Side of a response map, without its border, below which nothing is searched."""


@dataclass(frozen=True)
class GlobalSearchOptions:
    """Options of the global search.

    Attributes:
        radius_px: half the part's diameter in the templates.
        roll_step_deg: spacing of the templates in roll.
        subdivisions: icosahedron level of the template directions (2: 162, about 17° apart).
    """

    radius_px: float = 20.0
    roll_step_deg: float = 18.0
    subdivisions: int = 2


@dataclass(frozen=True)
class SearchBudget:
    """How far one search goes.

    Attributes:
        matches: template matches that are improved as outlines.
        refined: matches that are improved in the last round, too.
        ranked: improved matches that are ranked.
        starts: ranked poses from which the local search starts.
        kept: hypotheses kept after each level of the pattern search.
        scale_stride: spacing of the scale steps at which templates are matched.
        is_trimmed: leave out the quarter of each outline with the lowest responses, which may be occluded.
        use_edge_net: edge responses weigh as much as gradients until poses are ranked.
        is_outer: search a wide range's outer sizes, see `CORE_FILL`, and nothing in other ranges.
    """

    matches: int
    refined: int
    ranked: int
    starts: int
    kept: tuple[int, ...]
    scale_stride: int
    is_trimmed: bool
    use_edge_net: bool = True
    is_outer: bool = False


QUICK = SearchBudget(matches=400, refined=200, ranked=100, starts=16, kept=(6, 4), scale_stride=2, is_trimmed=False)
"""The first search of every image; half of the scales, few matches."""
WIDE = SearchBudget(matches=2500, refined=1400, ranked=700, starts=160, kept=(60, 20), scale_stride=1, is_trimmed=True)
"""For clutter, in which thousands of wrong matches score higher than the right one, and for occluded parts."""
QUICK_OUTER = replace(QUICK, is_outer=True)
"""The first search for a part that is smaller or larger in the picture than usual."""
WIDE_OUTER = replace(WIDE, matches=1200, refined=700, ranked=350, starts=80, kept=(30, 10), is_outer=True)
"""The same in clutter."""
GRADIENTS_ONLY = replace(WIDE, is_trimmed=False, use_edge_net=False)
"""For materials to which the edge network does not respond."""
UNTRIMMED = replace(WIDE, is_trimmed=False)
"""For unoccluded parts of low contrast, of which a trimmed score sees too little."""


@dataclass(frozen=True)
class PoseCandidate:
    """A rough pose.

    Attributes:
        score: compares the candidates of one image.
        cam_from_body: (4,4) about the part's centre.
    """

    score: float
    cam_from_body: Array


@dataclass(frozen=True)
class TemplateMatches:
    """Matches of outlines in the image.

    Attributes:
        keys: (M,) by which they compare.
        steps: (M,) scale steps.
        views: (M,) indices of the outlines.
        rolls: (M,) rad.
        radii_px: (M,) half diameters at that scale.
        places: (M,2) px of the part's centre at that scale.
    """

    keys: Array
    steps: NDArray[np.int64]
    views: NDArray[np.int32]
    rolls: Array
    radii_px: Array
    places: Array

    def best(self, count: int) -> TemplateMatches:
        """The ``count`` best matches, best first."""
        return self.select(np.argsort(-self.keys, kind="stable")[:count])

    def select(self, index: NDArray[np.intp]) -> TemplateMatches:
        """The matches of some indices."""
        return TemplateMatches(*(getattr(self, field.name)[index] for field in fields(self)))


class CandidatePoses(NamedTuple):
    """Poses before they are ranked, best first by their responses.

    Attributes:
        poses: (N,4,4) ``cam_from_body``.
        view_lines: (N,) distinct lines that the views at the poses show.
        responses: (N,) mean responses 0–1.
    """

    poses: Array
    view_lines: Array
    responses: Array


NO_CANDIDATES = CandidatePoses(np.empty((0, 4, 4)), np.empty(0), np.empty(0))


def _concatenated(parts: list[TemplateMatches]) -> TemplateMatches:
    return TemplateMatches(
        *(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(TemplateMatches))
    )


def search_distances_mm(
    views: GuideViewSet, camera: Camera, nearest: float = 0.85, farthest: float = 1.18
) -> tuple[float, float]:
    """Shortest and longest distance at which poses are searched.

    Args:
        views: guide views over the declared range.
        camera: of the pictures.
        nearest, farthest: shares of the shortest and longest distance of the range for this camera.
    """
    low, high = views.view_range.for_camera(camera, views.diameter_mm).distance_mm
    return nearest * low, farthest * high


def weight_by_lines(scores: Array, view_lines: Array) -> Array:
    """Scores that compare across views: a view that shows few distinct lines often fits by chance."""
    return np.asarray(scores * view_lines**0.25)


def _typical_response(maps: NDArray[np.uint8], stride: int = 4) -> float:
    """Response 0–1 that an outline has by chance in response maps (8,H,W), from every few of their pixels."""
    return TYPICAL_SHARE * float(maps[:, ::stride, ::stride].mean()) / 255.0


class GlobalSearch:
    """The global search for one part with one camera.

    Args:
        views: guide views of the part over the declared range.
        part: the same views for the kernels.
        camera: of the images.
        options: see `GlobalSearchOptions`.
        turns: (N,3,3) rotations of the part onto itself; of the views that they make equal one is searched.

    Raises:
        InputError: no view shows an outline.
    """

    def __init__(
        self,
        views: GuideViewSet,
        part: PartView,
        camera: Camera,
        options: GlobalSearchOptions,
        turns: Array,
    ) -> None:
        self.camera = camera
        self.options = o = options
        self._diameter_mm = views.diameter_mm
        self._focal_px = 0.5 * (camera.fx + camera.fy)
        self._ranker = ProfileRanker(part)
        self.outlines = make_outlines(views, part.model_from_body)
        # Scale steps of the templates, from far to near: large images first.
        low, high = views.view_range.for_camera(camera, views.diameter_mm).distance_mm
        self._distances_mm = search_distances_mm(views, camera)
        near, far = self.step_at(low), self.step_at(high)
        top = int(np.floor(STEPS_PER_OCTAVE * np.log2(MAX_SCALE)))
        self._steps = [s for s in range(int(np.floor(far + 0.4)), int(np.ceil(near - 0.4)) - 1, -1) if s <= top]
        self._core, self._outer = self._split(self._steps)
        chosen = outlines_near_icosphere(views, self.outlines, o.subdivisions)
        chosen = chosen[in_fundamental_domain(-self.outlines.rotations[chosen, 2], turns, views.view_range)]
        self._groups = len(np.unique(self.outlines.groups[chosen]))
        rolls = np.deg2rad(views.view_range.rolls_deg(o.roll_step_deg))
        focals_px = {step: self._focal_px * 2.0 ** (step / STEPS_PER_OCTAVE) for step in self._steps}
        self.banks = {
            step: make_bank(self.outlines, chosen, rolls, o.radius_px, o.radius_px / focal_px)
            for step, focal_px in focals_px.items()
        }

    @property
    def has_outer(self) -> bool:
        """Whether the range of sizes is so wide that its outer part is searched by budgets of its own."""
        return bool(self._outer)

    def _split(self, steps: list[int]) -> tuple[list[int], list[int]]:
        """Scale steps of the usual sizes, and of all others where the range of sizes is wide."""
        o = self.options
        if len(steps) <= MAX_OCTAVES * STEPS_PER_OCTAVE:
            return steps, []
        longer_px = max(self.camera.width, self.camera.height)
        last, first = (step_for(0.5 * fill * longer_px, o.radius_px) for fill in CORE_FILL)
        core = [step for step in steps if round(first) <= step <= round(last)]
        return core, [step for step in steps if step not in core]

    def step_at(self, distance_mm: float) -> float:
        """Scale step at which the part at a distance has the size of the templates."""
        return step_for(self._focal_px * 0.5 * self._diameter_mm / distance_mm, self.options.radius_px)

    def starts(self, pyramid: ImagePyramid, budget: SearchBudget = QUICK) -> list[PoseCandidate]:
        """Poses of the best matches over the whole range, apart from each other, best first."""
        return self.rank(pyramid, self.candidates(pyramid, budget), budget)

    def _are_in_reach(self, distances_mm: Array) -> NDArray[np.bool_]:
        low, high = self._distances_mm
        return np.asarray((low <= distances_mm) & (distances_mm <= high))

    def rank(
        self, pyramid: ImagePyramid, candidates: CandidatePoses, budget: SearchBudget = QUICK
    ) -> list[PoseCandidate]:
        """The candidates with the highest profile scores and responses, best first."""
        scores = self._ranker.scores(pyramid, candidates.poses, candidates.view_lines)
        scores = scores + RESPONSE_WEIGHT * candidates.responses
        best = np.argsort(-scores, kind="stable")[: budget.starts]
        return [PoseCandidate(float(scores[k]), candidates.poses[k]) for k in best]

    def candidates(self, pyramid: ImagePyramid, budget: SearchBudget = QUICK) -> CandidatePoses:
        """Poses of the best matches by their responses: matched as templates, then improved as outlines."""
        if not budget.use_edge_net:
            pyramid = pyramid.without_edge_net
        matches = self._match_all(pyramid, budget)
        if not len(matches.keys):
            return NO_CANDIDATES
        *first_steps, last_step = STEPS
        for step in first_steps:
            matches = self._refine(pyramid, matches, step, budget.is_trimmed)
        matches = self._refine(pyramid, matches.best(budget.refined), last_step, budget.is_trimmed)
        if not len(matches.keys):
            return NO_CANDIDATES
        matches = self._select_distinct(matches, budget.ranked)
        poses = np.stack([rigid(r, p) for r, p in zip(*self._posed(matches), strict=True)])
        view_lines = self.outlines.view_lines[matches.views]
        return CandidatePoses(poses, view_lines, matches.keys / weight_by_lines(np.ones(len(view_lines)), view_lines))

    def _match_all(self, pyramid: ImagePyramid, budget: SearchBudget) -> TemplateMatches:
        """The best template matches at all scales, without duplicates."""
        steps = self._outer if budget.is_outer else self._core
        if not steps:
            return self._no_matches()
        scales = steps[:: budget.scale_stride]
        pyramid.make_maps(scales)
        phases = list(pool().map(lambda step: self._phases(pyramid, step), scales))
        count = len(next(iter(self.banks.values())).bins)
        halves = [0, count // 2, count]
        votes = {step: np.zeros((GROUPS, 1024), dtype=np.int64) for step in scales}
        # Every group of views keeps equally many at each scale; most of them are duplicates.
        kept = MATCHES_PER_KEPT * -(-budget.matches // (self._groups * len(scales)))
        levels = list(zip(scales, phases, strict=True))
        jobs = [(*level, first, last) for level in levels for first, last in pairwise(halves)]
        found = pool().map(lambda job: self._match(votes[job[0]], kept, budget.is_trimmed, pyramid, *job), jobs)
        return self._without_duplicates(_concatenated([self._no_matches(), *found]), budget.matches)

    def _cut_margin_px(self, step: int) -> int:
        """Border added to the response maps at a scale step, on which outlines cut by the picture's border match."""
        o = self.options
        if o.radius_px < self._min_cut_px(step):
            return 0
        return GRID_PX * math.ceil(CUT_MARGIN * o.radius_px / GRID_PX)

    def _min_cut_px(self, step: int) -> float:
        """Half diameter at a scale step from which the part is searched where the picture's border cuts it."""
        shorter_px = min(self.camera.width, self.camera.height) * 2.0 ** (step / STEPS_PER_OCTAVE)
        return 0.5 * CUT_FILL * shorter_px

    def _phases(self, pyramid: ImagePyramid, step: int) -> NDArray[np.uint8]:
        """The decimated response maps at a scale step."""
        maps, _ = pyramid.maps(step)
        margin_px = self._cut_margin_px(step)
        if margin_px == 0:
            return decimate(maps, GRID_PX)
        return decimate_with_border(maps, GRID_PX, pyramid.pad_px, margin_px)

    @staticmethod
    def _no_matches() -> TemplateMatches:
        empty = np.empty(0)
        return TemplateMatches(empty, np.empty(0, np.int64), np.empty(0, np.int32), empty, empty, np.empty((0, 2)))

    def _match(
        self,
        votes: NDArray[np.int64],
        kept: int,
        is_trimmed: bool,
        pyramid: ImagePyramid,
        step: int,
        phases: NDArray[np.uint8],
        first: int,
        last: int,
    ) -> TemplateMatches:
        """The matches of the templates ``first`` to ``last`` at one scale."""
        bank = self.banks[step]
        maps, _ = pyramid.maps(step)
        if min(maps.shape[1:]) < MIN_MAP_PX + 2 * pyramid.pad_px:
            return self._no_matches()
        keys, templates, places = match_templates(
            phases, bank.offsets, bank.bins, bank.gains, bank.groups, first, last, kept, MIN_SCORE, votes,
            is_trimmed,
        )  # fmt: skip
        return TemplateMatches(
            keys=keys,
            steps=np.full(len(keys), step),
            views=bank.views[templates],
            rolls=bank.rolls[templates],
            radii_px=np.full(len(keys), self.options.radius_px),
            places=places + bank.origins[templates] - pyramid.pad_px - self._cut_margin_px(step),
        )

    def _posed(self, matches: TemplateMatches) -> tuple[Array, Array]:
        """Rotations (M,3,3) and positions (M,3) mm of the part's centre."""
        scales = 2.0 ** (matches.steps / STEPS_PER_OCTAVE)
        rays = self.camera.unproject((matches.places + 0.5) / scales[:, None] - 0.5)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        distances_mm = self._match_distances_mm(matches)
        c, s, zero = np.cos(matches.rolls), np.sin(matches.rolls), np.zeros(len(matches.rolls))
        turns = np.stack([c, -s, zero, s, c, zero, zero, zero, zero + 1.0], axis=1).reshape(-1, 3, 3)
        rotations = turns @ self.outlines.rotations[matches.views]
        return turns_to_rays(rays) @ rotations, rays * distances_mm[:, None]

    def _match_distances_mm(self, matches: TemplateMatches) -> Array:
        """Distances (M,) of the part's centre."""
        scales = 2.0 ** (matches.steps / STEPS_PER_OCTAVE)
        return np.asarray(self._focal_px * 0.5 * self._diameter_mm * scales / matches.radii_px)

    def _select_distinct(self, matches: TemplateMatches, count: int) -> TemplateMatches:
        """The best ``count`` matches, none close to a better one."""
        o = self.options
        matches = matches.select(np.argsort(-matches.keys, kind="stable"))
        rotations, positions = self._posed(matches)
        # In pixels at the scale of the templates: the larger the part is in the image, the larger the offset.
        reach = np.full(len(positions), DISTINCT_PX / o.radius_px) * 0.5 * self._diameter_mm
        cosine = np.cos(DISTINCT_RAD)
        return matches.select(
            select_distinct(rotations, positions, reach / positions[:, 2], cosine, DISTINCT_RATIO, count)
        )

    def _without_duplicates(self, matches: TemplateMatches, count: int) -> TemplateMatches:
        """The best ``count`` matches, one for each cell of place, scale and rotation.

        The best of each group of views at each scale come first, then all second best, and so on.
        """
        matches = matches.best(len(matches.keys))
        cells = np.floor(matches.places / CELL_PX).astype(np.int64) + 4096
        rolls = np.floor(matches.rolls / CELL_ROLL_RAD).astype(np.int64) + 64
        groups = self.outlines.groups[matches.views].astype(np.int64) * 128 + matches.steps + 64
        _, first = np.unique(((groups * 8192 + cells[:, 0]) * 8192 + cells[:, 1]) * 128 + rolls, return_index=True)
        first.sort()
        by_group = np.argsort(groups[first], kind="stable")
        _, starts, counts = np.unique(groups[first][by_group], return_index=True, return_counts=True)
        rank = np.empty(len(first), dtype=np.int64)
        rank[by_group] = np.arange(len(first)) - np.repeat(starts, counts)
        return matches.select(first[np.argsort(rank, kind="stable")[:count]])

    def _refine(
        self, pyramid: ImagePyramid, matches: TemplateMatches, refinement: RefinementStep, is_trimmed: bool
    ) -> TemplateMatches:
        """Matches improved independently on larger maps, without those that leave the searched distances."""
        if not len(matches.keys):
            return matches
        outlines = self.outlines
        around = outlines.near if refinement.is_fine else outlines.far
        jobs = []
        for step in np.unique(matches.steps):
            group = np.flatnonzero(matches.steps == step)
            jobs += [(min(0, step + refinement.scale_steps), part) for part in np.array_split(group, 2)]
        pyramid.make_maps([step for step, _ in jobs])

        def refine(job: tuple[int, NDArray[np.intp]]) -> TemplateMatches:
            step, index = job
            some = matches.select(index)
            focal_px = self._focal_px * 2.0 ** (step / STEPS_PER_OCTAVE)
            scale = 2.0 ** ((step - some.steps) / STEPS_PER_OCTAVE)
            maps, _ = pyramid.maps(step)
            places = (some.places + 0.5) * scale[:, None] - 0.5 + pyramid.pad_px
            scores, views, rolls, radii_px, places = search_outlines(
                maps, outlines.points, outlines.angles, around.views, around.rolls, some.views, some.rolls,
                some.radii_px * scale, places, focal_px, refinement.roll_step_rad, refinement.stretch_step, ROUNDS,
                SHIFT_PX, SHIFT_PX, is_trimmed, pyramid.pad_px, self._min_cut_px(step), _typical_response(maps),
            )  # fmt: skip
            keys = weight_by_lines(scores, outlines.view_lines[views])
            steps = np.full(len(keys), step)
            refined = TemplateMatches(keys, steps, views, rolls, radii_px, places - pyramid.pad_px)
            return refined.select(np.flatnonzero(self._are_in_reach(self._match_distances_mm(refined))))

        return _concatenated(list(pool().map(refine, jobs)))
