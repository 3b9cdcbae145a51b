"""PictureRefiner: refinement and evidence of poses in one working picture."""

from __future__ import annotations

import cv2
import numpy as np

from arview.camera import Camera
from arview.geometry import Array
from arview.refinement.evidence import PoseEvidence
from arview.refinement.modalities.texture import TextureMatches
from arview.refinement.refiner import NO_MATCHES, Appearance, PoseRefiner
from arview.refinement.working_picture import WorkingPicture, matches_in


class PictureRefiner:
    """A refiner with the picture that it works in.

    Args:
        refiner: of the part, for any camera.
        picture: the working picture.

    Attributes:
        refiner: refiner for the camera of the picture.
        picture: the working picture.
    """

    def __init__(self, refiner: PoseRefiner, picture: WorkingPicture) -> None:
        self.picture = picture
        self.refiner = refiner.with_camera(picture.camera)

    @property
    def scale(self) -> float:
        """Scale of the picture relative to the frame."""
        return self.picture.scale

    def matches(self, matches: TextureMatches | None) -> TextureMatches:
        """Texture matches of the frame in the pixels of the picture."""
        return NO_MATCHES if matches is None else matches_in(self.picture, matches)

    def refine_shading(self, cam_from_body: Array, information: Array) -> tuple[Array, Array]:
        """Pose (4,4) and information (6,6), as `PoseRefiner.refine_shading`."""
        gray = np.asarray(cv2.cvtColor(self.picture.image, cv2.COLOR_RGB2GRAY))
        return self.refiner.refine_shading(gray, cam_from_body, information)

    def evidence(self, cam_from_body: Array, appearance: Appearance) -> PoseEvidence:
        """Evidence of the picture for a pose (4,4)."""
        return self.refiner.evidence(self.picture.image, self.picture.smooth, cam_from_body, appearance)

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
