"""Guided initialisation: finds the part near a given pose, quickly enough to be tried on every frame of a video.

The picture around the pose is made small, so that the part always spans the same few pixels. Turns, distances and
shifts within reach are scored there by oriented edges, the best again at a higher resolution, and the best of those
are refined by the tracker and judged by the same evidence as a tracked pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.core.parallel import pool
from arview.detection.features.response_maps import response_maps, score_around
from arview.geometry import Array, apply, are_near, rotation_angle_rad, turn_ball
from arview.guideviews import GuideViewSet
from arview.guideviews.uniqueness import PLAIN_LINES, view_lines
from arview.refinement.evidence import PoseEvidence
from arview.refinement.modalities.edge import smoothed
from arview.refinement.projection import intrinsics_of
from arview.refinement.refiner import PoseRefiner
from arview.refinement.schedules import SEARCH_STAGES
from arview.refinement.view_model import PartView


@dataclass(frozen=True)
class GuidedInitOptions:
    """Options of the snap.

    Attributes:
        turn_limit_deg, distance_limit, offset_limit: a pose found farther than this from the given one is not
            taken for the part; the distance is a share, the offset in diameters of the part. They are wider than
            the search (15°, 15 % and 15 %), because the best pose on its rim may lie just outside.
        min_in_picture: less of the outline inside the picture is not judged.
        min_coarse, min_fine: edge scores of the two rounds below which the part is not there.
        min_score: of a pose less what its view is plain by; right and wrong poses part a little below.
        rival_score_share: a nearer pose around the found one with this share of its score makes
            the found one doubtful.
    """

    turn_limit_deg: float = 20.0
    distance_limit: float = 0.2
    offset_limit: float = 0.2
    min_in_picture: float = 0.4
    rival_score_share: float = 0.8
    min_coarse: float = 0.34
    min_fine: float = 0.4
    min_score: float = 0.6


@dataclass(frozen=True)
class GuidedPose:
    """A pose found near a given one: ``cam_from_model`` (4,4), its evidence and its quality."""

    cam_from_model: Array
    evidence: PoseEvidence
    quality: float


@dataclass(frozen=True)
class SearchLevel:
    """One round of the search.

    Attributes:
        radius_px: half the part's diameter in the small picture.
        turns: (R,3,3); stretches: (D,) factors of the distance: tried around every start.
        shift_px, shift_step_px: in the small picture.
        kept_each, kept: of the best, around one start and in all, apart from each other by ``apart_deg``.
    """

    radius_px: float
    turns: Array
    stretches: Array
    shift_px: int
    shift_step_px: int
    kept_each: int
    kept: int
    apart_deg: float


COARSE = SearchLevel(26.0, turn_ball(16.0, 9.0), np.geomspace(0.85, 1.15, 7), 8, 2, 8, 8, 4.0)
"""15° all around, 15 % of the distance, 15 % of the diameter aside."""
FINE = SearchLevel(80.0, turn_ball(3.6, 2.4), np.linspace(0.97, 1.03, 5), 4, 2, 1, 4, 1.5)
"""Between the poses of the coarse grid."""
RIVAL = SearchLevel(26.0, turn_ball(22.0, 10.0), np.geomspace(0.69, 1.38, 8), 12, 3, 3, 3, 4.0)
"""Around the found pose at RIVAL_DISTANCE: 0.38 to 0.76 of its distance."""
RIVAL_DISTANCE = 0.55
NEARER = 0.85
"""A rival at a larger share of the distance is the same pose."""
SPREAD_PX = 2
PLAIN_SCORE = 0.3
"""What a view without any line of its own takes from a pose's worth."""
CROP_REACH = 1.35
"""Radii around the part's middle that are looked at: it may be nearer than the given pose says."""


