"""PoseRefiner: refines a rough pose of the part in one picture.

Every stage projects the points of the nearest guide view and measures with each modality. Every update adds all
measurements to one damped 6×6 system and solves it for a step of the pose (Gauss-Newton). Scales and reach shrink from
stage to stage. Nothing is kept between calls, so threads may share a refiner.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.geometry import Array
from arview.refinement.edge_spread import edge_spread
from arview.refinement.evidence import EdgeSteps, PoseEvidence
from arview.refinement.kernels import (
    MIN_HISTOGRAM_COUNT,
    STEP_SHARE,
    ModalityWeights,
    count_colors,
    learn_odds,
    run_edge_steps,
    run_evidence,
    run_fresh,
    run_stages,
)
from arview.refinement.modalities.region import BINS, EDGE_FUNCTION, ColorModel, log_odds, value_bins
from arview.refinement.modalities.shading import ShadingOptions, crop_for_shading, refine_by_shading
from arview.refinement.modalities.texture import TextureMatches
from arview.refinement.projection import intrinsics_of
from arview.refinement.schedules import Stage, stage_table
from arview.refinement.view_model import PartView
from arview.rendering import EDGE_CONTOUR, EDGE_SHARP

NO_MATCHES = TextureMatches(np.empty((0, 3)), np.empty((0, 2)), np.empty(0), 0)
"""Matches of a frame in which texture is not used."""


REGION_WEIGHT = 0.5
"""Weight of colours; below 1, because neighbouring lines across the outline are correlated."""
EDGE_WEIGHT = 1.0
"""Weight of edges."""
EDGE_SIGMA_PX = 0.7
"""Standard deviation of a correct step from the edge of the CAD."""
EDGE_THRESHOLD = 3.0
"""Weakest step used, in grey levels over two pixels."""
TEXTURE_SIGMA_PX = 0.9
"""Standard deviation of a matched texture patch from its true position, including a share of the error of the pose at
which it was learned."""
ROTATION_SIGMA_RAD = 0.3
"""Expected rotation error of a start, which sets the damping."""
TRANSLATION_SIGMA = 0.3
"""Expected translation error of a start, in diameters, which sets the damping."""
MIN_INNER_SHARE = 0.3
"""Share of design edges inside the outline below which colours get more weight."""
PLAIN_REGION_GAIN = 6.0
"""Extra weight of colours, as a multiple of ``REGION_WEIGHT``, for a part without inner edges."""
SIZE_UNIT_PX = 80.0
"""Half diameter in the picture for which the stages are made; a larger part widens them."""


@dataclass(frozen=True)
class RefinerOptions:
    """Options of the refinement.

    Attributes:
        use_region: use the colours along the outline.
        use_edge: use grey-level steps at outline and design edges.
        shading: options of the shading modality.
    """

    use_region: bool = True
    use_edge: bool = True
    shading: ShadingOptions = field(default_factory=ShadingOptions)


PLAIN_BINS = value_bins(1.0)
"""Bins of channel values in a picture as bright as the learned colours."""


@dataclass
class Appearance:
    """Colours of part and background: histograms along the outline and their log odds.

    Attributes:
        fore, back: (BINS³,) normalised histograms of part and background.
        odds: (BINS³,) log odds of part against background.
        bin_of: (256,) histogram bin of a channel value, which takes a change of exposure out.
        is_known: whether any colours have been learned.
    """

    fore: Array = field(default_factory=lambda: np.zeros(BINS**3))
    back: Array = field(default_factory=lambda: np.zeros(BINS**3))
    odds: Array = field(default_factory=lambda: np.zeros(BINS**3))
    bin_of: NDArray[np.int64] = field(default_factory=lambda: PLAIN_BINS)
    is_known: bool = False

    @property
    def colors(self) -> ColorModel:
        """The colours in the form of the kernels."""
        return ColorModel(self.bin_of, self.odds, EDGE_FUNCTION)

    def blend(self, colors: tuple[Array, Array], rate: float) -> None:
        """Move the histograms towards those of a frame (part, background) by a share; the first are copied."""
        share = rate if self.is_known else 1.0
        self.fore += share * (colors[0] - self.fore)
        self.back += share * (colors[1] - self.back)
        self.is_known = True
        log_odds(self.fore, self.back, self.odds)


class PoseRefiner:
    """Refinement of rough poses of one part for one camera.

    Args:
        part: the part in the form of the kernels.
        camera: intrinsics of the pictures.
        options: see `RefinerOptions`.
    """

    def __init__(self, part: PartView, camera: Camera, options: RefinerOptions | None = None) -> None:
        self.part = part
        self.camera = camera
        o = self.options = options or RefinerOptions()
        self.diameter_mm = part.views.diameter_mm
        self.intrinsics = intrinsics_of(camera)
        self._step_mm = STEP_SHARE * self.diameter_mm
        kinds = np.asarray(part.views.arrays["edge_kinds"])
        outline = int(np.count_nonzero(kinds & EDGE_CONTOUR))
        inner = int(np.count_nonzero(((kinds & EDGE_CONTOUR) == 0) & ((kinds & EDGE_SHARP) > 0)))
        inner_share = inner / max(outline + inner, 1)
        # Colours count more for a part with few design edges inside its outline.
        plainness = max(0.0, 1.0 - inner_share / MIN_INNER_SHARE)
        region_weight = REGION_WEIGHT * (1.0 + PLAIN_REGION_GAIN * plainness)
        self._weights = ModalityWeights(
            region=region_weight if o.use_region else 0.0,
            edge=EDGE_WEIGHT if o.use_edge else 0.0,
            edge_sigma_px=EDGE_SIGMA_PX,
            edge_threshold=EDGE_THRESHOLD,
            texture_sigma_px=TEXTURE_SIGMA_PX,
        )
        self._weights_without_color = self._weights._replace(region=0.0)
        self._damping = np.concatenate(
            [
                np.full(3, 1.0 / ROTATION_SIGMA_RAD**2),
                np.full(3, 1.0 / (TRANSLATION_SIGMA * self.diameter_mm) ** 2),
            ]
        )

    def by_colors(self) -> PoseRefiner:
        """The same refiner without edges, as long as colours are known."""
        other = copy.copy(self)
        other.options, other._weights = replace(self.options, use_edge=False), self._weights._replace(edge=0.0)
        return other

    def with_camera(self, camera: Camera, pitch: float = 1.0) -> PoseRefiner:
        """The same refiner for pictures of another camera, such as crops; for its pitch see `intrinsics_of`."""
        other = object.__new__(PoseRefiner)
        other.__dict__.update(self.__dict__, camera=camera, intrinsics=intrinsics_of(camera, pitch))
        return other

    def radius_px(self, cam_from_body: Array) -> float:
        """Half the part's diameter in the picture at a pose (4,4), px."""
        return 0.5 * self.diameter_mm * self.camera.fx / max(float(cam_from_body[2, 3]), 1.0)

    def color_histograms(
        self, image: NDArray[np.uint8], cam_from_body: Array, bin_of: NDArray[np.int64]
    ) -> tuple[Array, Array] | None:
        """Normalised histograms (part, background) along the outline at a pose; None for too few pixels."""
        fore, back = np.zeros(BINS**3), np.zeros(BINS**3)
        count_colors(image, bin_of, self.part.arrays, cam_from_body, self.intrinsics, self._step_mm, fore, back)
        fore_count, back_count = fore.sum(), back.sum()
        if min(fore_count, back_count) < MIN_HISTOGRAM_COUNT:
            return None
        return fore / fore_count, back / back_count

    def appearance_at(self, image: NDArray[np.uint8], cam_from_body: Array) -> Appearance:
        """Colours along the outline at a pose (4,4), of this picture only: their odds, which are not to be blended."""
        found = Appearance()
        part, colors = self.part.arrays, found.colors
        found.is_known = learn_odds(image, colors, part, cam_from_body, self.intrinsics, self._step_mm)
        return found

    def refine(
        self,
        image: NDArray[np.uint8],
        gray: NDArray[np.uint8],
        cam_from_body: Array,
        stages: tuple[Stage, ...],
        appearance: Appearance,
        matches: TextureMatches = NO_MATCHES,
        use_region: bool = True,
    ) -> tuple[Array, Array]:
        """Refine a pose through some stages.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            gray: (H,W) uint8, smoothed by `smoothed`.
            cam_from_body: (4,4) start, about the part's centre.
            stages: see `schedules`.
            appearance: colours of part and background.
            matches: texture of the part found in this frame, the same for all stages.
            use_region: use the colours, if they are known.

        Returns:
            ``cam_from_body`` (4,4) and information (6,6) of the twist (rad, mm) on its right.
        """
        weights = self._weights if use_region and appearance.is_known else self._weights_without_color
        pose, information = run_stages(
            image,
            gray,
            appearance.colors,
            self.part.arrays,
            cam_from_body,
            self.intrinsics,
            self._step_mm,
            stage_table(stages),
            self._damping,
            weights,
            matches,
        )
        return pose, information

    def refine_fresh(
        self, image: NDArray[np.uint8], gray: NDArray[np.uint8], cam_from_body: Array, stages: tuple[Stage, ...]
    ) -> Array:
        """Refine a pose (4,4) of unknown quality: colours are learned anew before every stage, without any memory."""
        unit = max(1.0, self.radius_px(cam_from_body) / SIZE_UNIT_PX)
        table = stage_table(tuple(stage.widened(unit) for stage in stages))
        return np.asarray(
            run_fresh(
                image,
                gray,
                Appearance().colors,
                self.part.arrays,
                cam_from_body,
                self.intrinsics,
                self._step_mm,
                table,
                self._damping,
                self._weights,
                NO_MATCHES,
            )
        )

    def refine_shading(self, gray: NDArray[np.uint8], cam_from_body: Array, information: Array) -> tuple[Array, Array]:
        """Refine a pose by the shading of the surface under an unknown light, see `shading`.

        Args:
            gray: (H,W) uint8, not smoothed.
            cam_from_body: (4,4) the best pose by outline and edges.
            information: (6,6) of that pose.

        Returns:
            ``cam_from_body`` (4,4) and information (6,6), unchanged where the part is not in the picture.
        """
        o = self.options.shading
        crop = crop_for_shading(gray, self.camera, self.diameter_mm, cam_from_body)
        if crop is None:
            return cam_from_body, information
        part = self.part
        refined = refine_by_shading(
            crop, part.surface, part.corner_normals, self.diameter_mm, cam_from_body, information, o.gain, o.rounds
        )
        return refined.cam_from_body, refined.information

    def evidence(
        self,
        image: NDArray[np.uint8],
        gray: NDArray[np.uint8],
        cam_from_body: Array,
        appearance: Appearance,
        tolerance_px: float = 1.5,
    ) -> PoseEvidence:
        """Evidence of the picture for a pose (4,4); steps farther from an edge than the tolerance do not support it."""
        terms = run_evidence(
            image,
            gray,
            appearance.colors,
            appearance.is_known,
            self.part.arrays,
            cam_from_body,
            self.intrinsics,
            self._step_mm,
            EDGE_THRESHOLD,
            tolerance_px,
        )
        return PoseEvidence(*terms)

    def edge_spread_px(self, gray: NDArray[np.uint8], cam_from_body: Array) -> float | None:
        """Standard deviation of the blur of the part's edges at a pose (4,4); None where too few are seen."""
        spread_px = edge_spread(gray, self.part.arrays, cam_from_body, self.intrinsics, self._step_mm)
        return None if spread_px < 0 else spread_px

    def edge_steps(self, gray: NDArray[np.uint8], cam_from_body: Array, tolerance_px: float = 1.5) -> EdgeSteps:
        """Outline and design edges at a pose (4,4), and the support of the picture for each of their points."""
        return EdgeSteps(
            *run_edge_steps(
                gray,
                self.part.arrays,
                cam_from_body,
                self.intrinsics,
                self._step_mm,
                EDGE_THRESHOLD,
                tolerance_px,
            )
        )
