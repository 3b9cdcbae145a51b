"""Polishing: a found pose refined once more where the image is finer than that in which it was measured."""

from __future__ import annotations

from arview.detection.features.image_pyramid import ImagePyramid, WorkPicture
from arview.geometry import Array, are_near
from arview.refinement import (
    LAST_STAGES,
    MARGIN_PX,
    SEARCH_STAGES,
    PoseRefiner,
    Stage,
    WorkingScaleOptions,
    window_around,
)
from arview.refinement.working_picture import working_picture

MIN_GAIN = 1.3
"""How much larger than the working picture the finest one must be to be worth its time."""
STAGES: tuple[Stage, ...] = SEARCH_STAGES + LAST_STAGES
"""Stages through which a pose is refined."""
MAX_TURN_DEG = 4.0
"""A pose may turn by this angle, and move by as many hundredths of the diameter."""
MAX_LOSS = 0.03
"""Drop of the evidence score up to which the refined pose is kept."""
TOLERANCE_PX = 1.5
"""Distance within which edges support a pose."""


def polish(
    refiner: PoseRefiner,
    pyramid: ImagePyramid,
    measured: WorkPicture,
    cam_from_body: Array,
    scale: WorkingScaleOptions,
) -> Array:
    """A found pose refined at the finest useful resolution, or as it is where that is no finer or no better.

    Args:
        refiner: of the part, for any camera.
        pyramid: of the image.
        measured: the image in which the pose was measured.
        cam_from_body: (4,4).
        scale: which resolution is useful, by the size of the part and the softness of its edges.

    Returns:
        ``cam_from_body`` (4,4).
    """
    image, camera = pyramid.finest
    coarse = refiner.with_camera(measured.camera)
    spread_px = coarse.edge_spread_px(measured.gray, cam_from_body) or 0.0
    radius_px = refiner.with_camera(camera).radius_px(cam_from_body)
    working_scale, *_, fine_scale = 2 * scale.scales(radius_px, spread_px * camera.width / measured.camera.width)
    if fine_scale < MIN_GAIN * working_scale:
        return cam_from_body
    window = window_around(camera, [cam_from_body], refiner.diameter_mm, MARGIN_PX / fine_scale)
    fine = working_picture(image, camera, fine_scale, window)
    polished = refiner.with_camera(fine.camera, fine.pitch).refine_fresh(fine.image, fine.smooth, cam_from_body, STAGES)
    appearance = coarse.appearance_at(measured.image, cam_from_body)
    before, after = (
        coarse.evidence(measured.image, measured.gray, pose, appearance, TOLERANCE_PX).score
        for pose in (cam_from_body, polished)
    )
    reach_mm = 0.01 * MAX_TURN_DEG * refiner.diameter_mm
    is_near = are_near(polished, cam_from_body, reach_mm, MAX_TURN_DEG)
    return polished if is_near and after >= before - MAX_LOSS else cam_from_body
