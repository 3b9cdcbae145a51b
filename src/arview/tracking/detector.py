"""Detector: finds the part in a single frame from its guide views, with no pose to start from.

Candidates come from template matching over directions, rolls and distances of the declared range; the picture is
resized for every distance so that the part always spans the same few pixels and one bank of templates serves all.
The best candidates are refined by the tracker's edge modality and judged by the same evidence as a tracked pose.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array, exp_so3, rigid
from arview.guideviews import GuideViewSet
from arview.guideviews.mesh_edges import EDGE_CONTOUR
from arview.guideviews.sphere import icosphere_directions
from arview.guideviews.uniqueness import PLAIN_LINES, view_lines
from arview.tracking.matching import decimate, match_templates, orientation_bins, response_maps, score_around
from arview.tracking.quality import RIGHT_WORTH, quality_of
from arview.tracking.solver import project_lines
from arview.tracking.tracker import Stage, Tracker, TrackerOptions, intrinsics_of, smoothed


def _coarse_stages(region_gain: float) -> tuple[Stage, ...]:
    return (
        Stage(6, 12, 2.0, 10.0, 2, region_gain, 2),
        Stage(4, 12, 2.0, 7.0, 2, region_gain, 2),
        Stage(4, 12, 1.5, 5.0, 2, region_gain, 2),
        Stage(3, 10, 1.0, 3.5, 2, region_gain, 2),
    )


COARSE_STAGES: tuple[tuple[Stage, ...], ...] = ((), _coarse_stages(1.0), _coarse_stages(20.0))
"""Tries from every start: it is near enough already; edges lead; colours lead, on plain and glossy parts."""
LOWEST_SCORE = 0.25
"""Template matches below this are noise."""
HOPELESS_WORTH = 0.35
"""A pose worth less is not searched around: the part is not there."""
SURE_QUALITY = 0.985
"""A pose of this quality ends the search."""
HOPELESS_QUALITY = 0.1
"""When the likeliest matches end below this the part is hardly there."""
COARSE_TOLERANCE_PX = 3.5
"""After the coarse stages edges are looked for this near."""
FINE_STAGES = (
    Stage(2, 12, 1.5, 5.0, 2),
    Stage(2, 10, 1.0, 4.0, 2),
    Stage(1, 8, 1.0, 2.5, 2),
    Stage(1, 6, 1.0, 1.5, 2),
    Stage(1, 5, 1.0, 1.0, 2),
)


def _turn_grid(reach_deg: float, step_deg: float) -> Array:
    """(R,3,3) rotations on a grid of rotation vectors inside a ball."""
    axis = np.arange(-reach_deg, reach_deg + 0.5 * step_deg, step_deg)
    vectors = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    vectors = vectors[np.linalg.norm(vectors, axis=1) <= 1.3 * reach_deg]
    return np.stack([exp_so3(np.deg2rad(v)) for v in vectors])


@dataclass(frozen=True)
class SearchGrid:
    """Poses tried around a pose: turns (R,3,3), factors of the distance (D,), and how sharply they are looked at.

    ``magnification`` is the part's size against that of the templates, ``kept_each`` and ``kept`` how many of the
    best are kept around one pose and in all, apart from each other by ``apart_deg``.
    """

    turns: Array
    stretches: Array
    magnification: float
    kept_each: int
    kept: int
    apart_deg: float


NEAR_GRID = SearchGrid(_turn_grid(9.0, 4.5), np.array([0.93, 0.965, 1.0, 1.035, 1.07]), 2.0, 2, 10, 4.0)
"""Between the templates of the first search."""
WIDE_GRID = SearchGrid(_turn_grid(16.0, 4.0), np.array([0.92, 0.96, 1.0, 1.04, 1.08]), 2.0, 10, 10, 4.0)
"""Around a pose given by hand or a guess."""
FINE_GRID = SearchGrid(_turn_grid(3.0, 1.5), np.array([0.976, 0.988, 1.0, 1.012, 1.024]), 4.0, 1, 10, 1.5)
"""Between the poses of the grids above."""


@dataclass(frozen=True)
class DetectorOptions:
    """Options of the detector.

    Attributes:
        radius_px: half the part's diameter in the resized picture.
        points: per template.
        roll_step_deg, distance_ratio: spacing of the templates; the spread of the responses covers half of it.
        subdivisions: icosahedron level of the template directions (3: 642, about 9° apart).
        refined: template matches that are searched around.
        likeliest: of those, how many are tried first, and alone if they settle the matter.
        finalists: how many of either are refined to the end.
        min_in_picture: less of the outline inside the picture is no detection.
        min_quality: a weaker result is no detection.
    """

    radius_px: float = 26.0
    points: int = 64
    roll_step_deg: float = 12.0
    distance_ratio: float = 1.16
    subdivisions: int = 3
    spread_px: int = 2
    grid_px: int = 2
    refined: int = 14
    likeliest: int = 6
    finalists: int = 5
    min_quality: float = 0.5
    min_in_picture: float = 0.4

    def __post_init__(self) -> None:
        if not 10 <= self.radius_px <= 60:
            raise InputError(f"detector: radius_px = {self.radius_px}, expected 10 to 60")


BROAD_OPTIONS = DetectorOptions(
    radius_px=16.0,
    points=48,
    roll_step_deg=18.0,
    distance_ratio=1.22,
    subdivisions=2,
    refined=40,
    likeliest=8,
)
"""For ranges up to the full sphere at all rolls: fewer and coarser templates, more of them searched around."""
MOST_MATCHES = 6000
"""More templates times distances than this make a range broad."""


def options_for(views: GuideViewSet) -> DetectorOptions:
    """The options that suit the declared range."""
    usual = DetectorOptions()
    view_range = views.view_range
    directions = np.count_nonzero(view_range.contains_direction(icosphere_directions(usual.subdivisions), 3.0))
    rolls = len(view_range.rolls_deg(usual.roll_step_deg))
    matches = directions * rolls * len(view_range.distances_mm(usual.distance_ratio))
    return usual if matches <= MOST_MATCHES else BROAD_OPTIONS


@dataclass(frozen=True)
class Detection:
    """A place where the part was found.

    Attributes:
        cam_from_model: (4,4) mm.
        quality: 0–1, probability that the pose is right.
        mismatches: components that are not seen where expected, see `Pose.mismatches`.
        alternatives: other poses (4,4) that the picture bears out as well; not empty: the view is ambiguous.
    """

    cam_from_model: Array
    quality: float
    mismatches: tuple[str, ...] = ()
    alternatives: tuple[Array, ...] = ()


@dataclass(frozen=True)
class Candidate:
    """A template match: score 0–1 and the pose it stands for, about the model's centre."""

    score: float
    cam_from_body: Array


