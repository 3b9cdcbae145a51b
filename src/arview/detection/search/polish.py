"""Polishing: a found pose refined once more where the image is finer than that in which it was measured."""

from __future__ import annotations

from dataclasses import dataclass, field

from arview.detection.features.image_pyramid import ImagePyramid, WorkPicture
from arview.geometry import Array, are_near
from arview.refinement.refiner import PoseRefiner
from arview.refinement.schedules import LAST_STAGES, SEARCH_STAGES, Stage
from arview.refinement.working_picture import WorkingScaleOptions, window_around, working_picture


@dataclass(frozen=True)
class PolishOptions:
    """Options of the polishing.

    Attributes:
        min_gain: how much larger than the working picture the finest one must be to be worth its time.
        stages: through which a pose is refined.
        max_turn_deg: a pose may turn by this, and move by as many hundredths of the diameter.
        max_loss: drop of the evidence score up to which the refined pose is kept.
        tolerance_px: distance within which edges support a pose.
    """

    min_gain: float = 1.3
    stages: tuple[Stage, ...] = field(default_factory=lambda: SEARCH_STAGES + LAST_STAGES)
    max_turn_deg: float = 4.0
    max_loss: float = 0.03
    tolerance_px: float = 1.5


def polish(
    refiner: PoseRefiner,
    pyramid: ImagePyramid,
    measured: WorkPicture,
    cam_from_body: Array,
    scale: WorkingScaleOptions,
    options: PolishOptions,
) -> Array:
    """A found pose refined at the finest useful resolution, or as it is where that is no finer or no better.

    Args:
        refiner: of the part, for any camera.
        pyramid: of the image.
        measured: the image in which the pose was measured.
        cam_from_body: (4,4).
        scale: which resolution is useful, by the size of the part and the softness of its edges.
        options: see `PolishOptions`.

    Returns:
        ``cam_from_body`` (4,4).
    """
    o = options
    image, camera = pyramid.finest
    coarse = refiner.with_camera(measured.camera)
    spread_px = coarse.edge_spread_px(measured.gray, cam_from_body) or 0.0
    radius_px = refiner.with_camera(camera).radius_px(cam_from_body)
    working_scale, *_, fine_scale = 2 * scale.scales(radius_px, spread_px * camera.width / measured.camera.width)
    if fine_scale < o.min_gain * working_scale:
        return cam_from_body
    window = window_around(camera, [cam_from_body], refiner.diameter_mm, scale.margin_px / fine_scale)
    fine = working_picture(image, camera, fine_scale, window)
    polished = refiner.with_camera(fine.camera).refine_fresh(fine.image, fine.smooth, cam_from_body, o.stages)
    appearance = coarse.appearance_at(measured.image, cam_from_body)
    before, after = (
        coarse.evidence(measured.image, measured.gray, pose, appearance, o.tolerance_px).score
        for pose in (cam_from_body, polished)
    )
    reach_mm = 0.01 * o.max_turn_deg * refiner.diameter_mm
    is_near = are_near(polished, cam_from_body, reach_mm, o.max_turn_deg)
    return polished if is_near and after >= before - o.max_loss else cam_from_body
