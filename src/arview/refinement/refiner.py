"""PoseRefiner: from a rough pose of the part to the pose, in one picture.

Every iteration projects the points of the nearest guide view, measures with each modality, adds all measurements to
one 6×6 system that is damped towards the start, and updates the pose (Gauss-Newton). Scales and reach shrink from
stage to stage. Nothing is kept between calls, so threads may share a refiner.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.geometry import Array
from arview.guideviews.mesh_edges import EDGE_CONTOUR, EDGE_SHARP
from arview.refinement.evidence import EdgeSteps, PoseEvidence
from arview.refinement.kernels import count_colours, run_edge_steps, run_evidence, run_stages
from arview.refinement.modalities.region import BINS, EDGE_FUNCTION, log_odds, value_bins
from arview.refinement.modalities.shading import GAIN, look_at, shade
from arview.refinement.modalities.texture import TextureMatches
from arview.refinement.projection import intrinsics_of
from arview.refinement.schedules import Stage
from arview.refinement.view_model import PartView

NO_MATCHES = TextureMatches(np.empty((0, 3)), np.empty((0, 2)), np.empty(0), 0)
"""Matches of a frame in which texture is not used."""


@dataclass(frozen=True)
class RefinerOptions:
    """Options of the refinement.

    Attributes:
        use_region: measure the colours along the outline.
        use_edge: measure grey-level steps at outline and design edges.
        region_weight: trust in colours against edges; neighbours along an outline are not independent.
        edge_weight: trust in edges.
        edge_sigma_px: standard deviation of a correct step from the CAD's edge.
        edge_threshold: weakest step used, in grey levels over two pixels.
        feature_sigma_px: standard deviation of a matched texture patch from its place.
        rotation_sigma_rad: expected rotation error of a start.
        translation_sigma: expected translation error of a start, in diameters.
        min_inner_share: share of design edges inside the outline below which colours get more weight.
        plain_region_gain: extra weight of colours, relative to `region_weight`, for a part without any inner edge.
        min_histogram_count: pixels on either side of the outline from which colours are learned.
        size_unit_px: half diameter in the picture for which the stages are made; larger ones widen them.
    """

    use_region: bool = True
    use_edge: bool = True
    region_weight: float = 0.5
    edge_weight: float = 1.0
    edge_sigma_px: float = 0.7
    edge_threshold: float = 3.0
    feature_sigma_px: float = 0.5
    rotation_sigma_rad: float = 0.3
    translation_sigma: float = 0.3
    min_inner_share: float = 0.3
    plain_region_gain: float = 6.0
    min_histogram_count: int = 50
    size_unit_px: float = 80.0


@dataclass
class Appearance:
    """Colour model of part and background: histograms along the outline and their log odds.

    Attributes:
        fore, back: (BINS³,) normalised histograms of part and background.
        odds: (BINS³,) log odds of part against background.
        bin_of: (256,) histogram bin of a channel value, which takes a change of exposure out.
        is_known: whether any colours have been learned.
    """

    fore: Array = field(default_factory=lambda: np.zeros(BINS**3))
    back: Array = field(default_factory=lambda: np.zeros(BINS**3))
    odds: Array = field(default_factory=lambda: np.zeros(BINS**3))
    bin_of: NDArray[np.int64] = field(default_factory=lambda: value_bins(1.0))
    is_known: bool = False

    def blend(self, colours: tuple[Array, Array], rate: float) -> None:
        """Move the histograms towards those of a frame by a share; the first ones are taken as they are."""
        share = rate if self.is_known else 1.0
        self.fore += share * (colours[0] - self.fore)
        self.back += share * (colours[1] - self.back)
        self.is_known = True
        log_odds(self.fore, self.back, self.odds)


@lru_cache(maxsize=64)
def _stage_table(stages: tuple[Stage, ...]) -> Array:
    return np.array([stage.row() for stage in stages], dtype=np.float64)


class PoseRefiner:
    """Refinement of rough poses of one part with one camera.

    Args:
        part: of the guide views.
        camera: intrinsics of the pictures.
        options: see `RefinerOptions`.
    """

    def __init__(self, part: PartView, camera: Camera, options: RefinerOptions | None = None) -> None:
        self.part = part
        self.camera = camera
        self.options = options or RefinerOptions()
        self.diameter_mm = part.views.diameter_mm
        self.intrinsics = intrinsics_of(camera)
        self._step_mm = 0.01 * self.diameter_mm
        o = self.options
        kinds = np.asarray(part.views.arrays["edge_kinds"])
        outline = int(np.count_nonzero(kinds & EDGE_CONTOUR))
        inner = int(np.count_nonzero(((kinds & EDGE_CONTOUR) == 0) & ((kinds & EDGE_SHARP) > 0)))
        inner_share = inner / max(outline + inner, 1)
        # Parts without design edges inside their outline depend more on colours.
        plainness = max(0.0, 1.0 - inner_share / o.min_inner_share)
        self._region_weight = o.region_weight * (1.0 + o.plain_region_gain * plainness)
        self._damping = np.concatenate(
            [
                np.full(3, 1.0 / o.rotation_sigma_rad**2),
                np.full(3, 1.0 / (o.translation_sigma * self.diameter_mm) ** 2),
            ]
        )

    def with_camera(self, camera: Camera) -> PoseRefiner:
        """The same refiner for pictures of another camera, such as the one of a window."""
        other = copy.copy(self)
        other.camera, other.intrinsics = camera, intrinsics_of(camera)
        return other

    def radius_px(self, cam_from_body: Array) -> float:
        """Half the part's diameter in the picture, at a pose (4,4)."""
        return 0.5 * self.diameter_mm * self.camera.fx / max(float(cam_from_body[2, 3]), 1.0)

    def color_histograms(
        self, image: NDArray[np.uint8], cam_from_body: Array, bin_of: NDArray[np.int64]
    ) -> tuple[Array, Array] | None:
        """Normalised histograms (part, background) along the outline at a pose; None where the outline is too short."""
        fore, back = np.zeros(BINS**3), np.zeros(BINS**3)
        count_colours(image, bin_of, self.part.arrays, cam_from_body, self.intrinsics, self._step_mm, fore, back)
        fore_count, back_count = fore.sum(), back.sum()
        if min(fore_count, back_count) < self.options.min_histogram_count:
            return None
        return fore / fore_count, back / back_count

    def appearance_at(self, image: NDArray[np.uint8], cam_from_body: Array) -> Appearance:
        """The colours along the outline at a pose, learned from this picture alone."""
        appearance = Appearance()
        colours = self.color_histograms(image, cam_from_body, appearance.bin_of)
        if colours is not None:
            appearance.blend(colours, 1.0)
        return appearance

    def refine(
        self,
        image: NDArray[np.uint8],
        gray: NDArray[np.uint8],
        cam_from_body: Array,
        stages: tuple[Stage, ...],
        appearance: Appearance,
        matches: TextureMatches = NO_MATCHES,
    ) -> tuple[Array, Array]:
        """Pose and information after the given stages.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            gray: (H,W) smoothed, see `smoothed`.
            cam_from_body: (4,4) start, about the part's centre.
            stages: see `schedules`.
            appearance: colours that tell the part from its background.
            matches: texture of the part found in this frame, measured once for all stages.

        Returns:
            ``cam_from_body`` (4,4) and information (6,6) of the twist (rad, mm) on its right.
        """
        o = self.options
        pose, information = run_stages(
            image, gray, appearance.bin_of, appearance.odds, EDGE_FUNCTION, self.part.arrays, cam_from_body,
            self.intrinsics, self._step_mm, _stage_table(stages), self._damping,
            self._region_weight if o.use_region and appearance.is_known else 0.0,
            o.edge_weight if o.use_edge else 0.0, o.edge_sigma_px, o.edge_threshold,
            matches.points_in_body, matches.pixels, matches.weights, o.feature_sigma_px,
        )  # fmt: skip
        return pose, information

    def refine_fresh(
        self, image: NDArray[np.uint8], gray: NDArray[np.uint8], cam_from_body: Array, stages: tuple[Stage, ...]
    ) -> Array:
        """Refine a pose of unknown quality (4,4): colours are learned anew before every stage."""
        unit = max(1.0, self.radius_px(cam_from_body) / self.options.size_unit_px)
        for stage in stages:
            appearance = self.appearance_at(image, cam_from_body)
            cam_from_body, _ = self.refine(image, gray, cam_from_body, (stage.widened(unit),), appearance)
        return cam_from_body

    def refine_shading(self, gray: NDArray[np.uint8], cam_from_body: Array, information: Array) -> tuple[Array, Array]:
        """Pose and information after the surface's shading under an unknown light is used too, see `shading`.

        Args:
            gray: (H,W), not smoothed.
            cam_from_body: (4,4), the best by outline and edges.
            information: (6,6) of outline and edges.
        """
        look = look_at(gray, self.camera, self.diameter_mm, cam_from_body)
        if look is None:
            return cam_from_body, information
        pose, more, _ = shade(
            *look, self.part.surface, self.part.corner_normals, self.diameter_mm, cam_from_body, information, GAIN
        )
        return pose, more

    def evidence(
        self,
        image: NDArray[np.uint8],
        gray: NDArray[np.uint8],
        cam_from_body: Array,
        appearance: Appearance,
        tolerance_px: float = 1.5,
    ) -> PoseEvidence:
        """How well the picture supports a pose (4,4); steps count within a tolerance."""
        return PoseEvidence(
            *run_evidence(
                image, gray, appearance.bin_of, appearance.odds, appearance.is_known, EDGE_FUNCTION,
                self.part.arrays, cam_from_body, self.intrinsics, self._step_mm, self.options.edge_threshold,
                tolerance_px,
            )
        )  # fmt: skip

    def edge_steps(self, gray: NDArray[np.uint8], cam_from_body: Array, tolerance_px: float = 1.5) -> EdgeSteps:
        """The part's edges at a pose (4,4), and how far the picture supports each."""
        return EdgeSteps(
            *run_edge_steps(
                gray, self.part.arrays, cam_from_body, self.intrinsics, self._step_mm, self.options.edge_threshold,
                tolerance_px,
            )
        )  # fmt: skip