class Detector:
    """Detection of one part with one camera over the declared range of its guide views."""

    def __init__(self, views: GuideViewSet, camera: Camera, options: DetectorOptions | None = None) -> None:
        self.options = options or options_for(views)
        self.views = views
        self.camera = camera
        self.tracker = Tracker(views, camera, TrackerOptions(use_feature=False))
        self._make_templates()
        self._lines: dict[int, float] = {}
        looked_at = range(0, len(views), max(1, len(views) // 50))
        lines = [view_lines(views.view(i), views.diameter_mm) for i in looked_at]
        self._telling_lines = 0.7 * float(np.percentile(lines, 75))

    def _make_templates(self) -> None:
        o = self.options
        wanted = icosphere_directions(o.subdivisions)
        inside = self.views.view_range.contains_direction(wanted, 3.0)
        if not inside.any():
            chosen = np.arange(len(self.views))
        else:
            chosen = np.unique(np.argmax(wanted[inside] @ self.views.directions.T, axis=1))
        rolls = np.deg2rad(self.views.view_range.rolls_deg(o.roll_step_deg))
        focal = 1000.0
        # Normalised camera: the bounding sphere has radius_px.
        template_scale = o.radius_px / (0.5 * self.views.diameter_mm)
        offsets = np.zeros((len(chosen) * len(rolls), o.points, 2), dtype=np.int32)
        bins = np.zeros((len(chosen) * len(rolls), o.points), dtype=np.uint8)
        counts = np.zeros(len(chosen) * len(rolls), dtype=np.int32)
        origins = np.zeros((len(counts), 2))
        rotations = np.zeros((len(counts), 3, 3))
        intrinsics = np.array([focal, focal, 0.0, 0.0, 0, 0, 0, 0, 0, 0])
        row = 0
        for index in chosen:
            view = self.views.view(int(index))
            features = view.features
            cam_from_body = view.cam_from_model @ self.tracker.part.model_from_body
            center = self.views.center_in_model
            contour, normals = features.contour_points - center, features.contour_normals
            edges, tangents = features.edge_points - center, features.edge_tangents
            distance = cam_from_body[2, 3]
            c_px, c_n, c_z = project_lines(contour, normals, False, cam_from_body, intrinsics, 0.5)
            inner = (features.edge_kinds & EDGE_CONTOUR) == 0
            e_px, e_n, e_z = project_lines(edges[inner], tangents[inner], True, cam_from_body, intrinsics, 0.5)
            c_px, c_n = c_px[c_z > 0], c_n[c_z > 0]
            e_px, e_n = e_px[e_z > 0], e_n[e_z > 0]
            inner_count = min(len(e_px), int(0.35 * o.points))
            outer_count = min(len(c_px), o.points - inner_count)
            if outer_count < 8:
                continue
            px = np.concatenate([c_px[_spread(len(c_px), outer_count)], e_px[_spread(len(e_px), inner_count)]])
            n = np.concatenate([c_n[_spread(len(c_n), outer_count)], e_n[_spread(len(e_n), inner_count)]])
            px *= distance / focal * template_scale
            for roll in rolls:
                c, s = np.cos(roll), np.sin(roll)
                turn = np.array([[c, -s], [s, c]])
                p, q = px @ turn.T, n @ turn.T
                low = np.floor(p.min(axis=0))
                origins[row] = -low
                offsets[row, : len(p)] = np.round(p - low)
                bins[row, : len(p)] = orientation_bins(q)
                counts[row] = len(p)
                rotations[row] = rigid(exp_so3([0, 0, roll]), np.zeros(3))[:3, :3] @ cam_from_body[:3, :3]
                row += 1
        if row == 0:
            raise InputError("guide views: no view shows an outline; check the model and the declared distances")
        self._offsets, self._bins, self._counts = offsets[:row], bins[:row], counts[:row]
        self._origins, self._rotations = origins[:row], rotations[:row]

    def detect(self, image: NDArray[np.uint8], max_results: int = 3, is_thorough: bool = True) -> list[Detection]:
        """Poses of the part in a frame, best first; an empty list when it is not found.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            max_results: at most so many, all above the quality threshold and apart from each other.
            is_thorough: look at the less likely template matches too when the likeliest come to nothing at all.
        """
        o = self.options
        gray = smoothed(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        candidates = self.candidates(image)
        maps: dict[int, tuple[NDArray[np.uint8], Array] | None] = {}
        settled: list[tuple[float, Array]] = []
        # The likeliest first: when they settle the matter, the others are not looked at.
        for batch in (candidates[: o.likeliest], candidates[o.likeliest :]):
            near = self._sharpen(image, batch, NEAR_GRID, maps)
            settled += self._settle(image, gray, self._sharpen(image, near, FINE_GRID, maps))
            settled.sort(key=lambda item: -self._rank(*item))
            hopeless = not settled or self._quality(*settled[0]) < HOPELESS_QUALITY
            if (hopeless and not is_thorough) or (settled and self._is_sure(settled[0][1], self._quality(*settled[0]))):
                break
        found = [
            Detection(pose @ self.tracker.part.body_from_model, quality)
            for quality, pose in ((self._quality(worth, pose), pose) for worth, pose in settled)
            if quality >= o.min_quality and self._is_plausible(pose)
        ]
        return found[:max_results]

    def snap(self, image: NDArray[np.uint8], cam_from_model: Array) -> Detection:
        """The best pose near a given one, up to about 15° and 5 % of distance away.

        Its quality says whether it is right; it is returned even when that is low.
        """
        gray = smoothed(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        start = cam_from_model @ self.tracker.part.model_from_body
        maps: dict[int, tuple[NDArray[np.uint8], Array] | None] = {}
        wide = self._sharpen(image, [Candidate(1.0, start)], WIDE_GRID, maps)
        settled = self._settle(image, gray, [Candidate(1.0, start), *self._sharpen(image, wide, FINE_GRID, maps)])
        worth, pose = settled[0]
        return Detection(pose @ self.tracker.part.body_from_model, self._quality(worth, pose))

    def _sharpen(
        self,
        image: NDArray[np.uint8],
        candidates: list[Candidate],
        grid: SearchGrid,
        maps: dict[int, tuple[NDArray[np.uint8], Array] | None],
    ) -> list[Candidate]:
        """Poses around candidates that fit the picture best at a higher resolution, likeliest first.

        ``maps`` keeps the response maps of this picture by scale, for the next call.
        One score over the whole outline is not misled by print or texture that draws single edge points away.
        """
        o = self.options
        camera = self.camera
        pad = round(0.6 * o.radius_px)
        by_step: dict[int, list[Candidate]] = {}
        for candidate in candidates:
            scale = min(1.0, grid.magnification * o.radius_px / self.tracker.radius_px(candidate.cam_from_body))
            by_step.setdefault(round(np.log(scale) / np.log(o.distance_ratio)), []).append(candidate)

        def maps_at(step: int) -> tuple[NDArray[np.uint8], Array] | None:
            width = round(camera.width * o.distance_ratio**step)
            height = round(camera.height * o.distance_ratio**step)
            if width < 24 or height < 24:
                return None
            small = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))
            intrinsics = intrinsics_of(camera.scaled(width, height))
            intrinsics[2:4] += pad
            return response_maps(small, o.spread_px, pad), intrinsics

        missing = [step for step in by_step if step not in maps]
        maps.update(zip(missing, _pool().map(maps_at, missing), strict=True))

        def search(item: tuple[Candidate, NDArray[np.uint8], Array]) -> list[Candidate]:
            candidate, responses, intrinsics = item
            scores, poses = score_around(
                responses, self.tracker.part.arrays, candidate.cam_from_body, intrinsics,
                0.01 * self.views.diameter_mm, grid.turns, grid.stretches, 4, 2, 64, 32,
            )  # fmt: skip
            best: list[Candidate] = []
            for index in np.argsort(-scores)[:200]:
                if not any(self._same(poses[index], other.cam_from_body, grid.apart_deg) for other in best):
                    best.append(Candidate(float(scores[index]), poses[index]))
                    if len(best) >= grid.kept_each:
                        break
            return best

        jobs: list[tuple[Candidate, NDArray[np.uint8], Array]] = []
        for step, group in by_step.items():
            made = maps[step]
            if made is not None:
                jobs += [(candidate, *made) for candidate in group]
        found = [candidate for best in _pool().map(search, jobs) for candidate in best]
        found.sort(key=lambda item: -item.score)
        apart: list[Candidate] = []
        for candidate in found:
            if not any(self._same(candidate.cam_from_body, other.cam_from_body, grid.apart_deg) for other in apart):
                apart.append(candidate)
        return apart[: grid.kept]

    def _settle(
        self, image: NDArray[np.uint8], gray: NDArray[np.uint8], starts: list[Candidate]
    ) -> list[tuple[float, Array]]:
        """Refine starts, keep the best, search around them; (worth, cam_from_body) best first."""
        o = self.options
        tries = [(start.cam_from_body, stages) for start in starts for stages in COARSE_STAGES]
        coarse = sorted(
            _pool().map(lambda item: self._approach(image, gray, *item), tries), key=lambda item: -self._rank(*item)
        )
        finalists: list[Array] = []
        for _, start in coarse:
            if len(finalists) >= o.finalists:
                break
            if not any(self._same(start, other, 3.0) for other in finalists):
                finalists.append(start)
        finished = self._finish_all(image, gray, finalists)
        if finished and HOPELESS_WORTH <= finished[0][0] < RIGHT_WORTH:
            finished += self._finish_all(image, gray, _around(finished[0][1], 0.05))
            finished.sort(key=lambda item: -item[0])
        result: list[tuple[float, Array]] = []
        # Of two poses that both fit, the one that explains more of the picture is right: a plain back fits any outline.
        for worth, pose in sorted(finished, key=lambda item: -self._rank(*item)):
            if not any(self._same(pose, other) for _, other in result):
                result.append((worth, pose))
        return result

    def _view_lines(self, cam_from_body: Array) -> float:
        """Distinct lines of the view nearest to a pose."""
        index = self.tracker.part.nearest(cam_from_body)
        if index not in self._lines:
            self._lines[index] = max(view_lines(self.views.view(index), self.views.diameter_mm), 1.0)
        return self._lines[index]

    def _is_sure(self, cam_from_body: Array, quality: float) -> bool:
        """So good that nothing else need be looked at: plausible, and not a plain side of a part that has others."""
        is_telling = self._view_lines(cam_from_body) >= self._telling_lines
        return quality >= SURE_QUALITY and is_telling and self._is_plausible(cam_from_body)

    def _rank(self, worth: float, cam_from_body: Array) -> float:
        """For comparing poses of one picture, see `_settle`."""
        return worth * float(np.sqrt(self._view_lines(cam_from_body)))

    def _approach(
        self, image: NDArray[np.uint8], gray: NDArray[np.uint8], start: Array, stages: tuple[Stage, ...]
    ) -> tuple[float, Array]:
        pose = self.tracker.refine_fresh(image, gray, start, stages)
        look = self.tracker.fresh_appearance(image, pose)
        return self.tracker.evidence(image, gray, pose, COARSE_TOLERANCE_PX, look).worth, pose

    def _finish_all(
        self, image: NDArray[np.uint8], gray: NDArray[np.uint8], starts: list[Array]
    ) -> list[tuple[float, Array]]:
        """Refine to the end; (worth, cam_from_body) best first, worth 0 where too little is in the picture."""

        def finish(start: Array) -> tuple[float, Array]:
            pose = self.tracker.refine_fresh(image, gray, start, FINE_STAGES)
            look = self.tracker.fresh_appearance(image, pose)
            evidence = self.tracker.evidence(image, gray, pose, appearance=look)
            return (evidence.worth if evidence.points_in_picture >= self.options.min_in_picture else 0.0), pose

        return sorted(_pool().map(finish, starts), key=lambda item: -item[0])

    def _quality(self, worth: float, cam_from_body: Array) -> float:
        """Quality of a pose found without history: a view of few lines must be borne out the better."""
        lines = self._view_lines(cam_from_body)
        plainness = max(1.0 - lines / (2.0 * PLAIN_LINES), 0.0)
        return quality_of(worth - 0.3 * plainness)

    def _same(self, a: Array, b: Array, angle_deg: float = 5.0) -> bool:
        near = np.linalg.norm(a[:3, 3] - b[:3, 3]) < 0.01 * angle_deg * self.views.diameter_mm
        # cos of the angle between them from the trace: cheap, it is asked often.
        cosine = 0.5 * (float(np.sum(a[:3, :3] * b[:3, :3])) - 1.0)
        return bool(near and cosine > np.cos(np.deg2rad(angle_deg)))

    def _is_plausible(self, cam_from_body: Array) -> bool:
        """Within a margin of the declared distances and in front of the camera."""
        low, high = self.views.view_range.distance_mm
        distance = float(np.linalg.norm(cam_from_body[:3, 3]))
        return bool(0.85 * low <= distance <= 1.18 * high and cam_from_body[2, 3] > 0)

    def candidates(self, image: NDArray[np.uint8]) -> list[Candidate]:
        """The best template matches over the whole range, apart from each other, best first."""
        o = self.options
        distances = self.views.view_range.distances_mm(o.distance_ratio)
        matches = [m for m in _pool().map(lambda d: self._match_at(image, float(d)), distances) if m is not None]
        if not matches:
            return []
        scores = np.concatenate([m[0] for m in matches])
        order = np.argsort(-scores, kind="stable")[:1000]
        scores = scores[order]
        templates = np.concatenate([m[1] for m in matches])[order]
        centers_px = np.concatenate([m[2] for m in matches])[order]
        distance_mm = np.concatenate([np.full(len(m[0]), m[3]) for m in matches])[order]
        reach_px = np.concatenate([np.full(len(m[0]), 6.0 / m[4]) for m in matches])[order]
        rays = self.camera.unproject(centers_px)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        rotations = _turned_with_rays(self._rotations[templates], rays)
        kept: list[int] = []
        free = np.ones(len(scores), dtype=bool)
        for i in range(len(scores)):
            if not free[i]:
                continue
            kept.append(i)
            if len(kept) >= o.refined:
                break
            near = np.all(np.abs(centers_px - centers_px[i]) < reach_px[i], axis=1)
            near &= np.abs(np.log(distance_mm / distance_mm[i])) < 0.2
            near &= np.einsum("jk,njk->n", rotations[i], rotations) > 1.0 + 2.0 * np.cos(0.3)
            free &= ~near
        return [Candidate(float(scores[i]), rigid(rotations[i], rays[i] * distance_mm[i])) for i in kept]

    def _match_at(
        self, image: NDArray[np.uint8], distance_mm: float
    ) -> tuple[Array, NDArray[np.intp], Array, float, float] | None:
        """Scores, templates and centres (px) of the matches at one distance, with the distance and the scale."""
        o = self.options
        camera = self.camera
        focal = 0.5 * (camera.fx + camera.fy)
        scale = o.radius_px / (focal * 0.5 * self.views.diameter_mm / distance_mm)
        width, height = round(camera.width * scale), round(camera.height * scale)
        if width < 24 or height < 24 or scale > 1.5:
            return None
        resized = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))
        pad = round(0.6 * o.radius_px)
        phases = decimate(response_maps(resized, o.spread_px, pad), o.grid_px)
        scores, places = match_templates(phases, self._offsets, self._bins, self._counts, 3, LOWEST_SCORE)
        templates, ranks = np.nonzero(scores)
        centers = places[templates, ranks] + self._origins[templates] - pad
        centers_px = (centers + 0.5) * [camera.width / width, camera.height / height] - 0.5
        return scores[templates, ranks], templates, centers_px, distance_mm, scale


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    """Threads for candidates: the kernels release the interpreter."""
    return ThreadPoolExecutor(max(1, min(4, os.cpu_count() or 1)), thread_name_prefix="detector")


