"""Diagnosis: why the part is not found, or was lost, in words that a user can act on."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.cad.view_range import ViewRange
from arview.cad.viewpoint import Viewpoint, viewpoint
from arview.camera import Camera
from arview.detection.detector import RejectedHypothesis
from arview.geometry import Array, apply
from arview.guideviews import GuideViewSet
from arview.tracking.estimate import Estimate

NOTHING_IN_VIEW = "nothing like the part in view"
"""How the reason begins when neither the picture nor a hypothesis explains more."""
BLURRED = "blurred"
"""The reason for a picture without sharp edges."""


@dataclass(frozen=True)
class DiagnosisOptions:
    """Thresholds of the reasons.

    Attributes:
        width_px: wider pictures are reduced to this width before light and blur are measured.
        dark_level: a picture is too dark when 95 % of its pixels are below this grey level.
        bright_level: a picture is overexposed when half of its pixels reach this grey level.
        max_blur_px: standard deviation of the blur, in a picture ``width_px`` wide, above which detection fails.
        min_edges: edges needed for a measurement of the blur.
        min_step_share: edges lower than this share of the brightest grey level are not used for it.
        min_step: neither are edges lower than this many grey levels.
        min_quality: hypotheses of a lower quality are found in any clutter, so they explain nothing.
        fitting_quality: quality from which a hypothesis fits well enough to tell the direction of view.
        min_span_px: a part that spans fewer pixels shows too little to be found.
        min_contrast: median difference of the colours across the outline, in grey levels, below which contrast is low.
        angle_margin_deg: angle outside the declared range that is still tolerated.
        distance_margin: share of the distance outside the declared range that is still tolerated.
        pole_deg: elevation above which roll and azimuth cannot be told apart.
        cut_off_share: a hypothesis with less of its outline inside the picture is cut off by its border.
        overflow: ratio of the part's span to the picture's larger side above which the part does not fit in.
        left_share: share of the outline inside the picture below which a lost part has left the picture.
        leaving_share: below this share it has, too, if its centre would soon have been outside.
        leaving_frames: frames after the loss in which the centre would have been outside.
        max_motion: motion per frame, in diameters of the part, above which a part moved too fast.
    """

    width_px: int = 640
    dark_level: float = 40
    bright_level: float = 250
    max_blur_px: float = 2.5
    min_edges: int = 6
    min_step_share: float = 0.12
    min_step: float = 10.0
    min_quality: float = 0.2
    fitting_quality: float = 0.5
    min_span_px: float = 36.0
    min_contrast: float = 14.0
    angle_margin_deg: float = 5.0
    distance_margin: float = 0.1
    pole_deg: float = 80.0
    cut_off_share: float = 0.8
    overflow: float = 1.2
    left_share: float = 0.7
    leaving_share: float = 0.95
    leaving_frames: int = 5
    max_motion: float = 0.07


DEFAULT = DiagnosisOptions()


def diagnose_search(
    image: NDArray[np.uint8],
    camera: Camera,
    views: GuideViewSet,
    rejected: RejectedHypothesis | None,
    options: DiagnosisOptions = DEFAULT,
) -> str:
    """The likeliest reason why a search did not find the part.

    Args:
        image: (H,W,3) uint8 RGB of the camera's size.
        camera: the camera that took it.
        views: guide views of the part.
        rejected: the best hypothesis that was not accepted, if there was one.
        options: see `DiagnosisOptions`.
    """
    problem = diagnose_picture(image, options)
    if problem:
        return problem
    credible = rejected if rejected is not None and rejected.quality >= options.min_quality else None
    reason = _too_small(camera, views, credible, options)
    if not reason and credible is not None:
        place = viewpoint(credible.cam_from_model, views.center_in_model, views.view_range.up)
        reason = outside_range(place, views.view_range, credible.quality >= options.fitting_quality, options)
        reason = reason or _partly_outside(camera, views, credible, options)
        reason = reason or _low_contrast(image, camera, views, credible.cam_from_model, options)
        reason = reason or f"only {100 * credible.evidence.contour_support:.0f} % of the outline found"
    low, high = views.view_range.for_camera(camera, views.diameter_mm).distance_mm
    return reason or f"{NOTHING_IN_VIEW}, {low:.0f} to {high:.0f} mm away"


def diagnose_picture(image: NDArray[np.uint8], options: DiagnosisOptions = DEFAULT) -> str:
    """What is wrong with light, sharpness or contrast of a picture (H,W,3) uint8 RGB; empty when nothing is."""
    scale = min(1.0, options.width_px / image.shape[1])
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    if scale < 1.0:
        gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    if float(np.percentile(gray, 95)) < options.dark_level:
        return "too dark"
    if float(np.percentile(gray, 50)) >= options.bright_level:
        return "overexposed"
    widths_px = edge_widths_px(np.asarray(gray), options)
    if np.all(np.isnan(widths_px)):
        return "low contrast: hardly an edge in the picture"
    return BLURRED if np.nanmax(widths_px) > options.max_blur_px else ""


def edge_widths_px(gray: NDArray[np.uint8], options: DiagnosisOptions = DEFAULT) -> Array:
    """Standard deviation (2,) px of the blur across the strongest vertical and horizontal edges of a picture (H,W).

    A step blurred with σ has a slope in inverse proportion to √(σ² + s²) after smoothing with s, so the ratio of the
    slopes at two smoothings gives σ whatever the height of the step: Zhuo & Sim, "Defocus map estimation from a single
    image" (Pattern Recognition 2011). Edges are selected by height, so that a plain background does not count, and by
    direction, because motion blurs only the edges across it. Where wide blur leaves too few edges, they are searched
    for at half and a quarter of the size. NaN for a direction without enough edges.
    """
    widths = _widths_px(gray, options)
    for shrinking in (2, 4):
        if not np.any(np.isnan(widths)):
            break
        small = cv2.resize(gray, None, fx=1 / shrinking, fy=1 / shrinking, interpolation=cv2.INTER_AREA)
        widths = np.where(np.isnan(widths), shrinking * _widths_px(np.asarray(small), options), widths)
    return widths


def _widths_px(gray: NDArray[np.uint8], options: DiagnosisOptions) -> Array:
    """As `edge_widths_px`, at the size of the picture only."""
    fine_px, coarse_px = 1.0, 4.0
    picture = gray.astype(np.float32)
    slopes = []
    for sigma_px in (fine_px, coarse_px):
        smooth = cv2.GaussianBlur(picture, (0, 0), sigma_px)
        slopes.append([np.abs(cv2.Sobel(smooth, cv2.CV_32F, *axis, ksize=3)) / 8.0 for axis in ((1, 0), (0, 1))])
    lowest = max(options.min_step_share * float(np.percentile(gray, 95)), options.min_step)
    widths = np.full(2, np.nan)
    for axis in (0, 1):
        coarse, across = slopes[1][axis], slopes[1][1 - axis]
        height = coarse * np.sqrt(2.0 * np.pi) * coarse_px
        is_peak = (coarse >= cv2.dilate(coarse, np.ones((7, 7), np.uint8))) & (coarse > 1.5 * across)
        rows, columns = np.nonzero(is_peak & (height > lowest))
        if len(rows) < options.min_edges:
            continue
        fine = cv2.dilate(slopes[0][axis], np.ones((9, 9), np.uint8))
        strongest = np.argsort(-coarse[rows, columns])[:400]
        ratio2 = (fine[rows, columns][strongest] / coarse[rows, columns][strongest]) ** 2
        square = (coarse_px**2 - ratio2 * fine_px**2) / np.maximum(ratio2 - 1.0, 1e-3)
        widths[axis] = np.percentile(np.sqrt(np.maximum(square, 0.0)), 25)
    return widths


def outside_range(
    place: Viewpoint, view_range: ViewRange, is_fitting: bool, options: DiagnosisOptions = DEFAULT
) -> str:
    """How a viewpoint is outside the declared range, in words; empty when it is not.

    Direction and roll are only compared when the pose fits, because those of a poor pose are hardly known.
    """
    low, high = view_range.distance_mm
    if place.distance_mm > high * (1.0 + options.distance_margin):
        return f"too far: about {place.distance_mm:.0f} mm, declared up to {high:.0f} mm"
    if place.distance_mm < low * (1.0 - options.distance_margin):
        return f"too near: about {place.distance_mm:.0f} mm, declared from {low:.0f} mm"
    if not is_fitting:
        return ""
    direction = view_range.direction(place.azimuth_deg, place.elevation_deg)
    if not view_range.contains_direction(direction, options.angle_margin_deg):
        return (
            f"seen from outside the declared range: azimuth {place.azimuth_deg:.0f}°, "
            f"elevation {place.elevation_deg:.0f}°"
        )
    first, last = view_range.roll_deg
    away = abs((place.roll_deg - 0.5 * (first + last) + 180.0) % 360.0 - 180.0)
    if abs(place.elevation_deg) < options.pole_deg and away > 0.5 * (last - first) + options.angle_margin_deg:
        return f"turned outside the declared range: roll {place.roll_deg:.0f}°, declared {first:.0f} to {last:.0f}°"
    return ""


def diagnose_loss(
    image: NDArray[np.uint8],
    estimate: Estimate,
    recent: tuple[Array, Array] | None,
    camera: Camera,
    views: GuideViewSet,
    is_possible: bool,
    options: DiagnosisOptions = DEFAULT,
) -> str:
    """Why a tracked part was lost.

    Args:
        image: (H,W,3) uint8 RGB, the last frame.
        estimate: estimate of that frame, which was rejected.
        recent: the last two accepted poses (4,4), older first, if there are two.
        camera: camera of the frames.
        views: guide views of the part.
        is_possible: whether the estimate is in front of the camera and near the declared distances.
        options: see `DiagnosisOptions`.
    """
    center = apply(estimate.cam_from_model, views.center_in_model)
    if not is_possible and center[2] > 0:
        place = viewpoint(estimate.cam_from_model, views.center_in_model, views.view_range.up)
        return outside_range(place, views.view_range, False, options)
    step_px, share = _motion(camera, views, recent) if recent is not None else (np.zeros(2), None)
    in_picture = estimate.evidence.points_in_picture
    if center[2] <= 0 or in_picture < options.left_share:
        edge = "" if center[2] <= 0 else f" at the {_edge_of_picture(camera, camera.project(center))[0]} edge"
        return f"the part left the picture{edge}"
    edge, beyond_px = _edge_of_picture(camera, camera.project(center) + options.leaving_frames * step_px)
    if in_picture < options.leaving_share and beyond_px > 0:
        return f"the part left the picture at the {edge} edge"
    problem = diagnose_picture(image, options)
    if problem == BLURRED or (share is not None and share > options.max_motion):
        return "the part moved too fast"
    if problem:
        return problem
    return "the part is hidden or moved too fast"


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


def _too_small(
    camera: Camera, views: GuideViewSet, rejected: RejectedHypothesis | None, options: DiagnosisOptions
) -> str:
    """Whether the part spans too few pixels at the hypothesis, or even at the nearest declared distance."""
    low = views.view_range.distance_mm[0]
    distance_mm = low
    if rejected is not None:
        distance_mm = max(float(np.linalg.norm(apply(rejected.cam_from_model, views.center_in_model))), low)
    span_px = _span_px(camera, views, distance_mm)
    return f"too far: the part spans only {span_px:.0f} px" if span_px < options.min_span_px else ""


def _partly_outside(
    camera: Camera, views: GuideViewSet, rejected: RejectedHypothesis, options: DiagnosisOptions
) -> str:
    """Whether the border of the picture cuts the part off."""
    center = apply(rejected.cam_from_model, views.center_in_model)
    if rejected.evidence.points_in_picture > options.cut_off_share or center[2] <= 0:
        return ""
    if _span_px(camera, views, float(center[2])) > options.overflow * max(camera.width, camera.height):
        return "too near: the part does not fit in the picture"
    edge, _ = _edge_of_picture(camera, camera.project(center))
    return f"partly outside the picture at the {edge} edge"


def _low_contrast(
    image: NDArray[np.uint8], camera: Camera, views: GuideViewSet, cam_from_model: Array, options: DiagnosisOptions
) -> str:
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
    return "low contrast of the part against its background" if difference < options.min_contrast else ""
