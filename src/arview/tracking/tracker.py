"""Tracker: refines the pose of a part from frame to frame on guide views, without rendering.

Every iteration projects the nearest guide view's points, measures with each modality, adds all to one 6×6 system
with a damping towards the prediction, and updates the pose; scales shrink from iteration to iteration.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.cad.model import Model
from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array, invert, rigid, rotation_angle_rad
from arview.guideviews import GuideViewSet
from arview.guideviews.mesh_edges import EDGE_CONTOUR, EDGE_SHARP
from arview.tracking.ambiguity import EdgeSteps
from arview.tracking.crowding import is_crowded
from arview.tracking.feature import FeatureModality, Matches
from arview.tracking.nonlocal_search import NonlocalSearch
from arview.tracking.patch import Pyramid
from arview.tracking.quality import Evidence, quality_of
from arview.tracking.refine import count_colours, median_brightness_ratio, run_edge_steps, run_evidence, run_stages
from arview.tracking.region import BINS, EDGE_FUNCTION, log_odds, value_bins
from arview.tracking.shading import GAIN, LEAST_CURVED, corner_normals, curved_share, look_at, shade
from arview.tracking.solver import apply_twist, relative_twist

if TYPE_CHECKING:
    from arview.tracking.second_look import SecondLook


@dataclass(frozen=True)
class Stage:
    """One iteration of the solver: scales and reach of the modalities."""

    region_scale: int
    edge_reach: int
    edge_step_px: float
    edge_spread_px: float
    updates: int = 2
    region_gain: float = 1.0
    stride: int = 1

    def row(self) -> tuple[float, ...]:
        """As `run_stages` takes it."""
        return (
            self.region_scale,
            self.edge_reach,
            self.edge_step_px,
            self.edge_spread_px,
            self.updates,
            self.region_gain,
            self.stride,
        )

    def widened(self, factor: float) -> Stage:
        """The same stage for a part that is larger in the picture; fine stages stay fine."""
        if self.region_scale <= 1 or factor == 1.0:
            return self
        return replace(
            self,
            region_scale=round(self.region_scale * factor),
            edge_step_px=self.edge_step_px * factor,
            edge_spread_px=self.edge_spread_px * factor,
        )


TRACK_STAGES = (
    Stage(4, 12, 1.0, 5.0, 2, 0.5, 2),
    Stage(2, 8, 1.0, 3.0, 2, 0.2, 2),
    Stage(1, 6, 1.0, 1.5, 2, 0.1),
    Stage(1, 5, 1.0, 1.0, 2, 0.1),
)
"""Coarse to fine for the usual frame. Colours help to find the outline, the edges say where it is."""
NEAR_STAGES = (
    Stage(2, 12, 1.5, 3.0, 2, 0.0),
    Stage(2, 10, 1.0, 2.5, 2, 0.0),
    Stage(1, 8, 1.0, 2.0, 2, 0.0),
    Stage(1, 6, 1.0, 1.5, 2, 0.0),
    Stage(1, 5, 1.0, 1.0, 2, 0.0),
)
"""Edges nearby alone: colours mislead where something hides a part of the outline, or looks like the part."""
SETTLING_STAGES = (
    Stage(2, 12, 1.5, 5.0, 2),
    Stage(2, 10, 1.0, 4.0, 2),
    Stage(1, 8, 1.0, 2.5, 2),
    Stage(1, 6, 1.0, 1.5, 2),
    Stage(1, 5, 1.0, 1.0, 2),
)
"""Edges and colours, for a pose that a search found, some pixels off."""
PLAIN_SHARE = 0.05
"""With fewer design edges than this the outline alone turns with the light: colours are needed."""
LAST_STAGES = 2 * TRACK_STAGES[2:]
"""For a pose that is nearly right: coarse stages can lead away from it, into an edge beside the outline."""


def _colour_led(gain: float) -> tuple[Stage, ...]:
    return (
        Stage(6, 12, 2.0, 8.0, 2, gain, 2),
        Stage(4, 12, 1.0, 5.0, 2, gain, 2),
        Stage(2, 8, 1.0, 3.0, 2, gain, 2),
    )


FAR_STAGES = (
    _colour_led(5.0) + TRACK_STAGES,
    (
        Stage(6, 12, 2.0, 10.0, 2, 1.0, 2),
        Stage(4, 12, 2.0, 7.0, 2, 1.0, 2),
        Stage(4, 12, 1.5, 5.0, 2, 1.0, 2),
        Stage(3, 10, 1.0, 3.5, 2, 1.0, 2),
        *TRACK_STAGES,
    ),
    _colour_led(20.0) + NEAR_STAGES,
)
"""For a part that moved far: the usual stages take the next of many parallel edges for the right one, the outline as
colours show it leads past them. Of 720 pairs of semi-synthetic frames one or two steps apart, without a prediction,
the usual ones and those nearby bring 362 within 5 cm and 5°, with these 591."""

IN_PICTURE_SHARE = 0.9
"""With less of the outline in the picture no texture is remembered."""
STRANGE_TURN_RAD = 0.785
"""A turn away from the prediction that is as strange as a way of STRANGE_WAY diameters aside."""
STRANGE_WAY = 0.35
STRANGE_WORTH = 0.15
"""What a pose must be worth more for each such way from the prediction: turned parts often look alike."""
CLEARLY_MORE = 0.02
"""A pose found far off is worth so much more than that of the usual stages, or is not taken."""


@dataclass(frozen=True)
class TrackerOptions:
    """Options of the tracker.

    Attributes:
        use_region, use_edge, use_feature, use_shading: modalities to use; the last two beside one of the first.
        region_weight, edge_weight: relative trust; neighbours along an outline are not independent.
        edge_sigma_px: how far a good step lies from the CAD's edge.
        edge_threshold: weakest step in grey levels over two pixels.
        feature_sigma_px: how far a matched piece of texture lies from its place.
        feature_min_count, feature_min_share: fewer matches, or a smaller share of those tried, are not believed.
        learning_rate: how quickly colour histograms follow the picture.
        correlated_points: how many neighbouring edge points err together.
        doubtful_quality: below it the part is searched for around the prediction and colours are not learned.
        other_ways_share: other stages are tried, too, where a pose is worth less than this share of the usual.
        far_share: so are those for a part that moved far, where the others leave it worth less than this share.
        usual_share: it is searched for, too, where a pose is worth less than this share of the usual.
        surprise_share, surprise: the same for poses off the prediction, from such a `strangeness` on (about 6°).
        second_look: from such a `strangeness` on (about 3°) the `SecondLook` is taken, if there is one.
        rotation_sigma_rad, translation_sigma: expected error of the prediction, the latter in diameters.
    """

    use_region: bool = True
    use_edge: bool = True
    use_feature: bool = True
    use_shading: bool = True
    region_weight: float = 0.5
    edge_weight: float = 1.0
    edge_sigma_px: float = 0.7
    edge_threshold: float = 3.0
    feature_sigma_px: float = 0.5
    feature_min_count: int = 12
    feature_min_share: float = 0.4
    learning_rate: float = 0.2
    rotation_sigma_rad: float = 0.3
    translation_sigma: float = 0.3
    stages: tuple[Stage, ...] = TRACK_STAGES
    doubtful_quality: float = 0.4
    other_ways_share: float = 0.97
    far_share: float = 0.9
    usual_share: float = 0.8
    surprise_share: float = 0.95
    surprise: float = 0.02
    second_look: float = 0.005
    correlated_points: float = 8.0

    def __post_init__(self) -> None:
        if not (self.use_region or self.use_edge or self.use_feature):
            raise InputError("tracker: at least one modality must be on")


@dataclass
class Appearance:
    """Colours of part and background, learned while tracking."""

    fore: Array = field(default_factory=lambda: np.zeros(BINS**3))
    back: Array = field(default_factory=lambda: np.zeros(BINS**3))
    odds: Array = field(default_factory=lambda: np.zeros(BINS**3))
    is_known: bool = False


@dataclass(frozen=True)
class Estimate:
    """Result of one frame: ``cam_from_model`` (4,4), information (6,6) about the model's centre, quality, evidence."""

    cam_from_model: Array
    information: Array
    quality: float
    evidence: Evidence