def _turned_with_rays(rotations: Array, rays: Array) -> Array:
    """Rotations (N,3,3) of views seen along the optical axis, turned to be seen along unit rays (N,3)."""
    # The smallest rotation that takes +Z to the ray (Rodrigues with the axis z × ray).
    x, y, z = rays.T
    turn = np.empty((len(rays), 3, 3))
    k = 1.0 / (1.0 + z)
    turn[:, 0] = np.stack([1.0 - k * x * x, -k * x * y, x], axis=1)
    turn[:, 1] = np.stack([-k * x * y, 1.0 - k * y * y, y], axis=1)
    turn[:, 2] = np.stack([-x, -y, z], axis=1)
    return turn @ rotations


def _around(cam_from_body: Array, angle_rad: float) -> list[Array]:
    """Poses turned by an angle about 14 axes through the part's centre: the coordinate axes and the diagonals."""
    axes = [np.array(a, dtype=np.float64) for a in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]
    axes += [np.array([1.0, b, c]) for b in (-1, 1) for c in (-1, 1)]
    turned = []
    for axis in axes:
        for sign in (-1.0, 1.0):
            turn = exp_so3(axis / np.linalg.norm(axis) * sign * angle_rad)
            turned.append(rigid(turn @ cam_from_body[:3, :3], cam_from_body[:3, 3]))
    return turned


def _spread(available: int, wanted: int) -> NDArray[np.intp]:
    return np.floor((np.arange(wanted) + 0.5) * available / max(wanted, 1)).astype(np.intp)
