"""Poses of a near-symmetric part that one picture cannot distinguish, because the features that break the symmetry are
not in view.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.cad.model import Model
from arview.cad.shape.symmetry import Symmetry
from arview.camera import Camera
from arview.geometry import Array
from arview.guideviews.surface import Surface, draw_surface
from arview.rendering.renderers import ZBufferRenderer
from arview_lab.evaluation.metrics import PoseError, PoseMeter, symmetry_group

MIN_PIXELS = 24
"""Changed pixels, a patch of about 5 × 5 px, that are needed to distinguish two poses."""
IN_VIEW_PX = 8
"""Pixels this near to a visible pixel of the part are in view too, such as a notch in its outline; farther ones are
outside the picture or occluded."""
_DIFFERENT_DEPTH = 0.004
"""Smallest step in depth that makes an edge, in diameters of the part."""
SIDE_PX, RADIUS_PX = 80, 35.0
"""Side of the small picture in which renderings are compared, and half the part's diameter in it."""
OTHER_NORMAL, OTHER_DEPTH = 0.3, 0.05
"""Differences in a normal's components, and in depth in half diameters, above which a pixel has changed."""


def indistinguishable_poses(
    model: Model,
    camera: Camera,
    cam_from_model: Array,
    near_symmetries: tuple[Symmetry, ...],
    mask: NDArray[np.bool_] | None = None,
) -> tuple[Array, ...]:
    """``cam_from_model`` (4,4) of all poses that cannot be distinguished from one, itself first.

    Args:
        model: the part.
        camera: ideal, of the picture.
        cam_from_model: the true pose.
        near_symmetries: rotations under which all but small features of the part are symmetric; a rotation counts if
            it changes fewer than `MIN_PIXELS` pixels in view.
        mask: (H,W) of the visible part; None if nothing occludes it.
    """
    if not near_symmetries:
        return (cam_from_model,)
    renderer = ZBufferRenderer(model, camera)
    truth = renderer.render(cam_from_model).depth_mm
    in_view: NDArray[np.bool_] | bool = True
    if mask is not None:
        reach = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * IN_VIEW_PX + 1, 2 * IN_VIEW_PX + 1))
        in_view = cv2.dilate(mask.astype(np.uint8), reach) > 0
    limit_mm = _DIFFERENT_DEPTH * model.diameter_mm
    alike = [cam_from_model]
    for turn in symmetry_group(near_symmetries)[1:]:
        turned = renderer.render(cam_from_model @ turn).depth_mm
        if np.count_nonzero((np.abs(turned - truth) > limit_mm) & in_view) < MIN_PIXELS:
            alike.append(cam_from_model @ turn)
    return tuple(alike)


def changed_share(surface: Surface, diameter_mm: float, cam_from_body: Array, true_cam_from_body: Array) -> float:
    """Share of a part's pixels at a true pose that change at another pose, in a small picture.

    Args:
        surface: of the part, about its centre.
        diameter_mm: of the part.
        cam_from_body, true_cam_from_body: (4,4), with the part in front of the camera.
    """
    place = true_cam_from_body[:3, 3]
    focal_px = np.full(2, RADIUS_PX / (0.5 * diameter_mm) * place[2])
    shown = []
    for pose in (cam_from_body, true_cam_from_body):
        drawn = np.empty((4, SIDE_PX, SIDE_PX), dtype=np.float32)
        face_ids = np.empty((SIDE_PX, SIDE_PX), dtype=np.int32)
        center_px = 0.5 * (SIDE_PX - 1) + focal_px * (pose[:2, 3] / pose[2, 3] - place[:2] / place[2])
        draw_surface(surface, pose, focal_px, center_px, diameter_mm, drawn, face_ids)
        shown.append(drawn)
    one, true = shown
    is_other = differing(one, true, OTHER_NORMAL, OTHER_DEPTH)
    return int(np.count_nonzero(is_other)) / max(1, int(np.count_nonzero(true[2])))


def differing(one: NDArray[np.float32], other: NDArray[np.float32], normal: float, depth: float) -> NDArray[np.bool_]:
    """Pixels (H,W) at which two drawings (4,H,W) of `draw_surface` differ.

    Args:
        one, other: the drawings.
        normal: largest difference of a component of the normals that is no difference.
        depth: the same of the depth.
    """
    off = np.abs(one - other)
    is_one, is_other = one[2] != 0.0, other[2] != 0.0
    return np.asarray((is_one != is_other) | (off[:3].max(axis=0) > normal) | (off[3] > depth))


def nearest_error(meter: PoseMeter, estimate: Array, truths: tuple[Array, ...]) -> PoseError:
    """Error of an estimate (4,4) against the one of several true poses that it is least rotated against."""
    return min((meter.measure(estimate, truth) for truth in truths), key=lambda error: error.rotation_deg)