class GuidedInit:
    """Search for one part with one camera around given poses.

    Args:
        views: guide views of the part.
        camera: intrinsics of the frames.
        options: see GuidedInitOptions.
    """

    def __init__(self, views: GuideViewSet, camera: Camera, options: GuidedInitOptions | None = None) -> None:
        self.options = options or GuidedInitOptions()
        self.camera = camera
        self._views = views
        self._center_in_model = views.center_in_model
        self._refiner = PoseRefiner(PartView(views), camera)

    def find(self, image: NDArray[np.uint8], cam_from_model: Array) -> GuidedPose | None:
        """The best pose within 15°, 15 % of the distance and 15 % of the diameter aside.

        Its quality says whether it is right; it is returned even when that is low.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            cam_from_model: (4,4) where the part should be, mm.

        Returns:
            None where the part would be outside the picture or behind the camera.
        """
        start = cam_from_model @ self._refiner.part.model_from_body
        if start[2, 3] <= 0:
            return None
        near = self._search(image, start, [start], COARSE)
        return self._best(image, [start, *self._search(image, start, near, FINE)])

    def lock(self, image: NDArray[np.uint8], cam_from_model: Array, min_quality: float) -> GuidedPose | None:
        """The part's pose when it is near the given one beyond doubt, else None.

        A pose must be good, near enough (see `GuidedInitOptions`) and borne out the better the plainer the part looks
        from there. A plain part must not be a figure inside itself either: print on a box may look like a smaller
        box, and then a nearer pose around it fits as well. Most pictures without the part are done with after the
        first round.
        """
        start = cam_from_model @ self._refiner.part.model_from_body
        near = self._search(image, start, [start], COARSE, self.options.min_coarse)
        found = self._best(image, self._search(image, start, near, FINE, self.options.min_fine))
        if found is None or found.quality < min_quality or not self.is_near(found.cam_from_model, cam_from_model):
            return None
        lines = view_lines(self._views.nearest(found.cam_from_model), self._views.diameter_mm)
        plainness = max(1.0 - lines / (2.0 * PLAIN_LINES), 0.0)
        if found.evidence.score - PLAIN_SCORE * plainness < self.options.min_score:
            return None
        return None if lines < PLAIN_LINES and self._has_rival(image, found) else found

    def is_near(self, cam_from_model: Array, guide_cam_from_model: Array) -> bool:
        """Whether a pose is within the limits of `GuidedInitOptions` around a given one."""
        o = self.options
        center = apply(cam_from_model, self._center_in_model)
        wanted = apply(guide_cam_from_model, self._center_in_model)
        if center[2] <= 0:
            return False
        aside_mm = np.linalg.norm(center[:2] / center[2] - wanted[:2] / wanted[2]) * wanted[2]
        return bool(
            np.rad2deg(rotation_angle_rad(cam_from_model, guide_cam_from_model)) <= o.turn_limit_deg
            and abs(np.linalg.norm(center) / np.linalg.norm(wanted) - 1.0) <= o.distance_limit
            and aside_mm <= o.offset_limit * self._refiner.diameter_mm
        )

    def _has_rival(self, image: NDArray[np.uint8], found: GuidedPose) -> bool:
        """Whether a much nearer pose around the found one fits about as well."""
        pose = found.cam_from_model @ self._refiner.part.model_from_body
        nearer = pose.copy()
        nearer[:3, 3] *= RIVAL_DISTANCE
        starts = self._search(image, nearer, self._search(image, nearer, [nearer], RIVAL), FINE)
        rival = self._best(image, starts)
        if rival is None or rival.evidence.score < self.options.rival_score_share * found.evidence.score:
            return False
        center = apply(rival.cam_from_model, self._center_in_model)
        return bool(np.linalg.norm(center) < NEARER * np.linalg.norm(pose[:3, 3]))

    def _search(
        self, image: NDArray[np.uint8], around: Array, starts: list[Array], level: SearchLevel, least: float = 0.0
    ) -> list[Array]:
        """The best poses (``cam_from_body``) of a level's grid around starts, best first.

        ``around`` says where in the picture and at what scale to look; poses that score less than ``least`` are
        left out.
        """
        if not starts or around[2, 3] <= 0:
            return []
        maps = self._maps(image, around, level)
        if maps is None:
            return []

        def search(start: Array) -> list[tuple[float, Array]]:
            scores, poses = score_around(
                maps[0], self._refiner.part.arrays, start, maps[1], 0.01 * self._refiner.diameter_mm,
                level.turns, level.stretches, level.shift_px, level.shift_step_px, 64, 32,
            )  # fmt: skip
            best: list[tuple[float, Array]] = []
            for index in np.argsort(-scores)[:400]:
                if not any(self._same(poses[index], other, level.apart_deg) for _, other in best):
                    best.append((float(scores[index]), poses[index]))
                    if len(best) >= level.kept_each:
                        break
            return best

        found = sorted((item for best in pool().map(search, starts) for item in best), key=lambda item: -item[0])
        apart: list[Array] = []
        for score, pose in found:
            if score < least:
                break
            if not any(self._same(pose, other, level.apart_deg) for other in apart):
                apart.append(pose)
        return apart[: level.kept]

    def _maps(
        self, image: NDArray[np.uint8], cam_from_body: Array, level: SearchLevel
    ) -> tuple[NDArray[np.uint8], Array] | None:
        """Response maps of the picture around a pose, made small, and their intrinsics; None outside the picture."""
        camera = self.camera
        radius_px = self._refiner.radius_px(cam_from_body)
        scale = min(1.0, level.radius_px / radius_px)
        reach_px = CROP_REACH * radius_px + level.shift_px / scale
        center = camera.project(cam_from_body[:3, 3])
        size = np.array([camera.width, camera.height])
        first = np.clip(np.floor(center - reach_px), 0, size).astype(int)
        last = np.clip(np.ceil(center + reach_px) + 1, 0, size).astype(int)
        small = np.round((last - first) * scale).astype(int)
        if small.min() < 16:
            return None
        part = np.ascontiguousarray(image[first[1] : last[1], first[0] : last[0]])
        part = np.asarray(cv2.resize(part, (int(small[0]), int(small[1])), interpolation=cv2.INTER_AREA))
        pad = level.shift_px
        intrinsics = intrinsics_of(camera.cropped(*first.tolist(), *(last - first).tolist()).scaled(*small.tolist()))
        intrinsics[2:4] += pad
        return response_maps(part, SPREAD_PX, pad), intrinsics

    def _best(self, image: NDArray[np.uint8], starts: list[Array]) -> GuidedPose | None:
        """The start that is worth most after refinement."""
        if not starts:
            return None
        gray = smoothed(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))

        def refine(start: Array) -> GuidedPose:
            pose = self._refiner.refine_fresh(image, gray, start, SEARCH_STAGES)
            look = self._refiner.appearance_at(image, pose)
            evidence = self._refiner.evidence(image, gray, pose, look)
            is_inside = evidence.points_in_picture >= self.options.min_in_picture
            quality = evidence.quality if is_inside else 0.0
            return GuidedPose(pose @ self._refiner.part.body_from_model, evidence, quality)

        return max(pool().map(refine, starts), key=lambda item: (item.quality > 0, item.evidence.score))

    def _same(self, a: Array, b: Array, angle_deg: float) -> bool:
        return are_near(a, b, 0.01 * angle_deg * self._refiner.diameter_mm, angle_deg)
