"""Options of the tracker."""

from __future__ import annotations

from dataclasses import dataclass, field

from arview.errors import InputError
from arview.refinement.modalities.shading import ShadingOptions
from arview.refinement.refiner import RefinerOptions
from arview.refinement.schedules import TRACK_STAGES, Stage
from arview.refinement.working_picture import WorkingScaleOptions


@dataclass(frozen=True)
class TrackerOptions(RefinerOptions):
    """Options of the tracker, in addition to those of the refinement.

    Attributes:
        use_texture: match the part's own texture; needs the model's surface.
        use_shading: use the brightness of curved surfaces.
        shading: as of the refinement, with fewer rounds and less weight than for a pose found by a search, because the
            errors of the brightness are common to many pixels and the tracked pose is nearly right.
        stages: schedule of a usual frame.
        min_matches: texture matches needed to use texture.
        min_match_share: share of the expected texture that must be found to use texture.
        texture_score: score that texture adds to the quality when all of it is found, because it supports the pose
            where a hand hides the outline.
        learning_rate: share by which the colour histograms follow each frame.
        min_learning_quality: quality below which colours are not learned, and the part is searched for around the
            predicted pose.
        score_rate: share by which the usual score follows each frame.
        other_schedules_share: share of the usual score in the working picture below which other schedules are tried.
        other_schedules_fine_share: the same for the finest picture, in which scores vary more.
        near_schedules_min_inner_share: share of design edges needed for schedules without colours, because the apparent
            outline of a rounded part moves with the light.
        far_schedules_share: share of the usual score below which schedules for a part that moved far are tried.
        wide_search_share: share of the usual score below which the part is searched for around the predicted pose.
        surprise_share: the same for a pose whose squared motion distance exceeds ``surprise``.
        surprise: squared motion distance of a surprising pose; 0.02 is about 6°.
        motion_penalty: score that a squared motion distance of 1 costs, because turned parts often look alike.
        min_gain: score by which a pose found far from the predicted one must be better, and largest loss of score
            accepted from the shading refinement.
        min_keyframe_in_picture: share of the outline in the picture needed for a keyframe. A part that enters the
            picture is located badly at first, and so would be all that is later matched with the keyframe.
        min_keyframe_quality: quality needed for a keyframe.
        min_keyframe_support: share of the best recent support of the outline needed for a keyframe; with less,
            something is in front of the part.
        support_decay: factor by which the best recent support of the outline decreases in each frame.
        exposure_grid_px: distance of the pixels from which a change of exposure is measured.
        exposure_decay: exponent by which the estimated exposure fades, because the histograms follow slow changes.
        exposure_limits: smallest and largest exposure relative to the first frame.
        scale: options of the pictures in which poses are refined and judged.
        spread_rate: share by which the estimated blur of the edges follows each frame.
        correlated_points: neighbouring edge points that share one error.
        velocity_decay: share of the last frame's motion that is expected in the next frame.
    """

    use_texture: bool = True
    use_shading: bool = True
    shading: ShadingOptions = field(default_factory=lambda: ShadingOptions(gain=0.5, rounds=2))
    stages: tuple[Stage, ...] = TRACK_STAGES
    min_matches: int = 12
    min_match_share: float = 0.4
    texture_score: float = 0.5
    learning_rate: float = 0.2
    min_learning_quality: float = 0.4
    score_rate: float = 0.1
    other_schedules_share: float = 0.97
    other_schedules_fine_share: float = 0.85
    near_schedules_min_inner_share: float = 0.05
    far_schedules_share: float = 0.9
    wide_search_share: float = 0.8
    surprise_share: float = 0.95
    surprise: float = 0.02
    motion_penalty: float = 0.15
    min_gain: float = 0.02
    min_keyframe_in_picture: float = 0.9
    min_keyframe_quality: float = 0.6
    min_keyframe_support: float = 0.85
    support_decay: float = 0.99
    exposure_grid_px: int = 16
    exposure_decay: float = 0.9
    exposure_limits: tuple[float, float] = (0.2, 5.0)
    scale: WorkingScaleOptions = field(default_factory=WorkingScaleOptions)
    spread_rate: float = 0.3
    correlated_points: float = 8.0
    velocity_decay: float = 0.9

    def __post_init__(self) -> None:
        if not (self.use_region or self.use_edge or self.use_texture):
            raise InputError("tracker: at least one modality must be on")
