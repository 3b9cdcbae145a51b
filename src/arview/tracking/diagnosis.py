"""Diagnosis: why the part is not found, or was lost, in words that a user can act on."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.cad import Viewpoint, ViewRange
from arview.cad.viewpoint import viewpoint
from arview.camera import Camera
from arview.core.messages import key_of, sentence
from arview.detection import RejectedHypothesis
from arview.geometry import Array, apply
from arview.guideviews import GuideViewSet
from arview.tracking.estimate import Estimate

NOTHING_IN_VIEW = "tracking.nothing_from_to"
"""Key of the reason when neither the picture nor a hypothesis explains more."""
BLURRED = "tracking.blurred"
"""Key of the reason for a picture without sharp edges."""

WIDTH_PX = 640
"""Wider pictures are reduced to this width before light and blur are measured."""
DARK_LEVEL = 40.0
"""A picture is too dark when 95 % of its pixels are below this grey level."""
BRIGHT_LEVEL = 250.0
"""A picture is overexposed when half of its pixels reach this grey level."""
MAX_BLUR_PX = 2.5
"""Standard deviation of the blur, in a picture ``WIDTH_PX`` wide, above which detection fails."""
MIN_EDGES = 6
"""Edges needed for a measurement of the blur."""
MIN_STEP_SHARE = 0.12
"""Edges lower than this share of the brightest grey level are not used to measure the blur."""
MIN_STEP = 10.0
"""Edges lower than this many grey levels are not used to measure the blur."""
MIN_QUALITY = 0.2
"""Hypotheses of a lower quality are found in any clutter, so they explain nothing."""
FITTING_QUALITY = 0.5
"""Quality from which a hypothesis fits well enough to tell the direction of view."""
MIN_SPAN_PX = 36.0
"""A part that spans fewer pixels shows too little to be found."""
MIN_CONTRAST = 14.0
"""Median difference of the colours across the outline, in grey levels, below which contrast is low."""
ANGLE_MARGIN_DEG = 5.0
"""Angle outside the declared range that is still tolerated."""
DISTANCE_MARGIN = 0.1
"""Share of the distance outside the declared range that is still tolerated."""
POLE_DEG = 80.0
"""Elevation above which roll and azimuth cannot be told apart."""
CUT_OFF_SHARE = 0.8
"""A hypothesis with less of its outline inside the picture is cut off by its border."""
OVERFLOW = 1.2
"""Ratio of the part's span to the picture's larger side above which the part does not fit in."""
LEFT_SHARE = 0.7
"""Share of the outline inside the picture below which a lost part has left the picture."""
LEAVING_SHARE = 0.95
"""Share of the outline inside the picture below which a lost part has left it, if its centre would soon have been
outside."""
LEAVING_FRAMES = 5
"""Frames after the loss in which the centre would have been outside."""
MAX_MOTION = 0.07
"""Motion per frame, in diameters of the part, above which a part moved too fast."""


def diagnose_search(
    image: NDArray[np.uint8],
    camera: Camera,
    views: GuideViewSet,
    rejected: RejectedHypothesis | None,
) -> str:
    """The likeliest reason why a search did not find the part.

    Args:
        image: (H,W,3) uint8 RGB of the camera's size.
        camera: the camera that took it.
        views: guide views of the part.
        rejected: the best hypothesis that was not accepted, if there was one.
    """
    problem = diagnose_picture(image)
    if problem:
        return problem
    credible = rejected if rejected is not None and rejected.quality >= MIN_QUALITY else None
    reason = _too_small(camera, views, credible)
    if not reason and credible is not None:
        place = viewpoint(credible.cam_from_model, views.center_in_model, views.view_range.up)
        reason = outside_range(place, views.view_range, credible.quality >= FITTING_QUALITY)
        reason = reason or _partly_outside(camera, views, credible)
        reason = reason or _low_contrast(image, camera, views, credible.cam_from_model)
        share = f"{100 * credible.evidence.contour_support:.0f}"
        reason = reason or sentence("tracking.outline_share", share=share)
    low, high = views.view_range.for_camera(camera, views.diameter_mm).distance_mm
    return reason or sentence(NOTHING_IN_VIEW, low=f"{low:.0f}", high=f"{high:.0f}")


def diagnose_picture(image: NDArray[np.uint8]) -> str:
    """What is wrong with light, sharpness or contrast of a picture (H,W,3) uint8 RGB; empty when nothing is."""
    scale = min(1.0, WIDTH_PX / image.shape[1])
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    if scale < 1.0:
        gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    if float(np.percentile(gray, 95)) < DARK_LEVEL:
        return sentence("tracking.dark")
    if float(np.percentile(gray, 50)) >= BRIGHT_LEVEL:
        return sentence("tracking.bright")
    widths_px = edge_widths_px(np.asarray(gray))
    if np.all(np.isnan(widths_px)):
        return sentence("tracking.no_edges")
    return sentence(BLURRED) if np.nanmax(widths_px) > MAX_BLUR_PX else ""


def edge_widths_px(gray: NDArray[np.uint8]) -> Array:
    """Standard deviation (2,) px of the blur across the strongest vertical and horizontal edges of a picture (H,W).

    A step blurred with σ has a slope in inverse proportion to √(σ² + s²) after smoothing with s, so the ratio of the
    slopes at two smoothings gives σ whatever the height of the step: Zhuo & Sim, "Defocus map estimation from a single
    image" (Pattern Recognition 2011). Edges are selected by height, so that a plain background does not count, and by
    direction, because motion blurs only the edges across it. Where wide blur leaves too few edges, they are searched
    for at half and a quarter of the size. NaN for a direction without enough edges.
    """
    widths = _widths_px(gray)
    for shrinking in (2, 4):
        if not np.any(np.isnan(widths)):
            break
        small = cv2.resize(gray, None, fx=1 / shrinking, fy=1 / shrinking, interpolation=cv2.INTER_AREA)
        widths = np.where(np.isnan(widths), shrinking * _widths_px(np.asarray(small)), widths)
    return widths


def _widths_px(gray: NDArray[np.uint8]) -> Array:
    """As `edge_widths_px`, at the size of the picture only."""
    fine_px, coarse_px = 1.0, 4.0
    picture = gray.astype(np.float32)
    slopes = []
    for sigma_px in (fine_px, coarse_px):
        smooth = cv2.GaussianBlur(picture, (0, 0), sigma_px)
        slopes.append([np.abs(cv2.Sobel(smooth, cv2.CV_32F, *axis, ksize=3)) / 8.0 for axis in ((1, 0), (0, 1))])
    lowest = max(MIN_STEP_SHARE * float(np.percentile(gray, 95)), MIN_STEP)
    widths = np.full(2, np.nan)
    for axis in (0, 1):
        coarse, across = slopes[1][axis], slopes[1][1 - axis]
        height = coarse * np.sqrt(2.0 * np.pi) * coarse_px
        is_peak = (coarse >= cv2.dilate(coarse, np.ones((7, 7), np.uint8))) & (coarse > 1.5 * across)
        rows, columns = np.nonzero(is_peak & (height > lowest))
        if len(rows) < MIN_EDGES:
            continue
        fine = cv2.dilate(slopes[0][axis], np.ones((9, 9), np.uint8))
        strongest = np.argsort(-coarse[rows, columns])[:400]
        ratio2 = (fine[rows, columns][strongest] / coarse[rows, columns][strongest]) ** 2
        square = (coarse_px**2 - ratio2 * fine_px**2) / np.maximum(ratio2 - 1.0, 1e-3)
        widths[axis] = np.percentile(np.sqrt(np.maximum(square, 0.0)), 25)
    return widths


def outside_range(place: Viewpoint, view_range: ViewRange, is_fitting: bool) -> str:
    """How a viewpoint is outside the declared range, in words; empty when it is not.

    Direction and roll are only compared when the pose fits, because those of a poor pose are hardly known.
    """
    low, high = view_range.distance_mm
    distance = f"{place.distance_mm:.0f}"
    if place.distance_mm > high * (1.0 + DISTANCE_MARGIN):
        return sentence("tracking.far", distance=distance, limit=f"{high:.0f}")
    if place.distance_mm < low * (1.0 - DISTANCE_MARGIN):
        return sentence("tracking.near", distance=distance, limit=f"{low:.0f}")
    if not is_fitting:
        return ""
    direction = view_range.direction(place.azimuth_deg, place.elevation_deg)
    if not view_range.contains_direction(direction, ANGLE_MARGIN_DEG):
        angles = {"azimuth": f"{place.azimuth_deg:.0f}", "elevation": f"{place.elevation_deg:.0f}"}
        return sentence("tracking.outside", **angles)
    first, last = view_range.roll_deg
    away = abs((place.roll_deg - 0.5 * (first + last) + 180.0) % 360.0 - 180.0)
    if abs(place.elevation_deg) < POLE_DEG and away > 0.5 * (last - first) + ANGLE_MARGIN_DEG:
        return sentence("tracking.turned", roll=f"{place.roll_deg:.0f}", first=f"{first:.0f}", last=f"{last:.0f}")
    return ""


def diagnose_loss(
    image: NDArray[np.uint8],
    estimate: Estimate,
    recent: tuple[Array, Array] | None,
    camera: Camera,
    views: GuideViewSet,
    is_possible: bool,
) -> str:
    """Why a tracked part was lost.

    Args:
        image: (H,W,3) uint8 RGB, the last frame.
        estimate: estimate of that frame, which was rejected.
        recent: the last two accepted poses (4,4), older first, if there are two.
        camera: camera of the frames.
        views: guide views of the part.
        is_possible: whether the estimate is in front of the camera and near the declared distances.
    """
    center = apply(estimate.cam_from_model, views.center_in_model)
    if not is_possible and center[2] > 0:
        place = viewpoint(estimate.cam_from_model, views.center_in_model, views.view_range.up)
        return outside_range(place, views.view_range, False)
    step_px, share = _motion(camera, views, recent) if recent is not None else (np.zeros(2), None)
    in_picture = estimate.evidence.points_in_picture
    if center[2] <= 0 or in_picture < LEFT_SHARE:
        edge = "" if center[2] <= 0 else f"_at_{_edge_of_picture(camera, camera.project(center))[0]}"
        return sentence(f"tracking.left{edge}")
    edge, beyond_px = _edge_of_picture(camera, camera.project(center) + LEAVING_FRAMES * step_px)
    if in_picture < LEAVING_SHARE and beyond_px > 0:
        return sentence(f"tracking.left_at_{edge}")
    problem = diagnose_picture(image)
    if key_of(problem) == BLURRED or (share is not None and share > MAX_MOTION):
        return sentence("tracking.fast")
    if problem:
        return problem
    return sentence("tracking.hidden")


def _motion(camera: Camera, views: GuideViewSet, recent: tuple[Array, Array]) -> tuple[Array, float]:
    """Motion of the part's centre from one frame to the next: (2,) px, and its length in diameters of the part."""
    before, after = (apply(pose, views.center_in_model) for pose in recent)
    step_px = camera.project(after) - camera.project(before)
    return step_px, float(np.linalg.norm(step_px) / _span_px(camera, views, float(after[2])))


