"""RefinementPyramid: a frame at the scales at which a part is refined, from the working picture to the finest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.geometry import Array
from arview.refinement.evidence import PoseEvidence
from arview.refinement.modalities.texture import TextureMatches
from arview.refinement.refiner import NO_MATCHES, Appearance, PoseRefiner
from arview.refinement.schedules import LAST_STAGES, Stage
from arview.refinement.working_picture import (
    DEFAULT,
    MARGIN_PX,
    REACH,
    WorkingPicture,
    WorkingScaleOptions,
    gray_of,
    matches_in,
    window_around,
    working_picture,
)

NO_COLORS = Appearance()
"""Colours that are not known."""


class RefinementPyramid:
    """A frame at the scales of one part, made on demand; keep it only as long as the frame.

    Args:
        refiner: of the part, for the camera of the frame.
        image: (H,W,3) uint8 RGB of the frame.
        poses: (4,4) ``cam_from_body`` where the part may be; the last one gives the scales.
        spread_px: standard deviation of the blur of the part's edges, px of the frame; 0 where it is not known.
        options: of the scales.

    Attributes:
        scales: of the pictures, the working picture's first.
    """

    def __init__(
        self,
        refiner: PoseRefiner,
        image: NDArray[np.uint8],
        poses: Sequence[Array],
        spread_px: float = 0.0,
        options: WorkingScaleOptions = DEFAULT,
    ) -> None:
        self.scales = options.scales(refiner.radius_px(poses[-1]), spread_px)
        self._refiner = refiner
        self._image = image
        self._poses = list(poses)
        self._levels: dict[int, PictureRefiner] = {}

    @cached_property
    def gray(self) -> NDArray[np.uint8]:
        """Grey levels (H,W) of the frame."""
        return gray_of(self._image)

    @property
    def working(self) -> PictureRefiner:
        """The working picture, in which a pose is worth the same in every frame."""
        return self.level(0)

    @property
    def finest(self) -> PictureRefiner:
        """The picture in which the part is largest."""
        return self.level(len(self.scales) - 1)

    @property
    def finest_colors(self) -> PictureRefiner:
        """The finest picture that has colours."""
        return self.working if self._refiner.options.use_edge else self.finest

    @property
    def camera(self) -> Camera:
        """Intrinsics of the frame."""
        return self._refiner.camera

    def level(self, number: int) -> PictureRefiner:
        """One of the pictures, the working picture being 0."""
        if number not in self._levels:
            refiner, scale = self._refiner, self.scales[number]
            window = window_around(refiner.camera, self._poses, refiner.diameter_mm, MARGIN_PX / min(scale, 1.0), REACH)
            has_colors = number == 0 or not refiner.options.use_edge
            picture = working_picture(self._image, refiner.camera, scale, window, has_colors, self.gray)
            self._levels[number] = PictureRefiner(refiner, picture)
        return self._levels[number]

    def scores(self, cam_from_body: Array, appearance: Appearance) -> PoseScores:
        """Scores of a pose (4,4) in the working and in the finest picture."""
        evidence = self.working.evidence(cam_from_body, appearance)
        if len(self.scales) == 1:
            return PoseScores(evidence, evidence.score)
        return PoseScores(evidence, self.finest.evidence(cam_from_body, appearance).score)

    def cover(self, poses: Sequence[Array]) -> None:
        """Make all pictures show the part at some other poses (4,4), too."""
        made = self._levels.values()
        if not all(level.shows(pose, self.camera, REACH) for level in made for pose in poses):
            self._poses += poses
            self._levels.clear()

    def refine(
        self,
        cam_from_body: Array,
        stages: tuple[Stage, ...],
        appearance: Appearance,
        matches: TextureMatches | None = None,
        first: int = 0,
        finer_stages: tuple[Stage, ...] = LAST_STAGES,
    ) -> tuple[Array, Array]:
        """Refine a pose in one picture and then in all finer ones.

        Args:
            cam_from_body: (4,4) start.
            stages: schedule in the first picture.
            appearance: colours of part and background.
            matches: texture found, in the pixels of the frame.
            first: number of the first picture; negative ones count from the finest, as in a list.
            finer_stages: schedule in the finer pictures.

        Returns:
            ``cam_from_body`` (4,4), and information (6,6) of the twist on its right.
        """
        information = np.zeros((6, 6))
        start = max(first + len(self.scales), 0) if first < 0 else min(first, len(self.scales) - 1)
        for number in range(start, len(self.scales)):
            level = self.level(number)
            picture = level.picture
            cam_from_body, information = level.refiner.refine(
                picture.image,
                picture.smooth,
                cam_from_body,
                stages if number == start else finer_stages,
                appearance,
                level.matches(matches),
                use_region=picture.has_colors,
            )
        # An enlarged picture holds no more than the frame.
        return cam_from_body, information / max(self.scales[-1], 1.0) ** 2


@dataclass(frozen=True)
class PoseScores:
    """How well a frame supports a pose, in the working and in the finest picture.

    Attributes:
        evidence: evidence of the working picture, which means the same in every frame.
        fine_score: score of the evidence in the finest picture, which tells near poses apart.
    """

    evidence: PoseEvidence
    fine_score: float

    @property
    def mean(self) -> float:
        """Mean of both scores, by which poses of one frame are compared."""
        return 0.5 * (self.evidence.score + self.fine_score)


class PictureRefiner:
    """A refiner with one picture that it works in.

    Args:
        refiner: of the part, for any camera.
        picture: the picture.

    Attributes:
        refiner: refiner for the camera of the picture.
        picture: the picture.
    """

    def __init__(self, refiner: PoseRefiner, picture: WorkingPicture) -> None:
        self.picture = picture
        self.refiner = refiner.with_camera(picture.camera, picture.pitch)

    def matches(self, matches: TextureMatches | None) -> TextureMatches:
        """Texture matches of the frame in the pixels of the picture."""
        return NO_MATCHES if matches is None else matches_in(self.picture, matches)

    def refine_shading(self, cam_from_body: Array, information: Array) -> tuple[Array, Array]:
        """Pose (4,4) and information (6,6), as `PoseRefiner.refine_shading`."""
        stored = self.picture.camera.magnified(self.picture.pitch)
        return self.refiner.with_camera(stored).refine_shading(gray_of(self.picture.image), cam_from_body, information)

    def evidence(self, cam_from_body: Array, appearance: Appearance) -> PoseEvidence:
        """Evidence of the picture for a pose (4,4)."""
        used = appearance if self.picture.has_colors else NO_COLORS
        return self.refiner.evidence(self.picture.image, self.picture.smooth, cam_from_body, used)

    def learn_colors(self, cam_from_body: Array, appearance: Appearance, rate: float) -> None:
        """Blend the colours along the outline at a pose (4,4) into an appearance."""
        colors = self.refiner.color_histograms(self.picture.image, cam_from_body, appearance.bin_of)
        if colors is not None:
            appearance.blend(colors, rate)

    def edge_spread_px(self, cam_from_body: Array) -> float | None:
        """Standard deviation of the blur of the part's edges, px of the frame; None where too few are seen."""
        spread_px = self.refiner.edge_spread_px(self.picture.smooth, cam_from_body)
        return None if spread_px is None else spread_px / self.picture.scale

    def shows(self, cam_from_body: Array, camera: Camera, reach: float) -> bool:
        """Whether the picture shows all of the part at a pose (4,4) that the frame of a camera shows.

        Args:
            cam_from_body: (4,4).
            camera: of the frame.
            reach: half size of the part with its surroundings, in half diameters.
        """
        radius_px = 0.5 * self.refiner.diameter_mm * camera.fx / max(float(cam_from_body[2, 3]), 1.0)
        return self.picture.covers(camera.project(cam_from_body[:3, 3]), reach * radius_px, camera)