class PartView:
    """A guide-view set as the kernels need it: flat float32 arrays about the model's centre.

    ``arrays`` holds directions (N,3), contour starts (N+1), points, normals, runs, edge starts (N+1), points,
    tangents, kinds; ``surface`` is its mesh, of which enough may be curved for `shading`.
    """

    def __init__(self, views: GuideViewSet) -> None:
        self.views = views
        self.model_from_body = rigid(np.eye(3), views.center_in_model)
        self.body_from_model = invert(self.model_from_body)
        raw = views.arrays
        unit16 = np.float32(1.0 / 32767.0)
        center = views.center_in_model
        self.arrays = (
            np.ascontiguousarray(views.directions),
            np.array(raw["contour_start"]),
            (raw["contour_points"] - center).astype(np.float32),
            raw["contour_normals"] * unit16,
            np.array(raw["contour_runs_mm"]),
            np.array(raw["edge_start"]),
            (raw["edge_points"] - center).astype(np.float32),
            raw["edge_tangents"] * unit16,
            np.array(raw["edge_kinds"]),
        )
        self.surface = views.surface
        self.is_curved = curved_share(self.surface) >= LEAST_CURVED
        self.corner_normals = corner_normals(self.surface)

    @cached_property
    def distinct(self) -> tuple[NDArray[Any], ...]:
        """``arrays`` without the design edges that are crowded, see `is_crowded`; worked out when first asked for."""
        kinds = self.arrays[-1].copy()
        kinds[is_crowded(self.views)] &= np.uint8(255 - EDGE_SHARP)
        return (*self.arrays[:-1], kinds)