def _edge_of_picture(camera: Camera, pixel: Array) -> tuple[str, float]:
    """Name of the border nearest to a pixel (2,), and how far the pixel is beyond it, px; negative inside."""
    u, v = pixel
    beyond_px = {"left": -u, "right": u - camera.width, "upper": -v, "lower": v - camera.height}
    edge = max(beyond_px, key=lambda name: beyond_px[name])
    return edge, float(beyond_px[edge])


def _span_px(camera: Camera, views: GuideViewSet, distance_mm: float) -> float:
    """Pixels that the part's diameter spans at a distance."""
    return views.diameter_mm * camera.fx / distance_mm


def _too_small(camera: Camera, views: GuideViewSet, rejected: RejectedHypothesis | None) -> str:
    """Whether the part spans too few pixels at the hypothesis, or even at the nearest declared distance."""
    low = views.view_range.distance_mm[0]
    distance_mm = low
    if rejected is not None:
        distance_mm = max(float(np.linalg.norm(apply(rejected.cam_from_model, views.center_in_model))), low)
    span_px = _span_px(camera, views, distance_mm)
    return sentence("tracking.small", span=f"{span_px:.0f}") if span_px < MIN_SPAN_PX else ""


def _partly_outside(camera: Camera, views: GuideViewSet, rejected: RejectedHypothesis) -> str:
    """Whether the border of the picture cuts the part off."""
    center = apply(rejected.cam_from_model, views.center_in_model)
    if rejected.evidence.points_in_picture > CUT_OFF_SHARE or center[2] <= 0:
        return ""
    if _span_px(camera, views, float(center[2])) > OVERFLOW * max(camera.width, camera.height):
        return sentence("tracking.large")
    edge, _ = _edge_of_picture(camera, camera.project(center))
    return sentence(f"tracking.partly_{edge}")


