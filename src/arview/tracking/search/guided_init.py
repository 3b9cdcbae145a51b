"""Guided initialisation: finds the part near a given pose, fast enough for every frame of a video.

The picture around the pose is reduced so that the part always spans the same few pixels. Rotations, distances and
shifts within reach are scored there by oriented edges, the best ones again at a higher resolution. The best of these
are refined and scored by the same evidence as a tracked pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.core.parallel import pool
from arview.detection import NearSearch, PoseGrid
from arview.geometry import Array, apply, rotation_angle_rad, turn_ball
from arview.guideviews import PLAIN_LINES, GuideViewSet, view_lines
from arview.refinement import (
    LAST_STAGES,
    SEARCH_STAGES,
    Appearance,
    PartView,
    PoseEvidence,
    PoseRefiner,
    RefinementPyramid,
    WorkingScaleOptions,
)

TURN_LIMIT_DEG = 20.0
"""Largest rotation between the given pose and an accepted one."""
DISTANCE_LIMIT = 0.2
"""Largest relative difference of their distances."""
OFFSET_LIMIT = 0.2
"""Largest shift between them across the line of sight, in diameters of the part."""
MIN_IN_PICTURE = 0.4
"""Share of the outline inside the picture needed to accept a pose."""
RIVAL_SCORE_SHARE = 0.8
"""Share of the score with which a nearer pose of the same outline makes a pose ambiguous."""
MIN_COARSE = 0.34
"""Edge score of the first round below which the part is not there."""
MIN_FINE = 0.4
"""Edge score of the second round below which the part is not there."""
MIN_SCORE = 0.6
"""Score of a pose, reduced for a plain view, needed to accept it."""
PLAIN_PENALTY = 0.3
"""Reduction of the score for a view without distinct lines."""
RIVAL_DISTANCE = 0.55
"""Ratio of the distances around which a nearer pose is searched for."""
MAX_RIVAL_DISTANCE = 0.85
"""A nearer pose at a larger ratio is the same pose."""
CROP_REACH = 1.35
"""Half size of the crop, in half diameters, because the part may be nearer than the given pose."""
CONTOUR_POINTS = 64
DESIGN_POINTS = 32
"""Points of outline and of design edges that are scored."""
SCALE = WorkingScaleOptions()
"""Options of the picture in which the best poses are refined and scored."""


@dataclass(frozen=True)
class GuidedPose:
    """A pose found near a given one.

    Attributes:
        cam_from_model: (4,4) mm.
        evidence: evidence of the picture for it.
        quality: 0–1, 0 where too little of the outline is inside the picture.
    """

    cam_from_model: Array
    evidence: PoseEvidence
    quality: float


@dataclass(frozen=True)
class SearchLevel:
    """One round of the search: a grid of poses around every start.

    Attributes:
        radius_px: half diameter of the part in the reduced picture.
        grid: of the poses around every start.
        kept_each: best poses kept around one start.
        kept: best poses kept in all.
        separation_deg: smallest difference between poses that are kept; 1° corresponds to 1 % of the diameter.
    """

    radius_px: float
    grid: PoseGrid
    kept_each: int
    kept: int
    separation_deg: float


COARSE = SearchLevel(
    radius_px=26.0,
    grid=PoseGrid(turn_ball(16.0, 9.0), np.geomspace(0.85, 1.15, 7), shift_px=8, shift_step_px=2),
    kept_each=8,
    kept=8,
    separation_deg=4.0,
)
"""First round: rotations up to 15°, 15 % of the distance, shifts of 15 % of the diameter."""
FINE = SearchLevel(
    radius_px=80.0,
    grid=PoseGrid(turn_ball(3.6, 2.4), np.linspace(0.97, 1.03, 5), shift_px=4, shift_step_px=2),
    kept_each=1,
    kept=4,
    separation_deg=1.5,
)
"""Second round: between the poses of the first grid."""
RIVAL = SearchLevel(
    radius_px=26.0,
    grid=PoseGrid(turn_ball(22.0, 10.0), np.geomspace(0.69, 1.38, 8), shift_px=12, shift_step_px=3),
    kept_each=3,
    kept=3,
    separation_deg=4.0,
)
"""Search for a nearer pose: 0.38 to 0.76 of the distance of the found one."""
SPREAD_PX = 2
"""Tolerance of the edge positions in the response maps."""


class GuidedInit:
    """Search for one part with one camera around given poses.

    Args:
        views: guide views of the part.
        camera: intrinsics of the frames.
    """

    def __init__(self, views: GuideViewSet, camera: Camera) -> None:
        self.camera = camera
        self._views = views
        self._center_in_model = views.center_in_model
        self._refiner = PoseRefiner(PartView.of(views), camera)
        part, diameter_mm = self._refiner.part.arrays, self._refiner.diameter_mm
        points = {"contour_points": CONTOUR_POINTS, "design_points": DESIGN_POINTS}
        self._near = NearSearch(part, camera, diameter_mm, **points)

    def find(self, image: NDArray[np.uint8], cam_from_model: Array) -> GuidedPose | None:
        """The best pose within 15°, 15 % of the distance and a shift of 15 % of the diameter, whatever its quality.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            cam_from_model: (4,4) mm, where the part should be.

        Returns:
            None where the part would be outside the picture or behind the camera.
        """
        start = cam_from_model @ self._refiner.part.model_from_body
        if start[2, 3] <= 0:
            return None
        near = self._search(image, start, [start], COARSE)
        return self._best(image, [start, *self._search(image, start, near, FINE)])

    def lock(self, image: NDArray[np.uint8], cam_from_model: Array, min_quality: float) -> GuidedPose | None:
        """The pose of the part if it is certainly near the given one, else None.

        A pose must be good enough, near enough, and its score must be the higher the plainer
        the view is. Nor may a plain part be a figure on itself: print on a box can look like a smaller box, and then a
        nearer pose around it fits as well. Most pictures without the part are rejected after the first round.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            cam_from_model: (4,4) mm, where the part should be.
            min_quality: quality needed.
        """
        start = cam_from_model @ self._refiner.part.model_from_body
        near = self._search(image, start, [start], COARSE, MIN_COARSE)
        found = self._best(image, self._search(image, start, near, FINE, MIN_FINE))
        if found is None or found.quality < min_quality or not self.is_near(found.cam_from_model, cam_from_model):
            return None
        lines = view_lines(self._views.nearest(found.cam_from_model), self._views.diameter_mm)
        plainness = max(1.0 - lines / (2.0 * PLAIN_LINES), 0.0)
        if found.evidence.score - PLAIN_PENALTY * plainness < MIN_SCORE:
            return None
        return None if lines < PLAIN_LINES and self._has_rival(image, found) else found

    def is_near(self, cam_from_model: Array, guide_cam_from_model: Array) -> bool:
        """Whether a pose (4,4) is within the limits around a given one (4,4)."""
        center = apply(cam_from_model, self._center_in_model)
        wanted = apply(guide_cam_from_model, self._center_in_model)
        if center[2] <= 0:
            return False
        aside_mm = np.linalg.norm(center[:2] / center[2] - wanted[:2] / wanted[2]) * wanted[2]
        return bool(
            np.rad2deg(rotation_angle_rad(cam_from_model, guide_cam_from_model)) <= TURN_LIMIT_DEG
            and abs(np.linalg.norm(center) / np.linalg.norm(wanted) - 1.0) <= DISTANCE_LIMIT
            and aside_mm <= OFFSET_LIMIT * self._refiner.diameter_mm
        )

    def _has_rival(self, image: NDArray[np.uint8], found: GuidedPose) -> bool:
        """Whether a much nearer pose of the same outline fits about as well."""
        pose = found.cam_from_model @ self._refiner.part.model_from_body
        nearer = pose.copy()
        nearer[:3, 3] *= RIVAL_DISTANCE
        starts = self._search(image, nearer, self._search(image, nearer, [nearer], RIVAL), FINE)
        rival = self._best(image, starts)
        if rival is None or rival.evidence.score < RIVAL_SCORE_SHARE * found.evidence.score:
            return False
        center = apply(rival.cam_from_model, self._center_in_model)
        return bool(np.linalg.norm(center) < MAX_RIVAL_DISTANCE * np.linalg.norm(pose[:3, 3]))

    def _search(
        self, image: NDArray[np.uint8], around: Array, starts: list[Array], level: SearchLevel, min_score: float = 0.0
    ) -> list[Array]:
        """The best poses ``cam_from_body`` of a level's grid around some starts, best first.

        Args:
            image: (H,W,3) uint8 RGB.
            around: (4,4) pose that gives place and scale of the crop.
            starts: poses (4,4) around which the grid is laid.
            level: the grid.
            min_score: poses of a lower edge score are left out.
        """
        if not starts or around[2, 3] <= 0:
            return []
        radius_px = self._near.radius_px(around)
        scale = min(1.0, level.radius_px / radius_px)
        reach_px = CROP_REACH * radius_px + level.grid.shift_px / scale
        crop = self._near.crop(image, around, reach_px, scale, spread_px=SPREAD_PX, pad_px=level.grid.shift_px)
        if crop is None:
            return []
        found = [
            self._near.select(*crop.grid(start, level.grid), level.separation_deg, level.kept_each) for start in starts
        ]
        scores, poses = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
        scores, poses = self._near.select(scores, poses, level.separation_deg, level.kept)
        return list(poses[scores >= min_score])

    def _best(self, image: NDArray[np.uint8], starts: list[Array]) -> GuidedPose | None:
        """The start (4,4) with the best scores after refinement.

        The first start is refined by near edges alone, too: a wide schedule may leave a pose that is right.
        """
        if not starts:
            return None
        levels = self._levels(image, starts)
        working = levels.working

        def refine(job: tuple[Array, bool]) -> tuple[float, GuidedPose]:
            (pose, is_near), appearance, picture = job, Appearance(), working.picture
            if not is_near:
                pose = working.refiner.refine_fresh(picture.image, picture.smooth, pose, SEARCH_STAGES)
            working.learn_colors(pose, appearance, 1.0)
            pose, _ = levels.refine(pose, LAST_STAGES, appearance, first=-1 if is_near else 0)
            scores = levels.scores(pose, appearance)
            evidence = scores.evidence
            is_inside = evidence.points_in_picture >= MIN_IN_PICTURE
            found = pose @ self._refiner.part.body_from_model
            return scores.mean, GuidedPose(found, evidence, evidence.quality if is_inside else 0.0)

        jobs = [(starts[0], True), *((start, False) for start in starts)]
        return max(pool().map(refine, jobs), key=lambda item: (item[1].quality > 0, item[0]))[1]

    def _levels(self, image: NDArray[np.uint8], starts: list[Array]) -> RefinementPyramid:
        """The picture at the scales of a part at some poses (4,4), the first of which tells how sharp its edges are."""
        levels = RefinementPyramid(self._refiner, image, starts, options=SCALE)
        spread_px = levels.finest.edge_spread_px(starts[0])
        return RefinementPyramid(self._refiner, image, starts, spread_px or 0.0, SCALE)