def intrinsics_of(camera: Camera) -> Array:
    """(10,) fx fy cx cy k1 k2 p1 p2 k3 is_distorted, as the kernels take it."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.dist, 1.0 if camera.is_distorted else 0.0])


def strangeness(cam_from_body: Array, predicted: Array, diameter_mm: float) -> float:
    """How far a pose is from the predicted one: 1 at 45°, at a third of the diameter aside or two along."""
    turn = float(rotation_angle_rad(cam_from_body, predicted)) / STRANGE_TURN_RAD
    way = (cam_from_body[:3, 3] - predicted[:3, 3]) / (STRANGE_WAY * diameter_mm)
    return float(turn**2 + way[0] ** 2 + way[1] ** 2 + 0.25 * way[2] ** 2)


def smoothed(gray: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A gray picture as the edge modality takes it: averaged over 3×3."""
    return np.asarray(cv2.blur(gray, (3, 3)))


@lru_cache(maxsize=64)
def _stage_table(stages: tuple[Stage, ...]) -> Array:
    return np.array([stage.row() for stage in stages], dtype=np.float64)


_NO_MATCHES = Matches(np.empty((0, 3)), np.empty((0, 2)), np.empty(0), 0)


class Tracker:
    """6-DoF tracking of one part with one camera; a ``part`` made from the same views need not be made again."""

    def __init__(
        self,
        views: GuideViewSet,
        camera: Camera,
        options: TrackerOptions | None = None,
        model: Model | None = None,
        second_look: SecondLook | None = None,
        part: PartView | None = None,
    ) -> None:
        self.options = options or TrackerOptions()
        self.camera = camera
        self.second_look = second_look
        self.part = part or PartView(views)
        self.diameter_mm = views.diameter_mm
        self.appearance = Appearance()
        self._intrinsics = intrinsics_of(camera)
        self._step_mm = 0.01 * self.diameter_mm
        o = self.options
        # Parts without design edges inside their outline lean on colours the more.
        kinds = np.asarray(views.arrays["edge_kinds"])
        outline = int(np.count_nonzero(kinds & EDGE_CONTOUR))
        inner = int(np.count_nonzero(((kinds & EDGE_CONTOUR) == 0) & ((kinds & EDGE_SHARP) > 0)))
        inner_share = inner / max(outline + inner, 1)
        self._region_weight = o.region_weight * (1.0 + 6.0 * max(0.0, 1.0 - inner_share / 0.3))
        self._damping = np.concatenate(
            [
                np.full(3, 1.0 / o.rotation_sigma_rad**2),
                np.full(3, 1.0 / (o.translation_sigma * self.diameter_mm) ** 2),
            ]
        )
        self._search = NonlocalSearch(self.part.arrays, camera, self._intrinsics, self.diameter_mm)
        self._usual_worth = 0.0
        self._cam_from_body: Array | None = None
        self._velocity = np.zeros(6)
        self._gain = 1.0
        self._bin_of = value_bins(1.0)
        self._sparse_gray: NDArray[np.float64] | None = None
        self._best_contour_support = 0.0
        self._gray = np.zeros((0, 0), dtype=np.uint8)
        self._smooth = np.zeros((0, 0), dtype=np.uint8)
        self._features: FeatureModality | None = None
        if self.options.use_feature and model is not None:
            vertices, faces, _ = model.mesh
            self._features = FeatureModality(vertices - views.center_in_model, faces, camera)

    def seen_by(self, camera: Camera) -> Tracker:
        """The same for `refine_fresh` and `evidence` in pictures of another camera, such as that of a window."""
        other = copy.copy(self)
        other.camera, other._intrinsics = camera, intrinsics_of(camera)
        return other

    def start(self, image: NDArray[np.uint8], cam_from_model: Array) -> None:
        """Begin at a pose: colours are learned from this frame, the motion is taken as none."""
        self.appearance = Appearance()
        self._cam_from_body = cam_from_model @ self.part.model_from_body
        self._velocity = np.zeros(6)
        self._gain, self._sparse_gray = 1.0, None
        self._best_contour_support = 0.0
        if self._features is not None:
            self._features.clear()
        self._bin_of = value_bins(1.0)
        self.learn(image, self._cam_from_body, 1.0)
        if self._features is not None and not (self.options.use_region or self.options.use_edge):
            # Nothing else could bear the pose out before texture is remembered.
            gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
            self._features.add_keyframe(self._features.pyramid(gray), self._cam_from_body)
        _, gray = self._gray_around(image, self._cam_from_body)
        self._usual_worth = self.evidence(image, gray, self._cam_from_body).worth

    def colours_at(self, image: NDArray[np.uint8], cam_from_body: Array) -> tuple[Array, Array] | None:
        """Normalised histograms (part, background) along the contour at a pose; None where it is too short."""
        fore, back = np.zeros(BINS**3), np.zeros(BINS**3)
        count_colours(image, self._bin_of, self.part.arrays, cam_from_body, self._intrinsics, self._step_mm, fore, back)
        fore_count, back_count = fore.sum(), back.sum()
        if fore_count < 50 or back_count < 50:
            return None
        return fore / fore_count, back / back_count

    def fresh_appearance(self, image: NDArray[np.uint8], cam_from_body: Array) -> Appearance:
        """The colours found at a pose of unknown worth."""
        look = Appearance()
        colours = self.colours_at(image, cam_from_body)
        if colours is not None:
            look.fore, look.back = colours
            look.is_known = True
            log_odds(look.fore, look.back, look.odds)
        return look

    def learn(self, image: NDArray[np.uint8], cam_from_body: Array, rate: float) -> None:
        """Blend the colours along the contour at this pose into the histograms."""
        colours = self.colours_at(image, cam_from_body)
        if colours is None:
            return
        look = self.appearance
        blend = rate if look.is_known else 1.0
        look.fore += blend * (colours[0] - look.fore)
        look.back += blend * (colours[1] - look.back)
        look.is_known = True
        log_odds(look.fore, look.back, look.odds)

    def refine(
        self,
        image: NDArray[np.uint8],
        gray: NDArray[np.uint8],
        cam_from_body: Array,
        stages: tuple[Stage, ...],
        appearance: Appearance | None = None,
        matches: Matches = _NO_MATCHES,
    ) -> tuple[Array, Array]:
        """Pose (``cam_from_body``) and information (6,6) after the given stages from a start.

        ``appearance`` stands for the learned one; ``matches`` are the part's own texture found in this frame,
        measured once for all stages. Changes nothing in the tracker.
        """
        o = self.options
        look = appearance or self.appearance
        pose, information = run_stages(
            image, gray, self._bin_of, look.odds, EDGE_FUNCTION, self.part.arrays, cam_from_body,
            self._intrinsics, self._step_mm, _stage_table(stages), self._damping,
            self._region_weight if o.use_region and look.is_known else 0.0,
            o.edge_weight if o.use_edge else 0.0, o.edge_sigma_px, o.edge_threshold,
            matches.points_in_body, matches.pixels, matches.weights, o.feature_sigma_px,
        )  # fmt: skip
        return pose, information

    def refine_fresh(
        self, image: NDArray[np.uint8], gray: NDArray[np.uint8], cam_from_body: Array, stages: tuple[Stage, ...]
    ) -> Array:
        """Refine a pose of unknown worth: colours are learned anew before every stage, nothing is remembered."""
        unit = max(1.0, self.radius_px(cam_from_body) / 80.0)
        for stage in stages:
            look = self.fresh_appearance(image, cam_from_body)
            cam_from_body, _ = self.refine(image, gray, cam_from_body, (stage.widened(unit),), look)
        return cam_from_body

    def radius_px(self, cam_from_body: Array) -> float:
        """Half the part's diameter in the picture."""
        return 0.5 * self.diameter_mm * self.camera.fx / max(float(cam_from_body[2, 3]), 1.0)

    def evidence(
        self,
        image: NDArray[np.uint8],
        gray: NDArray[np.uint8],
        cam_from_body: Array,
        tolerance_px: float = 1.5,
        appearance: Appearance | None = None,
    ) -> Evidence:
        """What the picture says for a pose; steps count within a tolerance, colours as learned or as given."""
        look = appearance or self.appearance
        return Evidence(
            *run_evidence(
                image, gray, self._bin_of, look.odds, look.is_known, EDGE_FUNCTION,
                self.part.arrays, cam_from_body, self._intrinsics, self._step_mm, self.options.edge_threshold,
                tolerance_px,
            )
        )  # fmt: skip

    def edge_steps(self, gray: NDArray[np.uint8], cam_from_body: Array) -> EdgeSteps:
        """The edges at a pose, and which of them the picture bears out."""
        return EdgeSteps(
            *run_edge_steps(
                gray, self.part.arrays, cam_from_body, self._intrinsics, self._step_mm, self.options.edge_threshold, 1.5
            )
        )  # fmt: skip

    def worths_near(self, image: NDArray[np.uint8], cams_from_model: list[Array]) -> list[float]:
        """Worths (see `Evidence.worth`) of other poses (4,4) in this frame, each after a fine refinement."""
        gray = smoothed(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        fine = self.options.stages[-2:]
        poses = [self.refine(image, gray, pose @ self.part.model_from_body, fine)[0] for pose in cams_from_model]
        return [self.evidence(image, gray, pose).worth for pose in poses]

    def _follow_exposure(self, gray: NDArray[np.uint8]) -> None:
        """Take a change of exposure against the last frame out of the colours.

        The factor is the median ratio of the brightness on a coarse grid; saturated and black pixels do not count.
        """
        if self._sparse_gray is None:
            self._sparse_gray = np.zeros((gray.shape[0] // 16, gray.shape[1] // 16))
        ratio = median_brightness_ratio(gray, self._sparse_gray, 16)
        if ratio != 1.0 or self._gain != 1.0:
            # The histograms follow slow changes by themselves: the factor fades.
            self._gain = min(max(self._gain**0.9 * ratio, 0.2), 5.0)
            self._bin_of = value_bins(self._gain)

    def track(self, image: NDArray[np.uint8]) -> Estimate:
        """Pose in the next frame, with its evidence."""
        if self._cam_from_body is None:
            raise RuntimeError("Tracker.track was called before Tracker.start")
        self._follow_exposure(image[..., 1])
        o = self.options
        before = self._cam_from_body
        predicted = apply_twist(before, self._velocity)
        plain_gray, gray = self._gray_around(image, before, predicted)
        matches, found_share = None, 0.0
        start = predicted
        if self._features is not None:
            pyramid = self._features.pyramid(plain_gray)
            matches = self._features.measure(pyramid, predicted)
            found_share = len(matches.weights) / max(matches.tried, 1)
            if len(matches.weights) >= o.feature_min_count and found_share >= o.feature_min_share:
                start = self._features.align(matches, predicted)
            else:
                matches = None
        pose, information = self.refine(image, gray, start, o.stages, matches=matches or _NO_MATCHES)
        evidence = self.evidence(image, gray, pose)
        if evidence.worth < o.other_ways_share * self._usual_worth:
            ways: list[tuple[Array, tuple[Stage, ...], float]] = [(start, LAST_STAGES, 0.0)]
            if o.use_edge and evidence.inner_share > PLAIN_SHARE:
                ways += [(start, NEAR_STAGES, 0.0), (pose, NEAR_STAGES, 0.0)]
            for begin, stages, more in [*ways, *((start, stages, CLEARLY_MORE) for stages in FAR_STAGES)]:
                if more and evidence.worth >= o.far_share * self._usual_worth:
                    break
                other, other_information = self.refine(image, gray, begin, stages, matches=matches or _NO_MATCHES)
                other_evidence = self.evidence(image, gray, other)
                if other_evidence.worth > evidence.worth + more:
                    pose, information, evidence = other, other_information, other_evidence
        strange = strangeness(pose, predicted, self.diameter_mm)
        if self._is_suspicious(evidence, strange):
            plain_gray, gray = self._gray_around(image)
            best = evidence.worth - STRANGE_WORTH * strange
            for start in self._search.find(image, (self._bin_of, self.appearance.odds), predicted):
                other, other_information = self.refine(image, gray, start, o.stages)
                other_evidence = self.evidence(image, gray, other)
                worth = other_evidence.worth - STRANGE_WORTH * strangeness(other, predicted, self.diameter_mm)
                if worth > best + CLEARLY_MORE:
                    pose, information, evidence, matches = other, other_information, other_evidence, None
                    best = worth
            # What was looked for everywhere and found no better is usual from now on.
            self._usual_worth = evidence.worth
        if self.second_look is not None and strangeness(pose, predicted, self.diameter_mm) > o.second_look:
            better = self.second_look.better(image, pose, [predicted, before])
            if better is not None:
                plain_gray, gray = self._gray_around(image, better)
                # Refined with the colours remembered it would be led back to where these, too, had been wrong.
                _, information = self.refine(image, gray, better, LAST_STAGES[-1:])
                pose, evidence, matches = better, self.evidence(image, gray, better), None
        if o.use_shading and self.part.is_curved:
            shaded, shaded_information = self.shaded(plain_gray, pose, information)
            shaded_evidence = self.evidence(image, gray, shaded)
            if shaded_evidence.worth > evidence.worth - CLEARLY_MORE:
                pose, information, evidence = shaded, shaded_information, shaded_evidence
        self._usual_worth += 0.1 * (evidence.worth - self._usual_worth)
        self._velocity = 0.9 * relative_twist(before, pose)
        self._cam_from_body = pose
        quality = evidence.quality
        if matches is not None and evidence.points_in_picture > 0.05:
            # The part's own texture bears the pose out where a hand hides the outline.
            quality = quality_of(evidence.worth + 0.5 * found_share)
        if quality > o.doubtful_quality:
            if o.use_region:
                self.learn(image, pose, o.learning_rate)
            if self._features is not None:
                self._remember_texture(pyramid, pose, matches, evidence)
        return Estimate(pose @ self.part.body_from_model, information, quality, evidence)

    def shaded(self, gray: NDArray[np.uint8], cam_from_body: Array, information: Array) -> tuple[Array, Array]:
        """Pose and information after the shading of the surface under an unknown light was heard, too; see `shading`.

        Args:
            gray: (H,W), not smoothed.
            cam_from_body: (4,4), the best by outline and edges; information: (6,6) of these.
        """
        look = look_at(gray, self.camera, self.diameter_mm, cam_from_body)
        if look is None:
            return cam_from_body, information
        pose, more, _ = shade(
            *look, self.part.surface, self.part.corner_normals, self.diameter_mm, cam_from_body, information, GAIN
        )
        return pose, more

    def _is_suspicious(self, evidence: Evidence, strange: float) -> bool:
        """Whether the part may be elsewhere: the pose is worth little, less than usual, or off the prediction."""
        o = self.options
        share = evidence.worth / max(self._usual_worth, 1e-6)
        is_less = share < o.usual_share or (share < o.surprise_share and strange > o.surprise)
        return is_less or evidence.quality < o.doubtful_quality

    def _gray_around(self, image: NDArray[np.uint8], *poses: Array) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Gray picture and its smoothed copy, filled only around where the part may be.

        Everywhere without poses, and for texture.
        """
        height, width = image.shape[:2]
        first, last = np.array([0, 0]), np.array([width, height])
        if self._features is None and poses:
            centers = np.array([self.camera.project(pose[:3, 3]) for pose in poses])
            if np.all(np.isfinite(centers)):
                reach = 1.15 * max(self.radius_px(pose) for pose in poses) + 50.0
                first = np.clip(centers.min(axis=0) - reach, 0, last).astype(int)
                last = np.clip(centers.max(axis=0) + reach, 0, last).astype(int)
        if np.any(last - first < 16):
            first, last = np.array([0, 0]), np.array([width, height])
        window = np.s_[first[1] : last[1], first[0] : last[0]]
        if self._gray.shape != (height, width):
            self._gray = np.zeros((height, width), dtype=np.uint8)
            self._smooth = np.zeros((height, width), dtype=np.uint8)
        self._gray[window] = cv2.cvtColor(image[window], cv2.COLOR_RGB2GRAY)
        self._smooth[window] = smoothed(self._gray[window])
        return self._gray, self._smooth

    def _remember_texture(
        self, pyramid: Pyramid, cam_from_body: Array, matches: Matches | None, evidence: Evidence
    ) -> None:
        """Settle the features seen, and take a new keyframe where one is missing and nothing hides the outline."""
        assert self._features is not None
        if matches is not None:
            self._features.settle(cam_from_body)
        self._best_contour_support = max(0.99 * self._best_contour_support, evidence.contour_support)
        unhidden = evidence.contour_support > 0.85 * self._best_contour_support
        # What enters the picture is placed badly yet, and so would be all that is measured against it.
        unhidden &= evidence.points_in_picture > IN_PICTURE_SHARE
        tracked_count = 0 if matches is None else len(matches.weights)
        if unhidden and evidence.quality > 0.6 and self._features.wants_keyframe(cam_from_body, tracked_count):
            self._features.add_keyframe(pyramid, cam_from_body)

    def covariance(self, estimate: Estimate) -> Array:
        """(6,6) covariance of the twist (rad, mm) about the model's centre.

        The inverse information, widened by the number of neighbours that err together: edge points every few pixels
        along one line share the line's error.
        """
        scale = self.options.correlated_points / max(estimate.quality, 0.05)
        widest = np.array([0.5] * 3 + [0.5 * self.diameter_mm] * 3)
        covariance = np.linalg.inv(estimate.information / scale + np.diag(1.0 / widest**2))
        return np.asarray(covariance, dtype=np.float64)