def _low_contrast(image: NDArray[np.uint8], camera: Camera, views: GuideViewSet, cam_from_model: Array) -> str:
    """Whether the colours inside and outside the outline at a pose are about the same."""
    features = views.nearest(cam_from_model).features
    in_camera = apply(cam_from_model, features.contour_points)
    normals = features.contour_normals @ cam_from_model[:3, :3].T
    pixels = camera.project(in_camera)
    aside = camera.project(in_camera + 0.01 * views.diameter_mm * normals) - pixels
    with np.errstate(invalid="ignore"):
        aside *= 4.0 / np.linalg.norm(aside, axis=1, keepdims=True)
        inside, outside = np.round(pixels - aside), np.round(pixels + aside)
        both = np.concatenate([inside, outside], axis=1)
        is_seen = np.all((both >= 0) & (both < np.tile([camera.width, camera.height], 2)), axis=1)
    if is_seen.sum() < 20:
        return ""
    (u, v), (x, y) = inside[is_seen].astype(np.intp).T, outside[is_seen].astype(np.intp).T
    smooth = cv2.blur(image, (3, 3)).astype(np.float64)
    difference = float(np.median(np.abs(smooth[v, u] - smooth[y, x]).max(axis=1)))
    return sentence("tracking.contrast") if difference < MIN_CONTRAST else ""
